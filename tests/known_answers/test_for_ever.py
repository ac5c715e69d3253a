"""Guards plans that repeat: values in closed form, the largest disturbances of independent linear programs,
certificates, and loops that run through many periods."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.checker.claims import case as cases
from sparserob_core.checker.problem import returning
from sparserob_core.control.loop.remaining import remaining_problem
from sparserob_core.control.problem.terms.repeat import WITHIN, Return

MASS = {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]}


def _config(pieces: int, policy: str = "affine", cost: str = "peak", **problem: Any) -> dict[str, Any]:
    policies = {"name": policy, "cost": cost, "causal_signals": 0} if policy == "affine" else {"name": policy}
    dictionary = {"name": "piecewise_constant", "pieces": pieces}
    return {
        "problem": {"name": "linear", "control": {"box": 1.0}, "repeat": True, **problem},
        "dictionaries": {"control": dictionary, "disturbance": dictionary},
        "policy": policies,
    }


def _run(directory, config: dict[str, Any]) -> sr.Outcome:
    return sr.run(config, out=directory, quiet=True, figures=False)


def _verdicts(directory) -> dict[str, str]:
    return {one.name: one.verdict for one in sr.check(directory).claims}


def _integrator(pieces: int = 1, w: float = 0.25, **more: Any) -> dict[str, Any]:
    """``x' = u + w`` over one unit of time, from ``[-1, 1]``: ``u = M x(0)`` must have ``|1 + M| + w <= 1``."""
    keys = {"system": {"A": [[0]], "B": [[1]]}, "initial_state": {"centre": [0.0], "box": [1.0]}}
    return _config(pieces, **{**keys, "horizon": 1.0, "disturbance": {"box": w}, **more})


@pytest.mark.parametrize("centre", [0.0, 3.0])
def test_a_policy_that_returns_costs_what_the_disturbance_adds(tmp_path, centre) -> None:
    config = _integrator(initial_state={"centre": [centre], "box": [1.0]})
    found = _run(tmp_path / "run", config)
    assert found.status == "certified"
    assert found.result.cost == pytest.approx(0.25, rel=1e-6)  # |M| = w, and the set shrunk by WITHIN
    assert found.result.lower_bound <= 0.25 + 1.1 * WITHIN
    verdicts = _verdicts(tmp_path / "run")
    assert verdicts["repeat"] == verdicts["return"] == verdicts["lower bound"] == "holds"


@pytest.mark.slow
def test_integrals_begin_anew_with_every_period(tmp_path) -> None:
    """``x(t) = (1 + M t) x(0) + w t``: its integral, at most ``|1 + M / 2| + w / 2``, is within 0.7 from ``-M = 0.85``
    on, and the return asks for 0.25 alone."""
    found = _run(tmp_path / "run", _integrator(integral=[{"H": [[1]], "lower": [-0.7], "upper": [0.7]}]))
    assert found.status == "certified"
    assert found.result.cost == pytest.approx(0.85, rel=1e-6)
    assert set(_verdicts(tmp_path / "run").values()) == {"holds"}
    loops = sr.loop(found, periods=20, trajectories=2)
    assert loops.uncovered == 0
    assert loops.constraints["integral"][0] == pytest.approx(0.0, abs=1e-9)  # the worst case is met in its period


@pytest.mark.slow
@pytest.mark.parametrize(("most", "status"), [(0.14, "certified"), (0.13, "infeasible")])
def test_a_budget_is_one_of_every_period(tmp_path, most, status) -> None:
    """``x' = 1/2 - x + u`` from 1/2 gathers 1/2 in a period, of which a control within 1 takes at most ``e^-1`` away,
    and returns from -1/2."""
    keys = {"system": {"A": [[-1]], "B": [[1]], "c": [0.5]}, "initial_state": {"centre": [0.0], "box": [0.5]}}
    budget = [{"H": [[1]], "upper": [most]}]
    found = _run(tmp_path / "run", _config(4, "open_loop", **keys, horizon=1.0, integral=budget))
    assert found.status == status
    assert set(_verdicts(tmp_path / "run").values()) == {"holds"}


