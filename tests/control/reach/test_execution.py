"""Guards control/reach/execution: what errors of execution add to the state, exact, and enclosed on cells of
time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.enclosures.comparison import block_norms
from sparserob_core.control.reach.execution import ConstantExecution, ExecutionCellSupport
from sparserob_core.control.response.lifted import LiftedSystem
from sparserob_core.control.transcription.transcribe import Transcription, prepare
from sparserob_core.sip.expressions.rounding import rounding
from tests.support.enclosed import assert_bounded_on_cells

A = np.array([[0.0, 1.0], [-4.0, -0.3]])
B = np.array([[0.2, 0.0], [1.0, -0.7]])
SHARES = np.array([0.1, 0.03])
CONTROL = np.array([[0.0, 0.8, -0.8, 0.0, 0.3, 0.0], [0.5, 0.0, 0.0, -0.2, 0.0, 1.0]])
HORIZON, PIECES = 3.0, 6


def model(**changes: object) -> Transcription:
    dictionary = sr.Dictionary.indicators(np.linspace(0.0, HORIZON, PIECES + 1))
    problem = sr.OptimalControlProblem(
        **{
            "system": sr.LinearSystem(A, B),
            "horizon": HORIZON,
            "initial_state": [-1.0, 0.3],
            "control": sr.Box([-1.0, -1.0], [1.0, 1.0]),
            "path": [sr.PathConstraint(sr.Box([-0.6, -2.0], [0.7, 2.0]), start=0.4)],
            "terminal": [sr.Box([-0.4, -0.4], [0.4, 0.4])],
            "execution": SHARES,
            **changes,
        }  # type: ignore[arg-type]
    )
    return prepare(problem, dictionary, dictionary)


@pytest.fixture(scope="module")
def execution() -> ConstantExecution:
    found = model().functionals.execution
    assert isinstance(found, ConstantExecution)
    return found


def by_sums(c: np.ndarray, time: float, count: int = 6000) -> np.ndarray:
    """``int |c'e^{A(t-s)} B_j| ds`` over every piece up to ``time``, ``(m, K)``, by the midpoint rule."""
    values, vectors = np.linalg.eig(A)
    found = np.zeros((2, PIECES))
    for k, (begin, end) in enumerate(zip(np.arange(PIECES) / 2, np.arange(1, PIECES + 1) / 2, strict=True)):
        if begin < time:
            step = (min(end, time) - begin) / count
            ages = time - begin - step * (np.arange(count) + 0.5)
            flows = np.einsum(
                "i,nij->nj", c, (vectors * np.exp(values * ages[:, None])[:, None]) @ np.linalg.inv(vectors)
            )
            found[:, k] = np.abs((flows @ B).real).sum(axis=0) * step
    return found


@pytest.mark.parametrize("time", [0.0, 0.5, 1.23, 3.0])
def test_what_a_command_adds_is_the_integral_of_an_absolute_value(execution: ConstantExecution, time: float) -> None:
    c = np.array([1.0, -0.4])
    weights = by_sums(c, time) * SHARES[:, None]
    at = np.array([time]), c[None]
    np.testing.assert_allclose(execution.lengths(*at)[0].reshape(2, -1), weights, atol=3e-7)
    assert execution.added(CONTROL, *at)[0] == pytest.approx((weights * np.abs(CONTROL)).sum(), abs=1e-6)
    assert execution.added(CONTROL, *at)[0] == pytest.approx(
        execution.lengths(*at)[0] @ np.abs(CONTROL).ravel(), abs=1e-13
    )
    low, high = execution.enclosed(CONTROL, *at)[0]
    assert low <= execution.added(CONTROL, *at)[0] <= high <= low + 1e-12


def test_nothing_is_missing_of_nothing(execution: ConstantExecution) -> None:
    assert execution.added(np.zeros((2, PIECES)), np.array([2.0]), np.ones((1, 2)))[0] == 0.0
    assert not execution.none().lengths(np.array([2.0]), np.ones((1, 2))).any()


