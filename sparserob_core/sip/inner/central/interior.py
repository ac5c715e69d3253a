"""An interior point method for uncertain rows: Mehrotra's (1992), with a Newton system eliminated block by block.

minimise ``c'z`` subject to ``g z + scale_r sum_j radius_j t_j + s = h``, ``s >= 0``, ``|a_j| <= t_j`` and
``a = C f + offset``. A block of answering variables ``f`` is eliminated by one Cholesky factorisation of its own size;
what is left of it are the parts, sums of absolute values, and then the joint variables ``z``. So a step costs as much
as the blocks do, however many of them there are. A solution is in the middle of all that are as good: a new row moves
it little.

New rows come to a decision that violates them. All products of slacks and multipliers are then made so large that
slacks of the size of the violation are in the middle, and the next solve begins there.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import cast, final

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import coo_array, csr_array, diags_array, hstack, vstack

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import INTERIOR, FiniteProgram, Spread, UncertainRows
from sparserob_core.sip.inner.central.elimination import Eliminated, Left, State, cholesky, eliminate
from sparserob_core.sip.inner.central.layout import Block, Layout
from sparserob_core.sip.inner.simplex.counterpart import RobustAnswer
from sparserob_core.workers import one_thread

STEPS = 80  # Newton steps of one solve at most
CORRECTIONS = 3  # of a step at most (Gondzio 1996): as many as take about half as long as what is factorised for it
FURTHER = 0.3  # of the way, by which a correction is to make a step longer
LEAST, SHARES = 0.01, 9  # share of a correction at least, and how many are tried: its length is little work
SHARE = 0.995  # of the way to the boundary
PROXIMAL = 1e-9  # weight of the distance from the last iterate: directions that change nothing have no length
FIRST = 0.1  # products that the method begins with, in units of the largest cost
AROUND, ROOM = 5.0, 1.0  # slacks that it begins with: times the largest violation, at least
SLACK = 0.1  # share of a violation that new rows have as slack in the middle
SPENT = 0.1  # share of the accuracy that residuals may take
MET = 1e-10  # residual of rows that is none
ROUNDED = 1e-14  # share of its reach below which a variable is 0: what costs nothing has no gap, and rows do not move
NOTHING = 1e-11  # share of the largest multiplier below which one is 0
ENDLESS = 1e9  # multipliers of rows that nothing meets
TINY = 1e-300

Direction = tuple[Array, Array, Array, Array, Array, Array, Array, Array]
Iterate = tuple[float, Array, Array, Array, Array, Array, Array, Array, Array]


@final
@dataclass(eq=False)
class Interior:
    """Uncertain rows over one program and one box of deviations, to which rows are added; every solve begins where the
    last one ended. ``answered`` counts the solves by method."""

    program: FiniteProgram
    spread: Spread
    steps: int = 0
    answered: Counter[str] = field(default_factory=Counter)
    blocks: list[UncertainRows] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._layout = Layout(self.program, self.spread)
        self._is_initialised, self._is_stale, none = False, True, np.zeros(0)
        self._z, self._f, self._s, self._y, self._mu = none, none, none, none, 0.0
        self._plus, self._minus, self._alpha, self._beta = none, none, none, none
        self._dual_step = 0.0  # share of the last direction that multipliers went
        self._margin, self._tightening = 0.0, 0.0  # of the last solve, and by how much more rows are tightened now
        self._stored_iterate: tuple[float, Iterate] | None = None  # where the last solve with another margin ended

    def add(self, block: UncertainRows) -> None:
        """Impose rows from now on."""
        if self.spread.is_box and not block.exact:
            self._layout.add(block)
        self.blocks.append(block)
        self._is_stale = True

    @property
    def approximate(self) -> bool:
        """Always true: the accuracy of an answer can be chosen."""
        return True

    def fits(self) -> bool:
        """Return whether this method can solve the program, and is worth it.

        The deviations must be a box, no row exact, and the cost without a matrix or norms of blocks; `Layout.fits`
        checks the rest.
        """
        plain = self.spread.is_box and not any(block.exact for block in self.blocks)
        plain = plain and self.program.P is None and self.program.blocks is None
        return plain and self._layout.fits()

    def sharpen(self, x: Array) -> bool:
        """Return ``False``: the method has the rows themselves, with no finite set of points that could grow."""
        return False

    def solve(self, margin: float, accuracy: float, seconds: float = np.inf) -> RobustAnswer:
        """Return the optimum with every row tightened by ``margin``, to about ``accuracy`` in the cost. It is not
        solved where ``seconds`` do not suffice, and says how far it has come."""
        self.answered[INTERIOR] += 1
        until = time.monotonic() + seconds
        if self._is_initialised and margin != self._margin:
            self._change_margin(margin)
        if self._is_stale:
            self._extend_iterate(margin)
        first, predicted_error = self._limits.size, np.inf
        self._h[first:] = self._layout.h - self._layout.rest - margin
        with np.errstate(all="ignore"), one_thread():  # threads for thousands of small matrices wait for each other
            for _ in range(STEPS):
                gap, dual_error, primal_residual = self._compute_residuals()
                close = gap + dual_error <= accuracy or gap <= SPENT * accuracy
                # half of the gap that is small enough: one that only tends to it is met by chance. Smaller products
                # would make steps short while residuals are still large; where these are rounding, only they help
                share = SPENT if dual_error > 2.0 * predicted_error else 1.0
                self._floor = 0.5 * share * accuracy / (self._y.size + 2 * self._plus.size)
                if close and primal_residual <= max(MET, SPENT * accuracy):
                    return self._form_answer(True, "interior point method: optimal")
                if not self._y.max() < ENDLESS or not self._take_step():
                    return self._form_answer(False, "the interior point method came to a halt")
                predicted_error = (1.0 - self._dual_step) * dual_error
                if time.monotonic() > until:
                    return self._form_answer(False, "the interior point method is out of time")
                self.steps += 1
        return self._form_answer(False, f"the interior point method took {STEPS} steps")

    def _change_margin(self, margin: float) -> None:
        """Go on with another margin, from where the last solve with it ended. The way back from rows that were
        tightened for one decision is as long as the way there. Without such a solve, go on in the middle of rows that
        the difference of the margins violates."""
        current = self._mu, self._z, self._f, self._s, self._y, self._plus, self._minus, self._alpha, self._beta
        stored, self._stored_iterate = self._stored_iterate, (self._margin, current)
        if stored is not None and stored[0] == margin:
            self._mu, self._z, self._f, self._s, self._y, self._plus, self._minus, self._alpha, self._beta = stored[1]
        else:
            self._tightening = max(0.0, margin - self._margin)
        self._margin, self._is_stale = margin, True

    def _initialise(self, margin: float) -> None:
        """Begin with joint variables, absolute values of those that cost, and the rows that bound them."""
        program, joint = self.program, self._layout.joint
        n, low, high = joint.size, program.lower[joint], program.upper[joint]
        weights = program.weights[joint]
        split = np.flatnonzero((weights > 0.0) & (low < 0.0) & (high > 0.0))
        k = np.arange(split.size)
        self._n, self._size = n, n + split.size
        signs = np.where(low >= 0.0, 1.0, np.where(high <= 0.0, -1.0, 0.0))
        self._c = np.concatenate([program.q[joint] + signs * weights, weights[split]])
        up, down = np.flatnonzero(np.isfinite(high)), np.flatnonzero(np.isfinite(low))
        count = up.size + down.size
        row = np.concatenate([np.arange(count), count + k, count + split.size + k])
        column = np.concatenate([up, down, split, split])
        value = np.concatenate([np.ones(up.size), -np.ones(down.size), np.ones(split.size), -np.ones(split.size)])
        row = np.concatenate([row, count + k, count + split.size + k])
        column, value = np.concatenate([column, n + k, n + k]), np.concatenate([value, -np.ones(2 * split.size)])
        self._bound_rows = csr_array(coo_array((value, (row, column)), shape=(count + 2 * split.size, self._size)))
        self._limits = np.concatenate([high[up], -low[down], np.zeros(2 * split.size)])
        self._z, self._f = np.zeros(self._size), np.zeros(self._layout.answering.size)
        self._z[:n], self._z[n:] = np.clip(0.0, low, high), ROOM
        reach = np.maximum(np.abs(program.lower), np.abs(program.upper))
        reach = np.where(np.isfinite(reach), reach, ROOM)
        self._variable_sizes = np.concatenate([reach[joint], np.full(split.size, ROOM)]), reach[self._layout.answering]
        self._mu = FIRST * max(float(np.abs(self._c).max(initial=0.0)), TINY)
        self._s = np.maximum(self._limits - self._bound_rows @ self._z, ROOM)
        self._y = self._mu / self._s
        self._plus = self._minus = self._alpha = self._beta = np.zeros(0)
        self._is_initialised, self._margin, self._stored_iterate = True, margin, None

    def _extend_iterate(self, margin: float) -> None:
        """Give everything that is new a place, slacks and multipliers."""
        kept, L = self._layout.arrange(), self._layout
        if not (self._is_initialised and kept):
            self._initialise(margin)
        first = self._limits.size
        self._g = csr_array(hstack([L.g, csr_array((L.g.shape[0], self._size - self._n))]))
        self._G = csr_array(vstack([self._bound_rows, self._g]))
        self._h = np.concatenate([self._limits, L.h - L.rest - margin])
        self._Phi = csr_array((L.scale, (np.arange(L.of.size), L.of)), shape=(L.of.size, L.parts))
        self._part_sizes = np.bincount(L.of, np.abs(self._h[first:]), L.parts) / np.bincount(L.of, L.scale, L.parts)
        had = self._s.size - first
        a = L.C @ self._f + L.offset
        worst = np.bincount(L.part, L.radius * np.abs(a), L.parts)
        free = self._h[first:] - self._g @ self._z - L.scale * worst[L.of]
        counts = np.bincount(L.part, minlength=L.parts) + 2.0  # a slack is as large as that of each absolute value
        violation = max(self._tightening, -float(free[had:].min(initial=0.0)))
        before: Array = np.bincount(L.of[:had], L.scale[:had] * self._y[first:], L.parts).astype(float)
        if had:
            aim = SLACK * violation * float(self._y[first:].max()) / float(counts.max())
            self._mu = max(self._mu, aim)
            # the smaller one grows: the other would leave residuals as large as what it is
            self._s = np.where(self._y > self._s, np.maximum(self._s, self._mu / self._y), self._s)
            self._y = np.maximum(self._y, self._mu / self._s)
        else:
            violation = max(ROOM, AROUND * violation)
        self._add_slacks(had, before, a, free, np.maximum(free, violation) / counts[L.of])
        self._is_stale, self._tightening = False, 0.0

    def _add_slacks(self, had: int, before: Array, a: Array, free: Array, room: Array) -> None:
        """Add slacks and multipliers of new rows, and renew those of all absolute values; ``room (r,)``: what a row of
        this freedom ``free`` has as slack in the middle."""
        L, first = self._layout, self._limits.size
        y, old_count = np.concatenate([self._y[first:], self._mu / room[had:]]), self._plus.size
        eta = np.bincount(L.of, L.scale * y, L.parts)
        weight = (eta / np.maximum(before, TINY))[L.part[:old_count]]
        self._alpha, self._beta = weight * self._alpha, weight * self._beta
        near = np.where(self._alpha > self._beta, self._plus, self._minus)
        price = np.maximum(self._alpha, self._beta)
        increase = np.where(price > near, np.maximum(self._mu / price - near, 0.0), 0.0)
        self._plus, self._minus = self._plus + increase, self._minus + increase
        bounds = np.full(L.parts, np.inf)
        np.minimum.at(bounds, L.of, room / np.maximum(L.scale, TINY))
        t = np.abs(a) + np.minimum(self._mu / np.maximum(eta, TINY), bounds)[L.part] / L.radius
        t[:old_count] = (self._plus + self._minus) / 2
        used = np.bincount(L.part, L.radius * (t - np.abs(a)), L.parts)
        slacks = np.maximum(free - L.scale * used[L.of], room)[had:]
        self._s = np.concatenate([self._s, slacks])
        self._y = np.concatenate([self._y, self._mu / slacks])
        self._plus, self._minus = (
            np.append(self._plus, (t - a)[old_count:]),
            np.append(self._minus, (t + a)[old_count:]),
        )
        none = np.zeros(t.size - old_count)
        self._alpha = np.maximum(np.append(self._alpha, none), self._mu / self._plus)
        self._beta = np.maximum(np.append(self._beta, none), self._mu / self._minus)

    def _compute_residuals(self) -> tuple[float, float, float]:
        """Return the gap, what the residuals of the dual take from a bound, and the largest of the primal."""
        L, first = self._layout, self._limits.size
        tau = np.bincount(L.part, L.radius * (self._plus + self._minus) / 2, L.parts)
        eta: Array = np.bincount(L.of, L.scale * self._y[first:], L.parts).astype(float)
        self._rz = self._c + self._G.T @ self._y
        self._rf = L.C.T @ (self._alpha - self._beta)
        self._rt = L.radius * eta[L.part] - self._alpha - self._beta
        self._rp = self._G @ self._z + self._s - self._h
        self._rp[first:] += L.scale * tau[L.of]
        gap = float(self._y @ self._s + self._alpha @ self._plus + self._beta @ self._minus)
        self._mu = gap / (self._y.size + 2 * self._plus.size)
        weight, _, slope = self._balance_multipliers(eta)
        dual_error = float(
            np.abs(self._rz) @ self._variable_sizes[0]
            + (weight - eta) @ self._part_sizes
            + np.abs(slope) @ self._variable_sizes[1]
        )
        return gap, dual_error, float(np.abs(self._rp).max())

    def _take_step(self) -> bool:
        """Take one step towards the optimum; return whether a step was possible."""
        try:
            self._factorise()
        except np.linalg.LinAlgError:
            return False
        values, prices = (self._s, self._plus, self._minus), (self._y, self._alpha, self._beta)
        products = [value * price for value, price in zip(values, prices, strict=True)]
        predicted = self._compute_direction(*(-product for product in products))
        changes = list(zip(values, prices, *_split_changes(predicted), strict=True))
        primal, dual = (_compute_step_length(change, 1.0) for change in self._compute_relative_changes(predicted))
        after = sum(float((s + primal * ds) @ (y + dual * dy)) for s, y, ds, dy in changes)
        share = after / sum(float(product.sum()) for product in products)
        aim = max(self._mu * min(1.0, max(share, 0.0)) ** 3, self._floor)
        terms = [aim - s * y - ds * dy for s, y, ds, dy in changes]
        move, primal, dual = self._combine_directions(predicted, self._compute_direction(*terms), primal * dual)
        for _ in range(CORRECTIONS):  # products that a longer step would make far from the middle are brought back
            if min(primal, dual) > 0.9:
                break
            longer = min(1.0, primal + FURTHER), min(1.0, dual + FURTHER)
            changes = list(zip(values, prices, *_split_changes(move), strict=True))
            terms = [s * dy + y * ds + _compute_corrections(s, y, ds, dy, *longer, aim) for s, y, ds, dy in changes]
            candidate, *lengths = self._combine_directions(move, self._compute_direction(*terms), primal * dual)
            if not sum(lengths) > primal + dual + 0.01:
                break
            move, (primal, dual) = candidate, lengths
        if not max(primal, dual) > 1e-8 or not np.isfinite(move[1]).all():
            return False
        dz, df, ds, dy, dplus, dminus, dalpha, dbeta = move
        self._z, self._f, self._s = self._z + primal * dz, self._f + primal * df, self._s + primal * ds
        self._plus, self._minus = self._plus + primal * dplus, self._minus + primal * dminus
        self._y, self._alpha, self._beta = self._y + dual * dy, self._alpha + dual * dalpha, self._beta + dual * dbeta
        self._dual_step = dual
        return True

    def _combine_directions(
        self, move: Direction, corrected: Direction, least: float
    ) -> tuple[Direction, float, float]:
        """Return a direction with a share of a correction, and the step lengths of the slacks and of the multipliers.

        For each of the two, the share of the correction is the one with the longest step. A correction is computed for
        a whole step, so that a short step needs less of it (Colombo and Gondzio 2008).
        """
        lengths, weights = list[float](), list[float]()
        for before, after in zip(
            self._compute_relative_changes(move), self._compute_relative_changes(corrected), strict=True
        ):
            trial_shares = np.linspace(1.0, max(least, LEAST), SHARES).tolist()
            length, weight = max(
                (_compute_step_length(before + share * (after - before), SHARE), share) for share in trial_shares
            )
            lengths.append(length)
            weights.append(weight)
        primal, dual = weights
        shares = (primal, primal, primal, dual, primal, primal, dual, dual)
        combined = tuple(a + share * (b - a) for a, b, share in zip(move, corrected, shares, strict=True))
        return cast(Direction, combined), lengths[0], lengths[1]

    def _compute_relative_changes(self, move: Direction) -> tuple[Array, Array]:
        """Return the changes of all slacks and of all multipliers, relative to what they are."""
        slacks, prices = _split_changes(move)
        over = np.concatenate([d / v for v, d in zip((self._s, self._plus, self._minus), slacks, strict=True)])
        under = np.concatenate([d / v for v, d in zip((self._y, self._alpha, self._beta), prices, strict=True)])
        return over, under

    def _factorise(self) -> None:
        """Factorise the blocks, then what they leave of the rows, then the joint variables."""
        L, first = self._layout, self._limits.size
        e, b = self._alpha / self._plus, self._beta / self._minus
        both = e + b
        self._stiffness = both + PROXIMAL
        self._lean = (e - b) / self._stiffness
        self._weight = (4.0 * e * b + PROXIMAL * both) / self._stiffness
        lean = self._lean * L.radius
        S = np.diag(np.bincount(L.part, L.radius**2 / self._stiffness, L.parts))
        diagonal = PROXIMAL + L.squares @ self._weight
        self._eliminated: list[tuple[Block, Eliminated, np.ndarray]] = []
        for group in L.groups:
            contribution = Left(group.parts.size)
            for block in group.blocks:
                eliminated = eliminate(block, diagonal[block.first : block.last], self._weight, lean, contribution)
                self._eliminated.append((block, eliminated, group.parts))
            S[np.ix_(group.parts, group.parts)] += contribution.total()
        self._D = self._y / self._s
        W = (L.scale[:, None] * S[np.ix_(L.of, L.of)]) * L.scale
        W.reshape(-1)[:: L.of.size + 1] += 1.0 / self._D[first:]
        self._W = cholesky(W)
        self._Y, _ = lapack.dtrtrs(self._W, self._g.toarray(), lower=1)
        table = (self._bound_rows.T @ diags_array(self._D[:first]) @ self._bound_rows).toarray()
        self._K = cholesky(table + self._Y.T @ self._Y)

    def _compute_direction(self, rows: Array, over: Array, under: Array) -> Direction:
        """Return the Newton direction for these changes of the products of slacks and multipliers: of ``z``, ``f``, and
        the slacks and multipliers of rows and of both sides of absolute values."""
        L, D, first = self._layout, self._D, self._limits.size
        k, kp, km = rows / self._s, over / self._plus, under / self._minus
        pull = -self._rt + kp + km
        rhs = -self._rf - L.C.T @ (kp - km - self._lean * pull)
        kappa = np.bincount(L.part, L.radius * pull / self._stiffness, L.parts)
        states = list[State]()
        for block, eliminated, parts in self._eliminated:
            state, reduced_rhs = eliminated.forward(rhs[block.first : block.last])
            states.append(state)
            kappa[parts] += reduced_rhs
        lifted, _ = lapack.dtrtrs(self._W, self._rp[first:] + L.scale * kappa[L.of] + k[first:] / D[first:], lower=1)
        right = self._rz + self._bound_rows.T @ (D[:first] * self._rp[:first] + k[:first]) + self._Y.T @ lifted
        dz, _ = lapack.dpotrs(self._K, -right, lower=1)
        dy = np.empty(k.size)
        dy[:first] = D[:first] * (self._bound_rows @ dz + self._rp[:first]) + k[:first]
        dy[first:], _ = lapack.dtrtrs(self._W, self._Y @ dz + lifted, lower=1, trans=1)
        deta = self._Phi.T @ dy[first:]
        df = np.empty(self._f.size)
        for (block, eliminated, parts), state in zip(self._eliminated, states, strict=True):
            df[block.first : block.last] = eliminated.back(state, deta[parts])
        da = L.C @ df
        dt = (pull - L.radius * deta[L.part]) / self._stiffness + self._lean * da
        dplus, dminus = dt - da, dt + da
        dalpha, dbeta = kp - self._alpha / self._plus * dplus, km - self._beta / self._minus * dminus
        return dz, df, (k - dy) / D, dy, dplus, dminus, dalpha, dbeta

    def _form_answer(self, solved: bool, said: str) -> RobustAnswer:
        L = self._layout
        x = np.zeros(self.program.n)
        for places, values, reach in zip(
            (L.joint, L.answering), (self._z[: self._n], self._f), self._variable_sizes, strict=True
        ):
            x[places] = np.where(np.abs(values) > ROUNDED * reach[: values.size], values, 0.0)
        y = self._y[self._limits.size :]
        y = np.where(y > NOTHING * y.max(), y, 0.0)
        eta: Array = np.bincount(L.of, L.scale * y, L.parts).astype(float)
        weight, aim, _ = self._balance_multipliers(eta)
        y = y + ((weight - eta) / np.maximum(np.bincount(L.of, L.scale, L.parts), TINY))[L.of]
        leaning = np.divide(aim, weight[L.part], out=np.zeros(aim.size), where=weight[L.part] > 0.0)
        table = L.at_rest.copy()
        table[L.part, L.entry] = np.clip(leaning, -L.radius, L.radius)
        signs = np.concatenate([np.sign(block.factor) for block in self.blocks])
        return RobustAnswer(solved, said, x, y, signs[:, None] * table[L.of], np.zeros(0))

    def _balance_multipliers(self, eta: Array) -> tuple[Array, Array, Array]:
        """Return weights ``(p,)`` of parts that weigh ``eta``, with the multipliers ``(J,)`` of what is in their
        absolute values, such that variables that answer have no slope, and the slopes ``(n,)`` that some have all the
        same.

        What is left of ten thousand slopes, times how far each variable can go, is more than the tolerated gap. Every
        such variable is alone in an absolute value, of its effect on the control, whose deviation takes the slope.
        Where this deviation is at its end the part weighs more, by all its rows alike, so that opposite rows move no
        joint variable.
        """
        L = self._layout
        leaning = L.radius * (self._alpha - self._beta) / np.maximum(self._alpha + self._beta, TINY)
        aim = eta[L.part] * np.clip(leaning, -L.radius, L.radius)
        single = L.single[np.lexsort((eta[L.part[L.single]], L.offset[L.single] == 0.0))]  # the best are written last
        taker = np.full(self._f.size, -1)
        taker[L.C.indices[L.C.indptr[single]]] = single
        takes = taker >= 0
        taker, slope = taker[takes], L.C.T @ aim
        aim[taker] -= slope[takes] / L.C.data[L.C.indptr[taker]]
        weight = eta.copy()
        np.maximum.at(weight, L.part[taker], np.abs(aim[taker]) / L.radius[taker])
        return weight, aim, np.where(takes, 0.0, slope)


def _compute_step_length(changes: Array, share: float) -> float:
    """Return the longest step, at most 1, that goes no further than a ``share`` of the way to where a number is 0."""
    least = float(changes.min(initial=0.0))
    return min(1.0, share / -least) if least < 0.0 else 1.0


def _split_changes(move: Direction) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]:
    """Return the changes of the slacks, and of their multipliers."""
    _, _, ds, dy, dplus, dminus, dalpha, dbeta = move
    return (ds, dplus, dminus), (dy, dalpha, dbeta)


def _compute_corrections(
    value: Array, price: Array, dvalue: Array, dprice: Array, primal: float, dual: float, aim: float
) -> Array:
    """Return corrections towards ``[0.1 aim, 10 aim]`` for products that a longer step would take outside; none is
    larger than ``10 aim``."""
    product = (value + primal * dvalue) * (price + dual * dprice)
    return np.clip(np.clip(product, 0.1 * aim, 10.0 * aim) - product, -10.0 * aim, 10.0 * aim)
