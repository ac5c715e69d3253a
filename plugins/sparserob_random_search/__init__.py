"""Pure random search: independent uniform points. Slow, unbiased by any assumption, and the measure of every other maximiser."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import sparserob_core as sr

BATCH = 256


class RandomSearch(sr.Maximiser, sr.Options):
    """Independent uniform points in the box until the budget is spent (Brooks 1958); it proves no upper bound."""

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """See `sparserob_core.Maximiser`."""
        lower, upper = objective.domain.lower, objective.domain.upper
        while objective.remaining:
            unit = rng.random((min(BATCH, objective.remaining), lower.size))
            objective.evaluate(np.clip(lower + unit * (upper - lower), lower, upper))
        return float("inf")


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``random_search``."""
    yield sr.MaximiserPlugin(name="random_search", factory=RandomSearch, summary="independent uniform points")
