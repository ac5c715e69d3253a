"""Guards the expansion of a state in parameters beside the time, on cells of them: what is beyond its degree is bounded
by what is said, and bounds over cells of times and parameters hold what closed forms give there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import factorial

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import sparserob_core as sr
from sparserob_core.control.enclosures import dependence
from sparserob_core.control.enclosures.dependence import ExpandedSystem
from sparserob_core.control.reach.varying_motion import SpreadMotion, Truncation, VaryingMotion
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.response import OutputResponse, Propagator, Response
from sparserob_core.control.response.time_grid import merge_grids
from sparserob_core.control.response.varying import spread as expansions
from sparserob_core.control.response.varying.discs import cauchy
from sparserob_core.control.response.varying.expansion import Expansion
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.expressions.taylor import TaylorSpace

BOX = sr.Box([-0.3], [0.6])
SYSTEM = sr.VaryingSystem.of([["-0.5 - p*sin(2*t)"]], [["1 + p^2"]], 3.0, [[1]], parameters=BOX, names=["p"])


def decay(t: np.ndarray, p: np.ndarray) -> np.ndarray:
    """What an initial state of 1 becomes."""
    return np.asarray(np.exp(-t / 2 - p * (1 - np.cos(2 * t)) / 2))


@pytest.mark.slow
@pytest.mark.parametrize("degree", [2, 3, 5])
def test_what_is_beyond_a_degree_is_bounded_and_not_by_far_more_than_it_is(degree: int) -> None:
    spread = ExpandedSystem(1, TaylorSpace(1, degree), *SYSTEM.deviations)
    breaks = np.linspace(0.0, 3.0, 7)
    every = Propagator(SYSTEM.superposed(spread), merge_grids(breaks, breaks, varying=True))
    motion = VaryingMotion(every, np.eye(spread.states)[0])
    marks, points = motion.grid.breakpoints, np.linspace(-0.3, 0.6, 31)
    states = motion.nodes(np.zeros((1, 6)))[:, 0]
    seen = spread.space.monomials(spread.shares(points[:, None])) @ states.T
    off = np.abs(seen - decay(marks[None], points[:, None])).max(axis=0)
    lost = Truncation(motion, spread).bound_error(np.abs(states[:-1]), np.zeros((marks.size - 1, 2)))[:, 0]
    assert (off[1:] <= lost * (1.0 + 1e-9) + 1e-14).all()
    assert lost[-1] <= 1e3 * off.max()


@pytest.mark.parametrize("degree", [2, 3])
def test_supports_over_a_cell_hold_what_is_beyond_the_degree(degree: int) -> None:
    """A deviation of 1 of the initial state, and a disturbance of 0.2, by their closed forms at many parameters: each
    is above the polynomial alone, and at most the polynomial with what it neglects."""
    spread = ExpandedSystem(1, TaylorSpace(1, degree), *SYSTEM.deviations)
    breaks = np.linspace(0.0, 3.0, 7)
    every = Propagator(SYSTEM.superposed(spread), merge_grids(breaks, breaks, varying=True))
    cell = SpreadMotion(Truncation(VaryingMotion(every, np.eye(spread.states)[0]), spread))
    model = DisturbanceModel(
        "piecewise_constant", sr.Box([-0.2], [0.2]), sr.Box([-0.2], [0.2]), every.grid, starts=np.arange(6)
    )
    marks, points = cell.grid.breakpoints[:-1], np.linspace(-0.3, 0.6, 31)
    nodes, weights = np.polynomial.legendre.leggauss(24)
    late = (marks[:, None] + nodes * marks[:, None]) / 2
    passed = np.exp(-points[:, None, None] * (np.cos(2 * late) - np.cos(2 * marks[:, None])) / 2)
    driven = 0.1 * marks * ((np.exp(-(marks[:, None] - late) / 2) * passed) @ weights)
    monomials = spread.space.monomials(spread.shares(points[:, None]))
    truths = (driven, decay(marks[None], points[:, None]))
    inputs, forcing = np.tile([0.0, 0.2], (marks.size, 1)), 0.2 * cell.motion.flow.sizes[..., 1:]
    entering = ((inputs, forcing), (0.0 * inputs, 0.0 * forcing))
    supports = cell.supports(model, sr.Box([-1.0], [1.0]), np.ones((1, 1)), None)
    for support, truth, (pushed, forced) in zip(supports, truths, entering, strict=True):
        coefficients, excess = support.at(marks, np.zeros((marks.size, 1, 1)))
        polynomial = monomials @ coefficients[:, 0].T + excess[:, 0]
        neglected = support.neglected[0]
        assert (truth <= polynomial + neglected + 1e-14).all()
        beyond = (truth - polynomial).max()
        assert beyond > 1e-7 and neglected[-1] <= 1e5 * beyond
        assert (truth <= support.effect_bounds[:, 0] + neglected + 1e-14).all()
        sizes = support.sizes[:-1]
        steps = cell.motion.bound_state_errors(sizes, forced)
        assert (neglected >= cell.truncation.bound_error(sizes + steps, pushed)[:, 0] + steps.sum(axis=1)).all()


@pytest.mark.slow
def test_bounds_on_cells_hold_what_the_closed_form_gives_there() -> None:
    problem = sr.OptimalControlProblem(
        system=SYSTEM, horizon=3.0, initial_state=[1.0], control=sr.Box([-1.0], [1.0]), path=[sr.Box([-0.5], [0.5])]
    )
    pieces = sr.Dictionary.indicators(np.linspace(0.0, 3.0, 7))
    (constraint,) = prepare(problem, pieces, pieces).constraints
    rng, nothing = np.random.default_rng(30), np.zeros(6)
    cuts = constraint.functionals.response.propagator.marks
    starts = rng.choice(cuts[:-1], 40)
    stops = cuts[np.searchsorted(cuts, starts, side="right")]
    begun = starts + rng.uniform(0.0, 0.9, 40) * (stops - starts)
    ended = begun + rng.uniform(0.0, 1.0, 40) * (stops - begun)
    low = rng.uniform(-0.3, 0.6, 40)
    high = low + rng.uniform(0.0, 1.0, 40) * (0.6 - low)
    found = constraint.enclosure(nothing, np.stack([begun, low], axis=1), np.stack([ended, high], axis=1)).bounds
    t, p = (a + rng.uniform(0.0, 1.0, (200, 40)) * (b - a) for a, b in ((begun, ended), (low, high)))
    t[0], p[0], p[1] = begun, low, high
    truth = np.maximum(decay(t, p), -decay(t, p)).max(axis=0) - 0.5
    assert (truth <= found + 1e-14).all()
    assert np.median(found - truth) < 0.05
    response, which = constraint.functionals.response, rng.permutation(np.linspace(-0.3, 0.6, 37))
    states = response.states(np.zeros((1, 6)), which[:, None])[:, :, 0]
    exact = decay(response.grid.breakpoints, which[:, None])
    assert states == pytest.approx(exact, rel=1e-8)
    times, directions = np.repeat(3.0, 37), np.ones((37, 1))
    assert response.weights(times, directions, which[:, None]).free[:, 0] == pytest.approx(exact[:, -1], rel=1e-8)
    lower, upper = constraint.cells
    assert len(lower) == cuts.size - 1
    assert (upper - lower).prod(axis=1).sum() == pytest.approx(3.0 * 0.9)


@pytest.mark.slow
def test_cells_of_time_end_where_a_segment_of_any_part_does() -> None:
    law = [["-8/(p + 0.5) - sin(2*t)"]]
    system = sr.VaryingSystem.of(law, [[1]], 3.0, parameters=sr.Box([0.01], [3.0]), names=["p"])
    breaks = np.linspace(0.0, 3.0, 3)
    propagator = Propagator(system, merge_grids(breaks, breaks, varying=True))
    assert propagator.laws is not None
    every = [
        (Expansion.of(one).ends, propagator.laws.ends(part)) for part, (_, one) in enumerate(propagator.laws.every)
    ]
    assert len({ends.size for ends, _ in every}) > 1
    for ends, cell in every:
        assert np.isin(ends, propagator.marks).all()
        assert np.isin(propagator.on_cell(*cell).marks, propagator.marks).all()


def test_growth_within_a_piece_is_no_floor_under_the_coefficients_of_a_small_cell() -> None:
    breaks = np.linspace(0.0, 3.0, 7)
    propagator = Propagator(SYSTEM, merge_grids(breaks, breaks, varying=True))
    for width in (1e-2, 1e-4):
        motion = SpreadMotion.of(propagator.on_cell(np.array([0.1]), np.array([0.1 + width])), np.ones(1), None).motion
        sizes = np.zeros((motion.grid.pieces, motion.states))
        sizes[:, 0] = 1.0  # of the constant coefficient
        grown = motion.grown(motion.every, motion.grid.lengths, sizes)
        assert (grown[:, 0] >= 1.0).all()
        orders = np.arange(1, motion.states)
        assert (grown[:, 1:] <= 2.0 * width**orders + 1e-15).all()


PARTS = expansions.ParameterParts((np.array([0.0, 1.0, 3.0]), np.array([-1.0, 0.0])), ((None, None),) * 2)  # type: ignore[arg-type]


def test_every_parameter_and_every_cell_within_one_has_its_part() -> None:
    assert PARTS.of(np.array([[0.0, -1.0], [0.9, 0.0], [1.1, -0.5], [3.0, 0.0]])).tolist() == [0, 0, 1, 1]
    assert PARTS.holding(np.array([0.2, -1.0]), np.array([1.0, -0.5])) == 0
    assert PARTS.holding(np.array([1.0, -1.0]), np.array([3.0, 0.0])) == 1
    assert PARTS.holding(np.array([0.99, -1.0]), np.array([3.0, 0.0])) is None
    assert PARTS.holding(np.array([0.0, -1.0]), np.array([1.01, 0.0])) is None
    assert PARTS.holding(np.array([0.0, -1.01]), np.array([1.0, 0.0])) is None


def test_cells_are_cut_where_parts_end() -> None:
    lower, upper = PARTS.cut(np.array([[2.0, 0.0, -1.0]]), np.array([[2.0, 3.0, 0.0]]))  # one time
    assert lower.tolist() == [[2.0, 0.0, -1.0], [2.0, 1.0, -1.0]]
    assert upper.tolist() == [[2.0, 1.0, 0.0], [2.0, 3.0, 0.0]]
    lower, upper = PARTS.cut(np.array([[0.0, 1.0, -1.0]]), np.array([[2.0, 3.0, 0.0]]))  # of one part
    assert (lower.tolist(), upper.tolist()) == ([[0.0, 1.0, -1.0]], [[2.0, 3.0, 0.0]])


RELAXING = sr.VaryingSystem.of(
    [["-1/(1 + p) + 0*t"]], [["1/(1 + p)"]], 2.0, [[1]], parameters=sr.Box([-0.2], [0.3]), names=["p"]
)
FILLING = sr.VaryingSystem.of(
    [["0*t"]], [["1/(1 + p)"]], 2.0, [["exp(p)"]], parameters=sr.Box([-0.2], [0.3]), names=["p"]
)


def relaxed(t: np.ndarray, p: np.ndarray) -> np.ndarray:
    """What an initial state of 1 becomes under a control of -2."""
    return np.asarray(3.0 * np.exp(-t / (1.0 + p)) - 2.0)


@pytest.mark.parametrize("degree", [2, 3, 5])
@pytest.mark.parametrize("name", ["relaxing", "filling"])
def test_what_power_series_leave_of_entries_is_in_what_is_beyond(name: str, degree: int) -> None:
    system = RELAXING if name == "relaxing" else FILLING
    left = cauchy(system).bound_remainder(degree)
    spread = ExpandedSystem(1, TaylorSpace(1, degree), *system.deviations, remainder=left)
    breaks = np.linspace(0.0, 2.0, 5)
    every = Propagator(system.superposed(spread), merge_grids(breaks, breaks, varying=True))
    motion = VaryingMotion(every, np.eye(spread.states)[0])
    marks, points = motion.grid.breakpoints, np.linspace(-0.2, 0.3, 31)
    states = motion.nodes(np.full((1, 4), -2.0))[:, 0]
    seen = spread.space.monomials(spread.shares(points[:, None])) @ states.T
    t, p = marks[None], points[:, None]
    off = np.abs(seen - (relaxed(t, p) if name == "relaxing" else 1.0 - 2.0 * t / (1.0 + p))).max(axis=0)
    truncation, inputs = Truncation(motion, spread), np.tile([2.0, 0.0], (marks.size - 1, 1))
    lost = truncation.bound_error(np.abs(states[:-1]), inputs)[:, 0]
    assert (off[1:] <= lost * (1.0 + 1e-9) + 1e-14).all()
    assert lost[-1] <= 1e4 * off.max()
    rest = 1.0 / (1.0 + points)  # the series of 1 / (1 + p) in shares of a quarter
    rest = rest - sum((-0.25) ** n / 1.05 ** (n + 1) * ((points - 0.05) / 0.25) ** n for n in range(degree + 1))
    without = Truncation(motion, replace(spread, remainder=None)).bound_error(np.abs(states[:-1]), inputs)[:, 0]
    entering = np.exp(-2.0 / 0.8) if name == "relaxing" else 2.0  # the least that multiplies what is beyond
    assert (lost - without)[-1] >= 2.0 * np.abs(rest).max() * entering
    others = np.tile([0.0, 1.0], (marks.size - 1, 1))
    if name == "filling":  # a disturbance of 1, whose effect is t exp(p)
        exact = [float(np.exp(0.05 + 0.25 * e)) for e in np.linspace(-1.0, 1.0, 31)]
        series = sum(np.exp(0.05) * (0.25 * np.linspace(-1.0, 1.0, 31)) ** n / factorial(n) for n in range(degree + 1))
        true = 2.0 * float(np.abs(exact - series).max())
        assert true <= truncation.bound_error(0.0 * np.abs(states[:-1]), others)[-1, 0] <= 1e2 * true


PUSHED = sr.VaryingSystem.of(
    [["0", "1"], ["-(1 + p*sin(2*t)) - q", "-1/(4 + q)"]],
    [["0"], ["1 + p^2*cos(t)"]],
    3.0,
    [["q"], ["1"]],
    parameters=sr.Box([0.1, -0.1], [0.3, 0.05]),
    names=["p", "q"],
)


@pytest.mark.first(1)
@pytest.mark.parametrize("most", [400, 30])
def test_rows_and_outputs_at_any_time_and_parameter_are_those_of_an_integrator(
    most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(expansions, "TRUNCATION_TOLERANCES", (1e-8,))
    monkeypatch.setattr(expansions, "NUMBERS", most)  # fewer numbers are several parts
    breaks, rng = np.linspace(0.0, 3.0, 3), np.random.default_rng(4)
    system = PUSHED.in_phases([replace(phase) for phase in PUSHED.phases])
    response = Response(system, merge_grids(breaks, breaks, varying=True), np.array([1.0, -0.5]))
    assert response.propagator.laws is not None
    assert (len(response.propagator.laws.every) > 1) == (most == 30)
    times, c = np.array([0.4, 1.5, 2.3, 3.0]), rng.normal(size=(4, 2))
    points = rng.uniform(PUSHED.parameters.lower, PUSHED.parameters.upper, (4, 2))  # type: ignore[union-attr]
    control, disturbance = np.array([[1.0, -2.0]]), np.array([0.5, 0.3])
    weights = response.weights(times, c, points)
    rows = weights.free @ response.initial_state
    rows += weights.control[..., 0] @ control[0] + weights.disturbance[..., 0] @ disturbance
    outputs = OutputResponse(response.propagator, c, times, points).at(response, control)
    for k, (p, q) in enumerate(points.tolist()):

        def rate(t: float, x: np.ndarray, u: float, w: float, p: float = p, q: float = q) -> np.ndarray:
            moved = -(1 + p * np.sin(2 * t) + q) * x[0] - x[1] / (4 + q) + (1 + p**2 * np.cos(t)) * u + w
            return np.array([x[1] + q * w, moved])

        for share in (1.0, 0.0):
            x, seen = response.initial_state, {}
            for piece in range(2):
                inputs = control[0, piece], share * disturbance[piece]
                inside = times[(times > breaks[piece]) & (times <= breaks[piece + 1])]
                ends = breaks[piece], breaks[piece + 1]
                path = solve_ivp(rate, ends, x, args=inputs, t_eval=inside, method="DOP853", rtol=1e-12, atol=1e-13)
                seen |= dict(zip(inside.tolist(), path.y.T, strict=True))
                x = solve_ivp(rate, ends, x, args=inputs, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
            states = np.array([seen[t] for t in times.tolist()])
            if share:
                assert rows[k] == pytest.approx(c[k] @ states[k], abs=1e-7)
            else:
                assert outputs[k] == pytest.approx(c @ states.T, abs=1e-7)


@pytest.mark.parametrize("off", [0.0, 3e-7])
def test_norms_of_coefficients_hold_what_transitions_are_off_by(off: float, monkeypatch: pytest.MonkeyPatch) -> None:
    spread = ExpandedSystem(1, TaylorSpace(1, 6), *SYSTEM.deviations)
    breaks = np.linspace(0.0, 3.0, 7)
    every = Propagator(SYSTEM.superposed(spread), merge_grids(breaks, breaks, varying=True))
    truncation = Truncation(VaryingMotion(every, np.eye(spread.states)[0]), spread)
    marks, (centre, units) = truncation.motion.grid.breakpoints, SYSTEM.deviations
    if off:  # in the highest coefficient alone, which counts most in most norms
        wrong, flow = np.zeros((1, 7, 1)), truncation.motion.flow
        wrong[0, 6] = off
        truncation.motion.__dict__["flow"] = flow._replace(state=flow.state - spread.filled(wrong))
        monkeypatch.setattr(
            Expansion,
            "off",
            lambda _, starts, stops, ratio: np.full((len(ratio), starts.size), off * np.array(ratio)[:, None] ** 6),
        )
    turned = (np.cos(2 * marks[:, None]) - np.cos(2 * marks)) / 2  # of the integral of p sin(2 t), from one to another
    still = np.exp(-(marks[:, None] - marks) / 2 + centre[0] * turned)
    found = truncation._transition_norms
    for degree in range(7):
        exact = np.abs(still * (units[0] * turned) ** degree / factorial(degree))
        for k in range(marks.size):
            largest = exact[k, : k + 1].max()
            assert found[k, degree] >= largest * (1.0 - 1e-13)
            assert off or found[k, degree] <= largest * (1.0 + 1e-9) + 1e-12 / 2.0**degree


LOW, HIGH = np.array([0.15, -0.05]), np.array([0.22, 0.03])


@pytest.fixture(scope="module")
def pushed() -> Propagator:
    breaks = np.linspace(0.0, 3.0, 4)
    return Propagator(PUSHED, merge_grids(breaks, breaks, varying=True))


def entries(t: float, p: float, q: float) -> np.ndarray:
    """``[A B E]`` of `PUSHED`."""
    A = [[0.0, 1.0], [-(1 + p * np.sin(2 * t)) - q, -1 / (4 + q)]]
    return np.hstack([A, [[0.0], [1 + p**2 * np.cos(t)]], [[q], [1.0]]])


def seen_at(expansion: Expansion, t: float, powers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``[A B E]`` at a time from the coefficients of an expansion with these monomials, and what is left out."""
    (k,) = expansion.segment_of(np.array([t]))
    share = (2 * t - expansion.ends[k] - expansion.ends[k + 1]) / (expansion.ends[k + 1] - expansion.ends[k])
    law = np.einsum("n,nij->ij", share ** np.arange(expansion.coefficients.shape[1]), expansion.coefficients[k])
    both = []
    for table, weights in ((law, powers), (expansion.remainder[k], np.abs(powers))):
        first = np.hstack([table[:, :2], table[:, expansion.units.size :]])
        both.append(np.einsum("a,aij->ij", weights, first.reshape(powers.size, 2, -1)))
    return both[0], both[1]