@pytest.mark.first(1)
@pytest.mark.parametrize(("step", "status"), [(0.51, "certified"), (0.49, "infeasible")])
def test_steps_across_the_seam_hold_for_all_first_and_all_last_controls(tmp_path, step, status) -> None:
    """Of one piece the last control is the first one, but of another initial state: ``2 |M| <= step``."""
    found = _run(tmp_path / "run", _integrator(control_step={"box": step}))
    assert found.status == status
    assert set(_verdicts(tmp_path / "run").values()) == {"holds"}


def test_a_gain_that_goes_around_too_far_is_found(tmp_path) -> None:
    """``M`` from -0.25 to -0.3 still returns, and its control may change by 0.6 where 0.51 is allowed."""
    _run(tmp_path / "run", _integrator(control_step={"box": 0.51}))
    file = tmp_path / "run" / "certificate.json"
    honest = json.loads(file.read_text())
    file.write_text(json.dumps({**honest, "gains": (1.2 * np.array(honest["gains"])).tolist()}))
    verdicts = _verdicts(tmp_path / "run")
    assert verdicts["return"] == "holds"
    assert verdicts["control_step"] == verdicts["repeat"] == "fails"


def test_the_violation_across_the_seam_is_that_of_both_answers_apart(tmp_path) -> None:
    model = _run(tmp_path / "run", _integrator(control_step={"box": 0.51})).experiment.transcription
    family = next(one for one in model.program.families if one.name == "control_step")
    decision = np.zeros(model.program.n)
    decision[1] = -0.2
    assert model.feedback.loop.gains(decision).ravel() == pytest.approx([-0.2])
    at = np.array([[1.0]])
    assert family.excess(decision, at) == pytest.approx(np.full((1, 2), 0.4 - 0.51))
    assert family.enclosure(decision, at, at).bounds == pytest.approx([0.4 - 0.51])
    assert family.uncertain(at[0]).excess(decision, model.program.spread) == pytest.approx(np.full(2, 0.4 - 0.51))


def test_what_is_left_of_a_period_steps_to_the_control_that_begins_the_next(tmp_path) -> None:
    keys = {"system": {"A": [[0]], "B": [[1]], "c": [-0.5]}, "horizon": 2.0, "initial_state": [0.7]}
    config = _config(2, "open_loop", **keys, control_step={"box": 0.2})
    model = _run(tmp_path / "run", config).experiment.transcription
    left = remaining_problem(model, 1, np.array([0.7]), np.array([0.5]), again=np.array([0.4])).problem
    seam = next(one for one in left.path if one.name == "seam")
    assert not left.repeat
    assert (np.asarray(seam.G) @ [0.6] <= np.asarray(seam.h) + 1e-12).all()
    assert (np.asarray(seam.G) @ [0.61] > np.asarray(seam.h)).any()
    assert (np.asarray(seam.G) @ [0.19] > np.asarray(seam.h)).any()


@pytest.mark.slow
def test_twelve_masses_return_though_the_box_of_their_states_is_left_in_between(tmp_path) -> None:
    """24 states: without control the box grows to 4.4 times its size before it shrinks, and no control that is fixed
    beforehand brings it back under this disturbance."""
    n = 12
    stiffness = 4.0 * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness, -np.eye(n)]])
    B, E = np.zeros((2 * n, 2)), np.zeros((2 * n, 1))
    B[n, 0] = B[2 * n - 1, 1] = E[n + 5, 0] = 1.0
    assert max(np.abs(expm(A * t)).sum(axis=1).max() for t in (0.5, 1.0, 1.5)) > 2.0
    keys = {
        "system": {"A": A.tolist(), "B": B.tolist(), "E": E.tolist()},
        "horizon": 6.0,
        "initial_state": {"centre": [0.0] * 2 * n, "box": 0.1},
        "disturbance": {"box": 0.05},
    }
    assert _run(tmp_path / "fixed", _config(4, "open_loop", **keys)).status == "infeasible"
    found = _run(tmp_path / "run", _config(4, cost="nominal", **keys))
    assert found.status == "certified"
    assert set(_verdicts(tmp_path / "run").values()) == {"holds"}
    loops = sr.loop(found, periods=100, trajectories=1)
    assert not loops.contradicts
    assert loops.steps == 2000


