"""Attribution of errors to components: an error in foreign code becomes one that names the component."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from sparserob_core.errors import PluginError, SparseRobError, named
from sparserob_core.sip.maximiser import SearchEnded

Answer = TypeVar("Answer")
MAX_ANSWER_LETTERS = 80  # of an answer of a plugin in a message
PASSING = (SparseRobError, SearchEnded)  # errors with a message of their own


@contextmanager
def attributed(origin: str, what: str, but: tuple[type[Exception], ...] = PASSING) -> Iterator[None]:
    """Raise every error inside the context, `SystemExit` included, as a `PluginError`.

    It names the component ``origin`` and ``what`` it was doing. The errors ``but`` and an interrupt are raised as they
    are.
    """
    passing: tuple[type[BaseException], ...] = (KeyboardInterrupt, *but)
    try:
        yield
    except passing:
        raise
    except BaseException as error:
        description = named(error)
        raise PluginError(f"{origin}: {what} raised {description}") from error


def asked(origin: str, what: str, question: Callable[[], object], expected: type[Answer]) -> Answer:
    """Return the answer of a component, where it has the type that its kind must return.

    Parameters
    ----------
    origin : str
        The name of the component in messages.
    what : str
        The call, in words.
    question : callable
        The function that asks the component.
    expected : type
        The type of the answer.

    Returns
    -------
    object
        The answer.

    Raises
    ------
    PluginError
        If the component raises an error, or its answer has another type.
    """
    with attributed(origin, what):
        answer = question()
    if not isinstance(answer, expected):
        raise PluginError(f"{origin}: {what} returned {short_repr(answer)}, expected a {expected.__name__}")
    return answer


def short_repr(value: object) -> str:
    """Return a short text of a value from foreign code, whose ``repr`` may fail too."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # noqa: BLE001  a foreign repr may raise anything
        text = f"a {type(value).__name__}"
    return text if len(text) <= MAX_ANSWER_LETTERS else text[: MAX_ANSWER_LETTERS - 3] + "..."
