"""Guards sip/proof/branch_and_bound: the proof over the continuum: what it proves holds, what is violated is refuted,
and nothing ends in silence."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

import sparserob_core as sr
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.sip.convex_set import Box
from sparserob_core.sip.evidence import Proof
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.method import Tools
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.program import ConstraintFamily, Enclosure
from sparserob_core.sip.proof.branch_and_bound import prove_family
from tests.support.plants import indicators, random_system, uniform, worst_case

HORIZON = 3.0
GRIDS = {"uniform": uniform(12, HORIZON), "uneven": indicators([0.0, 0.4, 0.5, 1.0, 1.6, 2.2, HORIZON])}
DISTURBANCE = Box([-0.1, -0.3], [0.2, 0.1])


def family_of(constraint):
    return ConstraintFamily(
        name=constraint.name,
        index_set=constraint.index_set,
        rows=constraint.rows,
        worst=constraint.worst,
        enclosure=constraint.enclosure,
        cells=constraint.cells,
        explain=constraint.explain,
    )


def raised(constraint, amount):
    """The same constraint with its right-hand side raised."""
    return replace(constraint, h=constraint.h + amount)


def dense_maximum(constraint, x, per_piece=400):
    """The largest violation of a known system on a fine grid that contains the breakpoints."""
    breaks = constraint.functionals.response.grid.breakpoints
    times = np.unique(np.concatenate([np.linspace(a, b, per_piece) for a, b in itertools.pairwise(breaks)]))
    G, rhs = constraint.rows(times[(times >= constraint.start) & (times <= constraint.stop)][:, None])
    return (G @ x - rhs).max()


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 10**6), grid=st.sampled_from(sorted(GRIDS)), disturbed=st.booleans())
def test_a_violated_decision_is_never_proven_and_a_safe_one_is(seed, grid, disturbed):
    """The right-hand sides are set to what a fine grid sees, less or more a little: the grid is below the truth by
    about 1e-6."""
    rng = np.random.default_rng(seed)
    functionals = worst_case(
        random_system(rng), GRIDS[grid], bound=DISTURBANCE if disturbed else None, initial_state=rng.normal(size=2)
    )
    constraint = FlatConstraint(
        "path", functionals, rng.normal(size=(1, 2)), np.zeros(1), 0.0, HORIZON, ParameterIndex(None)
    )
    x = rng.normal(size=functionals.variables)
    top = dense_maximum(constraint, x)
    violated = prove_family(family_of(raised(constraint, top - 1e-7)), x)
    assert violated.verdict == "refuted"
    assert violated.violation > 1e-9
    proof = prove_family(family_of(raised(constraint, top + 1e-4)), x)
    assert proof.verdict == "proven"
    assert proof.bound <= 1e-9


def peak():
    """``x(t) = sin t`` with its peak strictly inside a piece: ``|x| <= 1`` exactly."""
    return worst_case(LinearSystem([[0, 1], [-1, 0]], [[0.0], [1.0]]), uniform(2, HORIZON), initial_state=[0.0, 1.0])


@pytest.mark.parametrize("slack", [-1e-3, -1e-7, -2e-9, 1e-7, 1e-3])
def test_a_peak_between_the_nodes_decides(slack):
    constraint = FlatConstraint(
        "path", peak(), np.array([[1.0, 0.0]]), np.array([1 + slack]), 0.0, HORIZON, ParameterIndex(None)
    )
    proof = prove_family(family_of(constraint), np.zeros(2))
    assert proof.verdict == ("proven" if slack > 0 else "refuted")
    if slack < 0:
        assert 1e-9 < proof.violation <= -slack + 1e-12
        assert abs(proof.index[0] - np.pi / 2) <= np.sqrt(-2 * slack) + 1e-9


@pytest.mark.parametrize("slack", [0.0, 1e-9, 1e-7])
@pytest.mark.parametrize("offset", [0.0, 0.02, -0.02])
def test_a_peak_that_nearly_touches_is_proven_in_few_batches_however_it_lies_in_its_piece(slack, offset):
    """Halving takes one batch for every bit of the width that the slack asks for: about fifteen."""
    constraint = FlatConstraint(
        "path", peak(), np.array([[1.0, 0.0]]), np.array([1 + slack]), offset + 0.05, HORIZON, ParameterIndex(None)
    )
    family, sizes = family_of(constraint), []

    def counted(x, lower, upper):
        sizes.append(lower.shape[0])
        return constraint.enclosure(x, lower, upper)

    proof = prove_family(replace(family, enclosure=counted), np.zeros(2))
    assert proof.verdict == "proven"
    assert len(sizes) <= 3
    assert sum(sizes) <= 120
    lower, upper = proof.leaves
    assert np.array_equal(lower[1:], upper[:-1])
    assert [lower[0, 0], upper[-1, 0]] == [offset + 0.05, HORIZON]
    assert (constraint.enclosure(np.zeros(2), lower, upper).bounds <= 1e-9).all()


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6), slack=st.sampled_from([1e-9, 1e-8, 1e-6]))
def test_cells_cut_towards_peaks_prove_what_halves_prove(seed, slack):
    """Under a disturbance, whose support function has kinks; the right-hand side is just above the largest violation
    that separation finds."""
    rng = np.random.default_rng(seed)
    functionals = worst_case(random_system(rng), GRIDS["uniform"], bound=DISTURBANCE, initial_state=rng.normal(size=2))
    x = rng.normal(size=functionals.variables)
    constraint = FlatConstraint(
        "path", functionals, rng.normal(size=(2, 2)), np.zeros(2), 0.3, HORIZON, ParameterIndex(None)
    )
    tight = raised(constraint, float(constraint.worst(x).violations[0]) + slack)
    found = prove_family(family_of(tight), x)
    halved = prove_family(replace(family_of(tight), worst=None), x)
    assert found.verdict == halved.verdict == "proven"
    assert found.violation >= halved.violation
    assert found.cells <= 2 * halved.cells


def oscillator(p):
    return np.array([[0 * p[0], 1 + 0 * p[0]], [-(p[0] ** 2), 0 * p[0]]])


@pytest.mark.first(7)
@pytest.mark.parametrize("slack", [-1e-3, -1e-6, 1e-3, 1e-6])
@pytest.mark.parametrize("window", ["terminal", "path"])
def test_a_worst_parameter_inside_the_box_decides(slack, window):
    """A free oscillator from (1, 0): ``x(T) = cos(omega T)``, at most 1 and equal to it at omega = 1, inside the
    box."""
    horizon = 2 * np.pi
    system = LinearSystem(oscillator, [[0.0], [1.0]], parameters=Box([0.93], [1.1]))
    functionals = worst_case(system, uniform(20, horizon), initial_state=[1.0, 0.0])
    start = horizon if window == "terminal" else 5.0
    constraint = FlatConstraint(
        "path",
        functionals,
        np.array([[1.0, 0.0]]),
        np.array([1 + slack]),
        start,
        horizon,
        ParameterIndex(system.parameters),
    )
    proof = prove_family(family_of(constraint), np.zeros(20))
    assert proof.verdict == ("proven" if slack > 0 else "refuted")


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 10**6), nu=st.sampled_from([1, 2]), disturbed=st.booleans())
def test_nothing_is_proven_that_a_sampled_parameter_violates(seed, nu, disturbed):
    rng = np.random.default_rng(seed)
    A, E = rng.normal(size=(nu + 1, 2, 2)), rng.normal(size=(nu + 1, 2, 2))
    system = LinearSystem(
        lambda p: A[0] + 0.3 * sum(p[i] * A[i + 1] for i in range(nu)),
        np.ones((2, 1)),
        lambda p: E[0] + 0.3 * sum(np.cos(p[i]) * E[i + 1] for i in range(nu)),
        parameters=Box([-1.0] * nu, [1.0] * nu),
    )
    functionals = worst_case(
        system, uniform(6, 1.5), bound=DISTURBANCE if disturbed else None, initial_state=rng.normal(size=2)
    )
    constraint = FlatConstraint(
        "end", functionals, rng.normal(size=(1, 2)), np.zeros(1), 1.2, 1.5, ParameterIndex(system.parameters)
    )
    x = rng.normal(size=6)
    indices = np.hstack([rng.uniform(1.2, 1.5, (1500, 1)), rng.uniform(-1, 1, (1500, nu))])
    indices[:1000, 1:] = np.where(rng.uniform(size=(1000, nu)) < 0.5, np.sign(indices[:1000, 1:]), indices[:1000, 1:])
    indices[:400, 0] = rng.choice([1.2, 1.25, 1.5], 400)
    G, rhs = constraint.rows(indices)
    top = (G @ x - rhs).max()
    assert prove_family(family_of(raised(constraint, top - 1e-6)), x, cells=3000).verdict in ("refuted", "undecided")
    assert (
        prove_family(family_of(raised(constraint, top + 0.3 * max(1.0, abs(top)))), x, cells=20_000).verdict == "proven"
    )


def test_a_stiff_system_that_is_violated_at_one_end_of_its_window_is_not_proven():
    """Violated by a millionth at the very end only, where no probe of a middle sees it at first; the fast mode has 30
    time constants per piece."""
    rng = np.random.default_rng(0)
    system = LinearSystem([[-30.0, 1.0], [0.0, -0.3]], [[1.0], [1.0]])
    proven = 0
    for _ in range(25):
        functionals = worst_case(system, uniform(3, HORIZON), initial_state=rng.normal(size=2))
        constraint = FlatConstraint(
            "end", functionals, rng.normal(size=(1, 2)), np.zeros(1), 2.05, HORIZON, ParameterIndex(None)
        )
        x = rng.normal(size=3)
        top = dense_maximum(constraint, x)
        violated = raised(constraint, top - 1e-6 * max(1.0, abs(top)))
        proven += prove_family(family_of(violated), x, cells=3000).verdict == "proven"
    assert proven == 0


@pytest.mark.parametrize("rate", [-60.0, -100.0])
@pytest.mark.parametrize("disturbed", [False, True])
def test_a_stiff_system_with_ample_slack_is_proven(rate, disturbed):
    system = LinearSystem([[rate, 1.0], [0.0, -0.3]], [[1.0], [1.0]])
    functionals = worst_case(
        system, uniform(3, HORIZON), bound=DISTURBANCE if disturbed else None, initial_state=[1.0, -1.0]
    )
    constraint = FlatConstraint(
        "path", functionals, np.array([[1.0, 0.5]]), np.zeros(1), 0.0, HORIZON, ParameterIndex(None)
    )
    x = np.array([0.5, -0.5, 1.0])
    with np.errstate(all="ignore"):
        assert (
            prove_family(family_of(raised(constraint, dense_maximum(constraint, x) + 0.5)), x, cells=20_000).verdict
            == "proven"
        )


def polynomial_family(bound_of, top):
    """``4 t (1 - t) <= top`` for t in [0, 1], with an enclosure made from ``bound_of(lower, upper)``."""

    def enclosure(x, lower, upper):
        return Enclosure(bound_of(lower[:, 0], upper[:, 0]) - top, np.zeros(lower.shape[0], dtype=int))

    return ConstraintFamily(
        name="hill",
        index_set=Box([0.0], [1.0]),
        enclosure=enclosure,
        rows=lambda t: (np.zeros((t.shape[0], 1, 1)), top - 4 * t * (1 - t)),
    )


def test_cells_that_differ_in_time_only_are_bounded_together_under_a_limit_and_prove_the_same():
    """Batches are small there, and what such cells share is done once a batch."""
    nodes = np.linspace(0.0, 1.0, 41)
    begin, beside = (one.ravel() for one in np.meshgrid(nodes[:-1], [0.0, 1.0, 2.0], indexing="ij"))
    cells = np.stack([begin, beside], axis=1), np.stack([begin + 1 / 40, beside + 1.0], axis=1)
    asked = []

    def enclosure(x, lower, upper):
        asked.append(lower)
        return Enclosure(upper[:, 0] * upper[:, 1] - x[0], np.zeros(len(lower), dtype=int))

    def rows(at):
        return -np.ones((len(at), 1, 1)), -at.prod(axis=1, keepdims=True)

    family = sr.ConstraintFamily(
        name="shared", index_set=sr.Box([0.0, 0.0], [1.0, 3.0]), rows=rows, enclosure=enclosure, cells=cells
    )
    proofs = [prove_family(family, np.array([3.01]), deadline=Deadline(seconds)) for seconds in (None, 600.0)]
    assert [np.unique(one[:, 1]).tolist() for one in asked[1:]] == [[0.0], [1.0], [2.0]]
    for one, other in zip(proofs[0].leaves, proofs[1].leaves, strict=True):
        np.testing.assert_array_equal(one, other)


def test_an_enclosure_that_returns_nan_proves_nothing():
    """The violation is where no probe of the middle sees it."""
    family = replace(
        polynomial_family(lambda a, b: np.full(a.size, np.nan), 0.5),
        rows=lambda t: (np.zeros((t.shape[0], 1, 1)), 0.5 - (np.abs(t - 0.3) < 1e-3)),
    )
    assert prove_family(family, np.zeros(1), cells=1000).verdict != "proven"


def test_an_enclosure_that_never_tightens_ends_undecided_within_its_cells():
    proof = prove_family(polynomial_family(lambda a, b: np.full(a.size, 2.0), 1.5), np.zeros(1), cells=1000)
    assert proof.verdict == "undecided"
    assert proof.cells <= 1000
    assert proof.reason


@pytest.mark.parametrize(
    ("top", "verdict"), [(1.0, "proven"), (1 + 1e-8, "proven"), (1 - 1e-8, "refuted"), (0.3, "refuted")]
)
def test_a_convergent_enclosure_decides(top, verdict):
    """The mean-value bound: value at the middle plus the steepest slope times half the width, plus the curvature where
    it is flat."""

    def bound(a, b):
        middle = (a + b) / 2
        return 4 * middle * (1 - middle) + np.abs(4 - 8 * middle) * (b - a) / 2

    proof = prove_family(polynomial_family(bound, top), np.zeros(1))
    assert proof.verdict == verdict
    if verdict == "refuted":
        assert proof.index[0] == pytest.approx(0.5, abs=0.5)


def test_a_family_without_enclosure_or_separation_is_undecided():
    family = ConstraintFamily(
        name="bare", index_set=Box([0.0], [1.0]), rows=lambda t: (np.zeros((t.shape[0], 1, 1)), 1.0 - t)
    )
    proof = prove_family(family, np.zeros(1))
    assert proof.verdict == "undecided"
    assert "bare" in proof.reason


def test_a_function_that_branches_on_its_parameter_is_undecided_and_says_so():
    system = LinearSystem(lambda p: np.array([[-1.0 if p[0] > 0 else -2.0]]), [[1.0]], parameters=Box([-1.0], [1.0]))
    functionals = worst_case(system, uniform(3, 1.0), initial_state=[1.0])
    constraint = FlatConstraint(
        "path", functionals, np.array([[1.0]]), np.array([2.0]), 0.0, 1.0, ParameterIndex(system.parameters)
    )
    proof = prove_family(family_of(constraint), np.zeros(3))
    assert proof.verdict == "undecided"
    assert "branch" in proof.reason


def test_a_function_that_is_enclosable_on_small_cells_only_is_proven_there():
    """The denominator is at least 0.1 on the box, but its crude enclosure over the whole box has a root."""
    system = LinearSystem(
        lambda p: np.array([[-1 / (0.05 + p[0] ** 2 - p[0] + 0.3)]]), [[1.0]], parameters=Box([0.0], [1.0])
    )
    assert min(0.05 + p * p - p + 0.3 for p in np.linspace(0, 1, 1001)) > 0.09
    functionals = worst_case(system, uniform(3, 1.0), initial_state=[1.0])
    constraint = FlatConstraint(
        "path", functionals, np.array([[1.0]]), np.array([1.5]), 0.0, 1.0, ParameterIndex(system.parameters)
    )
    assert prove_family(family_of(constraint), np.zeros(3)).verdict == "proven"


def test_a_decision_that_touches_the_boundary_is_proven_or_refuted_or_undecided_quickly():
    """``x(0)`` on the boundary, moving inwards, and touching it again tangentially."""
    constraint = FlatConstraint(
        "path", peak(), np.array([[1.0, 0.0]]), np.array([1.0]), 0.0, HORIZON, ParameterIndex(None)
    )
    assert prove_family(family_of(constraint), np.zeros(2)).verdict == "proven"
    inwards = worst_case(LinearSystem([[0.0]], [[1.0]]), uniform(4, 1.0), initial_state=[1.0])
    constraint = FlatConstraint("path", inwards, np.array([[1.0]]), np.array([1.0]), 0.0, 1.0, ParameterIndex(None))
    assert prove_family(family_of(constraint), -np.ones(4)).verdict == "proven"
    assert prove_family(family_of(constraint), np.zeros(4)).verdict == "proven"
    assert prove_family(family_of(constraint), np.full(4, 1e-6)).verdict == "refuted"


def test_the_peak_of_a_long_smooth_piece_is_bounded_within_the_tolerance():
    """The peak of a damped oscillation, found by its derivative."""
    functionals = worst_case(
        LinearSystem([[0, 1], [-9.0, -0.4]], [[0.0], [1.0]]), uniform(1, HORIZON), initial_state=[0.0, 1.0]
    )
    constraint = FlatConstraint(
        "path", functionals, np.array([[1.0, 0.0]]), np.zeros(1), 0.0, HORIZON, ParameterIndex(None)
    )
    slope = FlatConstraint(
        "slope", functionals, np.array([[0.0, 1.0]]), np.zeros(1), 0.0, HORIZON, ParameterIndex(None)
    )

    def at(which, time):
        G, rhs = which.rows(np.array([[time]]))
        return float(G[0, 0] @ np.zeros(1) - rhs[0, 0])

    top = at(constraint, brentq(lambda t: at(slope, t), 0.3, 0.8, xtol=1e-14))
    assert prove_family(family_of(raised(constraint, top + 1e-8)), np.zeros(1)).verdict == "proven"
    assert prove_family(family_of(raised(constraint, top - 1e-8)), np.zeros(1)).verdict == "refuted"


def test_a_curved_set_under_a_parameter_and_a_disturbance_is_proven_with_few_cells():
    """What the disturbance's flips cost comes from the direction: halving the parameter, which sits at its end, gains
    nothing."""

    def affine(first, second):
        return lambda p: np.array(first) + 0.05 * np.sin(p[0]) * np.array(second)

    system = sr.LinearSystem(
        affine([[-0.3, 0.19], [-0.1, -0.06]], [[0.4, -0.22], [-0.43, -0.05]]),
        affine([[0.83], [-0.03]], [[-0.26], [-0.59]]),
        affine([[1.92, 1.41], [0.12, -0.42]], [[0.67, 0.27], [-2.16, -0.44]]),
        parameters=Box([-1.0], [1.0]),
    )
    problem = sr.OptimalControlProblem(
        system=system,
        horizon=3.0,
        initial_state=[0.53, -0.78],
        control=Box([-4.0], [4.0]),
        disturbance=Box([-0.02, -0.01], [0.03, 0.02]),
        terminal=[sr.Ellipsoid([0, 0], [[0.3, 0.05], [0.05, 0.2]])],
    )
    program = sr.transcribe(problem, uniform(20, 3.0))
    decisions = []

    def undecided(x, cells=0):
        decisions.append(x)
        return [Proof("terminal", "undecided", np.inf)]

    from sparserob_piqp import Piqp
    from sparserob_regularisers import Ridge

    Exchange().close(program, Tools(solver=Piqp(), regulariser=Ridge()), undecided)
    assert prove_family(program.families[0], decisions[-1], cells=400).verdict == "proven"
