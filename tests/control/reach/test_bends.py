"""Guards how far what a disturbance gives to a functional is from its chord on a cell of times: not below what samples
say, and on short cells hardly above it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.linalg import expm

from sparserob_core.control.enclosures.comparison import block_norms
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.reach.disturbance_support import DisturbanceSupport
from sparserob_core.control.reach.support import InitialSupport
from sparserob_core.control.response.lifted import lift
from sparserob_core.control.sets.sets import Ellipsoid
from sparserob_core.sip.convex_set import Array, Box
from tests.support.plants import indicators, uniform, worst_case

HORIZON = 3.0
GRIDS = {"uniform": uniform(6, HORIZON), "uneven": indicators([0.0, 0.4, 0.5, 1.6, HORIZON])}
BOUNDS = {"box": Box([-0.2, -0.3], [0.2, 0.3]), "ellipsoid": Ellipsoid([0.0, 0.0], [[0.04, 0.01], [0.01, 0.02]])}
KNOWN = {
    "stable": [[-1.0, 0.5], [0.2, -2.0]],
    "oscillating": [[0.0, 1.0], [-4.0, -0.1]],
    "unstable": [[0.8, 1.0], [0.2, 0.5]],
    "fast": [[-12.0, 2.0], [1.0, -0.5]],
}
ROWS = np.array([[1.0, 0.0], [0.5, -2.0]])


def support_of(name: str, grid: str, bound: str, uncertain: bool) -> DisturbanceSupport:
    A, E = np.array(KNOWN[name]), np.array([[1.0, 0.3], [-0.4, 0.8]])
    if uncertain:
        turn, radius = np.array([[0.0, 0.4], [-0.3, 0.2]]), np.array([0.5])
        system = LinearSystem(
            lambda p: A + p[0] * turn, np.ones((2, 1)), lambda p: E * (1 + p[0]), parameters=Box([-0.5], [0.5])
        )
    else:
        system, radius = LinearSystem(A, np.ones((2, 1)), E), np.zeros(0)
    functionals = worst_case(system, GRIDS[grid], bound=BOUNDS[bound])
    lifted = lift(system.phases[0], functionals.response.grid, np.zeros(2), 0.0 * radius, radius)
    assert functionals.disturbance is not None
    return DisturbanceSupport(lifted, functionals.disturbance, ROWS @ lifted.transform)


def sampled(sigma: DisturbanceSupport, start: float, width: float) -> Array:
    """By how much the coefficients of every block miss their chords, in the worst of samples, summed: ``(r,)``."""
    shares = np.linspace(0.0, 1.0, 17)
    blocks = sigma.blocks(start + width * shares)  # (k, r, M, nb, q)
    share = shares[:, None, None, None, None]
    missed = blocks - (1.0 - share) * blocks[0] - share * blocks[-1]
    each = sigma.disturbance.set.reach(missed.swapaxes(2, 3))  # (k, r, nb, M)
    return np.asarray(each.sum(axis=(2, 3)).max(axis=0))


@pytest.mark.first(16)
@pytest.mark.parametrize("uncertain", [False, True])
@pytest.mark.parametrize("bound", sorted(BOUNDS))
@pytest.mark.parametrize("grid", sorted(GRIDS))
@pytest.mark.parametrize("name", sorted(KNOWN))
def test_what_the_blocks_receive_is_as_near_to_its_chord_as_is_said(
    name: str, grid: str, bound: str, uncertain: bool
) -> None:
    sigma = support_of(name, grid, bound, uncertain)
    breakpoints = sigma.lifted.grid.breakpoints
    tight = []
    for left, right in itertools.pairwise(breakpoints):
        for width, start in (
            (right - left, left),
            ((right - left) / 3, left + (right - left) / 2),
            (1e-4, left),
            (1e-4, right - 1e-4),
        ):
            found, truth = sigma.deviation(np.array([start]), np.array([width]))[0], sampled(sigma, start, width)
            assert (truth <= found * (1 + 1e-9) + 1e-15).all()
            if width == 1e-4:
                tight.append(found / truth)
    assert np.min(tight) <= 1.6


@pytest.mark.parametrize("pieces", [12, 24])
@pytest.mark.parametrize("A", [[[-1.0, 1.0], [0.0, -1.0]], [[-0.3, 3.0], [0.0, -0.3]]])
def test_rows_are_nowhere_larger_than_is_said_between_the_ends_of_a_span(A: list[list[float]], pieces: int) -> None:
    """Of a defective mode, whose coordinates cannot be turned so that they only shrink, some rows are largest between
    two ends, where their second derivative makes them so."""
    rng, system = np.random.default_rng(0), LinearSystem(A, np.ones((2, 1)))
    grid = worst_case(system, uniform(pieces, HORIZON)).response.grid
    lifted = lift(system.phases[0], grid, np.zeros(2), np.zeros(0), np.zeros(0))
    ends, nearest = lifted.fine.breakpoints, 0.0
    assert lifted.spans.size == lifted.fine.pieces
    rows = rng.normal(size=(60, 2))
    sizes = lifted.row_bounds(rows)[0][:, :, 0]
    for span, (left, right) in enumerate(itertools.pairwise(ends)):
        moved = np.array([rows @ expm(lifted.A[0] * s) for s in np.linspace(left, right, 9)])
        norms = block_norms(moved, lifted.starts)  # (9, r, q)
        assert (norms <= sizes[:, span] * (1 + 1e-12)).all()
        outside = np.maximum(norms[0], norms[-1])
        bend, beyond = sizes[:, span] - outside, norms.max(axis=0) - outside
        nearest = max(nearest, float((beyond[bend > 1e-9] / bend[bend > 1e-9]).max(initial=0.0)))
    assert nearest >= 0.55  # of what is added to the ends so much is reached


@pytest.mark.parametrize("uncertain", [False, True])
@pytest.mark.parametrize("name", sorted(KNOWN))
def test_what_an_initial_deviation_does_is_as_near_to_its_chord_as_is_said(name: str, uncertain: bool) -> None:
    of_disturbances = support_of(name, "uneven", "box", uncertain)
    sigma = InitialSupport(of_disturbances.lifted, BOUNDS["ellipsoid"], of_disturbances.rows)
    tight = []
    for left, right in itertools.pairwise(sigma.lifted.grid.breakpoints):
        for width, start in ((right - left, left), (1e-4, left), (1e-4, right - 1e-4)):
            share = np.linspace(0.0, 1.0, 17)[:, None, None, None]
            blocks = sigma.blocks(start + width * share[:, 0, 0, 0])  # (k, r, M, d)
            missed = blocks - (1.0 - share) * blocks[0] - share * blocks[-1]
            truth = sigma.set.reach(missed).sum(axis=2).max(axis=0)
            found = sigma.deviation(np.array([start]), np.array([width]))[0]
            assert (truth <= found * (1 + 1e-9) + 1e-15).all()
            tight += (found / truth).tolist() if width == 1e-4 else []
    assert min(tight) <= 1.2
