"""Plugins that are single files, as modules: ``sparserob_core.experiment.plugins.files.<file>``, ``<file>`` being its
path in hexadecimal digits.

A component of such a file can be sent to another process like any other: the name of its module says where it is.
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

__path__: list[str] = []  # what makes a module have modules below it


def load(file: Path) -> ModuleType:
    """The module of a file, executed anew."""
    name = f"{__name__}.x{os.fsencode(file).hex()}"
    sys.modules.pop(name, None)
    return importlib.import_module(name)


@final
class _Finder(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The file that a name of this kind spells."""
        parent, _, name = fullname.rpartition(".")
        if parent != __name__:
            return None
        return importlib.util.spec_from_file_location(fullname, os.fsdecode(bytes.fromhex(name[1:])))


sys.meta_path.append(_Finder())
