"""Guards checker/claims of controls that answer: what is claimed of policies with random gains, against loops that are
stepped from breakpoint to breakpoint and measure what they answer."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest
from flint import ctx

import sparserob_core as sr
from sparserob_core.checker.claims import claims, constraints, replay
from sparserob_core.checker.claims import multipliers as bounds
from sparserob_core.checker.claims.answers import feedback_of
from sparserob_core.checker.claims.case import Case, written_policy
from sparserob_core.checker.claims.units import units_of
from sparserob_core.checker.outcome import Broken
from sparserob_core.control.policies.affine import AffinePolicy
from sparserob_core.control.sets.sets import Box
from tests.support.closed_loops import LOOPS, Loop, gains

NAMES = ("box", "outputs", "fast")
DIRECTIONS = np.array([[1.0, 0.0], [-0.6, 0.8], [-1.0, 0.3]])
BESIDE = np.array([[0.5], [-0.25], [1.0]])
MOVING = np.array([[0.25, 0.5, 0.0], [1.0, -0.5, 0.75], [1.875, 0.25, -0.5]])
START, STOP = 0.25, 1.875
END, STEP = Box([-0.5, -0.25], [0.75, 1.0]), "control_step"
TOO_MUCH, NOTHING = 5e-9, 3e-10  # of a unit: more and less than what counts as none


@pytest.fixture(autouse=True)
def precision() -> Any:
    with ctx.workprec(96):
        yield


@cache
def driven(name: str) -> tuple[Loop, np.ndarray, np.ndarray]:
    """A loop with its nominal control and gains."""
    loop = LOOPS[name]
    v, M = gains(np.random.default_rng(11), loop)
    if loop.begun is None:
        M[:, 0] = 0.0  # nothing is to be seen at the beginning
    return loop, v, M


def case_of(name: str, cost: str = "nominal", certificate: dict[str, Any] | None = None, **more: Any) -> Case:
    loop, v, M = driven(name)
    said = {"decision": v.tolist(), "gains": M.tolist(), "status": "verified", **(certificate or {})}
    said |= {} if loop.observer is None else {"observer": loop.observer.tolist()}
    return Case(replace(loop.problem, **more), *loop.grids, said, policy=AffinePolicy(cost=cost))


@cache
def states(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Dense times of the window, the state with its responses there, and the controls."""
    loop, v, M = driven(name)
    times = np.unique([*np.linspace(START, STOP, 209), *loop.grid[(loop.grid > START) & (loop.grid < STOP)]])
    found, _, controls = loop.states(v, M, times)
    return times, found, controls


def beside(name: str, which: str, side: str = "right") -> np.ndarray:
    """The rows at the times of the window with what stands beside the state, ``(T, r, 1 + Q)``."""
    times, found, controls = states(name)
    along = DIRECTIONS @ found
    if which == "moving":
        along[..., 0] -= np.stack([np.interp(times, MOVING[:, 0], MOVING[:, i]) for i in (1, 2)], 1) @ DIRECTIONS.T
    if which == "mixed":
        ends = driven(name)[0].breakpoints
        along = along + BESIDE @ controls[np.clip(np.searchsorted(ends, times, side=side) - 1, 0, len(controls) - 1)]
    return along


def wall(which: str, limits: np.ndarray) -> Any:
    if which == "mixed":
        return sr.MixedConstraint(DIRECTIONS, BESIDE, limits, START, STOP)
    return sr.PathConstraint(
        sr.Polytope(DIRECTIONS, limits), START, STOP, relative_to=MOVING if which == "moving" else None
    )


def admissible(loop: Loop, rng: np.random.Generator) -> tuple[np.ndarray, dict[str, Any]]:
    """Deviations ``(Q,)`` on the edge of their sets, and as a certificate names them."""
    points = [shape.support_point(rng.normal(size=(1, shape.dimension)))[0] for shape, _ in loop.sets]
    points = [middle + 0.999 * (point - middle) for point, (_, middle) in zip(points, loop.sets, strict=True)]
    off = [point - middle for point, (_, middle) in zip(points, loop.sets, strict=True)]
    said, blocks = {}, 0 if loop.bound is None else loop.changes.size - 1
    if blocks:
        said["disturbance"] = np.transpose(points[:blocks]).tolist()
    if loop.noise is not None:
        said["noise"] = np.array(points[blocks : blocks + loop.breakpoints.size - 1]).tolist()
    if loop.begun is not None:
        said["deviation"] = points[-1].tolist()
    return np.concatenate(off), said


