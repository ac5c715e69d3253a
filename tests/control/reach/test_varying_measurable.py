"""Guards control/reach/varying_measurable: measurable disturbances of systems that change with time, against an
integrator and the constant system; enclosed on cells of time, also where series are cut short."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import sparserob_core as sr
import sparserob_core.control.response.varying.expansion as expansion
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.problem.system import System, VaryingSystem
from sparserob_core.control.reach.measurable import MeasurableSupport
from sparserob_core.control.reach.support import Supports
from sparserob_core.control.reach.varying_execution import VaryingExecution
from sparserob_core.control.reach.varying_measurable import VaryingMeasurable
from sparserob_core.control.reach.varying_motion import VaryingMotion
from sparserob_core.control.studies.adversary import evaluate_disturbance, worst_signal
from sparserob_core.control.transcription.transcribe import Transcription, prepare
from sparserob_core.sip.convex_set import Array
from tests.support.enclosed import assert_bounded_on_cells

HORIZON, PIECES = 3.0, 6
BOX = sr.Box([-0.1, 0.02], [0.1, 0.05])
TRIANGLE = sr.Polytope([[-1.0, -1.0], [1.0, -0.5], [0.0, 1.0]], [0.2, 0.1, 0.05])
A, B, E = np.array([[0.0, 1.0], [-4.0, -0.3]]), np.array([[0.2], [1.0]]), np.array([[0.1, 1.0], [1.0, -0.7]])
MATHIEU = [[0, 1], ["-(1.5 - 0.8*cos(2*t))", -0.1]], [["t"], [1]], [["0.2*sin(t)", 0], [1, "-0.7 + t/4"]]
WILD = [["-t", 2], [-1, "t"]], [[0], [1]], [["t^2", 0], ["cos(9*t)", 1]]
ALONE = [[0, 1], ["-1 + 0*t", 0]], [[0], [0]], [["1 + t", 0], [1, "cos(3*t)"]]  # which no control enters
H = np.array([[1.0, -0.4], [0.3, 1.0], [-1.0, -0.2]])
NONE = np.zeros(0)


def model(system: System, box: sr.ConvexSet = BOX) -> Transcription:
    dictionary = sr.Dictionary.indicators(np.linspace(0.0, HORIZON, PIECES + 1))
    problem = sr.OptimalControlProblem(
        system=system,
        horizon=HORIZON,
        initial_state=[-1.0, 0.3],
        control=sr.Box([-1.0], [1.0]),
        path=[sr.PathConstraint(sr.Box([-0.6, -2.0], [0.7, 2.0]), start=0.4)],
        disturbance=box,
        disturbance_class="measurable",
    )
    return prepare(problem, dictionary, dictionary)


def support(plant: tuple[list, list, list] = MATHIEU, bound: sr.ConvexSet = BOX) -> VaryingMeasurable:
    A, B, E = plant
    found = model(VaryingSystem.of(A, B, HORIZON, E), bound).functionals.measurable
    assert isinstance(found, VaryingMeasurable)
    return found


def values(found: VaryingMeasurable, times: Array, rows: Array) -> Array:
    """Those of every row at every time, ``(k, r)``."""
    k, r = times.size, len(rows)
    return found(np.repeat(times, r), np.tile(rows, (k, 1)), np.zeros((k * r, 0))).reshape(k, r)


def test_a_constant_that_is_dressed_is_the_constant() -> None:
    plain = model(sr.LinearSystem(A, B, E)).functionals.measurable
    found = support(tuple([[f"{entry} + 0*t" for entry in row] for row in part] for part in (A, B, E)))  # type: ignore[arg-type]
    assert isinstance(plain, MeasurableSupport)
    times = np.array([0.0, 0.3, 0.5, 1.23, 2.2, HORIZON])
    bounds = plain.enclosed(np.repeat(times, 3), np.tile(H, (6, 1)))
    np.testing.assert_allclose(values(found, times, H).ravel(), bounds.mean(axis=1), atol=1e-13)


@pytest.mark.parametrize("bound", [BOX, TRIANGLE], ids=["box", "triangle"])
@pytest.mark.parametrize("time", [0.4, 2.2])
def test_mathieus_equation_agrees_with_an_integrator(time: float, bound: sr.ConvexSet) -> None:
    """Also of a set whose coordinates are not free of one another, of which no two corners are opposite."""
    c, ends = np.array([1.0, -0.4]), np.linspace(0.0, time, 41)

    def backwards(s: float, row: Array) -> Array:
        return -row @ np.array([[0, 1], [-(1.5 - 0.8 * np.cos(2 * s)), -0.1]])

    adjoint = solve_ivp(backwards, (time, 0.0), c, rtol=1e-12, atol=1e-13, dense_output=True).sol

    def height(s: float) -> float:
        return float(bound.support(adjoint(s)[None] @ np.array([[0.2 * np.sin(s), 0.0], [1.0, -0.7 + s / 4]]))[0])

    truth = sum(quad(height, *pair, epsabs=1e-9)[0] for pair in pairwise(ends))
    found = support(MATHIEU, bound)
    assert values(found, np.array([time]), c[None])[0, 0] == pytest.approx(truth, abs=1e-7)
    if bound is TRIANGLE:  # all channels together: enclosed to the last digits
        assert isinstance(found.errors, VaryingExecution)
        low, high = found.errors.enclosed(found.command, np.array([time]), c[None])[0]
        assert low <= values(found, np.array([time]), c[None])[0, 0] <= high <= low + 1e-11


def test_the_worst_signal_attains_it() -> None:
    functionals = model(VaryingSystem.of(*MATHIEU[:2], HORIZON, MATHIEU[2])).functionals
    for time in (0.4, 1.7, HORIZON):
        signal = worst_signal(functionals, time, H[0], NONE)
        assert signal[1] is not None
        assert ((signal[1] >= BOX.lower[:, None]) & (signal[1] <= BOX.upper[:, None])).all()
        attained = evaluate_disturbance(functionals, time, H[0], NONE, (signal[0], signal[1]))
        assert attained == pytest.approx(values(support(), np.array([time]), H[:1])[0, 0], abs=1e-13)


@pytest.mark.parametrize(
    "plant",
    [ALONE, *(pytest.param(one, marks=pytest.mark.slow) for one in (MATHIEU, WILD))],
    ids=["alone", "mathieu", "wild"],
)
def test_it_is_nowhere_above_its_chord_by_more_than_is_said_and_hardly_less(plant: tuple[list, list, list]) -> None:
    found, share, ratios = support(plant), np.linspace(0.0, 1.0, 25), []
    motion = found.errors.motion
    marks, parts = motion.grid.breakpoints, Supports(tuple(found.over(H, motion)))
    starts = np.concatenate([marks[:-1], marks[:-1] + 0.3 * np.diff(marks)])
    widths = np.concatenate([np.diff(marks), 0.01 * np.diff(marks)])
    said = sum(part.deviation(starts, widths) for part in parts.parts)
    for start, width, bounds in zip(starts, widths, said, strict=True):
        path = values(found, np.minimum(start + width * share, HORIZON), H)
        above = (path - np.outer(1 - share, path[0]) - np.outer(share, path[-1])).max(axis=0)
        assert (above <= bounds * (1 + 1e-9) + 1e-14).all()
        ratios.append((above / np.maximum(bounds, 1e-12)).max())
    assert max(ratios) > 0.5  # an enclosure that is a little smaller would be wrong


@pytest.mark.first(1)
@pytest.mark.parametrize("name", ["TERMS", "DEGREE"])
def test_bounds_hold_what_coarse_transitions_are_off_by(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    times = np.linspace(0.0, HORIZON, 31)
    truths = values(support(), times, H)
    for rough in ("SHARPEST", "BLUNTEST"):
        monkeypatch.setattr(expansion, rough, 1.0)
    monkeypatch.setattr(expansion, name, 5)
    coarse = support()
    motion = coarse.errors.motion
    piece, low, high = np.minimum(motion.place(times), motion.origin.size - 1), 0.0, 0.0
    for part in coarse.over(H, motion):
        middle, excess = part.at(times, np.zeros((31, 3, 0)))
        lost = excess + part.neglected[:, piece].T + 1e-14
        low, high = low + middle[..., 0] - lost, high + middle[..., 0] + lost
    assert np.abs(values(coarse, times, H) - truths).max() > 1e-8, "nothing was left out"
    assert (low <= truths).all() and (truths <= high).all()


def test_a_box_is_within_its_middle_and_half_its_widths() -> None:
    rng = np.random.default_rng(3)
    for size in (1e-9, 1.0, 1e6):
        lower = rng.normal(size=2) * size
        for upper in (lower + rng.uniform(size=2) * [1e-6, 3.0], lower):
            held = model(VaryingSystem.of(*MATHIEU[:2], HORIZON, MATHIEU[2]), sr.Box(lower, upper)).functionals
            found = held.measurable
            assert isinstance(found, VaryingMeasurable)
            for m, far, low, high in zip(found.middle, found.errors.shares, lower, upper, strict=True):
                assert Fraction(m) - Fraction(far) <= Fraction(low) and Fraction(high) <= Fraction(m) + Fraction(far)
                assert Fraction(2 * far) <= Fraction(high) - Fraction(low) + Fraction(
                    4 * np.spacing(max(-low, low, high))
                )
                assert low < high or far == 0.0


@pytest.mark.parametrize(
    "bound", [sr.Ellipsoid([0.02, -0.01], [[0.01, 0.004], [0.004, 0.02]]), sr.Polytope(H, [0.1, 0.2, 0.05])]
)
def test_what_a_set_makes_of_states_is_bounded_by_the_box_around_it(bound: sr.ConvexSet) -> None:
    far = bound.reach(np.eye(2))
    found, boxed = (
        model(VaryingSystem.of(*MATHIEU[:2], HORIZON, MATHIEU[2]), one).functionals.measurable
        for one in (bound, sr.Box(-far, far))
    )
    assert isinstance(found, VaryingMeasurable) and isinstance(boxed, VaryingMeasurable)
    assert isinstance(found.errors, VaryingExecution)
    most, marks = (
        found.errors.bound_states(found.command, found.errors.motion).at_marks,
        found.errors.motion.grid.breakpoints,
    )
    both = values(found, marks, np.vstack([np.eye(2), -np.eye(2)]))
    assert (most >= np.maximum(both[:, :2], both[:, 2:])).all()
    np.testing.assert_allclose(most, values(boxed, marks, np.eye(2)), rtol=1e-9)


@pytest.mark.slow
def test_the_bound_of_a_constraint_holds_on_every_cell_and_closes() -> None:
    found = model(VaryingSystem.of(*MATHIEU[:2], HORIZON, MATHIEU[2]))
    one = found.constraints[0]
    assert isinstance(one, FlatConstraint) and isinstance(one.functionals.over_cells.legs(NONE, NONE)[0], VaryingMotion)
    x = np.array([0.5, 0.0, -0.3, 0.8, 0.0, -1.0])
    assert_bounded_on_cells(one, x)
