"""A bound against every causal policy: finitely many disturbance signals, and controls that may differ only once the
signals did.

Let ``w_1 .. w_S`` be signals of the disturbance's set. Whatever a causal policy does, its controls on piece ``k`` under
two of them are equal unless the signals differ before ``tau_k``. A difference within the piece comes too late, and a
policy that sees less than the disturbance itself can do no more (`knowledge`). So the controls under the signals are a
point of a linear program, the tree of the signals. Its value is a lower bound of the cost of every causal policy with
this dictionary, affine or not. These are the scenarios of Hadjiyiannis, Goulart and Kuhn (2011), who have two stages;
here there is every stage, and finitely many times.

Most signals need no variables. Take a signal that leaves one of the tree at a report, and is the worst for one row from
there on. The controls that can know of it respond as is best for that row: the least of a linear function over the set
of the control, a number. So every signal of the tree stands for many, and those that have multipliers are written out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, final

import numpy as np

from sparserob_core.control.feedback.closed_loop import ClosedLoop
from sparserob_core.control.feedback.knowledge import Knowledge, sums
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.inner.simplex.growing import GrowingProgram

EXCEEDED = 1e-9  # of a row's size, beyond which it is imposed
AT_ONCE = 3  # rows of every side that are imposed of each signal at once
PASSES = 40  # solutions of one tree, each with more rows
ROOM = 1.0  # how far a row may be kept within its limit, of its size


@final
@dataclass(frozen=True, eq=False)
class Sampled:
    """Constraints on the state at finitely many times: ``T u + N z <= b`` for the control ``u (m, K)`` and deviations
    ``z (Q,)`` of the disturbance; ``T (R, m, K)``, ``N (R, Q)``, ``b (R,)``. Of every row its
    ``constraint`` and ``side``, by number, and its ``time``."""

    T: Array
    N: Array
    b: Array
    constraint: np.ndarray
    side: np.ndarray
    time: Array

    @staticmethod
    def of(loop: ClosedLoop, constraints: list[tuple[Array, Array, Array]]) -> Sampled:
        """Return the rows of constraints ``H x(t) <= h``, each given as ``(H, h, times)``, for the control and the
        disturbances of a loop."""
        blocks: list[tuple[np.ndarray, ...]] = []
        response, K = loop.functionals.response.bare, loop.functionals.dictionary.pieces
        for number, (H, h, times) in enumerate(constraints):
            if not H.shape[0] or not times.size:
                continue
            row_times, side = np.repeat(times, H.shape[0]), np.tile(np.arange(H.shape[0]), times.size)
            free, weights, on_noise = response.weights(row_times, H[side], np.zeros((row_times.size, 0)))
            constant = free @ loop.start + loop.functionals.given(weights)
            constant = constant + np.einsum("rli,li->r", on_noise, loop.middles)
            T = loop.functionals.on_decision(weights).reshape(row_times.size, -1, K)
            N = np.einsum("rli,liq->rq", on_noise, loop.entries[..., : loop.noise.start])
            limits, numbers = h[side] - constant, np.full(row_times.size, number)
            blocks.append((T, N, limits, numbers, side, row_times))
        m, Q = loop.answers.shape[1], loop.noise.start
        if not blocks:
            none = np.zeros(0, dtype=int)
            return Sampled(np.zeros((0, m, K)), np.zeros((0, Q)), np.zeros(0), none, none, np.zeros(0))
        T, N, b, constraint, side, time = (np.concatenate(arrays) for arrays in zip(*blocks, strict=True))
        return Sampled(T, N, b, constraint, side, time)


@final
@dataclass(frozen=True, eq=False)
class Grown:
    """A solved tree, with the controls ``u (S, m, K)`` under every signal and the ``value`` of its program. For each
    row with a multiplier it has the signal, the row, the multiplier, and the report from which on the worst for that
    row replaces the signal. ``x``: the columns; ``shares``: with the cost ``worst``, the weight of every signal's
    effort."""

    value: float
    x: Array
    u: Array
    signals: np.ndarray
    rows: np.ndarray
    reports: np.ndarray
    multipliers: Array
    shares: Array


@final
@dataclass(eq=False)
class Tree:
    """The program of a tree of signals, which grows; ``knowledge``: what a control can tell of them, and what it
    cannot. ``prices (m, K)``: what an absolute value costs. The first signal must be the nominal one; with the cost
    ``nominal`` its absolute values are charged, with ``peak`` the largest over all signals, with ``worst`` those of the
    signal that costs most. With a ``highest`` factor its program is that of the largest factor of all
    deviations, without prices. ``seconds`` tells how many a solution may take; ``work`` counts what was done, the same
    on every machine.
    """

    sampled: Sampled
    knowledge: Knowledge
    control: ConvexSet
    prices: Array
    cost: Literal["nominal", "peak", "worst"]
    highest: float | None = None
    seconds: Callable[[], float] = lambda: np.inf
    work: float = 0.0
    signals: list[Array] = field(default_factory=list)
    _columns: list[np.ndarray] = field(default_factory=list)
    _group_columns: dict[tuple[int, bytes], np.ndarray] = field(default_factory=dict)
    _imposed_keys: set[tuple[int, int, bytes]] = field(default_factory=set)
    _imposed_rows: list[tuple[int, int, int]] = field(default_factory=list)
    _row_numbers: list[int] = field(default_factory=list)
    _group_size_columns: dict[tuple[int, bytes], np.ndarray] = field(default_factory=dict)
    _effort_rows: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        m, K = self.prices.shape
        axes = np.eye(m)
        low, high = -self.control.support(-axes), self.control.support(axes)
        radii = np.maximum(np.abs(low), np.abs(high))
        # columns are controls in this unit, and costs in that of the largest
        self._control_units = np.where(radii > 0.0, radii, 1.0)
        self._lower_bounds, self._upper_bounds = low / self._control_units, high / self._control_units
        largest = float((self.prices * self._control_units[:, None]).sum())
        self._cost_unit = largest if largest > 0.0 else 1.0
        self._program = GrowingProgram()
        upper, price = (0.0, 0.0) if self.highest is None else (self.highest, -1.0)
        self._program.variables(np.zeros(1), np.array([upper]), np.array([price]))
        self._size_columns = np.zeros((m, 0), dtype=int)
        if self.priced:
            self._charges, reach = self._column_prices.ravel(), np.ones(m * K)
            if self.cost == "worst":
                self._charges, reach = np.ones(1), np.array([2.0])
            self._charged_columns = self._program.variables(np.zeros(reach.size), reach, self._charges)
            if self.cost != "worst":
                self._size_columns = self._charged_columns.reshape(m, K)
            entries = [(np.zeros(reach.size, dtype=int), self._charged_columns, self._charges)]
            self._budget_row = int(self._program.rows(entries, np.array([-np.inf]), np.array([np.inf]))[0])

    @property
    def priced(self) -> bool:
        """True where the program minimises a cost, False where it maximises the factor of all deviations."""
        return self.highest is None

    @cached_property
    def _column_prices(self) -> Array:
        """The prices of the columns, ``(m, K)``."""
        return np.asarray(self.prices * self._control_units[:, None] / self._cost_unit)

    @cached_property
    def _halfspaces(self) -> tuple[Array, Array] | None:
        """Half-spaces of the columns of a piece, each in the unit of what it can be; the bounds of a box are none."""
        flat = None if self.control.is_box else self.control.halfspaces()
        if flat is None:
            return None
        H = flat[0] * self._control_units
        size = np.maximum(np.abs(H).sum(axis=1), np.finfo(float).tiny)
        return H / size[:, None], flat[1] / size

    @cached_property
    def _control_coefficients(self) -> Array:
        """Coefficients of the columns in the rows, ``(R, m, K)``."""
        return np.asarray(self.sampled.T * self._control_units[:, None])

    @cached_property
    def units(self) -> Array:
        """Largest possible size of every row, ``(R,)``, by which the row is divided."""
        s = self.sampled
        size = np.abs(self._control_coefficients).sum(axis=(1, 2)) + self.knowledge.contribution_bounds + np.abs(s.b)
        return np.where(size > 0.0, size, 1.0)

    def add(self, z: Array) -> bool:
        """Add a signal, and return whether it is new."""
        z = np.asarray(z, dtype=float) + 0.0
        if any(np.array_equal(z, signal) for signal in self.signals):
            return False
        m, K = self.prices.shape
        columns, nominal, flat = np.zeros((m, K), dtype=int), not self.signals, self._halfspaces
        for k in range(K):
            key = self._compute_information_key(z, k)
            is_new = key not in self._group_columns
            if is_new:
                self._group_columns[key] = self._program.variables(self._lower_bounds, self._upper_bounds, np.zeros(m))
            columns[:, k] = self._group_columns[key]
            if is_new and flat is not None:
                row, channel = np.nonzero(flat[0])
                self._add_rows([(row, columns[channel, k], flat[0][row, channel])], flat[1])
            if is_new and self.priced and (nominal or self.cost != "nominal"):
                channels = np.arange(m)
                if self.cost == "worst":
                    self._group_size_columns[key] = self._program.variables(np.zeros(m), np.ones(m), np.zeros(m))
                sizes = self._group_size_columns[key] if self.cost == "worst" else self._size_columns[:, k]
                for sign in (1.0, -1.0):
                    self._add_rows(
                        [(channels, columns[:, k], np.full(m, sign)), (channels, sizes, -np.ones(m))], np.zeros(m)
                    )
        if self.priced and self.cost == "worst":
            size_variables = [self._group_size_columns[self._compute_information_key(z, k)] for k in range(K)]
            column = np.concatenate([*size_variables, self._charged_columns])
            self._effort_rows.append(
                self._add_rows(
                    [(np.zeros(column.size, dtype=int), column, np.append(self._column_prices.T, -1.0))], np.zeros(1)
                )
            )
        self.signals.append(z)
        self._columns.append(columns)
        return True

    def _add_rows(self, entries: list[tuple[np.ndarray, np.ndarray, Array]], upper: Array) -> int:
        return int(self._program.rows(entries, np.full(upper.size, -np.inf), upper)[0])

    def _compute_information_key(self, z: Array, k: int) -> tuple[int, bytes]:
        """Return a key that is equal for all signals that the control on piece ``k`` cannot distinguish."""
        return k, self.knowledge.history(z, int(self.knowledge.known_reports[k]))

    def changed(self, signal: int, row: int, report: int) -> Array:
        """Return the worst signal for a row among those that share the first ``report`` reports with a signal of the
        tree."""
        return self.knowledge.changed(self.signals[signal], row, report)[1]

    def _impose_row(self, signal: int, row: int, report: int) -> bool:
        """Impose one row under a `changed` signal, and return whether it is new."""
        s, z = self.sampled, self.signals[signal]
        key = (row, report, self.knowledge.history(z, report))
        if key in self._imposed_keys:
            return False
        self._imposed_keys.add(key)
        is_informed, unit = self.knowledge.known_reports > report, self.units[row]
        channel, piece = np.nonzero(self._control_coefficients[row] * ~is_informed)
        noise, _ = self.knowledge.changed(z, row, report)
        columns, values = [self._columns[signal][channel, piece]], [self._control_coefficients[row][channel, piece]]
        columns.append(np.zeros(1, dtype=int))
        values.append(np.array([-unit if self.priced else noise]))
        limit = s.b[row] - (noise if self.priced else 0.0)
        if self._has_peak_variables:
            columns.append(self._size_columns[:, is_informed].ravel())
            values.append(-self._decrease_rates[row][:, is_informed].ravel())
            limit -= float(self._forced_contributions[row][:, is_informed].sum())
        else:
            limit -= float(self._least_contributions[row, is_informed].sum())
        column, value = np.concatenate(columns), np.concatenate(values) / unit
        self._row_numbers.append(
            self._add_rows([(np.zeros(column.size, dtype=int), column, value)], np.array([limit / unit]))
        )
        self._imposed_rows.append((signal, row, report))
        return True

    @property
    def _has_peak_variables(self) -> bool:
        """True where variables bound the sizes of the controls, as with the cost ``peak``."""
        return self.cost == "peak" and self.priced

    @cached_property
    def _decrease_rates(self) -> Array:
        """Largest decrease of every row by a control, per unit of the peak that bounds the control, ``(R, m, K)``."""
        T = self._control_coefficients
        moves = np.where(T > 0.0, (self._lower_bounds < 0.0)[:, None], (self._upper_bounds > 0.0)[:, None])
        return np.asarray(np.abs(T) * moves)

    @cached_property
    def _forced_contributions(self) -> Array:
        """Contribution above 0 to every row that the control cannot avoid, since its bounds exclude 0, ``(R, m, K)``; 0
        elsewhere."""
        T = self._control_coefficients
        return np.asarray(
            T
            * np.where(
                T > 0.0, np.maximum(self._lower_bounds, 0.0)[:, None], np.minimum(self._upper_bounds, 0.0)[:, None]
            )
        )

    @cached_property
    def _least_contributions(self) -> Array:
        """The least that the control on every piece can give to every row, ``(R, K)``."""
        return np.asarray(-self.control.support(-self.sampled.T.swapaxes(1, 2)))

    def least(self) -> Grown | None:
        """Return the tree of least cost, or of the largest factor; ``None`` where nothing is feasible or nothing was
        solved."""
        return self._solve_tree()

    def relaxed(self, budget: float = np.inf, central: bool = False) -> Grown | None:
        """Return the least relaxation, in the rows' units, that a cost within a ``budget`` needs (below 0: how far
        within all rows it can stay); the ``value`` is that. ``central``: in the middle of all controls that need no
        more."""
        highs = self._program.highs
        highs.changeColBounds(0, -ROOM, np.inf)
        highs.changeColCost(0, 1.0)
        for column in self._charged_columns.tolist():
            highs.changeColCost(column, 0.0)
        highs.changeRowBounds(self._budget_row, -np.inf, budget / self._cost_unit)
        if central:
            highs.setOptionValue("solver", "ipm")
            highs.setOptionValue("run_crossover", "off")
        try:
            return self._solve_tree(relaxed=True)
        finally:
            if central:
                highs.setOptionValue("solver", "simplex")
                highs.setOptionValue("run_crossover", "on")
                highs.clearSolver()
            highs.changeColBounds(0, 0.0, 0.0)
            highs.changeColCost(0, 0.0)
            for column, price in zip(self._charged_columns.tolist(), self._charges.tolist(), strict=True):
                highs.changeColCost(column, price)
            highs.changeRowBounds(self._budget_row, -np.inf, np.inf)

    def _solve_tree(self, relaxed: bool = False) -> Grown | None:
        """Solve the program with every sampled row; rows are imposed as they are violated."""
        solution = None
        for _ in range(PASSES):
            is_solved, _, x, y = self._program.solve(self.seconds())
            self.work += self._program.work + len(self.signals) * (self.sampled.T.size + self.sampled.N.size)
            if not is_solved:
                return None
            u, multipliers = (
                x[np.array(self._columns)] * self._control_units[:, None],
                np.array([y[at] for at in self._row_numbers]),
            )
            kept = np.flatnonzero(multipliers > 0.0)
            signals, rows, reports = np.array(self._imposed_rows, dtype=int).reshape(-1, 3)[kept].T
            unit = 1.0 if relaxed or not self.priced else self._cost_unit
            value = (
                float(x[0]) if relaxed or not self.priced else unit * float(self._charges @ x[self._charged_columns])
            )
            shares = np.maximum([y[at] for at in self._effort_rows], 0.0)
            solution = Grown(value, x, u, signals, rows, reports, unit * multipliers[kept] / self.units[rows], shares)
            if not self._impose_violated_rows(solution):
                break
        return solution

    def _impose_violated_rows(self, found: Grown) -> bool:
        s, excess, grew = self.sampled, self.excess(found), False
        kinds = s.constraint * (1 + s.side.max(initial=0)) + s.side
        for kind in np.unique(kinds):
            rows = np.flatnonzero(kinds == kind)
            violations = excess[:, rows].reshape(excess.shape[0], -1)
            for signal, flat_indices in enumerate(np.argsort(-violations, axis=1)[:, :AT_ONCE]):
                for flat_index in flat_indices[violations[signal, flat_indices] > EXCEEDED].tolist():
                    row, report = divmod(flat_index, excess.shape[2])
                    grew |= self._impose_row(signal, int(rows[row]), report)
        return grew

    def excess(self, found: Grown) -> Array:
        """Return the excess of every row under every `changed` signal, in units of the row, ``(S, R, reports + 1)``.

        The controls that can know of the change take their best values. Values of rows that hold may be any numbers
        that are not above 0, and ``-inf`` stands where the change comes after the row.
        """
        s, knowledge = self.sampled, self.knowledge
        control_values = np.einsum("rmk,smk->srk", s.T, found.u)
        best = self._least_contributions
        if self._has_peak_variables:
            best = (self._forced_contributions - self._decrease_rates * found.x[self._size_columns]).sum(axis=1)
        later_best = sums(best[:, ::-1])[:, ::-1]  # of every piece and all later ones
        reports, scale = np.arange(knowledge.reports + 1), 1.0 if self.priced else max(found.x[0], np.finfo(float).tiny)
        offsets = sums(control_values)[:, :, knowledge.first] + later_best[:, knowledge.first] - s.b[:, None]
        if self.priced:
            offsets = offsets - found.x[0] * self.units[:, None]
        offsets = np.where(reports <= knowledge.past_reports[:, None], offsets, -np.inf)
        excess = offsets + scale * knowledge.bound_contributions(np.array(self.signals))
        return np.asarray(excess / self.units[:, None])
