"""Guards policy affine: known values, an independent linear program on a fine grid, all kinds of disturbances and
grids, closed loops that measure, forged certificates, other units."""

from __future__ import annotations

import json
import pickle
import re
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog
from scipy.sparse import coo_array

import sparserob_core as sr
from sparserob_core.control.studies.answer import ControlResult
from sparserob_core.experiment.assemble import ControlExperiment, assemble, tools_of
from sparserob_core.experiment.check.check import check
from sparserob_core.experiment.config.load import load_config
from sparserob_core.sip.working.scaled import largest_factor, least_slack
from tests.support.places import CONFIGS, ROOT
from tests.support.problems import double_integrator, spring

SPRING = spring(0.25, since=0.5)
DOUBLE = double_integrator(0.1)
MASSES: dict[str, Any] = {
    "name": "linear",
    "system": {
        "A": [[0, 0, 1, 0], [0, 0, 0, 1], [-2, 1, -0.1, 0], [1, -2, 0, -0.1]],
        "B": [[0, 0], [0, 0], [1, 0], [0, 1]],
        "E": [[0, 0], [0, 0], [1, 0], [0, 1]],
    },
    "horizon": 6.0,
    "initial_state": [0.8, 0.3, 0.4, -0.2],
    "control": {"box": 0.6},
    "disturbance": {"box": [0.1, 0.1]},
    "path": [{"polytope": {"H": [[1, -1, 0, 0], [-1, 1, 0, 0]], "h": [0.5, 0.5]}, "from": 0.5}],
    "terminal": [{"box": [0.2, 0.2, 0.2, 0.2]}],
}


def config(problem: dict[str, Any], pieces: int, cost: str = "nominal", **more: Any) -> dict[str, Any]:
    disturbance = more.pop("disturbance", None)
    dictionaries: dict[str, Any] = {"control": {"name": "piecewise_constant", "pieces": pieces}}
    if disturbance is not None:
        dictionaries["disturbance"] = {"name": "piecewise_constant", "pieces": disturbance}
    policy = {"name": "affine", "cost": cost, **more.pop("policy", {})}
    return {"problem": problem, "dictionaries": dictionaries, "policy": policy, "observers": [], **more}


def run(problem: dict[str, Any], pieces: int, out: Path, cost: str = "nominal", **more: Any) -> sr.Outcome:
    return sr.run(config(problem, pieces, cost, **more), out=out, quiet=True, figures=False)


def springs(w: float, start: float) -> dict[str, Any]:
    return {**SPRING, "disturbance": {"box": [w, w]}, "path": [{"box": [0.7, None], "from": start}]}


