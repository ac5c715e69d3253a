"""Guards experiment/bound: worst cases against closed forms, on both sides; of configs, problems and runs; certificates
that are forged; plants of hundreds of states; bad input."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.studies.suprema import rows_of
from sparserob_core.control.transcription.terms.accumulated import integrals_as_states
from sparserob_core.experiment.bound.record import list_bound_columns, list_bound_rows
from tests.support.places import matrices, needs_plants

OSCILLATOR = {"A": [[0, 1], [-1, 0]], "B": [[0], [1]]}


def config(pieces: int = 1, **problem: object) -> dict:
    return {
        "problem": {
            "name": "linear",
            "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
            "horizon": 2.0,
            "initial_state": [1, 0],
            "control": {"box": 1.0},
            **problem,
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
        "observers": [],
    }


def assert_encloses(row: sr.WorstCase, exact: float, tolerance: float = 1e-6) -> None:
    assert row.lower <= exact <= row.upper
    assert row.upper - row.lower <= tolerance * max(abs(exact), 1e-3) * 1.001


def verdicts(directory: Path) -> list[str]:
    return [claim.verdict for claim in sr.check(directory).claims]


def test_the_double_integrator_is_bounded_on_both_sides(tmp_path: Path) -> None:
    """x1(2) = 1 + 2 x2(0) + 2 w1 + 2 w2 at most, x2(2) = x2(0) + 2 w2."""
    start = {"centre": [1, 0], "box": [0.1, 0.05]}
    stated = config(initial_state=start, disturbance={"box": [0.02, 0.03]}, terminal=[{"box": [2.0, 0.5]}])
    found = sr.bound(stated, out=tmp_path / "out")
    assert [(row.sense, row.quantity) for row in found.rows] == [
        ("sup", "x1"),
        ("sup", "x2"),
        ("inf", "x1"),
        ("inf", "x2"),
    ]
    for row, exact in zip(found.rows, (1.3, 0.11, 0.7, -0.11), strict=True):
        assert_encloses(row, exact)
    assert found.status == "certified"
    assert found.rows[0].margin == pytest.approx(0.7, abs=1e-6)
    assert found.rows[2].margin == pytest.approx(2.7, abs=1e-6)
    assert sr.check(tmp_path / "out").status == "verified"


def test_a_measurable_disturbance_does_more_than_one_that_is_constant(tmp_path: Path) -> None:
    """x1 of an oscillator at rest: the integral of |sin| against the largest value of 1 - cos."""
    stated = config(
        system=OSCILLATOR, horizon=2 * math.pi, initial_state=[0, 0], path=[{"box": [5.0, None]}],
        disturbance={"box": [0.0, 0.1]},
    )  # fmt: skip
    constant = sr.bound(stated)
    assert_encloses(constant.rows[0], 0.2)
    assert constant.rows[0].time == pytest.approx(math.pi, abs=1e-2)
    measurable = sr.bound(stated, {"problem.disturbance_class": "measurable"}, out=tmp_path / "out")
    assert_encloses(measurable.rows[0], 0.4)
    assert sr.check(tmp_path / "out").status == "verified"


def test_the_worst_parameter_may_be_inside_its_interval(tmp_path: Path) -> None:
    """x1(2 pi) = cos(2 pi omega), 1 at omega = 1; the least at the ends."""
    system = {"A": [[0, 1], ["-omega^2", 0]], "B": [[0], [1]], "parameters": {"omega": [0.9, 1.1]}}
    found = sr.bound(config(system=system, horizon=2 * math.pi, terminal=[{"box": [2.0, None]}]), out=tmp_path / "out")
    assert_encloses(found.rows[0], 1.0)
    assert_encloses(found.rows[1], math.cos(0.2 * math.pi))
    assert found.rows[0].parameter == pytest.approx([1.0], abs=1e-3)
    assert sr.check(tmp_path / "out").status == "verified"


def test_rows_are_looked_at_in_the_middle_of_parameters_that_are_far_from_1() -> None:
    """e^(1.1 2), whose parameter in own units would make it e^2000, terms by which both sides were told wider."""
    system = {"A": [["1000 * k"]], "B": [[1]], "parameters": {"k": [0.0009, 0.0011]}}
    found = sr.bound(config(system=system, initial_state=[1], terminal=[{"box": [100.0]}]))
    assert_encloses(found.rows[0], math.exp(2.2))


def test_a_window_is_bounded_over_time_and_its_envelope_holds_the_truth(tmp_path: Path) -> None:
    """x' = -x + w from 1: x(t) = e^-t + 0.2 (1 - e^-t) at most."""
    stated = config(
        system={"A": [[-1]], "B": [[1]]}, horizon=3.0, initial_state=[1], path=[{"box": 2.0, "from": 0.5, "to": 2.5}],
        disturbance={"box": 0.2},
    )  # fmt: skip
    found = sr.bound(stated, out=tmp_path / "out")
    assert_encloses(found.rows[0], 0.2 + 0.8 * math.exp(-0.5))
    assert_encloses(found.rows[1], -0.2 + 1.2 * math.exp(-2.5))
    # largest at the ends of the window, where no cell has its middle
    assert [row.time for row in found.rows] == [0.5, 2.5]
    assert max(row.upper - row.lower for row in found.rows) < 1e-9
    times = np.linspace(0.5, 2.5, 1001)[1:-1]
    truth = 0.2 + 0.8 * np.exp(-times)
    held = np.searchsorted(found.rows[0].edges, times, side="right") - 1
    assert (found.rows[0].high[held] >= truth).all()
    middles = (found.rows[0].edges[:-1] + found.rows[0].edges[1:]) / 2
    assert (found.rows[0].low <= 0.2 + 0.8 * np.exp(-middles)).all()
    assert sr.check(tmp_path / "out").status == "verified"
    assert {file.name for file in (tmp_path / "out").iterdir()} >= {"bound.json", "bound.png", "config.yaml"}


