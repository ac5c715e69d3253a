"""Sets of kinds that others have written: they are known by what they say of themselves, which is looked at before it
is believed, and named where a claim rests on it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, ConvexSet

# Of the extent of the set, as in the contract of sets. Ten times less, and a support function that is computed by
# iterations is refused; ten times more, and one that is none by so much passes, though a proof asks for 1e-9.
CLOSE = 1e-7
# Where the own kinds of sets stand; those of a plugin that is a file stand below sparserob_core.experiment.
OWN = ("sparserob_core.control.", "sparserob_core.sip.")
DIRECTIONS = 16  # random ones, beside the axes and the sums of neighbours


def strangers(record: Any) -> Iterator[ConvexSet]:
    """The sets of kinds of others that a record holds, or is: its fields, and the members of its tuples."""
    if isinstance(record, ConvexSet) and not type(record).__module__.startswith(OWN):
        yield record
    elif isinstance(record, tuple):
        for member in record:
            yield from strangers(member)
    else:
        for name in getattr(record, "__dataclass_fields__", {}):
            yield from strangers(getattr(record, name, None))


def require_consistent(path: str, convex: ConvexSet | None) -> None:
    """Raise `InputError` where a set, or one of its parts, is of a kind of others and contradicts itself.

    In some directions ``c`` the support function has to be positively homogeneous, to be attained at the support point,
    and to bound ``c'x`` for the support points of all of these directions; on those it is then sublinear. So have the
    half-spaces, if there are any. What passes is believed, and said to be.
    """
    for one in strangers(convex):
        said = _contradiction(one)
        if said:
            raise InputError(
                path=path, expected="the support function of a convex set", got=f"one of the kind {one.kind}: {said}"
            )


def _contradiction(convex: ConvexSet) -> str:
    axes = np.eye(convex.dimension)
    drawn = np.random.default_rng(5).normal(size=(DIRECTIONS, convex.dimension))
    c = np.vstack([axes, -axes, drawn, drawn + np.roll(drawn, 1, axis=0), np.zeros((1, convex.dimension))])
    heights = np.asarray(convex.support(c), dtype=float)
    if heights.shape != (len(c),) or np.isnan(heights).any() or (heights == -np.inf).any():
        return "it is no number in some direction"
    bounded = np.isfinite(heights)
    c, heights, points = c[bounded], heights[bounded], np.asarray(convex.support_point(c[bounded]), dtype=float)
    if points.shape != c.shape or not np.isfinite(points).all():
        return "a support point is no point"
    lengths = np.linalg.norm(c, axis=1)
    close = CLOSE * lengths * max(float(np.abs(heights).max()), float(np.abs(points).max()))
    values = points @ c.T  # of every point in every direction
    return _first(
        (np.abs(np.diag(values) - heights) > close, c, "it is not attained at its support point"),
        (values.max(axis=0) > heights + close, c, "it does not bound its own support points: it is not sublinear"),
        (np.abs(convex.support(2.5 * c) - 2.5 * heights) > 2.5 * close, c, "h(2.5 c) is not 2.5 h(c)"),
        *_sides(convex, points, close),
    )


def _sides(convex: ConvexSet, points: Array, close: Array) -> Iterator[tuple[Array, Array, str]]:
    flat = convex.halfspaces()
    if flat is not None and flat[1].size:
        H, h = flat
        room = close.max(initial=0.0) * np.linalg.norm(H, axis=1)
        yield (points @ H.T > h + room).any(axis=0), H, "its half-spaces leave out a support point"
        yield convex.support(H) > h + room, H, "it is above the right-hand side of a half-space"


def _first(*looks: tuple[Array, Array, str]) -> str:
    """The first of some looks that has found something, with the direction."""
    for wrong, directions, words in looks:
        if wrong.any():
            return f"{words}, in the direction {directions[int(np.argmax(wrong))].tolist()}"
    return ""