def proven(outcome: sr.Outcome) -> None:
    """The run is certified, and its check holds."""
    assert outcome.status == "certified", outcome.result.message
    found = check(outcome.directory)
    assert found.status == "verified", [claim for claim in found.claims if claim.verdict != "holds"]


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("problem", "pieces", "cost", "value"),
    [
        ({**DOUBLE, "disturbance": {"box": 0.1}}, 20, "nominal", 1.195),
        ({**DOUBLE, "disturbance": {"box": 0.3}}, 20, "nominal", 1.31346154),
        ({**DOUBLE, "disturbance": {"box": 0.2}}, 20, "peak", 2.33846154),
        (springs(0.2, 0.3), 20, "peak", 2.17147527),
        ({**MASSES, "disturbance": {"box": [0.08, 0.08]}}, 12, "peak", 1.86338920),
        pytest.param(springs(0.3, 0.5), 40, "nominal", 0.54529401, marks=pytest.mark.slow),
        pytest.param(springs(0.2, 0.3), 40, "peak", 2.08708204, marks=pytest.mark.slow),
        pytest.param(springs(0.25, 0.5), 40, "peak", 2.61864192, marks=pytest.mark.slow),
        pytest.param(
            {**MASSES, "disturbance": {"box": [0.15, 0.15]}}, 16, "nominal", 1.04791863, marks=pytest.mark.slow
        ),
    ],
)
def test_known_values_are_met_and_certified(
    problem: dict[str, Any], pieces: int, cost: str, value: float, tmp_path: Path
) -> None:
    outcome = run(problem, pieces, tmp_path / "run", cost)
    proven(outcome)
    assert outcome.result.cost == pytest.approx(value, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("problem", "pieces", "cost", "value", "within"),
    [
        (springs(0.3, 0.5), 20, "nominal", 0.74611518, 2e-6),
        pytest.param(springs(0.25, 0.5), 20, "peak", 2.68082505, 6e-6, marks=pytest.mark.slow),
        pytest.param(springs(0.25, 0.3), 20, "nominal", 0.79648774, 2e-5, marks=pytest.mark.slow),
        pytest.param(springs(0.35, 0.5), 40, "nominal", 0.87352974, 4e-6, marks=pytest.mark.slow),
        pytest.param(
            {**MASSES, "disturbance": {"box": [0.1, 0.1]}}, 12, "nominal", 1.16782006, 2e-6, marks=pytest.mark.slow
        ),
    ],
)
def test_references_that_saw_times_less_densely_are_lower_bounds(
    problem: dict[str, Any], pieces: int, cost: str, value: float, within: float, tmp_path: Path
) -> None:
    """These values come from programs that impose the path at finitely many times; a proof over all times costs more.
    A program with 40 times a piece, for the third of them, gives 0.7964988 where all times give 0.7964993."""
    outcome = run(problem, pieces, tmp_path / "run", cost)
    proven(outcome)
    assert value <= outcome.result.lower_bound * (1 + 1e-9)
    assert outcome.result.cost == pytest.approx(value, rel=within)


@pytest.mark.first(1)
@pytest.mark.parametrize("cost", ["nominal", "peak"])
def test_more_disturbance_than_any_policy_withstands_is_infeasible_with_its_reason(cost: str, tmp_path: Path) -> None:
    outcome = run(springs(0.3, 0.3), 20, tmp_path / "run", cost)
    assert outcome.status == "infeasible"
    assert "for every disturbance" in outcome.result.message
    assert check(outcome.directory).status == "verified"


