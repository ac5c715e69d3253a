"""Guards costs: factors, groups of channels as one vector, and quadratic terms of the nominal trajectory, against known
values, closed forms, independent cone programs, an integration of the physics, and forged certificates."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import clarabel
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.sparse import csc_matrix

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from tests.support.problems import spring
from tests.support.tampering import Forgery, forged

SPRING = spring(0.05)
EVERYTHING = {
    "state": {"Q": [[0.2, 0], [0, 0.1]]},
    "control": {"R": [[0.05]]},
    "final": {"Q": [[1, 0], [0, 1]]},
}
TRACKING = {"l1": 0.5, "state": {"Q": [[1, 0], [0, 0.1]], "reference": [0.2, 0]}}
PLANE: dict[str, Any] = {  # a point in the plane, pushed by a vector
    "name": "linear",
    "system": {
        "A": [[0, 0, 1, 0], [0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]],
        "B": [[0, 0], [0, 0], [1, 0], [0, 1]],
        "E": [[0, 0], [0, 0], [1, 0], [0, 1]],
    },
    "horizon": 4.0,
    "initial_state": [1.2, 1.6, 0.0, 0.0],
    "control": {"norm": {"p": 2, "radius": 1}},
    "terminal": [{"equals": [0, 0, 0, 0]}],
    "cost": {"group": "all"},
}


def run(problem: dict[str, Any], pieces: int, out: Path, dictionary: str = "piecewise_constant", **more: Any):
    config = {
        "problem": problem,
        "dictionaries": {
            "control": {"name": dictionary, "pieces": pieces},
            "disturbance": {"name": "piecewise_constant", "pieces": pieces},
        },
        "observers": [],
        **more,
    }
    return sr.run(config, out=out, quiet=True, figures=False)


def certified(outcome: Any) -> float:
    """The cost of a run that is certified, and verified by the checker."""
    assert outcome.result.status == "certified", outcome.result.message
    verdict = check(outcome.directory)
    assert verdict.status == "verified", verdict.claims
    assert outcome.result.gap <= 1e-6
    return float(outcome.result.cost)


@pytest.mark.first(1)
@pytest.mark.parametrize(("cost", "value"), [(EVERYTHING, 0.983009), (TRACKING, 1.234490)])
@pytest.mark.parametrize("solver", ["piqp", "clarabel", pytest.param("proxqp", marks=pytest.mark.slow)])
def test_known_costs_are_reached_with_every_solver(cost, value, solver, tmp_path):
    outcome = run({**SPRING, "cost": cost}, 50, tmp_path / "run", solver={"name": solver})
    assert certified(outcome) == pytest.approx(value, rel=1e-6)


def test_a_factor_of_the_l1_norm_multiplies_the_cost_and_nothing_else(tmp_path):
    one = certified(run(SPRING, 20, tmp_path / "one"))
    four = certified(run({**SPRING, "cost": {"l1": 4.0}}, 20, tmp_path / "four"))
    assert four == pytest.approx(4.0 * one, rel=1e-7)


HARD: dict[str, Any] = {  # everything at once: drift, delay, a parameter, sets that are not about 0
    **SPRING,
    "system": {
        "A": [[0, 1], ["-2 + p", -0.5]],
        "B": [[0], [1]],
        "c": [0.0, 0.1],
        "delay": 0.15,
        "parameters": {"p": [-0.05, 0.15]},
    },
    "initial_control": [0.3],
    "initial_state": {"centre": [-1, 1], "box": {"lower": [-0.02, 0.0], "upper": [0.04, 0.0]}},
    "disturbance": {"box": {"lower": [-0.01, 0.0], "upper": [0.02, 0.04]}},
    "path": [],
    "terminal": [{"box": [0.4, 0.5]}],
    "cost": {**EVERYTHING, "l1": 0.25, "state": {"Q": [[1, 0.5], [0.5, 0.25]], "reference": [0.2, -0.1]}},
}


LATER = {"A": [[0, 1], ["-3 + 2 * p", -0.2]], "B": [[0.1], [1.5]], "E": [[1, 0], [0.5, 1]], "c": [0.0, -0.2]}
SWITCHED = {
    **HARD,
    "terminal": [{"box": [1.0, 1.0]}],
    "system": {
        "pieces": [
            {"until": 2.2, **{name: HARD["system"][name] for name in ("A", "B", "c")}},
            {"until": 5.0, **LATER},
        ],
        "delay": 0.15,
        "parameters": {"p": [-0.05, 0.15]},
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("problem", [HARD, SWITCHED], ids=["one system", "two systems that take turns"])
def test_the_cost_is_that_of_the_physics_integrated_by_another_program(problem, tmp_path):
    outcome = run(problem, 17, tmp_path / "run")
    cost, control = certified(outcome), outcome.control[0]
    edges, delay, Q, r = np.linspace(0.0, 5.0, 18), 0.15, np.array([[1, 0.5], [0.5, 0.25]]), np.array([0.2, -0.1])

    def commanded(t):
        return 0.3 if t < 0.0 else control[min(int(np.searchsorted(edges, t, side="right")) - 1, 16)]

    def rates(t, z, u, later):
        x, w = z[:2], np.array([0.005, 0.02])
        A, B, c = np.array([[0, 1], [-2 + 0.05, -0.5]]), np.array([0.0, 1.0]), np.array([0.0, 0.1])
        if later:
            A, B, c = np.array([[0, 1], [-3 + 2 * 0.05, -0.2]]), np.array([0.1, 1.5]), np.array([0.0, -0.2])
            w = np.array([[1, 0], [0.5, 1]]) @ w
        return [*(A @ x + B * u + w + c), (x - r) @ Q @ (x - r)]

    z, times = np.array([-0.99, 1.0, 0.0]), np.unique(np.concatenate([edges, edges + delay, [delay, 2.2]]))
    times = times[times <= 5.0]
    for start, stop in pairwise(times):
        u, later = commanded((start + stop) / 2 - delay), problem is SWITCHED and start >= 2.2
        z = solve_ivp(rates, (start, stop), z, args=(u, later), rtol=1e-12, atol=1e-14).y[:, -1]
    lengths = np.diff(edges)
    wanted = z[2] + 0.25 * lengths @ np.abs(control) + 0.05 * lengths @ control**2 + z[:2] @ z[:2]
    assert cost == pytest.approx(wanted, rel=1e-9)


def _stepped(pieces: int, per_piece: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The states of the spring at Gauss points of a fine grid, ``free (t, 2)`` and ``driven (t, 2, pieces)``, with the
    weights ``(t,)`` of their integral; the last row is the final state."""
    h = 5.0 / pieces / per_piece
    F = np.array([[0.0, 1.0, 0.0], [-2.0, -0.5, 1.0], [0.0, 0.0, 0.0]])
    nodes = h * (1.0 + np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)])) / 2
    free, driven, weights = [], [], []
    x, X = np.array([-1.0, 1.0]), np.zeros((2, pieces))
    for k in range(pieces):
        for _ in range(per_piece):
            for node, weight in zip([*nodes, h], [*(h * np.array([5, 8, 5]) / 18), 0.0], strict=True):
                E = expm(F * node)
                here = E[:2, :2] @ X
                here[:, k] += E[:2, 2]
                free.append(E[:2, :2] @ x)
                driven.append(here)
                weights.append(weight)
            x, X = free[-1], driven[-1]
    return np.array(free), np.array(driven), np.array(weights)


