"""Guards problems whose worst case rides on its wall all the time: a heated house, against a linear program."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.experiment.run import run as run_module
from sparserob_core.sip.evidence import Proof
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.methods import exchange, sparsest
from sparserob_core.sip.proof.branch_and_bound import MAX_PROOF_CELLS
from sparserob_core.sip.working import tightening
from sparserob_core.sip.working.ledger import prover_of
from sparserob_core.sip.working.plain import PlainRows
from sparserob_core.sip.working.robust import RobustRows

LOSS, GUST, WALL, START = (0.3, 0.5), 0.1, 1.0, 2.0


def house(pieces: int, uncertain: bool) -> dict[str, Any]:
    """One room: ``x' = -a x + u + w`` with ``|w| <= GUST``, never below ``WALL``, from ``START``."""
    loss = {"A": [["-a"]], "B": [[1]], "parameters": {"a": list(LOSS)}}
    known = {"A": [[-LOSS[1]]], "B": [[1]]}
    return {
        "problem": {
            "name": "linear",
            "system": loss if uncertain else known,
            "horizon": pieces / 4,
            "initial_state": [START],
            "control": {"box": {"lower": [0.0], "upper": [2.0]}},
            "disturbance": {"box": [GUST]},
            "path": [{"polytope": {"H": [[-1.0]], "h": [-WALL]}}],
        },
        "dictionaries": {name: {"name": "piecewise_constant", "pieces": pieces} for name in ("control", "disturbance")},
    }


def least_heat(pieces: int) -> float:
    """The value. The lowest state obeys ``y' = -a y + u - GUST`` with the largest loss, since y is positive; it is
    monotone on every piece, so that the nodes are all that counts."""
    step, loss = 0.25, LOSS[1]
    stays, gains = np.exp(-loss * step), (1 - np.exp(-loss * step)) / loss
    ages = np.subtract.outer(np.arange(1, pieces + 1), np.arange(1, pieces + 1))
    heated = np.where(ages >= 0, gains * stays ** np.maximum(ages, 0), 0.0)
    free = START * stays ** np.arange(1, pieces + 1) - heated @ np.full(pieces, GUST)
    found = linprog(np.full(pieces, step), A_ub=-heated, b_ub=free - WALL, bounds=(0.0, 2.0))
    assert found.status == 0
    return float(found.fun)


@pytest.mark.parametrize(
    ("pieces", "uncertain"),
    [
        (16, False),
        pytest.param(16, True, marks=pytest.mark.slow),
        pytest.param(64, False, marks=pytest.mark.slow),
        pytest.param(64, True, marks=pytest.mark.slow),
    ],
)
def test_a_wall_that_is_ridden_all_day_takes_few_rounds_however_long_the_day(pieces: int, uncertain: bool) -> None:
    result = sr.run(house(pieces, uncertain), quiet=True, figures=False).result
    assert result.status == "certified"
    assert abs(result.cost - least_heat(pieces)) <= 1e-6 * result.cost
    assert result.counts["rounds"] <= 12


def ridden(wall: str, pieces: int, uncertain: bool = False, feedback: bool = False) -> dict[str, Any]:
    """``x' = -a x + u + w``, one state or two, along a wall that is sloped or has bends, or inside an ellipse that
    moves: the cheapest control rides it all the time."""
    horizon = pieces / 4
    bent = [[0, 1.5], [1, 1.5], [2, 1.5 + horizon / 8], [3, 1.5 + horizon / 8], [4, 1.5]]
    along = {
        "sloped": [[0, 1.5], [horizon, 1.5 + horizon / 8]],
        "moving": [[row[0] * horizon / 4, row[1]] for row in bent],
        "curved": [[0, 1.5, 1.0], [horizon, 1.5 + horizon / 16, 1.0 + horizon / 12]],
    }[wall]
    size = len(along[0]) - 1
    A = [[("-a" if uncertain else -0.5) if i == j else 0 for j in range(size)] for i in range(size)]
    flat, round_ = {"polytope": {"H": [[-1.0]], "h": [0.0]}}, {"ellipsoid": {"shape": [[0.04, 0], [0, 0.02]]}}
    names = ("control",) if feedback else ("control", "disturbance")
    return {
        "problem": {
            "name": "linear",
            "system": {"A": A, "B": np.eye(size).tolist(), **({"parameters": {"a": [0.45, 0.5]}} if uncertain else {})},
            "horizon": horizon,
            "initial_state": [1.6, 1.0][:size],
            "control": {"box": {"lower": [0.0] * size, "upper": [6.0] * size}},
            "disturbance": {"box": [0.02] * size},
            "path": [{**(flat if size == 1 else round_), "relative_to": along, "from": 0.25}],
        },
        "dictionaries": {name: {"name": "piecewise_constant", "pieces": pieces} for name in names},
        "observers": [],
        **({"policy": {"name": "affine"}} if feedback else {}),
    }


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("wall", "uncertain", "feedback", "most"),
    [
        ("sloped", False, False, 6),
        pytest.param("sloped", True, False, 11, marks=pytest.mark.slow),
        ("moving", False, False, 14),
        pytest.param("moving", True, False, 16, marks=pytest.mark.slow),
        pytest.param("moving", False, True, 14, marks=pytest.mark.slow),
        pytest.param("curved", False, False, 24, marks=pytest.mark.slow),
    ],
)
def test_a_wall_that_moves_takes_no_more_rounds_the_longer_it_is_ridden(
    wall: str, uncertain: bool, feedback: bool, most: int
) -> None:
    for pieces in (8, 16) if feedback else (8, 32):
        result = sr.run(ridden(wall, pieces, uncertain, feedback), quiet=True, figures=False).result
        assert result.status == "certified"
        assert result.counts["rounds"] <= most