def test_the_law_on_a_cell_is_that_of_its_parameters_but_for_what_it_says(pushed: Propagator) -> None:
    expansion, rng = pushed.on_cell(LOW, HIGH).expansion, np.random.default_rng(8)
    assert expansion is not None
    assert expansion.spread is not None
    for t, *shares in rng.uniform([0.0, -1.0, -1.0], [3.0, 1.0, 1.0], (40, 3)).tolist():
        p, q = (LOW + HIGH) / 2 + (HIGH - LOW) / 2 * np.array(shares)
        law, left = seen_at(expansion, t, expansion.spread.space.monomials(np.array([shares]))[0])
        beyond = 0.0 if expansion.spread.remainder is None else expansion.spread.remainder.over(np.array([t, t]))[0]
        off = np.abs(law - entries(t, float(p), float(q)))
        assert (off <= left + beyond).all()
        assert off.max() < 1e-9


def test_what_a_cell_leaves_of_its_law_is_counted_and_nothing_else(
    pushed: Propagator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dependence, "NUMBERS_ON_CELL", 6)  # so few that the degree is 1, and q/(4 + q) and p^2 are not
    expansion = pushed.on_cell(LOW, HIGH).expansion
    assert expansion is not None
    assert expansion.spread is not None
    assert expansion.spread.space.degree == 1
    assert expansion.spread.remainder is not None
    r, s = (HIGH - LOW) / 2
    left = expansion.spread.remainder.over(np.array([0.0, 0.3]))[0]
    assert r**2 <= left[1, 2] <= 1.3 * r**2  # of 1 + p^2 cos t
    assert s**2 / 4.05**3 <= left[1, 1] <= 1.3 * s**2 / 3.9**3  # of -1 / (4 + q)
    assert left[0].max() < 1e-15
    assert left[1, 0] < 1e-15