def test_its_slope_is_a_difference(execution: ConstantExecution) -> None:
    times, c, h = np.array([0.3, 1.1, 2.6]), np.tile([0.3, 1.0], (3, 1)), 1e-6
    about = [execution.added(CONTROL, times + sign * h, c) for sign in (1.0, -1.0)]
    np.testing.assert_allclose(execution.slope(CONTROL, times, c), (about[0] - about[1]) / (2 * h), rtol=1e-5)


def constraint(found: Transcription) -> FlatConstraint:
    assert isinstance(found.constraints[0], FlatConstraint)
    return found.constraints[0]


def test_it_is_nowhere_above_its_chord_by_more_than_is_said_and_hardly_less() -> None:
    functionals = model().functionals
    legs, H = functionals.over_cells.legs(np.zeros(0), np.zeros(0)), np.array([[1.0, -0.4], [0.3, 1.0]])
    assert isinstance(functionals.execution, ConstantExecution)
    support = ExecutionCellSupport(functionals.execution, CONTROL, H, legs[0])
    share, ratios = np.linspace(0.0, 1.0, 41), []
    for start, width in [(0.0, 0.5), (0.6, 0.2), (1.0, 0.1), (2.05, 0.4), (2.5, 0.01)]:
        said = support.deviation(np.array([start]), np.array([width]))[0]
        for row, bound in zip(H, said, strict=True):
            path = functionals.execution.added(CONTROL, start + width * share, np.tile(row, (41, 1)))
            off = (path - (1 - share) * path[0] - share * path[-1]).max()
            assert off <= bound * (1 + 1e-9)
            ratios.append(off / bound)
    assert max(ratios) > 0.5  # an enclosure that is a little smaller would be wrong


def test_the_bound_of_a_constraint_holds_on_every_cell_and_closes() -> None:
    one = constraint(model())
    assert_bounded_on_cells(one, np.concatenate([CONTROL.ravel(), np.abs(CONTROL).ravel()]), halvings=3, near=0.02)


def test_rows_at_the_sizes_of_the_control_are_its_worst_case() -> None:
    one = constraint(model())
    x = np.concatenate([CONTROL.ravel(), np.abs(CONTROL).ravel()])
    indices = np.array([[0.4], [0.9], [1.7], [3.0]])
    G, h = one.rows(indices)
    np.testing.assert_allclose(G @ x - h, one.at(x, indices), atol=1e-13)
    assert one.worst(x).violations[0] == pytest.approx(one.at(x, np.linspace(0.4, 3.0, 301)[:, None]).max(), abs=2e-4)


@pytest.mark.parametrize("units", [1.0, 1e-3, 1e4])
def test_a_constraint_is_the_same_in_any_units(units: float) -> None:
    scaled = model(
        system=sr.LinearSystem(A, B / units),
        control=sr.Box([-units, -units], [units, units]),
    )
    x = np.concatenate([CONTROL.ravel(), np.abs(CONTROL).ravel()])
    indices = np.array([[0.9], [3.0]])
    np.testing.assert_allclose(
        constraint(scaled).at(x * units, indices), constraint(model()).at(x, indices), atol=1e-12
    )


