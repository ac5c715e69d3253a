"""Attributes errors to components: what foreign code raises, or returns in spite of its kind, becomes one error that
names the component."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from sparserob_core.errors import PluginError, SparseRobError, named
from sparserob_core.sip.maximiser import SearchEnded

Answer = TypeVar("Answer")
SHOWN = 80
PASSING = (SparseRobError, SearchEnded)  # these say themselves what is wrong


@contextmanager
def attributed(origin: str, what: str, but: tuple[type[Exception], ...] = PASSING) -> Iterator[None]:
    """Whatever is raised inside, `SystemExit` too, becomes a `PluginError` that names the component ``origin`` and what
    it was doing. The errors ``but`` and Ctrl-C pass."""
    passing: tuple[type[BaseException], ...] = (KeyboardInterrupt, *but)
    try:
        yield
    except passing:
        raise
    except BaseException as error:
        said = named(error)
        raise PluginError(f"{origin}: {what} raised {said}") from error


def asked(origin: str, what: str, question: Callable[[], object], expected: type[Answer]) -> Answer:
    """The answer of a component, of the type that its kind must return; anything else is its `PluginError`."""
    with attributed(origin, what):
        answer = question()
    if not isinstance(answer, expected):
        raise PluginError(f"{origin}: {what} returned {short_repr(answer)}, expected a {expected.__name__}")
    return answer


def short_repr(value: object) -> str:
    """A short text of a value that foreign code made, whose ``repr`` may fail too."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # noqa: BLE001  a foreign repr
        text = f"a {type(value).__name__}"
    return text if len(text) <= SHOWN else text[: SHOWN - 3] + "..."
