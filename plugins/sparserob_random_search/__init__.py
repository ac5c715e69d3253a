"""Searches that do not look at the values: independent uniform points, the measure of every other maximiser, and
Sobol's sequence, whose best points a polish improves."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

import numpy as np

import sparserob_core as sr

BATCH = 256
NUMBERS = 2**22  # coordinates in a batch of Sobol's points


class RandomSearch(sr.Maximiser, sr.Options):
    """Independent uniform points in the box until the budget is spent (Brooks 1958); it proves no upper bound."""

    @property
    def polished(self) -> float:
        """Share of the budget for a local method: none, as this search is a yardstick."""
        return 0.0

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """Search until the budget is spent and return ``inf``, as no upper bound is proven; see
        `sparserob_core.Maximiser`."""
        lower, upper = objective.domain.lower, objective.domain.upper
        while objective.remaining:
            unit = rng.random((min(BATCH, objective.remaining), lower.size))
            objective.evaluate(np.clip(lower + unit * (upper - lower), lower, upper))
        return float("inf")


class Sobol(sr.Maximiser, sr.Options):
    """Points of Sobol's sequence (1967) with Owen's scrambling in the form of Matousek (1998): each is uniform, and
    ``2^k`` of them in a row fill the box more evenly than independent ones.

    That helps in a few dimensions; in many, any affordable number of points is as good as independent ones. The
    sequence is known up to 21201 dimensions, beyond which `InputError` is raised. It proves no upper bound.
    """

    scramble: bool = True
    """Randomise the sequence by the generator; without, it is the same in every run and begins in the lowest corner of
    the box."""

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """Search until the budget is spent and return ``inf``, as no upper bound is proven; see
        `sparserob_core.Maximiser`."""
        from scipy.stats import qmc

        lower, upper = objective.domain.lower, objective.domain.upper
        if lower.size > qmc.Sobol.MAXDIM:
            raise sr.InputError(
                f"sobol: the sequence is known up to {qmc.Sobol.MAXDIM} dimensions, this domain has {lower.size}; "
                "random_search has no such limit"
            )
        # scipy renamed the argument in 1.15.
        seed_option: dict[str, Any] = {"rng" if "rng" in inspect.signature(qmc.Sobol).parameters else "seed": rng}
        sequence = qmc.Sobol(lower.size, scramble=self.scramble, **seed_option)
        # Powers of two, as the balance of the sequence wants it; what exceeds the budget is drawn and not used.
        batch = min(BATCH, 2 ** max(0, (NUMBERS // lower.size).bit_length() - 1))
        while objective.remaining:
            unit = sequence.random(batch)[: objective.remaining]
            objective.evaluate(np.clip(lower + unit * (upper - lower), lower, upper))
        return float("inf")


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``random_search`` and ``sobol``."""
    yield sr.MaximiserPlugin(name="random_search", factory=RandomSearch, summary="independent uniform points")
    yield sr.MaximiserPlugin(name="sobol", factory=Sobol, summary="points of Sobol's sequence, scrambled (scipy)")