def test_a_late_command_adds_what_a_system_followed_in_time_says() -> None:
    """And so does the control before it, which acts until the first piece does."""
    delayed = sr.LinearSystem(A, B, delay=0.3)
    late, in_time = (
        model(system=system, initial_control=[0.4, -0.9]).functionals.execution
        for system in (delayed, delayed.in_time(HORIZON))
    )
    assert late is not None and in_time is not None and type(late) is ConstantExecution is not type(in_time)
    times = np.array([0.0, 0.1, 0.3, 0.5, 0.8, 1.23, 2.2, HORIZON])
    at = times, np.tile([1.0, -0.4], (times.size, 1))
    np.testing.assert_allclose(late.given(*at), in_time.given(*at), atol=1e-12)
    assert late.given(*at)[1] > 1e-3 and late.given(*at)[-1] > 1e-3
    np.testing.assert_allclose(late.lengths(*at), in_time.lengths(*at), atol=1e-12)
    np.testing.assert_allclose(late.added(CONTROL, *at), in_time.added(CONTROL, *at), atol=1e-12)
    bounds, truth = late.enclosed(CONTROL, *at), in_time.enclosed(CONTROL, *at)
    assert (bounds[:, 0] <= truth[:, 1]).all() and (truth[:, 0] <= bounds[:, 1]).all()
    h = 1e-6
    about = [late.added(CONTROL, times[1:-1] + sign * h + 0.01, at[1][1:-1]) for sign in (1.0, -1.0)]
    slopes = late.slope(CONTROL, times[1:-1] + 0.01, at[1][1:-1])
    np.testing.assert_allclose(slopes, (about[0] - about[1]) / (2 * h), rtol=1e-5)


def test_pieces_that_begin_beside_others_begin_with_them() -> None:
    """A delay of a piece and 3e-12: the grid has one time for both, and so have the errors."""
    late = model(system=sr.LinearSystem(A, B, delay=0.5 + 2.9e-12), initial_control=[0.4, -0.9]).functionals
    assert isinstance(late.execution, ConstantExecution)
    grid = late.response.grid.breakpoints
    assert np.isin(late.execution.begins, grid).all() and late.execution.begins[1] == 0.5
    assert late.execution.begins.size == PIECES + 2 and late.execution.begins[-1] == HORIZON


def test_late_bounds_hold_on_every_cell_and_close() -> None:
    one = constraint(model(system=sr.LinearSystem(A, B, delay=0.3), initial_control=[0.4, -0.9]))
    assert_bounded_on_cells(one, np.concatenate([CONTROL.ravel(), np.abs(CONTROL).ravel()]), halvings=3, near=0.02)


def test_the_sum_over_jumps_allows_for_its_rounding(execution: ConstantExecution) -> None:
    at = np.array([2.9]), np.array([[1.0, -0.4]])
    low, high = execution.enclosed(CONTROL, *at)[0]
    assert high - low >= 1e-14 * execution.added(CONTROL, *at)[0]


def test_no_error_brings_a_state_further_than_is_said() -> None:
    functionals, H = model().functionals, np.array([[1.0, -0.4], [0.3, 1.0]])
    leg = functionals.over_cells.legs(np.zeros(0), np.zeros(0))[0]
    assert isinstance(functionals.execution, ConstantExecution) and isinstance(leg, LiftedSystem)
    full = np.ones_like(CONTROL)
    support = ExecutionCellSupport(functionals.execution, full, H, leg)
    ends = leg.grid.breakpoints[1:]
    made = functionals.execution.added(full, np.repeat(ends, 2), np.tile(H, (ends.size, 1))).reshape(-1, 2)
    assert (made <= support.effect_bounds @ block_norms(H @ leg.transform, leg.starts).T * (1 + 1e-12)).all()


def test_ages_and_their_sum_are_rounded_outwards(execution: ConstantExecution) -> None:
    class Exact:
        """An integral that is its age, without an error."""

        def __init__(self) -> None:
            self.asked: list[np.ndarray] = []

        def enclosed(self, ages: np.ndarray, rows: np.ndarray) -> np.ndarray:
            self.asked.append(ages)
            return np.stack([ages, ages], axis=1)

    mine, exact = replace(execution), Exact()
    mine.__dict__["_supports"] = [exact, None]
    low, high = mine.enclosed(CONTROL, np.array([2.9]), np.array([[1.0, -0.4]]))[0]
    below, above = exact.asked
    assert (below[above > 1e-300] < above[above > 1e-300]).all()
    which, change = mine.jumps(CONTROL)
    size = float(np.abs(change[0]) @ (2.9 - mine.breakpoints[which]).clip(0.0))
    assert high - low >= 2.0 * rounding(4 * which.size + 8) * size