@pytest.mark.slow
def test_without_walls_the_outputs_are_bounded_and_without_outputs_the_states() -> None:
    states = sr.bound(config())
    assert [(row.constraint, row.sense, row.quantity) for row in states.rows] == [
        ("state", "sup", "x1"), ("state", "inf", "x1"), ("state", "sup", "x2"), ("state", "inf", "x2"),
    ]  # fmt: skip
    assert all(row.wall is None and row.margin is None for row in states.rows)
    outputs = sr.bound(config(initial_state={"centre": [1, 0], "box": 0.1}, measurements={"C": [[1, -2]]}))
    assert [(row.sense, row.quantity) for row in outputs.rows] == [("sup", "x1 - 2 x2"), ("inf", "x1 - 2 x2")]
    assert_encloses(outputs.rows[0], 1.3)


def test_a_run_is_bounded_with_its_control_and_stays_within_its_walls(tmp_path: Path) -> None:
    stated = config(
        pieces=5, initial_state=[0.5, 0.0], disturbance={"box": [0.0, 0.02]}, terminal=[{"box": [0.1, 0.2]}],
        path=[{"mixed": {"H": [[0, 1]], "G": [[0.5]], "h": [2.0]}}],
    )  # fmt: skip
    outcome = sr.run(stated, out=tmp_path / "run", figures=False)
    assert outcome.result.status == "certified"
    free = sr.bound(stated)
    held = sr.bound(outcome, out=tmp_path / "out")
    at_end = [row for row in held.rows if row.constraint == "terminal"]
    assert free.rows[1].upper > 0.5
    assert all(row.margin >= -1e-7 for row in held.rows)
    assert min(row.margin for row in at_end) == pytest.approx(0.0, abs=1e-5)
    assert [row.upper for row in sr.bound(tmp_path / "run").rows] == [row.upper for row in held.rows]
    assert sr.check(tmp_path / "out").status == "verified"


def test_delay_drift_and_moving_walls_are_bounded_and_checked(tmp_path: Path) -> None:
    """x' = 0.5 + u, delayed by 0.5 with u = 1 before: x(2) - r(2) = 0.5 + 1 - 1, and least in between."""
    stated = config(
        system={"A": [[0]], "B": [[1]], "c": [0.5], "delay": 0.5}, initial_state=[0], initial_control=[1],
        path=[{"box": 5.0, "relative_to": [[0, 0], [2, 1]]}],
    )  # fmt: skip
    found = sr.bound(stated, out=tmp_path / "out")
    assert_encloses(found.rows[0], 0.5)
    assert_encloses(found.rows[1], 0.0)
    assert sr.check(tmp_path / "out").status == "verified"