def pushed(A: np.ndarray, h: float, pieces: int, t: float, row: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """What every piece that has begun by ``t`` gives to ``row x(t)``, what the initial state gives, the last piece."""

    def flow(r: float) -> tuple[np.ndarray, np.ndarray]:
        both = expm(np.block([[A, np.eye(2)], [np.zeros((2, 4))]]) * r)
        return both[:2, :2], both[:2, 2:]

    last = min(int(np.ceil(t / h - 1e-9)) - 1, pieces - 1)
    weights = np.zeros((pieces, 2))
    for piece in range(last, -1, -1):
        Phi, Gamma = flow(t - last * h if piece == last else h)
        weights[piece], row = row @ Gamma, row @ Phi
    return weights, row, last


def dense(problem: dict[str, Any], pieces: int, within: int, cost: str) -> float:
    """The same problem as one linear program with ``within`` times a piece, of a spring and a box: a lower bound."""
    A, B = np.array(problem["system"]["A"], dtype=float), np.array(problem["system"]["B"], dtype=float)
    T, w, start = problem["horizon"], problem["disturbance"]["box"][0], problem["path"][0]["from"]
    x0, h = np.array(problem["initial_state"], dtype=float), problem["horizon"] / pieces
    pairs = [(k, seen, i) for k in range(pieces) for seen in range(k) for i in (0, 1)]
    first, size = 2 * pieces, 2 * pieces + len(pairs)  # v, |v| or its peak, F, |F|, then absolute values of every row
    place = {pair: first + n for n, pair in enumerate(pairs)}
    count = size + len(pairs)
    rows: list[tuple[dict[int, float], float]] = []
    for n in range(len(pairs)):
        rows += [({first + n: s, size + n: -1.0}, 0.0) for s in (1.0, -1.0)]
    for k in range(pieces):
        spread = {at - first + size: w for (piece, _, _), at in place.items() if piece == k}
        for s in (1.0, -1.0):
            rows += [({k: s, **spread}, 1.0), ({k: s, pieces + k: -1.0, **(spread if cost == "peak" else {})}, 0.0)]
    times = [(t, 0, 0.7) for t in np.linspace(0, T, pieces * within + 1) if t > start] + [(start, 0, 0.7)]
    for t, state, limit in [*times, (T, 0, 0.3), (T, 1, 0.3)]:
        weights, free, last = pushed(A, h, pieces, t, np.eye(2)[state])
        acting, sizes = weights @ B[:, 0], {}
        for seen, i in np.ndindex(last + 1, 2):
            inner = {place[k, seen, i]: acting[k] for k in range(seen + 1, last + 1)}
            for s in (1.0, -1.0):
                rows.append(({**{c: s * v for c, v in inner.items()}, count: -1.0}, -s * weights[seen, i]))
            sizes[count] = w
            count += 1
        for s in (1.0, -1.0):
            rows.append(({**{k: s * acting[k] for k in range(last + 1)}, **sizes}, limit - s * float(free @ x0)))
    entries = [(r, c, v) for r, (row, _) in enumerate(rows) for c, v in row.items()]
    r, c, v = (np.array(part) for part in zip(*entries, strict=True))
    objective = np.zeros(count)
    objective[pieces:first] = h
    bounds = [(-1, 1)] * pieces + [(0, None)] * pieces + [(None, None)] * len(pairs) + [(0, None)] * (count - size)
    table = coo_array((v, (r.astype(int), c.astype(int))), shape=(len(rows), count)).tocsr()
    found = linprog(objective, A_ub=table, b_ub=[b for _, b in rows], bounds=bounds, method="highs-ds")
    return float(found.fun)


@pytest.mark.slow
@pytest.mark.parametrize("cost", ["nominal", "peak"])
def test_an_independent_linear_program_on_a_grid_comes_near_from_below(cost: str, tmp_path: Path) -> None:
    problem = springs(0.25, 0.5)
    outcome = run(problem, 10, tmp_path / "run", cost)
    proven(outcome)
    coarse, fine = (dense(problem, 10, within, cost) for within in (2, 8))
    assert coarse <= fine <= outcome.result.cost * (1 + 1e-9)
    assert outcome.result.cost == pytest.approx(fine, rel=2e-3)


VARIANTS: dict[str, dict[str, Any]] = {
    "coarser pieces of the disturbance": {"disturbance": 5},
    "finer pieces of the disturbance": {"disturbance": 20},
    "pieces of the disturbance across those of the control": {"disturbance": 7},
    "memory": {"policy": {"memory": 1.0}},
}


@pytest.mark.first(1)
@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("cost", [pytest.param("nominal", marks=pytest.mark.slow), "peak"])
def test_grids_and_memory_keep_every_guarantee(name: str, cost: str, tmp_path: Path) -> None:
    proven(run(springs(0.2, 0.5), 10, tmp_path / "run", cost, **json.loads(json.dumps(VARIANTS[name]))))


SETS: dict[str, dict[str, Any]] = {
    "an uneven box": {"box": {"lower": [-0.2, -0.1], "upper": [0.1, 0.2]}},
    "a box that is thin": {"box": [0.2, 0.0]},
    "an ellipsoid": {"ellipsoid": {"centre": [0, 0], "shape": [[0.02, 0.01], [0.01, 0.03]]}},
    "a ball of the 1-norm": {"norm": {"p": 1, "radius": 0.2}},
    "a triangle": {"polytope": {"H": [[1, 0], [0, 1], [-1, -1]], "h": [0.15, 0.15, 0.1]}},
}


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "an ellipsoid" else ()) for name in SETS]
)
def test_sets_of_disturbances_keep_every_guarantee(name: str, tmp_path: Path) -> None:
    proven(run({**SPRING, "disturbance": SETS[name]}, 8, tmp_path / "run", "peak"))