def test_a_known_plant_at_a_parameter_is_what_the_law_is_there(pushed: Propagator) -> None:
    expansion, rng = pushed.at_point(np.array([0.27, 0.02])).expansion, np.random.default_rng(9)
    assert expansion is not None
    for t in rng.uniform(0.0, 3.0, 20).tolist():
        law, left = seen_at(expansion, t, np.ones(1))
        off = np.abs(law - entries(t, 0.27, 0.02))
        assert (off <= left + 1e-13).all()
        assert left.max() < 1e-12
        A, inputs = pushed.law.entries(np.array([t]), np.array([[0.27, 0.02]]))
        assert np.hstack([A[0], inputs[0]]) == pytest.approx(entries(t, 0.27, 0.02), abs=1e-12)


def test_cells_whose_state_moves_too_far_say_along_which_parameter() -> None:
    law = [["p*sin(2*t) + q"]]
    box = sr.Box([-3.0, -0.1], [3.0, 0.1])
    system = sr.VaryingSystem.of(law, [[1]], 3.0, parameters=box, names=["p", "q"])
    breaks = np.linspace(0.0, 3.0, 4)
    propagator = Propagator(system, merge_grids(breaks, breaks, varying=True))
    with pytest.raises(NotEnclosable) as raised:
        SpreadMotion.of(propagator.on_cell(box.lower, box.upper), np.ones(1), None)
    assert raised.value.along == 0
    wide = SpreadMotion.of(propagator.on_cell(np.array([0.0, -0.1]), np.array([0.5, 0.1])), np.ones(1), None)
    inside = SpreadMotion.of(propagator.on_cell(np.array([0.2, 0.0]), np.array([0.3, 0.1])), np.ones(1), None)
    # transitions over [s, t] are exp(p (cos 2s - cos 2t) / 2 + q (t - s)), at most on the larger cell
    t = np.linspace(0.0, 3.0, 301)
    turned, passed = (np.cos(2 * t[:, None]) - np.cos(2 * t)) / 2, t - t[:, None]
    for leg, p, q in ((wide, (0.0, 0.5), (-0.1, 0.1)), (inside, (0.2, 0.3), (0.0, 0.1))):
        most = max(np.exp(a * turned + b * passed)[passed >= 0.0].max() for a in p for b in q)
        assert most <= leg.truncation.growth <= 3.0 * most
    assert inside.truncation.growth <= wide.truncation.growth


