"""The worst case of ``c'x(t)`` over everything that a control answers, on cells of time, of a known system: what `VerifiedTube`
is where nothing is answered. Between the ends of a cell by a chord and the second derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.reach.closed_loop import VerifiedLoop, exactly
from sparserob_core.checker.reach.tube import Around, Polynomial
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat


@final
@dataclass(eq=False)
class LoopTube:
    """The reachable states of a closed ``loop``, seen along combinations of the rows of ``basis (b, d)``, and of
    ``gains (b, m)`` on the answers of the control beside them, its nominal part left out."""

    loop: VerifiedLoop
    basis: Array
    gains: Array
    flow: Around = Around()  # noqa: RUF009  immutable
    _heights: dict[tuple[int, float, bytes], Enclosed] = field(default_factory=dict, repr=False)

    def cells(self, piece: int, start: float, stop: float, z: Array, sharp: bool = False) -> list[Polynomial]:
        """As `VerifiedTube.cells`, with the chord as polynomial; of its error `expansion` is due to the length of the cell. The
        truth may be far below it between the ends."""
        begin, end = self._height(piece, start, z), self._height(piece, stop, z)
        bent = np.zeros(z.shape[0])
        if start < stop:
            bent = self.loop.bent(piece, start, stop, _combined(z, self.basis))
        lost = np.maximum(begin.rad, end.rad) + rounding(2) * (np.abs(begin.mid) + np.abs(end.mid)) + bent
        chords = np.stack([begin.mid, end.mid - begin.mid] if start < stop else [begin.mid])
        return [
            Polynomial(chord[:, None], float(error) * OUTWARD, float(length), 0.0)
            for chord, error, length in zip(chords.T, lost, bent, strict=True)
        ]

    def _height(self, piece: int, time: float, z: Array) -> Enclosed:
        """The largest ``c'x`` at a time in a piece of the grid, ``(k,)``."""
        key = piece, time, z.tobytes()
        if key not in self._heights:
            beside = None
            if self.gains.shape[1]:
                beside = exactly(_combined(z, self.gains)) * self.loop.answers(self.loop.on(piece))
            self._heights[key] = _of_column(self.loop.highest(piece, time, _combined(z, self.basis), beside))
        return self._heights[key]


@final
@dataclass(frozen=True, eq=False)
class Still:
    """Of what has places in place of times: ``heights`` of a place, by number, along rows ``(r, d)``, which are
    combinations of those of ``basis (b, d)``."""

    heights: Callable[[int, arb_mat], list[arb]]
    basis: Array
    flow: Around = Around()  # noqa: RUF009  immutable

    def cells(self, piece: int, start: float, stop: float, z: Array, sharp: bool = False) -> list[Polynomial]:
        """As `VerifiedTube.cells`, at one place."""
        found = _of_column(self.heights(piece, exactly(_combined(z, self.basis))))
        return [
            Polynomial(np.array([[height]]), float(error), 0.0, 0.0)
            for height, error in zip(found.mid, found.rad, strict=True)
        ]


def _combined(z: Array, basis: Array) -> Array | arb_mat:
    """``z'basis (k, d)``: floats where nothing is added up, balls elsewhere."""
    alone = (np.count_nonzero(z, axis=1) <= 1).all() and np.isin(z, (-1.0, 0.0, 1.0)).all()
    return np.asarray(z @ basis) if alone else exactly(z) * exactly(basis)


def _of_column(heights: Sequence[arb]) -> Enclosed:
    """Balls as numbers with their radii, ``(k,)`` each."""
    found = Enclosed.of(stacked([[height] for height in heights]))
    return Enclosed(found.mid[:, 0], found.rad[:, 0])