def test_without_a_disturbance_feedback_changes_nothing(tmp_path: Path) -> None:
    still = {**SPRING, "disturbance": None}
    answering = run(still, 20, tmp_path / "answering")
    proven(answering)
    plain = {**config(still, 20), "policy": {"name": "open_loop"}}
    fixed = sr.run(plain, out=tmp_path / "fixed", quiet=True, figures=False)
    assert answering.result.cost == pytest.approx(fixed.result.cost, rel=1e-6)


@pytest.mark.slow
def test_a_drift_is_answered_too(tmp_path: Path) -> None:
    system = {**SPRING["system"], "c": [0, 0.3]}
    proven(run({**springs(0.1, 0.5), "system": system}, 10, tmp_path / "run", "peak"))


@pytest.mark.slow
def test_other_units_change_nothing(tmp_path: Path) -> None:
    """The spring in seconds and metres, and in units of 1/4 s and 1/1024 m: factors of two."""
    first = run(springs(0.25, 0.5), 10, tmp_path / "first", "peak")
    scaled: dict[str, Any] = {
        **SPRING,
        "system": {"A": [[0, 1], [-2 / 16, -0.5 / 4]], "B": [[0], [64]], "E": [[256, 0], [0, 64]]},
        "horizon": 20.0,
        "initial_state": [-1024, 256],
        "control": {"box": 1.0},
        "path": [{"box": [0.7 * 1024, None], "from": 2.0}],
        "terminal": [{"box": [0.3 * 1024, 0.3 * 256]}],
    }
    second = run(scaled, 10, tmp_path / "second", "peak")
    proven(second)
    assert second.result.cost == 4 * first.result.cost
    assert second.result.lower_bound == pytest.approx(4 * first.result.lower_bound, rel=1e-12)


@pytest.mark.slow
def test_the_loop_that_measures_meets_the_worst_case_that_was_predicted(tmp_path: Path) -> None:
    outcome = run({**MASSES, "disturbance": {"box": [0.08, 0.08]}}, 12, tmp_path / "run", "peak")
    found = sr.simulate(outcome.directory, law="adversary")
    for one in found.constraints:
        assert one.largest == pytest.approx(one.worst, abs=1e-11)
    sampled = sr.simulate(outcome.directory, law="vertices", trajectories=500)
    assert sampled.any_violated is not None and sampled.any_violated.violated == 0


def test_the_stored_gains_answer_only_what_was_seen(tmp_path: Path) -> None:
    outcome = run(springs(0.2, 0.5), 10, tmp_path / "run", policy={"memory": 1.0})
    gains = np.load(outcome.directory / "solution.npz")["gains"]
    assert gains.shape == (10, 10, 1, 2)
    k, j = np.indices((10, 10))
    assert not gains[(j > k) | (j == 0) | ((k - j) * 0.5 > 1.0 + 1e-9)].any()
    assert gains.any()


@pytest.mark.slow
def test_a_peak_is_zero_where_the_control_is_off_whatever_happens(tmp_path: Path) -> None:
    outcome = run(springs(0.2, 0.3), 20, tmp_path / "run", "peak")
    assert outcome.control is not None
    gains = np.load(outcome.directory / "solution.npz")["gains"]
    moves = np.abs(gains).max(axis=(1, 2, 3)) > 1e-6
    acts = np.abs(outcome.control[0]) > 1e-6
    off = int((~moves & ~acts).sum())
    assert 3 <= off < 20


FORGERIES: dict[str, Any] = {
    "a gain": lambda data: data["gains"][5][3][0].__setitem__(1, data["gains"][5][3][0][1] + 0.5),
    "a gain on the future": lambda data: data["gains"][3][7][0].__setitem__(0, 0.1),
    "a gain on what is not measured": lambda data: data["gains"][3][0][0].__setitem__(0, 0.1),
    "a nominal control": lambda data: data["decision"][0].__setitem__(2, data["decision"][0][2] + 0.01),
    "a disturbance outside of its set": lambda data: data["multipliers"]["constraints"][0]["disturbance"][
        0
    ].__setitem__(0, 0.21),
    "a smaller gap": lambda data: data.__setitem__("lower_bound", data["cost"]),
    "a multiplier": lambda data: data["multipliers"]["constraints"][0].__setitem__("multiplier", 2.0),
    "a cell that is missing": lambda data: (data["proof"]["path"]["lower"].pop(), data["proof"]["path"]["upper"].pop()),
    "gains of another shape": lambda data: data["gains"].pop(),
}


