"""SparseRob: sparse robust optimal control of uncertain linear systems, with the proof.

Every public name is an attribute of this module, and is imported when it is first used; ``__init__.pyi`` lists them. To
read the package, follow the data; ``docs/architecture.md`` has the picture.

1. ``control/``     what is to be controlled (``sets``, ``problem``), what the state does (``response``), and the
   problem as a convex semi-infinite program (``constraints``, ``transcription``).
2. ``sip/``         such a program in general (``program``), finitely many of its constraints (``relaxed``, ``inner``),
   the most violated ones (``separation``), the way from there to the whole continuum (``methods``), and what was found
   and proven (``result``, ``evidence``, ``proof``).
3. ``checker/``     the same claims derived anew in ball arithmetic.
4. ``experiment/``  a file that names components (``config``), who offers them (``plugins``), the whole walk (``run``),
   and the commands (``cli``).

Imports go downwards only: ``experiment``, ``checker``, ``control``, ``sip``. Plugins import this module only.
"""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path


def _map_public_names() -> dict[str, str]:
    """The module of every public name, from the table in ``__init__.pyi``, which type checkers read too."""
    table = ast.parse(Path(__file__).with_suffix(".pyi").read_text("utf-8"))
    imports = [node for node in table.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in imports for alias in node.names}


_HOME = _map_public_names()
__all__ = sorted(_HOME)  # noqa: PLE0605
_FORMER = {
    f"{piece}Plugin": "sparserob_core.experiment.plugins.hookspecs"
    for piece in ("Schedule", "OuterStop", "InnerStop", "Selection")
}
"""Names that packages of interface 1 may use, and that are no longer told."""


def __getattr__(name: str) -> object:
    home = _HOME.get(name) or _FORMER.get(name)
    if home is None:
        from difflib import get_close_matches

        near = " or ".join(repr(match) for match in get_close_matches(name, __all__, 2))
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}" + f"; did you mean {near}?" * bool(near))
    value = getattr(import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__doc__", "__file__", "__name__", "__path__"]
