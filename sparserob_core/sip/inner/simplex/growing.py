"""A sparse linear program that grows, solved by HiGHS from where it was."""

from __future__ import annotations

from typing import Any, final

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array, vstack

from sparserob_core.errors import PluginError, named
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import HIGHS, gathered
from sparserob_core.sip.inner.simplex.interruptible import run
from sparserob_core.sip.inner.simplex.silence import silent
from sparserob_core.sip.solver import AccountedSolver, QuadraticProgram

HIGHS_ACCURACY = 1e-10  # of rows and reduced costs: the least that HiGHS takes
# Entries of the matrix below it are left out by HiGHS: the least that it takes. With a thousand times as much a policy
# of noisy outputs took 6 s in place of 3 s, as its bounds met more slowly.
SMALLEST_ENTRY = 1e-12
# Residuals of an answer of somebody else, in rows of length 1. Ten times more, and a row that was imposed is violated
# by more than the margins by which rows are tightened (1e-8); ten times less, and it is more than was asked for.
BELIEVED = 1e-9
# An answer that misses more is not asked for with fewer digits: a first-order method needs seconds for each, and does
# not mend what is off by so much. With a hundredth, answers that a second time mends are given up.
HOPELESS_RESIDUAL = 1e-4
# Steps from the last basis for each row and column, after which there is no end to them: a program of 918 columns and
# 1 835 rows went in circles from there, and took 1 188 steps from nothing. With a tenth of it programs that come to an
# end are begun anew; with ten times as many a small one takes half a minute.
STALLED = 10
# Numbers in the rows, from which on a program without a basis is solved by the interior point method of HiGHS, which
# ends at one too. With half of them both take as long; with 480 000, of a policy that answers one noisy output on 40
# pieces, the simplex method took 35 000 steps to the optimum and went in circles from there, where this takes 9 s.
INTERIOR_POINT_NUMBERS = 200_000
# Steps from the last basis for each row and column of such a program, after which it is begun anew: that takes as long
# as so many. With ten times as many one round took more than a minute; with a tenth of them small rounds begin anew.
STEPS_PER_ROW_AND_COLUMN = 0.25
UNSCALED = 0  # the strategy of HiGHS by which its simplex method does not scale
ROBUST = "feedback"  # what these programs are called where a solver fails on some
INNER = 20  # steps of the simplex method that one of an interior point method takes as long as


