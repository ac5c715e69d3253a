"""The kinds of sets that the checker knows, each with its `Shape`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np
from flint import arb, ctx

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.sets.along import NormSummand
from sparserob_core.checker.sets.budget import Budgeted, join_signals
from sparserob_core.checker.sets.curved import Ball, Cylindrical, Ellipsoidal, Joint
from sparserob_core.checker.sets.flat import Boxed, Octahedral, Polyhedral, Segments
from sparserob_core.checker.sets.shape import Shape, total
from sparserob_core.checker.sets.summands import Summand
from sparserob_core.control.sets.budget import BudgetedBox, BudgetedSignals
from sparserob_core.control.sets.sets import Box, ConvexSet, Cylinder, Ellipsoid, NormBall, Polytope, Product, Zonotope
from sparserob_core.sip.convex_set import Array

MAX_FACET_DIMENSION = 10  # the largest dimension in which the facets of a 1-norm ball are listed


def _build_ball(source: NormBall) -> Shape:
    if source.dimension == 1 or source.p == np.inf:
        return Boxed(source)
    return Octahedral(source) if source.p == 1.0 and source.dimension <= MAX_FACET_DIMENSION else Ball(source)


KINDS: Mapping[type[ConvexSet], Callable[[Any], Shape]] = MappingProxyType(
    {
        Box: Boxed,
        BudgetedBox: Boxed,
        BudgetedSignals: Budgeted,
        Polytope: Polyhedral,
        Ellipsoid: Ellipsoidal,
        NormBall: _build_ball,
        Zonotope: Segments,
        Cylinder: lambda source: Cylindrical(source, known(source.base)),
        Product: lambda source: Joint(source, [known(part) for part in source.parts]),
    }
)


def known(source: ConvexSet) -> Shape:
    """Return the `Shape` of a set at the working precision; `Unchecked` for a kind whose data the checker cannot read.
    No claim rests on what the set's own class computes, nor on a subclass of a known kind."""
    if type(source) not in KINDS:
        raise Unchecked(f"the checker does not know sets of the kind {source.kind}")
    return _build_shape(source, ctx.prec)


@lru_cache(maxsize=64)
def _build_shape(source: ConvexSet, precision: int) -> Shape:
    return KINDS[type(source)](source)


def middle(shape: ConvexSet) -> Array:
    """Return the middle ``(d,)`` of a bounded set; for a set without an interior, floats close to it."""
    point = shape.middle()  # any point of the set would be right: claims are about deviations from it
    if known(shape).member(point) is None:
        raise Unchecked(f"the middle of the {shape.kind} is not shown to be in it")
    return point


def summands_of(shape: ConvexSet) -> list[Summand | NormSummand]:
    """Return sets whose sum is a bounded set minus its `middle`, as `Shape.summands` does."""
    return known(shape).summands(middle(shape))


def sum_supports(bound: ConvexSet, lengths: Array, weights: Sequence[Sequence[arb]]) -> arb:
    """Return the largest sum over pieces of ``weights[l]'w_l``, for a disturbance in a set that is constant on pieces
    of such ``lengths``."""
    if bound.is_pointwise:
        return total(known(bound).support(row) for row in weights)
    signals = join_signals(bound, lengths[: len(weights)])
    return known(signals).support([row[i] for i in range(bound.dimension) for row in weights])


def admit(bound: ConvexSet, lengths: Array, signal: Array) -> bool:
    """Return True where the values ``(mw, n)`` of a signal on pieces, each in the set, are shown to be a signal of it;
    raise `Unchecked` where rounding may have moved it out of the set."""
    return bound.is_pointwise or known(join_signals(bound, lengths)).contains(signal.ravel())
