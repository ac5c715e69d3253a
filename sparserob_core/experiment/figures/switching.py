"""Switching function of a control, which explains where it switches: multipliers times rows of the active
constraints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import final

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.program import SemiInfiniteProgram


@final
class Switching:
    """The switching function of a program: minus the multipliers times the rows, on every piece, in units of what
    acting there costs.

    At an optimiser the control of a piece is zero where it lies between -1 and 1, and acts towards its sign beyond:
    stationarity, ``weights sign(S x) + S'^{-1} G'y = 0`` up to the regulariser. Known only where ``S`` is square and
    regular, and every piece has a cost. Of a policy it is that of the control that answers nothing; where the cost is
    that of the largest size over all disturbances (``peak``), the band says what this size costs, and no more. Where
    an error of execution grows with the command (``erring``), acting costs also what that error does in the rows. Of a
    rendezvous the function is the primer vector (Lawden 1963).
    """

    def __init__(self, program: SemiInfiniteProgram, row: Callable[[Cut], Array | None]) -> None:
        """``row``: the left-hand side ``(n,)`` of an imposed constraint, ``None`` where that is not known."""
        self.program, self.row = program, row
        weights = np.asarray(program.finite.weights)
        acting = weights[weights > 0.0]
        self.erring = program.spread is None and program.n == 2 * acting.size
        priced = weights if program.spread is None and not self.erring else acting
        self.weights, self.pieces = priced, priced.size
        self.peak = bool(program.spread is not None and (weights[: priced.size] == 0.0).any())
        square = self.erring or priced.size == (program.n if program.spread is None else program.image_size)
        self.known = bool(square and priced.size and (priced > 0).all() and program.G is None)
        self.dense: Array | None = None
        if self.known and program.finite.S is not None:
            self.dense = np.asarray(program.finite.S.toarray())
            if self.erring:
                self.dense = self.dense[: self.pieces, : self.pieces]
            has_all_pieces = self.dense.shape == (self.pieces, self.pieces)
            self.known = bool(has_all_pieces and np.linalg.matrix_rank(self.dense) == self.pieces)

    def evaluate(self, cuts: Sequence[Cut], mu: Array | None) -> Array | None:
        """Return the switching function ``(m, K)`` under these constraints with their multipliers; ``None`` where it is
        not known."""
        program = self.program
        if not self.known or (program.A is not None and (mu is None or mu.size != len(np.atleast_2d(program.A)))):
            return None
        names = {family.name for family in program.families}
        if any(cut.family not in names for cut in cuts):  # a method may impose what is no constraint of the program
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
        price = self.weights + (total[self.pieces :] if self.erring else 0.0)
        total = total[: self.pieces]
        on_pieces = total if self.dense is None else np.linalg.solve(self.dense.T, total)
        return np.asarray(-on_pieces / price).reshape(program.channels, -1)
