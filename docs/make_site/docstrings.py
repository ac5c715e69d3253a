"""Docstrings for the site: they are plain text with `names` and ``code``, and mathematics that is no markup."""

from __future__ import annotations

import re

LITERAL = re.compile(r"(``.+?``|`[^`]+`)")
MARKUP = re.compile(r"([\\*|_])")


def made_safe(app: object, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """For autodoc: the lines of a docstring, in place."""
    lines[:] = [*safe("\n".join(lines)).split("\n"), ""]


def safe(text: str) -> str:
    """The docstring with every character escaped that would be read as markup, but for names and code.

    A field's docstring, a list or a paragraph stays what it is; ``|u|`` and ``a*`` are mathematics.
    """
    return "\n\n".join(_paragraph(part) for part in text.split("\n\n"))


def _paragraph(text: str) -> str:
    pieces = LITERAL.split(text if _aligned(text) else " ".join(text.split()).replace("::", ":"))
    done = "".join(piece if at % 2 else MARKUP.sub(r"\\\1", piece) for at, piece in enumerate(pieces))
    return "\n".join(f"| {line.strip()}" for line in done.split("\n")) if _aligned(text) else done


def _aligned(text: str) -> bool:
    """Whether the lines of a paragraph are entries, such as ``name``  what it is."""
    lines = text.split("\n")
    return len(lines) > 1 and sum(bool(re.match(r"\s*``[^`]+``\s{2,}", line)) for line in lines) > 1