@pytest.mark.parametrize("which", ["fixed", "moving", "mixed"])
@pytest.mark.parametrize("name", NAMES)
def test_a_wall_may_be_where_the_worst_deviation_takes_the_loop_and_no_nearer(name: str, which: str) -> None:
    loop, _, _ = driven(name)
    times, _, _ = states(name)
    sides = [loop.height(beside(name, which, side)) for side in ("left", "right")]
    highest = np.maximum(*sides).max(axis=0)
    proof = {"proof": {"path": {"tolerance": 1e-9, "lower": [[START]], "upper": [[STOP]]}}}
    judged = case_of(name, certificate=proof, path=[wall(which, highest + 5e-3)])
    assert "margin" in constraints.bounded(judged, judged.windows[0])
    i = (NAMES.index(name) + len(which)) % len(DIRECTIONS)
    near = case_of(name, certificate=proof, path=[wall(which, highest + np.where(np.arange(3) == i, -1e-3, 5e-3))])
    with pytest.raises(Broken, match="exceeded"):
        constraints.bounded(near, near.windows[0])
    # row by row, and at single deviations
    order = [int(np.abs(DIRECTIONS - c[:2]).sum(axis=1).argmin()) for c, _ in judged.windows[0].enclosed_set.facets]
    rng = np.random.default_rng(5)
    for t in (0, 60, int(np.searchsorted(times, loop.breakpoints[1])), times.size - 1):
        said = {"constraint": "path", "time": float(times[t]), "violation": 0.0}
        found = np.array(replay.exceeded(judged, said)[0]).reshape(-1, len(DIRECTIONS)).max(axis=0)
        truth = np.maximum(*(side[t] for side in sides)) - highest - 5e-3
        assert found == pytest.approx(truth[order], abs=1e-9)
        off, named = admissible(loop, rng)
        piece = int(np.clip(np.searchsorted(loop.breakpoints, times[t], side="right") - 1, 0, loop.breakpoints.size))
        direction = np.append(DIRECTIONS[i], BESIDE[i] if which == "mixed" else [])
        over, slack = replay.witnessed(judged, {**said, **named, "direction": direction.tolist(), "piece": piece})
        along = beside(name, which)[t, i]
        assert float(over.mid()) == pytest.approx(along[0] + along[1:] @ off - highest[i] - 5e-3, abs=1e-9)
        assert 0.0 < slack < 1e-7


def test_the_top_of_a_wave_between_breakpoints_counts_to_what_counts_as_none() -> None:
    loop, v, M = driven("fast")
    times, _, _ = states("fast")
    row = np.array([[0.6, 0.8]])
    heights = loop.height((row @ states("fast")[1])[:, 0])
    t = times[1:-1][(heights[1:-1] >= np.maximum(heights[:-2], heights[2:]))][0]
    for width in (1e-2, 1e-4):
        near = np.linspace(t - width, t + width, 401)
        found = loop.height((row @ loop.states(v, M, near)[0])[:, 0])
        t, top = near[found.argmax()], found.max()
    proof = {"proof": {"path": {"tolerance": 1e-9, "lower": [[t - 0.125]], "upper": [[t + 0.0625]]}}}
    wall = sr.PathConstraint(sr.Polytope(row, [top]), t - 0.125, t + 0.0625)
    plain = case_of("fast", path=[wall])
    unit = float(units_of(plain, plain.windows[0]).rows[0])
    for share in (NOTHING, 2e-9):
        wall = replace(wall, set=sr.Polytope(row, [top - share * unit]))
        judged = case_of("fast", certificate=proof, path=[wall])
        if share == NOTHING:
            assert constraints.bounded(judged, judged.windows[0])
        else:
            with pytest.raises(Broken, match="exceeded"):
                constraints.bounded(judged, judged.windows[0])


