"""SequOOL, the parameter-free optimistic tree search: the best cells of each depth are opened, fewer of them the deeper
they lie."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Final

import numpy as np
from pydantic import Field

import sparserob_core as sr

CHILDREN: Final = 3
NUMBERS_AT_ONCE: Final = 2**23  # coordinates of a batch: 64 MB, however many dimensions there are


class SequOOL(sr.Maximiser, sr.Options):
    """Sequential online optimisation by opening cells (Bartlett, Gabillon and Valko, ALT 2019), with three children and
    centres.

    The box is a tree of cells; to *open* a cell is to cut it into thirds across one coordinate and to evaluate the
    centres of the two outer ones (the middle one inherits its value). The root is opened, and at each depth
    ``h = 1, ..., hmax`` the ``floor(hmax / h)`` best cells, or all when there are fewer. Across depth ``h`` the cut is
    across coordinate ``h`` modulo the number of coordinates. Of equal values the earlier cell is opened first
    (children in the order left, right, centre), so that the search is deterministic: the generator is not used. All
    cells of one depth are evaluated in one batch.

    ``hmax`` is the largest one whose exact number of evaluations ``1 + 2 (1 + sum_h min(floor(hmax / h), 3^h))`` fits
    what remains of the budget, or the paper's own for ``openings``. With fewer than three evaluations left the root is
    opened as far as they go.

    Guarantee (proven there): no smoothness has to be known. If ``f(x) >= f* - nu rho^h`` holds on the cell of depth
    ``h`` around one maximiser, the regret falls exponentially in ``n / log n`` where the near-optimality dimension
    ``d'`` is 0, and like ``(n / log n)^(-1/d')`` up to logarithms otherwise. No upper bound of the maximum is proven.

    In high dimension: a coordinate is cut only once in every ``d`` depths, so ``rho`` is about ``3^(-1/d)``;
    coordinates from ``hmax + 1`` on stay at the centre of the box for good (``hmax`` is about 140 for 1000
    evaluations); in a tuple that is another place for every index. It is strong up to some ten coordinates. Cells that
    are permutations of one another, such as the same index tuple in another order, are not recognised; what an earlier
    search found is not used. Below depth ``34 d`` the cells are smaller than the spacing of floating-point numbers, and
    points repeat.
    """

    apart: ClassVar[bool] = True

    openings: int | None = Field(default=None, ge=1, le=10**7)
    """The paper's ``n``: ``hmax = floor(n / (1 + 1/2 + ... + 1/n))``, which opens at most ``n + 1`` cells; the budget
    ends the search if that is more.
    ``null``: the largest ``hmax`` whose evaluations fit the budget."""

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """Search until the budget is spent and return ``inf``, as no upper bound is proven; see
        `sparserob_core.Maximiser`."""
        hmax = _paper(self.openings) if self.openings else _fill(objective.remaining)
        _Tree(objective, hmax + 1).grow(_schedule(hmax))
        return float("inf")


class _Tree:
    """Cells of one depth that can still be opened: centres ``(k, c)`` in the coordinates that are ever cut, and values
    ``(k,)``, best first."""

    def __init__(self, objective: sr.Objective, depths: int) -> None:
        domain = objective.domain
        self.objective, self.period = objective, domain.dimension
        cut = self.cut = np.arange(min(depths, self.period))
        self.root = np.clip(0.5 * domain.lower + 0.5 * domain.upper, domain.lower, domain.upper)
        self.lower, self.upper = domain.lower[cut], domain.upper[cut]
        # how far the children of the next cut stand off
        self.thirds = (0.5 * self.upper - 0.5 * self.lower) * (2 / CHILDREN)

    def grow(self, schedule: np.ndarray) -> None:
        """Open ``schedule[h]`` cells of each depth ``h``."""
        centres = self.root[np.newaxis, self.cut]
        values = self._values(centres)
        opened, hmax = 0, len(schedule) - 1
        for depth, count in enumerate(schedule.tolist()):
            best = np.array([values.argmax()]) if count == 1 else (-values).argsort(kind="stable")[:count]
            if self.objective.observed:
                self._show(centres[best])
            centres, values = self._open(centres[best], values[best], depth % self.period)
            opened += count
            self.objective.note(depth=depth, openings=opened, hmax=hmax)

    def _show(self, centres: np.ndarray) -> None:
        """Show the cells that are opened; a coordinate that is never cut is as wide as the box."""
        lower, upper = (
            np.tile(edge, (len(centres), 1)) for edge in (self.objective.domain.lower, self.objective.domain.upper)
        )
        half = 1.5 * self.thirds  # thirds are between the centres of the next children
        lower[:, self.cut] = np.maximum(centres - half, self.lower)
        upper[:, self.cut] = np.minimum(centres + half, self.upper)
        self.objective.sketch("cells opened", lower, upper)

    def _open(self, centres: np.ndarray, values: np.ndarray, across: int) -> tuple[np.ndarray, np.ndarray]:
        step = self.thirds[across]
        k, d = centres.shape
        children = np.empty((k, CHILDREN, d))
        children[:] = centres[:, np.newaxis]
        coordinates = centres[:, across]
        children[:, 0, across] = np.maximum(coordinates - step, self.lower[across])
        children[:, 1, across] = np.minimum(coordinates + step, self.upper[across])
        self.thirds[across] = step / CHILDREN
        child_values = np.empty((k, CHILDREN))
        child_values[:, :2] = self._values(children[:, :2].reshape(-1, d)).reshape(-1, 2)
        child_values[:, 2] = values
        return children.reshape(-1, d), child_values.ravel()

    def _values(self, centres: np.ndarray) -> np.ndarray:
        d = self.root.size
        if centres.shape[1] == d and centres.size <= NUMBERS_AT_ONCE:
            return self.objective.evaluate(centres)
        batch_size = max(1, NUMBERS_AT_ONCE // d)
        return np.concatenate(
            [self._values_at(centres[start : start + batch_size]) for start in range(0, len(centres), batch_size)]
        )

    def _values_at(self, centres: np.ndarray) -> np.ndarray:
        points = np.tile(self.root, (len(centres), 1))
        points[:, self.cut] = centres
        return self.objective.evaluate(points)


def _schedule(hmax: int) -> np.ndarray:
    """Return the numbers of cells to be opened at depths ``0, ..., hmax``."""
    depth = np.arange(1, hmax + 1)
    existing = CHILDREN ** np.minimum(depth, 39)  # 3^39 is the largest power in 64 bits
    return np.concatenate([[1], np.minimum(hmax // depth, existing)])


def _fill(budget: int) -> int:
    """Return the largest ``hmax`` whose evaluations fit; 0 when not even the root can be opened."""
    fits, exceeds = 0, 1
    while _cost(exceeds) <= budget:
        fits, exceeds = exceeds, 2 * exceeds
    while exceeds - fits > 1:
        middle = (fits + exceeds) // 2
        if _cost(middle) <= budget:
            fits = middle
        else:
            exceeds = middle
    return fits


def _cost(hmax: int) -> int:
    return 1 + 2 * int(_schedule(hmax).sum())


def _paper(openings: int) -> int:
    """Return the ``hmax`` of the paper for ``n`` openings."""
    return int(openings / (1.0 / np.arange(1, openings + 1)).sum())


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``sequool``."""
    yield sr.MaximiserPlugin(
        name="sequool", factory=SequOOL, summary="optimistic tree search without parameters, deterministic"
    )