@pytest.mark.first(2)
@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_policy_is_found(name: str, tmp_path: Path, policies: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(policies, copy)
    file = copy / "certificate.json"
    data = json.loads(file.read_text())
    FORGERIES[name](data)
    file.write_text(json.dumps(data))
    assert check(copy).status == "refuted"


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> Path:
    outcome = run(springs(0.2, 0.5), 10, tmp_path_factory.mktemp("policy") / "run")
    proven(outcome)
    return outcome.directory


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"disturbance_class": "l1_ball"}, "piecewise_constant, not l1_ball"),
        ({"disturbance_class": "measurable"}, "not measurable; more pieces in dictionaries.disturbance"),
    ],
)
def test_what_is_not_built_is_refused_in_one_sentence(changed: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(sr.InputError, match=said):
        run({**SPRING, **changed}, 10, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("method", ["sparserob", "nominal", "scenario"])
def test_other_methods_are_refused_before_anything_is_written(method: str, tmp_path: Path) -> None:
    with pytest.raises(sr.InputError, match="exchange"):
        run(SPRING, 10, tmp_path / "run", method={"name": method})
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "name",
    ["an uneven box", *(pytest.param(name, marks=pytest.mark.slow) for name in ("an ellipsoid", "a triangle"))],
)
def test_the_largest_factor_is_where_the_least_slack_changes_its_sign(name: str) -> None:
    problem = {**SPRING, "disturbance": SETS[name]}

    loaded = load_config(config(problem, 6))
    tools, experiment = tools_of(loaded), assemble(loaded)
    assert isinstance(experiment, ControlExperiment) and experiment.problem.disturbance is not None
    chosen, grids = experiment.problem, (experiment.control, experiment.disturbance)

    def at(factor: float) -> sr.SemiInfiniteProgram:
        scaled = replace(chosen, disturbance=chosen.disturbance.scaled(factor))
        own = sr.transcribe(scaled, *grids, policy=sr.AffinePolicy()).own_units
        assert own is not None
        return own.program

    factor = largest_factor(at(1.0), tools, 100.0)
    assert factor is not None and 0.5 < factor < 5.0
    assert least_slack(at(factor * (1 - 1e-5)), tools) < 0.0 < least_slack(at(factor * (1 + 1e-5)), tools)


@pytest.mark.slow
def test_the_margin_of_the_first_experiment_is_where_no_causal_policy_goes_further(tmp_path: Path) -> None:
    """With u = 1 until 0.3 the worst disturbance takes x1(0.3) to -0.7 at 0.2905 (closed form), and 0.3 is a breakpoint
    of 50 pieces: affine feedback loses next to nothing."""
    found = sr.margin(config(springs(0.25, 0.3), 50), of="disturbance", out=tmp_path / "margin")
    assert found.status == "certified"
    assert 0.2895 <= found.amounts[0] <= found.amounts[1] <= 0.2906


@pytest.mark.slow
def test_the_margin_of_a_policy_is_bracketed_where_independent_programs_found_it(tmp_path: Path) -> None:
    """The spring with 20 pieces and the path from 0.5 withstands between 0.33612 and 0.33619, five times as much as
    without feedback."""
    found = sr.margin(config(springs(0.25, 0.5), 20), of="disturbance", tolerance=1e-4, out=tmp_path / "margin")
    assert found.status == "certified"
    assert found.amounts[0] <= found.amounts[1]
    assert found.amounts[0] >= 0.33612 and found.amounts[1] <= 0.33622


def test_a_record_is_solved_without_files() -> None:
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0, 1], [0, 0]], [[0], [1]], [[0], [1]]),
        horizon=5.0,
        initial_state=[4, 0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.1], [0.1]),
        path=[sr.Box([-4.2, -1.6], [4.2, 1.6])],
        terminal=[sr.Box([-0.5, -0.4], [0.5, 0.4])],
    )
    pieces = {"name": "piecewise_constant", "pieces": 20}
    result = sr.solve(problem, control=pieces, policy=sr.AffinePolicy())
    assert result.status == "certified"
    assert result.cost == pytest.approx(1.195, rel=1e-6)