def test_a_robust_quadratic_program_is_that_of_an_independent_solver(tmp_path):
    pieces, w = 20, 0.05
    free, driven, weights = _stepped(pieces, 6)
    Q, r = np.array([[1.0, 0.3], [0.3, 0.4]]), np.array([0.1, -0.2])
    P = 2 * np.einsum("t,tik,ij,tjl->kl", weights, driven, Q, driven) + 2 * 0.02 * 5.0 / pieces * np.eye(pieces)
    q = 2 * np.einsum("t,tik,ij,tj->k", weights, driven, Q, free - r)
    constant = np.einsum("t,ti,ij,tj->", weights, free - r, Q, free - r)
    spread = np.zeros(2)
    lengths = 5.0 / pieces
    A = np.array([[0.0, 1.0], [-2.0, -0.5]])
    for k in range(pieces):  # |w| is at its bound on every piece, with the sign of the piece's integral
        flow = np.linalg.solve(A, expm(A * lengths) - np.eye(2))
        spread += w * np.abs(expm(A * lengths * k) @ flow).sum(axis=1)
    rows = np.vstack([driven[-1], -driven[-1], np.eye(pieces), -np.eye(pieces)])
    high = np.concatenate([0.3 - spread - free[-1], 0.3 - spread + free[-1], np.ones(2 * pieces)])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
        setattr(settings, name, 1e-11)
    solution = clarabel.DefaultSolver(
        csc_matrix(np.triu(P)), q, csc_matrix(rows), high, [clarabel.NonnegativeConeT(high.size)], settings
    ).solve()
    cost = {"l1": 0.0, "state": {"Q": Q.tolist(), "reference": r.tolist()}, "control": {"R": [[0.02]]}}
    outcome = run({**SPRING, "path": [], "cost": cost}, pieces, tmp_path / "run")
    assert certified(outcome) == pytest.approx(solution.obj_val + constant, rel=1e-7)
    bent = 2 * 0.02 * 5.0 / pieces  # the cost is at least this curved, and its gap is 1e-7
    assert outcome.control[0] == pytest.approx(np.array(solution.x), abs=np.sqrt(2 * 2e-7 / bent))


