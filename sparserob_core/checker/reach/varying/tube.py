"""The worst case of ``c'x(t)`` over every disturbance and initial state, on cells of time, of a known system that
changes with time: what `Tube` is to the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.reach.disturbance_support import Scene, bounded
from sparserob_core.checker.reach.flow import stacked
from sparserob_core.checker.reach.tube import Known, Polynomial
from sparserob_core.checker.reach.varying.flow import VaryingFlow, prefixes
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb_mat

ORDER = 6  # of polynomials in the time on a cell: half of it takes shorter cells, twice it takes longer for each

EFFECTS_KEPT = 16  # nodes, at which the effect of every piece before is remembered; cells come one after another


@final
@dataclass(eq=False)
class VaryingTube:
    """The reachable states of a system, of which ``law`` is the flow, seen along combinations of the rows of ``basis
    (b, d)``."""

    law: VaryingFlow
    scene: Scene
    basis: Array
    flow: Known = Known()  # noqa: RUF009  immutable
    _tables: dict[tuple[int, int], tuple[arb_mat, arb_mat]] = field(default_factory=dict)
    _effects: dict[int, tuple[Enclosed, Enclosed]] = field(default_factory=dict)

    @cached_property
    def nodes(self) -> list[arb_mat]:
        """The undisturbed state at the breakpoints of the grid."""
        steps, d = [], self.law.system.states
        for (Phi, Gamma, _), u in zip(self._pieces, self.scene.control, strict=True):
            pushed = (Gamma * u).entries()
            last = balls([*np.zeros(d), 1.0])
            steps.append(stacked([*([*row, push] for row, push in zip(Phi.tolist(), pushed, strict=True)), last]))
        first = stacked([[v] for v in balls([*self.scene.initial_state, 1.0])])
        return [stacked([[x] for x in (step * first).entries()[:d]]) for step in prefixes(steps)]

    def cells(self, piece: int, start: float, stop: float, z: Array, sharp: bool = False) -> list[Polynomial]:
        """As `Tube.cells`, on a part of a piece within one segment of the system."""
        rows, begun, inputs = self._rows(piece, start, stop)
        x, m = self.nodes[piece], inputs.ncols() - self._disturbances
        u = self.scene.control[min(piece, len(self.scene.control) - 1)]
        pushes = stacked([row[:m] for row in inputs.tolist()])
        d, here = x.nrows(), begun * x + pushes * u
        both = stacked([[v] for v in (*here.entries(), *u.entries())])
        state = _with_rest([stacked([row[: d + m] for row in part.tolist()]) * both for part in rows])
        state = Enclosed(state.mid[..., 0], state.rad[..., 0])
        mid = (state.mid @ z.T).T[:, :, None]
        lost = state.rad + rounding(z.shape[1]) * np.abs(state.mid)
        rad, kinks = np.abs(z) @ lost.sum(axis=0), np.zeros(z.shape[0])
        parts = []
        if self.scene.disturbance is not None and stop > 0.0:
            parts.append((self.scene.disturbance, self._pushed(piece, rows, begun, inputs)))
        if self.scene.initial_set is not None:
            carried = _with_rest([stacked([row[:d] for row in part.tolist()]) * begun for part in rows])
            free = _product(carried, self._effect(piece)[0])  # (J + 1, b, d)
            every = Enclosed(*(np.moveaxis(part, 1, 2)[None, :, None] for part in (free.mid, free.rad)))
            parts.append((self.scene.initial_set, every))
        for convex, every in parts:
            shape = known(convex)
            moved, off, switching, _ = bounded(shape, self.flow.monomials, every.mid, every.rad, z, sharp)
            rad += off + rounding(1) * (np.abs(mid) + np.abs(moved)).sum(axis=(1, 2))
            mid, kinks = mid + moved, kinks + switching
        return [Polynomial(mid[i], float(rad[i]) * OUTWARD, 0.0, float(kinks[i])) for i in range(z.shape[0])]

    def _rows(self, piece: int, start: float, stop: float) -> tuple[list[arb_mat], arb_mat, arb_mat]:
        """The basis on ``[start, stop]`` as rows on the state at ``start`` and on inputs, ``(b, d + m + mw)``:
        coefficients in the time, and last what they leave out; and what the piece until ``start`` makes of the state at
        its beginning, and of inputs."""
        from flint import arb

        basis = stacked([[arb(float(v)) for v in row] for row in self.basis])
        if start == stop:
            terms, rest = self.law.within(start, stop, 0)
        else:
            terms, rest = self.law.within(start, stop, ORDER - 1)
        Phi, Gamma, Delta = self.law.over(self.scene.grid[piece], start)
        inputs = stacked([b + e for b, e in zip(Gamma.tolist(), Delta.tolist(), strict=True)])
        return [basis * part for part in (*terms, rest)], Phi, inputs

    def _pushed(self, piece: int, rows: Sequence[arb_mat], begun: arb_mat, inputs: arb_mat) -> Enclosed:
        """What every piece of the disturbance adds per unit, ``(pieces, J + 1, 1, mw, b)``."""
        d, mw = begun.nrows(), self._disturbances
        on_state = [stacked([row[:d] for row in part.tolist()]) for part in rows]
        carried = _with_rest([part * begun for part in on_state])  # (J + 1, b, d)
        pushes = stacked([row[inputs.ncols() - mw :] for row in inputs.tolist()])
        lasting = _with_rest(
            [
                part * pushes + stacked([row[whole.ncols() - mw :] for row in whole.tolist()])
                for part, whole in zip(on_state, rows, strict=True)
            ]
        )
        past = _product(carried, self._effect(piece)[1])  # (J + 1, b, piece mw)
        shape = (*past.mid.shape[:2], -1, mw)
        mid, rad = (
            np.moveaxis(np.concatenate([one.reshape(shape), two[:, :, None]], axis=2), (2, 3, 1), (0, 2, 3))
            for one, two in ((past.mid, lasting.mid), (past.rad, lasting.rad))
        )
        changes, grid = np.array(self.scene.changes), np.array(self.scene.grid[: mid.shape[0]])
        block = np.searchsorted(changes, grid, side="right")
        firsts = np.flatnonzero(np.diff(block, prepend=-1))
        rad = rad + rounding(mid.shape[0]) * np.abs(mid)
        mid, rad = (np.add.reduceat(part, firsts, axis=0)[:, :, None] for part in (mid, rad * OUTWARD))
        return Enclosed(mid, rad) if self.scene.lasting is None else Enclosed(*self.scene.lasting.gathered(mid, rad))

    @property
    def _disturbances(self) -> int:
        return int(self.law.system.disturbances)

    @cached_property
    def _pieces(self) -> list[tuple[arb_mat, arb_mat, arb_mat]]:
        return [self.law.over(*ends) for ends in pairwise(self.scene.grid)]

    def _effect(self, node: int) -> tuple[Enclosed, Enclosed]:
        """What the state at 0, ``(d, d)``, and the disturbance on every piece before a node of the grid, ``(d, node
        mw)``, made of the state there: by blocks of 1, 2, 4, ... pieces, each carried on by those that follow it."""
        if node not in self._effects:
            d, blocks, begin = self.law.system.states, [], 0
            for level in range(node.bit_length() - 1, -1, -1):
                if node >> level & 1:
                    blocks.append((level, begin >> level))
                    begin += 1 << level
            after, found = stacked([balls(row) for row in np.eye(d)]), []
            for block in reversed(blocks):
                found.append(_product(Enclosed.of(after), self._table(*block)))
                after = after * self._joined(*block)[0]
            columns = [Enclosed(np.zeros((d, 0)), np.zeros((d, 0))), *reversed(found)]
            mid, rad = (np.concatenate([getattr(one, name) for one in columns], axis=1) for name in ("mid", "rad"))
            if len(self._effects) >= EFFECTS_KEPT:
                self._effects.clear()
            self._effects[node] = Enclosed.of(after), Enclosed(mid, rad)
        return self._effects[node]

    def _table(self, level: int, number: int) -> Enclosed:
        return Enclosed.of(self._joined(level, number)[1])

    def _joined(self, level: int, number: int) -> tuple[arb_mat, arb_mat]:
        """What ``2^level`` pieces in a row make of the state before them, and of the disturbances on them, side by
        side."""
        if (level, number) not in self._tables:
            if not level:
                Phi, _, Delta = self._pieces[number]
                self._tables[level, number] = Phi, Delta
            else:
                (Phi, early), (onward, late) = (self._joined(level - 1, 2 * number + i) for i in range(2))
                rows = zip((onward * early).tolist(), late.tolist(), strict=True)
                self._tables[level, number] = onward * Phi, stacked([[*one, *two] for one, two in rows])
        return self._tables[level, number]


def _with_rest(parts: Sequence[arb_mat]) -> Enclosed:
    """Coefficients ``(J + 1, rows, columns)``, the last of ``parts`` being what all of them together leave out."""
    every = [Enclosed.of(part) for part in parts]
    mid, rad = (np.array([getattr(one, name) for one in every]) for name in ("mid", "rad"))
    rad[0] += (np.abs(mid[-1]) + rad[-1]) * OUTWARD
    return Enclosed(mid[:-1], rad[:-1])


def _product(left: Enclosed, right: Enclosed) -> Enclosed:
    """The product of matrices ``(..., d)`` and ``(d, n)``."""
    size, there = np.abs(left.mid), np.abs(right.mid)
    rad = size @ (right.rad + rounding(size.shape[-1]) * there) + left.rad @ (there + right.rad)
    return Enclosed(left.mid @ right.mid, rad * OUTWARD)