@pytest.mark.slow
def test_no_causal_policy_costs_less_than_a_tree_of_signals_proves(tmp_path: Path) -> None:
    """An independent tree of about fifty signals proves 0.55099 where the affine policy costs 0.58605."""
    outcome = run(springs(0.2, 0.5), 10, tmp_path / "run")
    proven(outcome)
    lower = outcome.summary["causal_lower_bound"]
    assert 0.55099 <= lower <= outcome.summary["lower_bound"] + 1e-9
    assert outcome.summary["lower_bound"] == pytest.approx(0.58605, abs=1e-5)
    assert outcome.summary["causal_infeasible"] is False
    assert outcome.summary["causal_ended"] == "settled"


@pytest.mark.slow
def test_the_bound_against_causal_policies_depends_on_no_clock_and_says_so_where_it_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sparserob_core.sip.inner.simplex.growing import GrowingProgram

    quick = run(springs(0.2, 0.5), 10, tmp_path / "quick").summary
    solve = GrowingProgram.solve

    def slowly(self: GrowingProgram, seconds: float = np.inf) -> Any:
        time.sleep(0.02)
        return solve(self, seconds)

    monkeypatch.setattr(GrowingProgram, "solve", slowly)
    slow = run(springs(0.2, 0.5), 10, tmp_path / "slow").summary
    assert slow["causal_lower_bound"] == quick["causal_lower_bound"]
    stopped = run(springs(0.2, 0.5), 10, tmp_path / "stopped", policy={"causal_seconds": 0.0}).summary
    assert stopped["causal_ended"] == "seconds" and stopped["status"] == "certified"


@pytest.mark.slow
def test_the_bound_against_causal_policies_is_pickled_with_its_result(tmp_path: Path) -> None:
    outcome = run(springs(0.2, 0.5), 10, tmp_path / "run")
    for copy in (pickle.loads(pickle.dumps(outcome)).result, pickle.loads(pickle.dumps(outcome.result))):
        assert isinstance(copy, ControlResult) and isinstance(outcome.result, ControlResult)
        assert copy.causal is not None and outcome.result.causal is not None
        assert copy.causal.lower == outcome.result.causal.lower == outcome.summary["causal_lower_bound"]
        assert [row.multiplier for row in copy.causal.rows] == [row.multiplier for row in outcome.result.causal.rows]
    assert outcome.result.plain.__class__ is sr.Result


def test_where_no_causal_policy_exists_the_run_says_so_and_the_check_derives_it(tmp_path: Path) -> None:
    """On experiment 1 with the path from 0.3 none withstands more than 0.2905."""
    outcome = run(springs(0.3, 0.3), 20, tmp_path / "run")
    assert outcome.status == "infeasible"
    assert outcome.summary["causal_infeasible"] is True and outcome.summary["causal_lower_bound"] is None
    assert "nor does any other causal policy" in outcome.summary["message"]
    found = check(outcome.directory)
    assert {claim.name: claim.verdict for claim in found.claims}["causal"] == "holds"
    assert found.status == "verified"


@pytest.mark.slow
def test_no_bound_against_causal_policies_is_sought_with_no_signals(tmp_path: Path) -> None:
    outcome = run(springs(0.2, 0.5), 10, tmp_path / "run", policy={"causal_signals": 0})
    assert outcome.summary["causal_lower_bound"] is None and outcome.summary["causal_infeasible"] is False
    assert "causal" not in json.loads((outcome.directory / "certificate.json").read_text())
    proven(outcome)