def test_a_seam_that_binds_has_a_cost_that_the_checker_derives(tmp_path) -> None:
    """Late control is cheap, but the step back to the first piece is at most 0.2: 0.4 and 0.6 instead of 0 and 1."""
    steps = {"polytope": {"H": [[-1], [1]], "h": [0.2, 1.0]}}
    config = _config(
        2,
        "open_loop",
        system={"A": [[0]], "B": [[1]], "c": [-0.5]},
        horizon=2.0,
        initial_state=[0.7],
        weights=[[0, 1], [1, 0.1]],
        control_step=steps,
    )
    found = _run(tmp_path / "run", config)
    assert found.status == "certified"
    assert found.result.cost == pytest.approx(0.46, abs=1e-7)
    assert set(_verdicts(tmp_path / "run").values()) == {"holds"}
    ends = {**config["problem"], "repeat": False, "terminal": [{"equals": [0.7]}]}
    once = _run(tmp_path / "once", {**config, "problem": ends})
    assert once.result.cost == pytest.approx(0.1, abs=1e-7)


def test_curved_steps_go_around_too(tmp_path) -> None:
    config = _config(
        2,
        "open_loop",
        system={"A": [[0]], "B": [[1]], "c": [-0.5]},
        horizon=2.0,
        initial_state=[0.7],
        weights=[[0, 1], [1, 0.1]],
        control_step={"ellipsoid": {"shape": [[0.04]]}},
    )
    found = _run(tmp_path / "run", config)
    assert found.result.cost == pytest.approx(0.46, abs=1e-6)
    assert _verdicts(tmp_path / "run")["control_step"] == "holds"


@pytest.mark.first(2)
@pytest.mark.parametrize(("share", "feasible"), [(0.996, True), (1.006, False)])
@pytest.mark.parametrize(
    ("period", "noise", "largest"),
    [
        (1, None, 0.1973),
        pytest.param(2, None, 0.3171, marks=pytest.mark.slow),
        pytest.param(5, None, 0.3394, marks=pytest.mark.slow),
        (1, 0.02, 0.1565),
        pytest.param(2, 0.02, 0.1917, marks=pytest.mark.slow),
        pytest.param(5, 0.02, 0.1988, marks=pytest.mark.slow),
    ],
)
def test_the_largest_disturbance_for_ever_is_that_of_an_independent_program(
    period, noise, largest, share, feasible
) -> None:
    """known answers, for the box of 0.3 into itself within a period, of the state or of ``x1`` with that noise."""
    seen = {} if noise is None else {"measurements": {"C": [[1, 0]], "noise": {"box": noise}}}
    config = _config(
        4 * period,
        system=MASS,
        horizon=float(period),
        initial_state={"centre": [0, 0], "box": [0.3, 0.3]},
        disturbance={"box": [share * largest, share * largest]},
        path=[{"box": [0.7, None]}],
        **seen,
    )
    found = sr.run(config, quiet=True, figures=False)
    assert found.status == ("certified" if feasible else "infeasible")


@pytest.fixture(scope="module")
def loops(tmp_path_factory) -> sr.Outcome:
    config = _config(
        8,
        system=MASS,
        horizon=2.0,
        initial_state={"centre": [0, 0], "box": [0.3, 0.3]},
        disturbance={"box": [0.12, 0.12]},
        control_step={"box": 1.0},
        path=[{"box": [0.7, None]}],
    )
    found = _run(tmp_path_factory.mktemp("repeats") / "run", config)
    assert found.status == "certified"
    return found


@pytest.mark.slow
def test_loops_run_through_many_periods(loops) -> None:
    found = sr.loop(loops, periods=20, trajectories=1)
    assert not found.contradicts
    assert found.summary()["periods"] == 20
    assert found.constraints["control_step"][0] <= 1e-9
    assert found.uncovered == 0


def test_a_plan_that_ends_has_one_period(tmp_path) -> None:
    config = _integrator(repeat=False)
    with pytest.raises(sr.InputError, match="periods: expected 1 of a plan that ends at its horizon"):
        sr.loop(_run(tmp_path / "run", config), periods=2)


def test_a_controller_goes_on_after_the_horizon_and_knows_where_a_period_may_begin(loops) -> None:
    controller = sr.controller(loops)
    points = controller.breakpoints
    state = np.zeros(2)
    first = [controller.step(t, state if t == 0.0 else None) for t in points[:-1]]
    assert not controller.covered
    assert controller.ever_uncovered
    with pytest.raises(sr.InputError, match=r"^time: expected 2.0, the next breakpoint, got 0.0$"):
        controller.step(0.0, state)
    again = controller.step(2.0, state)  # one of the initial states: the proof holds for another period
    assert controller.covered
    assert controller.ever_uncovered
    assert again == pytest.approx(first[0])
    for t in points[1:-1]:
        controller.step(2.0 + t, None)
    controller.step(4.0, [0.31, 0.0])
    assert not controller.covered
    controller.reset()
    assert controller.covered
    assert not controller.ever_uncovered


