"""Kinds of sets beyond those of the core: zonotopes."""

from __future__ import annotations

from collections.abc import Iterator

import sparserob_core as sr
from sparserob_sets.zonotope import ZonotopeFactory


@sr.hookimpl
def sparserob_sets() -> Iterator[sr.SetPlugin]:
    """Zonotopes."""
    yield sr.SetPlugin(
        name="zonotope",
        factory=ZonotopeFactory,
        summary="A sum of segments: centre + sum_j s_j generators_j with |s_j| <= 1.",
    )
