"""Why a control switches where it does: how strongly the active constraints push it at every moment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, final

import numpy as np

if TYPE_CHECKING:
    import sparserob_core as sr
    from sparserob_rerun.drawing.palette import Floats


@final
class Switching:
    """The switching function of a program: minus the multipliers times the rows, on every piece, in units of what
    acting there costs.

    At an optimiser the control of a piece is zero where it lies between -1 and 1, and acts towards its sign beyond:
    stationarity, ``weights sign(S x) + S'^{-1} G'y = 0`` up to the regulariser. Known only where ``S`` is square and
    regular, and every piece has a cost.
    """

    def __init__(self, program: sr.SemiInfiniteProgram) -> None:
        self.program = program
        weights = np.asarray(program.finite.weights)
        self.weights = weights
        self.known = bool(weights.size == program.n and (weights > 0).all() and program.G is None)
        self.dense: Floats | None = None
        if self.known and program.finite.S is not None:
            self.dense = np.asarray(program.finite.S.toarray())
            self.known = bool(np.linalg.matrix_rank(self.dense) == program.n)

    def push(self, cuts: Sequence[sr.Cut], mu: Floats | None) -> Floats | None:
        """The switching function ``(m, K)`` under these constraints with their multipliers, or ``None`` where it is not
        known."""
        program = self.program
        if not self.known or (program.A is not None and (mu is None or mu.size != len(np.atleast_2d(program.A)))):
            return None
        total = np.zeros(program.n)
        for cut in cuts:
            family = program.formulated(cut.family, cut.formulation)
            if family is None:  # the number of a sample does not say which constraint it is
                return None
            rows, _ = family.rows(np.asarray(cut.index)[np.newaxis])
            total += cut.multiplier * rows[0, cut.row]
        if program.A is not None and mu is not None:
            total += mu @ np.atleast_2d(program.A)
        on_pieces = total if self.dense is None else np.linalg.solve(self.dense.T, total)
        return np.asarray(-on_pieces / self.weights).reshape(program.channels, -1)