@pytest.mark.slow
def test_a_plan_that_is_solved_anew_steps_to_the_next_period_too(tmp_path) -> None:
    config = _config(
        5,
        "open_loop",
        system={**MASS, "c": [0, 0.3]},
        horizon=5.0,
        initial_state={"centre": [0, 0], "box": [0.3, 0.3]},
        disturbance={"box": [0.01, 0.01]},
        path=[{"box": [0.45, None]}],
        control_step={"box": 0.1},
    )
    found = _run(tmp_path / "run", config)
    assert found.status == "certified"
    assert set(_verdicts(tmp_path / "run").values()) == {"holds"}
    A, B = np.array(MASS["A"], dtype=float), np.array(MASS["B"], dtype=float)
    block = np.zeros((4, 4))
    block[:2, :2], block[:2, 2:3], block[:2, 3] = A, B, [0, 0.3]
    flow = expm(block)
    controller = sr.controller(found, resolve=True)
    state, applied = np.array([-0.3, 0.3]), []
    for time in range(8):
        applied.append(controller.step(float(time), state)[0])
        state = (flow @ [*state, applied[-1], 1.0])[:2]
    assert not controller.ever_uncovered
    assert any(one.resolved for one in controller.steps)
    assert np.abs(np.diff(applied)).max() <= 0.1 + 1e-9


def test_one_coordinate_may_be_known_exactly(tmp_path) -> None:
    system = {"A": [[0, 0], [0, -1]], "B": [[1, 0], [0, 1]], "c": [-0.5, 0]}
    config = _config(2, "open_loop", system=system, horizon=1.0, initial_state={"centre": [1, 0], "box": [0, 0.5]})
    found = _run(tmp_path / "run", config)
    assert found.status == "certified"
    assert found.result.cost == pytest.approx(0.5, abs=1e-8)
    claim = next(one for one in sr.check(tmp_path / "run").claims if one.name == "repeat")
    assert claim.verdict == "holds"
    assert "in x1 to rounding" in claim.text


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"system": {"A": [[0]], "B": [[1]], "delay": 0.1}}, "problem.repeat: expected a control that acts at once"),
        ({"path": [{"box": 2.0, "name": "return"}]}, "problem.repeat: expected no path constraint named return"),
        ({"repeat": "maybe"}, "problem.repeat"),
    ],
)
def test_what_does_not_repeat_is_refused_in_one_sentence(keys, sentence) -> None:
    with pytest.raises(sr.InputError, match=sentence):
        sr.run(_integrator(**keys))


@pytest.mark.slow
def test_that_an_unstable_plant_cannot_be_kept_from_its_outputs_is_verified(tmp_path) -> None:
    """What gains can lower is told by how far their control can go, over deviations of very different sizes: noise,
    disturbance and initial states. A checker that told them by least squares regardless of these proved -104."""
    config = _config(
        11,
        cost="nominal",
        system={
            "A": [
                [0.468512442, 0.326384187, -0.576829585],
                [0.642605199, 0.420873396, 0.422984073],
                [0.447037562, 0.662608343, 1.345783437],
            ],
            "B": [[-0.611493123], [0.047211183], [1.754234682]],
            "E": [[-0.936585906], [0.227902128], [-0.482382401]],
        },
        horizon=3.193108054,
        control={"box": 3.0},
        disturbance={"box": 0.044571532},
        measurements={
            "C": [[0.474753246, -1.931101416, -0.992478278], [-1.405471083, -0.231095508, -0.688847085]],
            "noise": {"box": 0.023979747},
            "latency": 0.5,
        },
        path=[{"box": [1.5, 1.5, 1.5]}],
        initial_state={"centre": [0.0, 0.0, 0.0], "box": [0.3, 0.3, 0.3]},
    )
    outcome = _run(tmp_path / "run", config)
    assert outcome.status == "infeasible"
    assert _verdicts(tmp_path / "run")["infeasibility"] == "holds"


