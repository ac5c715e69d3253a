"""The contract of a method: whatever it claims is true, and it lets itself be stopped."""

from __future__ import annotations

import random
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.experiment.plugins.registry import load_registry
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.events import Event, RoundFinished
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.duality import dual_bound, farkas_margin
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.method import Continuation, Method, Tools
from sparserob_core.sip.program import ConstraintFamily, Enclosure, SemiInfiniteProgram
from sparserob_core.sip.proof.branch_and_bound import prove
from sparserob_core.sip.result import MEANING, Result
from sparserob_core.sip.solver import Claim, QuadraticProgram, Solver
from sparserob_core.testing.contract import Contract, broken, demand, same

DIP, WIDTH = 0.73713, 0.003  # where the narrow dip of `dipping` is, and how narrow
CLAIM_ACCURACY = 1e-6  # relative accuracy with which a claim is compared with what is known
DRAWN_SAMPLES = 4_000  # of an index set, at which a decision is examined; a tenth of them lie in the dip
HONEST = "claim no more than was proven: `certified` and `verified` only where every family is proven at the decision"


@dataclass(frozen=True, eq=False)
class Known:
    """A program with its value (``inf``: infeasible), and whether anything can be proven of its families."""

    name: str
    program: SemiInfiniteProgram
    value: float
    provable: bool = True


def _make_dip(provable: bool) -> ConstraintFamily:
    """``x1 + x2 t <= 1 + (t - DIP)^2 - 0.3 exp(-((t - DIP) / WIDTH)^2)`` for all t in [0, 1]."""

    def rows(t: Array) -> tuple[Array, Array]:
        offset = t[:, 0] - DIP
        rhs = 1.0 + offset**2 - 0.3 * np.exp(-((offset / WIDTH) ** 2))
        return np.stack([np.ones(len(t)), t[:, 0]], axis=1)[:, None], rhs[:, None]

    def enclosure(x: Array, lower: Array, upper: Array) -> Enclosure:
        low, high = lower[:, 0], upper[:, 0]
        distance = np.maximum(np.maximum(low - DIP, DIP - high), 0.0)
        lhs = x[0] + np.maximum(x[1] * low, x[1] * high)
        bounds = lhs - 1.0 - distance**2 + 0.3 * np.exp(-((distance / WIDTH) ** 2))
        return Enclosure(bounds, np.zeros(len(low), dtype=int))

    return ConstraintFamily(
        name="below", index_set=Box(np.zeros(1), np.ones(1)), rows=rows, enclosure=enclosure if provable else None
    )


def dipping(provable: bool = True) -> SemiInfiniteProgram:
    """minimise ``-x1 - DIP x2`` below a curve with a narrow dip that no coarse grid meets: -0.7, at (0.7, 0)."""
    return SemiInfiniteProgram(n=2, q=np.array([-1.0, -DIP]), lower=-10.0, upper=10.0, families=[_make_dip(provable)])


def _make_bilinear() -> SemiInfiniteProgram:
    """minimise ``|x|_1`` such that ``x1 + x2 s + x3 t >= 1 + s t`` on the unit square: 2, at (1, 1/2, 1/2)."""

    def rows(index: Array) -> tuple[Array, Array]:
        s, t = index.T
        return -np.stack([np.ones_like(s), s, t], axis=1)[:, None], -(1.0 + s * t)[:, None]

    def enclosure(x: Array, lower: Array, upper: Array) -> Enclosure:
        corners = [(s, t) for s in (lower[:, 0], upper[:, 0]) for t in (lower[:, 1], upper[:, 1])]
        bounds = np.max([1.0 + s * t - x[0] - x[1] * s - x[2] * t for s, t in corners], axis=0)
        return Enclosure(bounds, np.argmax(upper - lower, axis=1))

    above = ConstraintFamily(name="above", index_set=Box(np.zeros(2), np.ones(2)), rows=rows, enclosure=enclosure)
    return SemiInfiniteProgram(n=3, weights=1.0, lower=-5.0, upper=5.0, families=[above])


