"""A memory of the last few results, by key."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def remember(cache: dict[bytes, T], key: bytes, value: T, capacity: int) -> T:
    """Keep ``value`` under ``key``, and at most ``capacity`` entries, the oldest forgotten first; returns the value."""
    while len(cache) >= capacity:
        cache.pop(next(iter(cache)))
    cache[key] = value
    return value
