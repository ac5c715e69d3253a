"""Guards measurements of outputs: known margins, a linear program of its own, a loop that is stepped by hand, bounds of
causal policies, forged certificates, controllers."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from tests.archive.store import unpack
from tests.support.output_programs import OutputProgram
from tests.support.problems import double_integrator, spring

SHORT: dict[str, Any] = {
    **double_integrator(0.05),
    "horizon": 2.0,
    "initial_state": [0.3, 0.0],
    "control": {"box": 2.0},
    "path": [{"box": [1.0, 1.0]}],
    "terminal": [{"box": [0.2, 0.2]}],
}
POSITION = {"C": [[1, 0]], "noise": {"box": 0.02}}


def config(problem: dict[str, Any], measured: dict[str, Any] | None, pieces: int, **policy: Any) -> dict[str, Any]:
    known = {} if measured is None else {"measurements": measured}
    return {
        "problem": {**problem, **known},
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
        "policy": {"name": "affine", "causal_signals": 0, **policy},
        "observers": [],
    }


def run(problem: dict[str, Any], measured: dict[str, Any] | None, out: Path, pieces: int = 4, **policy: Any) -> Any:
    return sr.run(config(problem, measured, pieces, **policy), out=out, quiet=True, figures=False)


def proven(outcome: sr.Outcome) -> None:
    assert outcome.status == "certified", outcome.result.message
    found = sr.check(outcome.directory)
    assert found.status == "verified", [claim for claim in found.claims if claim.verdict != "holds"]


def test_whole_states_without_noise_are_what_is_measured_anyway(tmp_path: Path) -> None:
    plain = run(SHORT, None, tmp_path / "plain", cost="peak")
    same = run(SHORT, {"C": [[1, 0], [0, 1]]}, tmp_path / "same", cost="peak")
    with np.load(plain.directory / "solution.npz") as one, np.load(same.directory / "solution.npz") as other:
        assert set(other.files) - set(one.files) == {"observer"}
        assert all(np.array_equal(one[name], other[name]) for name in one.files)
        flow = expm(np.array([[0.0, 1.0], [0.0, 0.0]]) * 0.5)
        assert np.allclose(other["observer"][:-1], flow, atol=1e-15)
    proven(same)


def test_what_is_measured_in_other_coordinates_costs_the_same(tmp_path: Path) -> None:
    plain = run(SHORT, None, tmp_path / "plain")
    turned = run(SHORT, {"C": [[2, 1], [0, 100]]}, tmp_path / "turned")
    assert turned.result.cost == pytest.approx(plain.result.cost, rel=1e-7)
    proven(turned)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("measured", "low", "high"),
    [
        ({"C": [[1, 0]]}, 0.234907, 0.234909),
        ({"C": [[1, 0], [0, 1]], "noise": {"box": 0.02}}, 0.2823, 0.2825),
        ({"C": [[1, 0]], "noise": {"box": 0.01}}, 0.2130, 0.2131),
        ({"C": [[1, 0]], "noise": {"box": 0.02}}, 0.1986, 0.1988),
        ({"C": [[1, 0]], "noise": {"box": 0.05}}, 0.1684, 0.1685),
    ],
)
def test_the_largest_disturbances_are_those_that_were_found_elsewhere(measured, low, high) -> None:
    """Values of linear programs of another hand, to four digits where there is a noise."""
    problem = {**spring(0.1, since=0.5), "disturbance": {"box": 0.1}}
    found = sr.margin(config(problem, measured, 20), of="disturbance")
    assert low <= 0.1 * found.lower <= 0.1 * found.upper <= high


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("C", "noise", "late"),
    [([[1, 0]], 0.02, 0), ([[1, 0]], 0.01, 1), ([[1, 0], [0, 1]], 0.03, 1), ([[1, 0.5]], 0.0, 0)],
)
def test_a_linear_program_in_purified_outputs_says_the_same(C, noise, late, tmp_path: Path) -> None:
    measured = {"C": C, "latency": 0.5 * late, **({"noise": {"box": noise}} if noise else {})}
    outcome = run(SHORT, measured, tmp_path / "run")
    proven(outcome)
    assert outcome.result.cost == pytest.approx(
        OutputProgram(SHORT, 4, np.array(C, dtype=float), noise, late, 2).least(), rel=1e-6
    )


def stepped(directory: Path, problem: dict[str, Any], w: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States at twenty times a piece, and the control, of a loop that is stepped by hand from what the run has written:
    a double integrator under disturbances ``w (K,)``, outputs with noises ``v (K, p)``."""
    with np.load(directory / "solution.npz") as found:
        nominal, gains, L = found["control"], found["gains"], found["observer"]
    C, K = np.array(problem["measurements"]["C"], dtype=float), w.size
    h, x = problem["horizon"] / K, np.array(problem["initial_state"], dtype=float)
    predicted, seen, path, applied = x.copy(), [], [x], []
    for k in range(K):
        seen.append(C @ x + v[k] - C @ predicted)
        u = nominal[:, k] + sum(gains[k, j] @ seen[j] for j in range(k + 1))
        applied.append(float(u[0]))
        steps = np.arange(1, 21) * h / 20
        path += [np.array([x[0] + s * x[1] + s * s / 2 * (u[0] + w[k]), x[1] + s * (u[0] + w[k])]) for s in steps]
        x = path[-1]
        predicted = np.array([predicted[0] + h * predicted[1] + h * h / 2 * u[0], predicted[1] + h * u[0]])
        predicted = predicted + L[k] @ seen[k]
    return np.array(path), np.array(applied)