@pytest.mark.slow
def test_a_forged_bound_against_causal_policies_is_refused(tmp_path: Path) -> None:
    outcome = run(springs(0.2, 0.5), 8, tmp_path / "run")
    certificate = json.loads((outcome.directory / "certificate.json").read_text())
    causal = certificate["causal"]

    def verdict(**changed: Any) -> str:
        copy = tmp_path / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(outcome.directory, copy)
        (copy / "certificate.json").write_text(json.dumps({**certificate, "causal": {**causal, **changed}}))
        return {claim.name: claim.verdict for claim in check(copy).claims}["causal"]

    entries, signals = causal["multipliers"], causal["signals"]
    assert verdict() == "holds"
    assert verdict(lower_bound=causal["lower_bound"] + 1e-6) == "fails"
    assert verdict(lower_bound=None) == "fails"
    assert verdict(signals=[[[1.01 * v for v in row] for row in one] for one in signals]) == "fails"
    assert verdict(signals=[[[0.0 * v for v in row] for row in one] for one in signals]) == "fails"
    assert verdict(multipliers=[{**one, "multiplier": -one["multiplier"]} for one in entries]) == "fails"
    assert verdict(multipliers=[{**one, "multiplier": 2.0 * one["multiplier"]} for one in entries]) == "fails"
    assert verdict(multipliers=[{**one, "signal": len(signals)} for one in entries]) == "fails"
    assert verdict(multipliers=[{**one, "time": 0.25} for one in entries]) == "fails"
    assert verdict(multipliers=[{**one, "direction": [0.0, 0.0, 1.0]} for one in entries]) == "fails"
    for wrong in (None, [], {}, "text", [None], [{}]):
        assert verdict(multipliers=wrong) == "fails"
        assert verdict(signals=wrong) == "fails"


@pytest.mark.slow
def test_a_result_that_says_another_causal_bound_than_the_certificate_is_noticed(tmp_path: Path) -> None:
    outcome = run(springs(0.2, 0.5), 10, tmp_path / "run")
    file = outcome.directory / "result.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "causal_lower_bound": 0.58}))
    assert {claim.name: claim.verdict for claim in check(outcome.directory).claims}["result.json"] == "fails"


@pytest.mark.slow
def test_the_margin_of_a_policy_says_above_which_factor_no_causal_policy_exists(tmp_path: Path) -> None:
    """Experiment 1 with the path from 0.3, a breakpoint: u = 1 until then is the best for x1(0.3) whatever happens."""
    A, c, x0 = np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([1.0, 0.0]), np.array([-1.0, 1.0])
    fine = (np.arange(6000) + 0.5) * 0.3 / 6000
    rows = np.array([c @ expm(A * s) for s in fine]) * 0.3 / 6000
    cap = (0.7 + c @ expm(A * 0.3) @ x0 + rows[:, 1].sum()) / np.abs(rows).sum()
    times = [0.0, 0.3, 1.0, 2.0, 3.0, 4.0, 5.0]
    given = config({**springs(0.2, 0.3), "terminal": [{"box": [0.9, 1.2]}]}, 5)
    given["dictionaries"] = {"control": {"name": "piecewise_constant", "breakpoints": times}}
    found = sr.margin(given, tolerance=1e-4)
    assert found.lower <= found.causal_upper
    assert found.causal_upper * 0.2 <= cap * (1.0 + 1e-6)
    assert found.causal_ended in ("settled", "signals", "work")


def test_the_margin_says_when_the_time_for_the_causal_bound_was_over(tmp_path: Path) -> None:
    given = config({**springs(0.2, 0.5), "path": []}, 3)
    given["policy"] = {**given["policy"], "causal_seconds": 0.0}
    found = sr.margin(given, tolerance=1e-2, out=tmp_path / "margin")
    assert found.causal_ended == "seconds"
    assert json.loads((tmp_path / "margin" / "margin.json").read_text())["causal_ended"] == "seconds"
    given["policy"] = {**given["policy"], "causal_signals": 0}
    assert sr.margin(given, tolerance=1e-2).causal_ended is None


