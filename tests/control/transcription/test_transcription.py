"""Guards control/transcription: from a problem to its semi-infinite program: cost, bounds, equalities and families,
against the definition."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sparserob_core as sr
import sparserob_core.checker.outcome as checked
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.problem.terms.windows import PathConstraint
from sparserob_core.control.sets.sets import Ellipsoid, Equality, NormBall, Polytope
from sparserob_core.control.transcription.own_units import THIN_SET_SHARE, units_of_sides
from sparserob_core.control.transcription.transcribe import transcribe
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Box
from tests.support.plants import held, indicators, simulated, uniform, walsh

HORIZON = 3.0
UNEVEN = indicators([0.0, 0.2, 0.25, 1.1, HORIZON])
CONTROLS = {
    "box": Box([-1.0, -0.5], [2.0, 0.5]),
    "triangle": Polytope([[1.0, 1.0], [-1.0, 0.2], [0.0, -1.0]], [1.0, 0.7, 0.4]),
    "1-norm": NormBall(p=1.0, radius=0.8, centre=[0.1, 0.0]),
    "disc": NormBall(p=2.0, radius=0.7, dimension=2),
    "ellipse": Ellipsoid([0.2, 0.0], [[0.5, 0.2], [0.2, 0.3]]),
}


def problem_of(rng, control=CONTROLS["box"], **more):
    system = LinearSystem(rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), rng.normal(size=(3, 2)))
    return OptimalControlProblem(
        system=system, horizon=HORIZON, initial_state=rng.normal(size=3), control=control, **more
    )


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    shape=st.sampled_from(["uneven", "walsh", "three walsh"]),
    control=st.sampled_from(sorted(CONTROLS)),
)
def test_the_cost_is_the_weighted_integral_of_the_modulus_of_the_control(seed, shape, control):
    rng = np.random.default_rng(seed)
    dictionary = {"uneven": UNEVEN, "walsh": walsh(4, HORIZON), "three walsh": walsh(4, HORIZON, 3)}[shape]
    weights = rng.uniform(0.5, 2, 2)
    program = transcribe(problem_of(rng, CONTROLS[control], weights=weights), dictionary)
    theta = rng.normal(size=(2, dictionary.functions))
    times = (np.arange(60_000) + 0.5) * HORIZON / 60_000
    signal = (theta @ dictionary.values)[
        :, np.clip(np.searchsorted(dictionary.breakpoints, times) - 1, 0, dictionary.pieces - 1)
    ]
    truth = (weights @ np.abs(signal)).mean() * HORIZON
    assert abs(program.cost(theta.ravel()) - truth) <= 1e-3 * truth
    assert program.image_size == 2 * dictionary.pieces


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    shape=st.sampled_from(["uneven", "walsh", "three walsh"]),
    control=st.sampled_from(sorted(CONTROLS)),
)
def test_a_decision_is_feasible_exactly_when_its_control_is_in_its_set_on_every_piece(seed, shape, control):
    rng = np.random.default_rng(seed)
    dictionary = {"uneven": UNEVEN, "walsh": walsh(4, HORIZON), "three walsh": walsh(4, HORIZON, 3)}[shape]
    program = transcribe(problem_of(rng, CONTROLS[control]), dictionary)
    for _ in range(8):
        theta = rng.uniform(0, 0.8) * rng.normal(size=(2, dictionary.functions))
        image = program.finite.image(theta.ravel())
        outside = max((program.finite.lower - image).max(), (image - program.finite.upper).max())
        for family in program.families:
            outside = max(outside, family.worst(theta.ravel()).violations[0])
        truth = CONTROLS[control].violation((theta @ dictionary.values).T).max()
        if abs(truth) > 1e-6:
            assert (outside > 0) == (truth > 0)


def test_terminal_equalities_fix_the_simulated_state():
    rng = np.random.default_rng(1)
    problem = problem_of(rng, terminal=[Equality([0.3, np.nan, -0.2])])
    program = transcribe(problem, UNEVEN)
    theta = np.linalg.lstsq(program.finite.A, program.finite.b, rcond=None)[0]
    A, B, _ = (matrix[0] for matrix in problem.system.phases[0].matrices(np.zeros((1, 0))))
    end = simulated(
        A, [(B, UNEVEN.breakpoints, theta.reshape(2, -1))], problem.initial_state, HORIZON, UNEVEN.breakpoints
    )
    assert program.finite.A.shape == (2, 8)
    assert np.allclose(end[[0, 2]], [0.3, -0.2], atol=1e-10)


def test_an_equality_of_a_state_that_uncertainty_reaches_is_refused():
    rng = np.random.default_rng(2)
    disturbed = {"disturbance": Box([-0.1, -0.1], [0.1, 0.1]), "terminal": [Equality([0.0, np.nan, np.nan])]}
    with pytest.raises(InputError, match="state 1 depends on the uncertainty"):
        transcribe(problem_of(rng, **disturbed), UNEVEN)
    system = LinearSystem(lambda p: np.array([[p[0]]]), [[1.0]], parameters=Box([-1.0], [1.0]))
    with pytest.raises(InputError, match="state 1 depends on the uncertainty"):
        transcribe(
            OptimalControlProblem(
                system=system, horizon=1.0, initial_state=[1.0], control=Box([-1.0], [1.0]), terminal=[Equality([0.0])]
            ),
            uniform(3, 1.0),
        )


@pytest.mark.parametrize(
    "size",
    [
        1.0,
        1e4,
    ],
)
def test_an_equality_of_a_state_that_the_parameter_does_not_reach_is_kept_whatever_its_size(size):
    """The second state is driven by the control alone; the first, uncertain, does not reach it. Rounding grows with the
    numbers."""
    system = LinearSystem(
        lambda p: np.array([[0.7 * p[0], p[0], 0.0], [0.0, 1.3, 0.8], [0.0, -0.7, 1.1]]),
        lambda p: size * np.array([[1.0], [0.3], [0.7]]),
        parameters=Box([-1.0], [1.0]),
    )
    problem = OptimalControlProblem(
        system=system,
        horizon=HORIZON,
        initial_state=[0.0, size, 0.0],
        control=Box([-1.0], [1.0]),
        terminal=[Equality([np.nan, 0.0, 0.0])],
    )
    assert transcribe(problem, UNEVEN).finite.A.shape == (2, 4)


def test_families_are_named_and_windowed_as_the_problem_says():
    rng = np.random.default_rng(3)
    path = [
        PathConstraint(Box([-1, -np.inf, -np.inf], [1, np.inf, np.inf]), 0.5, 2.0),
        PathConstraint(NormBall(p=1.0, radius=9, dimension=3), name="diamond"),
    ]
    program = transcribe(
        problem_of(rng, path=path, terminal=[Box([-1] * 3, [1] * 3), Equality([np.nan] * 2 + [0.0])]), UNEVEN
    )
    assert [family.name for family in program.families] == ["path[0]", "diamond", "terminal"]
    windows = {family.name: (family.index_set.lower[0], family.index_set.upper[0]) for family in program.families}
    assert windows == {"path[0]": (0.5, 2.0), "diamond": (0.0, HORIZON), "terminal": (HORIZON, HORIZON)}
    assert program.families[0].rows(np.array([[1.0]]))[1].shape == (1, 2)
    assert program.families[1].rows(np.array([[1.0]]))[1].shape == (1, 8)


def test_equal_names_of_two_path_constraints_are_refused_with_a_sentence():
    path = [PathConstraint(Box([-1] * 3, [1] * 3), name="same"), PathConstraint(Box([-2] * 3, [2] * 3), name="same")]
    with pytest.raises(InputError, match="names must differ"):
        transcribe(problem_of(np.random.default_rng(3), path=path), UNEVEN)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_every_family_states_the_simulated_worst_case(seed):
    rng = np.random.default_rng(seed)
    bound = Box([-0.1, -0.2], [0.3, 0.1])
    problem = problem_of(
        rng, path=[Box([-1] * 3, [1] * 3)], terminal=[Polytope(rng.normal(size=(4, 3)), np.ones(4))], disturbance=bound
    )
    program = transcribe(problem, UNEVEN, uniform(4, HORIZON))
    theta = rng.normal(size=8)
    A, B, E = (matrix[0] for matrix in problem.system.phases[0].matrices(np.zeros((1, 0))))
    for family, convex in zip(program.families, [problem.path[0].set, problem.terminal[0]], strict=True):
        time = HORIZON if family.name == "terminal" else rng.uniform(0, HORIZON)
        H, h = convex.halfspaces()
        claimed = family.violations(theta, np.array([[time]]))[0]
        found = np.full(h.size, -np.inf)
        for _ in range(10):
            w = rng.choice([0, 1], size=(2, 4)) * (bound.upper - bound.lower)[:, None] + bound.lower[:, None]
            drives = [(B, UNEVEN.breakpoints, theta.reshape(2, -1)), (E, np.linspace(0, HORIZON, 5), w)]
            found = np.maximum(found, H @ simulated(A, drives, problem.initial_state, time, UNEVEN.breakpoints) - h)
        assert (found <= claimed + 1e-9).all()
        for row in range(h.size):
            w = family.explain(np.array([time]), row).disturbance
            grid = np.unique(np.concatenate([UNEVEN.breakpoints, np.linspace(0, HORIZON, 5)]))
            state = simulated(
                A, [(B, UNEVEN.breakpoints, theta.reshape(2, -1)), (E, grid, w)], problem.initial_state, time, grid
            )
            assert abs(H[row] @ state - h[row] - claimed[row]) <= 1e-9 * max(1.0, abs(claimed[row]))


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6), complete=st.booleans())
def test_the_literal_program_at_the_worst_disturbance_is_the_reduced_one(seed, complete):
    rng = np.random.default_rng(seed)
    problem = problem_of(rng, path=[Box([-1] * 3, [1] * 3)], disturbance=Box([-0.1, -0.2], [0.3, 0.1]))
    dictionary = walsh(4, HORIZON, None if complete else 3)
    reduced = transcribe(problem, UNEVEN, dictionary).families[0]
    literal = transcribe(problem, UNEVEN, dictionary, formulation="literal").families[0]
    theta = rng.normal(size=8)
    lower, upper = literal.index_set.lower, literal.index_set.upper
    indices = lower + rng.uniform(size=(30, lower.size)) * (upper - lower)
    assert (literal.violations(theta, indices) <= reduced.violations(theta, indices[:, :1]) + 1e-9).all()
    assert literal.worst(theta).violations[0] == pytest.approx(reduced.worst(theta).violations[0], abs=1e-9)


def test_a_dictionary_over_another_horizon_is_refused():
    with pytest.raises(InputError, match="expected the horizon"):
        transcribe(problem_of(np.random.default_rng(4)), uniform(3, 2.0))
    with pytest.raises(InputError, match="expected the horizon"):
        transcribe(problem_of(np.random.default_rng(4)), uniform(3, HORIZON), uniform(3, 4.0))


def test_pieces_shorter_than_rounding_are_transcribed_or_refused_with_a_sentence():
    tiny = Dictionary(np.array([0.0, 1.0, 1.0 + 1e-13, HORIZON]), np.eye(3))
    problem = problem_of(np.random.default_rng(5), path=[Box([-1] * 3, [1] * 3)])
    try:
        program = transcribe(problem, tiny)
    except InputError:
        return
    assert program.families[0].rows(np.array([[2.0]]))[0].shape == (1, 6, 6)


def test_the_control_is_read_piece_by_piece():
    theta = np.arange(4.0)
    assert held(UNEVEN.breakpoints, theta[None], 0.22)[0] == 1.0
    assert held(UNEVEN.breakpoints, theta[None], HORIZON)[0] == 3.0


def test_a_control_that_answers_has_the_nominal_entries_and_the_units_of_one_that_does_not() -> None:
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(A=[[0, 1], [-2, -0.5]], B=[[0], [1]]),
        horizon=2.0,
        initial_state=[-1, 1],
        control=sr.Box([-3], [2]),
        disturbance=sr.Box([-0.02, -40], [0.02, 40]),
        path=[sr.PathConstraint(sr.Box([-300, -2000], [300, 2000]), 0.5)],
    )
    grid = sr.Dictionary.indicators(np.linspace(0.0, 2.0, 5))
    plain, answering = (sr.transcribe(problem, grid, policy=policy) for policy in (None, sr.AffinePolicy()))
    own = [program.own_units for program in (plain, answering)]
    assert own[0] is not None and own[1] is not None
    for one, other in ((plain, answering), (own[0].program, own[1].program)):
        for name in ("weights", "lower", "upper"):
            assert getattr(one.finite, name).tolist() == getattr(other.finite, name)[: grid.pieces].tolist()
    for units in ("decision", "image"):
        assert getattr(own[0], units).tolist() == getattr(own[1], units)[: grid.pieces].tolist()
    mine, theirs = (each.program.family("path") for each in own if each is not None)
    assert mine.row_units is not None and theirs.row_units is not None
    assert mine.row_units.tolist() == theirs.row_units.tolist()
    assert set(mine.row_units.tolist()) != {1.0}
    for family in (mine, theirs):  # every form of a family in own units is told in the user's
        literal = family.literal
        assert literal is not None and literal.reduced is not None and literal.reduced.row_units is not None
        assert literal.index_units is not None and literal.index_units.size == literal.index_set.dimension
        assert literal.index_units.min() < 1.0 < literal.index_units.max()


def test_a_slab_that_is_thin_beside_what_a_plant_amplifies_is_one_like_others() -> None:
    """Sums of 1e13 from states of 1: the slab is 2 wide, and its unit what doubles resolve of the sums."""
    H, h, sums = np.array([[1.0], [-1.0]]), np.ones(2), np.full(2, 1e13)
    for driven, unit in ((1.0, 2.0**-18 * 1e13), (np.inf, 2.0**-4 * 1e13)):
        units = units_of_sides(H, h, sums, sums, np.full(2, driven))
        assert (1.2 * units <= unit).all() and (unit <= 2.5 * units).all()


def test_the_unit_of_a_slab_that_doubles_do_not_resolve_is_how_far_its_row_reaches() -> None:
    """2^-37 of the sums, less than what the checker calls thin; a sixteenth of the reach, since a claim may excuse no
    more than what the row does. A unit is 1.2 to 2.5 times below that."""
    assert THIN_SET_SHARE < checked.THIN
    H, added = np.array([[1.0], [-1.0]]), np.full(2, 4.0)
    for share, unit in ((0.99, 2.0**-4 * 3.0), (1.01, 2.0**-18 * 4.0)):
        half = 0.5 * share * 2.0**-37 * 4.0
        units = units_of_sides(H, np.array([2.0 + half, -2.0 + half]), np.full(2, 3.0), added)
        assert (1.2 * units <= unit).all() and (unit <= 2.5 * units).all()
    alone = units_of_sides(H[:1], np.array([0.99 * 2.0**-37 * 4.0]), np.array([3.0]), added[:1])
    assert 1.2 * alone[0] <= 3.0 <= 2.5 * alone[0]  # of a wall beside 0 the reach, as of one at 0