def _make_contradiction() -> SemiInfiniteProgram:
    """`dipping`, and ``x1 + x2 t >= 0.9`` for all t: nothing is feasible."""

    def rows(t: Array) -> tuple[Array, Array]:
        return -np.stack([np.ones(len(t)), t[:, 0]], axis=1)[:, None], np.full((len(t), 1), -0.9)

    def enclosure(x: Array, lower: Array, upper: Array) -> Enclosure:
        bounds = 0.9 - x[0] - np.minimum(x[1] * lower[:, 0], x[1] * upper[:, 0])
        return Enclosure(bounds, np.zeros(len(lower), dtype=int))

    above = ConstraintFamily(name="above", index_set=Box(np.zeros(1), np.ones(1)), rows=rows, enclosure=enclosure)
    return replace(dipping(), families=[_make_dip(True), above])


def _make_quadratic() -> SemiInfiniteProgram:
    """minimise ``(x - 1)^2 - 1`` such that ``x <= 1/2 + (t - 1/2)^2``: -3/4, at 1/2."""

    def rows(t: Array) -> tuple[Array, Array]:
        return np.ones((len(t), 1, 1)), 0.5 + (t - 0.5) ** 2

    def enclosure(x: Array, lower: Array, upper: Array) -> Enclosure:
        distance = np.maximum(np.maximum(lower - 0.5, 0.5 - upper), 0.0)[:, 0]
        return Enclosure(x[0] - 0.5 - distance**2, np.zeros(len(lower), dtype=int))

    below = ConstraintFamily(name="below", index_set=Box(np.zeros(1), np.ones(1)), rows=rows, enclosure=enclosure)
    return SemiInfiniteProgram(n=1, P=np.array([[2.0]]), q=np.array([-2.0]), families=[below])


def double_integrator(spread: float) -> SemiInfiniteProgram:
    """A double integrator in time 5 from (4, 0), ``|w| <= 0.02 spread``, to ``|x(5)| <= (0.5, 0.3)`` by 50 pieces: 1.6
    for spread 1, infeasible beyond 1.43."""
    from sparserob_core.control.problem.dictionary import Dictionary
    from sparserob_core.control.problem.problem import OptimalControlProblem
    from sparserob_core.control.problem.system import LinearSystem
    from sparserob_core.control.transcription.transcribe import transcribe

    pieces = Dictionary(np.linspace(0.0, 5.0, 51), np.eye(50))
    problem = OptimalControlProblem(
        system=LinearSystem(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])),
        horizon=5.0,
        initial_state=[4.0, 0.0],
        control=_make_symmetric(1.0),
        disturbance=_make_symmetric(0.02 * spread, 0.02 * spread),
        terminal=[_make_symmetric(0.5, 0.3)],
    )
    return transcribe(problem, control=pieces, disturbance=pieces)


def _make_symmetric(*sides: float) -> Box:
    return Box(-np.array(sides), np.array(sides))


def known() -> Iterator[Known]:
    """Programs with and without a solution; in the first one the worst index is hard to meet, and of the last one
    nothing can be proven."""
    yield Known("a narrow dip", dipping(), -0.7)
    yield Known("a bilinear family", _make_bilinear(), 2.0)
    yield Known("a quadratic cost", _make_quadratic(), -0.75)
    yield Known("a double integrator", double_integrator(1.0), 1.6)
    yield Known("a double integrator, infeasible", double_integrator(2.0), np.inf)
    yield Known("a contradiction", _make_contradiction(), np.inf)
    yield Known("a family without an enclosure", dipping(provable=False), -0.7, provable=False)