def test_derivatives_in_time_and_parameters_are_those_of_differences() -> None:
    problem = sr.OptimalControlProblem(
        system=PUSHED,
        horizon=3.0,
        initial_state=[1.0, -0.5],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.1], [0.1]),
        path=[sr.Box([-2.0, -2.0], [2.0, 2.0])],
    )
    pieces, rng = sr.Dictionary.indicators(np.linspace(0.0, 3.0, 7)), np.random.default_rng(10)
    (family,) = prepare(problem, pieces, pieces).program.families
    box, x = family.index_set, rng.uniform(-1.0, 1.0, 6)
    indices = rng.uniform(box.lower + 0.01, box.upper - 0.01, (30, 3))
    indices = indices[np.abs(indices[:, 0] / 0.5 - np.rint(indices[:, 0] / 0.5)) > 0.02]
    assert family.gradient is not None

    def value(at: np.ndarray) -> np.ndarray:
        G, h = family.rows(at)
        return np.asarray(G[:, 0] @ x - h[:, 0])

    found = family.gradient(x, indices, np.zeros(len(indices), dtype=int))
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        exact = (value(indices + step) - value(indices - step)) / 2e-6
        assert found[:, axis] == pytest.approx(exact, abs=1e-6)


DRIVEN = sr.VaryingSystem.of([["-1/(1 + p) + 0*t"]], [["1"]], 2.0, [[1]], parameters=sr.Box([-0.2], [0.3]), names=["p"])


