"""Guards what measurable disturbances of a piece do to the state: support functions against closed forms and
quadrature, signals that lead where they should."""

from __future__ import annotations

import numpy as np
import pytest
from flint import ctx
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.checker.sets.known import summands_of
from sparserob_core.checker.sets.polynomials import Enclosed
from sparserob_core.control.feedback.zonoid import Arc, KernelPolynomial, Zonoid, _is_nonnegative, _solve_shares
from sparserob_core.control.sets.sets import Box, Polytope
from sparserob_core.sip.convex_set import Array, ConvexSet
from tests.support.undriven import undriven

DOUBLE = np.array([[0.0, 1.0], [0.0, 0.0]])
SPRING = np.array([[0.0, 1.0], [-2.0, -0.5]])
FORCE = np.array([[0.0], [1.0]])
PLANE = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [0, 0, 0, 1.36], [0, 1.39, -1.36, 0]])
TRIANGLE = Polytope([[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]], [0.1, 0.1, 0.3])

CASES: dict[str, tuple[Array, Array, float, ConvexSet]] = {
    "force on a double integrator": (DOUBLE, FORCE, 0.5, Box([-0.1], [0.3])),
    "two channels of a spring": (SPRING, np.eye(2), 0.25, Box([-0.2, -0.3], [0.2, 0.3])),
    "a triangle": (SPRING, np.eye(2), 2.5, TRIANGLE),
    "many oscillations within a piece": (np.array([[0.0, 8.0], [-8.0, -0.5]]), np.eye(2), 2.5, TRIANGLE),
    "four integrators": (np.diag([1.0, 1.0, 1.0], 1), np.eye(4)[:, 3:], 0.3, Box([-0.2], [0.2])),
    "two forces on a motion in a plane": (PLANE, np.eye(4)[:, 2:], 1.0, Box([-1e-5, -1e-5], [1e-5, 1e-5])),
    "one direction of two": (-np.eye(2), np.ones((2, 1)), 1.0, Box([-0.2], [0.2])),
}


def effect(A: Array, E: Array, length: float, ends: Array, values: Array) -> Array:
    """The state after a piece from 0, under a signal that is constant until each share of the piece."""
    state, before, d = np.zeros(A.shape[0]), 0.0, A.shape[0]
    for end, value in zip(ends, values, strict=True):
        flow = expm(np.block([[A, (E @ value)[:, None]], [np.zeros((1, d + 1))]]) * (end - before) * length)
        state, before = flow[:d, :d] @ state + flow[:d, d], end
    return state


def test_the_support_of_a_force_on_a_double_integrator_is_in_closed_form() -> None:
    """``int_0^l |a_1 r + a_2| dr`` with a root at ``-a_2 / a_1`` where that is within the piece."""
    length, found = 0.8, Zonoid.of(KernelPolynomial.of(DOUBLE, FORCE, 0.8), Box([-1.0], [1.0]))
    rng = np.random.default_rng(0)
    for a in rng.normal(size=(50, 2)):
        root = float(np.clip(-a[1] / a[0], 0.0, length))
        parts = [a[0] * (v**2 - u**2) / 2 + a[1] * (v - u) for u, v in ((0.0, root), (root, length))]
        assert found.support(a @ found.outward) == pytest.approx(np.abs(parts).sum(), rel=1e-13)


@pytest.mark.first(3)
@pytest.mark.parametrize("name", CASES)
def test_the_support_function_is_the_integral_of_that_of_the_disturbance(name: str) -> None:
    A, E, length, bound = CASES[name]
    found, count = Zonoid.of(KernelPolynomial.of(A, E, length), bound), 20_000
    step, K = expm(A * length / count), [expm(A * length / count / 2) @ E]
    for _ in range(count - 1):
        K.append(step @ K[-1])
    rows = np.einsum("rd,ndw->nrw", found.into, np.array(K))
    for a in np.random.default_rng(1).normal(size=(5, found.dimension)):
        along = np.einsum("nrw,r->nw", rows, a)
        middles = (bound.support(along) - along @ bound.middle()).sum() * length / count
        assert found.support(a) == pytest.approx(middles, rel=1e-7)


