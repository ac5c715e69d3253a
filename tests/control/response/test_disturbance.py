"""Guards control/response/disturbance: disturbance classes: the support against linear programs over their vertices,
and the disturbances that attain it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from sparserob_core.control.enclosures.polynomial import face_of
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.reach.disturbance_support import summed
from sparserob_core.control.response.disturbance import disturbance_model
from sparserob_core.control.response.time_grid import merge_grids
from sparserob_core.control.sets.sets import Ellipsoid, NormBall, Polytope
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Box
from sparserob_core.sip.expressions.taylor import TaylorSpace, combination
from tests.support.plants import indicators, random_system, uniform, walsh, weight_on_piece, worst_case

HORIZON = 2.0
TRIANGLE = Polytope([[1.0, 1.0], [-1.0, 0.2], [0.0, -1.0]], [0.3, 0.2, 0.1])
BOUNDS = {
    "box": Box([-0.1, 0.05], [0.3, 0.2]),
    "triangle": TRIANGLE,
    "1-norm": NormBall(p=1.0, radius=0.3, centre=[0.1, 0.0]),
    "point": Box([0.1, -0.2], [0.1, -0.2]),
    "one channel": Box([-0.1, 0.0], [0.2, 0.0]),
}
COARSE = indicators([0.0, 0.3, 1.4, HORIZON])


def model_of(kind, bound, dictionary, control=None):
    return disturbance_model(
        kind, bound, dictionary, merge_grids((control or uniform(4, HORIZON)).breakpoints, dictionary.breakpoints)
    )


def by_linear_program(bound, dictionary, weights_on_pieces):
    """``max sum_k y_k' (Beta phi_k)`` over coefficients with ``Beta phi_k`` in a flat ``bound`` on every piece ``k``;
    ``weights (K, mw)``."""
    H, h = bound.halfspaces()
    mw, functions = H.shape[1], dictionary.functions
    rows = np.vstack([np.kron(H, dictionary.values[:, k]) for k in range(dictionary.pieces)])
    cost = np.einsum("ki,jk->ij", weights_on_pieces, dictionary.values).ravel()
    answer = linprog(
        -cost, rows, np.tile(h, dictionary.pieces), bounds=[(None, None)] * (mw * functions), method="highs"
    )
    assert answer.status == 0
    return -answer.fun


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    name=st.sampled_from(sorted(BOUNDS)),
    shape=st.sampled_from(["uniform", "coarse", "walsh", "two walsh", "joined", "dense", "incomplete"]),
)
def test_the_support_is_that_of_a_linear_program_over_all_coefficients(seed, name, shape):
    # a span that may hold no constant holds no such disturbance
    assume(name != "point" or shape not in ("two walsh", "incomplete"))
    rng = np.random.default_rng(seed)
    bound = BOUNDS[name]
    dictionary = {
        "uniform": uniform(3, HORIZON),
        "coarse": COARSE,
        "walsh": walsh(4, HORIZON),
        "two walsh": walsh(4, HORIZON, 2),
        "joined": Dictionary(np.linspace(0, HORIZON, 5), np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 2.0, 2.0]])),
        "dense": Dictionary(np.linspace(0, HORIZON, 3), np.array([[1.0, -3.0], [0.5, 1.0]])),
        "incomplete": Dictionary(np.linspace(0, HORIZON, 4), np.array([[1.0, 0.5, 2.0], [0.0, 1.0, -1.0]])),
    }[shape]
    system, time = random_system(rng), rng.uniform(0.2, HORIZON)
    functionals = worst_case(system, COARSE, dictionary, bound)
    direction = rng.normal(size=2)
    A, _, E = (matrix[0] for matrix in system.phases[0].matrices(np.zeros((1, 0))))
    ends = dictionary.breakpoints
    weights = np.array([weight_on_piece(A, E, direction, time, a, b) for a, b in itertools.pairwise(ends)])
    truth = by_linear_program(bound, dictionary, weights)
    found = functionals.offsets(np.array([time]), direction[None], np.zeros((1, 0)))[0]
    assert abs(found - truth) <= 1e-9 * max(1.0, abs(truth))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    kind=st.sampled_from(["box", "triangle", "1-norm", "ellipsoid", "2-norm", "3-norm", "l1_ball", "incomplete"]),
)
def test_the_worst_disturbance_attains_the_support_and_is_admissible(seed, kind):
    rng = np.random.default_rng(seed)
    curved = {
        "ellipsoid": Ellipsoid([0.1, 0.0], [[0.04, 0.01], [0.01, 0.09]]),
        "2-norm": NormBall(p=2.0, radius=0.3, centre=[0.0, 0.2]),
        "3-norm": NormBall(p=3.0, radius=0.3, dimension=2),
    }
    bound = curved.get(kind, BOUNDS.get(kind, Box([-0.2, -0.3], [0.2, 0.3])))
    dictionary = walsh(4, HORIZON, 3) if kind in ("l1_ball", "incomplete") else COARSE
    model = model_of("l1_ball" if kind == "l1_ball" else "piecewise_constant", bound, dictionary)
    weights = rng.normal(size=(5, 3, model.grid.pieces, 2)) * rng.integers(0, 2, size=(5, 3, 1, 2))
    signal = model.worst(weights)
    assert signal.shape == (5, 3, 2, model.grid.pieces)
    assert np.allclose(np.einsum("...li,...il->...", weights, signal), model.support(weights), rtol=1e-10, atol=1e-11)
    assert bound.contains(np.swapaxes(signal, -1, -2), 1e-9).all()
    for other in np.einsum(
        "kij,jl->kil",
        0.1 * rng.normal(size=(20, 2, dictionary.functions)),
        dictionary.values[:, model.grid.disturbance_piece],
    ):
        if kind != "l1_ball" and bound.contains(other.T, 0.0).all():
            assert (np.einsum("...li,il->...", weights, other) <= model.support(weights) + 1e-9).all()


@pytest.mark.parametrize("kind", ["l1_ball", "piecewise_constant", "measurable"])
def test_no_disturbance_is_longer_than_its_radius_and_some_are_nearly_as_long(kind):
    rng, bound = np.random.default_rng(5), Box([-0.2, -0.3], [0.2, 0.3])
    uneven = Dictionary(np.linspace(0.0, HORIZON, 4), np.array([[1.0, 0.0, 0.5], [0.0, 3.0, -0.25]]))
    model = model_of(kind, bound, uneven if kind == "l1_ball" else COARSE)
    signal = model.worst(rng.normal(size=(200, model.grid.pieces, 2)))
    longest = np.linalg.norm(signal, axis=1).max()
    assert 0.99 * model.radius <= longest <= model.radius * (1 + 1e-12)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), functions=st.integers(1, 4))
def test_the_l1_ball_is_attained_at_one_of_its_vertices(seed, functions):
    rng = np.random.default_rng(seed)
    dictionary, half = walsh(4, HORIZON, functions), rng.uniform(0, 1, 2)
    system, time, direction = random_system(rng), rng.uniform(0.1, HORIZON), rng.normal(size=2)
    functionals = worst_case(system, COARSE, dictionary, Box(-half, half), kind="l1_ball")
    A, _, E = (matrix[0] for matrix in system.phases[0].matrices(np.zeros((1, 0))))
    ends = dictionary.breakpoints
    weights = np.array([weight_on_piece(A, E, direction, time, a, b) for a, b in itertools.pairwise(ends)])
    truth = sum(half[i] * np.abs(dictionary.values @ weights[:, i]).max() for i in range(2))
    assert abs(functionals.offsets(np.array([time]), direction[None], np.zeros((1, 0)))[0] - truth) <= 1e-10 * max(
        1.0, truth
    )


def test_complete_dictionaries_describe_the_same_disturbances_whatever_their_functions():
    rng = np.random.default_rng(5)
    system = random_system(rng)
    others = [walsh(4, HORIZON), uniform(4, HORIZON), Dictionary(np.linspace(0, HORIZON, 5), rng.normal(size=(4, 4)))]
    times, directions = rng.uniform(0, HORIZON, 6), rng.normal(size=(6, 2))
    found = [
        worst_case(system, COARSE, other, TRIANGLE).offsets(times, directions, np.zeros((6, 0))) for other in others
    ]
    assert np.allclose(found, found[0], rtol=1e-12, atol=1e-13)


def test_finer_pieces_never_help_the_control():
    rng = np.random.default_rng(6)
    system = random_system(rng, speed=3.0)
    times, directions = rng.uniform(0, HORIZON, 20), rng.normal(size=(20, 2))
    sigmas = [
        worst_case(system, COARSE, uniform(3 * 2**k, HORIZON), BOUNDS["box"]).offsets(
            times, directions, np.zeros((20, 0))
        )
        for k in range(6)
    ]
    for coarser, finer in itertools.pairwise(sigmas):
        assert (finer >= coarser - 1e-12).all()


def test_an_l1_ball_of_an_asymmetric_box_is_refused():
    with pytest.raises(InputError, match="symmetric"):
        model_of("l1_ball", Box([-0.1, -0.1], [0.1, 0.2]), COARSE)


def test_fewer_functions_than_pieces_need_a_flat_set():
    with pytest.raises(InputError, match="flat sides"):
        model_of("piecewise_constant", NormBall(p=2.0, radius=1.0, dimension=2), walsh(4, HORIZON, 3))


@pytest.mark.parametrize("ends", [None, [0.0, 1.0, 0.0, 0.0], [-1.0, 1.0, 0.0, -1.0], [1.0, 1.0, -1.0, 1.0]])
@pytest.mark.parametrize("name", ["box", "triangle", "one channel"])
def test_coefficients_that_are_0_are_left_out_and_change_nothing(name, ends):
    """Of functionals in two uncertain directions beside two parameters, on a face or not."""
    rng, space = np.random.default_rng(5), TaylorSpace(2, 2)
    larger = combination(space, 2)
    blocks = rng.normal(size=(3, 3, space.size, 4, 2)) * 0.3 ** space.degrees[:, None, None]
    face = None if ends is None else face_of(larger.space, np.array(ends))
    dense = larger.apply(blocks)
    whole = summed(BOUNDS[name], dense, face)
    few = summed(BOUNDS[name], blocks.reshape(3, 1, -1, 4, 2), face, larger.targets.reshape(-1), larger.space.size)
    np.testing.assert_allclose(few, whole, rtol=1e-13, atol=1e-13)
    onto = dense if face is None else np.einsum("ab,krbnq->kranq", face.matrix.toarray(), dense)
    s = rng.uniform(-1.0, 1.0, (50, 4))
    s = s if ends is None else np.where(np.array(ends) != 0.0, ends, s)
    powers = np.prod(s[:, None] ** larger.space.exponents, axis=2)
    height = BOUNDS[name].support(np.einsum("sa,kranq->skrnq", powers, onto))
    model = np.einsum("sa,krna->skrn", powers, few[..., :-1]) + few[..., -1]
    assert (height <= model + 1e-12).all(), "the model is not above the support function on the cell"
