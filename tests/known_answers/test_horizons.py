"""Guards margins of the horizon: the shortest feasible horizon, in closed form or by independent programs; feasibility
that is not monotone; refusals; what is written and drawn."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.experiment.cli.main import main
from sparserob_core.experiment.margin.margin import curve_rows, margin_rows

SPRING = {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]}
SOON: dict[str, Any] = {
    "name": "linear",
    "system": SPRING,
    "horizon": 5.0,
    "initial_state": [-1, 1],
    "control": {"box": 1.0},
    "disturbance": {"box": [0.09, 0.09]},
    "terminal": [{"box": [0.3, 0.3]}],
}
RATE: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [[0]], "B": [[1]]},
    "horizon": 4.0,
    "initial_state": [2],
    "control": {"box": 1.0},
    "terminal": [{"box": [0.5]}],
}


def margin(problem: dict[str, Any], pieces: int = 10, curve: int = 0, **keys: Any) -> sr.Margin:
    entry = {"name": "piecewise_constant", "pieces": pieces}
    loaded = {"problem": problem, "dictionaries": {"control": entry, "disturbance": entry}, "observers": []}
    return sr.margin({**loaded, **keys.pop("also", {})}, "horizon", curve=curve, **keys)


def assert_between(found: sr.Margin, exact: float, width: float) -> None:
    assert found.status == "certified", found.message
    assert found.lower <= exact * (1 + 1e-9) and exact <= found.upper * (1 + 1e-9)
    assert found.upper - found.lower <= width
    ends = [0.0, *(high for _, high in found.covered)]
    assert [low for low, _ in found.covered] == ends[:-1] and ends[-1] == found.lower  # without a hole


def feasible(T: float, pieces: int, w: float) -> bool:
    """Whether a robust terminal constraint of the spring can be met, by a linear program on matrix exponentials."""
    h, A = T / pieces, np.array(SPRING["A"], dtype=float)
    big = expm(np.block([[A, np.eye(2)], [np.zeros((2, 4))]]) * h)
    Phi, Gamma = big[:2, :2], big[:2, 2:]
    gains = [np.linalg.matrix_power(Phi, pieces - 1 - k) @ Gamma for k in range(pieces)]
    sigma = w * sum(np.abs(gain).sum(axis=1) for gain in gains)
    free = np.linalg.matrix_power(Phi, pieces) @ [-1.0, 1.0]
    G = np.stack([gain[:, 1] for gain in gains], axis=1)
    rows, room = np.vstack([G, -G]), np.concatenate([0.3 - sigma - free, 0.3 - sigma + free])
    answer = linprog(np.zeros(pieces), rows, room, bounds=(-1, 1), method="highs")
    return answer.status == 0


@pytest.mark.slow
def test_the_spring_can_be_at_rest_at_some_horizons_only(tmp_path: Path) -> None:
    """|w| <= 0.09: feasible for T = 1.5 to 3, infeasible up to 1 and from 3.5 on."""
    found = margin(SOON, curve=20, tolerance=1e-4, out=tmp_path / "margin")
    low, high = 1.25, 1.5
    while high - low > 1e-7:
        middle = (low + high) / 2
        low, high = (low, middle) if feasible(middle, 10, 0.09) else (middle, high)
    assert_between(found, high, 2e-3)
    status = {round(point.factor, 9): point.status for point in found.curve}
    for T in np.arange(0.25, 5.01, 0.25):
        assert status[round(T, 9)] == ("certified" if feasible(T, 10, 0.09) else "infeasible")
    assert {status[T] for T in (0.5, 1.0, 3.5, 4.0, 5.0)} == {"infeasible"}
    assert {status[T] for T in (1.5, 2.0, 2.5, 3.0)} == {"certified"}
    written = json.loads((tmp_path / "margin" / "margin.json").read_text())
    assert written["of"] == "horizon" and written["lower"] == found.lower and written["upper"] == found.upper
    assert (tmp_path / "margin" / "margin.png").stat().st_size > 5000
    rows = dict(margin_rows(found))
    assert "shortest horizon" in rows and rows["excluded"].startswith("(0, 1.")
    assert len(curve_rows(found)) == 21
    assert "10 pieces at every horizon" in found.remarks[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "exact"),
    [
        ({}, 1.5),
        ({"disturbance": {"box": 0.1}}, 1.5 / 0.9),
        pytest.param(
            {"disturbance": {"box": 0.1}, "disturbance_class": "measurable"}, 1.5 / 0.9, marks=pytest.mark.slow
        ),
        ({"initial_state": {"centre": 2, "box": 0.1}}, 1.6),
        ({"system": {"A": [[0]], "B": [[1]], "c": [0.25]}}, 1.5 / 0.75),
        ({"terminal": [{"equals": [0]}]}, 2.0),
        pytest.param({"terminal": [{"norm": {"p": 2, "radius": 0.5}}]}, 1.5, marks=pytest.mark.slow),
        pytest.param({"control": {"box": {"lower": -3, "upper": 0.5}}}, 0.5, marks=pytest.mark.slow),
    ],
    ids=("known", "disturbed", "measurable", "begun", "drift", "equality", "norm", "asymmetric"),
)
def test_the_shortest_way_at_full_speed_is_found(change: dict[str, Any], exact: float) -> None:
    assert_between(margin({**RATE, **change}, tolerance=1e-4), exact, 2e-3)


@pytest.mark.slow
def test_the_shortest_horizon_at_an_uncertain_rate() -> None:
    """x' = -a x - 1 from 2 to 0.5: slowest at a = 0.5, where x(T) = 4 e^(-T / 2) - 2."""
    system = {"A": [["-a"]], "B": [[1]], "parameters": {"a": [0.5, 1.0]}}
    assert_between(margin({**RATE, "system": system}, tolerance=1e-4), 2.0 * math.log(4.0 / 2.5), 2e-3)