@pytest.mark.slow
@pytest.mark.parametrize("dictionary", ["haar", "walsh"])
def test_the_cost_does_not_depend_on_the_functions_that_span_the_controls(dictionary, tmp_path):
    problem = {**SPRING, "cost": EVERYTHING}
    plain = certified(run(problem, 32, tmp_path / "plain"))
    assert certified(run(problem, 32, tmp_path / "spanned", dictionary)) == pytest.approx(plain, rel=2e-7)


def test_thrust_as_one_vector_along_a_line_costs_what_the_line_costs(tmp_path):
    line = {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 4.0,
        "initial_state": [2.0, 0.0],
        "control": {"box": 1.0},
        "terminal": [{"equals": [0, 0]}],
    }
    cost = certified(run(PLANE, 20, tmp_path / "plane"))
    assert cost == pytest.approx(certified(run(line, 20, tmp_path / "line")), rel=2e-7)
    assert cost == pytest.approx(4.0 - np.sqrt(8.0), abs=0.01)  # of any measurable control; pieces approach from above
    assert cost > 4.0 - np.sqrt(8.0)


@pytest.mark.slow
def test_thrust_as_one_vector_approaches_the_closed_form_of_the_double_integrator(tmp_path):
    cost = certified(run(PLANE, 100, tmp_path / "plane"))
    assert 0.0 < cost - (4.0 - np.sqrt(8.0)) < 5e-4


def test_a_vector_acts_where_it_is_not_0_though_a_channel_may_be(tmp_path):
    outcome = run({**PLANE, "initial_state": [2.0, 0.0, 0.0, 0.0], "control": {"box": 1.0}}, 8, tmp_path / "run")
    certified(outcome)
    assert np.abs(outcome.control[1]).max() <= 1e-9 < np.abs(outcome.control[0]).max()
    acts = (outcome.control != 0.0).any(axis=0).mean()
    assert outcome.result.activity.upper == pytest.approx(acts, abs=1e-12)


TWO_GROUPS: dict[str, Any] = {  # three thrusters on a turning platform, the first two as one vector
    "name": "linear",
    "system": {
        "A": [[0, 0, 1, 0], [0, 0, 0, 1], [0.3, 0, 0, 0.4], [0, -0.2, -0.4, 0]],
        "B": [[0, 0, 0], [0, 0, 0], [1, 0, 0.3], [0, 1, 0.4]],
    },
    "horizon": 3.0,
    "initial_state": [1.0, -0.4, 0.2, 0.5],
    "control": {"box": [0.8, 0.8, 0.5]},
    "terminal": [{"equals": [0, 0, 0, 0]}],
    "weights": [1.0, 1.0, 0.6],
    "cost": {"l1": 2.0, "group": [[1, 2]]},
}


