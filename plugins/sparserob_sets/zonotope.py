"""Zonotopes as a config writes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

import numpy as np
from pydantic import Field

import sparserob_core as sr


@final
class ZonotopeFactory(sr.SetFactory, sr.Options):
    """``centre + sum_j s_j generators_j`` with ``|s_j| <= 1``."""

    generators: list[list[float]] = Field(min_length=1)
    """Half the segments, one row each."""

    centre: float | list[float] = 0.0
    """Centre; a number serves every coordinate."""

    def build(self, dimension: int) -> sr.Zonotope:
        """Build the zonotope; raises `InputError` when the numbers are not as many as coordinates."""
        if {len(row) for row in self.generators} != {dimension}:
            lengths = [len(row) for row in self.generators]
            raise sr.InputError(f"every generator must have {dimension} numbers, got rows of {lengths}")
        centre = self.centre if isinstance(self.centre, list) else [self.centre] * dimension
        if len(centre) != dimension:
            raise sr.InputError(f"centre: expected {dimension} numbers, got {len(centre)}")
        return sr.Zonotope(np.array(centre), np.array(self.generators))

    @staticmethod
    def options_of(convex: sr.ConvexSet) -> Mapping[str, Any] | None:
        """Return the options that build a zonotope; the centre only where it is not the origin."""
        if not isinstance(convex, sr.Zonotope):
            return None
        centre = {"centre": convex.centre.tolist()} if convex.centre.any() else {}
        return {"generators": convex.generators.tolist(), **centre}