@pytest.mark.first(1)
@pytest.mark.parametrize("change", [1.8, 1.0])
def test_beyond_a_change_of_the_system_horizons_are_looked_at_one_by_one(change: float) -> None:
    """x' = u until the change, x' = u / 2 afterwards: 1.5 to go, from the change on at half the speed."""
    pieces = [{"until": change, **RATE["system"]}, {"until": 4.0, "A": [[0]], "B": [[0.5]]}]
    found = margin({**RATE, "system": {"pieces": pieces}}, tolerance=1e-3)
    if change > 1.5:
        assert_between(found, 1.5, 2e-2)
        return
    assert found.status == "undecided" and "the system changes at 1" in found.message
    assert found.lower == 1.0
    assert 2.0 - 1e-9 <= found.upper <= 2.01


@pytest.mark.slow
def test_sets_that_move_stay_where_they_are_while_the_horizon_varies() -> None:
    """x' = u, |x - r| <= 0.5 from time 1 on, r from 0 at time 0 to 2 at time 4: 2 - t <= r + 0.5 from 1 on; and at the
    end x(T) <= 0.25, where r - 0.5 = T / 2 - 0.5 <= x: feasible from 1.75 to 1.5 at most, so never."""
    corridor = {"box": [0.5], "from": 1, "relative_to": [[0, 0], [4, 2]]}
    never = margin({**RATE, "terminal": [{"box": [0.25]}], "path": [corridor]}, tolerance=1e-3)
    assert never.status == "infeasible", never.message
    wider = {**corridor, "box": [0.6]}
    found = margin({**RATE, "terminal": [{"box": [0.3]}], "path": [wider]}, curve=16, tolerance=1e-4)
    assert_between(found, 1.7, 2e-3)  # 2 - T <= 0.3, and T / 2 - 0.6 <= 0.3 up to 1.8
    assert {point.status for point in found.curve if point.factor > 1.81} == {"infeasible"}


@pytest.mark.slow
def test_a_mixed_constraint_slows_the_way_down() -> None:
    """|u| <= 1 - 0.2 x where x > 0: x' = -(1 - 0.2 x) at best, piece by piece with the state at its beginning."""
    mixed = {"mixed": {"H": [[0.2]], "G": [[-1]], "h": [1]}}
    found = margin({**RATE, "path": [mixed]}, pieces=8, tolerance=1e-4)

    def reached(T: float) -> float:
        x = 2.0
        for _ in range(8):
            x -= T / 8 * (1.0 - 0.2 * x)
        return x

    low, high = 1.5, 4.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if reached(middle) > 0.5 else (low, middle)
    assert_between(found, high, 2e-3)


@pytest.mark.slow
def test_a_round_set_of_controls_reaches_along_the_straight_line() -> None:
    problem = {
        **RATE,
        "system": {"A": [[0, 0], [0, 0]], "B": [[1, 0], [0, 1]]},
        "initial_state": [1.2, 1.6],
        "control": {"ellipsoid": {"shape": 1.0}},
        "terminal": [{"norm": {"p": 2, "radius": 0.5}}],
    }
    assert_between(margin(problem, 4, tolerance=1e-3), 1.5, 2e-2)


