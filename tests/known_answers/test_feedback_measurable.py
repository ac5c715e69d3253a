"""Guards measurable disturbances under policy affine: the limit of finer and finer pieces, proofs that are checked,
loops that are driven, forged certificates, what is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.control.feedback.zonoid import Zonoid
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.experiment.check.check import check
from sparserob_core.experiment.run.conclusion import bound
from tests.support.problems import pushed_spring

SPRING = {**pushed_spring(0.25), "path": [{"box": [0.7, None], "from": 0.5}]}
PIECES = 5
FEW = {"control": {"name": "piecewise_constant", "pieces": 3}}
POLICY = sr.AffinePolicy(causal_signals=0)


def run(problem: dict[str, Any], out: Path, cost: str = "nominal", **more: Any) -> sr.Outcome:
    dictionaries: dict[str, Any] = {"control": {"name": "piecewise_constant", "pieces": PIECES}}
    dictionaries |= more.pop("dictionaries", {})
    policy = {"name": "affine", "cost": cost, **more}
    return sr.run(
        {"problem": problem, "dictionaries": dictionaries, "policy": policy}, out=out, quiet=True, figures=False
    )


def proven(outcome: sr.Outcome) -> None:
    """The run is certified, its check holds, its adversaries reach what was predicted, and no loop that is driven
    leaves what was proven."""
    assert outcome.status == "certified", outcome.result.message
    found = check(outcome.directory)
    assert found.status == "verified", [claim for claim in found.claims if claim.verdict != "holds"]
    driven = sr.simulate(outcome.directory, law="adversary")
    for one in driven.constraints:
        assert one.largest == pytest.approx(one.worst, abs=1e-9)
    sampled = sr.simulate(outcome.directory, law="vertices", trajectories=200)
    assert not any(one.violated for one in sampled.constraints)


@pytest.mark.slow
@pytest.mark.parametrize("cost", ["nominal", "peak"])
def test_finer_pieces_of_the_disturbance_cost_more_and_more_and_measurable_ones_the_limit(
    cost: str, tmp_path: Path
) -> None:
    measurable = run(SPRING, tmp_path / "measurable", cost)
    proven(measurable)
    lower = []
    for within in (1, 4, 16):
        finer = {"disturbance": {"name": "piecewise_constant", "pieces": PIECES * within}}
        held = run({**SPRING, "disturbance_class": "piecewise_constant"}, tmp_path / f"{within}", cost,
                   dictionaries=finer)  # fmt: skip
        assert held.status == "certified"
        lower.append(held.result.lower_bound)
        assert held.result.lower_bound <= measurable.result.cost * (1 + 1e-9)
    assert lower[0] <= lower[1] * (1 + 1e-7) and lower[1] <= lower[2] * (1 + 1e-7)
    assert measurable.result.cost - lower[2] <= 0.2 * (measurable.result.cost - lower[0]) + 1e-6
    if cost == "peak":
        assert measurable.result.cost - lower[0] > 1e-3  # what pieces of the control's length leave out


@pytest.mark.slow
def test_what_is_held_is_the_worst_where_one_state_is_disturbed(tmp_path: Path) -> None:
    """``x' = -x + u + w``: the worst disturbance of a piece is constant on it, so pieces leave nothing out."""
    problem = {
        "name": "linear",
        "system": {"A": [[-1.0]], "B": [[1.0]]},
        "horizon": 3.0,
        "initial_state": [2.0],
        "control": {"box": 1.0},
        "disturbance": {"box": 0.3},
        "path": [{"box": [1.0], "from": 1.5}],
        "terminal": [{"box": [0.3]}],
    }
    found = [run({**problem, "disturbance_class": kind}, tmp_path / kind, "peak")
             for kind in ("measurable", "piecewise_constant")]  # fmt: skip
    proven(found[0])
    assert found[0].result.cost == pytest.approx(found[1].result.cost, rel=1e-7)


