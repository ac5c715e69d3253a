"""The proof of a critical factor from both sides, each by an ordinary run, and the cost on the feasible side."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias, final

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.control.loop.resolving import shift_cuts
from sparserob_core.control.studies.causal import Ended
from sparserob_core.errors import InputError
from sparserob_core.experiment.directory.artefacts import UNWRITTEN, finite
from sparserob_core.experiment.margin.critical import Critical, critical_factor
from sparserob_core.experiment.margin.points import MarginPoint, Points
from sparserob_core.experiment.margin.scaling import Scaling, Sense
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.method import Tools
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.methods.own_units import answered_in_own_units
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.relaxed.parametric import ParametricProgram
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram, rows_of
from sparserob_core.sip.result import Result, Status
from sparserob_core.sip.working.ledger import prover_of

Answer: TypeAlias = Literal["certified", "unbounded", "infeasible", "undecided"]
FEASIBLE: tuple[Status, ...] = ("certified", "verified")
# Distances from the critical factor, in widths, at which runs are tried until an answer is proven.
STEPS = (
    0.25,
    1.0,
    4.0,
    16.0,
    64.0,
)
# Distances that are tried only where the active constraints alone exclude the factor. Terminal sets that are small in
# relation to the motion of the state are not resolved more finely.
FARTHER = (*STEPS, 256.0, 1024.0, 4096.0)


Sides: TypeAlias = tuple[Answer, str, MarginPoint | None, MarginPoint | None]
"""An answer, its message, and the runs that prove the feasible and the infeasible side."""


@final
@dataclass(frozen=True)
class Margin:
    """The critical factor of a problem, which lies in ``[lower, upper]``, with the runs that prove it.

    Parameters
    ----------
    title : str
        The title of the experiment.
    of : str
        The part of the problem that is scaled.
    sense : {"largest", "smallest"}
        The feasible factor that is searched. ``largest`` (``disturbance``, ``parameters``, ``initial_state``,
        ``execution``): a control is proven feasible at ``lower``, and a checked Farkas certificate excludes any at
        ``upper``. ``smallest`` (sets that are enlarged, starts of windows): the other way round.
    quantity : str
        The quantity that a factor changes, with its unit.
    status : {"certified", "unbounded", "infeasible", "undecided"}
        ``certified``: both sides are proven. ``unbounded``: feasible as far as the search went, up to the factor
        ``lower``, or down to 0 for the smallest. ``infeasible``: at every factor. ``undecided``: a side could not be
        proven.
    message : str
        The explanation of the status.
    lower, upper : float
        The bounds of the factor.
    amounts : tuple of float
        The quantity at ``lower`` and at ``upper``, in the units of the problem.
    feasible, infeasible : Point or None
        The two runs that prove the bounds.
    curve : tuple of Point
        Runs on the feasible side, by factor.
    remarks : tuple of str
        Warnings.
    seconds : float
        The seconds that the search has taken.
    directory : Path or None
        The directory that was written, if there is one.
    covered : tuple
        Of the horizon: the cells that fill ``(0, lower]``.
    causal_upper : float
        Under a policy, of the disturbance: no causal policy exists at this factor and above.
    causal_ended : str or None
        The reason why no smaller such factor was searched (as in ``result.json``); ``None`` where there was no search.
    cost_unit : str
        The unit of the cost and its bounds, where the problem names one.

    Notes
    -----
    Feasibility is not monotone in the ``horizon``. Nothing is feasible at any horizon in ``(0, lower]``: one set of
    multipliers, with the horizon as a parameter, proves it on each of the cells ``covered``. At ``upper`` a control is
    proven, at the shortest horizon for which one was found. ``infeasible`` then means that no horizon up to the
    config's is feasible. ``curve`` has runs at equally spaced horizons, feasible or not.
    """

    title: str
    of: str
    sense: Sense
    quantity: str
    status: Answer
    message: str
    lower: float
    upper: float
    amounts: tuple[float, float]
    feasible: MarginPoint | None = None
    infeasible: MarginPoint | None = None
    curve: tuple[MarginPoint, ...] = ()
    remarks: tuple[str, ...] = ()
    seconds: float = 0.0
    directory: Path | None = field(default=None, metadata=UNWRITTEN)
    covered: tuple[tuple[float, float], ...] = ()
    causal_upper: float = np.nan
    causal_ended: Ended | None = None
    cost_unit: str = ""

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``margin.json``: every field but the directory."""
        return dict(finite(self))

    __repr__ = brief