@pytest.mark.slow
def test_horizons_before_a_window_begins_do_not_know_of_it() -> None:
    """|x| <= 1.6 is met from 0.4 on; the window from 0.5 asks for |x(0.5)| <= 1.2, and 1.5 is the least: an island."""
    island = {**RATE, "horizon": 2.0, "terminal": [{"box": [1.6]}], "path": [{"box": [1.2], "from": 0.5}]}
    found = margin(island, curve=16, tolerance=1e-4)
    assert_between(found, 0.4, 1e-3)
    assert {point.status for point in found.curve if point.factor >= 0.5} == {"infeasible"}


@pytest.mark.slow
def test_what_is_never_feasible_is_covered_up_to_the_end() -> None:
    found = margin({**RATE, "horizon": 1.4})
    assert found.status == "infeasible" and found.lower == 1.4 and math.isnan(found.upper)
    assert "no horizon up to 1.4 is feasible" in found.message
    assert ("shortest horizon", "more than 1.4") in margin_rows(found)


def test_what_is_feasible_at_once_has_no_shortest_horizon() -> None:
    found = margin({**RATE, "terminal": [{"box": [3]}]})
    assert found.status == "unbounded" and found.lower == 0.0 and 0.0 < found.upper <= 2e-5


@pytest.mark.slow
def test_limits_on_steps_are_left_out_of_what_is_excluded_and_said_so() -> None:
    """u may change by 0.2 from piece to piece: its mean is 0.8, so that 1.5 / 0.8 is the least horizon with them."""
    found = margin({**RATE, "control_step": {"box": 0.2}, "initial_control": 0.0}, tolerance=1e-3)
    assert found.status == "undecided" and "control_step is left out" in found.message
    assert 1.4 <= found.lower <= 1.5
    assert 1.5 / 0.8 - 1e-9 <= found.upper <= 1.5 / 0.8 + 8e-3


@pytest.mark.slow
@pytest.mark.parametrize("unit", [2.0, 2.0**-7])
def test_another_unit_of_time_gives_the_same_horizons_to_the_last_bit(unit: float) -> None:
    slower = {
        **SOON,
        "horizon": 5.0 * unit,
        "system": {
            "A": (np.array(SPRING["A"]) / unit).tolist(),
            "B": (np.array(SPRING["B"]) / unit).tolist(),
            "E": (np.eye(2) / unit).tolist(),
        },
    }
    one, other = margin(SOON, tolerance=1e-3), margin(slower, tolerance=1e-3)
    assert (other.lower, other.upper) == (one.lower * unit, one.upper * unit)
    assert [(low / unit, high / unit) for low, high in other.covered] == list(one.covered)


@pytest.mark.parametrize(
    ("change", "also", "said"),
    [
        ({"system": {**RATE["system"], "delay": 0.1}}, {}, "a delay is no share of the horizon"),
        ({"path": [{"box": [3], "from": 0, "to": 3}]}, {}, "a window that lasts until the horizon, 4"),
        ({"disturbance": {"box": 0.1}}, {"policy": {"name": "affine"}}, "open_loop for the margin of the horizon"),
        (
            {},
            {"dictionaries": {"control": {"name": "walsh", "pieces": 8, "functions": 3}}},
            "fewer functions than",
        ),
    ],
)
def test_what_cannot_be_proven_is_refused_at_once(change: dict[str, Any], also: dict[str, Any], said: str) -> None:
    with pytest.raises(sr.InputError, match=said):
        margin({**RATE, **change}, also=also)


def test_an_interrupted_search_knows_what_was_covered() -> None:
    heard: list[sr.Event] = []

    def impatient(event: sr.Event) -> None:
        heard.append(event)
        if len(heard) > 12:
            raise KeyboardInterrupt

    found = margin(RATE, notify=impatient)
    assert found.status == "undecided" and 0.0 < found.lower <= 1.5
    assert "interrupted" in found.message


@pytest.mark.slow
def test_the_command_prints_the_curve(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "rate.yaml"
    config.write_text(
        json.dumps({"problem": RATE, "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 8}}})
    )
    with pytest.raises(SystemExit) as ended:
        main(["margin", str(config), "--of", "horizon", "--curve", "8", "--out", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    assert ended.value.code == 0
    assert "Cost against the horizon" in printed and "infeasible" in printed and "certified" in printed