def test_pieces_of_the_system_are_bounded_and_checked(tmp_path: Path) -> None:
    """x' = x until 1, then x' = -x: the largest is e."""
    pieces = [{"until": 1.0, "A": [[1]], "B": [[1]]}, {"until": 2.0, "A": [[-1]], "B": [[1]]}]
    found = sr.bound(config(system={"pieces": pieces}, initial_state=[1], path=[{"box": 5.0}]), out=tmp_path / "out")
    assert_encloses(found.rows[0], math.e)
    assert sr.check(tmp_path / "out").status == "verified"


@pytest.mark.slow
def test_entries_in_the_time_are_bounded_and_checked(tmp_path: Path) -> None:
    """``x' = cos(t) w``, |w| <= 0.1: ``1 + 0.1 sin t`` at most where ``w`` stays what it is, ``1 + 0.1`` times the
    integral of ``|cos|`` where it may be anything; a drift ``p sin t`` with ``0 <= p <= 0.5`` adds 1 until pi."""
    system = {"A": [[0]], "B": [[1]], "E": [["cos(t)"]]}
    stated = config(
        system=system, horizon=math.pi, initial_state=[1], disturbance={"box": [0.1]}, path=[{"box": [3.0]}]
    )
    constant = sr.bound(stated, out=tmp_path / "constant")
    assert_encloses(constant.rows[0], 1.1)
    assert constant.rows[0].time == pytest.approx(math.pi / 2, abs=1e-2)
    anything = {"problem.disturbance_class": "measurable"}
    measurable = sr.bound(stated, anything, out=tmp_path / "measurable")
    assert_encloses(measurable.rows[0], 1.2)
    uncertain = {**system, "c": ["p * sin(t)"], "parameters": {"p": [0.0, 0.5]}}
    stated["problem"].update(system=uncertain, path=[], terminal=[{"box": [3.0]}])
    found = sr.bound(stated, anything, out=tmp_path / "uncertain")
    for exact in (2.2, 0.8):
        (row,) = (row for row in found.rows if row.lower - 1e-6 < exact < row.upper + 1e-6)
        assert_encloses(row, exact)
    assert [(row.sense, row.quantity, row.corner) for row in found.over_parameters] == [
        ("sup", "x1", "p = 0.5"),
        ("inf", "x1", "p = 0"),
    ]
    for row, exact in zip(found.over_parameters, (2.2, 0.8), strict=True):
        assert_encloses(row, exact)
    assert [told[1:2] + told[-1:] for told in list_bound_rows(found)] == [("sup x1", "p = 0.5"), ("inf x1", "p = 0")]
    for run in ("constant", "measurable", "uncertain"):
        assert sr.check(tmp_path / run).status == "verified"


def test_rows_at_corners_of_parameters_beside_the_time_are_told_as_one_quantity() -> None:
    """x1(t) + x2(t) is p and (1 + q) t more than at first: p acts on x2 alone, q on both; r on nothing."""
    stated = sr.OptimalControlProblem(
        system=sr.VaryingSystem.of(
            [["0", "0"], ["0", "0"]],
            [["1 + q"], ["q"]],
            1.0,
            c=["0 * t", "p"],
            parameters=sr.Box([0.0, -0.5, 1.0], [2.0, 0.5, 2.0]),
            names=["p", "q", "r"],
        ),
        horizon=1.0,
        initial_state=[0, 0],
        control=sr.Box([-1], [1]),
        terminal=[sr.Polytope([[1.0, 0.0], [1.0, 1.0]], [5.0, 5.0])],
    )
    larger = integrals_as_states(stated)
    corners = larger.names.corners
    assert corners is not None
    told = [(row.quantity(larger), corners.at(row.direction)) for row in rows_of(larger)]
    assert told == [
        ("x1", "q = -0.5"),
        ("x1 + x2", "p = 0, q = -0.5"),
        ("x1", "q = 0.5"),
        ("x1 + x2", "p = 0, q = 0.5"),
        ("x1 + x2", "p = 2, q = -0.5"),
        ("x1 + x2", "p = 2, q = 0.5"),
    ]