@pytest.mark.parametrize("name", CASES)
def test_the_signal_of_a_direction_attains_the_support_function_and_no_sampled_signal_exceeds_it(name: str) -> None:
    A, E, length, bound = CASES[name]
    found, rng = Zonoid.of(KernelPolynomial.of(A, E, length), bound), np.random.default_rng(2)
    for a in rng.normal(size=(3, found.dimension)):
        best = found.best(a)
        assert (bound.violation(best.values + bound.middle()) <= 1e-12).all()
        point = found.into @ effect(A, E, length, best.ends, best.values)
        assert a @ point == pytest.approx(float(found.support(a)), rel=1e-11)
        np.testing.assert_allclose(point, found.support_point(a), rtol=1e-9, atol=1e-11)
        other = bound.sample_extreme(7, rng) - bound.middle()
        pushed = found.into @ effect(A, E, length, np.arange(1, 8) / 7, other)
        assert a @ pushed <= float(found.support(a)) * (1 + 1e-12)


@pytest.mark.first(2)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "four integrators" else ()) for name in CASES]
)
def test_every_point_of_the_set_has_an_admissible_signal(name: str) -> None:
    A, E, length, bound = CASES[name]
    found, rng = Zonoid.of(KernelPolynomial.of(A, E, length), bound), np.random.default_rng(3)
    extreme = found.support_point(rng.normal(size=(6, found.dimension)))
    points = np.vstack([rng.dirichlet(np.ones(6), 3) @ extreme, np.zeros((1, found.dimension)), extreme[:1]])
    for point, made in zip(points, found.signals(points), strict=True):
        assert (bound.violation(made.values + bound.middle()) <= 1e-12).all()
        reached = found.into @ effect(A, E, length, made.ends, made.values)
        np.testing.assert_allclose(reached, point, atol=1e-11 * np.abs(extreme).max())


@pytest.mark.first(2)
@pytest.mark.parametrize("name", CASES)
def test_a_signal_leads_where_an_exponential_says(name: str) -> None:
    """Signals that jump anywhere, at ends of parts too, not those of the best corners alone."""
    A, E, length, bound = CASES[name]
    found, rng = Zonoid.of(KernelPolynomial.of(A, E, length), bound), np.random.default_rng(6)
    of_parts = 1.0 - found.kernel.ends[1:-1] / length
    for ends in (np.ones(1), np.append(np.sort(rng.uniform(size=7)), 1.0), np.append(of_parts[::-1], 1.0)):
        values = rng.normal(size=(ends.size, E.shape[1]))
        truth = found.into @ effect(A, E, length, ends, values)
        np.testing.assert_allclose(
            found.evaluate_signal(Arc(ends, values)), truth, rtol=1e-12, atol=1e-12 * np.abs(truth).max()
        )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["four integrators", "two forces on a motion in a plane"])
def test_a_signal_does_not_miss_its_point_where_columns_are_the_same_but_for_rounding(name: str, seed: int) -> None:
    """Towards a corner of a round set three of four columns are one point to 1e-9, and a share of theirs is negative:
    without it a signal missed 3e-8."""
    A, E, length, bound = CASES[name]
    found, rng = Zonoid.of(KernelPolynomial.of(A, E, length), bound), np.random.default_rng(seed)
    points = found.support_point(rng.normal(size=(8, 4))) * rng.uniform(size=(8, 1))
    reached = np.array([found.evaluate_signal(one) for one in found.signals(points)])
    assert np.abs(reached - points).max() <= 1e-13


