"""Guards control/loop/controller, resolving and remaining: no loop that begins in the proven set violates a
constraint, whatever drives it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.control.loop import resolving, retuning
from sparserob_core.control.loop.remaining import remaining_problem
from sparserob_core.control.loop.resolving import shift_cuts
from sparserob_core.control.studies.adversary import find_adversary
from sparserob_core.control.transcription.transcribe import in_own_units
from sparserob_core.sip.proof.branch_and_bound import prove

BASE = {
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
        "horizon": 3.0,
        "initial_state": [-1, 1],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.06, 0.06]},
        "path": [{"box": [0.7, None], "from": 0.5}],
        "terminal": [{"box": [0.3, 0.6]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 12}},
}
GAINS = {**BASE, "policy": {"name": "affine", "cost": "nominal"}}
PEAK = {**BASE, "policy": {"name": "affine", "cost": "peak"}}
EXACT = 1e-9


@pytest.fixture(scope="module")
def plans(tmp_path_factory) -> dict[str, sr.Outcome]:
    found = {}
    for name, config in (("open loop", BASE), ("nominal", GAINS), ("peak", PEAK)):
        found[name] = sr.run(config, out=tmp_path_factory.mktemp("runs") / "run", quiet=True, figures=False)
        assert found[name].status == "certified"
    return found


class Plant:
    """The exact system, piece by piece of the control, without any of the code that made the plan: a matrix
    exponential of the system with its inputs as states (Van Loan 1978), looked at within the pieces too."""

    def __init__(self, outcome: sr.Outcome) -> None:
        problem = outcome.problem
        self.problem, self.bounds = problem, outcome.experiment.control.breakpoints
        system = problem.system
        self.A, self.B, self.E = (
            np.asarray(one, dtype=float) for one in (system.phases[0].A, system.phases[0].B, system.phases[0].E)
        )

    def moved(self, state, u, w, length):
        """The states at ten times within a piece and at its end."""
        d = state.size
        block = np.zeros((d + 1, d + 1))
        block[:d, :d], block[:d, d] = self.A, self.B @ u + self.E @ w
        step = expm(block * length / 10)
        states, z = [], np.append(state, 1.0)
        for _ in range(10):
            z = step @ z
            states.append(z[:d])
        return states

    def violation(self, time, state):
        """How far a state is outside the sets of its time."""
        found = [-np.inf]
        found += [float(p.set.violation(state)) for p in self.problem.path if p.start - 1e-9 <= time <= p.stop + 1e-9]
        at_end = abs(time - self.problem.horizon) < 1e-9
        found += [float(one.violation(state)) for one in self.problem.terminal if at_end]
        return max(found)

    def loop(self, controller, disturb):
        """The largest violation, of the states and of the control, and the control that was applied."""
        controller.reset()
        state, worst, applied = np.array(self.problem.initial_state, dtype=float), -np.inf, []
        for k, (begin, end) in enumerate(zip(self.bounds[:-1], self.bounds[1:], strict=True)):
            u = controller.step(begin, state)
            applied.append(u)
            worst = max(worst, float(self.problem.control.violation(u)))
            for part, reached in enumerate(self.moved(state, u, disturb(k, state, controller), end - begin)):
                worst = max(worst, self.violation(begin + (end - begin) * (part + 1) / 10, reached))
            state = reached
        assert controller.covered
        return worst, np.array(applied).T


def adaptive(plan, k):
    """The first piece of the worst disturbance of the plan that is applied now: an adversary that learns of every
    plan."""
    model = plan.model
    found = [find_adversary(one, plan.decision, model.feedback) for one in model.constraints]
    worst = max(found, key=lambda one: one.violation)
    return worst.disturbance[:, k - plan.first]


def drives(outcome, rng):
    """Disturbances of the four laws, of the adversary, and of one that learns."""
    bound, pieces = outcome.problem.disturbance, outcome.experiment.control.pieces
    iid, vertices = bound.sample(pieces, rng), bound.sample_extreme(pieces, rng)
    slow = np.linspace(*bound.sample_extreme(2, rng), pieces)
    model = outcome.experiment.transcription
    yield lambda k, x, c: iid[k]
    yield lambda k, x, c: vertices[k]
    yield lambda k, x, c: slow[k]
    for constraint in model.constraints:
        w = find_adversary(constraint, outcome.result.decision, model.feedback).disturbance
        near = w.copy()
        near[:, rng.integers(pieces)] *= -1.0
        yield lambda k, x, c, w=w: w[:, k]
        yield lambda k, x, c, w=near: w[:, k]
    yield lambda k, x, c: adaptive(c.plan, k)


@pytest.mark.first(1)
@pytest.mark.parametrize("name", ["open loop", "nominal", "peak"])
@pytest.mark.parametrize("resolve", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_no_loop_violates_a_constraint(plans, name, resolve) -> None:
    plant, controller = Plant(plans[name]), sr.controller(plans[name], resolve)
    every = list(drives(plans[name], np.random.default_rng(0)))
    found = [plant.loop(controller, drive) for drive in (every[1::6] if resolve else every)]
    assert max(worst for worst, _ in found) <= EXACT


@pytest.mark.slow
@pytest.mark.parametrize("name", ["open loop", "nominal", "peak"])
def test_no_loop_of_ten_thousand_steps_violates_a_constraint(plans, name) -> None:
    plant, controller, rng, steps = Plant(plans[name]), sr.controller(plans[name]), np.random.default_rng(1), 0
    while steps < 10_000:
        for drive in drives(plans[name], rng):
            worst, _ = plant.loop(controller, drive)
            steps += 12
            assert worst <= EXACT


@pytest.mark.slow
def test_no_loop_of_many_steps_that_are_solved_anew_violates_a_constraint(plans) -> None:
    for name, outcome in plans.items():
        plant, controller, rng, steps = Plant(outcome), sr.controller(outcome, True), np.random.default_rng(2), 0
        while steps < 400:
            for drive in drives(outcome, rng):
                worst, _ = plant.loop(controller, drive)
                steps += 12
                assert worst <= EXACT, name


def test_an_open_loop_controller_tells_the_planned_control_whatever_it_measures(plans) -> None:
    outcome = plans["open loop"]
    rng = np.random.default_rng(3)
    _, applied = Plant(outcome).loop(sr.controller(outcome), lambda k, x, c: 0.06 * rng.uniform(-1, 1, 2))
    assert np.array_equal(applied, outcome.control)


@pytest.mark.parametrize("name", ["nominal", "peak"])
def test_without_a_disturbance_gains_add_nothing(plans, name) -> None:
    outcome = plans[name]
    _, applied = Plant(outcome).loop(sr.controller(outcome), lambda k, x, c: np.zeros(2))
    assert applied == pytest.approx(outcome.control, abs=1e-9)


@pytest.mark.parametrize("name", ["nominal", "peak"])
def test_the_control_is_the_gains_times_the_innovations(plans, name) -> None:
    outcome = plans[name]
    stored, plant = np.load(outcome.directory / "solution.npz"), Plant(outcome)
    w, rng = [], np.random.default_rng(4)

    def disturb(k, state, controller):
        w.append(0.06 * rng.uniform(-1, 1, 2))
        return w[-1]

    _, applied = plant.loop(sr.controller(outcome), disturb)
    lengths, zero = np.diff(plant.bounds), np.zeros(1)
    innovations = [np.zeros(2)] + [
        plant.moved(np.zeros(2), zero, one, length)[-1] for one, length in zip(w[:-1], lengths, strict=False)
    ]
    expected = stored["control"] + np.einsum("kjmd,jd->mk", stored["gains"], np.array(innovations))
    assert applied == pytest.approx(expected, abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["open loop", "nominal", "peak"])
def test_a_resolved_plan_is_taken_only_where_it_costs_less_than_what_is_left(plans, name) -> None:
    outcome = plans[name]
    plant, controller = Plant(outcome), sr.controller(outcome, True)
    _, applied = plant.loop(controller, lambda k, x, c: np.zeros(2))
    paid = float(np.abs(applied[0]) @ np.diff(plant.bounds))
    assert paid <= outcome.result.cost * (1.0 + 1e-6)
    if name == "open loop":  # a disturbance that did not come leaves room
        assert paid < 0.99 * outcome.result.cost
    resolved = [one for one in controller.steps if one.resolved]
    assert resolved or name == "nominal"  # what nothing disturbs is as good as it was
    assert all(one.lower_bound <= one.cost + 1e-9 for one in resolved)


def test_the_cost_that_a_policy_has_left_is_the_cost_of_its_program(plans) -> None:
    for name in ("nominal", "peak"):
        plan = sr.controller(plans[name]).plan
        assert plan.remaining_cost(0, [np.zeros(2)]) == pytest.approx(plans[name].result.cost, rel=1e-7)


def test_a_plan_that_was_solved_anew_offers_its_program_from_the_measured_state(plans) -> None:
    controller, state = sr.controller(plans["open loop"], True), np.array([-0.99, 1.0])
    controller.step(0.0, state)  # not the initial state of the problem: the old plan proves nothing
    state[:] = 7.0
    assert controller.covered
    plan = controller.plan
    assert np.asarray(plan.model.problem.initial_state).tolist() == [-0.99, 1.0]
    assert plan.model is plan.model
    assert all(proof.verdict == "proven" for proof in prove(plan.model.program, plan.decision))
    assert plan.model.program.cost(plan.decision) == pytest.approx(controller.steps[-1].cost, rel=1e-12)


@pytest.mark.parametrize("name", ["nominal", "peak"])
def test_under_feedback_what_is_left_begins_with_the_times_that_mattered(plans, name) -> None:
    plan = sr.controller(plans[name]).plan
    gap = float(plan.known.control.breakpoints[2])
    program = remaining_problem(plan.known, 2, np.array([-0.5, 0.5]), None).program.own_units.program
    times = np.array([cut.index[0] for cut in plan.cuts if cut.family == "path"])
    found = shift_cuts(plan.cuts, gap, program)
    assert found or (times < gap).all()
    for indices, _, family in found:
        one = program.family(family)
        assert family == "path"  # the control has all its rows from the beginning
        assert np.abs(times - indices[0, 0] * one.index_units[0] - gap).min() <= 1e-12
        assert np.abs(one.start - indices).min() > 1e-9  # what it begins with anyway is not imposed twice


def test_what_is_left_at_the_beginning_is_the_problem_itself(plans) -> None:
    for outcome in plans.values():
        model = outcome.experiment.transcription
        whole = remaining_problem(model, 0, np.array([-1.0, 1.0]), None)
        assert whole.program.cost(outcome.result.decision) == pytest.approx(outcome.result.cost)
        assert [one.name for one in whole.constraints] == [one.name for one in model.constraints]
        late = remaining_problem(model, 6, np.zeros(2), None)
        assert late.problem.horizon == pytest.approx(1.5)
        assert late.problem.path[0].start == 0.0
        assert [one.name for one in late.constraints] == [one.name for one in model.constraints]


def test_a_state_that_no_disturbance_leads_to_is_told_and_solved_anew(plans) -> None:
    for resolve in (False, True):
        controller = sr.controller(plans["nominal"], resolve)
        controller.step(0.0, [-1, 1])
        u = controller.step(0.25, [-0.6, 0.9])
        assert controller.covered is resolve  # a control is proven from there, so that the proof covers it again
        assert abs(u[0]) <= 1.0
        controller.reset()
        assert controller.covered
        u = controller.step(0.0, [40.0, 0.0])  # from where nothing is feasible
        assert not controller.covered
        assert abs(u[0]) <= 1.0


def test_without_time_the_plan_goes_on(plans) -> None:
    controller = sr.controller(plans["nominal"], True, seconds=1e-9)
    assert 0.0 < controller.prepared < 60.0
    assert sr.controller(plans["nominal"]).prepared == 0.0
    worst, applied = Plant(plans["nominal"]).loop(controller, lambda k, x, c: np.zeros(2))
    assert worst <= EXACT
    assert not any(one.resolved for one in controller.steps)
    assert applied == pytest.approx(plans["nominal"].control, abs=1e-9)


def test_a_step_that_is_refused_changes_nothing(plans) -> None:
    controller = sr.controller(plans["nominal"])
    with pytest.raises(sr.InputError, match=r"^time: expected 0, since it begins there, got 0.25$"):
        controller.step(0.25, [-1, 1])
    first = controller.step(0.0, [-1, 1])
    with pytest.raises(sr.InputError, match=r"^time: expected 0.25, the next breakpoint, got 0.0$"):
        controller.step(0.0, [-1, 1])
    for state in ([-0.7], [[1, 2]], [np.nan, 0], [np.inf, 0], "here"):
        with pytest.raises(sr.InputError, match=r"^state: expected 2 finite numbers, one per state"):
            controller.step(0.25, state)
    for time in (None, "0.25", True, np.nan):
        with pytest.raises(sr.InputError, match=r"^time: expected 0.25"):
            controller.step(time, [-1, 1])
    controller.step(0.25 + 1e-10, [-0.75, 1.2])
    assert len(controller.steps) == 2
    controller.reset()
    assert np.array_equal(controller.step(0.0, [-1, 1]), first)


@pytest.mark.parametrize("kind", ["open loop", "nominal", "peak"])
def test_a_missing_measurement_is_an_innovation_of_0(plans, kind) -> None:
    """Told nothing at all, the control is the nominal one; told nothing once, it is that of the state as predicted."""
    controller = sr.controller(plans[kind])
    points = controller.breakpoints[:-1]
    applied = np.array([controller.step(t, None) for t in points]).T
    nominal = plans[kind].control
    assert applied == pytest.approx(nominal, abs=1e-12)
    assert not controller.covered
    assert controller.ever_uncovered
    plant, told = Plant(plans[kind]), sr.controller(plans[kind])
    controller.reset()
    state = np.array([-1.0, 1.0])
    length = points[1]
    for k, t in enumerate(points[:6]):
        seen = told.step(t, state)
        assert controller.step(t, None if k == 3 else state) == pytest.approx(seen, abs=1e-12)
        w = 0.05 * np.ones(2) if k != 2 else np.zeros(2)  # the state that is not told is as predicted
        state = plant.moved(state, seen, w, length)[-1]
    assert told.covered
    assert not told.ever_uncovered
    assert not controller.covered


def test_what_is_not_covered_is_not_forgotten_where_a_new_plan_covers_the_rest(plans) -> None:
    controller = sr.controller(plans["open loop"], resolve=True)
    controller.step(0.0, [-1, 1])
    assert not controller.ever_uncovered
    controller.step(0.25, None)
    assert not controller.steps[-1].resolved
    assert not controller.covered
    controller.step(0.5, [-0.45, 1.0])
    assert controller.covered
    assert controller.ever_uncovered
    controller.reset()
    assert not controller.ever_uncovered


def test_a_spike_is_told_and_forgotten_by_the_state_after_it(plans) -> None:
    """A spike ``s`` gives innovations ``s`` and ``-Phi s``; what is told as missing gives none."""
    plant, state = Plant(plans["peak"]), np.array([-1.0, 1.0])
    believed, missing = sr.controller(plans["peak"]), sr.controller(plans["peak"])
    for t in believed.breakpoints[:4]:
        spike = np.array([0.5, 0.0]) * (t == believed.breakpoints[2])
        u = missing.step(t, None if spike.any() else state)
        seen = believed.step(t, state + spike)
        assert (np.abs(seen) <= 1.0).all()
        assert believed.covered is bool(t < believed.breakpoints[2])
        if not spike.any() and t < believed.breakpoints[2]:
            assert seen == pytest.approx(u)
        state = plant.moved(state, u, np.zeros(2), 0.25)[-1]
    assert np.isfinite(u).all()


def test_after_the_horizon_it_asks_for_a_reset(plans) -> None:
    controller = sr.controller(plans["open loop"])
    for time in controller.breakpoints[:-1]:
        controller.step(time, [0, 0])
    with pytest.raises(sr.InputError, match=r"reset\(\) first, since the horizon 3 is over"):
        controller.step(3.0, [0, 0])


def test_what_cannot_be_solved_anew_is_refused_in_one_sentence() -> None:
    haar = {**BASE, "dictionaries": {"control": {"name": "haar", "pieces": 8}}}
    delayed = {**BASE, "problem": {**BASE["problem"], "system": {**BASE["problem"]["system"], "delay": 0.1}}}
    for config, said in ((haar, "indicators"), (delayed, "without a delay")):
        with pytest.raises(sr.InputError, match=f"^resolve: .*{said}"):
            sr.controller(config, True)
        controller = sr.controller(config)
        plan = controller.plan
        controller.step(0.0, [-1, 1])
        assert plan.first == 0


def test_a_controller_needs_a_proven_control() -> None:
    hopeless = {**BASE, "problem": {**BASE["problem"], "disturbance": {"box": [5, 5]}}}
    with pytest.raises(sr.InputError, match=r"no proven control to apply; the status is 'infeasible'"):
        sr.controller(hopeless)
    with pytest.raises(sr.InputError, match=r"^config: expected a config"):
        sr.controller(3)
    with pytest.raises(sr.InputError, match=r"^resolve: expected true or false"):
        sr.controller(BASE, "yes")
    with pytest.raises(sr.InputError, match=r"^seconds"):
        sr.controller(BASE, seconds=1.0)


def test_a_disturbance_that_is_not_one_of_the_set_is_told_at_the_next_step() -> None:
    ball = {**GAINS, "policy": {"name": "open_loop"}}
    ball["problem"] = {**GAINS["problem"], "disturbance": {"ellipsoid": {"shape": [[0.0036, 0], [0, 0.0036]]}}}
    controller = sr.controller(ball)
    A, B = np.array([[0, 1], [-2, -0.5]]), np.array([0.0, 1.0])
    radius = float(controller.plan.model.problem.disturbance.support(np.array([[1.0, 0.0]]))[0])
    for share, covered in ((0.70, True), (0.80, False)):  # of the radius in each coordinate: inside, and in a corner
        controller.reset()
        u, state = controller.step(0.0, [-1, 1]), np.array([-1.0, 1.0, 1.0])
        block = np.zeros((3, 3))
        block[:2, :2], block[:2, 2] = A, B * u[0] + share * radius
        state = expm(block * 0.25) @ state
        controller.step(0.25, state[:2])
        assert controller.covered is covered


@pytest.mark.parametrize("disturbed", [{}, {"disturbance": {"box": [1e-3, 1e-3]}}])
def test_a_control_that_is_delivered_with_an_admissible_error_is_covered(disturbed: dict[str, object]) -> None:
    problem = {name: value for name, value in BASE["problem"].items() if name != "disturbance"}
    controller = sr.controller({**BASE, "problem": {**problem, **disturbed, "execution": [0.05]}})
    A, B = np.array([[0, 1], [-2, -0.5]]), np.array([0.0, 1.0])
    state, moved = np.array([-1.0, 1.0]), 0.0
    for k in range(12):
        u = controller.step(k * 0.25, state)
        moved = max(moved, abs(u[0]))
        block = np.zeros((3, 3))
        block[:2, :2], block[:2, 2] = A, B * 1.05 * u[0]
        state = (expm(block * 0.25) @ np.append(state, 1.0))[:2]
    assert moved > 0.1  # there was an error
    assert controller.covered and not controller.ever_uncovered


@pytest.mark.parametrize("bound", [{"norm": {"p": 1.5, "radius": 1.0}}, {"ellipsoid": {"shape": [[1, 0.5], [0.5, 1]]}}])
def test_a_state_from_nowhere_is_answered_within_a_curved_set_of_controls(bound: dict[str, object]) -> None:
    changed = {"system": {**BASE["problem"]["system"], "B": [[0, 0.2], [1, 0.3]]}, "control": bound}
    controller = sr.controller({**GAINS, "problem": {**BASE["problem"], **changed}})
    controls, state, outside = controller.plan.model.problem.control, np.array([-1.0, 1.0]), 0
    for k in range(12):
        nominal = controller.plan.model.pieces(controller.plan.decision)[:, k]
        u = controller.step(k * 0.25, state)
        assert float(controls.violation(u)) <= 1e-12
        outside += float(controls.violation(nominal + 1.01 * (u - nominal))) > 0.0
        state = np.array([9.0, -9.0])
    assert not controller.covered
    assert outside  # a control at the edge: as much of the answer as there is room for


def test_a_disturbance_that_changes_within_its_own_piece_is_told() -> None:
    pieces = {"control": 12, "disturbance": 6}
    coarse = {**GAINS, "dictionaries": {k: {"name": "piecewise_constant", "pieces": n} for k, n in pieces.items()}}
    controller = sr.controller(coarse)
    A, B = np.array([[0, 1], [-2, -0.5]]), np.array([0.0, 1.0])
    for second, covered in ((0.05, True), (-0.05, False)):
        controller.reset()
        state = np.array([-1.0, 1.0])
        for k, w in enumerate((0.05, second, 0.0)):
            u = controller.step(k * 0.25, state)
            block = np.zeros((3, 3))
            block[:2, :2], block[:2, 2] = A, B * u[0] + w
            state = (expm(block * 0.25) @ np.append(state, 1.0))[:2]
        assert controller.covered is covered


POLYTOPE = {"polytope": {"H": [[1, 1], [-1, 0], [0, -1]], "h": [0.06, 0.05, 0.05]}}


@pytest.mark.first(1)
@pytest.mark.parametrize("disturbance", [{"box": [0.05, 0.05]}, {"norm": {"p": 1.5, "radius": 0.05}}, POLYTOPE])
@pytest.mark.parametrize("policy", [pytest.param("affine", marks=pytest.mark.slow), "open_loop"])
def test_with_a_limit_nothing_is_written_down_and_nothing_hopeless_begun_in_a_step(
    policy: str, disturbance: dict, tmp_path, monkeypatch
) -> None:
    """Of every kind of disturbance, whether its gains can be kept or not: steps of a limit that nothing can keep only
    apply what was made before."""
    problem = {**BASE["problem"], "disturbance": disturbance}
    few = {"control": {"name": "piecewise_constant", "pieces": 4}}
    config = {**BASE, "problem": problem, "dictionaries": few, "policy": {"name": policy}}
    outcome = sr.run(config, out=tmp_path / "run", quiet=True, figures=False)
    assert outcome.status == "certified"
    written, begun = [], []
    for module in (resolving, retuning):
        monkeypatch.setattr(
            module, "remaining_problem", lambda *a, **k: (written.append(a[1]), remaining_problem(*a, **k))[1]
        )
    monkeypatch.setattr(resolving, "in_own_units", lambda model: (begun.append(model), in_own_units(model))[1])
    controller = sr.controller(outcome, True, seconds=1e-6)
    assert written  # before the first step
    written.clear()
    begun.clear()
    state = np.array(problem["initial_state"], dtype=float)
    for _ in range(2):
        controller.reset()
        for time in controller.breakpoints[:-1]:
            controller.step(float(time), state)
    assert not written
    assert not begun


def test_a_limit_that_is_long_enough_is_used(plans, monkeypatch) -> None:
    controller, written = sr.controller(plans["nominal"], True, seconds=1e6), []
    monkeypatch.setattr(
        resolving, "remaining_problem", lambda *a, **k: (written.append(a[1]), remaining_problem(*a, **k))[1]
    )
    controller.step(0.0, np.array([-1.0, 1.0]))
    assert written == [0]