def test_groups_are_those_of_an_independent_cone_program(tmp_path):
    pieces = 15
    h = 3.0 / pieces
    A, B = (np.array(TWO_GROUPS["system"][name], dtype=float) for name in ("A", "B"))
    F = np.zeros((7, 7))
    F[:4, :4], F[:4, 4:] = A, B
    step = expm(F * h)
    Phi, Gamma = step[:4, :4], step[:4, 4:]
    reach = np.hstack([np.linalg.matrix_power(Phi, pieces - 1 - k) @ Gamma for k in range(pieces)])
    n = 3 * pieces  # then a bound t for every norm, and one for every absolute value
    q = np.concatenate([np.zeros(n), np.full(pieces, 2.0 * h), np.full(pieces, 2.0 * 0.6 * h)])
    rows, right, cones = (
        [np.hstack([reach, np.zeros((4, 2 * pieces))])],
        [-np.linalg.matrix_power(Phi, pieces) @ TWO_GROUPS["initial_state"]],
        [clarabel.ZeroConeT(4)],
    )
    third, own = np.zeros((pieces, n)), np.eye(pieces)
    third[np.arange(pieces), 3 * np.arange(pieces) + 2] = 1.0
    blank = np.zeros((pieces, pieces))
    rows += [np.hstack([third, blank, -own]), np.hstack([-third, blank, -own])]
    rows += [np.hstack([s * np.eye(n), np.zeros((n, 2 * pieces))]) for s in (1.0, -1.0)]
    right += [np.zeros(2 * pieces), np.tile([0.8, 0.8, 0.5], 2 * pieces)]
    cones.append(clarabel.NonnegativeConeT(2 * pieces + 2 * n))
    for k in range(pieces):
        block = np.zeros((3, q.size))
        block[0, n + k] = block[1, 3 * k] = block[2, 3 * k + 1] = -1.0
        rows.append(block)
        right.append(np.zeros(3))
        cones.append(clarabel.SecondOrderConeT(3))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    G, g = csc_matrix(np.vstack(rows)), np.concatenate(right)
    solution = clarabel.DefaultSolver(csc_matrix((q.size, q.size)), q, G, g, cones, settings).solve()
    assert certified(run(TWO_GROUPS, pieces, tmp_path / "run")) == pytest.approx(solution.obj_val, rel=1e-6)


@pytest.mark.slow
def test_groups_stand_beside_disturbances_walls_and_quadratic_terms(tmp_path):
    problem = {
        **PLANE,
        "disturbance": {"box": [0.02, 0.02]},
        "path": [{"polytope": {"H": [[-1, 0.2, 0, 0]], "h": [0.3]}}],
        "terminal": [{"box": [0.2, 0.2, 0.2, 0.2]}],
        "control": {"box": 1.0},
        "cost": {"group": [[1, 2]], "state": {"Q": np.diag([0.05, 0.05, 0, 0]).tolist()}},
    }
    first = certified(run(problem, 16, tmp_path / "first"))
    turned = {**problem, "control": {"norm": {"p": 2, "radius": 1.5}}}  # another set, of which nothing is at its edge
    assert certified(run(turned, 16, tmp_path / "turned")) <= first * (1 + 1e-7)


def test_an_infeasible_problem_has_its_reason_whatever_it_costs(tmp_path):
    for number, cost in enumerate((TRACKING, {"group": [[1]], "control": {"R": [[1]]}})):
        outcome = run({**SPRING, "disturbance": {"box": [0.2, 0.2]}, "cost": cost}, 20, tmp_path / str(number))
        assert outcome.result.status == "infeasible"
        assert check(outcome.directory).status == "verified", check(outcome.directory).claims
    other = {**PLANE, "initial_state": [6.0, 8.0, 0.0, 0.0]}
    outcome = run(other, 10, tmp_path / "vector")
    assert outcome.result.status == "infeasible"
    assert check(outcome.directory).status == "verified", check(outcome.directory).claims


def _lower(forgery: Forgery, by: float) -> None:
    forgery.certificate["lower_bound"] += by
    forgery.result["lower_bound"] = forgery.certificate["lower_bound"]


def _cost(forgery: Forgery) -> None:
    forgery.certificate["cost"] *= 1.0 - 1e-7
    forgery.result["cost"] = forgery.result["upper_bound"] = forgery.certificate["cost"]


def _moved(forgery: Forgery) -> None:
    forgery.multipliers["tangent"] = (np.array(forgery.multipliers["tangent"]) + 0.5).tolist()


def _short(forgery: Forgery) -> None:
    forgery.multipliers["tangent"] = np.array(forgery.multipliers["tangent"])[:, 1:].tolist()


FORGERIES = {
    "a better lower bound": (lambda forgery: _lower(forgery, 1e-5), "lower bound"),
    "a better cost": (_cost, "cost"),
    "another tangent": (_moved, "lower bound"),
    "a tangent of another size": (_short, "lower bound"),
    "no tangent": (lambda forgery: forgery.multipliers.pop("tangent"), "lower bound"),
    "words for a tangent": (lambda forgery: forgery.multipliers.update(tangent="all of them"), "lower bound"),
}


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    return run({**SPRING, "cost": TRACKING}, 20, tmp_path_factory.mktemp("costs") / "honest").directory


