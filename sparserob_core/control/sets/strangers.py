"""Checks of sets of plugins, whose support functions are used in proofs.

A set of a plugin is known by its methods alone. These are compared with one another before the set is used, and claims
that rest on such a set name it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, ConvexSet

# The tolerance relative to the extent of the set, as in the contract of sets. Ten times less would refuse a support
# function that is computed by iterations. Ten times more would accept larger errors, although a proof asks for 1e-9.
SUPPORT_TOLERANCE = 1e-7
# The modules of the sets of this package; a plugin that is a single file has a module below sparserob_core.experiment.
OWN = ("sparserob_core.control.", "sparserob_core.sip.")
RANDOM_DIRECTIONS = 16  # random directions, which are tried with the axes and with the sums of neighbouring directions


def strangers(record: Any) -> Iterator[ConvexSet]:
    """Yield the sets of plugins in a record: the record itself, its fields, and the members of its tuples."""
    if isinstance(record, ConvexSet) and not type(record).__module__.startswith(OWN):
        yield record
    elif isinstance(record, tuple):
        for member in record:
            yield from strangers(member)
    else:
        for name in getattr(record, "__dataclass_fields__", {}):
            yield from strangers(getattr(record, name, None))


def require_consistent(path: str, convex: ConvexSet | None) -> None:
    """Raise `InputError` where a set of a plugin, or such a part of a set, contradicts itself.

    In some directions ``c`` the support function has to be positively homogeneous and to be attained at the support
    point. It has to bound ``c'x`` for the support points of all of these directions, and is then sublinear on them.
    Half-spaces, if there are any, have to agree with it. A set that passes is used in proofs, which name it.

    Parameters
    ----------
    path : str
        The key of a config at which the set stands, for messages.
    convex : ConvexSet or None
        The set.

    Raises
    ------
    InputError
        The error names the contradiction and a direction.
    """
    for stranger in strangers(convex):
        contradiction = _find_contradiction(stranger)
        if contradiction:
            raise InputError(
                path=path,
                expected="the support function of a convex set",
                got=f"one of the kind {stranger.kind}: {contradiction}",
            )


def _find_contradiction(convex: ConvexSet) -> str:
    """Return the first contradiction of a set in words; empty where none is found."""
    axes = np.eye(convex.dimension)
    random_directions = np.random.default_rng(5).normal(size=(RANDOM_DIRECTIONS, convex.dimension))
    c = np.vstack(
        [
            axes,
            -axes,
            random_directions,
            random_directions + np.roll(random_directions, 1, axis=0),
            np.zeros((1, convex.dimension)),
        ]
    )
    heights = np.asarray(convex.support(c), dtype=float)
    if heights.shape != (len(c),) or np.isnan(heights).any() or (heights == -np.inf).any():
        return "it is no number in some direction"
    is_bounded = np.isfinite(heights)
    c, heights, points = (
        c[is_bounded],
        heights[is_bounded],
        np.asarray(convex.support_point(c[is_bounded]), dtype=float),
    )
    if points.shape != c.shape or not np.isfinite(points).all():
        return "a support point is no point"
    lengths = np.linalg.norm(c, axis=1)
    tolerances = SUPPORT_TOLERANCE * lengths * max(float(np.abs(heights).max()), float(np.abs(points).max()))
    values = points @ c.T  # c'x for every support point x and every direction c
    return _describe_first_failure(
        (np.abs(np.diag(values) - heights) > tolerances, c, "it is not attained at its support point"),
        (values.max(axis=0) > heights + tolerances, c, "it does not bound its own support points: it is not sublinear"),
        (np.abs(convex.support(2.5 * c) - 2.5 * heights) > 2.5 * tolerances, c, "h(2.5 c) is not 2.5 h(c)"),
        *_check_halfspaces(convex, points, tolerances),
    )


def _check_halfspaces(convex: ConvexSet, points: Array, close: Array) -> Iterator[tuple[Array, Array, str]]:
    """Yield the checks of the half-spaces of a set, each as a mask of failures, the normals, and words."""
    flat = convex.halfspaces()
    if flat is not None and flat[1].size:
        H, h = flat
        room = close.max(initial=0.0) * np.linalg.norm(H, axis=1)
        yield (points @ H.T > h + room).any(axis=0), H, "its half-spaces leave out a support point"
        yield convex.support(H) > h + room, H, "it is above the right-hand side of a half-space"


def _describe_first_failure(*looks: tuple[Array, Array, str]) -> str:
    """Return the words of the first check that fails, with the direction; empty where none fails."""
    for fails, directions, words in looks:
        if fails.any():
            return f"{words}, in the direction {directions[int(np.argmax(fails))].tolist()}"
    return ""