def test_an_integral_is_bounded_and_checked(tmp_path: Path) -> None:
    """The integral of x1 of the double integrator to 2, from (1, 0) under w2: 2 + 0.05 2^3 / 6 at most."""
    found = sr.bound(
        config(disturbance={"box": [0.0, 0.05]}, integral=[{"H": [[1, 0]], "upper": [3.0]}]), out=tmp_path / "out"
    )
    assert [(row.constraint, row.sense) for row in found.rows] == [("integral", "sup")]
    assert_encloses(found.rows[0], 2.0 + 0.05 * 8.0 / 6.0)
    assert sr.check(tmp_path / "out").status == "verified"


IN_TIME = {"A": [[0, 1], ["-1 - 0.3 * sin(t)", -0.2]], "B": [[0], ["exp(-t / 20)"]], "E": [[0], [1]]}
LATER = {"until": 8.0, "A": [[0, 1], [-1, -0.1]], "B": [[0], [1]], "E": [[0], [1]]}
TWICE = {"pieces": [LATER | {"until": 4.0}, LATER]}


@pytest.mark.slow
@pytest.mark.parametrize("system", [IN_TIME, TWICE])
def test_rows_whose_terms_cancel_and_rows_that_are_0_are_bounded_and_checked(tmp_path: Path, system: dict) -> None:
    """What the control leaves of x1(8) is a hundred thousandth of what it is made of; nothing is commanded at first."""
    stated = config(
        8,
        system=system,
        horizon=8.0,
        disturbance={"box": 0.05},
        terminal=[{"box": {"lower": [-1, -1], "upper": [1e-5, 1]}}],
        integral=[{"G": [[1]], "from": 0, "to": 1, "upper": 0.0, "lower": 0.0, "name": "fuel"}],
    )
    assert sr.run(stated, out=tmp_path / "run", quiet=True, figures=False).result.status == "certified"
    found = sr.bound(tmp_path / "run", out=tmp_path / "out")
    at_end = next(row for row in found.rows if row.constraint == "terminal" and row.sense == "sup")
    assert at_end.lower == pytest.approx(1e-5, rel=1e-3)
    assert sr.check(tmp_path / "out").status == "verified"
    free = sr.bound(stated)
    assert free.status == "certified"
    for row in free.rows:
        if row.constraint == "fuel":
            assert_encloses(row, 0.0)


def test_round_sets_have_witnesses_inside(tmp_path: Path) -> None:
    """|w| <= 0.1 and |x(0) - (1, 0)| <= 0.1: x1(2) of the double integrator is 1 + 0.1 (sqrt 5 + sqrt 8) at most."""
    ball = {"norm": {"p": 2, "radius": 0.1}}
    stated = config(initial_state={"centre": [1, 0], **ball}, disturbance=ball, terminal=[{"box": [3.0, None]}])
    found = sr.bound(stated, out=tmp_path / "out")
    assert_encloses(found.rows[0], 1.0 + 0.1 * (math.sqrt(5.0) + math.sqrt(8.0)))
    assert sr.check(tmp_path / "out").status == "verified"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bound") / "out"
    sr.bound(
        config(initial_state={"centre": [1, 0], "box": [0.1, 0.05]}, disturbance={"box": [0.02, 0.03]},
               path=[{"box": [2.0, None]}]),
        out=out,
    )  # fmt: skip
    return out


FORGED = {
    "upper side narrowed": lambda row: row.update(upper=row["upper"] - 3e-6, margin=row["margin"] + 3e-6),
    "upper side narrowed, and a calm witness": lambda row: row.update(
        upper=1.2999, margin=2.0 - 1.2999, lower=0.999, deviation=[0.0, 0.0], disturbance=[[0.0], [0.0]]
    ),
    "lower side narrowed": lambda row: row.update(lower=row["upper"]),
    "witness too early": lambda row: row.update(time=1.0),
    "witness outside its window": lambda row: row.update(time=2.5),
    "deviation outside its set": lambda row: row.update(deviation=[0.2, 0.05]),
    "deviation of the other side": lambda row: row.update(deviation=[-0.1, -0.05]),
    "disturbance outside its set": lambda row: row.update(disturbance=[[0.03], [0.03]]),
    "disturbance that jumps": lambda row: row.update(changes=[0.0, 1.0, 2.0], disturbance=[[0.02, 0.01], [0.03, 0.0]]),
    "another sense": lambda row: row.update(sense="inf"),
    "another wall": lambda row: row.update(wall=3.0, margin=row["margin"] + 1.0),
    "another margin": lambda row: row.update(margin=row["margin"] + 1e-3),
    "a parameter that there is not": lambda row: row.update(parameter=[0.0]),
    "no witness": lambda row: row.update(time="late"),
}


