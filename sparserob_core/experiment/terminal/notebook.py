"""A finished run as a piece of a page: what notebooks show of it."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from html import escape

from sparserob_core.experiment.terminal.printing import printable


def page(title: str, rows: Sequence[tuple[str, str]], figure: bytes | None) -> str:
    """HTML of a title, a list of keys and values, and a figure (a PNG) where there is one."""
    cells = "".join(
        f"<tr><th style='text-align:left'>{_escape_text(name)}</th>"
        f"<td style='text-align:left'>{_escape_text(value)}</td></tr>"
        for name, value in rows
    )
    shown = ""
    if figure is not None:
        data = b64encode(figure).decode("ascii")
        shown = f"<img style='max-width:640px' alt='the control over time' src='data:image/png;base64,{data}'>"
    return f"<div><strong>{_escape_text(title)}</strong><table>{cells}</table>{shown}</div>"


def _escape_text(value: str) -> str:
    return escape(printable(value))