@pytest.mark.slow
def test_a_curved_wall_that_is_ridden_takes_few_rounds_with_parameters_too() -> None:
    result = sr.run(ridden("curved", 8, uncertain=True), quiet=True, figures=False).result
    assert result.status == "certified"
    assert result.counts["rounds"] <= 20


class Clock(Deadline):
    """A limit of a minute that is over after so many looks at it, whatever the clock says."""

    looks = 8

    def __init__(self, seconds: float | None = None) -> None:
        super().__init__(60.0)
        self.looked = 0

    def check(self) -> None:
        self.looked += 1
        super().check()

    @property
    def used(self) -> float:
        return min(1.0, self.looked / self.looks)

    @property
    def passed(self) -> bool:
        return self.looked > self.looks or super().passed

    @property
    def reason(self) -> str:
        return "the limit of 60 s is reached" if self.looked > self.looks else super().reason


@pytest.mark.slow
@pytest.mark.parametrize("feedback", [False, True])
def test_under_a_limit_what_little_would_pay_for_is_proven_at_once(
    feedback: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_module, "Deadline", Clock)
    monkeypatch.setattr(Clock, "looks", 10_000)  # no share of the limit is over
    result = sr.run(ridden("moving", 8, feedback=feedback), quiet=True, figures=False).result
    assert result.status == "certified"
    near = next(i for i, event in enumerate(result.history) if event.violation <= 1e-4)
    assert all(event.proven < np.inf for event in result.history[near + 1 :])
    assert near + 1 < len(result.history)


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("wall", "uncertain", "feedback", "method", "looks"),
    [
        ("moving", False, True, "exchange", 8),
        ("moving", True, False, "exchange", 36),
        ("moving", True, False, "sparsest", 36),
        pytest.param("moving", True, False, "reweighted", 36, marks=pytest.mark.slow),
    ],
)
def test_a_limit_leaves_a_proven_control_whatever_the_method(
    wall: str, uncertain: bool, feedback: bool, method: str, looks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_module, "Deadline", Clock)
    monkeypatch.setattr(Clock, "looks", looks)
    given = {**ridden(wall, 16, uncertain, feedback), "method": {"name": method}}
    result = sr.run(given, quiet=True, figures=False).result
    assert result.stopped == "the limit of 60 s is reached"
    assert result.status == "verified"
    assert result.lower_bound < result.upper_bound < 1.2 * result.lower_bound or method == "sparsest"
    assert np.isfinite(result.upper_bound)


def test_a_limit_leaves_a_proven_control_between_walls_that_are_closer_than_is_spared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(run_module, "Deadline", Clock)
    monkeypatch.setattr(Clock, "looks", 14)
    given, width = ridden("moving", 16), 1e-4
    problem = given["problem"]
    problem.update(initial_state=[1.5 + width / 2], disturbance={"box": [1e-7]}, system={"A": [[0.0]], "B": [[1.0]]})
    problem["path"].append({**problem["path"][0], "polytope": {"H": [[1.0]], "h": [width]}})
    problem["control"]["box"]["lower"] = [-6.0]
    result = sr.run(given, quiet=True, figures=False).result
    assert result.status == "verified"


@pytest.mark.first(1)
@pytest.mark.parametrize(("feedback", "looks"), [(False, 36), (True, 8)])
def test_a_relaxed_program_that_is_not_solved_leaves_the_control_that_is_proven(
    feedback: bool, looks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_module, "Deadline", Clock)
    monkeypatch.setattr(Clock, "looks", looks)
    monkeypatch.setattr(Clock, "passed", False)  # a share of the time is over, the time is not
    monkeypatch.setattr(Clock, "reason", "")
    rows = RobustRows if feedback else PlainRows
    relax = rows.relax

    def relaxed(working: Any, ledger: Any, *rest: Any) -> Any:
        answer = relax(working, ledger, *rest)
        failed = replace(answer.solution, status="failed", residual=1.0, message="nothing came of it")
        return answer if ledger.proven is None else ledger.without(replace(answer, solution=failed))

    monkeypatch.setattr(rows, "relax", relaxed)
    result = sr.run(ridden("moving", 16, not feedback, feedback), quiet=True, figures=False).result
    assert result.status == "verified"
    assert "nothing came of it" in result.message
    assert result.lower_bound < result.upper_bound < 1.2 * result.lower_bound


