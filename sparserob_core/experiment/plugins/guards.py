"""Checks around foreign components: an error that they raise, or an answer of the wrong type, becomes one that names
them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Generic, TypeVar, final

import numpy as np

from sparserob_core.control.policies.policy import Charge, Policy, Quantity
from sparserob_core.control.problem.dictionary import Dictionary, DictionaryFactory
from sparserob_core.control.problem.problem import OptimalControlProblem, ProblemFactory
from sparserob_core.errors import InputError, PluginError
from sparserob_core.experiment.plugins import files
from sparserob_core.experiment.plugins.attribution import asked, attributed, short_repr
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.convexity import ControlImage, Regulariser, require_convex
from sparserob_core.sip.maximiser import Maximiser, Objective
from sparserob_core.sip.method import ExecutorFactory, Method, Tools
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.result import MEANING, Result, Status
from sparserob_core.sip.rules import InnerStop, OuterStop, Schedule, Selection
from sparserob_core.sip.solver import Claim, QuadraticProgram, Solver

if TYPE_CHECKING:
    from scipy.sparse import csc_array

Component = TypeVar("Component")
FILES = f"{files.__name__}."
CLAIMS: tuple[Status, ...] = ("certified", "verified", "infeasible")
TRUTH = (bool, np.bool_)
NUMBER = (int, float, np.integer, np.floating)


def guarded(component: Component, origin: str) -> Component:
    """Return a component wrapped in the check of its kind; messages call it ``origin``.

    A component is returned as it is where its kind has no check, and where it belongs to the core, whose faults are
    internal errors.
    """
    module = type(component).__module__
    own = module.startswith("sparserob_core.") and not module.startswith(FILES)
    guard = next((guard for kind, guard in GUARDS.items() if isinstance(component, kind)), None)
    return component if own or guard is None else guard(component, origin)


def unguarded(component: object) -> object:
    """Return the component within its check.

    A policy is part of the problem that was solved, and its own class and options are needed.
    """
    return component.behind if isinstance(component, _Policy) else component


def origin_of(kind: str, component: object) -> str:
    """Return the name in messages of a component that was given as an object."""
    return f"{kind} {type(component).__name__} ({type(component).__module__})"


class _Guard(Generic[Component]):
    """A component that is ``behind`` its check; messages call it ``origin``."""

    def __init__(self, behind: Component, origin: str) -> None:
        self.behind, self.origin = behind, origin


@final
class _Problem(_Guard[ProblemFactory], ProblemFactory):
    def build(self) -> OptimalControlProblem | SemiInfiniteProgram:
        with attributed(self.origin, "build"):
            built: object = self.behind.build()
        if not isinstance(built, OptimalControlProblem | SemiInfiniteProgram):
            raise PluginError(
                f"{self.origin}: build returned {short_repr(built)}, expected an OptimalControlProblem or a "
                "SemiInfiniteProgram"
            )
        return built


@final
class _Dictionary(_Guard[DictionaryFactory], DictionaryFactory):
    def build(self, horizon: float) -> Dictionary:
        built = asked(self.origin, "build", lambda: self.behind.build(horizon), Dictionary)
        first, last = float(built.breakpoints[0]), float(built.breakpoints[-1])
        if first != 0.0 or abs(last - horizon) > 1e-9 * horizon:
            raise PluginError(
                f"{self.origin}: build returned a dictionary on [{first!r}, {last!r}], expected [0, {horizon!r}]"
            )
        return built


@final
class _Policy(_Guard[Policy], Policy):
    """A checked policy; `sparserob_core.control.policies.policy.answers_of` checks its answers."""

    @property
    def knows(self) -> frozenset[Quantity]:
        return asked(self.origin, "knows", lambda: self.behind.knows, frozenset)

    def answers(self, breakpoints: Array) -> np.ndarray:
        return asked(self.origin, "answers", lambda: self.behind.answers(breakpoints), np.ndarray)

    @property
    def charge(self) -> Charge:
        return asked(self.origin, "charge", lambda: self.behind.charge, Charge)


@final
class _Method(_Guard[Method], Method):
    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        result = asked(self.origin, "solve", lambda: self.behind.solve(program, tools), Result)
        if result.status not in MEANING:
            raise PluginError(
                f"{self.origin}: solve returned the status {short_repr(result.status)}, expected one of"
                f" {', '.join(MEANING)}"
            )
        decision: Any = result.decision
        if decision is not None and np.shape(decision) != (program.n,):
            raise PluginError(
                f"{self.origin}: solve returned the decision {short_repr(decision)}, expected {program.n} numbers"
            )
        if result.status in CLAIMS:  # proofs and multipliers are derived anew by `check`, not here
            name = self.origin.partition(" (")[0]
            return replace(result, message=f"{result.message}; what the {name} claims is believed")
        return result


@final
class _Executors(_Guard[ExecutorFactory], ExecutorFactory):
    @property
    def parallel(self) -> bool:
        return asked(self.origin, "parallel", lambda: self.behind.parallel, bool)

    @contextmanager
    def open(self) -> Iterator[Executor]:
        with ExitStack() as stack:
            yield asked(self.origin, "open", lambda: stack.enter_context(self.behind.open()), Executor)


@final
class _Solver(_Guard[Solver], Solver):
    @property
    def delegate(self) -> str:
        return asked(self.origin, "delegate", lambda: self.behind.delegate, str)

    @property
    def conic(self) -> bool:  # type: ignore[override]
        return self.behind.conic

    @property
    def aborts(self) -> bool:  # type: ignore[override]
        return self.behind.aborts

    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        claim = asked(self.origin, "solve", lambda: self.behind.solve(program, accuracy), Claim)
        if claim.status not in ("solved", "infeasible", "failed"):
            raise PluginError(
                f"{self.origin}: solve claimed {short_repr(claim.status)}, expected solved, infeasible or failed"
            )
        if claim.status != "solved":
            return claim
        templates = {"x": program.q, "z": program.h, "y": program.b, "z_box": program.q}
        for name, template in templates.items():
            value = getattr(claim, name)
            if np.shape(value) != template.shape or np.asarray(value).dtype.kind not in "fiu":
                raise PluginError(
                    f"{self.origin}: solve claimed {name} = {short_repr(value)}, expected {template.size} numbers"
                )
        return claim


@final
class _Maximiser(_Guard[Maximiser], Maximiser):
    """A maximiser with its name in messages; `sparserob_core.sip.search.search.maximise` checks its answer."""

    @property
    def scaled(self) -> bool:  # type: ignore[override]
        return asked(self.origin, "scaled", lambda: self.behind.scaled, bool)

    @property
    def apart(self) -> bool:  # type: ignore[override]
        return asked(self.origin, "apart", lambda: self.behind.apart, bool)

    @property
    def whole(self) -> bool:  # type: ignore[override]
        return asked(self.origin, "whole", lambda: self.behind.whole, bool)

    @property
    def polished(self) -> float:
        return self.behind.polished

    def search(self, objective: Objective, rng: np.random.Generator) -> float:
        return self.behind.search(objective, rng)


@final
class _Regulariser(_Guard[Regulariser], Regulariser):
    def quadratic(self, image: ControlImage) -> tuple[csc_array, Array]:
        from scipy.sparse import csc_array

        answer = asked(self.origin, "quadratic", lambda: self.behind.quadratic(image), tuple)
        n = image.S.shape[1]
        with attributed(self.origin, "quadratic: what it returned"):
            P, q = csc_array(answer[0]), np.asarray(answer[1], dtype=float)
        if len(answer) != 2 or P.shape != (n, n) or q.shape != (n,):
            raise PluginError(
                f"{self.origin}: quadratic returned shapes {P.shape} and {q.shape}, expected ({n}, {n}) and ({n},)"
            )
        if not np.isfinite(q).all():
            raise PluginError(f"{self.origin}: quadratic returned numbers that are not finite")
        try:
            return require_convex("P", P, n), q
        except InputError as error:
            raise InputError(f"{self.origin}: quadratic: {error}") from error


def _make_rule_guard(kind: type, expected: tuple[type, ...], words: str) -> Callable[[Any, str], object]:
    """Return the check of a kind of rules, which are functions."""

    def guard(rule: Callable[..., object], origin: str) -> object:
        def call(_: object, *arguments: object) -> object:
            answer = asked(origin, "calling it", lambda: rule(*arguments), object)
            if not isinstance(answer, expected):
                raise PluginError(f"{origin}: calling it returned {short_repr(answer)}, expected {words}")
            return answer

        return type(kind.__name__, (kind,), {"__call__": call, "origin": origin})()

    return guard


GUARDS: dict[type, Callable[[Any, str], Any]] = {
    ProblemFactory: _Problem,
    DictionaryFactory: _Dictionary,
    Policy: _Policy,
    Method: _Method,
    ExecutorFactory: _Executors,
    Solver: _Solver,
    Maximiser: _Maximiser,
    Regulariser: _Regulariser,
    Schedule: _make_rule_guard(Schedule, NUMBER, "a number"),
    OuterStop: _make_rule_guard(OuterStop, TRUTH, "true or false"),
    InnerStop: _make_rule_guard(InnerStop, TRUTH, "true or false"),
    Selection: _make_rule_guard(Selection, TRUTH, "true or false"),
}
