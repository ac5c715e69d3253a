"""Guards checker/cost/nominal: the integrals of a quadratic cost, against exponentials of another kind (Van Loan 1978),
closed forms and an integrator."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from flint import acb, arb, arb_mat, ctx
from scipy.integrate import solve_ivp

import sparserob_core as sr
from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.arithmetic.series import Series, identity, stacked
from sparserob_core.checker.cost.nominal import NominalMotion, evaluate_quadratic_terms, nominal_states
from sparserob_core.checker.cost.price import Price
from sparserob_core.checker.flow.flow import FlowPart, VerifiedFlow
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.flow.segment import SHARP, VerifiedSegment
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, VaryingSystem
from sparserob_core.control.sets.sets import Box
from sparserob_core.sip.expressions.expression import parse_matrix

BITS, IN_TIME, EXACT = 96, 192, 600
rng = np.random.default_rng(4)
Z = rng.normal(size=(4, 4))
PLANTS = {
    "stable": Z - 4.0 * np.eye(4),
    "unstable": 3.0 * Z + 2.0 * np.eye(4),
    "stiff": np.array([[-1e4, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1e-3, -3.0]]),
    "turning": np.array([[0.0, 7.0], [-7.0, 0.0]]),
    "a chain of integrators": np.eye(4, k=1),
    "in other units": np.array([[0.0, 1e6, 0.0], [-1e-6, -0.5, 1e-9], [0.0, 1e3, -2.0]]),
}


def problem_of(system, until: float, Q=None, r=None, **more) -> sr.OptimalControlProblem:
    d, m = system.states, system.controls
    cost = sr.Cost(state=None if Q is None else {"Q": Q.tolist(), "reference": np.broadcast_to(r, d).tolist()},
                   **more.pop("cost", {}))  # fmt: skip
    known = {"initial_state": np.ones(d), "control": Box([-9.0] * m, [9.0] * m), "cost": cost}
    return sr.OptimalControlProblem(system=system, horizon=until, **{**known, **more})


def nominal_of(problem, parameter=(), sharp: float = SHARP) -> NominalMotion:
    flow = VerifiedFlow(Plant.of(problem.system, problem.horizon), problem.horizon).at(parameter)
    flow.sharp = sharp
    return NominalMotion(problem, flow)


def van_loan(A, B, c, Q, r, time) -> tuple[arb_mat, arb_mat]:
    """``e^(F h)`` and ``int_0^h e^(F't) M e^(F t) dt`` of ``z = (x, 1, u)``, from one exponential."""
    d, m = B.shape
    n = d + 1 + m
    F, E = np.zeros((n, n)), np.hstack([np.eye(d), -np.asarray(r)[:, None], np.zeros((d, m))])
    F[:d] = np.hstack([A, c[:, None], B])
    E, F, Q = (stacked([balls(row) for row in one]) for one in (E, F, Q))
    M = E.transpose() * Q * E
    rows = [[*a, *b] for a, b in zip((-F.transpose()).tolist(), M.tolist(), strict=True)]
    rows += [[arb(0)] * n + row for row in F.tolist()]
    whole = (stacked(rows) * time).exp().tolist()
    flow = arb_mat([row[n:] for row in whole[n:]])
    return flow, flow.transpose() * arb_mat([row[n:] for row in whole[:n]])


def holds(found: arb_mat, truth: arb_mat) -> bool:
    """Whether every ball holds a number that is known much better."""
    return all(a.contains(b) for a, b in zip(found.entries(), truth.entries(), strict=True))


def widest(found: arb_mat) -> float:
    """The largest radius, of the largest number."""
    return max(float(x.rad()) for x in found.entries()) / max(abs(float(x.mid())) for x in found.entries())


def quadratic(d: int, singular: bool = False) -> np.ndarray:
    root = np.random.default_rng(d).integers(-3, 4, size=(1 if singular else d, d)).astype(float)
    return root.T @ root + 0.0


@pytest.mark.parametrize("sharp", [SHARP, 2.0**-12], ids=["sharp", "rough"])
@pytest.mark.parametrize("name", PLANTS)
def test_steps_and_weights_hold_those_of_an_exponential(name: str, sharp: float) -> None:
    """Within a stride, at its end and many strides later; a rough guess leaves out what can be seen."""
    A = PLANTS[name]
    d = len(A)
    B, c, Q = np.eye(d)[:, -1:], np.linspace(-1.0, 1.0, d), quadratic(d)
    r = np.linspace(0.5, 2.0, d)
    problem = problem_of(LinearSystem(A, B, c=c), 4.0, Q, r)
    with ctx.workprec(BITS):
        nominal = nominal_of(problem, sharp=sharp)
        stride = nominal.flow.law.stretches[0].stride
        spans = [
            (0.0, stride / 3),
            (0.0, stride),
            (1.0, min(4.0, 1.0 + 2.7 * stride)),
            (0.3, min(4.0, 0.3 + 40 * stride)),
        ]
        found = [(nominal.step(*span), nominal.weight(*span)) for span in spans]
    with ctx.workprec(EXACT):
        for (start, stop), (step, weight) in zip(spans, found, strict=True):
            flow, truth = van_loan(A, B, c, Q, r, arb(stop) - arb(start))
            assert holds(step, flow) and holds(weight, truth)
            if sharp == SHARP:
                assert widest(step) < 1e-24 and widest(weight) < 1e-24


def test_a_law_that_changes_with_time_costs_what_is_integrated_by_hand() -> None:
    """``x' = x / (1 + t) + u`` is ``(1 + t) (x0 / (1 + a) + u log((1 + t) / (1 + a)))`` from ``a`` on."""
    problem = problem_of(VaryingSystem.of([["1 / (1 + t)"]], [[1]], 3.0), 3.0, np.array([[2.0]]), [0.5])
    spans = [(0.0, 0.1), (0.7, 2.6)]
    for sharp in (SHARP, 2.0**-12):
        with ctx.workprec(IN_TIME):
            nominal = nominal_of(problem, sharp=sharp)
            found = [(nominal.step(*span), nominal.weight(*span)) for span in spans]
        with ctx.workprec(200):
            for (a, b), (step, weight) in zip(spans, found, strict=True):

                def at(t, a=a):
                    return (1 + t) / (1 + acb(a)), -acb(0.5), (1 + t) * ((1 + t) / (1 + acb(a))).log()

                one, _, driven = (x.real for x in at(acb(b)))
                assert holds(step, stacked([[one, arb(0), driven], *identity(3).tolist()[1:]]))
                truth = [[acb.integral(lambda t, _, i=i, j=j: 2 * at(t)[i] * at(t)[j], a, b).real for j in range(3)]
                         for i in range(3)]  # fmt: skip
                assert holds(weight, stacked(truth))
                assert widest(weight) < 1e-20  # such a law has so many terms that no guess is rough


@pytest.mark.parametrize("off", [0.1, 4.0])
@pytest.mark.parametrize("terms", [[0.0, 1.0], [1.0, -1.0], [0.0, 0.0, 1.0]])
def test_what_a_polynomial_leaves_out_counts_in_every_product(terms: list[float], off: float) -> None:
    """A flow of ``t``, ``1 - t`` or ``t^2`` may be off by as much all along as it says."""
    problem = problem_of(LinearSystem(np.zeros((1, 1)), np.ones((1, 1))), 8.0, np.array([[3.0]]), [0.0])
    made = VerifiedSegment([Series.known(stacked([balls([x, 0.0, 0.0])])) for x in terms], np.array([[off, 0.0, 0.0]]))
    step, cost = nominal_of(problem)._integrate(FlowPart(made, arb(1), arb(2)))
    for by in (-off, off):
        true = [terms[0] + by, *terms[1:]]
        squares = sum(a * b / arb(i + j + 1) for i, a in enumerate(true) for j, b in enumerate(true))
        assert cost[0, 0].contains(6 * squares)
        assert step[0, 0].contains(sum(true))
    assert float(cost[0, 0].rad()) < 6.0 * (2.0 * off + off**2) * 1.01


def everything(varying: bool) -> sr.OptimalControlProblem:
    """A delay with a control before it, a drift, a parameter, two laws, deviations and disturbances not about 0."""
    drift, E, p = [0.0, 0.1], [[1.0, 0.0], [0.5, 1.0]], Box([-0.05], [0.15])
    if varying:
        A = [[0, 1], ["-2 + p", "-0.5 + sin(t) / 4"]]
        system = VaryingSystem.of(A, [[0], [1]], 2.0, E=E, c=drift, delay=0.15, parameters=p, names=["p"])
    else:
        laws = (([[0, 1], ["-2 + p", -0.5]], [[0.0], [1.0]]), ([[0, 1], ["-3 + 2 * p", -0.2]], [[0.1], [1.5]]))
        first, second = (LinearSystem(parse_matrix("A", A, ("p",)), np.array(B), np.array(E), p, ("p",),
                                      np.array(drift)) for A, B in laws)  # fmt: skip
        system = SwitchedSystem([(1.1, first), (2.0, second)], delay=0.15)
    return problem_of(
        system, 2.0, np.array([[1.0, 0.5], [0.5, 0.25]]), [0.2, -0.1], initial_state=[-1.0, 1.0], initial_control=[0.3],
        initial_set=Box([-0.02, 0.0], [0.04, 0.0]), disturbance=Box([-0.01, 0.0], [0.02, 0.04]),
        cost={"control": {"R": [[0.05]]}, "final": {"Q": [[1.0, 0.0], [0.0, 2.0]], "reference": [0.1, 0.0]}},
    )  # fmt: skip


def integrated(problem, control: np.ndarray, edges: np.ndarray) -> tuple[float, list[np.ndarray]]:
    """The quadratic terms of a control, and the nominal states where it begins to act, by an integrator."""
    Q, r = np.array([[1.0, 0.5], [0.5, 0.25]]), np.array([0.2, -0.1])
    varying = problem.system.varies

    def slope(t, z, u, late):
        damping = -0.2 if late else -0.5 + (np.sin(t) / 4 if varying else 0.0)
        A, B = np.array([[0, 1], [-3 + 0.1 if late else -2 + 0.05, damping]]), [0.1, 1.5] if late else [0.0, 1.0]
        push = np.array([[1, 0], [0.5, 1]]) @ [0.005, 0.02] + [0.0, 0.1] + np.array(B) * u
        return [*(A @ z[:2] + push), (z[:2] - r) @ Q @ (z[:2] - r)]

    z, seen = np.array([-0.99, 1.0, 0.0]), []
    times = sorted({0.0, 2.0, *(t for t in edges + 0.15 if t < 2.0), *(() if varying else (1.1,))})
    for a, b in pairwise(times):
        k = int(np.searchsorted(edges + 0.15, (a + b) / 2, side="right")) - 1
        seen.append(np.array([*z[:2], 1.0, 0.0 if k < 0 else control[k]]))
        late = not varying and a >= 1.1
        z = solve_ivp(slope, (a, b), z, args=(0.3 if k < 0 else control[k], late), rtol=1e-12, atol=1e-14).y[:, -1]
    seen.append(np.array([*z[:2], 1.0, 0.0]))
    final = (z[0] - 0.1) ** 2 + 2.0 * z[1] ** 2
    return z[2] + final + 0.05 * float(np.diff(edges) @ control**2), seen


@pytest.mark.parametrize("varying", [False, True], ids=["two laws", "in time"])
def test_values_slopes_and_states_are_those_of_an_integrator(varying: bool) -> None:
    problem, edges = everything(varying), np.array([0.0, 0.4, 0.9, 1.9, 2.0])  # the last piece acts too late
    control, dictionary = np.array([0.7, -0.4, 0.2, 1.1]), Dictionary.indicators(edges)
    with ctx.workprec(IN_TIME if varying else BITS):
        nominal = nominal_of(problem, (0.05,))
        pieces = [stacked([balls([u])]) for u in control]
        found, states = (
            evaluate_quadratic_terms(nominal, dictionary, pieces),
            nominal_states(nominal, dictionary, pieces),
        )
    value, seen = integrated(problem, control, edges)
    assert float(found.value.mid()) == pytest.approx(value, rel=1e-10)
    assert found.blurred < 1e-22
    assert found.terms >= value
    np.testing.assert_allclose([[float(x.mid()) for x in z.entries()] for z in states], seen, rtol=1e-9, atol=1e-11)
    h = 1e-3  # of a quadratic function differences are exact
    for k, (slope,) in enumerate(found.slope):
        up, down = (integrated(problem, control + s * h * np.eye(4)[k], edges)[0] for s in (1.0, -1.0))
        assert float(slope.mid()) == pytest.approx((up - down) / (2 * h), rel=1e-7)


def test_a_cost_without_states_asks_for_no_weight() -> None:
    problem = replace(everything(False), cost=sr.Cost(control={"R": [[0.05]]}))
    nominal = nominal_of(problem, (0.05,))
    assert nominal.weight(0.0, 1.3) == nominal.running * 0
    assert "_tabulate_remembered" not in nominal.__dict__


def test_a_plant_that_grows_is_resolved_by_more_bits_and_by_a_sharper_guess() -> None:
    """``x' = a (x - 1)`` from 1 stays there, and what rounds grows by ``e^(2 a)``."""
    dictionary = Dictionary.indicators(np.array([0.0, 1.0, 2.0]))
    for a, resolved in ((10.0, True), (40.0, True), (200.0, False)):
        problem = problem_of(LinearSystem(np.array([[a]]), np.ones((1, 1))), 2.0, np.ones((1, 1)), [0.0])
        with ctx.workprec(BITS):
            price = Price(problem, dictionary, VerifiedFlow(Plant.of(problem.system, 2.0), 2.0))
            pieces = [stacked([balls([-a])])] * 2
            if resolved:
                assert abs(price.squares(pieces) - 2) < 1e-4
                assert price._evaluate_quadratic(pieces).blurred <= 1e-20
            else:
                with pytest.raises(Unchecked, match="resolved"):
                    price.squares(pieces)


def test_intervals_of_one_kind_share_what_is_made_of_them() -> None:
    nominal = nominal_of(everything(False), (0.05,))
    assert nominal.step(0.25, 0.5) is nominal.step(0.5, 0.75)
    assert nominal.weight(0.25, 0.5) is nominal.weight(0.5, 0.75)
    assert nominal.step(0.25, 0.5) is not nominal.step(1.25, 1.5)
    assert nominal.weight(0.25, 0.5) is not nominal.weight(1.25, 1.5)


def test_what_was_found_serves_the_same_control_and_no_more_bits() -> None:
    problem = problem_of(LinearSystem(-np.ones((1, 1)), np.ones((1, 1))), 2.0, np.ones((1, 1)), [0.0])
    price = Price(
        problem, Dictionary.indicators(np.array([0.0, 2.0])), VerifiedFlow(Plant.of(problem.system, 2.0), 2.0)
    )
    one, other = ([stacked([balls([u])])] for u in (1.0, 0.0))
    radii = []
    for bits in (96, 192, 96):
        with ctx.workprec(bits):
            assert price.squares(one).contains(2)
            radii.append(float(price.squares(one).rad()))
            assert price.squares(other) < 1
    assert radii[1] < 1e-12 * radii[0]