@pytest.mark.parametrize("name", NAMES)
def test_controls_and_steps_are_as_large_as_the_worst_deviation_makes_them(name: str) -> None:
    loop, _, _ = driven(name)
    _, _, U = states(name)
    before = np.zeros_like(U[:1])
    before[0, 0, 0] = 0.2
    for steps, judged, tell in (
        (U, claims._verify_control, "control"),
        (np.diff(np.concatenate([before, U]), axis=0), claims._verify_steps, STEP),
    ):
        ends = [float(loop.height(s * steps[:, 0]).max()) for s in (-1.0, 1.0)]
        unit = min(abs(ends[0]), abs(ends[1]), sum(ends))
        for side, share in product((0, 1), (-NOTHING, TOO_MUCH)):
            low, high = -ends[0] + unit * share * (side == 0), ends[1] - unit * share * (side == 1)
            one = case_of(name, initial_control=[0.2], **{"control" if tell == "control" else STEP: Box([low], [high])})
            if share < 0.0:
                assert judged(one)
            else:
                with pytest.raises(Broken, match="leaves its set"):
                    judged(one)
        for k, at in enumerate(loop.breakpoints[:-1].tolist()):
            said = {"constraint": tell, "time": at, "violation": 0.0}
            wide = {"control": Box([-9.0], [8.0]), STEP: Box([-9.0], [8.0])}
            found = replay.exceeded(case_of(name, initial_control=[0.2], **wide), said)[0]
            truth = sorted([loop.height(steps[k, 0]) - 8.0, loop.height(-steps[k, 0]) - 9.0])
            assert sorted(found) == pytest.approx(truth, abs=1e-9)
            off, named = admissible(loop, np.random.default_rng(k))
            witness = {**said, **named, "direction": [-2.0], "time": at + 1e-3 * (tell == "control")}
            over, slack = replay.witnessed(case_of(name, initial_control=[0.2], **wide), witness)
            told = -2.0 * (steps[k, 0, 0] + steps[k, 0, 1:] @ off) - 18.0
            assert float(over.mid()) == pytest.approx(told, abs=1e-9)
            assert slack == pytest.approx(1e-9 * 9.0, rel=1.0)


@pytest.mark.parametrize("name", NAMES)
def test_what_a_policy_costs_is_the_integral_at_its_worst_deviations(name: str) -> None:
    loop, v, _ = driven(name)
    _, _, U = states(name)
    lengths = np.diff(loop.breakpoints)
    assert float(feedback_of(case_of(name)).cost().mid()) == pytest.approx(lengths @ np.abs(v[0]))
    peaks = np.maximum(loop.height(U[:, 0]), loop.height(-U[:, 0]))
    assert float(feedback_of(case_of(name, "peak")).cost().mid()) == pytest.approx(lengths @ peaks)
    assert float(feedback_of(case_of(name, "peak", weights=[3.0])).cost().mid()) == pytest.approx(3.0 * lengths @ peaks)


@pytest.mark.parametrize("name", ["box", "fast"])
def test_a_row_is_what_the_policy_makes_of_it_at_its_deviations(name: str) -> None:
    """Linear in the nominal control and in what the gains answer: with those of the loop, what the loop does."""
    loop, v, M = driven(name)
    rng, d = np.random.default_rng(8), 2
    mixed = wall("mixed", np.array([0.3, 0.4, 0.5]))
    case = case_of(name, path=[mixed], terminal=[END], initial_control=[0.2], control_step=Box([-0.4], [0.3]))
    for place in range(6):
        off, named = admissible(loop, rng)
        at = float(rng.uniform(START, STOP)) if place else float(loop.breakpoints[1])
        k = int(np.searchsorted(loop.breakpoints, at, side="right")) - 1
        x, _, U = loop.states(v, M, np.array([at, loop.breakpoints[-1]]))
        x, U = x[..., 0] + x[..., 1:] @ off, U[..., 0] + U[..., 1:] @ off
        i = place % 3
        for entry, truth in (
            ({"constraint": "path", "time": at, "direction": [*DIRECTIONS[i], *BESIDE[i]], "piece": k},
             DIRECTIONS[i] @ x[0] + BESIDE[i] @ U[k] - (0.3, 0.4, 0.5)[i]),
            ({"constraint": "terminal", "time": 2.0, "direction": [0.0, -2.0]}, -2.0 * x[1, 1] - 0.5),
            ({"constraint": "control", "time": at, "direction": [-1.5]}, -1.5 * U[k, 0] - 13.5),
            ({"constraint": STEP, "time": float(loop.breakpoints[k]), "direction": [1.0]},
             U[k, 0] - (U[k - 1, 0] if k else 0.2) - 0.3),
        ):  # fmt: skip
            ((y, row),) = bounds.rows_of(case, {**entry, **named, "multiplier": 2.0})
            assert y == 2.0
            slope = np.array([[float(g.mid()) for g in piece] for piece in row.slope])
            answered = replace(feedback_of(case).named(named, "row"), z=row.deviations).entering
            seen = np.array([[float(e.mid()) for e in part] for part in answered])
            made = v.T + np.einsum("kjmp,jp->km", M, seen)
            assert float(row.constant.mid()) + (slope * made).sum() == pytest.approx(truth, abs=1e-9), entry
    with pytest.raises(Broken, match="no constraint"):
        entry = {"constraint": STEP, "time": 0.0, "direction": [1.0], "multiplier": 1.0, **named}
        bounds.rows_of(case_of(name), entry)
    for wrong in ({"piece": 1.0}, {"piece": True}, {"time": 1.9}, {"direction": [1.0] * d}, {"multiplier": 0.0}):
        entry = {"constraint": "path", "time": 1.0, "direction": [*DIRECTIONS[0], *BESIDE[0]], "piece": 1, **named}
        with pytest.raises(Broken):
            bounds.rows_of(case, {"multiplier": 1.0, **entry, **wrong})
    with pytest.raises(Broken, match="expected"):
        bounds.rows_of(case, "nothing")