@pytest.fixture(scope="module")
def refuted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that ends after one round, with a witness."""
    given = springs(0.2, 0.5) | {"initial_state": {"centre": [-1, 1], "box": [0.01, 0.01]}}
    method = {"name": "exchange", "rounds": 1}
    outcome = run(given, 10, tmp_path_factory.mktemp("refuted") / "run", method=method)
    assert outcome.result.status == "refuted"
    return outcome.directory


def test_the_checker_drives_the_closed_loop_by_the_witness(refuted: Path) -> None:
    found = {claim.name: claim for claim in check(refuted).claims}
    assert found["violation"].verdict == "holds" and found["result.json"].verdict == "holds"
    assert check(refuted).status == "verified"


def test_a_forged_witness_of_a_closed_loop_is_refused(refuted: Path, tmp_path: Path) -> None:
    certificate = json.loads((refuted / "certificate.json").read_text())
    witness = certificate["witness"]

    def verdict(**changed: Any) -> str:
        copy = tmp_path / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(refuted, copy)
        (copy / "certificate.json").write_text(json.dumps({**certificate, "witness": {**witness, **changed}}))
        return {claim.name: claim.verdict for claim in check(copy).claims}["violation"]

    signal = np.array(witness["disturbance"])
    assert verdict() == "holds"
    assert verdict(disturbance=(1.01 * signal).tolist()) == "fails"  # not in its set
    assert verdict(disturbance=(-signal).tolist()) == "fails"  # drives the state elsewhere
    assert verdict(disturbance=signal[:, 1:].tolist()) == "fails"
    assert verdict(deviation=[0.02, 0.0]) == "fails"
    assert verdict(violation=2.0 * witness["violation"]) == "fails"
    assert verdict(time=0.1) == "fails"  # before the window
    assert verdict(direction=[1.0, 0.0, 0.0]) == "fails"
    assert verdict(constraint="control") == "fails"
    assert verdict(disturbance=None) == "not checked"


def test_the_witness_is_where_the_simulated_loop_goes(refuted: Path) -> None:
    """The signal that the certificate holds, through the controller that measures."""
    simulated = sr.simulate(str(refuted), law="adversary")
    witness = json.loads((refuted / "certificate.json").read_text())["witness"]
    largest = {one.name: one.largest for one in simulated.constraints}
    assert largest[witness["constraint"]] == pytest.approx(witness["violation"], rel=1e-9)


@pytest.mark.slow
def test_minimum_attention_answers_what_it_measures_and_its_rate_has_a_name_of_its_own(tmp_path: Path) -> None:
    outcome = sr.run(CONFIGS / "experiment3_feedback.yaml", out=tmp_path / "run", quiet=True, figures=False)
    assert {"control", "rate", "equals"} <= set(outcome.summary["tolerances"])
    found = check(outcome.directory)
    assert found.status == "verified"
    loop = outcome.result.model.feedback.loop
    assert (
        np.abs(loop.states(outcome.result.decision, np.array([5.0]))[0, 2]).max() < 1e-12
    )  # u(5) = 0 whatever happens


@pytest.mark.slow
def test_the_page_on_feedback_says_what_the_runs_say(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "feedback.md").read_text()
    row = r"^\| `(\w+_feedback)` \| (\w+)" + 4 * r" \| ([\d.]+)"
    rows = re.findall(row, page, re.MULTILINE)
    assert {name for name, *_ in rows} == {path.stem for path in CONFIGS.glob("*_feedback.yaml")}
    for name, cost, *said, apart in rows:
        summary = sr.run(CONFIGS / f"{name}.yaml", out=tmp_path / name, quiet=True, figures=False).summary
        found = [summary[key] for key in ("cost", "lower_bound", "causal_lower_bound")]
        assert found[:2] == pytest.approx([float(one) for one in said[:2]], abs=1e-6)
        assert found[2] >= float(said[2]) - 1e-3 and cost in ("nominal", "peak", "worst")
        assert 100 * (found[0] - found[2]) / found[0] == pytest.approx(float(apart), abs=0.6)