class _WatchedDeadline(Deadline):
    """A deadline that counts how often it is asked."""

    def __init__(self, seconds: float | None = None) -> None:
        super().__init__(seconds)
        self.asked = 0

    @property
    def passed(self) -> bool:
        self.asked += 1
        return super().passed

    @property
    def reason(self) -> str:
        self.asked += 1
        return super().reason


class _LyingSolver(Solver):
    """Answers with a fixed status, zeros and multipliers of 1."""

    def __init__(self, status: Literal["solved", "infeasible", "failed"]) -> None:
        self.status = status

    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        x = np.clip(np.zeros(program.q.size), program.lower, program.upper)
        return Claim(
            self.status,
            x,
            np.ones(program.h.size),
            np.ones(program.b.size),
            np.zeros(x.size),
        )


class MethodContract(Contract[Method], kind="method"):
    """Contract of a method: subclass it as ``class TestMine(MethodContract)`` and give ``component``.

    ``solve(program, tools)`` returns a `Result` for every program, whose status never claims more than was proven. The
    contract compares every claim with programs whose value is known. Bounds must lie on their side of the value, and
    multipliers must prove the lower bound. A certified decision is proven anew; an infeasible answer needs multipliers
    that prove it, a refuted one a witness. A method that does not suit a program raises `InputError`, but has to suit
    one of them.
    """

    def tools(self, **changed: object) -> Tools:
        """New tools, some of them replaced."""
        registry = load_registry()
        own: dict[str, object] = {
            "solver": registry.build("solver", "piqp"),
            "maximiser": registry.build("maximiser", "direct"),
            "regulariser": registry.build("regulariser", "ridge"),
            "continuation": Continuation(start=1e-2, factor=0.1, stop=1e-3),
            "budget": 100,
            "rng": np.random.default_rng(4),
            **changed,
        }
        return Tools(**own)  # type: ignore[arg-type]

    def solved(self, one: Known, method: Method | None = None, **changed: object) -> Result | None:
        """Return the method's result for a program, or ``None`` where it does not suit the program.

        The contract is broken where the method raises anything but `InputError`, or returns no `Result`.
        """
        chosen, tools = method or self.create(), self.tools(**changed)
        try:
            result: object = chosen.solve(one.program, tools)
        except InputError:
            return None
        except KeyboardInterrupt as error:
            broken(
                f"{one.name}: an interrupt, or the end of the time, goes through the method ({error})",
                "catch KeyboardInterrupt around the work, tell `tools.deadline.interrupt(error)`, and return what is "
                "known by then, with the reason as `stopped`",
            )
        except Exception as error:  # noqa: BLE001  a component may raise anything, and must not
            broken(
                f"{one.name}: solve raised {type(error).__name__}: {error}",
                'return a Result with the status "failed" and the reason as its message; raise `InputError` only where '
                "the method does not suit the program",
            )
        if not isinstance(result, Result):
            broken(f"{one.name}: solve returned {result!r}", "return a `sparserob_core.Result`")
        return result

    def test_what_it_claims_is_true(self) -> None:
        answered = 0
        for case in known():
            result = self.solved(case)
            if result is not None:
                answered += 1
                judge(case, result)
        demand(answered, "it refuses every program", "answer one kind of program at least")

    def test_the_rounds_that_it_tells_are_true(self) -> None:
        for case in known():
            events: list[Event] = []
            self.solved(case, notify=events.append)
            for event in events:
                if isinstance(event, RoundFinished):
                    demand(
                        event.lower_bound <= case.value + CLAIM_ACCURACY,
                        f"{case.name}: round {event.round} tells the lower bound {event.lower_bound:.9g}, and the "
                        f"value is {case.value:.9g}",
                        "tell bounds that are proven, -inf while there is none",
                    )
                    demand(
                        event.decision is None or not event.decision.flags.writeable,
                        f"{case.name}: observers may write into the decision of round {event.round}",
                        "set `decision.flags.writeable = False` on a view of it before it is told",
                    )

    def test_a_solver_that_lies_misleads_nobody(self) -> None:
        for liar in (_LyingSolver("solved"), _LyingSolver("infeasible"), _LyingSolver("failed")):
            for case in known():
                if case.name in ("a narrow dip", "a contradiction"):
                    result = self.solved(case, solver=liar)
                    if result is not None:
                        judge(case, result)

    def test_the_same_seed_gives_the_same_result(self) -> None:
        shared, own = str(np.random.get_state(legacy=False)), random.getstate()  # noqa: NPY002
        for case in known():
            first, second = self.solved(case), self.solved(case)
            demand(
                _list_numbers(first) == _list_numbers(second),
                f"{case.name}: the same seed gives another result: {_list_numbers(first)[:3]},"
                f" {_list_numbers(second)[:3]}",
                "draw from `tools.rng` only, and let no clock decide",
            )
        demand(
            shared == str(np.random.get_state(legacy=False)) and own == random.getstate(),  # noqa: NPY002
            "the method draws from, or seeds, the random numbers of the whole process (np.random or random)",
            "use `tools.rng`",
        )

    def test_one_method_may_solve_many_programs(self) -> None:
        method = self.create()
        for case in known():
            reused, fresh = self.solved(case, method), self.solved(case)
            demand(
                _list_numbers(reused) == _list_numbers(fresh),
                f"{case.name}: a method that has solved other programs before comes to another result than a new one",
                "keep nothing of a program in `self`",
            )

    def test_the_program_is_left_as_it_was(self) -> None:
        for case in known():
            program = case.program.finite
            names = ("q", "weights", "lower", "upper", "G", "h", "A", "b")
            before = {name: deepcopy(getattr(program, name)) for name in names}
            self.solved(case)
            changed = [name for name in names if not same(before[name], getattr(program, name))]
            demand(
                not changed,
                f"{case.name}: the method has changed {', '.join(changed)} of the program",
                "make a new program with `dataclasses.replace`",
            )

    def test_it_ends_when_its_time_is_over(self) -> None:
        for case in known():
            late = _WatchedDeadline(1e-9)
            result = self.solved(case, deadline=late)
            if result is None:
                continue
            judge(case, result)
            demand(
                late.asked,
                f"{case.name}: the method never asks whether its time is over",
                "call `tools.deadline.check()` between steps, or look at `tools.deadline.passed`",
            )
            demand(
                result.stopped or result.status in ("certified", "infeasible"),
                f"{case.name}: time is over, the result is {result.status}, and does not say why it came to an end",
                "return `tools.deadline.reason` as `stopped`",
            )

    def test_an_interrupt_ends_it_with_what_is_known(self) -> None:
        for case in known():
            events: list[Event] = []

            def interrupt(event: Event, told: list[Event] = events) -> None:
                told.append(event)
                raise KeyboardInterrupt

            result = self.solved(case, notify=interrupt)
            if result is None or not events:
                continue
            judge(case, result)
            demand(
                len(events) <= 2,
                f"{case.name}: {len(events)} events were told after the interrupt from the keyboard",
                "let KeyboardInterrupt end the work",
            )
            demand(
                result.stopped,
                f"{case.name}: it was interrupted, and the result does not say so",
                "return what `tools.deadline.interrupt(error)` returns as `stopped`",
            )

    def test_without_a_maximiser_it_works_or_says_what_it_needs(self) -> None:
        for case in known():
            method, tools = self.create(), self.tools(maximiser=None)
            try:
                result: object = method.solve(case.program, tools)
            except InputError:
                continue
            except Exception as error:  # noqa: BLE001  as above
                broken(
                    f"{case.name}: without a maximiser solve raised {type(error).__name__}: {error}",
                    "`tools.maximiser` may be None: raise `InputError` where it is needed",
                )
            if isinstance(result, Result):
                judge(case, result)