def test_with_an_alphabet_any_control_is_proven_before_the_sparsest_one(monkeypatch: pytest.MonkeyPatch) -> None:
    gaps: list[float] = []

    def spied(program: Any, relaxed: Any, rows: Any, letters: Any, gap: float = 0.0) -> Any:
        gaps.append(gap)
        return propose(program, relaxed, rows, letters, gap)

    propose = sparsest.propose_decision
    monkeypatch.setattr(sparsest, "propose_decision", spied)
    given = {**ridden("moving", 8), "method": {"name": "sparsest", "alphabet": [0, 0.5, 1.0, 1.5, 3.0, 6.0]}}
    result = sr.run(given, quiet=True, figures=False).result
    assert result.status == "certified"
    assert gaps[0] == sparsest.ANY, "the first one need not be the best"
    assert gaps == sorted(gaps, reverse=True), "those after a proven one are asked to be"


def test_a_limit_before_any_control_of_letters_leaves_open_whether_there_is_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(run_module, "Deadline", Clock)
    monkeypatch.setattr(Clock, "looks", 5)
    given = {**ridden("moving", 8), "method": {"name": "sparsest", "alphabet": [0, 0.5, 1.0, 1.5, 3.0, 6.0]}}
    result = sr.run(given, quiet=True, figures=False).result
    assert (result.status, result.decision) == ("undecided", None)
    assert result.stopped == "the limit of 60 s is reached"
    assert "limits.seconds" in result.message


def heating() -> dict[str, Any]:
    """Two rooms and their walls for a day in winter, comfort bands that move, an uncertain conductance, in kW and h."""
    A = [
        ["-(ua + 0.5) / 0.6", 0, "0.5 / 0.6"],
        [0, "-0.46 / 0.4", 1],
        ["0.5 / 6", "0.4 / 6", "-0.95 / 6"],
    ]
    B, E = [["1 / 0.6", 0], [0, "1 / 0.4"], [0, 0]], [["0.1 / 0.6", "1 / 0.6"], ["0.06 / 0.4", 0], ["0.05 / 6", 0]]
    drifts = {
        6.0: ["-2 * ua / 0.6", "-0.12 / 0.4", "-0.1 / 6"],
        18.0: ["4 * ua / 0.6", "0.24 / 0.4", "0.2 / 6"],
        24.0: [0, 0, 0],
    }
    comfort = [[0, 19, 18, 18], [6, 19, 18, 18], [8, 21, 19, 18], [22, 21, 19, 18], [24, 19, 18, 18]]
    return {
        "problem": {
            "name": "linear",
            "system": {
                "parameters": {"ua": [0.09, 0.11]},
                "pieces": [{"until": until, "A": A, "B": B, "E": E, "c": c} for until, c in drifts.items()],
            },
            "horizon": 24.0,
            "initial_state": {"centre": [19, 18, 18], "box": [0.3, 0.3, 0.3]},
            "control": {"box": {"lower": 0, "upper": [4, 3]}},
            "control_step": {"box": 1.5},
            "disturbance": {"box": [1.0, 0.05]},
            "path": [{"box": [2.0, 2.5, None], "relative_to": comfort, "from": 1.0}],
        },
        "dictionaries": {
            "control": {"name": "piecewise_constant", "step": 0.5},
            "disturbance": {"name": "piecewise_constant", "step": 1.0},
        },
    }


@pytest.mark.slow
def test_a_day_of_heating_is_certified_and_a_limit_leaves_a_proven_control() -> None:
    whole = sr.run(heating(), quiet=True, figures=False).result
    assert whole.status == "certified"
    limited = sr.run(heating(), {"limits.seconds": 10}, quiet=True, figures=False).result
    assert limited.status in ("certified", "verified")
    assert whole.lower_bound <= limited.upper_bound <= 1.05 * whole.lower_bound


def test_where_nothing_is_as_far_away_as_large_cells_ask_for_smaller_ones_prove(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A proof whose large cells exclude nothing below the size of the wall, as in four dimensions."""
    monkeypatch.setattr(run_module, "Deadline", Clock)
    monkeypatch.setattr(Clock, "looks", 20)

    def coarse(program: Any, tools: Any) -> Any:
        proving = prover_of(program, tools)

        def prover(x: Any, cells: int = MAX_PROOF_CELLS) -> Any:
            open_ = Proof("path", "undecided", 1e3, index=np.array([2.0]), row=0, cells=1, formulation="reduced")
            return proving(x, cells) if cells > tightening.GLANCE else [open_]

        return prover

    monkeypatch.setattr(exchange, "prover_of", coarse)
    result = sr.run(ridden("moving", 16), quiet=True, figures=False).result
    assert result.status == "verified"
