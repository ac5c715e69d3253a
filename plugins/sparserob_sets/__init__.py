"""The kinds of sets that a config can name: their mathematics is in the core."""

from __future__ import annotations

from collections.abc import Iterator

import sparserob_core as sr
from sparserob_sets.zonotope import ZonotopeFactory

KINDS = "sparserob_core.experiment.config.set_kinds"


@sr.hookimpl
def sparserob_sets() -> Iterator[sr.SetPlugin]:
    """Offer the shipped kinds of sets."""
    yield sr.SetPlugin(name="box", factory=f"{KINDS}:BoxFactory", summary="Bounds on every coordinate.")
    yield sr.SetPlugin(name="polytope", factory=f"{KINDS}:PolytopeFactory", summary="Half-spaces: H x <= h.")
    yield sr.SetPlugin(
        name="ellipsoid",
        factory=f"{KINDS}:EllipsoidFactory",
        summary="An ellipsoid: (x - centre)' shape^-1 (x - centre) <= 1.",
    )
    yield sr.SetPlugin(
        name="norm", factory=f"{KINDS}:NormFactory", summary="A ball of a p-norm: |x - centre|_p <= radius."
    )
    yield sr.SetPlugin(
        name="zonotope",
        factory=ZonotopeFactory,
        summary="A sum of segments: centre + sum_j s_j generators_j with |s_j| <= 1.",
    )