@final
class GrowingProgram:
    """A sparse linear program that grows, solved by HiGHS from where it was, unless somebody else is ``asked``; ``by``:
    whose the last answer was."""

    def __init__(self, asked: AccountedSolver | None = None) -> None:
        import highspy

        self.asked, self.by = asked, HIGHS
        with silent():
            self.highs: Any = highspy.Highs()
        self.columns = self.count = 0
        self.refused = False
        self._entering_pairs = list[tuple[np.ndarray, np.ndarray]]()
        self.work = 0.0  # of the last solution: entries times steps
        for name, value in {
            "output_flag": False,
            "threads": 1,
            "primal_feasibility_tolerance": HIGHS_ACCURACY,
            "dual_feasibility_tolerance": HIGHS_ACCURACY,
            "small_matrix_value": SMALLEST_ENTRY,
        }.items():
            self.highs.setOptionValue(name, value)

    def variables(self, lower: Array, upper: Array, cost: Array) -> np.ndarray:
        """Add columns with these bounds and costs, and return their numbers."""
        none = np.zeros(0, dtype=np.int32)
        starts = np.zeros(lower.size, dtype=np.int32)
        self.highs.addCols(lower.size, cost, lower, upper, 0, starts, none, np.zeros(0))
        self.columns += lower.size
        return np.arange(self.columns - lower.size, self.columns)

    def rows(self, entries: list[tuple[np.ndarray, np.ndarray, Array]], lower: Array, upper: Array) -> np.ndarray:
        """Add rows, and return their numbers; ``entries`` are rows counted from 0, columns and values."""
        import highspy

        row, column, value = (np.concatenate(arrays) for arrays in zip(*entries, strict=True))
        starts, places, values = gathered(row, column, value, (upper.size, self.columns))
        status = self.highs.addRows(upper.size, lower, upper, values.size, starts[:-1], places, values)
        self.refused |= status == highspy.HighsStatus.kError  # an entry that is too large
        self.count += upper.size
        return np.arange(self.count - upper.size, self.count)

    def enter(self, columns: np.ndarray, rows: np.ndarray) -> None:
        """Begin with ``columns``, which cost nothing, in the basis in place of as many ``rows``, equations that were
        added since: no reduced cost changes, and no step is needed for each of them."""
        self._entering_pairs.append((columns, rows))

    def _extend_basis(self) -> None:
        """Put what is to enter into the last basis."""
        import highspy

        if not self._entering_pairs:
            return
        columns, rows = (np.concatenate(arrays).tolist() for arrays in zip(*self._entering_pairs, strict=True))
        self._entering_pairs, status = [], highspy.HighsBasisStatus
        basis = self.highs.getBasis()
        if not basis.valid:  # the first solution: presolve takes out these equations, and begins in a better place
            return
        within, without = basis.col_status, basis.row_status
        for column, row in zip(columns, rows, strict=True):
            if without[row] == status.kBasic and within[column] != status.kBasic:
                within[column], without[row] = status.kBasic, status.kLower
        basis.col_status, basis.row_status = within, without
        self.highs.setBasis(basis)

    def limit(self, rows: np.ndarray, upper: Array) -> None:
        """Set new upper limits of rows that have no lower limit."""
        for row, value in zip(rows.tolist(), upper.tolist(), strict=True):
            self.highs.changeRowBounds(row, -np.inf, value)

    def solve(self, seconds: float = np.inf) -> tuple[bool, str, Array, Array]:
        """Solve the program within ``seconds``.

        Returns whether it was solved, the solver's words, the values of the columns and the multipliers of the rows. It
        is not solved where the time does not suffice.
        """
        import highspy

        if self.refused:
            return False, "HiGHS: a row is refused", np.zeros(0), np.zeros(0)
        reason, self.by = "", HIGHS
        if self.asked is not None:
            answer = self._ask_solver(self.asked)
            if not isinstance(answer, str):
                self.by = self.asked.name
                return answer
            reason = answer
        self._extend_basis()
        self.highs.setOptionValue("time_limit", self.highs.getRunTime() + max(seconds, 0.0))  # none of an earlier call
        has_basis, large = bool(self.highs.getBasis().valid), self.highs.getNumNz() >= INTERIOR_POINT_NUMBERS
        steps = self._run_until_decided(has_basis, large)
        status, statuses = self.highs.getModelStatus(), highspy.HighsModelStatus
        self.work = float(steps) * self.highs.getNumNz()
        message = f"HiGHS: {self.highs.modelStatusToString(status)}"
        if self.asked is not None and status in (statuses.kOptimal, statuses.kInfeasible):
            self.asked.failures.add(ROBUST, reason, HIGHS)
        if status != statuses.kOptimal:
            return False, message, np.zeros(0), np.zeros(0)
        solution = self.highs.getSolution()
        if not (has_basis or large):
            solution = self._correct_solution(solution)
        return True, message, np.array(solution.col_value), -np.array(solution.row_dual)

    def _run_until_decided(self, has_basis: bool, large: bool) -> int:
        """Solve it from the last basis, and return the steps that this took.

        Where this leads nowhere, it is solved from nothing: by the other method, and then as it was posed, without
        scaling and presolve.
        """
        import highspy

        patience = STEPS_PER_ROW_AND_COLUMN if has_basis and large else STALLED
        self.highs.setOptionValue("simplex_iteration_limit", int(patience * (self.columns + self.count)))
        steps = self._run_highs(inside=large and not has_basis)
        if self._is_decided():
            return steps
        self.highs.setOptionValue("simplex_iteration_limit", highspy.kHighsIInf)
        self.highs.clearSolver()
        steps += self._run_highs(inside=large == has_basis)
        if self._is_decided():
            return steps
        self.highs.clearSolver()
        self.highs.setOptionValue("simplex_scale_strategy", UNSCALED)
        self.highs.setOptionValue("presolve", "off")
        steps += self._run_highs(inside=False)
        self.highs.setOptionValue("presolve", "choose")
        return steps

    def _is_decided(self) -> bool:
        """Return whether the last attempt came to an end."""
        import highspy

        status = highspy.HighsModelStatus
        lost = (status.kNotset, status.kUnknown, status.kIterationLimit, status.kSolveError)
        return self.highs.getModelStatus() not in lost

    def _correct_solution(self, solution: Any) -> Any:
        """Return the solution, or that without scaling where it is one of another matrix.

        HiGHS scales rows and columns. Where entries of a row differ by many digits, its simplex method may end with
        values of rows and reduced costs that are not those of the matrix, off by 1e-3 of the numbers.
        """
        import highspy

        error = self._measure_error(solution)
        if error <= BELIEVED:
            return solution
        self.highs.clearSolver()
        self.highs.setOptionValue("simplex_scale_strategy", UNSCALED)
        self.work += float(self._run_highs(inside=False)) * self.highs.getNumNz()
        if self.highs.getModelStatus() != highspy.HighsModelStatus.kOptimal:
            return solution
        return min(solution, self.highs.getSolution(), key=self._measure_error)

    def _measure_error(self, solution: Any) -> float:
        """Return by how much values of rows differ from those of the matrix, or reduced costs in units of the largest
        cost."""
        program = self.highs.getLp()
        matrix, cost = _read_matrix(program), np.array(program.col_cost_)
        values = matrix @ np.array(solution.col_value) - np.array(solution.row_value)
        costs = cost - matrix.T @ np.array(solution.row_dual) - np.array(solution.col_dual)
        relative = np.abs(costs).max(initial=0.0) / np.abs(cost).max(initial=1.0)
        return max(float(np.abs(values).max(initial=0.0)), float(relative))

    def _ask_solver(self, asked: AccountedSolver) -> tuple[bool, str, Array, Array] | str:
        """Return the answer of who is asked, from nothing, where it holds; in words why it does not."""
        program = self.highs.getLp()
        low, high = np.array(program.row_lower_), np.array(program.row_upper_)
        table = _read_matrix(program).tocsr()
        norms = np.sqrt(np.asarray(table.multiply(table).sum(axis=1)).reshape(-1))
        norms[norms == 0.0] = 1.0
        table = diags_array(1.0 / norms) @ table
        cost = np.array(program.col_cost_)
        kappa = float(np.abs(cost).max(initial=0.0)) or 1.0
        equal = low == high
        above, below = np.flatnonzero(np.isfinite(high) & ~equal), np.flatnonzero(np.isfinite(low) & ~equal)
        fixed = np.flatnonzero(equal)
        posed = QuadraticProgram(
            csc_array((self.columns, self.columns)),
            cost / kappa,
            csc_array(vstack([table[above], -table[below]])),
            np.concatenate([(high / norms)[above], -(low / norms)[below]]),
            csc_array(table[fixed]),
            (high / norms)[fixed],
            np.array(program.col_lower_),
            np.array(program.col_upper_),
        )
        message = ""
        for accuracy in (HIGHS_ACCURACY, BELIEVED):  # the last digit that is asked for may cost the others
            try:
                claim = asked.solve(posed, accuracy)
            except Exception as error:  # noqa: BLE001  a foreign solver may raise anything; its failure must not be ours
                return str(error) if isinstance(error, PluginError) else f"the solver raised {named(error)}"
            if claim.met(posed, BELIEVED):
                break
            if not claim.met(posed, HOPELESS_RESIDUAL):
                return claim.message
            note = "; its rows, bounds, slopes or gap are missed by more than 1e-9"
            message = message or f"{claim.message}{note if claim.status == 'solved' else ''}"
        else:
            return message
        multipliers = np.zeros(self.count)
        multipliers[above] += claim.z[: above.size]
        multipliers[below] -= claim.z[above.size :]
        multipliers[fixed] = claim.y
        return True, claim.message, np.clip(claim.x, posed.lower, posed.upper), kappa * multipliers / norms

    def _run_highs(self, inside: bool) -> int:
        """Solve it, by an interior point method where it is to be sought from ``inside``; the steps that this took."""
        if inside:
            self.highs.setOptionValue("solver", "ipm")
        try:
            run(self.highs)
        finally:
            if inside:
                self.highs.setOptionValue("solver", "choose")
        info = self.highs.getInfo()
        return int(1 + max(0, info.simplex_iteration_count) + INNER * max(0, info.ipm_iteration_count))


def _read_matrix(program: Any) -> csc_array | csr_array:
    """Return the matrix of a program of HiGHS."""
    import highspy

    matrix = program.a_matrix_
    kind = csc_array if matrix.format_ == highspy.MatrixFormat.kColwise else csr_array
    return kind((matrix.value_, matrix.index_, matrix.start_), shape=(program.num_row_, program.num_col_))
