"""The decorator of methods whose latest values are remembered."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

S = TypeVar("S")
P = ParamSpec("P")
T = TypeVar("T")


def remembered(
    capacity: Callable[[], int] | None = None, key: Callable[..., Hashable] | None = None
) -> Callable[[Callable[Concatenate[S, P], T]], Callable[Concatenate[S, P], T]]:
    """Return a decorator that remembers values of a method on each object, under a ``key`` of the object and the
    arguments. Beyond ``capacity()`` values the oldest are forgotten."""

    def of(method: Callable[Concatenate[S, P], T]) -> Callable[Concatenate[S, P], T]:
        attribute = f"_{method.__name__}_remembered"

        @wraps(method)
        def remembering(self: S, *given: P.args, **named: P.kwargs) -> T:
            cache: dict[Any, T] = self.__dict__.setdefault(attribute, {})
            cache_key = (given, *named.items()) if key is None else key(self, *given, **named)
            if cache_key not in cache:
                value = method(self, *given, **named)
                while capacity is not None and len(cache) >= capacity():
                    cache.pop(next(iter(cache)))
                cache[cache_key] = value
            return cache[cache_key]

        return remembering  # type: ignore[return-value]  # its first argument has a name

    return of
