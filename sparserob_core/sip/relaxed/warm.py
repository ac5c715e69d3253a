"""A linear program of few rows that is solved again and again for other right-hand sides, each time from the last
basis."""

from __future__ import annotations

from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from sparserob_core.sip.convex_set import Array

ROUNDING = 2.0**-46  # of the numbers that are added up


@final
class WarmProgram:
    """Minimise ``sum_k weights_k |x_k|`` over ``lower <= x <= upper (n,)``, which hold 0, and rows ``G x <= h``.

    Rows are added with `add`; `solve` says the right-hand sides. HiGHS goes on from its last basis (Huangfu and Hall
    2018, dual simplex): a basis that was optimal stays dual feasible when right-hand sides change.
    """

    def __init__(self, weights: Array, lower: Array, upper: Array) -> None:
        import highspy

        self._optimal = highspy.HighsModelStatus.kOptimal
        self.weights, self.lower, self.upper = weights, lower, upper
        self.G = np.zeros((0, weights.size))
        n = weights.size
        self._highs: Any = highspy.Highs()
        for name, value in (("output_flag", False), ("presolve", "off"), ("solver", "simplex"), ("threads", 1)):
            self._highs.setOptionValue(name, value)
        self._highs.setOptionValue("primal_feasibility_tolerance", 1e-10)
        self._highs.setOptionValue("dual_feasibility_tolerance", 1e-10)
        self._highs.addVars(2 * n, np.zeros(2 * n), np.concatenate([upper, -lower]))
        self._highs.changeColsCost(2 * n, np.arange(2 * n, dtype=np.int32), np.concatenate([weights, weights]))

    def add(self, G: Array) -> None:
        """More rows ``(r, n)``."""
        r, n = G.shape
        starts, places = np.arange(r, dtype=np.int32) * (2 * n), np.tile(np.arange(2 * n, dtype=np.int32), r)
        free = np.full(r, np.inf)
        self._highs.addRows(r, -free, free, places.size, starts, places, np.hstack([G, -G]).ravel())
        self.G = np.vstack([self.G, G])

    def keep(self, wanted: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Leave out rows but for those that are ``wanted (r,)`` and those that are active now, so that the basis is one
        without them too; which rows are kept ``(r,)``."""
        import highspy

        basis, basic = self._highs.getBasis(), highspy.HighsBasisStatus.kBasic
        status = list(basis.row_status) if basis.valid else [basic] * wanted.size
        kept: NDArray[np.bool_] = wanted | np.array([one != basic for one in status], dtype=bool)
        gone = np.flatnonzero(~kept).astype(np.int32)
        self._highs.deleteRows(gone.size, gone)
        if basis.valid:
            basis.row_status = [one for one, stays in zip(status, kept, strict=True) if stays]
            self._highs.setBasis(basis)
        self.G = self.G[kept]
        return kept

    def solve(self, h: Array) -> tuple[Array, Array] | None:
        """``x (n,)`` and multipliers ``y (r,)``, for right-hand sides ``h (r,)``; ``None`` where there is no
        optimum."""
        self._highs.changeRowsBounds(h.size, np.arange(h.size, dtype=np.int32), np.full(h.size, -np.inf), h)
        self._highs.run()
        if self._highs.getModelStatus() != self._optimal:
            return None
        found, n = self._highs.getSolution(), self.weights.size
        values = np.array(found.col_value)
        x = np.clip(values[:n] - values[n:], self.lower, self.upper)
        return x, np.maximum(-np.array(found.row_dual), 0.0)

    def bound(self, h: Array, y: Array) -> float:
        """A lower bound of the cost under right-hand sides ``h (r,)``, by weak duality from any ``y (r,) >= 0``, less
        what rounding may do."""
        slope = y @ self.G
        ends = np.minimum((self.weights + slope) * self.upper, np.minimum((slope - self.weights) * self.lower, 0.0))
        reach = np.maximum(-self.lower, self.upper)
        size = y @ (np.abs(h) + np.abs(self.G) @ reach) + self.weights @ reach
        return float(ends.sum() - y @ h - ROUNDING * size)