@pytest.mark.first(1)
@pytest.mark.parametrize("cost", ["nominal", "peak"])
def test_a_loop_that_is_stepped_by_hand_keeps_every_wall_and_meets_its_worst_case(cost: str, tmp_path: Path) -> None:
    problem = {**SHORT, "measurements": {**POSITION, "latency": 0.5}}
    outcome = run(SHORT, problem["measurements"], tmp_path / "run", cost=cost)
    proven(outcome)
    rng, most = np.random.default_rng(0), np.full(2, -np.inf)
    draws = [(rng.choice([-0.05, 0.05], 4), rng.choice([-0.02, 0.02], (4, 1))) for _ in range(40)]
    with np.load(outcome.directory / "adversary.npz") as worst:
        for number, name in enumerate(worst["names"].tolist()):
            path, _ = stepped(outcome.directory, problem, worst["disturbances"][number, 0], worst["noises"][number])
            if name == "terminal":
                reached = float(worst["directions"][number] @ path[-1] - worst["bounds"][number])
                assert reached == pytest.approx(worst["violations"][number], abs=1e-9)
    for w, v in draws:
        path, control = stepped(outcome.directory, problem, w, v)
        assert (np.abs(path) <= 1.0 + 1e-9).all() and (np.abs(path[-1]) <= 0.2 + 1e-9).all()
        assert (np.abs(control) <= 2.0 + 1e-9).all()
        most = np.maximum(most, np.abs(path[-1]))
    assert (most > 0.1).any()  # the walls are not far from what happens


@pytest.mark.first(1)
@pytest.mark.parametrize("cost", ["nominal", "peak", "worst"])
def test_no_causal_policy_is_cheaper_than_what_its_signals_prove(cost: str, tmp_path: Path) -> None:
    quick = run(SHORT, POSITION, tmp_path / "quick", cost=cost, causal_signals=20)
    slow = run(SHORT, {**POSITION, "latency": 1.0}, tmp_path / "slow", cost=cost, causal_signals=20)
    for outcome in (quick, slow):
        proven(outcome)
        assert 0.0 < outcome.result.causal.lower <= outcome.result.cost * (1 + 1e-9)
    assert quick.result.causal.lower <= slow.result.causal.lower * (1 + 1e-9)


@pytest.mark.first(1)
@pytest.mark.parametrize("measured", [None, POSITION])
def test_what_costs_nothing_costs_no_causal_policy_less(measured, tmp_path: Path) -> None:
    problem = {**SHORT, "initial_state": [0.0, 0.0], "disturbance": {"box": 0.001}}
    outcome = run(problem, measured, tmp_path / "run", causal_signals=5)
    proven(outcome)
    assert outcome.result.cost == 0.0 and outcome.summary["causal_lower_bound"] == 0.0


def test_what_is_never_known_is_not_answered(tmp_path: Path) -> None:
    """An open loop, then; a certificate that answers it is a forgery."""
    problem = {**SHORT, "terminal": [{"box": [0.4, 0.4]}]}
    late, alone = ({**POSITION, "latency": 1.9}, None)
    outcome = run(problem, late, tmp_path / "late")
    proven(outcome)
    plain = run(problem, alone, tmp_path / "plain", memory=0.0)
    assert outcome.result.cost >= plain.result.cost * (1 - 1e-9)
    assert not (outcome.directory / "solution.npz").read_bytes().count(b"gains")


def _bound(data: dict[str, Any]) -> dict[str, Any]:
    return max(data["multipliers"]["constraints"], key=lambda one: one["multiplier"])