@pytest.mark.parametrize(
    ("law", "begun", "closed"),
    [
        (RELAXING, 1.0, relaxed),
        (FILLING, 1.0, lambda t, p: 1.0 - 2.0 * t / (1.0 + p)),
        (DRIVEN, 0.0, lambda t, p: -2.0 * (1.0 + p) * (1.0 - np.exp(-t / (1.0 + p)))),
    ],
    ids=["relaxing", "filling", "driven"],
)
def test_what_a_law_leaves_out_of_its_series_is_in_no_state_more_than_is_said(
    law: sr.System, begun: float, closed: Callable[..., np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(expansions, "TRUNCATION_TOLERANCES", (1e-2,))  # so much that the degree is low
    system = law.in_phases([replace(phase) for phase in law.phases])
    problem = sr.OptimalControlProblem(
        system=system, horizon=2.0, initial_state=[begun], control=sr.Box([-2.0], [2.0]), path=[sr.Box([-9.0], [9.0])]
    )
    pieces = sr.Dictionary.indicators(np.linspace(0.0, 2.0, 5))
    (constraint,) = prepare(problem, pieces, pieces).constraints
    functionals, points = constraint.functionals, np.linspace(-0.2, 0.3, 31)
    states = functionals.response.states(np.full((1, 4), -2.0), points[:, None])[:, :, 0]
    exact = closed(functionals.response.grid.breakpoints, points[:, None])
    off, said = np.abs(states - exact).max(), functionals.over_cells.truncation(np.array([2.0]))[0]
    assert 1e-6 < off <= said <= 1e3 * off
    least = functionals.over_cells.truncation(np.array([0.0]))[0]
    assert (least > 0.0) == (law is RELAXING)
    assert least < said
    wider = replace(functionals, initial=sr.Box([-1.0], [1.0])).over_cells.truncation(np.array([2.0]))[0]
    assert (wider > said) == (law is not FILLING)
    cell = functionals.response.propagator.on_cell(np.array([-0.1]), np.array([0.2])).expansion
    assert cell is not None
    assert cell.spread is not None
    assert cell.spread.remainder is not None
    for p in (-0.1, 0.05, 0.2):  # what the law leaves out is in what is beyond a cell
        powers = cell.spread.space.monomials(np.array([[(p - 0.05) / 0.15]]))[0]
        found = (
            powers @ cell.coefficients[0, 0, :, 0] if law is not FILLING else powers @ cell.coefficients[0, 0, :, -2]
        )
        true = -1.0 / (1.0 + p) if law is not FILLING else 1.0 / (1.0 + p)
        entry = cell.spread.remainder.sizes[0, 0, 0 if law is not FILLING else 1]
        assert abs(found - true) <= entry + 1e-14
    (polynomial,) = prepare(replace(problem, system=SYSTEM, horizon=3.0), pieces_of(3.0), pieces_of(3.0)).constraints
    assert not polynomial.functionals.over_cells.truncation(np.array([2.0])).any()


def pieces_of(horizon: float) -> sr.Dictionary:
    return sr.Dictionary.indicators(np.linspace(0.0, horizon, 5))


def test_growth_is_asked_of_the_part_that_a_cell_is_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expansions, "TRUNCATION_TOLERANCES", (1e-3,))
    monkeypatch.setattr(expansions, "NUMBERS", 14)
    law = [["0", "exp(3*p)"], ["-1", "-0.1*t"]]
    system = sr.VaryingSystem.of(law, [[0], [1]], 1.0, parameters=sr.Box([-1.0], [1.0]), names=["p"])
    problem = sr.OptimalControlProblem(
        system=system,
        horizon=1.0,
        initial_state=[0.1, 0.0],
        control=sr.Box([-1.0], [1.0]),
        path=[sr.Box([-9.0] * 2, [9.0] * 2)],
    )
    (constraint,) = prepare(problem, pieces_of(1.0), pieces_of(1.0)).constraints
    functionals = constraint.functionals
    laws = functionals.response.propagator.laws
    assert laws is not None
    units = [Expansion.of(one).units[:2].tolist() for _, one in laws.every]
    edge = next(k for k in range(len(units) - 1) if units[k] != units[k + 1])
    before = functionals.over_cells.legs(*laws.ends(edge))[0]
    point = laws.ends(edge)[1]  # which is in the part after
    after = functionals.over_cells.legs(point, point)[0]
    assert isinstance(before, SpreadMotion)
    assert isinstance(after, SpreadMotion)
    assert after.truncation.known is None
    narrow = laws.ends(edge)[0], laws.ends(edge)[0] * 0.75 + point * 0.25
    inside = functionals.over_cells.legs(*narrow)[0]
    assert isinstance(inside, SpreadMotion)
    assert inside.truncation.growth == before.truncation.growth
    (other,) = prepare(problem, pieces_of(1.0), pieces_of(1.0)).constraints
    other.functionals.over_cells.legs(*narrow)
    around = other.functionals.over_cells.legs(*laws.ends(edge))[0]  # which is not inside of what is known
    assert isinstance(around, SpreadMotion)
    assert around.truncation.known is None


def test_growth_is_the_largest_on_any_half_of_a_part() -> None:
    law = [["2*exp(p) + 0*t"]]
    system = sr.VaryingSystem.of(law, [[1]], 2.0, parameters=sr.Box([-1.0], [1.0]), names=["p"])
    problem = sr.OptimalControlProblem(
        system=system, horizon=2.0, initial_state=[0.0], control=sr.Box([-1.0], [1.0]), path=[sr.Box([-9.0], [9.0])]
    )
    (constraint,) = prepare(problem, pieces_of(2.0), pieces_of(2.0)).constraints
    low, high = np.array([-1.0]), np.array([1.0])
    with pytest.raises(NotEnclosable):
        constraint.functionals.over_cells.legs(low, high)
    found = constraint.functionals.over_cells._bound_growth(low, high, 8)
    assert np.exp(4.0 * np.e) * (1.0 - 1e-9) <= found <= 100.0 * np.exp(4.0 * np.e)
    assert constraint.functionals.over_cells._bound_growth(low, high, 0) == np.inf


def test_what_steps_are_off_by_is_carried_to_all_coefficients(pushed: Propagator) -> None:
    motion = SpreadMotion.of(pushed.on_cell(LOW, HIGH), np.zeros(2), None).motion
    steps, units = motion.flow.state, motion.expansion.units
    for mark in (1, len(steps) // 2, len(steps)):
        transition = np.eye(motion.states)
        for piece in range(mark - 1, -1, -1):  # from the end of the piece
            stretch = motion._stretches[0][piece]
            assert (motion.transition_bounds[mark, stretch] >= np.abs(transition) @ units * (1.0 - 1e-12)).all()
            transition = transition @ steps[piece]


def test_what_a_law_leaves_out_in_time_is_no_less_on_a_cell_than_at_its_corners(pushed: Propagator) -> None:
    assert pushed.laws is not None
    how, law = pushed.laws.every[0][0], pushed.laws.expansions[0]
    low, high = np.array([0.25, 0.0]), np.array([0.3, 0.05])  # at a corner all monomials have one sign
    rough = replace(law, remainder=np.full(law.remainder.shape, 1e-3))
    cell, corner = rough.on_cell(how, low, high), rough.at_point(how, high)
    assert cell.spread is not None
    first = np.concatenate([cell.remainder[..., :2], cell.remainder[..., cell.units.size :]], axis=2)
    on_cell = first.reshape(len(first), cell.spread.space.size, 2, -1).sum(axis=1)
    left = 0.0 if cell.spread.remainder is None else cell.spread.remainder.over(cell.ends)
    assert (on_cell + left >= corner.remainder * (1.0 - 1e-9)).all()
    assert (on_cell <= 1.01 * corner.remainder).all()


def test_cells_on_which_inputs_vanish_are_halved_where_states_grow() -> None:
    law = [["7 + 0.1*sin(t) + 0.05*(q + 0.3*q^2)"]]
    box = sr.Box([-1.0, -3.0], [1.0, 3.0])
    system = sr.VaryingSystem.of(law, [["p"]], 3.0, parameters=box, names=["p", "q"])
    breaks = np.linspace(0.0, 3.0, 4)
    propagator = Propagator(system, merge_grids(breaks, breaks, varying=True))
    low, high = np.array([0.0, -3.0]), np.array([1e-3, 3.0])
    with pytest.raises(NotEnclosable) as raised:
        SpreadMotion.of(propagator.on_cell(low, high), np.ones(1), None)
    assert raised.value.along == 1
    leg = SpreadMotion.of(propagator.on_cell(low, np.array([1e-3, -2.99])), np.ones(1), None)
    assert leg.influence[0] < 0.01  # falls with the cell