def test_a_flat_set_that_is_no_box_is_refused() -> None:
    flat = {"centre": [0, 0], "polytope": {"H": [[1, 1], [-1, -1], [1, 0], [-1, 0]], "h": [0, 0, 1, 1]}}
    with pytest.raises(sr.InputError, match="expected a set of initial states with an interior, or a box"):
        sr.run(_config(2, system=MASS, horizon=1.0, initial_state=flat))


def test_what_a_repeating_plan_cannot_be_asked() -> None:
    with pytest.raises(sr.InputError, match="initial_state is where a plan that repeats ends too"):
        sr.margin(_integrator(), of="initial_state")
    with pytest.raises(sr.InputError, match="horizon is the period"):
        sr.margin(_config(1, "open_loop", **_integrator()["problem"]), of="horizon")


def test_a_certificate_that_does_not_say_so_or_a_proof_that_is_gone_fails(tmp_path) -> None:
    _run(tmp_path / "run", _integrator())
    file = tmp_path / "run" / "certificate.json"
    honest = json.loads(file.read_text())
    assert honest["repeat"] is True
    for forged in (
        {name: value for name, value in honest.items() if name != "repeat"},
        {**honest, "repeat": 1},
        {**honest, "proof": {name: one for name, one in honest["proof"].items() if name != "return"}},
        {**honest, "gains": (0.9 * np.array(honest["gains"])).tolist()},
    ):
        file.write_text(json.dumps(forged))
        assert _verdicts(tmp_path / "run")["repeat"] == "fails"


def test_the_checker_finds_the_return_by_itself_whatever_the_records_say(tmp_path, monkeypatch) -> None:
    """A problem whose records had lost the return, or a wider one, is refuted or not checked."""
    found = _run(tmp_path / "run", _integrator())
    assert _verdicts(tmp_path / "run")["repeat"] == "holds"
    begun = cases.Case.__post_init__
    for kept in ((), (Return(sr.Box([-9.0], [9.0]), 1.0, 1.0, "return"),)):

        def without(self: cases.Case, kept: tuple[Return, ...] = kept) -> None:
            others = tuple(one for one in self.problem.path if not isinstance(one, Return))
            object.__setattr__(self.problem, "path", (*others, *kept))
            begun(self)

        monkeypatch.setattr(cases.Case, "__post_init__", without)
        assert _verdicts(tmp_path / "run")["return"] == "holds"
        assert _verdicts(tmp_path / "run")["repeat"] == "holds"
    assert found.problem.repeat


def test_a_state_that_is_alone_must_be_fixed_at_the_end(tmp_path, monkeypatch) -> None:
    keys = {"system": {"A": [[0]], "B": [[1]], "c": [-0.5]}, "horizon": 2.0, "initial_state": [0.7]}
    _run(tmp_path / "run", _config(2, "open_loop", **keys))
    assert _verdicts(tmp_path / "run")["repeat"] == "holds"
    monkeypatch.setattr(cases.Case, "equalities", property(lambda self: []))
    assert _verdicts(tmp_path / "run")["repeat"] == "fails"


def test_what_counts_as_no_violation_must_not_leave_the_initial_states(tmp_path, monkeypatch) -> None:
    _run(tmp_path / "run", _integrator())
    monkeypatch.setattr(returning, "INSIDE", 1e-10)  # what counts as no violation is then outside of the initial states
    assert _verdicts(tmp_path / "run")["repeat"] == "not checked"


def test_a_problem_that_repeats_is_said_and_solved_from_python(tmp_path) -> None:
    system = sr.LinearSystem([[0.0]], [[1.0]])
    problem = sr.OptimalControlProblem(
        system=system,
        horizon=1.0,
        initial_state=[2.0],
        initial_set=sr.Box([-1.0], [1.0]),
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.25], [0.25]),
        repeat=True,
    )
    assert isinstance(problem.path[-1], Return)
    assert len(replace(problem, title="again").path) == len(problem.path) == 1
    indicators = sr.Dictionary([0.0, 1.0], [[1.0]])
    program = sr.transcribe(problem, control=indicators, policy=sr.AffinePolicy(cost="peak"))
    found = sr.solve(program, method="exchange", solver="piqp")
    found.save(tmp_path / "run", figures=False)
    assert found.cost == pytest.approx(0.25, rel=1e-6)
    assert _verdicts(tmp_path / "run")["repeat"] == "holds"