@pytest.mark.first(7)
@pytest.mark.parametrize("fault", FORGED)
def test_a_forged_worst_case_is_refuted(written: Path, tmp_path: Path, fault: str) -> None:
    data = json.loads((written / "bound.json").read_text())
    assert verdicts(written) == ["holds"] * 4
    FORGED[fault](data["rows"][0])
    (tmp_path / "config.yaml").write_text((written / "config.yaml").read_text())
    (tmp_path / "bound.json").write_text(json.dumps(data))
    assert verdicts(tmp_path) == ["holds", "holds", "fails", "holds"]


ROWS = {
    "another direction": lambda rows: rows[0].update(direction=[0.0, 1.0]),
    "another constraint": lambda rows: rows[0].update(constraint="terminal"),
    "one left out": lambda rows: rows.pop(),
    "one twice": lambda rows: rows.append(rows[0]),
    "no row": lambda rows: rows.append(3),
}


@pytest.mark.parametrize("fault", ROWS)
def test_rows_that_are_not_those_of_the_problem_are_refuted(written: Path, tmp_path: Path, fault: str) -> None:
    data = json.loads((written / "bound.json").read_text())
    ROWS[fault](data["rows"])
    (tmp_path / "config.yaml").write_text((written / "config.yaml").read_text())
    (tmp_path / "bound.json").write_text(json.dumps(data))
    assert verdicts(tmp_path)[1] == "fails"


def test_the_certificate_is_about_its_config(written: Path, tmp_path: Path) -> None:
    (tmp_path / "bound.json").write_text((written / "bound.json").read_text())
    (tmp_path / "config.yaml").write_text((written / "config.yaml").read_text().replace("0.03", "0.029"))
    assert verdicts(tmp_path)[0] == "fails"


def test_what_is_known_at_the_limit_holds(tmp_path: Path) -> None:
    system = {"A": [[0, 1], ["-omega^2", 0]], "B": [[0], [1]], "parameters": {"omega": [0.9, 1.1]}}
    stated = config(system=system, horizon=6.0, path=[{"box": [2.0, None]}])
    found = sr.bound(stated, seconds=1e-3, out=tmp_path / "out")
    assert found.status == "undecided"
    assert found.rows[0].lower <= 1.0 <= found.rows[0].upper
    assert "limit" in found.rows[0].reason
    assert sr.check(tmp_path / "out").status in ("verified", "undecided")


def test_two_runs_write_the_same_numbers(written: Path, tmp_path: Path) -> None:
    sr.bound(written / "config.yaml", out=tmp_path / "again")
    first, second = (json.loads((at / "bound.json").read_text()) for at in (written, tmp_path / "again"))
    assert {**first, "seconds": 0, "title": ""} == {**second, "seconds": 0, "title": ""}


def test_what_the_table_shows_holds_too() -> None:
    names = {"units": {"time": "s"}}
    found = sr.bound(config(initial_state=[1 / 3, 0], terminal=[{"box": [2.0, None]}], names=names))
    assert list_bound_columns(found)[4] == "at t [s]"
    for told, row in zip(list_bound_rows(found), found.rows, strict=True):
        assert float(told[2]) <= row.lower <= row.upper <= float(told[3])


@pytest.mark.parametrize(
    ("stated", "arguments", "named"),
    [
        (config(), {"tolerance": 0.0}, "tolerance"),
        (config(), {"tolerance": "narrow"}, "tolerance"),
        (config(), {"seconds": -1.0}, "seconds"),
        (config(terminal=[{"norm": {"p": 2, "radius": 0.3}}]), {}, "terminal"),
        (3, {}, "config"),
    ],
)
def test_bad_input_is_named(stated: object, arguments: dict, named: str) -> None:
    with pytest.raises(sr.InputError) as told:
        sr.bound(stated, **arguments)
    assert named in str(told.value)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 0.5])
