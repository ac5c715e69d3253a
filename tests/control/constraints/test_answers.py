"""Guards control/constraints/feedback, effort, feedback_curved: what is asked of a control that answers is that of its
values at every corner of the deviations, in rows, separations, bounds and words."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.problem.names import Names
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.problem.units import Units
from sparserob_core.control.sets.sets import Box, ConvexSet, Ellipsoid, NormBall, Polytope
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.sip.convex_set import Array
from tests.support.plants import uniform

PIECES, HORIZON = 3, 2.0
LENGTH = HORIZON / PIECES
STARTS = np.arange(PIECES) * LENGTH
CONTROL, STEP = Box([-1.0, -2.0], [1.0, 1.5]), Box([-0.4, -0.6], [0.4, 0.5])
NAMES = Names(states=["x", "v"], controls=["pull", "turn"], control_units=["N", "N"], time="s")
ONES = np.ones(2)
UNITS = Units(8.0, ONES, np.array([2.0, 4.0]), ONES[:1], ONES[:0], 0.5)


def model(cost: str = "nominal", answering: bool = True, blocks: int = 2, **more: Any) -> Any:
    """A plant with two controls, which answers a disturbance on two pieces and a set of initial states, or nothing."""
    said = {
        "system": LinearSystem([[0.0, 1.0], [-2.0, -0.3]], [[0.0, 0.2], [1.0, 0.0]], [[0.3], [1.0]]),
        "horizon": HORIZON,
        "names": NAMES,
        "initial_state": [-1.0, 0.5],
        "control": CONTROL,
        "disturbance": Box([-0.1], [0.2]),
        "initial_set": Box([-0.05, -0.02], [0.05, 0.02]),
        "terminal": [Box([-0.5, -0.5], [0.5, 0.5])],
    }
    grids = uniform(PIECES, HORIZON), uniform(blocks, HORIZON)
    return prepare(
        sr.OptimalControlProblem(**(said | more)), *grids, policy=sr.AffinePolicy(cost=cost) if answering else None
    )


def family(made: Any, name: str) -> Any:
    return next(one for one in made.program.families if one.name == name)


def drawn(made: Any, seed: int) -> tuple[Array, Array]:
    """A decision, and its controls ``(corners, K, m)`` at every corner of the deviations."""
    x, loop = np.random.default_rng(seed).normal(size=made.program.n), made.feedback.loop
    known = loop.controls(x)
    return x, known[..., 0] + np.einsum("kmq,cq->ckm", known[..., 1:], at_corners(loop))


def at_corners(loop: Any) -> Array:
    """Every corner of the deviations."""
    return np.array(list(product(*([-far, far] for far in loop.spread.radii))))


@pytest.mark.parametrize("control", [CONTROL, Polytope([[1.0, 1.0], [-1.0, 0.5], [0.0, -1.0]], [1.0, 2.0, 0.5])])
def test_a_flat_set_holds_the_control_and_its_steps_at_every_corner(control: ConvexSet) -> None:
    made = model(control=control, control_step=STEP)
    x, u = drawn(made, 1)
    for name, bound, values, times in (
        ("control", control, u, STARTS),
        ("control_step", STEP, np.diff(u, axis=1), STARTS[1:]),
    ):
        one = family(made, name)
        H, h = one.source.H, one.source.h
        c = np.random.default_rng(2).normal(size=(5, 2))
        assert Polytope(H, h).support(c) == pytest.approx(bound.support(c))
        expected = ((values @ H.T) - h).max(axis=0)
        worst = expected.max(axis=1)
        assert one.violations(x, times[:, None]) == pytest.approx(expected, abs=1e-12)
        for time, rows in zip(times, expected, strict=True):
            assert one.uncertain(np.array([time])).excess(x, made.program.spread) == pytest.approx(rows, abs=1e-12)
        found = one.worst(x)
        assert found.violations == pytest.approx(np.sort(worst)[::-1], abs=1e-12)
        assert found.indices[:, 0] == pytest.approx(one.source.places.times[np.argsort(-worst)])
        assert found.rows.tolist() == expected.argmax(axis=1)[np.argsort(-worst)].tolist()
        assert found.bound == pytest.approx(worst.max(), abs=1e-12)
        bounds = one.enclosure(x, *one.cells).bounds
        assert (bounds >= worst).all() and bounds == pytest.approx(worst, abs=1e-11)
        assert one.cells[0][:, 0] == pytest.approx(times)
        normals, units = one.source.normals_in(UNITS)
        assert normals is H and units is UNITS.controls


def test_a_peak_is_the_largest_control_on_its_piece_at_any_corner() -> None:
    made = model("peak")
    x, u = drawn(made, 3)
    one, spread, highest = family(made, "peak"), made.program.spread, np.abs(u).max(axis=0)
    source = one.source
    peaks = x[source.bound :].reshape(2, PIECES)
    found = one.violations(x, STARTS[:, None])
    for row, direction in enumerate(source.H):
        channel = int(np.abs(direction).argmax())
        expected = (u @ direction).max(axis=0) - np.abs(direction[channel]) * peaks[channel]
        assert found[:, row] == pytest.approx(expected, abs=1e-12)
        for piece, time in enumerate(STARTS):
            rows = one.uncertain(np.array([time]))
            assert rows.excess(x, spread)[row] == pytest.approx(expected[piece], abs=1e-12)
    settled = source.settled(x)
    assert (settled[: source.bound] == x[: source.bound]).all()
    assert settled[source.bound :].reshape(2, PIECES) == pytest.approx(highest.T)
    assert one.violations(settled, STARTS[:, None]).max(axis=1) == pytest.approx(np.zeros(PIECES), abs=1e-12)
    bounds = one.enclosure(settled, *one.cells).bounds
    assert (bounds >= 0.0).all() and bounds.max() <= 1e-12
    assert one.explain(np.array([LENGTH]), 0).text == (
        "peak: pull(0.666667) <= its peak for every disturbance and initial state"
    )
    assert one.defines


def test_the_effort_is_the_largest_sum_of_moduli_at_any_corner() -> None:
    made = model("worst")
    x, u = drawn(made, 4)
    one, spread, prices = family(made, "effort"), made.program.spread, LENGTH * np.ones(2 * PIECES)
    source = one.source
    efforts = LENGTH * np.abs(u).sum(axis=(1, 2))
    assert source.prices == pytest.approx(prices)
    found = one.worst(x)
    assert found.violations[0] == pytest.approx(efforts.max() - x[source.bound])
    assert efforts.max() <= (found.bound + x[source.bound]) * (1 + 1e-14)
    assert found.bound + x[source.bound] == pytest.approx(efforts.max(), rel=1e-6)
    entries = u.transpose(0, 2, 1).reshape(len(u), -1)  # those of one channel after those of another
    rng = np.random.default_rng(5)
    for signs in rng.choice([-1.0, 1.0], size=(6, 2 * PIECES)):
        along = LENGTH * entries @ signs
        expected = np.array([along.max(), (-along).max()]) - x[source.bound]
        assert one.violations(x, signs[None])[0] == pytest.approx(expected, abs=1e-12)
        assert one.uncertain(signs).excess(x, spread) == pytest.approx(expected, abs=1e-12)
        assert (expected <= found.bound + 1e-12).all()
    settled = source.settled(x)
    assert (np.delete(settled, source.bound) == np.delete(x, source.bound)).all()
    assert efforts.max() <= settled[source.bound] <= efforts.max() * (1 + 1e-6)
    lower, upper = one.cells
    assert (lower == -1.0).all() and (upper == 1.0).all()
    enclosed = one.enclosure(x, lower, upper).bounds
    assert enclosed == pytest.approx(settled[source.bound] - x[source.bound])
    assert one.source.normals_in(UNITS)[1].tolist() == [UNITS.cost] and one.source.index_units(UNITS).size == 0
    assert one.defines and one.start.tolist() == [[1.0] * 6] and one.literal.reduced.name == one.name
    assert one.literal.index_set.upper[6:] == pytest.approx(spread.radii)
    told = one.explain(np.ones(6), 1)
    assert told.text.startswith("effort: the control against 6 signs <= the cost for every disturbance and initial")
    assert told.direction.tolist() == [-1.0] * 6
    once = model("worst", disturbance=Ellipsoid([0.0], [[0.01]]), initial_set=None)
    assert family(once, "effort").violations(drawn(once, 6)[0], np.ones((1, 6))).shape == (1, 1)


ROUND = Ellipsoid([0.1, 0.0], np.diag([1.0, 2.0]))
CUBIC = NormBall(p=3.0, radius=0.5, dimension=2)


@pytest.mark.parametrize(("name", "bound"), [("control", ROUND), ("control_step", CUBIC)])
def test_a_curved_set_holds_the_control_and_its_steps_at_every_corner(name: str, bound: ConvexSet) -> None:
    """Every corner against all directions: the largest excess over the support function."""
    made = model(control=ROUND, control_step=CUBIC)
    x, u = drawn(made, 7)
    values, times = (u, STARTS) if name == "control" else (np.diff(u, axis=1), STARTS[1:])
    one, spread = family(made, name), made.program.spread
    c = directions(bound)
    over = np.einsum("zd,ckd->zck", c, values).max(axis=1) - bound.support(c)[:, None]
    worst = over.max(axis=0)
    found = one.worst(x)
    assert found.violations == pytest.approx(np.sort(worst)[::-1], rel=1e-5)
    assert found.indices[:, 0] == pytest.approx(one.source.places.times[np.argsort(-worst)])
    assert one.violations(x, found.indices)[:, 0] == pytest.approx(found.violations, abs=1e-12)
    for index, violation in zip(found.indices, found.violations, strict=True):
        assert one.uncertain(index).excess(x, spread)[0] == pytest.approx(violation, abs=1e-12)
    lower, upper = one.cells
    bounds = one.enclosure(x, lower, upper).bounds
    at = np.searchsorted(times, lower[:, 0] + 1e-9) - 1
    for place in range(times.size):
        assert bounds[at == place].max() >= worst[place] - 1e-12
    narrow = found.indices[0] + 1e-7 * np.array([[0.0, -1.0, -1.0], [0.0, 1.0, 1.0]])
    inside = one.enclosure(x, narrow[:1], narrow[1:]).bounds[0]
    assert found.violations[0] - 1e-9 <= inside <= found.violations[0] + 1e-5
    assert one.source.normals_in(UNITS)[1].tolist() == [1.0]
    said = one.explain(found.indices[0], 0)
    when = f"{found.indices[0, 0]:.6g}"
    words = f"u({when})" if name == "control" else f"the change of u at {when}"
    assert said.text == f"{name}: {words} in the {bound.kind} for every disturbance and initial state"


def test_what_is_said_at_a_deviation_is_the_deviation() -> None:
    made = model(control_step=STEP)
    one, loop = family(made, "control_step"), made.feedback.loop
    w = np.array([0.15, -0.1, 0.03, -0.02])
    said = one.explain(np.concatenate([[LENGTH], w]), 1)
    assert "the change of turn at 0.666667 s <= 0.5 N" in " ".join(
        one.explain(np.array([LENGTH]), row).text for row in range(4)
    )
    assert said.disturbance.tolist() == [pytest.approx([0.2, -0.05])]
    assert said.deviation == pytest.approx(w[2:])
    assert said.initial_state == pytest.approx(np.array([-1.0, 0.5]) + w[2:])
    assert said.text.endswith("for every disturbance and initial state")
    assert loop.spread.middle[:2] == pytest.approx(0.05)
    known = model(initial_set=None)
    said = family(known, "control").explain(np.array([0.0, 0.1, 0.1]), 0)
    assert said.text.endswith("for every disturbance") and said.initial_state is None
    assert said.disturbance.tolist() == [pytest.approx([0.15, 0.15])]


def directions(bound: ConvexSet) -> Array:
    """Many of the plane, along each of which a set reaches 1 from its middle."""
    angles = np.linspace(0.0, 2.0 * np.pi, 2001)
    c = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return c / (bound.support(c) - c @ bound.middle())[:, None]


@pytest.mark.parametrize("seam", [False, True])
@pytest.mark.parametrize("answering", [False, True])
def test_steps_begin_with_the_control_before_or_go_around_a_plan_that_repeats(answering: bool, seam: bool) -> None:
    """The first control of the next period answers the deviation of its own initial state."""
    said = {"repeat": True, "terminal": []} if seam else {"initial_control": np.array([0.3, -0.2])}
    made = model(control_step=CUBIC, initial_state=[0.0, 0.0], answering=answering, **said)
    if answering:
        x, u = drawn(made, 8)
        corners, known = at_corners(made.feedback.loop), made.feedback.loop.controls(x)[0]
        following = known[:, 0] + corners[:, -4:-2] @ known[:, -2:].T
    else:
        x = np.random.default_rng(8).normal(size=made.program.n)
        u = x.reshape(1, 2, PIECES).transpose(0, 2, 1)
        following = u[:, 0]
    first = u[:, :1] - np.array([0.3, -0.2])
    steps = np.diff(u, axis=1)
    steps = np.hstack([steps, (following - u[:, -1])[:, None]] if seam else [first, steps])
    times = np.append(STARTS[1:], HORIZON) if seam else STARTS
    c, one = directions(CUBIC), family(made, "control_step")
    worst = (np.einsum("zd,ckd->zck", c, steps) - CUBIC.support(c)[:, None, None]).max(axis=(0, 1))
    found = one.worst(x)
    assert found.indices[:, 0] == pytest.approx(times[np.argsort(-worst)])
    assert found.violations == pytest.approx(np.sort(worst)[::-1], rel=1e-5)
    assert found.bound >= found.violations[0] - 1e-12
    assert one.violations(x, found.indices)[:, 0] == pytest.approx(found.violations, abs=1e-9)
    if answering:
        rows = [one.uncertain(index).excess(x, made.program.spread)[0] for index in found.indices]
        assert rows == pytest.approx(found.violations, abs=1e-9)
    else:
        assert found.bound == pytest.approx(found.violations[0], abs=1e-9)
        said = one.explain(found.indices[0], 0)
        assert said.text == f"control_step: the change of u at {found.indices[0, 0]:.6g} in the {CUBIC.kind}"
        assert said.direction @ steps[0, np.argmax(worst)] - CUBIC.support(said.direction) == pytest.approx(worst.max())
        assert one.source.normals_in(UNITS)[0].tolist() == [[1.0]]
