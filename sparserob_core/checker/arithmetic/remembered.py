"""Methods whose latest values are remembered."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

S = TypeVar("S")
P = ParamSpec("P")
T = TypeVar("T")


def remembered(
    most: Callable[[], int] | None = None, key: Callable[..., Hashable] | None = None
) -> Callable[[Callable[Concatenate[S, P], T]], Callable[Concatenate[S, P], T]]:
    """Return a decorator that remembers so many values of a method with every object: then the oldest are forgotten.

    Parameters
    ----------
    most
        How many values, asked for whenever one is made; all of them without it.
    key
        What values are told apart by, from the object and the arguments; by the arguments themselves without it.
    """

    def of(method: Callable[Concatenate[S, P], T]) -> Callable[Concatenate[S, P], T]:
        place = f"_{method.__name__}_remembered"

        @wraps(method)
        def remembering(self: S, *given: P.args, **named: P.kwargs) -> T:
            made: dict[Any, T] = self.__dict__.setdefault(place, {})
            mark = (given, *named.items()) if key is None else key(self, *given, **named)
            if mark not in made:
                value = method(self, *given, **named)
                while most is not None and len(made) >= most():
                    made.pop(next(iter(made)))
                made[mark] = value
            return made[mark]

        return remembering  # type: ignore[return-value]  # its first argument has a name

    return of