@final
@dataclass(eq=False)
class MarginSearch:
    """The search of one margin.

    Parameters
    ----------
    title : str
        The title of the experiment.
    programs : ParametricProgram
        The programs of ordinary runs, by their factor.
    joined : ParametricProgram or None
        The programs in units that do not depend on the factor, where it enters linearly.
    scaling : Scaling
        The problem as a function of the factor.
    method : Exchange
        The method of the runs.
    tools : Tools
        The solver and the deadline.
    width : float
        The distance of the two sides that is asked for, relative to the factor where this is above 1.
    progress : Points
        The reports of the runs.
    points, unproven_answers, results : list, dict, dict
        The runs, the factors that were tried without proof, and the results by their factor.
    cuts : sequence of Cut
        The constraints that are active at the critical factor, in the user's units.
    beyond : callable, optional
        A function of the ``results``. It returns the factor from which no causal policy exists, and the reason why no
        smaller one was searched.
    """

    title: str
    programs: ParametricProgram
    joined: ParametricProgram | None
    scaling: Scaling
    method: Exchange
    tools: Tools
    width: float
    progress: Points
    points: list[MarginPoint] = field(default_factory=list)
    unproven_answers: dict[float, str] = field(default_factory=dict)
    results: dict[float, Result] = field(default_factory=dict)
    cuts: Sequence[Cut] = ()
    beyond: Callable[[dict[float, Result]], tuple[float, Ended | None]] | None = None

    def margin(self, count: int) -> Margin:
        """Return the margin, with a curve of ``count`` points."""
        started, curve = time.perf_counter(), tuple[MarginPoint, ...]()
        sides: Sides | None = None
        try:
            self.progress.say(f"looking for the {self.scaling.sense} factor of {self.scaling.of}")
            with self.tools.deadline.enforced():
                critical = self._find_critical()
                self.cuts = critical.cuts
                sides = self._prove_sides(critical)
                feasible = sides[2]
                curve = self._trace_curve(feasible, sides[0], count) if feasible is not None else ()
        except KeyboardInterrupt as interrupt:
            reason = str(interrupt) or "interrupted from the keyboard"
            sides, points = self._collect_known(reason, sides)
            curve = points if count else ()
        causal, ended = np.nan, None
        if self.beyond is not None:
            try:
                with self.tools.deadline.enforced():
                    causal, ended = self.beyond(self.results)
            except KeyboardInterrupt as interrupt:
                self.tools.deadline.interrupt(interrupt)
        status, message, feasible, infeasible = sides
        inner, outer = feasible.factor if feasible else np.nan, infeasible.factor if infeasible else np.nan
        if status == "unbounded":
            outer = np.inf if self.scaling.sense == "largest" else 0.0
        lower, upper = (inner, outer) if self.scaling.sense == "largest" else (outer, inner)
        amounts = tuple(self.scaling.amount(f) if np.isfinite(f) else f for f in (lower, upper))
        return Margin(
            title=self.title,
            of=self.scaling.of,
            sense=self.scaling.sense,
            quantity=self.scaling.quantity,
            status=status,
            message=message,
            lower=lower,
            upper=upper,
            amounts=(amounts[0], amounts[1]),
            feasible=feasible,
            infeasible=infeasible,
            curve=curve,
            causal_upper=causal,
            causal_ended=ended,
            cost_unit=self.scaling.cost_unit,
            seconds=time.perf_counter() - started,
        )

    def _find_critical(self) -> Critical:
        """Return the critical factor.

        For a largest factor the factor 0 is run first, so that a search that ends early knows whether anything is
        feasible.
        """
        if self.scaling.sense == "largest" and self.scaling.nested and self.run(0.0).status == "infeasible":
            return Critical("never")
        arguments = self.programs, self.joined, self.scaling, self.tools, self.width
        return critical_factor(*arguments, self.progress.notify, self.unproven_answers)

    def _collect_known(self, said: str, sides: Sides | None) -> tuple[Sides, tuple[MarginPoint, ...]]:
        """Return the sides that an interrupted search knows, and every proven run on the feasible side as a curve.

        They are both sides where these were proven before. Otherwise they are the nearest two runs of which each proves
        one side.
        """
        proven = sorted((point for point in self.points if point.status in FEASIBLE), key=lambda point: point.factor)
        if sides is not None:
            return (sides[0], f"{sides[1]}; no more of the curve: {said}", *sides[2:]), tuple(proven)
        refused = sorted(
            (point for point in self.points if point.status == "infeasible"), key=lambda point: point.factor
        )
        last, first = (-1, 0) if self.scaling.sense == "largest" else (0, -1)
        feasible, infeasible = proven[last] if proven else None, refused[first] if refused else None
        attempts = [f"{answer} at {factor:.4g}" for factor, answer in sorted(self.unproven_answers.items())]
        hint = f"; not proven: it seems {', '.join(attempts)}" if attempts else ""
        note = "" if proven or refused else ", of which none proves anything" if self.points else ": nothing is proven"
        return ("undecided", f"{said} after {len(self.points)} runs{note}{hint}", feasible, infeasible), tuple(proven)

    def _prove_sides(self, found: Critical) -> Sides:
        largest = self.scaling.sense == "largest"
        if found.status == "unknown":
            return "undecided", f"no critical factor was found: {found.message}", None, None
        if found.status == "never":
            return self._prove_infeasible(found)
        if found.status == "always":
            feasible = self.run(found.good)
            words = (
                f"feasible at the factor {found.good:g} and at every smaller one"
                if largest
                else "feasible at the smallest there is"
            )
            proven = feasible.status in FEASIBLE
            return ("unbounded" if proven else "undecided"), words if proven else feasible.message, feasible, None
        outward = 1.0 if largest else -1.0
        good, bad = (
            self._find_proven_run(found.good, -outward, FEASIBLE),
            self._find_proven_run(found.bad, outward, ("infeasible",)),
        )
        if good is None or bad is None:
            return (
                "undecided",
                f"the critical factor seems to be {found.good:.9g}, but one side of it could not be proven",
                good,
                bad,
            )
        return "certified", f"beyond it: {bad.message}", good, bad

    def _prove_infeasible(self, found: Critical) -> Sides:
        """Return the sides where nothing is feasible; the run at the most favourable factor says why."""
        best_factor = (
            {"largest": 0.0, "smallest": self.scaling.highest}[self.scaling.sense] if self.scaling.nested else 1.0
        )
        point = self.run(best_factor)
        if point.status != "infeasible":
            words = (
                f"nothing seems to be feasible, but the run at the factor {best_factor:g} is {point.status}:"
                f" {point.message}"
            )
            return "undecided", words, None, None
        at = f"even at {best_factor:g} " if self.scaling.nested else ""
        return "infeasible", f"{at}nothing is feasible: {point.message}", None, point

    def _find_proven_run(self, factor: float, outward: float, wanted: tuple[Status, ...]) -> MarginPoint | None:
        """Return the run nearest to the critical factor whose status is one of those ``wanted`` on that side."""
        width = self.width * (max(1.0, abs(factor)) if self.scaling.affine else 1.0)
        candidates = [float(np.clip(factor + outward * step * width, 0.0, self.scaling.highest)) for step in FARTHER]
        first = None
        if "infeasible" in wanted:  # without this test, a run too close to the critical factor would take very long
            first = next((i for i, candidate in enumerate(candidates) if self._is_excluded(candidate)), None)
        initial_cuts = () if first is None else self.cuts
        for candidate in candidates[: len(STEPS)] if first is None else candidates[first:]:
            point = self.run(candidate, initial_cuts)
            if point.status in wanted:
                return point
        return None

    def _is_excluded(self, factor: float) -> bool:
        """Return whether the active constraints at the critical factor alone are infeasible at another factor."""
        if not self.cuts:
            return False
        program = self.programs.program(factor)
        program = program if program.own_units is None else program.own_units.program
        rows = rows_of(program, shift_cuts(self.cuts, 0.0, program))
        relaxed = RelaxedProgram(program, self.tools.solver, deadline=self.tools.deadline)
        return relaxed.solve(rows, 0.0).status == "infeasible"

    def _solve_from_cuts(self, initial_cuts: Sequence[Cut], program: SemiInfiniteProgram, tools: Tools) -> Result:
        """Return the result of a program in its own units, whose run begins with the constraints ``initial_cuts``."""
        return self.method.close(program, tools, prover_of(program, tools), shift_cuts(initial_cuts, 0.0, program))

    def run(self, factor: float, initial_cuts: Sequence[Cut] = ()) -> MarginPoint:
        """Run the problem at a factor, unless that was done before.

        Parameters
        ----------
        factor : float
            The factor.
        initial_cuts : sequence of Cut, default ()
            Constraints with which the run begins.

        Returns
        -------
        Point
            The answer; ``failed`` where the problem is not defined at the factor.
        """
        for point in self.points:
            if point.factor == factor:
                return point
        amount, tools = self.scaling.amount(factor), replace(self.tools, notify=self.progress.begin(factor))
        try:
            result = answered_in_own_units(
                partial(self._solve_from_cuts, initial_cuts), self.programs.program(factor), tools
            )
        except InputError as error:
            point = MarginPoint(factor, amount, "failed", str(error), -np.inf, np.inf)
            self.progress.end(point)
            return point
        self.results[factor] = result
        point = MarginPoint(factor, amount, result.status, result.message, result.lower_bound, result.upper_bound)
        self.points.append(point)
        self.progress.end(point)
        if result.stopped:
            self.tools.deadline.check()
        return point

    def _trace_curve(self, feasible: MarginPoint, status: Answer, count: int) -> tuple[MarginPoint, ...]:
        """Return runs from the feasible side of the critical factor to no uncertainty, or to a set twice as large."""
        if count == 0:
            return ()
        if self.scaling.sense == "largest":
            ends = (0.0, 2.0 if status == "unbounded" else feasible.factor)
        elif self.scaling.affine:
            ends = (feasible.factor, max(1.0, 2.0 * feasible.factor))
        else:
            ends = (feasible.factor, self.scaling.highest)
        factors = np.linspace(*ends, count)
        return tuple(feasible if factor == feasible.factor else self.run(float(factor)) for factor in factors)