FORGERIES = {
    "a gain that answers too early": lambda data: data["gains"][1][1].__setitem__(0, [0.5]),
    "another observer": lambda data: data["observer"][0].__setitem__(0, [data["observer"][0][0][0] + 0.3]),
    "no observer": lambda data: data.pop("observer"),
    "an observer of another shape": lambda data: data["observer"].pop(),
    "larger gains": lambda data: data.update(gains=(np.array(data["gains"]) * 1.5).tolist()),
    "a noise outside of its set": lambda data: _bound(data)["noise"][1].__setitem__(0, 0.03),
    "no noise": lambda data: _bound(data).pop("noise"),
    "a noise of another shape": lambda data: _bound(data)["noise"].pop(),
    "a noise that does nothing": lambda data: [
        one.update(noise=[[0.0]] * 4) for one in data["multipliers"]["constraints"]
    ],
}


@pytest.fixture(scope="module")
def honest(tmp_path_factory) -> Path:
    outcome = run(SHORT, {**POSITION, "latency": 0.5}, tmp_path_factory.mktemp("outputs") / "run")
    proven(outcome)
    return outcome.directory


@pytest.mark.first(4)
@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_certificate_is_found(name: str, honest: Path, tmp_path: Path) -> None:
    shutil.copytree(honest, tmp_path / "run")
    file = tmp_path / "run" / "certificate.json"
    data = json.loads(file.read_text())
    FORGERIES[name](data)
    file.write_text(json.dumps(data))
    assert sr.check(tmp_path / "run").status == "refuted"


HIDDEN = {
    "outputs of no noise in its set": lambda causal: causal["outputs"][0][1].__setitem__(0, 5.0),
    "a little more than a noise hides": lambda causal: causal["outputs"][0][9].__setitem__(
        0, causal["outputs"][0][9][0] + 4e-9
    ),
    "an output too few": lambda causal: causal["outputs"][0].pop(),
    "a signal without outputs": lambda causal: causal["outputs"].pop(),
    "a signal that begins nowhere": lambda causal: causal["initial_states"].pop(),
    "no outputs": lambda causal: [causal.pop("outputs"), causal.pop("initial_states")],
    "a higher bound": lambda causal: causal.update(lower_bound=causal["lower_bound"] + 1e-6),
    "a worse disturbance": lambda causal: [signal[0].__setitem__(1, -0.05) for signal in causal["signals"]],
}
"""Changes of a bound that an earlier version derived from what a noise hides."""


@pytest.mark.parametrize("name", [None, *HIDDEN])
def test_a_bound_that_hides_what_no_noise_can_is_found(name: str | None, tmp_path: Path) -> None:
    directory = unpack("config-output_feedback", tmp_path)
    file = directory / "certificate.json"
    data = json.loads(file.read_text())
    if name is not None:
        HIDDEN[name](data["causal"])
    file.write_text(json.dumps(data))
    verdicts = {one.name: one.verdict for one in sr.check(directory).claims}
    assert verdicts["causal"] == ("holds" if name is None else "fails")


@pytest.mark.parametrize("name", ["gains", "observer"])
def test_what_a_certificate_leaves_out_is_not_what_a_solution_holds(name: str, honest: Path, tmp_path: Path) -> None:
    shutil.copytree(honest, tmp_path / "run")
    file = tmp_path / "run" / "certificate.json"
    data = json.loads(file.read_text())
    del data[name]
    file.write_text(json.dumps(data))
    verdicts = {one.name: one.verdict for one in sr.check(tmp_path / "run").claims}
    assert verdicts["solution.npz"] == "fails"


def test_a_controller_is_told_outputs_and_says_when_they_cannot_be(honest: Path) -> None:
    controller = sr.controller(str(honest))
    u = controller.step(0.0, [0.31])
    assert controller.covered and np.isfinite(u).all()
    controller.step(0.5, [2.0])
    assert not controller.covered
    controller.reset()
    with pytest.raises(sr.InputError, match="output"):
        controller.step(0.0, [0.3, 0.0])
    with pytest.raises(sr.InputError, match="outputs"):
        sr.controller(str(honest), resolve=True)


def test_loops_and_simulations_have_noise_and_violate_nothing(honest: Path) -> None:
    found = sr.loop(str(honest), trajectories=3)
    assert found.uncovered == 0
    assert all(largest <= most for largest, most in found.constraints.values())
    for law in ("iid", "vertices", "slow"):
        assert all(one.violated == 0 for one in sr.simulate(str(honest), 200, law=law).constraints)


