"""What holds of the bounds on cells of a flat constraint in time, whatever pushes it."""

from __future__ import annotations

import numpy as np

from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.sip.convex_set import Array


def assert_bounded_on_cells(one: FlatConstraint, x: Array, halvings: int = 2, near: float = 0.03) -> None:
    """No violation at a decision is above the bound of its cell, bounds are ``near`` after so many ``halvings`` of the
    cells, and rows at single times say the same violations."""
    lower, upper = one.cells
    for halved in range(halvings + 1):
        bounds = one.enclosure(x, lower, upper).bounds
        for low, high, bound in zip(lower[:, 0], upper[:, 0], bounds, strict=True):
            highest = one.at(x, np.linspace(low, high, 5)[:, None]).max()
            assert highest <= bound + 1e-12
            assert bound <= highest + near or halved < halvings
        middle = (lower + upper) / 2
        lower, upper = np.vstack([lower, middle]), np.vstack([middle, upper])
    indices = np.array([[0.4], [0.9], [1.7], [3.0]])
    G, h = one.rows(indices)
    np.testing.assert_allclose(G @ x - h, one.at(x, indices), atol=1e-13)
