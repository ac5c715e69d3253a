"""Guards the tubes of systems that take turns: above the worst case that is stepped backwards through every piece, and
hardly above it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from flint import arb, ctx
from scipy.linalg import expm

from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.law import ParameterBox
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.reach.states import Scene, States
from sparserob_core.checker.reach.tube import ProjectedStates, VerifiedTube
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem
from sparserob_core.control.sets.sets import ConvexSet, NormBall
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.expressions.expression import parse_matrix

SWITCHES, CHANGES, HORIZON = (0.7, 1.5), [0.0, 0.5, 1.0, 1.75], 2.0
GRID = sorted({*SWITCHES, *CHANGES, 0.25, HORIZON})  # pieces of the disturbance go on over both switches
START, INITIAL = np.array([-1.0, 0.5]), NormBall(p=1.0, radius=0.2, dimension=2)
BOUNDS: dict[str, ConvexSet] = {"box": Box([-0.3, -0.1], [0.2, 0.4]), "disc": NormBall(p=2.0, radius=0.3, dimension=2)}
ENTRIES = (
    ([["0", "1"], ["-2 + p1", "-0.5"]], [["0"], ["1"]], [["1", "0"], ["1", "0.3*exp(p1)"]]),
    ([["-0.3", "2"], ["0.5*p1", "-1"]], [["1"], ["p1"]], [["1 + p1", "0"], ["0", "1"]]),
    ([["0.2", "-1"], ["1", "p1**2 - 0.4"]], [["1"], ["0"]], [["1", "0.5"], ["0", "2"]]),
)


def modes(spread: float) -> SwitchedSystem:
    """Three systems with one parameter, which is known where there is no ``spread``."""
    made = []
    for rows in ENTRIES:
        A, B, E = (parse_matrix(name, part, ("p1",)) for name, part in zip("ABE", rows, strict=True))
        uncertain = LinearSystem(A, B, E, parameters=Box([0.1 - spread], [0.1 + spread]), names=("p1",))
        known = LinearSystem(*(matrix[0] for matrix in uncertain.phases[0].matrices(np.array([[0.1]]))))
        made.append(uncertain if spread else known)
    return SwitchedSystem(list(zip((*SWITCHES, HORIZON), made, strict=True)))


def worst(system: SwitchedSystem, bound: ConvexSet, control: Array, direction: Array, time: float, p: Array) -> float:
    """``max c'x(time)``, by steps backwards from one event to the one before."""
    weights, total, row = np.zeros((len(CHANGES), 2)), 0.0, direction
    events = [a for a in GRID if a < time]
    for k, (left, right) in reversed(list(enumerate(itertools.pairwise([*events, time])))):
        middle = (left + right) / 2
        A, B, E = (part[0] for part in system.modes[np.searchsorted(SWITCHES, middle)].matrices(p[None]))
        block = np.zeros((5, 5))
        block[:2] = np.hstack([A, B, E])
        moved = row @ expm(block * (right - left))[:2]
        total += float(moved[2] * control[k])
        weights[np.searchsorted(CHANGES, middle) - 1] += moved[3:]
        row = moved[:2]
    return total + float(row @ START + INITIAL.support(row) + bound.support(weights).sum())


@pytest.mark.parametrize(
    ("name", "spread", "degree", "near"),
    [("box", 0.0, 0, 1e-6), ("box", 0.05, 6, 1e-6), ("box", 0.4, 3, np.inf), ("disc", 0.05, 6, 1e-6)],
)
def test_tubes_of_systems_that_take_turns_are_above_the_worst_case_and_not_far_above(
    name: str, spread: float, degree: int, near: float
) -> None:
    rng, bound, system = np.random.default_rng(6), BOUNDS[name], modes(spread)
    control = rng.uniform(-1, 1, size=len(GRID) - 1)
    held, unknown = [stacked([[arb(float(u))]]) for u in control], bool(spread)
    with ctx.workprec(96):
        scene = Scene(GRID, held, START.tolist(), bound, CHANGES, INITIAL)
        around = ParameterBox((0.1,), (spread,)) if unknown else ParameterBox()
        flow = VerifiedFlow(Plant.of(system, HORIZON), HORIZON, around, degree)
        states = States(flow, scene)
        tube = VerifiedTube(ProjectedStates(states, np.eye(2)), around)
        for piece, (a, b) in list(enumerate(itertools.pairwise(GRID)))[2::2]:
            start, stop = a + 0.1 * (b - a) * (piece % 4 // 2), b - 0.6 * (b - a)
            stop = min([stop, *(mark for mark in states.marks if mark > start)])
            directions = rng.normal(size=(1, 2))
            for direction, poly in zip(directions, tube.cells(piece, start, stop, directions), strict=True):
                for share, delta in itertools.product((0.4, 1.0), (-1.0, 1.0) if spread else (0.0,)):
                    powers = delta ** np.arange(poly.coefficients.shape[1])
                    value = float(share ** np.arange(poly.coefficients.shape[0]) @ poly.coefficients @ powers)
                    p = np.array([0.1 + spread * delta][:unknown])
                    truth = worst(system, bound, control, direction, start + share * (stop - start), p)
                    assert truth <= value + poly.error + 1e-13
                    assert poly.error - poly.kinks <= near
                    assert value - poly.error - poly.kinks <= truth + 1e-13


def test_what_the_degree_leaves_out_is_enough_beyond_every_switch() -> None:
    """``x' = p x`` in every leg, ``x(2) = e^{2 p}`` and what a disturbance of 1 adds, ``(e^{2 p} - 1) / p``: degree 2
    leaves out at least what the series says, and not much more."""
    one = LinearSystem(parse_matrix("A", [["p1"]], ("p1",)), np.ones((1, 1)), parameters=Box([-0.5], [0.5]))
    system = SwitchedSystem([(1.0, one), (2.0, one)])
    for bound, left_out in (
        (None, np.e - 2.5),
        (Box([-1.0], [1.0]), np.e - 2.5 + 2 * (np.e - 1.0) - 2 * (1 + 1 / 2 + 1 / 6)),
    ):
        scene = Scene([0.0, 1.0, 2.0], [stacked([[arb(0)]])] * 2, [1.0], bound, [0.0] if bound else [])
        with ctx.workprec(96):
            flow = VerifiedFlow(Plant.of(system, 2.0), 2.0, ParameterBox((0.0,), (0.5,)), 2)
            (poly,) = VerifiedTube(ProjectedStates(States(flow, scene), np.eye(1)), flow.box).cells(
                1, 2.0, 2.0, np.eye(1)
            )
        assert left_out <= poly.error - poly.kinks <= 10 * left_out
