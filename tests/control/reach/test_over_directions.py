"""Guards control/response: what measurable disturbances and errors of execution add over a cell of directions is
bounded wherever a direction of it points, exactly at the corners, and by little more on small cells."""

from __future__ import annotations

from itertools import product as every_choice
from typing import Any, cast

import numpy as np
import pytest

from sparserob_core.control.enclosures.comparison import block_norms
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem, VaryingSystem
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.reach.support import DirectionsCellSupport, Supports, between_corners
from sparserob_core.control.sets.sets import Box, Ellipsoid
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.sip.expressions.taylor import TaylorSpace, combination
from tests.support.plants import uniform

HORIZON, D = 2.0, 4
A = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [-2.0, 0.3, -0.1, 0.2], [0.4, -1.0, 0.0, -0.3]])
B, E = np.eye(D)[:, 2:] + 0.1, np.array([[0.1, 0.0], [0.0, -0.1], [1.0, 0.3], [-0.2, 1.0]])
CONTROL = np.array([[0.7, -0.4, 0.0], [0.0, 0.9, -0.6]])
SETS = {
    "a box": Box([-0.1, -0.3], [0.2, 0.1]),
    "an ellipse": Ellipsoid([0.02, 0.0], [[0.02, 0.004], [0.004, 0.01]]),
}
KINDS = [*SETS, "a box in time", "errors", "errors in time"]


def made(kind: str, rows: np.ndarray) -> tuple[Supports, Any]:
    """What a part of the uncertainty adds over a cell of directions ``rows (J + 1, d)``, and its values at times and
    directions."""
    plant = LinearSystem(A, B, E)
    if "in time" in kind:
        whole = [[float(v) for v in row] for row in A]
        law: Any = [[*row] for row in whole]
        law[2][0], law[3][3] = "-2 - sin(3*t)", "-0.3 + 0.2*t"
        plant = VaryingSystem.of(law, B.tolist(), HORIZON, E.tolist())
    bound = next((one for name, one in SETS.items() if kind.startswith(name)), None)
    problem = OptimalControlProblem(
        system=plant, horizon=HORIZON, initial_state=np.zeros(D), control=Box([-1.0, -1.0], [1.0, 1.0]),
        terminal=[Box(-np.ones(D), np.ones(D))], disturbance=bound,
        disturbance_class="piecewise_constant" if bound is None else "measurable",
        execution=[0.1, 0.2] if bound is None else None,
    )  # fmt: skip
    functionals: WorstFunctionals = prepare(problem, uniform(3, HORIZON), uniform(3, HORIZON)).functionals
    (leg,) = functionals.over_cells.legs(np.zeros(0), np.zeros(0))
    joined = combination(leg.space, len(rows) - 1)
    if bound is not None:
        support = functionals.measurable
        assert support is not None
        parts, none = support.over(rows, leg, joined), np.zeros((1, 0))
        return Supports(tuple(parts)), lambda times, c: support(times, c, none.repeat(times.size, axis=0))
    execution = functionals.execution
    assert execution is not None
    return Supports((execution.over(CONTROL, rows, leg, joined),)), lambda times, c: execution.added(CONTROL, times, c)


def over_directions_of(part: Supports) -> DirectionsCellSupport:
    found = part.parts[0]
    assert isinstance(found, DirectionsCellSupport)
    return found


