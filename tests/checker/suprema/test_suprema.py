"""Guards checker/suprema: either side of a worst case is where a walk of our own says, and no nearer; witnesses, rows,
senses, walls and margins that are not the problem's are refused."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flint import ctx

import sparserob_core as sr
from sparserob_core.checker.claims.claims import PRECISION
from sparserob_core.checker.suprema.suprema import check_suprema
from sparserob_core.control.sets.sets import Box
from sparserob_core.sip.convex_set import Array
from tests.support.worst_cases import (
    BEGUN,
    BOUND,
    CHANGES,
    DIRECTIONS,
    ENDS,
    HORIZON,
    KINDS,
    START,
    TIMES,
    Kind,
    kind,
    walls,
)

ROOM = 5e-3  # what a row rises between two samples
WHICH = ("fixed", "moving", "mixed")


@pytest.fixture(autouse=True)
def precision() -> Any:
    with ctx.workprec(PRECISION):
        yield


def witness(made: Kind, row: Array, time: float) -> dict[str, Any]:
    """The deviation and the disturbance that are worst for a row at a time."""
    said: dict[str, Any] = {"parameter": [], "deviation": [0.0, 0.0], "changes": [0.0, HORIZON]}
    if made.bound is None or made.begun is None:
        return {**said, "disturbance": None}
    w = made.motion.weights(row[None], time)
    inwards = 1.0 - 1e-9  # a support point of an ellipsoid is on its boundary but for rounding
    middle = (made.begun.support_point(np.eye(2)) + made.begun.support_point(-np.eye(2))).mean(axis=0) / 2.0
    deviation = middle + inwards * (made.begun.support_point(w.free)[0] - middle)
    grid = sorted({*made.case().timing.grid, *made.motion.changes.tolist()})  # systems in pieces want all of their own
    signal = made.bound.support_point(w.blocks[0])[np.searchsorted(made.motion.changes, grid[:-1], side="right") - 1].T
    return {**said, "deviation": deviation.tolist(), "changes": grid, "disturbance": signal.tolist()}


def written(made: Kind, which: str, far: float = 1.0, **more: Any) -> tuple[Any, Any]:
    """Rows of walls that are ``far`` away, as they are but for `ROOM`, and what judges such rows."""
    wall, times, heights = walls("any", which, made)
    highest, limits = heights.max(axis=0), heights.max(axis=0) + far
    if which == "mixed":  # where the control jumps, a witness sees what comes after
        seen = ~np.isin(times, ENDS)
        times, heights = times[seen], heights[seen]
    facets = made.case(path=[wall(limits)], **more).windows[0].enclosed_set.facets
    rows = []
    for direction, b in facets:
        i = int(np.abs(DIRECTIONS - direction[:2]).sum(axis=1).argmin())
        sign, time = (
            (-1.0 if direction[np.flatnonzero(direction)[0]] < 0 else 1.0),
            float(times[heights[:, i].argmax()]),
        )
        ends = sorted((sign * (heights[:, i].max() - 1e-8), sign * (highest[i] + ROOM)))
        limit = float(b.mid())
        rows.append({
            "constraint": "path", "direction": direction.tolist(), "sense": "sup" if sign > 0 else "inf",
            "quantity": "row", "lower": ends[0], "upper": ends[1], "wall": sign * limit,
            "margin": limit - highest[i] - ROOM, "time": time, **witness(made, DIRECTIONS[i], time),
        })  # fmt: skip

    def judged(rows: Any, form: object = 1) -> list[str]:
        said = {"format": form, "rows": rows}
        found = check_suprema(made.case(said, path=[wall(limits)], **more))
        judged.texts = [one.text for one in found]  # type: ignore[attr-defined]
        return [one.verdict for one in found]

    return rows, judged


def nearer(row: dict[str, Any], by: float, end: str) -> dict[str, Any]:
    """The same row with one of its ends moved towards the other: ``proven`` or ``reached``."""
    upper = (row["sense"] == "sup") == (end == "proven")
    moved = {"upper": row["upper"] - by} if upper else {"lower": row["lower"] + by}
    return {**row, **moved, **({"margin": row["margin"] + by} if end == "proven" else {})}


@pytest.mark.parametrize("which", WHICH)
@pytest.mark.parametrize("name", KINDS[:-1])
def test_a_worst_case_is_between_what_is_reached_and_what_is_proven(name: str, which: str) -> None:
    rows, judged = written(kind(name), which)
    assert set(judged(rows)) == {"holds"}
    if which == "fixed":
        assert judged([nearer(row, 1e-7, "reached") for row in rows])[1:] == ["fails"] * len(rows)
    if which != "mixed":  # at a jump more is reached than by the witness, and a round set is never refuted by cells
        assert "holds" not in judged([nearer(row, ROOM + 1e-3, "proven") for row in rows])[1:]


@pytest.mark.parametrize(
    ("name", "which"), [("alone", "moving"), ("alone", "mixed"), ("known", "fixed"), ("late", "mixed")]
)
def test_cells_refute_what_no_witness_does(name: str, which: str) -> None:
    """By sets with flat sides, whose support functions are sharp, and a witness that shows less than it might."""
    made = kind(name)
    if made.begun is not None:
        made = replace(made, begun=Box([-0.05, -0.1], [0.1, 0.1]))
    rows, judged = written(made, which)
    for row in rows:
        row.update(time=0.25, deviation=[0.0, 0.0], **({"lower": -99.0} if row["sense"] == "sup" else {"upper": 99.0}))
    assert set(judged(rows)) == {"holds"}
    assert judged([nearer(row, ROOM + 1e-3, "proven") for row in rows])[1:] == ["fails"] * len(rows)


def test_a_wall_far_away_and_its_margin_are_compared_in_its_digits() -> None:
    rows, judged = written(kind("alone"), "fixed", far=1e7)
    for share, verdict in ((2e-12, "holds"), (1e-9, "fails")):
        for name in ("wall", "margin"):
            assert judged([{**rows[0], name: rows[0][name] * (1.0 + share)}, *rows[1:]])[1] == verdict


def test_measurable_disturbances_do_what_those_that_change_often_do_and_a_little_more() -> None:
    often = np.arange(0.0, HORIZON, 1.0 / 64.0)
    made = kind("known")
    made = replace(made, motion=replace(made.motion, changes=often, _steps={}))
    rows, judged = written(made, "fixed", disturbance_class="measurable")
    assert set(judged(rows)) == {"holds"}
    assert "holds" not in judged([nearer(row, ROOM + 1e-3, "proven") for row in rows])[1:]


OUTSIDE = np.array([0.02, 0.2])
WRONG: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "sense": (lambda row: row.update(sense="inf" if row["sense"] == "sup" else "sup"), "its direction is that of"),
    "empty": (lambda row: row.update(lower=row["upper"] + 1.0), "is empty"),
    "wall": (lambda row: row.update(wall=row["wall"] + 1e-6), "a wall at"),
    "margin": (lambda row: row.update(margin=row["margin"] + 1e-6), "a margin of"),
    "less margin": (lambda row: row.update(margin=row["margin"] - 1e-6), "a margin of"),
    "wall on the other side": (lambda row: row.update(wall=row["wall"] - 1e-6), "a wall at"),
    "margin without a bound": (
        lambda row: row.update({"upper" if row["sense"] == "sup" else "lower": None}),
        "a margin is written without a bound",
    ),
    "no wall": (lambda row: row.update(wall=None), "wall: expected numbers"),
    "early": (lambda row: row.update(time=0.2), "t = 0.2 is not within"),
    "late": (lambda row: row.update(time=1.9), "t = 1.9 is not within"),
    "a parameter": (lambda row: row.update(parameter=[0.0]), "parameter: 1 numbers where 0 are expected"),
    "a deviation outside": (
        lambda row: row.update(deviation=OUTSIDE.tolist()),
        "the deviation of the initial state is not shown",
    ),
    "a deviation of three": (lambda row: row.update(deviation=[0.0] * 3), "deviation: shape (3,), expected (2,)"),
    "changes that end early": (
        lambda row: row.update(changes=[*CHANGES, HORIZON - 0.1]),
        "changes: expected times from 0 to 2",
    ),
    "changes that begin late": (
        lambda row: row.update(changes=[0.1, *CHANGES[1:], HORIZON]),
        "changes: expected times from 0 to 2",
    ),
    "changes that stand still": (
        lambda row: row.update(changes=[0.0, 1.5, 1.5, HORIZON]),
        "changes: expected increasing times",
    ),
    "changes of its own": (lambda row: row.update(changes=[0.0, 0.7, 1.5, HORIZON]), "disturbance: shape"),
    "a disturbance outside": (
        lambda row: row.update(disturbance=(1.001 * np.array(row["disturbance"])).tolist()),
        "is not shown to be in its set",
    ),
    "another shape": (lambda row: row.update(disturbance=row["disturbance"][:1]), "disturbance: shape"),
    "a jump within a piece": (
        lambda row: row.update(
            changes=[0.0, 0.3, *row["changes"][1:]], disturbance=[[0.0, *one] for one in row["disturbance"]]
        ),
        "the disturbance jumps within a piece",
    ),
    "no disturbance": (lambda row: row.update(disturbance=None), "disturbance: expected numbers"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_row_that_is_not_the_problems_fails_alone(wrong: str) -> None:
    rows, judged = written(kind("known"), "fixed")
    changed = copy.deepcopy(rows)
    change, sentence = WRONG[wrong]
    change(changed[1])
    assert judged(changed) == ["holds", "holds", "fails", *["holds"] * (len(rows) - 2)]
    assert sentence in judged.texts[2]


def test_what_is_half_written_is_left_open() -> None:
    rows, judged = written(kind("known"), "fixed")
    for side, sentence in (("reached", "no value is written that is reached"), ("proven", "no bound is written on")):
        first = copy.deepcopy(rows[0])
        first["lower" if (first["sense"] == "sup") == (side == "reached") else "upper"] = None
        first["margin"] = None if side == "proven" else first["margin"]
        assert judged([first, *rows[1:]])[1] == "not checked"
        assert sentence in judged.texts[1]


def test_every_row_of_the_problem_is_written_once() -> None:
    rows, judged = written(kind("alone"), "fixed")
    first, *others, last = rows
    for changed in ([*others, last], [*rows, first], [first, *others, first], [first, *others, 3.0]):
        assert judged(changed)[0] == "fails"
    for said in ({"direction": [1.0, 1.0]}, {"constraint": "terminal"}):
        assert judged([first, *others, {**last, **said}])[0] == "fails"
    pushed = copy.deepcopy(rows)
    for said in ({"disturbance": [[0.0], [0.0]]}, {"deviation": [1e-9, 0.0]}):
        assert judged([{**pushed[0], **said}, *pushed[1:]])[1] == "fails"
    assert [judged(rows, form) for form in (2, 1.0, None, True)] == [["fails"]] * 4


def test_what_a_control_reaches_without_its_errors_of_execution_bounds_nothing_and_one_that_rests_has_none() -> None:
    made = kind("known")
    still = replace(made, u=np.zeros((2, 3)))
    for one, verdict in ((made, "fails"), (still, "holds")):
        rows, judged = written(one, "fixed", execution=[0.5, 0.0])
        assert judged(rows) == ["holds", *[verdict] * len(rows)]


def test_without_walls_outputs_are_asked_for_and_without_outputs_states() -> None:
    made = kind("known")
    for measured, normals in ((None, np.eye(2)), (sr.Measurements(C=[[1.0, 0.5]]), np.array([[1.0, 0.5]]))):
        rows = []
        for normal in normals:
            for sign in (1.0, -1.0):
                row = sign * normal
                heights = [made.heights(float(t), row[None])[0] for t in TIMES]
                most, time = max(heights), float(TIMES[int(np.argmax(heights))])
                ends = sorted((sign * (most - 1e-8), sign * (most + ROOM)))
                rows.append({
                    "constraint": "state" if measured is None else "output", "direction": row.tolist(),
                    "sense": "sup" if sign > 0 else "inf", "quantity": "x", "lower": ends[0], "upper": ends[1],
                    "time": time, **witness(made, row, time),
                })  # fmt: skip
        case = made.case({"format": 1, "rows": rows}, **({} if measured is None else {"measurements": measured}))
        assert {one.verdict for one in check_suprema(case)} == {"holds"}
        rows[0]["wall"] = 9.0
        assert [one.verdict for one in check_suprema(case)][1] == "fails"
    assert isinstance(BOUND, Box) and BEGUN.contains(np.array([0.02, 0.0])) and not BEGUN.contains(OUTSIDE)
    assert START.shape == (2,)