def test_worst_cases_of_a_run_have_the_worst_errors_of_execution(delay: float, tmp_path: Path) -> None:
    # x' = u from -1 to at most 0.1 from 0: 0.9 / 0.95 is commanded, of which 0.95 to 1.05 arrive
    stated = config(
        pieces=4,
        system={"A": [[0]], "B": [[1]], "delay": delay},
        initial_state=[-1],
        control={"box": [1]},
        execution=[0.05],
        terminal=[{"box": [0.1]}],
    )
    sr.run(stated, out=tmp_path / "run", figures=False)
    found = sr.bound(tmp_path / "run", out=tmp_path / "bound")
    least, most = sorted(found.rows, key=lambda row: row.lower)
    assert [least.lower, least.upper] == pytest.approx([-0.1, -0.1], abs=1e-8)
    assert [most.lower, most.upper] == pytest.approx([1.05 * 0.9 / 0.95 - 1.0] * 2, abs=1e-8)
    assert set(verdicts(tmp_path / "bound")) == {"holds"}
    assert sr.bound(stated).rows


@pytest.mark.slow
def test_a_run_that_answers_what_it_measures_is_refused(tmp_path: Path) -> None:
    stated = config(pieces=4, initial_state=[0.1, 0], disturbance={"box": [0.0, 0.1]}, terminal=[{"box": [0.4, 0.4]}])
    outcome = sr.run({**stated, "policy": {"name": "affine", "cost": "nominal"}}, out=tmp_path / "run", figures=False)
    with pytest.raises(sr.InputError, match="policy"):
        sr.bound(outcome)


def stated_plant(plant: dict, centre: np.ndarray, radius: np.ndarray, inputs: sr.Box, row: np.ndarray, wall: float):
    return sr.OptimalControlProblem(
        system=sr.LinearSystem(plant["A"], np.zeros((centre.size, 1)), E=plant["B"]),
        horizon=20.0, initial_state=centre, initial_set=sr.Box(-radius, radius), control=sr.Box([-1.0], [1.0]),
        disturbance=inputs, disturbance_class="measurable",
        path=[sr.PathConstraint(sr.Polytope(np.vstack([row, -row]), [wall, wall]))],
    )  # fmt: skip


@needs_plants
@pytest.mark.slow
def test_the_building_of_48_states_is_bounded_and_checked(tmp_path: Path) -> None:
    """BLDF01: at t = 0.078 the worst x25 is 4.453677e-3, a little before it more."""
    centre, radius = np.zeros(48), np.zeros(48)
    centre[:10], radius[:10], radius[24] = 2.25e-4, 0.25e-4, 1e-4
    problem = stated_plant(matrices("building"), centre, radius, sr.Box([0.8], [1.0]), np.eye(48)[24], 5e-3)
    found = sr.bound(problem, out=tmp_path / "out")
    top = found.rows[0]
    assert 4.4536e-3 <= top.lower <= top.upper <= 4.456e-3
    assert top.time == pytest.approx(0.078, abs=1e-3)
    assert sr.check(tmp_path / "out").status == "verified"


@needs_plants
@pytest.mark.slow
def test_the_space_station_of_270_states_is_bounded() -> None:
    """ISSF01: an independent program found 5.98783e-4 at t = 19.228 and -5.96004e-4 at t = 19.612."""
    station = matrices("iss")
    inputs = sr.Box([0.0, 0.8, 0.9], [0.1, 1.0, 1.0])
    problem = stated_plant(station, np.zeros(270), np.full(270, 1e-4), inputs, station["C"][2], 7e-4)
    found = sr.bound(problem)
    for row, value, time in zip(found.rows, (5.98783e-4, -5.96004e-4), (19.228, 19.612), strict=True):
        assert row.lower - 5e-9 <= value <= row.upper + 5e-9
        assert row.time == pytest.approx(time, abs=2e-3)
    assert found.status == "certified"