@pytest.mark.slow
def test_a_control_beside_the_state_has_answered_what_happened_until_it_jumped(tmp_path: Path) -> None:
    """``x' = u + w``, ``|x + u| <= 1/2`` from 1, where the control jumps, to 1.2: the second piece of the control takes
    back all that the first one of the disturbance did, so that ``2 + v_0 + v_1 <= 1/2`` is all that is asked for."""
    problem = {
        "name": "linear",
        "system": {"A": [[0.0]], "B": [[1.0]]},
        "horizon": 2.0,
        "initial_state": [2.0],
        "control": {"box": 1.0},
        "disturbance": {"box": 0.3},
        "disturbance_class": "measurable",
        "path": [{"mixed": {"H": [[1], [-1]], "G": [[1], [-1]], "h": 0.5}, "from": 1.0, "to": 1.2}],
    }
    outcome = run(problem, tmp_path / "run", dictionaries={"control": {"name": "piecewise_constant", "pieces": 2}})
    proven(outcome)
    assert outcome.result.cost == pytest.approx(1.5, rel=1e-7)


VARIANTS: dict[str, dict[str, Any]] = {
    "bounds of state and control together": {
        "path": [{"mixed": {"H": [[1, 0.3], [-1, -0.3]], "G": [[0.3], [-0.3]], "h": 0.75}, "from": 0.8, "to": 3.2}],
    },
    "a polytope off the origin": {
        "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
        "disturbance": {"polytope": {"H": [[-1, 0], [0, -1], [1, 1]], "h": [0.08, 0.1, 0.15]}},
    },
    "a state that nothing pushes": {
        "system": {"A": [[0, 1, 0], [-2, -0.5, 0], [0, 0, -1]], "B": [[0], [1], [0.5]], "E": [[0], [1], [0]]},
        "initial_state": [-1, 1, 0.5],
        "path": [{"box": [0.7, None, None], "from": 0.5}],
        "terminal": [{"box": [0.3, 0.3, 0.4]}],
    },
    "one channel that is known": {
        "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
        "disturbance": {"box": [0.0, 0.2]},
    },
    "initial states in a set": {"initial_state": {"centre": [-1, 1], "box": [0.05, 0.05]}},
    "no deviation at all": {"disturbance": {"box": {"lower": [0.1], "upper": [0.1]}}},
}
LONG = {
    "bounds of state and control together",
    "a polytope off the origin",
    "a state that nothing pushes",
    "initial states in a set",
    "one channel that is known",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in LONG else name for name in VARIANTS]
)
def test_sets_and_systems_keep_every_guarantee(name: str, tmp_path: Path) -> None:
    proven(run({**SPRING, **VARIANTS[name]}, tmp_path / "run"))


GRIDS: dict[str, dict[str, Any]] = {
    "other pieces of the disturbance": {"dictionaries": {"disturbance": {"name": "piecewise_constant", "pieces": 3}}},
    "uneven pieces": {
        "dictionaries": {"control": {"name": "piecewise_constant", "breakpoints": [0, 0.5, 1.2, 2, 2.7, 4]}}
    },
    "a short memory": {"memory": 1.0},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", GRIDS)
def test_grids_and_memory_keep_every_guarantee(name: str, tmp_path: Path) -> None:
    proven(run(SPRING, tmp_path / "run", **GRIDS[name]))


@pytest.mark.slow
def test_other_units_change_nothing(tmp_path: Path) -> None:
    """Metres as millimetres, seconds as milliseconds, newtons as kilonewtons, for the control only."""
    plain = run(SPRING, tmp_path / "plain")
    x, t, u = np.array([1e3, 1.0]), 1e3, 1e-3  # (mm, mm/ms), ms, kN
    A, B, E = (np.array(SPRING["system"][name], dtype=float) for name in "ABE")
    other = {
        **SPRING,
        "system": {"A": (np.diag(x) @ A @ np.diag(1 / x) / t).tolist(), "B": (x[:, None] * B / u / t).tolist(),
                   "E": (x[:, None] * E / t).tolist()},
        "horizon": 4.0 * t,
        "initial_state": (x * [-1, 1]).tolist(),
        "control": {"box": u},
        "path": [{"box": [0.7 * x[0], None], "from": 0.5 * t}],
        "terminal": [{"box": (0.3 * x).tolist()}],
    }  # fmt: skip
    found = run(other, tmp_path / "other")
    proven(found)
    assert found.result.cost / (u * t) == pytest.approx(plain.result.cost, rel=1e-6)


@pytest.mark.slow
def test_without_gains_the_tube_is_that_of_the_open_loop() -> None:
    answer = sr.solve(_problem(), control={"name": "piecewise_constant", "pieces": PIECES}, policy=POLICY)
    model: Transcription = answer.model
    assert model.feedback is not None
    loop, decision = model.feedback.loop, np.asarray(answer.decision).copy()
    decision[loop.nominal_size :] = 0.0
    times = np.linspace(0.0, 4.0, 41)
    alone = replace(model, feedback=None)
    for direction in np.array([[1.0, 0.0], [-1.0, 0.0], [0.3, -1.0]]):
        values = loop.values(decision, times, direction[None])[:, 0]
        open_loop = alone.functionals.values(
            model.nominal(decision), times, np.tile(direction, (41, 1)), np.zeros((41, 0))
        )
        np.testing.assert_allclose(values, open_loop, rtol=1e-11, atol=1e-11)


@pytest.mark.slow
def test_bounds_over_cells_hold_and_become_exact() -> None:
    answer = sr.solve(_problem(), control={"name": "piecewise_constant", "pieces": PIECES}, policy=POLICY)
    assert answer.model.feedback is not None
    loop, decision, H = answer.model.feedback.loop, np.asarray(answer.decision), np.array([[1.0, 0.0], [-0.2, 1.0]])
    for width in (0.4, 0.05, 0.001):
        lower = np.array([0.81, 1.7, 3.2])
        bounds = loop.bounds(decision, lower, lower + width, H)
        inside = [loop.values(decision, lower + share * width, H) for share in np.linspace(0.0, 1.0, 9)]
        assert (np.max(inside, axis=0) <= bounds).all()
        assert (bounds - np.max(inside, axis=0) <= 2.0 * width**2 + 1e-9).all()


def _problem() -> sr.OptimalControlProblem:
    system = sr.LinearSystem(A=[[0, 1], [-2, -0.5]], B=[[0], [1]], E=[[0], [1]])
    return sr.OptimalControlProblem(
        system=system,
        horizon=4.0,
        initial_state=[-1, 1],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.25], [0.25]),
        disturbance_class="measurable",
        path=[sr.PathConstraint(sr.Box([-0.7, -np.inf], [0.7, np.inf]), start=0.5)],
        terminal=[sr.Box([-0.3, -0.3], [0.3, 0.3])],
    )


