"""Guards known answers: convex semi-infinite programs whose values are known in closed form, through the public
call."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.special import roots_jacobi

import sparserob_core as sr
from sparserob_core.sip.solver import Auto

SOLVERS = ["piqp", *(pytest.param(name, marks=pytest.mark.slow) for name in ("proxqp", "clarabel"))]


def family(name, lower, upper, rows):
    return sr.ConstraintFamily(name=name, index_set=sr.Box(lower, upper), rows=rows)


def solved(program, solver):
    return sr.solve(program, method="exchange", solver=solver, maximiser="direct", budget=200, tolerance=1e-7, seed=0)


def apart(result):
    """How far the cost of an answer is from its lower bound: nothing is proven of a family that offers its rows only,
    so there is no upper bound."""
    return (result.cost - result.lower_bound) / max(1.0, abs(result.cost))


def assert_solved(program, solver, truth, accuracy=1e-6):
    """The lower bound and the cost enclose the truth, and meet there. ProxQP may fall short on a badly conditioned
    program, but then it says so."""
    result = solved(program, solver)
    slack = 1e-9 * max(1.0, abs(truth))
    assert result.lower_bound <= truth + slack
    if solver == "proxqp" and not apart(result) <= 1e-6:
        pytest.skip(f"proxqp says {result.status}, with a gap of {apart(result):.1e}")
    assert result.cost >= truth - slack
    assert result.status in {"certified", "verified", "undecided"}, result.message
    assert result.upper_bound == (np.inf if result.status == "undecided" else result.cost)
    assert apart(result) <= 1e-6
    assert abs(result.cost - truth) <= accuracy * max(1.0, abs(truth))
    return result


# One-sided approximation in the mean by polynomials. The dual of the program is a quadrature of f with positive weights
# that is exact
# for degree n - 1 and whose error has one sign: Gauss, Radau or Lobatto (Bojanic and DeVore 1966; Karlin and Studden
# 1966).


def jacobi(nodes, at_left, at_right):
    """The Gauss-type rule on [0, 1] with the given number of nodes that contains 0, 1, both or neither."""
    inner = nodes - at_left - at_right
    points = roots_jacobi(inner, float(at_right), float(at_left))[0] if inner else np.empty(0)
    points = np.concatenate([[-1.0] * at_left, points, [1.0] * at_right])
    moments = [(1 - (-1) ** (k + 1)) / (k + 1) for k in range(nodes)]
    weights = np.linalg.solve(np.vander(points, nodes, increasing=True).T, moments)
    return (points + 1) / 2, weights / 2


def quadrature(n, derivative_sign):
    if derivative_sign > 0:
        return jacobi((n + 1) // 2, False, True) if n % 2 else jacobi(n // 2 + 1, True, True)
    return jacobi((n + 1) // 2, True, False) if n % 2 else jacobi(n // 2, False, False)


def one_sided(n, f, bound=200.0):
    powers = np.arange(n)
    above = family("above", [0.0], [1.0], lambda t: (-(t**powers)[:, np.newaxis], -f(t)))
    return sr.SemiInfiniteProgram(n=n, q=1 / (1.0 + powers), lower=-bound, upper=bound, families=[above])


FUNCTIONS = {
    "tan": (np.tan, +1),
    "exp": (np.exp, +1),
    "1/(2-t)": (lambda t: 1 / (2 - t), +1),
    "-even powers": (lambda t: -(1 + t**2 + t**4 + t**6 + t**8), -1),
    "-exp": (lambda t: -np.exp(t), -1),
    "cosh(2t)+sinh(t)": (lambda t: np.cosh(2 * t) + np.sinh(t), +1),
    "-1/(3-t)": (lambda t: -1 / (3 - t), -1),
}


@pytest.mark.first(6)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("n", [2, 5, *(pytest.param(n, marks=pytest.mark.slow) for n in (3, 4, 6))])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_one_sided_polynomial_approximation_has_the_value_of_its_quadrature(name, n, solver):
    f, sign = FUNCTIONS[name]
    nodes, weights = quadrature(n, sign)
    assert (weights > 0).all()
    np.testing.assert_allclose(weights @ nodes[:, np.newaxis] ** np.arange(n), 1 / (1.0 + np.arange(n)), rtol=1e-13)
    assert_solved(one_sided(n, f), solver, float(weights @ f(nodes)))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("tan", 0.6490420933),
        ("exp", 1.7262797759),
        ("1/(2-t)", 0.7),
        ("-even powers", -1.5765889346),
    ],
)
def test_the_quadratures_reproduce_the_listed_values(name, value):
    f, sign = FUNCTIONS[name]
    nodes, weights = quadrature(3, sign)
    assert abs(weights @ f(nodes) - value) <= 1e-10


@pytest.mark.first(1)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("decay", [0.5, 4.0])
def test_one_sided_approximation_of_an_exponential_of_any_rate(decay, solver):
    nodes, weights = quadrature(5, -1)
    assert_solved(one_sided(5, lambda t: np.exp(-decay * t)), solver, float(weights @ np.exp(-decay * nodes)))


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_watson_8_with_two_index_dimensions(solver):
    def rows(y):
        a, b = y.T
        return (
            -np.stack([np.ones_like(a), a, b, a**2, a * b, b**2], axis=1)[:, np.newaxis],
            -np.exp(a**2 + b**2)[:, np.newaxis],
        )

    program = sr.SemiInfiniteProgram(
        n=6,
        q=np.array([1, 1 / 2, 1 / 2, 1 / 3, 1 / 4, 1 / 3]),
        lower=-100.0,
        upper=100.0,
        families=[family("above", [0.0, 0.0], [1.0, 1.0], rows)],
    )
    assert_solved(program, solver, 2.4356434882)


# Best approximation in the maximum norm: both signs of the error are families of their own.


def best_approximation(f, basis, bound=200.0):
    """Minimise the level of ``|f - sum_i c_i basis_i|`` on [-1, 1]; the decision is the coefficients and the level."""
    n = basis(np.zeros((1, 1))).shape[1] + 1

    def side(sign):
        return lambda t: (np.hstack([-sign * basis(t), -np.ones((len(t), 1))])[:, np.newaxis], -sign * f(t))

    sides = [family(name, [-1.0], [1.0], side(sign)) for name, sign in (("above", 1.0), ("below", -1.0))]
    return sr.SemiInfiniteProgram(n=n, q=np.eye(n)[-1], lower=-bound, upper=bound, families=sides)


def powers(degree):
    return lambda t: t ** np.arange(degree)


@pytest.mark.first(1)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("n", [2, 3, 8, *(pytest.param(n, marks=pytest.mark.slow) for n in (4, 5, 6, 7))])
def test_the_monic_polynomial_of_least_deviation_is_the_one_of_chebyshev(n, solver):
    assert_solved(best_approximation(lambda t: t**n, powers(n)), solver, 2.0 ** (1 - n))


@pytest.mark.first(1)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(("a", "degree"), [(1.5, 2), (2.0, 4), (3.0, 3)])
def test_best_approximation_of_a_simple_pole(a, degree, solver):
    """``E_n(1/(x - a)) = (a - sqrt(a^2 - 1))^n / (a^2 - 1)`` (Chebyshev; Achieser 1956, section 33)."""
    truth = (a - math.sqrt(a * a - 1)) ** degree / (a * a - 1)
    assert_solved(best_approximation(lambda t: 1 / (t - a), powers(degree + 1)), solver, truth)


@pytest.mark.parametrize("solver", SOLVERS)
def test_best_approximation_of_a_kink(solver):
    """The best quadratic to |t| is t^2 + 1/8, by alternation at 0, 1/2, 1 and their mirror images."""
    assert_solved(best_approximation(np.abs, powers(3)), solver, 1 / 8)


# Quadratic costs, curved sets given by their tangents, and robust linear programs.


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_quadratic_cost_over_a_touching_parabola(solver):
    touching = family("below", [0.0], [1.0], lambda t: (np.ones((len(t), 1, 1)), 0.5 + (t - 0.5) ** 2))
    program = sr.SemiInfiniteProgram(
        n=1, P=np.array([[2.0]]), q=np.array([-2.0]), lower=-10.0, upper=10.0, families=[touching]
    )
    result = assert_solved(program, solver, -0.75)  # (x - 1)^2 = x^2 - 2 x + 1: the value 1/4 less the constant
    assert abs(result.decision[0] - 0.5) <= 1e-6


def circle(angles):
    return np.hstack([np.cos(angles), np.sin(angles)])


def ellipse_tangents(half_axes):
    """``x`` in the ellipse with those half-axes: every tangent."""

    def rows(angles):
        return circle(angles)[:, np.newaxis], np.linalg.norm(circle(angles) * half_axes, axis=1, keepdims=True)

    return family("tangents", [0.0], [2 * np.pi], rows)


@pytest.mark.first(3)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("half_axes", [(1.0, 1.0), (2.0, 0.5), (0.3, 3.0)])
@pytest.mark.parametrize("direction", [(1.0, 0.0), (-0.6, 0.8), (1.3, 2.1)])
def test_a_linear_cost_over_an_ellipse_given_by_its_tangents(direction, half_axes, solver):
    program = sr.SemiInfiniteProgram(
        n=2, q=np.array(direction), lower=-10.0, upper=10.0, families=[ellipse_tangents(np.array(half_axes))]
    )
    assert_solved(program, solver, -float(np.linalg.norm(np.multiply(direction, half_axes))))


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_projection_onto_a_disc_given_by_its_tangents(solver):
    point = np.array([1.2, -0.5])
    program = sr.SemiInfiniteProgram(
        n=2, P=np.eye(2), q=-point, lower=-10.0, upper=10.0, families=[ellipse_tangents(np.ones(2))]
    )
    result = assert_solved(program, solver, (math.hypot(*point) - 1) ** 2 / 2 - point @ point / 2)
    np.testing.assert_allclose(result.decision, point / math.hypot(*point), atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_linear_cost_over_a_ball_given_by_its_tangents_in_spherical_coordinates(solver):
    def tangents(a):
        normals = np.stack(
            [np.sin(a[:, 0]) * np.cos(a[:, 1]), np.sin(a[:, 0]) * np.sin(a[:, 1]), np.cos(a[:, 0])], axis=1
        )
        return normals[:, np.newaxis], np.ones((len(a), 1))

    direction = np.array([0.3, -1.1, 0.7])
    program = sr.SemiInfiniteProgram(
        n=3,
        q=direction,
        lower=-10.0,
        upper=10.0,
        families=[family("tangents", [0.0, 0.0], [np.pi, 2 * np.pi], tangents)],
    )
    assert_solved(program, solver, -float(np.linalg.norm(direction)))


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    ("half_angle", "squared_radius"), [(0.7, math.sin(0.7) ** 2), (1.2, math.sin(1.2) ** 2), (2.0, 1.0), (3.1, 1.0)]
)
def test_the_smallest_disc_around_an_arc(half_angle, squared_radius, solver):
    """Minimise ``z + |c|^2``, the squared radius, with ``|p|^2 - 2 p'c <= z`` on the arc: its chord decides until it is
    a half circle."""
    arc = family(
        "covered",
        [-half_angle],
        [half_angle],
        lambda a: (np.hstack([-2 * circle(a), -np.ones((len(a), 1))])[:, np.newaxis], -np.ones((len(a), 1))),
    )
    program = sr.SemiInfiniteProgram(
        n=3, P=np.diag([2.0, 2.0, 0.0]), q=np.array([0.0, 0.0, 1.0]), lower=-10.0, upper=10.0, families=[arc]
    )
    assert_solved(program, solver, squared_radius)


@pytest.mark.first(1)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("radius", [0.1, 0.5, 0.9])
def test_a_linear_program_with_an_uncertain_row_in_a_disc(radius, solver):
    """Maximise ``x1 + x2`` with ``(1 + r cos a) x1 + (1 + r sin a) x2 <= 1``: by symmetry ``2 / (2 + r sqrt 2)``."""
    uncertain = family(
        "uncertain row", [0.0], [2 * np.pi], lambda a: ((1 + radius * circle(a))[:, np.newaxis], np.ones((len(a), 1)))
    )
    program = sr.SemiInfiniteProgram(n=2, q=-np.ones(2), lower=-50.0, upper=50.0, families=[uncertain])
    assert_solved(program, solver, -2 / (2 + radius * math.sqrt(2)))


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_absolute_cost_over_a_parabola_given_by_its_tangents(solver):
    """Minimise ``|x1| + |x2|`` with ``x2 >= (x1 - 2)^2``: at (3/2, 1/4)."""
    tangents = family(
        "above", [-3.0], [3.0], lambda s: (np.hstack([2 * s, -np.ones_like(s)])[:, np.newaxis], s**2 + 4 * s)
    )
    program = sr.SemiInfiniteProgram(n=2, weights=1.0, lower=-10.0, upper=10.0, families=[tangents])
    result = assert_solved(program, solver, 1.75)
    np.testing.assert_allclose(result.decision, [1.5, 0.25], atol=1e-3)


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_absolute_cost_of_an_image_with_an_equality(solver):
    """Minimise ``|x1 - x2| + |x1 + x2|`` on the tangents of the disc around (2, 2) with ``x1 = x2``:
    ``2 (2 - 1/sqrt 2)``."""
    disc = family(
        "tangents",
        [0.0],
        [2 * np.pi],
        lambda a: (circle(a)[:, np.newaxis], 1 + 2 * circle(a).sum(axis=1, keepdims=True)),
    )
    program = sr.SemiInfiniteProgram(
        n=2,
        weights=1.0,
        S=np.array([[1.0, -1.0], [1.0, 1.0]]),
        lower=-20.0,
        upper=20.0,
        A=np.array([[1.0, -1.0]]),
        b=np.zeros(1),
        families=[disc],
    )
    assert_solved(program, solver, 4 - math.sqrt(2))


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_program_whose_families_contradict_each_other_is_infeasible(solver):
    """``x >= t`` and ``x <= 1/2 + t`` on [0, 1] leave nothing between 1 and 1/2."""
    above = family("above", [0.0], [1.0], lambda t: (-np.ones((len(t), 1, 1)), -t))
    below = family("below", [0.0], [1.0], lambda t: (np.ones((len(t), 1, 1)), 0.5 + t))
    result = solved(sr.SemiInfiniteProgram(n=1, q=np.ones(1), lower=-10.0, upper=10.0, families=[above, below]), solver)
    assert result.status == "infeasible", result.message


def test_a_random_search_ends_at_the_same_value():
    result = sr.solve(
        one_sided(3, np.tan), method="exchange", solver="piqp", maximiser="random_search", tolerance=1e-7, seed=0
    )
    assert abs(result.cost - 0.6490420933) <= 1e-7
    assert apart(result) <= 1e-6


# Any convex program: free variables, no Slater point, numbers of any size, programs without a solution.


def half_line(**more):
    """``x >= t`` for t in [0, 1]."""
    above = family("above", [0.0], [1.0], lambda t: (-np.ones((len(t), 1, 1)), -t))
    return sr.SemiInfiniteProgram(n=1, families=[above], **more)


def disc(radius=1.0, units=(1.0, 1.0), **more):
    """The tangents of an ellipse with the half-axes ``radius units``."""
    tangents = family(
        "disc",
        [0.0],
        [2 * np.pi],
        lambda a: ((circle(a) / units)[:, np.newaxis], radius * np.ones((len(a), 1))),
    )
    return sr.SemiInfiniteProgram(n=2, families=[tangents], **more)


def parabola(**more):
    """``x2 >= x1^2`` by its tangents from -3 to 3."""
    tangents = family("above", [-3.0], [3.0], lambda s: (np.hstack([2 * s, -np.ones_like(s)])[:, np.newaxis], s**2))
    return sr.SemiInfiniteProgram(n=2, families=[tangents], **more)


ANSWERED = {
    "a free variable": (half_line(q=[1.0]), 1.0),
    "two free variables": (disc(q=[1.0, 1.0]), -math.sqrt(2)),
    "a free polynomial": (
        sr.SemiInfiniteProgram(
            n=3,
            q=1 / (1.0 + np.arange(3)),
            families=[family("above", [0.0], [1.0], lambda t: (-(t ** np.arange(3))[:, np.newaxis], -np.tan(t)))],
        ),
        0.6490420933,
    ),
    "a relaxed program without a bound": (parabola(q=[0.0, 1.0]), 0.0),
    "a slanted cost without a bound": (parabola(q=[1.0, 1.0]), -0.25),
    "an equality": (half_line(q=[1.0], A=[[1.0]], b=[2.0]), 2.0),
    "no Slater point": (disc(0.0, q=[1.0, 1.0]), 0.0),
    "no Slater point in a box": (disc(0.0, q=[1.0, 1.0], lower=-10.0, upper=10.0), 0.0),
    "variables of 1e12": (disc(1e12, q=[1.0, 1.0], lower=-1e12, upper=1e12), -math.sqrt(2) * 1e12),
    "free variables of 1e12": (disc(1e12, q=[1.0, 1.0]), -math.sqrt(2) * 1e12),
    "variables of two sizes": (
        disc(1.0, (1.0, 1e12), q=[1.0, 1e-12], lower=[-1.0, -1e13], upper=[1.0, 1e13]),
        -math.sqrt(2),
    ),
    "no cost": (half_line(), 0.0),
}


@pytest.mark.first(1)
@pytest.mark.parametrize("name", ANSWERED)
def test_any_convex_program_is_answered(name):
    program, truth = ANSWERED[name]
    result = sr.solve(program)
    slack = 1e-6 * max(1.0, abs(truth))
    assert result.status == "undecided", f"rows alone prove nothing: {result.message}"
    assert result.cost == pytest.approx(truth, abs=slack)
    assert truth - slack <= result.lower_bound <= truth + slack


UNBOUNDED = {
    "a half-line": (half_line(q=[-1.0]), [1.0], "undecided"),
    "no constraint": (sr.SemiInfiniteProgram(n=2, q=[-1.0, 0.0]), [1.0, 0.0], "verified"),
    "along a flat direction of a quadratic cost": (
        parabola(P=[[2.0, 0.0], [0.0, 0.0]], q=[1.0, -1.0]),
        [0.0, 1.0],
        "undecided",
    ),
    "an absolute cost that a linear one outweighs": (
        sr.SemiInfiniteProgram(n=1, weights=1.0, q=[-2.0]),
        [1.0],
        "verified",
    ),
}


@pytest.mark.first(2)
@pytest.mark.parametrize("name", UNBOUNDED)
def test_an_unbounded_program_is_told_with_a_ray(name):
    program, ray, status = UNBOUNDED[name]
    result = sr.solve(program)
    assert result.status == status, result.message
    assert result.message.startswith("unbounded below: along the ray")
    assert (result.lower_bound, result.gap) == (-np.inf, np.inf)
    assert result.ray == pytest.approx(ray, abs=1e-9)
    costs = [program.cost(result.decision + length * result.ray) for length in (0.0, 1.0, 1e3, 1e6)]
    assert (np.diff(costs) < 0).all()
    indices = np.linspace(0.0, 1.0, 50)[:, np.newaxis]
    for one in program.families:
        assert (one.violations(result.decision + 1e6 * result.ray, indices) <= 1e-6).all()


INFEASIBLE = {
    "a bound": half_line(q=[1.0], upper=0.5),
    "a bound and a box": half_line(q=[1.0], lower=-10.0, upper=0.5),
    "a row": half_line(q=[1.0], G=[[1.0]], h=[0.5]),
    "an equality": half_line(q=[1.0], A=[[1.0]], b=[0.5]),
    "no cost": half_line(upper=0.5),
    "a cost that would fall for ever": half_line(q=[-1.0], A=[[0.0]], b=[1.0]),
}


@pytest.mark.first(2)
@pytest.mark.parametrize("name", INFEASIBLE)
def test_a_program_that_leaves_nothing_is_infeasible_whatever_else_is_free(name):
    result = sr.solve(INFEASIBLE[name])
    assert result.status == "infeasible", result.message
    assert result.decision is None
    assert result.message


@pytest.mark.parametrize("more", [{}, {"lower": -10.0, "upper": 10.0}, {"P": [[1e-3]]}, {"A": [[0.0]], "b": [0.0]}])
def test_a_right_hand_side_of_infinity_asks_for_nothing(more):
    result = sr.solve(sr.SemiInfiniteProgram(n=1, q=[-1.0], G=[[1.0], [1.0], [-1.0]], h=[1.0, np.inf, np.inf], **more))
    finite = sr.solve(sr.SemiInfiniteProgram(n=1, q=[-1.0], G=[[1.0]], h=[1.0], **more))
    assert result.status == finite.status == "certified"
    assert abs(result.cost - finite.cost) <= 1e-10
    assert result.dual.fixed[1:].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("sides", "said"),
    [
        ({"G": [[1.0]], "h": [-np.inf]}, r"h: expected numbers, or inf for a row that asks for nothing, got \[-inf\]"),
        ({"G": [[1.0]], "h": [np.nan]}, "h: expected numbers, got NaN"),
        ({"A": [[1.0]], "b": [np.inf]}, r"b: expected finite numbers, got \[inf\]"),
    ],
)
def test_a_right_hand_side_that_nothing_meets_is_refused_by_name(sides, said):
    with pytest.raises(sr.InputError, match=said):
        sr.SemiInfiniteProgram(n=1, q=[-1.0], **sides)


def test_a_failure_says_once_what_is_wrong_and_what_to_do():
    class Silent(sr.Solver):
        def solve(self, program, accuracy):
            n, r, e = program.q.size, program.h.size, program.b.size
            return sr.Claim("failed", np.zeros(n), np.zeros(r), np.zeros(e), np.zeros(n), "nothing found")

    image = {"S": [[1.0, 1.0], [1.0, -1.0], [1.0, 0.0]], "weights": 1.0, "lower": -2.0, "upper": 2.0}
    result = sr.solve(disc(0.5, q=[-3.0, 1.0], **image), solver=Auto(general=Silent()))  # whom nobody stands in for
    assert result.status == "failed"
    assert "try another solver" in result.message
    parts = result.message.split("; ")
    assert len(parts) == len(set(parts)) <= 3


@pytest.mark.first(1)
@pytest.mark.parametrize("seed", range(12))
def test_programs_in_numbers_up_to_1e12_have_the_answer_of_a_linear_program_on_a_grid(seed):
    """Variables, rows and prices each in a unit of their own; what lies between the indices of a fine grid is below
    the slack."""
    rng = np.random.default_rng([seed, 77])
    n, units, price = int(rng.integers(1, 5)), 10.0 ** rng.uniform(0, 12, 4), 10.0 ** rng.uniform(0, 12)
    C, c, size = rng.normal(size=(n, 3)), rng.normal(size=3), 10.0 ** rng.uniform(0, 12)
    weights, q, reach = rng.uniform(0, 1, n) * (seed % 3 > 0), rng.normal(size=n), rng.uniform(0.5, 5, n)
    units = units[:n]

    def sides(s):
        basis = np.stack([np.ones_like(s), np.cos(2 * s), np.sin(3 * s)], axis=-1)
        return basis @ C.T, basis @ c

    def rows(index):
        G, h = sides(index[:, 0])
        return size * (G / units)[:, np.newaxis], size * h[:, np.newaxis]

    G, h = sides(np.linspace(0.0, 1.0, 4001))
    eye, none = np.eye(n), np.zeros(n)
    table = np.vstack([np.hstack([G, 0.0 * G]), np.hstack([eye, -eye]), np.hstack([-eye, -eye])])
    bounds = [*((-r, r) for r in reach), *[(0, None)] * n]
    truth = linprog(np.concatenate([q, weights]), table, np.concatenate([h, none, none]), bounds=bounds)
    result = sr.solve(
        sr.SemiInfiniteProgram(
            n=n,
            weights=price * weights / units,
            q=price * q / units,
            lower=-reach * units,
            upper=reach * units,
            families=[family("walls", [0.0], [1.0], rows)],
        )
    )
    if truth.status == 2:
        assert result.status == "infeasible", result.message
        return
    slack = 2e-6 * max(1.0, abs(truth.fun))
    assert result.status == "undecided", result.message
    assert abs(result.cost / price - truth.fun) <= slack
    assert truth.fun - slack <= result.lower_bound / price <= truth.fun + slack