@pytest.mark.first(2)
@pytest.mark.parametrize("name", FORGERIES)
def test_what_a_certificate_says_of_a_cost_is_derived_anew(name, honest, tmp_path):
    change, claim = FORGERIES[name]
    assert {one.name: one.verdict for one in check(forged(honest, tmp_path / "copy", change, consistent=True)).claims}[
        claim
    ] == "fails"


def test_a_cheaper_matrix_in_the_config_is_found_out(honest, tmp_path):
    def cheaper(forgery: Forgery) -> None:
        forgery.problem["cost"]["state"]["Q"][0][0] = 0.5

    copy = forged(honest, tmp_path / "copy", cheaper, consistent=True)
    verdicts = {one.name: one.verdict for one in check(copy).claims}
    assert verdicts["cost"] == "fails"


WRONG = [
    ({"l1": -1.0}, "cost.l1"),
    ({"l1": 0.0}, "cost.l1"),
    ({"state": {"Q": [[1, 0], [0, -1e-3]]}}, "-0.001"),
    ({"state": {"Q": [[1, 2], [2, 1]]}}, "cost.state.Q: .*eigenvalue -1"),
    ({"state": {"Q": [[1, 2], [0, 1]]}}, "cost.state.Q: .*symmetric"),
    ({"state": {"Q": [[1]]}}, "cost.state.Q: .*2 by 2"),
    ({"state": {"Q": [[1, 0], [0, 1]], "reference": [1, 2, 3]}}, "cost.state.reference"),
    ({"control": {"R": [[-1]]}}, "cost.control.R: .*eigenvalue -1"),
    ({"control": {"Q": [[1]]}}, "cost.control"),
    ({"final": {"Q": [[0, 1], [1, 0]]}}, "cost.final.Q: .*eigenvalue -1"),
    ({"group": "some"}, "cost.group"),
    ({"group": [[1, 2]]}, "cost.group: .*channels from 1 to 1"),
    ({"group": [[1], [1]]}, "cost.group: .*one group"),
    ({"group": [[0]]}, "cost.group: .*got 0"),
    ({"l2": 1.0}, "l2"),
]


@pytest.mark.first(7)
@pytest.mark.parametrize(("cost", "said"), WRONG)
def test_a_wrong_cost_is_refused_with_its_place(cost, said, tmp_path):
    with pytest.raises(sr.InputError, match=said):
        run({**SPRING, "cost": cost}, 10, tmp_path / "run")


def test_a_matrix_that_is_semidefinite_but_for_rounding_is_taken():
    thin = np.outer([0.1, 0.3, 0.7], [0.1, 0.3, 0.7])
    thin = (thin + thin.T) / 2
    cost = sr.Cost(state={"Q": thin}).checked(3, 1, np.ones(1))
    assert np.abs(cost.state.Q - thin).max() <= 1e-11
    with pytest.raises(sr.InputError, match="eigenvalue"):
        sr.Cost(state={"Q": thin - 1e-9 * np.eye(3)}).checked(3, 1, np.ones(1))


@pytest.mark.first(1)
@pytest.mark.parametrize("time", [1.0, 2.0**-7])
def test_other_units_give_the_same_bits(time, tmp_path):
    states, control, price = np.array([2.0**5, 2.0**-3]), 2.0**4, 2.0**6
    cost, Q, r = dict(TRACKING), np.diag([1.0, 0.1]), np.array([0.2, 0.0])
    plain = run({**SPRING, "cost": TRACKING}, 20, tmp_path / "plain").result
    A, B = np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([[0.0], [1.0]])
    cost["state"] = {"Q": (price * Q / np.outer(states, states) / time).tolist(), "reference": (r * states).tolist()}
    cost["l1"] = 0.5 * price / time / control
    other = {
        **SPRING,
        "system": {
            "A": (A * states[:, None] / states / time).tolist(),
            "B": (B * states[:, None] / control / time).tolist(),
        },
        "horizon": 5.0 * time,
        "initial_state": (np.array([-1.0, 1.0]) * states).tolist(),
        "control": {"box": control},
        "disturbance": {"box": (0.05 * states / time).tolist()},
        "path": [{"box": [0.7 * states[0], None], "from": 0.3 * time}],
        "terminal": [{"box": (0.3 * states).tolist()}],
        "cost": cost,
    }
    scaled = run(other, 20, tmp_path / "scaled").result
    assert scaled.cost == plain.cost * price
    assert scaled.lower_bound == plain.lower_bound * price
    assert np.array_equal(scaled.decision, plain.decision * control)