@pytest.mark.parametrize("name", ["box", "outputs"])
def test_multipliers_prove_no_more_than_every_policy_of_the_kind_pays(name: str) -> None:
    """Random policies whose control stays in its set: the weighted sum of the rows is never less than what is told."""
    loop, _, _ = driven(name)
    rng = np.random.default_rng(3)
    judged = case_of(name, control=Box([-1.0], [0.5]), terminal=[END])
    entries, offs, sums = [], [], []
    for y, direction in ((0.5, [1.0, 0.0]), (0.25, [0.0, -1.0]), (1.0, [-1.0, 0.0])):
        off, named = admissible(loop, rng)
        entries.append({"constraint": "terminal", "time": 2.0, "direction": direction, "multiplier": y, **named})
        offs.append((y, np.array(direction), off, float(END.support(np.array(direction)))))
    said = {**judged.certificate, "multipliers": {"constraints": entries, "equalities": []}}
    told = float(bounds.multiplied(replace(judged, certificate=said), priced=False).upper())
    for _ in range(15):
        v, M = gains(rng, loop, 1.0)
        M[:, : loop.begun is None] = 0.0
        U = loop.states(np.zeros_like(v), M, np.array([2.0]))[2]
        height, depth = loop.height(U[:, 0]), loop.height(-U[:, 0])
        M = M * (1.5 / np.maximum(height + depth, 1e-9))[:, None, None, None] * rng.uniform(0.9, 1.0)
        U = loop.states(np.zeros_like(v), M, np.array([2.0]))[2]
        height, depth = loop.height(U[:, 0]), loop.height(-U[:, 0])
        v = (-1.0 + depth + rng.integers(0, 2, size=depth.shape) * (1.5 - height - depth))[None]
        x = loop.states(v, M, np.array([2.0]))[0][0]
        sums.append(sum(y * (c @ (x[:, 0] + x[:, 1:] @ off) - limit) for y, c, off, limit in offs))
    assert min(sums) >= told - 1e-9
    assert min(sums) <= told + 3.0


def test_what_is_written_of_a_policy_is_what_the_problem_asks_for() -> None:
    loop, _, _ = driven("outputs")
    rows = [[[0, 0]], [[0, 1]], [[0, 0], [2, 2]]]

    def judged(answers: Any, cost: Any = "peak", own: str = "peak") -> str:
        return claims._verify_policy(case_of("outputs", own, {"policy": {"answers": answers, "cost": cost}}))

    every = [[[0, k]] for k in range(3)]
    assert judged(every)
    assert judged([[[0, 0]], [[0, 0], [1, 1]], [[0, 1], [1, 2]]])
    for answers, cost, own in ((rows, "peak", "peak"), (every, "worst", "peak"), (every, "peak", "nominal")):
        with pytest.raises(Broken):
            judged(answers, cost, own)
    written = written_policy({"policy": {"answers": rows, "cost": "worst"}}, 3)
    assert written.mask.tolist() == [[True, False, False], [True, True, False], [True, False, True]]
    assert written.charge.cost == "worst"
    assert written_policy({"policy": {"answers": [[], [], []], "cost": "nominal"}}, 3).mask.sum() == 0
    for wrong in ([0, 1], [-1, 0], [1, 0], [0], [0, 0, 0], [0.0, 0], [True, True], 0, None, "0"):
        with pytest.raises(Broken):
            written_policy({"policy": {"answers": [[wrong], [], []], "cost": "nominal"}}, 3)
    for wrong in ({"answers": rows[:2], "cost": "peak"}, {"answers": rows, "cost": "least"}, {"cost": "peak"}, 3, None):
        with pytest.raises(Broken):
            written_policy({"policy": wrong}, loop.breakpoints.size - 1)