def test_shares_of_columns_that_are_one_point_are_taken_over_by_one_of_them() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 4))
    columns = np.array([a, a + 1e-9 * rng.normal(size=4), b, a + 1e-9 * rng.normal(size=4)])
    for point in (0.7 * a + 0.2 * b, 0.7 * a + 1e-10 * rng.normal(size=4), b, 0.0 * a):
        shares = _solve_shares(columns, point)
        assert (shares >= 0.0).all()
        assert shares @ columns == pytest.approx(point, abs=1e-9)
    assert _solve_shares(np.array([a, 0.0 * a, b, 0.0 * a]), 0.7 * a + 0.2 * b) == pytest.approx([0.7, 0.0, 0.2, 0.0])


def test_a_direction_that_nothing_pushes_is_no_coordinate() -> None:
    found = Zonoid.of(KernelPolynomial.of(-np.eye(2), np.ones((2, 1)), 1.0), Box([-0.2], [0.2]))
    assert found.dimension == 1
    assert Zonoid.of(KernelPolynomial.of(SPRING, np.eye(2), 1.0), Box([0.5, 0.0], [0.5, 0.0])).dimension == 0


def test_a_chord_less_a_parabola_is_the_whole_truth_of_convex_quadratics() -> None:
    """``l, r`` at the ends of ``[-1, 1]`` and ``c u^2`` in between: not negative exactly where
    ``(sqrt l + sqrt r)^2 >= 4 c``, or where the lowest point is outside."""
    rng = np.random.default_rng(3)
    c, low = rng.uniform(0.1, 2.0, size=(2, 400))
    u, share = rng.uniform(-0.9, 0.9, size=400), rng.choice([-1e-6, 1e-6, 0.3, -0.3], size=400)
    lowest = share * low
    left, right = (c * (end - u) ** 2 + lowest for end in (-1.0, 1.0))
    said = _is_nonnegative(left, right, 4.0 * c, 0.0)
    assert (said == (lowest >= 0.0)).all()
    assert not _is_nonnegative(np.array([-1e-9, 1.0]), np.array([1.0, -1e-9]), np.zeros(2), 0.0).any()
    assert _is_nonnegative(np.array([-1e-9]), np.array([1.0]), np.zeros(1), 1e-8).all()
    straight = rng.uniform(0.0, 1.0, size=(2, 50))
    assert _is_nonnegative(*straight, np.zeros(50), 0.0).all()


@pytest.mark.first(3)
@pytest.mark.parametrize("name", CASES)
def test_the_support_function_is_that_of_the_checker_to_all_digits(name: str) -> None:
    """Whose enclosure is another algorithm, in balls: no quadrature is as good."""
    A, E, length, bound = CASES[name]
    found = Zonoid.of(KernelPolynomial.of(A, E, length), bound)
    a = np.random.default_rng(4).normal(size=(40, found.dimension))
    with ctx.workprec(96):
        system = sr.LinearSystem(A, np.zeros((len(A), 1)), E)
        problem = sr.OptimalControlProblem(
            system=system, horizon=length, initial_state=np.zeros(len(A)), control=Box([0.0], [0.0]),
            disturbance=bound, disturbance_class="measurable",
        )  # fmt: skip
        kernel = undriven(problem, [0.0, length]).deviations.kernel(0)
        rows = a @ found.into
        truth = kernel.integrate_support(Enclosed(rows, np.zeros_like(rows)), summands_of(bound))
    sizes = np.abs(found.support(a)).max()
    assert truth.rad.max() < 1e-10 * sizes
    assert found.support(a) == pytest.approx(truth.mid, rel=1e-10, abs=1e-11 * sizes)
    points = found.support_point(a)
    assert np.einsum("kr,kr->k", points, a) == pytest.approx(truth.mid, rel=1e-10, abs=1e-11 * sizes)
    for direction in a[:3]:
        arc = found.best(direction)
        reached = effect(A, E, length, arc.ends, arc.values) @ (direction @ found.into)
        assert reached == pytest.approx(float(found.support(direction)), rel=1e-8)
