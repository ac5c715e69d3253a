"""Options of the landscape."""

from __future__ import annotations

from pydantic import Field

import sparserob_core as sr


class LandscapeOptions(sr.Options):
    """The landscape of ``g``, evaluated in the background."""

    coordinates: tuple[str, str] | None = None
    """Two coordinates, such as [t, p1] of the index that decides most, or [t, p1[2]] for a time of it and a parameter
    of the one that decides second; null: the two along which g moves most."""

    grid: int = Field(default=32, ge=8, le=256)
    """Points along each of the two."""

    evaluations: int = Field(default=100_000, ge=64)
    """Evaluations of g that all landscapes of a run may take; for the last quarter of them they stay coarse."""

    share: float = Field(default=0.15, gt=0.0, le=1.0)
    """Share of the processor time of one core that it may take during the run, beside a first, coarse drawing for each
    weight epsilon; finer grids take two thirds of it, a coarse one after a gain all."""

    patience: float = Field(default=2.0, ge=0.0, le=600.0)
    """Seconds that a run waits at its end for the landscape of its last tuple."""