MORE: dict[str, dict[str, Any]] = {
    "delay": {"system": {**SHORT["system"], "delay": 0.25}},
    "drift": {"system": {**SHORT["system"], "c": [0.0, -0.05]}},
    "pieces": {
        "system": {
            "pieces": [
                {"until": 0.75, **SHORT["system"]},
                {"until": 2.0, "A": [[0, 1], [-0.5, 0]], "B": [[0], [1]], "E": [[0], [1]]},
            ]
        }
    },
    "initial set": {"initial_state": {"centre": [0.3, 0.0], "box": [0.02, 0.01]}},
    "steps": {"control_step": {"box": 0.8}, "initial_control": [0.0]},
    "mixed": {"path": [{"mixed": {"H": [[0, 1]], "G": [[0.2]], "h": [0.6]}}, {"box": [1.0, 1.0]}]},
    "curved control": {"control": {"norm": {"p": 2, "radius": 2.0}}},
    "fixed": {"terminal": [{"equals": [None, None]}, {"box": [0.2, 0.2]}]},
    "moving": {"path": [{"box": [1.0, 1.0], "relative_to": [[0, 0, 0], [2, 0.1, 0]]}]},
    "round noise": {"measurements": {"C": [[1, 0], [0, 1]], "noise": {"norm": {"p": 2, "radius": 0.02}}}},
    "uneven noise": {"measurements": {"C": [[1, 0]], "noise": {"box": {"lower": [-0.01], "upper": [0.03]}}}},
    "no disturbance": {"disturbance": None},
}


@pytest.mark.slow
@pytest.mark.parametrize("cost", ["nominal", "peak", "worst"])
@pytest.mark.parametrize("name", MORE)
def test_outputs_go_with_everything_that_states_go_with(name: str, cost: str, tmp_path: Path) -> None:
    problem = {**SHORT, "measurements": POSITION, **MORE[name]}
    problem = {key: value for key, value in problem.items() if value is not None}
    outcome = run(problem, problem["measurements"], tmp_path / "run", cost=cost, causal_signals=10)
    proven(outcome)
    found = sr.loop(outcome.directory, trajectories=2)
    assert found.uncovered == 0 and all(largest <= most for largest, most in found.constraints.values())


@pytest.mark.first(1)
@pytest.mark.parametrize("unit", [1e-6, 1e3])
def test_other_units_change_nothing(unit: float, tmp_path: Path) -> None:
    """Lengths in other units, of outputs too."""
    scaled = {
        **SHORT,
        "initial_state": [0.3 * unit, 0.0],
        "control": {"box": 2.0 * unit},
        "disturbance": {"box": 0.05 * unit},
        "path": [{"box": [unit, unit]}],
        "terminal": [{"box": [0.2 * unit, 0.2 * unit]}],
    }
    plain = run(SHORT, POSITION, tmp_path / "plain")
    other = run(scaled, {"C": [[1, 0]], "noise": {"box": 0.02 * unit}}, tmp_path / "other")
    assert other.result.cost == pytest.approx(unit * plain.result.cost, rel=1e-7)
    proven(other)


@pytest.mark.parametrize(
    ("measured", "key"),
    [
        ({"C": [[1, 0, 0]]}, "measurements.C"),
        ({"C": [[1, 0], [1]]}, "measurements.C"),
        ({"C": [[0, 0]]}, "measurements.C.0"),
        ({"C": [[1, 0]], "noise": {"box": [0.1, 0.1]}}, "measurements.noise"),
        ({"C": [[1, 0]], "noise": {"polytope": {"H": [[1]], "h": [1]}}}, "measurements.noise"),
        ({"C": [[1, 0]], "latency": 2.0}, "measurements.latency"),
    ],
)
def test_what_cannot_be_measured_is_an_error_of_its_key(measured, key: str, tmp_path: Path) -> None:
    with pytest.raises(sr.InputError) as error:
        run(SHORT, measured, tmp_path / "run")
    assert key in str(error.value)


def test_a_problem_with_outputs_is_a_config_and_back(tmp_path: Path) -> None:
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0, 1], [0, 0]], [[0], [1]], [[0], [1]]),
        horizon=2.0,
        initial_state=[0.3, 0.0],
        control=sr.Box([-2.0], [2.0]),
        disturbance=sr.Box([-0.05], [0.05]),
        terminal=[sr.Box([-0.2, -0.2], [0.2, 0.2])],
        measurements=sr.Measurements([[1, 0]], sr.Box([-0.02], [0.02]), 0.5),
    )
    result = sr.solve(
        problem, control={"name": "piecewise_constant", "pieces": 4}, policy=sr.AffinePolicy(causal_signals=0)
    )
    result.save(tmp_path / "run", figures=False)
    assert sr.check(tmp_path / "run").status == "verified"
    told = run({**SHORT, "path": []}, {**POSITION, "latency": 0.5}, tmp_path / "told")
    assert told.result.cost == pytest.approx(result.cost, rel=1e-9)
