"""Which functions of the core a call enters."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import sparserob_core as sr

CORE = Path(str(sr.__file__)).parent


def entered(call: Callable[[], Any], *places: str) -> tuple[Any, set[str]]:
    """What a call returns, and the functions that it enters in these files or folders of the core, ``sip/methods/`` for
    one, as ``sip.methods.driver.drive``; comprehensions and lambdas are left out."""
    found: set[str] = set()
    beginnings = tuple(str(CORE / place) + ("/" if place.endswith("/") else "") for place in places)

    def note(frame: Any, event: str, _: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(beginnings) and "<" not in code.co_name:
            module = Path(code.co_filename).relative_to(CORE).with_suffix("")
            found.add(".".join([*module.parts, code.co_qualname]))

    sys.setprofile(note)
    try:
        return call(), found
    finally:
        sys.setprofile(None)
