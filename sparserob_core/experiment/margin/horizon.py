"""The shortest feasible horizon: horizons are scanned and covered, since feasibility is not monotone in the horizon."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import final

import numpy as np

from sparserob_core.control.constraints.explanation import in_numbers
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.studies.horizons import Horizons, Multiplier, shorten_horizon, stretch_dictionary
from sparserob_core.control.transcription.own_units import fixed
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.errors import InputError
from sparserob_core.experiment.margin.points import MarginPoint, Points
from sparserob_core.experiment.margin.search import FEASIBLE, Answer, Margin
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.method import Tools
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.methods.own_units import solve_in_own_units
from sparserob_core.sip.result import Result

HORIZON = "horizon"
SCAN = 16  # number of equal parts into which the search first divides all horizons, where no curve asks for more
MAX_RUNS = 400  # largest number of runs of the search, without those of the curve
MET = 4.0  # largest distance of the two ends of a finished search, in widths


@final
@dataclass(eq=False)
class HorizonSearch:
    """The search over the horizons up to that of the ``problem``.

    Its dictionaries keep the number of their pieces. ``width`` is the distance of the two ends that is asked for, in
    the unit of time.
    """

    title: str
    problem: OptimalControlProblem
    control: Dictionary
    disturbance: Dictionary
    method: Exchange
    tools: Tools
    width: float
    progress: Points
    points: dict[float, MarginPoint] = field(default_factory=dict)
    covered: list[tuple[float, float]] = field(default_factory=list)
    _farkas_multipliers: dict[float, list[Multiplier]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._problem_without_steps = replace(self.problem, control_step=None)
        self._horizons = Horizons(self._problem_without_steps, self.control, self.disturbance)

    def margin(self, count: int) -> Margin:
        """Return the shortest feasible horizon, between those that are excluded and one that is proven.

        The margin has a curve of ``count`` runs.
        """
        started, best, reason = time.perf_counter(), None, ""
        longest = self.problem.horizon
        scan = longest * np.arange(1, max(count, SCAN) + 1) / max(count, SCAN)
        try:
            with self.tools.deadline.enforced():
                reason = self._cover_horizons(scan.tolist())
                if count:
                    for horizon in scan:
                        self._run_horizon(float(horizon))
        except KeyboardInterrupt as interrupt:
            reason = str(interrupt) or "interrupted from the keyboard"
        proven = [point for point in self.points.values() if point.status in FEASIBLE]
        best = min(proven, key=lambda point: point.factor, default=None)
        low = self.covered[-1][1] if self.covered else 0.0
        status, message = self._conclude(best, low, reason)
        upper = best.factor if best is not None else np.nan
        curve = tuple(self.points[key] for key in sorted(self.points) if key in scan or self.points[key] is best)
        kept = f"{self.control.pieces} pieces at every horizon; windows begin at the times that the config says"
        return Margin(
            title=self.title,
            of=HORIZON,
            sense="smallest",
            quantity=f"horizon [{self.problem.names.time}]" if self.problem.names.time else "horizon",
            status=status,
            message=message,
            lower=low,
            upper=upper,
            amounts=(low, upper),
            feasible=best,
            infeasible=self.points.get(low),
            curve=curve if count else (),
            remarks=(f"kept fixed: {kept}",),
            seconds=time.perf_counter() - started,
            covered=tuple(self.covered),
            cost_unit=self.problem.cost_unit,
        )

    def _conclude(self, best: MarginPoint | None, low: float, stuck: str) -> tuple[Answer, str]:
        longest = self.problem.horizon
        cells = f"{len(self.covered)} cell{'s' if len(self.covered) != 1 else ''}"
        if best is None and low >= longest:
            return (
                "infeasible",
                (
                    f"no horizon up to {self._format_time(longest)} is feasible, proven on {cells}:"
                    f" {self._explain_infeasibility(longest)}"
                ),
            )
        if best is None:
            return "undecided", f"no horizon up to {self._format_time(longest)} was found feasible; {stuck}"
        if low == 0.0 and best.factor <= MET * self.width:
            return (
                "unbounded",
                f"feasible at every horizon that was looked at on the way down to {self._format_time(best.factor)}",
            )
        if best.factor - low <= MET * self.width:
            return (
                "certified",
                (
                    f"no horizon up to {self._format_time(low)} is feasible, proven on {cells}:"
                    f" {self._explain_infeasibility(low)}"
                ),
            )
        return (
            "undecided",
            f"what is between {low:.9g} and {self._format_time(best.factor)} could not be proven: {stuck}",
        )

    def _format_time(self, time: float) -> str:
        """Return a time with its unit."""
        return f"{time:.9g} {self.problem.names.time}".rstrip()

    def _explain_infeasibility(self, horizon: float) -> str:
        point = self.points.get(horizon)
        return point.message if point is not None else "the constraints clash"

    def _cover_horizons(self, scan: list[float]) -> str:
        """Cover horizons from 0 on by cells in which nothing is feasible, until one is feasible.

        Returns the reason where that did not succeed, else an empty text.
        """
        starts = [entry.start for entry in self.problem.windows]
        starts.append(self._horizons.changes)
        # a window that begins after 0 divides a cell, since its rows exist for longer horizons only
        points = sorted({0.0, *scan, *(start for start in starts if 0.0 < start < self.problem.horizon)})
        cells, best = list(pairwise(points))[::-1], np.inf
        while cells:
            low, high = cells.pop()
            if low >= best:
                break
            high = min(high, best)
            status = self._run_horizon(high).status
            if status in FEASIBLE:
                best = min(best, high)
            elif status == "infeasible" and self._is_excluded(low, high):
                self.covered.append((low, high))
                self.progress.say(f"no horizon up to {self._format_time(high)} is feasible")
                continue
            short = high - low <= self.width
            if short and status in FEASIBLE:
                break
            reason = self._explain_stop(low, high, short)
            if reason:
                self._bisect_points(
                    low, [point for point in (*points, best) if low < point <= best and np.isfinite(point)]
                )
                return reason
            cells += [((low + high) / 2, high), (low, (low + high) / 2)]
        return ""

    def _explain_stop(self, low: float, high: float, short: bool) -> str:
        """Return the reason why an interval that was not excluded is not halved again; empty where it is."""
        point = self.points[high]
        if point.status not in (*FEASIBLE, "infeasible"):
            return f"the run at {self._format_time(high)} is {point.status}: {point.message}"
        if point.status == "infeasible" and high > self._horizons.changes:
            at = self._format_time(self._horizons.changes)
            return f"the system changes at {at}, and beyond horizons are looked at one by one only"
        if short:
            note = "" if self.problem.control_step is None else "; control_step is left out of what excludes horizons"
            return f"no multipliers exclude {low:.9g} to {self._format_time(high)}{note}"
        return f"{MAX_RUNS} runs did not suffice" if len(self.points) > MAX_RUNS else ""

    def _bisect_points(self, low: float, points: list[float]) -> None:
        """Find the first feasible one of ``points`` beyond ``low``, and by bisection the shortest feasible horizon
        before it.

        It is used where horizons cannot be covered any further.
        """
        before = low
        for point in points:
            if self._run_horizon(point).status in FEASIBLE:
                while point - before > self.width:
                    middle = (before + point) / 2
                    before, point = (
                        (before, middle) if self._run_horizon(middle).status in FEASIBLE else (middle, point)
                    )
                return
            before = point

    def _is_excluded(self, low: float, high: float) -> bool:
        """Return whether multipliers of a run at one of the two ends prove that nothing is feasible between them."""
        multipliers = [self._find_multipliers(end) for end in (high, low)]
        return any(self._horizons.amount(rows, low, high) > 0.0 for rows in multipliers if rows)

    def _run_horizon(self, horizon: float) -> MarginPoint:
        """Return the run at a horizon, which is made only once."""
        if horizon not in self.points:
            model, result = self._solve_horizon(self.problem, horizon, self.progress.begin(horizon))
            self.points[horizon] = MarginPoint(
                horizon, horizon, result.status, result.message, result.lower_bound, result.upper_bound
            )
            self.progress.end(self.points[horizon])
            if result.status == "infeasible" and self.problem.control_step is None:
                self._farkas_multipliers[horizon] = _extract_multipliers(model, result)
            if result.stopped:
                self.tools.deadline.check()
        return self.points[horizon]

    def _find_multipliers(self, horizon: float) -> list[Multiplier]:
        """Return the multipliers that prove a horizon infeasible, without limits on steps, which no proof on cells
        covers."""
        if horizon not in self._farkas_multipliers and horizon > 0.0:
            model, result = self._solve_horizon(self._problem_without_steps, horizon)
            self._farkas_multipliers[horizon] = (
                _extract_multipliers(model, result) if result.status == "infeasible" else []
            )
        return self._farkas_multipliers.get(horizon, [])

    def _solve_horizon(
        self, problem: OptimalControlProblem, horizon: float, notify: Notify = ignore
    ) -> tuple[Transcription, Result]:
        from sparserob_core.control.transcription.transcribe import prepare

        control, disturbance = (
            stretch_dictionary(dictionary, horizon) for dictionary in (self.control, self.disturbance)
        )
        model = prepare(shorten_horizon(problem, horizon), control, disturbance)
        return model, solve_in_own_units(self.method, model.program, replace(self.tools, notify=notify))


def horizon_search(
    title: str,
    problem: OptimalControlProblem,
    dictionaries: tuple[Dictionary, Dictionary],
    method: Exchange,
    tools: Tools,
    tolerance: float,
    notify: Notify,
) -> HorizonSearch:
    """Return the search for a margin of the horizon.

    Parameters
    ----------
    title : str
        The title of the experiment.
    problem : OptimalControlProblem
        The problem, with the longest horizon.
    dictionaries : tuple of two Dictionary
        The dictionaries of control and disturbance.
    method : Exchange
        The method of the runs.
    tools : Tools
        The solver and the deadline.
    tolerance : float
        The distance of the two ends that is asked for, relative to the longest horizon.
    notify : callable
        A function that receives the events of the search.

    Returns
    -------
    HorizonSearch
        The search.

    Raises
    ------
    InputError
        If the plan repeats or has integral constraints, or if nothing could be proven of the problem.
    """
    width = tolerance * problem.horizon
    if problem.repeat:
        raise InputError(
            "of: horizon is the period of a plan that repeats, of which none excludes another; expected another thing"
            " to vary"
        )
    if problem.sums:
        raise InputError(
            path=next(iter(problem.sums)),
            expected="none where the horizon is varied, since windows of integrals stay where they are",
            got=f"{sum(map(len, problem.sums.values()))}",
        )
    try:
        return HorizonSearch(title, problem, *dictionaries, method, tools, width, Points(HORIZON, notify))
    except InputError as error:
        raise error if not error.path else error.under("of", HORIZON) from None


def _extract_multipliers(model: Transcription, result: Result) -> list[Multiplier]:
    """Return the multipliers that prove a horizon infeasible, row by row.

    Rows of a curved set of controls are left out, since the proof takes the least value over that set.
    """
    problem, multipliers = model.problem, []
    # terminal sets come after those of the path
    starts = {entry.name: entry.start for entry in model.constraints[: len(problem.path)]}
    shares = model.control.breakpoints / model.control.horizon
    middle = model.parameters.middle
    for cut in result.dual.cuts:
        constraint = model.constraint(model.program.family(cut.family))
        if constraint is None:
            continue
        explanation = in_numbers(model.program, cut.family, cut.formulation, cut.index, cut.row)
        if explanation is not None and cut.multiplier > 0.0:
            offset = float(constraint.reference.along(np.array([explanation.time]), explanation.direction[None])[0, 0])
            interval = (
                (0.0, 1.0)
                if explanation.piece is None
                else (float(shares[explanation.piece]), float(shares[explanation.piece + 1]))
            )
            multipliers.append(
                Multiplier(
                    weight=float(cut.multiplier),
                    share=min(1.0, explanation.time / problem.horizon),
                    direction=explanation.direction,
                    parameter=np.asarray(explanation.parameter_or(middle), dtype=float),
                    limit=explanation.sign * explanation.limit - offset,
                    earliest=starts.get(cut.family, 0.0),
                    reference=constraint.reference,
                    gain=explanation.gain,
                    piece=interval,
                )
            )
    for axis, value, price in zip(*fixed(problem), result.dual.mu, strict=False):
        multipliers.append(Multiplier(float(price), 1.0, axis, middle, float(value), uncertain=False))
    return multipliers