def judge(one: Known, result: Result) -> None:
    """Raise `ContractBroken` where a result claims something that is not so."""
    program, scale = one.program, max(1.0, abs(one.value)) if np.isfinite(one.value) else 1.0
    demand(
        result.status in MEANING and bool(result.message),
        f"{one.name}: the status is {result.status!r}, the message {result.message!r}",
        f"one of {', '.join(MEANING)}, and a sentence that says why",
    )
    proven = result.status in ("certified", "verified")
    demand(
        not proven or one.provable,
        f"{one.name}: it is {result.status}, though nothing can be proven of a family that offers its rows only",
        HONEST,
    )
    demand(
        result.status != "infeasible" or one.value == np.inf,
        f"{one.name}: it is called infeasible, though {one.value:g} can be reached ({result.message})",
        "say so only where multipliers prove it",
    )
    x = result.decision
    if x is not None:
        demand(
            np.shape(x) == (program.n,) and np.isfinite(x).all(),
            f"{one.name}: the decision has shape {np.shape(x)}, or numbers that are not finite",
            f"return an array of {program.n} numbers, or None",
        )
        demand(
            abs(result.cost - program.cost(x)) <= 1e-9 * max(1.0, program.finite.magnitude(x)),
            f"{one.name}: the cost is said to be {result.cost:.9g}, and is {program.cost(x):.9g} at the decision",
            "take `program.cost(decision)`: without the regulariser, and of the decision that is returned",
        )
    demand(
        x is not None or result.status in ("infeasible", "failed", "undecided"),
        f"{one.name}: it is {result.status} without a decision",
        "return the decision that this is said of",
    )
    if proven and x is not None:
        _judge_decision(one, result, x, scale)
    _judge_bounds(one, result, scale)
    if result.status == "refuted" and x is not None:
        _judge_witness(one, result, x)


