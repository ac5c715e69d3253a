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
    regular, and every piece has a cost. Of a policy it is that of the control that answers nothing; where the cost is
    that of the largest size over all disturbances (``peak``), the band says what this size costs, and no more.
    """

    def __init__(self, view: sr.Inspection) -> None:
        self.program, self.row = view.program, view.row
        program, weights = view.program, np.asarray(view.program.finite.weights)
        priced = weights if program.spread is None else weights[weights > 0.0]
        self.weights, self.pieces = priced, priced.size
        self.peak = bool(program.spread is not None and (weights[: priced.size] == 0.0).any())
        square = priced.size == (program.n if program.spread is None else program.image_size)
        self.known = bool(square and priced.size and (priced > 0).all() and program.G is None)
        self.dense: Floats | None = None
        if self.known and program.finite.S is not None:
            self.dense = np.asarray(program.finite.S.toarray())
            whole = self.dense.shape == (self.pieces, self.pieces)
            self.known = bool(whole and np.linalg.matrix_rank(self.dense) == self.pieces)

    def push(self, cuts: Sequence[sr.Cut], mu: Floats | None) -> Floats | None:
        """The switching function ``(m, K)`` under these constraints with their multipliers, or ``None`` where it is not
        known."""
        program = self.program
        if not self.known or (program.A is not None and (mu is None or mu.size != len(np.atleast_2d(program.A)))):
            return None
        total = np.zeros(program.n)
        for cut in cuts:
            if program.family(cut.family).defines:  # it says what the price is
                continue
            row = self.row(cut)
            if row is None:
                return None
            total += cut.multiplier * row
        if program.A is not None and mu is not None:
            total += mu @ np.atleast_2d(program.A)
        total = total[: self.pieces]
        on_pieces = total if self.dense is None else np.linalg.solve(self.dense.T, total)
        return np.asarray(-on_pieces / self.weights).reshape(program.channels, -1)