def test_the_python_record_means_what_the_config_means():
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0, 1.0], [-2.0, -0.5]], [[0.0], [1.0]]),
        horizon=5.0,
        initial_state=[-1.0, 1.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.05, -0.05], [0.05, 0.05]),
        path=[sr.PathConstraint(sr.Box([-0.7, -np.inf], [0.7, np.inf]), 0.3)],
        terminal=[sr.Box([-0.3, -0.3], [0.3, 0.3])],
        cost=sr.Cost(**EVERYTHING),
    )
    pieces = sr.load_registry().build("dictionary", "piecewise_constant", {"pieces": 50}).build(5.0)
    result = sr.solve(sr.transcribe(problem, pieces), method="exchange", solver="piqp")
    assert result.cost == pytest.approx(0.983009, rel=1e-6)


def test_minimum_attention_weighs_the_rate_and_the_control_apart(tmp_path):
    problem = {
        "name": "minimum_attention",
        "system": {"A": [[0]], "B": [[1]]},
        "horizon": 4.0,
        "initial_state": [1.0],
        "rate": {"box": 1.0},
        "terminal": [{"equals": [0]}],
        "cost": {"l1": 0.5, "control": {"R": [[2.0]]}, "state": {"Q": [[0.3]], "reference": [0.1]}},
    }
    outcome = run(problem, 16, tmp_path / "run")
    cost, rate = certified(outcome), outcome.control[0]
    h = 0.25
    ends = np.concatenate([[0.0], np.cumsum(h * rate)])
    of_the_control = (h * (ends[:-1] ** 2 + ends[:-1] * ends[1:] + ends[1:] ** 2) / 3).sum()
    x, of_the_state = 1.0, 0.0
    nodes, weights = np.polynomial.legendre.leggauss(4)
    for u, v in zip(ends[:-1], rate, strict=True):
        s = h * (nodes + 1) / 2
        of_the_state += h / 2 * weights @ (x + u * s + v * s**2 / 2 - 0.1) ** 2
        x += u * h + v * h**2 / 2
    assert cost == pytest.approx(0.5 * h * np.abs(rate).sum() + 2.0 * of_the_control + 0.3 * of_the_state, rel=1e-9)
    with pytest.raises(sr.InputError, match=r"cost\.control\.R: .*eigenvalue -1"):
        run({**problem, "cost": {"control": {"R": [[-1.0]]}}}, 16, tmp_path / "wrong")


def test_a_program_with_norms_and_a_constant_has_the_value_of_its_closed_form():
    # min |x| + |x|^2/2 + q'x + 3 over the plane: shrink -q towards 0 by 1
    q = np.array([3.0, -4.0])
    program = sr.SemiInfiniteProgram(
        n=2, q=q, P=np.eye(2), weights=1.0, lower=-10.0, upper=10.0, constant=3.0, blocks=[0, 0]
    )
    result = sr.solve(program, method="exchange", solver="piqp")
    assert result.cost == pytest.approx(3.0 - (5.0 - 1.0) ** 2 / 2, rel=1e-7)
    assert result.decision == pytest.approx(-q * 4.0 / 5.0, abs=1e-3)  # of a gap of 1e-7
    assert result.lower_bound <= 3.0 - 8.0 + 1e-9


def test_norms_and_absolute_values_are_no_more_than_their_directions_say():
    rng = np.random.default_rng(0)
    for _ in range(5):
        n, rows = 6, 8
        G = rng.normal(size=(rows, n))
        h = G @ rng.uniform(-2.0, 2.0, n) + rng.uniform(0.0, 0.1, rows)
        labels = [0, 0, 0, 1, 1, -1]
        program = sr.SemiInfiniteProgram(n=n, weights=1.0, lower=-3.0, upper=3.0, G=G, h=h, blocks=labels)
        result = sr.solve(program, method="exchange", solver="clarabel")
        x = result.decision
        assert result.cost == pytest.approx(np.linalg.norm(x[:3]) + np.linalg.norm(x[3:5]) + abs(x[5]), rel=1e-12)
        assert result.lower_bound <= result.cost <= result.lower_bound + 1e-6 * max(1.0, result.cost)