def _judge_bounds(one: Known, result: Result, scale: float) -> None:
    proven = result.status in ("certified", "verified")
    demand(
        result.upper_bound == (result.cost if proven else np.inf),
        f"{one.name}: it is {result.status} with the cost {result.cost:.9g} and the upper bound "
        f"{result.upper_bound:.9g}",
        "the upper bound is the cost where the decision is proven, and inf where it is not",
    )
    demand(
        result.lower_bound <= one.value + CLAIM_ACCURACY * scale,
        f"{one.name}: the lower bound {result.lower_bound:.9g} is above the value {one.value:.9g}",
        "a lower bound comes from multipliers of the unregularised program (weak duality), or is -inf; the cost of a "
        "decision is none, and neither is what a solver says",
    )
    if result.status != "infeasible" and not result.lower_bound > -np.inf:
        return
    derived = _derive_bound(one.program, result)
    if derived is None:
        return
    if result.status == "infeasible":
        demand(
            derived > 0.0,
            f"{one.name}: it is called infeasible, and its multipliers do not prove it",
            "return the Farkas multipliers of the imposed constraints as `dual`",
        )
    else:
        demand(
            result.lower_bound <= derived + CLAIM_ACCURACY * scale,
            f"{one.name}: the lower bound is said to be {result.lower_bound:.9g}; its multipliers prove {derived:.9g}",
            "return the multipliers that prove the lower bound as `dual`; `check` looks at them",
        )


def _derive_bound(program: SemiInfiniteProgram, result: Result) -> float | None:
    """Derive the bound that the multipliers of a result prove: a lower bound of the value, or the margin of
    infeasibility.

    ``None`` where the multipliers belong to constraints that are not the program's own (samples).
    """
    base, rows, sides, y = program.finite, [], [], []
    for cut in result.dual.cuts:
        family = program.formulated(cut.family, cut.formulation)
        if family is None:
            return None
        G, h = family.rows(np.asarray(cut.index)[None])
        rows.append(G[0, cut.row])
        sides.append(h[0, cut.row])
        y.append(cut.multiplier)
    fixed = result.dual.of_fixed_rows(base.h.size)
    mu = result.dual.mu if result.dual.mu.size else np.zeros(base.b.size)
    G = np.vstack([base.G, np.array(rows).reshape(-1, program.n)])
    finite: FiniteProgram = replace(base, G=G, h=np.concatenate([base.h, np.array(sides)]))
    multipliers = np.concatenate([fixed, np.array(y)])
    if result.status == "infeasible":
        return farkas_margin(finite, multipliers, mu, result.dual.z)[0]
    return dual_bound(finite, multipliers, mu, result.dual.z, at=result.decision)