def values(space: TaylorSpace, coefficients: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Polynomials ``(k, 1, M)`` at points ``(n, nu)``, ``(k, n)``."""
    return np.asarray(coefficients[:, 0] @ space.monomials(points).T)


@pytest.mark.first(1)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("free", [1, 3])
def test_it_holds_every_direction_and_is_exact_at_corners(free: int, kind: str) -> None:
    rng, times = np.random.default_rng(7), np.array([0.3, 1.0, HORIZON])
    middle, axes, lost = rng.normal(size=D), rng.normal(size=(free, D)), []
    for width in (0.5, 0.05):
        rows = np.vstack([middle, width * axes])
        part, exact = made(kind, rows)
        space = over_directions_of(part).joined.space
        for pattern in (np.zeros(free), np.append(1.0, np.zeros(free - 1)), np.append(np.zeros(free - 1), -1.0)):
            found, excess = part.at(times, np.tile(pattern, (times.size, 1, 1)))
            inside = np.vstack([np.zeros(free), rng.uniform(-1.0, 1.0, (39, free))])
            corners = np.array(list(every_choice((-1.0, 1.0), repeat=free)))
            points = np.where(pattern != 0.0, pattern, np.vstack([inside, corners]))
            bound = values(space, found, points) + excess
            at = np.repeat(times, len(points)), np.tile(rows[0] + points @ rows[1:], (times.size, 1))
            truth = exact(*at).reshape(times.size, -1)
            assert (truth <= bound + 1e-13).all()
            if free < 3 or pattern.any():  # the space has all products
                assert bound[:, len(inside) :] == pytest.approx(truth[:, len(inside) :], abs=1e-12)
            if not pattern.any():
                lost.append((bound - truth)[:, : len(inside)].max())
        steep = part.steepness(times)[:, 0]
        for axis in range(free):
            moved = np.eye(free)[axis] * 0.7
            sides = [exact(times, np.tile(rows[0] + (side * moved) @ rows[1:], (times.size, 1))) for side in (1, -1)]
            assert (np.abs(sides[0] - sides[1]) <= 1.4 * steep[:, axis]).all()
            most = [exact(times, np.tile(side * rows[1 + axis], (times.size, 1))) for side in (1, -1)]
            assert (steep[:, axis] >= np.max(most, axis=0) * (1 - 1e-9)).all()
            if len(part.parts) == 1:  # two are along a row and against it, each where it adds more
                assert steep[:, axis] == pytest.approx(np.max(most, axis=0), rel=1e-9)
    assert lost[1] <= 0.03 * lost[0]  # of second order in the width


@pytest.mark.first(1)
@pytest.mark.parametrize("kind", ["a box", "errors"])
def test_a_chord_in_time_holds_every_direction(kind: str) -> None:
    rng, start, width = np.random.default_rng(8), np.array([0.1, 0.8, 1.5]), np.full(3, 0.12)
    rows = np.vstack([0.01 * rng.normal(size=D), 0.4 * rng.normal(size=(2, D))])
    part, exact = made(kind, rows)
    bent = part.deviation(start, width).sum(axis=1)
    for point in rng.uniform(-1.0, 1.0, (10, 2)):
        c = np.tile(rows[0] + point @ rows[1:], (3, 1))
        ends = exact(start, c), exact(start + width, c)
        for share in (0.3, 0.5, 0.8):
            chord = (1 - share) * ends[0] + share * ends[1]
            assert (exact(start + share * width, c) - chord <= bent + 1e-13).all()
    assert (bent <= 0.1).all()


def test_what_is_left_out_counts_for_every_row_with_what_rounding_makes_of_corners() -> None:
    rows = np.vstack([np.ones(D), 0.3 * np.eye(D)[:2]])
    part = over_directions_of(made("a box", rows)[0])
    alone, leg = part.made(rows), part.leg
    size = block_norms(np.abs(rows) @ np.abs(leg.transform), leg.starts) @ part.effect_bounds.T
    assert (part.neglected - alone.neglected >= 1e-16 * size).all()
    assert (part.neglected - alone.neglected <= 1e-14 * size).all()


class Linear:
    """``c_1 + 2 c_2``, off by a thousandth of a millionth of ``|c_1|``."""

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows

    def at(self, times: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = np.tile(self.rows @ [1.0, 2.0], (times.size, 1))
        return found[..., None], np.tile(1e-9 * np.abs(self.rows[:, 0]), (times.size, 1))


def test_what_corners_are_off_by_and_what_is_rounded_is_in_the_excess() -> None:
    rows, pattern = np.array([[3.0, 1.0], [1.0, 0.0], [0.0, 2.0]]), np.zeros(2)
    space = TaylorSpace(0, 0)
    part = DirectionsCellSupport(cast(Any, Linear), rows, cast(Any, None), combination(space, 2))
    found, excess = part.at(np.array([1.0]), np.zeros((1, 1, 2)))
    corners = np.array([[5.0 + a + 4.0 * b for a in (-1.0, 1.0) for b in (-1.0, 1.0)]])
    _, beyond = between_corners(part.joined.space, pattern, corners)
    assert values(part.joined.space, found, np.array([[-1.0, -1.0], [1.0, 1.0]])) == pytest.approx(
        np.array([[0.0, 10.0]])
    )
    assert (excess[:, 0] - 4e-9 - beyond >= 1e-15).all()
    assert (excess[:, 0] - 4e-9 - beyond <= 1e-13).all()


def test_between_corners_is_what_they_are_and_products_that_are_missing_are_counted() -> None:
    rng = np.random.default_rng(9)
    for nu in (1, 2, 3, 4):
        space, corners = TaylorSpace(nu, 2), np.array(list(every_choice((-1.0, 1.0), repeat=nu)))
        given = rng.normal(size=(5, len(corners)))
        found, beyond = between_corners(space, np.zeros(nu), given)
        off = np.abs(found @ space.monomials(corners).T - given)
        assert (off <= beyond[:, None] + 1e-14).all()
        assert (beyond >= 1e-15 * np.abs(given).max(axis=1)).all()
        assert (beyond <= 1e-12).all() if nu < 3 else (off.max(axis=1) >= 0.05 * beyond).all()
