"""Guards checker/reach/inner_loop: the nominal control, rows on its decided part, and the range of that part, against
floats that are stepped from breakpoint to breakpoint."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from flint import arb_mat, ctx
from scipy.linalg import expm

from sparserob_core.checker.arithmetic.balls import ball, balls
from sparserob_core.checker.arithmetic.series import exactly, identity
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.reach.inner_loop import (
    Driving,
    NoInnerLoop,
    PlantInputs,
    StateBound,
    VerifiedInnerLoop,
    read_constraints,
)
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.sip.convex_set import Box

A, B, E, DRIFT = np.array([[0.0, 1.0], [9.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[0.1], [1.0]]), [0.2, -0.1]
START, MIDDLE = np.array([0.3, -0.2]), np.array([0.05])


def made(horizon: float, pieces: int) -> VerifiedInnerLoop:
    plant = Plant.of(LinearSystem(A, B, E, c=DRIFT), horizon)
    breakpoints = np.linspace(0.0, horizon, pieces + 1).tolist()
    grid = sorted({*breakpoints, *np.linspace(0.0, horizon, 2 * pieces // 3 + 1).tolist()})
    gains = np.random.default_rng(1).normal(size=(pieces, 1, 2)) + np.array([-14.0, -5.0])
    flow = VerifiedFlow(plant, horizon, sharp=2.0 ** -float(ctx.prec))
    return VerifiedInnerLoop(flow, breakpoints, grid, gains, balls(START), MIDDLE)


def step(length: float) -> tuple[np.ndarray, np.ndarray]:
    whole = np.zeros((5, 5))
    whole[:2] = np.hstack([A, B, E, np.array(DRIFT)[:, None]])
    flow = expm(whole * length)[:2]
    return flow[:, :2], flow[:, 2:]


def controls(loop: VerifiedInnerLoop, decided: np.ndarray, added: np.ndarray) -> np.ndarray:
    """The control on every piece, with ``added (K, d)`` to the state at every breakpoint."""
    Phi, Gamma = step(loop.breakpoints[1])
    state, found = START + added[0], []
    for k, v in enumerate(decided):
        found.append(float(loop.gains[k, 0] @ state + v))
        state = Phi @ state + Gamma @ np.array([found[-1], MIDDLE[0], 1.0])
        state = state + (added[k + 1] if k + 1 < len(added) else 0.0)
    return np.array(found)


@pytest.mark.parametrize("horizon", [0.5, 2.0])
def test_the_nominal_control_is_what_the_loop_makes_of_its_decided_part(horizon: float) -> None:
    loop, decided = made(horizon, 6), np.random.default_rng(2).normal(size=6)
    found = [float(u[0, 0]) for u in loop.nominal([arb_mat([[ball(v)]]) for v in decided])]
    assert found == pytest.approx(controls(loop, decided, np.zeros((6, 2))), rel=1e-9)


def test_a_row_on_the_control_is_the_same_on_its_decided_part() -> None:
    loop, rng = made(1.0, 6), np.random.default_rng(3)
    decided, added, slope = rng.normal(size=6), 0.1 * rng.normal(size=(6, 2)), rng.normal(size=6)
    errors = 0.1 * rng.normal(size=(6, 2))  # of the states that the feedback acts on
    constant, slopes = loop.on_decided(
        [[ball(s)] for s in slope], lambda: ([balls(row) for row in added], [balls(row) for row in errors])
    )
    found = float(constant) + sum(float(s) * v for (s,), v in zip(slopes, decided, strict=True))
    acting = decided - np.einsum("kd,kd->k", loop.gains[:, 0], errors)
    assert found == pytest.approx(float(slope @ controls(loop, acting, added)), rel=1e-9)


def test_growth_by_e60_does_not_widen_the_nominal_control() -> None:
    """Its balls lose what signs are worth in each of 200 steps, and nothing of what the plant amplifies by."""
    with ctx.workprec(400):
        loop = made(20.0, 200)
        found = loop.nominal([arb_mat([[ball(0.1)]])] * 200)
        assert all(float(u[0, 0].rad()) < 1e-60 and abs(float(u[0, 0])) < 100.0 for u in found)


@pytest.mark.parametrize("horizon", [1.0, 6.0])
def test_the_range_holds_what_controls_that_keep_the_constraints_add(horizon: float) -> None:
    """Controls that hold a random state in the walls are found by inverting the plant, one piece after the other."""
    pieces, reach = int(10 * horizon), 8.0
    loop, rng = made(horizon, pieces), np.random.default_rng(4)
    wall = balls([0.5, 1.5])
    inputs = PlantInputs(
        arb_mat(2, 1, [ball(v) for v in START]),
        arb_mat([[ball(-reach).union(ball(reach))]]),
        arb_mat([[ball(MIDDLE[0])]]),
        [StateBound(np.eye(2), [arb_mat(2, 1, [(-w).union(w) for w in wall])] * (pieces + 1))],
        np.zeros(1),
    )
    box = loop.widen(Box([-reach], [reach]), lambda: inputs)
    Phi, Gamma = step(loop.breakpoints[1])
    largest = 0.0
    for _ in range(20):
        state, is_kept = START.copy(), True
        for k in range(pieces):
            if not is_kept:
                break
            largest = max(largest, abs(float(loop.gains[k, 0] @ state)))
            u = np.clip(-14.0 * state[0] - 5.0 * state[1] + rng.normal(), -reach, reach)
            state = Phi @ state + Gamma @ np.array([u, MIDDLE[0], 1.0])
            is_kept = bool((np.abs(state) <= [0.5, 1.5]).all())
    assert largest + reach <= float(box.support(np.ones((1, 1)))[0]) <= reach + 20.0 * 2.0


def _same(inputs: PlantInputs) -> PlantInputs:
    return inputs


def test_a_wall_that_holds_at_the_end_narrows_the_range() -> None:
    """Without walls the range grows with the plant, from both ends it does not."""
    ranges = {}
    for name in ("none", "end"):
        loop = made(6.0, 60)
        free = [None] * 60
        wall = arb_mat(2, 1, [(-w).union(w) for w in balls([0.5, 1.5])])
        bounds = [StateBound(np.eye(2), [*free, wall])] if name == "end" else []
        inputs = PlantInputs(
            arb_mat(2, 1, balls(START)),
            arb_mat([[ball(-8.0).union(ball(8.0))]]),
            arb_mat([[ball(0.05)]]),
            bounds,
            np.zeros(1),
        )
        box = loop.widen(Box([-8.0], [8.0]), partial(_same, inputs))
        ranges[name] = float(box.support(np.ones((1, 1)))[0])
    assert ranges["end"] < 100.0 and ranges["none"] > 1e6


def test_no_inner_loop_changes_nothing() -> None:
    none, decided, slope = NoInnerLoop(), [arb_mat([[ball(1.0)]])], [[ball(2.0)]]
    control = Box([-1.0], [1.0])
    constant, same = none.on_decided(slope, lambda: pytest.fail("no deviation is asked for"))
    assert none.nominal(decided) is decided and same is slope and float(constant) == 0.0 and not none.acts
    assert none.widen(control, lambda: pytest.fail("no input is asked for")) is control


@pytest.mark.parametrize("guess", [1.0, 0.5])
def test_the_range_holds_every_initial_state(guess: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first state is any of its set, so that the bound of what is added first is attained; also where the matrix of
    least squares is a bad guess."""
    least_squares = np.linalg.pinv
    monkeypatch.setattr(np.linalg, "pinv", lambda table: guess * least_squares(table))
    loop, sides = made(0.1, 1), np.array([0.5, 1.5])
    inputs = PlantInputs(
        arb_mat(2, 1, [(-v).union(v) for v in balls(sides)]),
        arb_mat([[ball(0.0)]]),
        arb_mat([[ball(0.05)]]),
        [],
        np.zeros(1),
    )
    least = 8.0 + float(np.abs(loop.gains[0, 0]) @ sides)
    inputs = replace(inputs, control=arb_mat([[ball(-8.0).union(ball(8.0))]]))
    assert float(loop.widen(Box([-8.0], [8.0]), partial(_same, inputs)).support(np.ones((1, 1)))[0]) >= least
    unknown = replace(inputs, missing=np.array([0.7]))
    assert float(loop.widen(Box([-8.0], [8.0]), partial(_same, unknown)).support(np.ones((1, 1)))[0]) >= least + 0.7


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_values_of_constraints_that_are_read_back_hold_of_a_trajectory(sign: float) -> None:
    """Constraints that hold with equality along a trajectory of the largest controls leave its state."""
    Phi, Gamma = step(0.1)
    states = [np.array([0.2, sign])]
    for _ in range(3):
        states.append(Phi @ states[-1] + Gamma @ np.array([sign * 8.0, 0.05, 1.0]))
    steps = [
        (exactly(Phi), Driving([(exactly(Gamma[:, :1]), arb_mat([[ball(-8.0).union(ball(8.0))]])),
                                (exactly(Gamma[:, 1:]), arb_mat([[ball(0.05)], [ball(1.0)]]))]))
    ] * 3  # fmt: skip
    bound = identity(2), [None, None, *(arb_mat(2, 1, balls(state)) for state in states[2:])]
    rows, values = read_constraints(0, 3, steps, [bound])
    assert len(rows) == 4
    for row, value in zip(rows, values, strict=True):
        along = sum((c * ball(v) for c, v in zip(row, states[0], strict=True)), ball(0.0))
        assert abs(along - value) < 1e-9 or (along - value).overlaps(ball(0.0))
        assert float(value.rad()) > 0.01