def _judge_decision(one: Known, result: Result, x: Array, scale: float) -> None:
    program = one.program
    demand(
        one.value < np.inf,
        f"{one.name}: it is {result.status}, though nothing is feasible ({result.message})",
        HONEST,
    )
    demand(
        program.finite.residual(x) <= 1e-8,
        f"{one.name}: it is {result.status}, and the decision misses bounds or fixed rows by "
        f"{program.finite.residual(x):.1e}",
        "look at `program.finite.residual(decision)` before you claim anything",
    )
    for family in program.families:
        worst = _sample_worst_violation(family, x)
        demand(
            worst <= 1e-8,
            f"{one.name}: it is {result.status}, and the decision violates {family.name} by {worst:.3g}",
            HONEST + "; a grid, however fine, proves nothing",
        )
    unproven = [proof.family for proof in prove(program, x) if proof.verdict != "proven"]
    demand(
        not unproven,
        f"{one.name}: it is {result.status}, and {', '.join(unproven)} cannot be proven at the decision",
        HONEST,
    )
    proven_names = {proof.family for proof in result.proofs if proof.verdict == "proven"}
    demand(
        proven_names >= {family.name for family in program.families},
        f"{one.name}: it is {result.status}, and `proofs` has a proof of "
        f"{', '.join(sorted(proven_names)) or 'no family'} only",
        "return a `Proof` for each family; `check` looks at them",
    )
    demand(
        result.status != "certified" or result.cost <= one.value + 1e-5 * scale,
        f"{one.name}: it is certified with the cost {result.cost:.9g}, and the value is {one.value:.9g}",
        "`certified` means that the bounds have met; `verified`, that the decision is feasible",
    )


def _sample_worst_violation(family: ConstraintFamily, x: Array) -> float:
    """The largest violation at many indices, near the dip of `dipping` above all; it proves nothing."""
    box, rng = family.index_set, np.random.default_rng(1)
    spread = rng.random((DRAWN_SAMPLES, box.dimension))
    points = box.lower + spread * (box.upper - box.lower)
    points[: DRAWN_SAMPLES // 10, 0] = np.clip(
        DIP + WIDTH * (spread[: DRAWN_SAMPLES // 10, 0] - 0.5), box.lower[0], box.upper[0]
    )
    return float(family.violations(x, points).max())


def _judge_witness(one: Known, result: Result, x: Array) -> None:
    worst = result.worst
    if worst is None or not worst.violation > 0.0:
        broken(f"{one.name}: it is refuted without a witness", "return the violated constraint as `worst`")
    family = one.program.formulated(worst.constraint, worst.formulation)
    if family is None:
        return
    violation = float(family.violations(x, np.asarray(worst.index)[None])[0, worst.row])
    demand(
        violation > 0.0 and abs(violation - worst.violation) <= CLAIM_ACCURACY * max(1.0, violation),
        f"{one.name}: the witness is said to be violated by {worst.violation:.6g}, and is by {violation:.6g}",
        "take the violation from `family.violations(decision, index)`, in the row that is named",
    )


def _list_numbers(result: Result | None) -> list[object]:
    if result is None:
        return []
    decision = None if result.decision is None else result.decision.tolist()
    bounds = [str(number) for number in (result.cost, result.lower_bound, result.upper_bound)]
    return [result.status, result.message, bounds, decision]