def test_more_disturbance_than_any_policy_withstands_is_infeasible_with_its_reason(tmp_path: Path) -> None:
    outcome = run({**SPRING, "disturbance": {"box": 0.6}}, tmp_path / "run")
    assert outcome.status == "infeasible"
    assert check(outcome.directory).status == "verified"


@pytest.fixture(scope="module")
def certified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    outcome = run(SPRING, tmp_path_factory.mktemp("measurable") / "run", "peak")
    proven(outcome)
    return outcome.directory


def _heaviest(data: dict[str, Any]) -> dict[str, Any]:
    entries = [one for one in data["multipliers"]["constraints"] if len(one["changes"]) > 1]
    heaviest: dict[str, Any] = max(entries, key=lambda one: one["multiplier"])
    return heaviest


def _scaled(data: dict[str, Any], factor: float) -> None:
    one = _heaviest(data)
    one["disturbance"] = [[factor * v for v in row] for row in one["disturbance"]]


FORGERIES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a disturbance outside of its set": lambda data: _scaled(data, 1.01),
    "a disturbance that does nothing": lambda data: _scaled(data, 0.0),
    "changes that do not increase": lambda data: _heaviest(data)["changes"].reverse(),
    "changes that do not begin at 0": lambda data: _heaviest(data)["changes"].__setitem__(0, 0.1),
    "changes after the end": lambda data: _heaviest(data)["changes"].__setitem__(-1, 4.5),
    "no changes": lambda data: _heaviest(data).pop("changes"),
    "changes in words": lambda data: _heaviest(data).__setitem__("changes", "always"),
    "fewer changes than values": lambda data: _heaviest(data)["changes"].pop(),
    "a larger bound": lambda data: data.__setitem__("lower_bound", data["lower_bound"] * (1 + 1e-7)),
    "a gain that answers more": lambda data: data["gains"][3][2][0].__setitem__(1, data["gains"][3][2][0][1] + 0.5),
    "no gains": lambda data: data.__setitem__("gains", (0.0 * np.array(data["gains"])).tolist()),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if "outside of its set" in name else ()) for name in FORGERIES],
)
def test_a_forged_certificate_is_found(name: str, tmp_path: Path, certified: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(certified, copy)
    file = copy / "certificate.json"
    data = json.loads(file.read_text())
    FORGERIES[name](data)
    file.write_text(json.dumps(data))
    assert check(copy).status == "refuted"


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"disturbance": {"ellipsoid": {"centre": [0.0], "shape": [[0.04]]}}}, "known corners"),
        ({"disturbance_class": "l1_ball"}, "l1_ball"),
        ({"terminal": [{"equals": [0, 0]}]}, "interior"),
        ({"path": [{"ellipsoid": {"centre": [0, 0], "shape": [[1.0, 0], [0, 4.0]]}}]}, "flat sides"),
        ({"cost": "worst"}, "other than worst"),
    ],
)
def test_what_is_not_built_is_refused_in_one_sentence(changed: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(sr.InputError, match=said):
        cost = changed.pop("cost", "nominal")
        run({**SPRING, **changed}, tmp_path / "run", cost)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_what_a_bound_rests_on_is_composed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever rounds the bound, derives it, seeks another or writes it down takes the same signals."""
    composed: list[bytes] = []
    plain = Zonoid.signals

    def counted(zonoid: Zonoid, points: np.ndarray) -> list[Any]:
        composed.extend(point.tobytes() for point in points)
        return plain(zonoid, points)

    monkeypatch.setattr(Zonoid, "signals", counted)
    outcome = run({**SPRING, "horizon": 2.0}, tmp_path / "run", "peak", dictionaries=FEW)
    assert outcome.status == "certified"
    assert len(composed) > 2
    assert len(composed) == len(set(composed))


@pytest.mark.slow
def test_what_a_bound_rests_on_is_composed_at_once_beside_initial_states_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Deviations of initial states come after those of the pieces, and are no points of their sets."""
    batches: list[set[bytes]] = []
    plain = Zonoid.signals

    def told(zonoid: Zonoid, points: np.ndarray) -> list[Any]:
        batches.append({point.tobytes() for point in points})
        return plain(zonoid, points)

    monkeypatch.setattr(Zonoid, "signals", told)
    problem = {**SPRING, **VARIANTS["initial states in a set"], "horizon": 2.0}
    outcome = run(problem, tmp_path / "run", "peak", dictionaries=FEW, causal_signals=0)
    experiment: Any = outcome.experiment
    loop = experiment.transcription.answering.loop
    assert loop.spread.size == loop.measurable.size + 2
    rests = [cut.index[-loop.spread.size :] for cut in outcome.result.dual.cuts]
    points = [w[loop.measurable.at(piece)[0]] for w in rests for piece in range(3)]
    assert batches[0] == {point.tobytes() for point in points if point.any()}


PLANE: dict[str, Any] = {
    "name": "linear",
    "system": {
        "A": [[0, 0, 1, 0], [0, 0, 0, 1], [0, 0, 0, 1.36], [0, 1.39, -1.36, 0]],
        "B": [[0, 0], [0, 0], [1, 0], [0, 1]],
        "E": [[0, 0], [0, 0], [1, 0], [0, 1]],
    },
    "horizon": 3.0,
    "initial_state": [-1.0, 0.3, 0.2, 0.0],
    "control": {"box": 1.0},
    "disturbance": {"box": 0.01},
    "disturbance_class": "measurable",
    "terminal": [{"box": [0.1, 0.1, 0.1, 0.1]}],
}
BENT = {**PLANE, "system": {**PLANE["system"], "A": [*PLANE["system"]["A"][:3], [0, "1.39 + 0.1*t", -1.36, 0]]}}


def missing(monkeypatch: pytest.MonkeyPatch, shares: Callable[[np.ndarray], np.ndarray]) -> None:
    """Signals that miss their points, since their parts have these shares, and nobody derives the bound anew."""
    plain = Zonoid._decompose_points

    def made(zonoid: Zonoid, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        directions, found = plain(zonoid, points)
        return directions, shares(found)

    monkeypatch.setattr(Zonoid, "_decompose_points", made)
    monkeypatch.setattr(bound, "SECONDS", 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("problem", [PLANE, BENT], ids=["constant", "in t"])
def test_what_signals_miss_of_their_deviations_is_taken_off_the_lower_bound(
    problem: dict[str, Any], seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(seed)
    missing(monkeypatch, lambda shares: shares * (1.0 - 1e-6 * rng.uniform(0.5, 1.0, shares.shape)))
    outcome = run(problem, tmp_path / "run", dictionaries=FEW, causal_signals=0)
    assert outcome.status == "verified"  # the gap is not closed by signals that prove less
    assert 1e-7 < 1.0 - outcome.result.lower_bound / outcome.result.cost < 2e-5
    assert check(outcome.directory).status == "verified"
    for name in ("certificate.json", "result.json"):
        file = outcome.directory / name
        data = json.loads(file.read_text())
        file.write_text(json.dumps({**data, "lower_bound": outcome.result.cost * (1.0 - 1.3e-8)}))
    assert check(outcome.directory).status == "refuted"


@pytest.mark.slow
def test_what_signals_miss_is_taken_off_where_nothing_is_answered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``x' = -x + u + w`` with one command for all time, twice: ``2 e^-3 - (|u| - r) (1 - e^-3)`` is at most the wall,
    of which signals that are a thousandth smaller on the first two of three pieces prove that much less."""
    radii, walls = np.array([0.05, 0.02]), np.array([0.06, 0.03])
    problem = {
        **PLANE,
        "system": {"A": [[-1.0, 0.0], [0.0, -1.0]], "B": [[1.0, 0.0], [0.0, 1.0]]},
        "initial_state": [2.0, 2.0],
        "disturbance": {"box": radii.tolist()},
        "terminal": [{"box": walls.tolist()}],
    }
    grids = {"control": 1, "disturbance": 3}
    named = {name: {"name": "piecewise_constant", "pieces": count} for name, count in grids.items()}
    missing(monkeypatch, lambda shares: shares * (1.0 - 1e-3))
    outcome = run(problem, tmp_path / "run", dictionaries=named, causal_signals=0)
    faded = np.exp(-3.0)
    least = 3.0 * float(((2.0 * faded - walls) / (1.0 - faded) + radii).sum())
    lost = 3.0 * 1e-3 * float(radii.sum()) * (np.exp(-1.0) - faded) / (1.0 - faded)
    assert outcome.result.cost == pytest.approx(least, rel=1e-6)
    assert outcome.result.lower_bound == pytest.approx(least - lost, rel=1e-6)
    assert check(outcome.directory).status == "verified"


@pytest.mark.slow
def test_what_signals_do_not_show_to_be_infeasible_is_not_said_to_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing(monkeypatch, lambda shares: 0.1 * shares)
    outcome = run({**SPRING, "disturbance": {"box": 0.6}}, tmp_path / "run")
    assert outcome.status == "failed" and "do not prove it" in outcome.result.message
    assert outcome.result.lower_bound == -np.inf and outcome.result.infeasible is None


@pytest.mark.slow
def test_no_causal_policy_costs_less_than_signals_that_are_held_prove(certified: Path) -> None:
    said = json.loads((certified / "result.json").read_text())
    assert 0.9 * said["cost"] < said["causal_lower_bound"] <= said["cost"]
    assert {claim.name: claim.verdict for claim in check(certified).claims}["causal"] == "holds"


@pytest.mark.slow
def test_the_margin_is_bracketed_and_lies_below_what_any_causal_policy_withstands(tmp_path: Path) -> None:
    config = {
        "problem": SPRING,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": PIECES}},
        "policy": {"name": "affine"},
    }
    found = sr.margin(config, tolerance=0.02, out=tmp_path / "margin")
    assert 1.0 < found.lower <= found.upper <= 1.05 * found.lower
    assert not np.isfinite(found.causal_upper) or found.causal_upper >= found.lower


@pytest.mark.slow
def test_a_controller_takes_a_force_that_switches_within_its_pieces_for_one_of_the_set(certified: Path) -> None:
    A, B, step = np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([0.0, 1.0]), 4.0 / PIECES
    controller, rng = sr.controller(certified), np.random.default_rng(0)
    for _ in range(5):
        controller.reset()
        state = np.array([-1.0, 1.0])
        for k in range(PIECES):
            u = controller.step(k * step, state)
            cut, sign = rng.uniform(0.1, 0.9), rng.choice([-1.0, 1.0])
            for share, force in ((cut, 0.25 * sign), (1.0 - cut, -0.25 * sign)):
                rest = np.linalg.solve(A, B * (u[0] + force))
                state = expm(A * share * step) @ (state + rest) - rest
        assert controller.covered
        assert (np.abs(state) <= 0.3 + 1e-9).all()
