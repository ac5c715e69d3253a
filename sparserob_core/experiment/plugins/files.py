"""Plugins that are single files, as modules.

The name of such a module is ``sparserob_core.experiment.plugins.files.<file>``, where ``<file>`` is ``x`` and the path
in hexadecimal digits. A component of the file can thus be sent to another process, for the name of its module contains
the place of the file.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import final

__path__: list[str] = []  # an attribute that makes this module a package, so that modules can be below it


def load(file: Path) -> ModuleType:
    """Return the module of a file, executed anew."""
    name = f"{__name__}.x{os.fsencode(file).hex()}"
    sys.modules.pop(name, None)
    return importlib.import_module(name)


@final
class _Finder(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the specification of the file that the name of such a module contains; ``None`` for other names."""
        parent, _, name = fullname.rpartition(".")
        if parent != __name__:
            return None
        return importlib.util.spec_from_file_location(fullname, os.fsdecode(bytes.fromhex(name[1:])))


sys.meta_path.append(_Finder())
