"""Guards sip/proof: the leaves of a proof: closed cells that together are the whole index set, the same in every
run."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.control.constraints.curved import CurvedConstraint
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.sets.sets import Ellipsoid, Polytope
from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.convex_set import Box
from sparserob_core.sip.program import ConstraintFamily
from sparserob_core.sip.proof.branch_and_bound import prove_family
from tests.support.plants import uniform, worst_case

TRIANGLE = Polytope([[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]], [0.6, 0.6, 0.5])


def plant(parameters, disturbance=None):
    system = LinearSystem(
        lambda p: np.array([[0 * p[0], 1 + 0.3 * p[0]], [-2 + p[0], -0.5 + p[1]]]),
        [[0.0], [1.0]],
        parameters=parameters,
    )
    return worst_case(system, uniform(4, 2.0), bound=disturbance, initial_state=[1.0, 0.5]), ParameterIndex(
        system.parameters
    )


def flat(parameters, start):
    functionals, index = plant(parameters, Box([-0.1, -0.1], [0.1, 0.1]))
    constraint = FlatConstraint(
        "path", functionals, np.array([[1.0, 0.4], [-0.3, 1.0]]), np.zeros(2), start, 2.0, index
    )
    slack = 0.1 if start < 2.0 or isinstance(parameters, Polytope) else 0.02
    return FlatConstraint("path", functionals, constraint.H, np.full(2, top(constraint) + slack), start, 2.0, index)


def curved(parameters, start):
    functionals, index = plant(parameters)
    size = 3.4 if start < 2.0 else 2.5 if isinstance(parameters, Polytope) else 1.9
    return CurvedConstraint("path", functionals, Ellipsoid([0.0, 0.0], size * np.eye(2)), start, 2.0, index)


def top(constraint):
    box, rng = constraint.index_set, np.random.default_rng(0)
    G, rhs = constraint.rows(rng.uniform(box.lower, box.upper, (2000, box.dimension)))
    return float((G @ np.ones(4) - rhs).max())


def proven(constraint):
    family = ConstraintFamily(
        name="path",
        index_set=constraint.index_set,
        rows=constraint.rows,
        enclosure=constraint.enclosure,
        cells=constraint.cells,
    )
    proof = prove_family(family, np.ones(4))
    assert proof.verdict == "proven", proof.reason
    return family, proof


CASES = {"flat": (flat, 0.3), "end": (flat, 2.0), "curved": (curved, 0.3), "curved end": (curved, 2.0)}
SETS = {"box": Box([-0.6, -0.6], [0.6, 0.6]), "triangle": TRIANGLE}


@pytest.mark.first(4)
@pytest.mark.parametrize("case", sorted(CASES))
@pytest.mark.parametrize("parameters", sorted(SETS))
def test_the_leaves_of_a_proof_partition_its_cells(case, parameters):
    make, start = CASES[case]
    family, proof = proven(make(SETS[parameters], start))
    lower, upper = proof.leaves
    assert lower.shape[0] > family.cells[0].shape[0], "nothing was halved, so nothing is tested"
    found = np.zeros(lower.shape[0], dtype=int)
    for low, high in zip(*family.cells, strict=True):
        inside = ((lower >= low) & (upper <= high)).all(axis=1)
        wide = high > low
        found += inside
        volumes = np.prod((upper - lower)[inside][:, wide], axis=1)
        assert abs(volumes.sum() - np.prod((high - low)[wide])) <= 1e-12
        overlap = np.minimum(upper[inside, None], upper[None, inside]) - np.maximum(
            lower[inside, None], lower[None, inside]
        )
        assert ((overlap[..., wide] > 0).all(axis=2) == np.eye(inside.sum(), dtype=bool)).all()
    assert (found == 1).all()


@pytest.mark.parametrize("case", sorted(CASES))
def test_every_leaf_is_closed_by_its_own_bound_and_the_order_is_the_same_every_time(case):
    make, start = CASES[case]
    family, proof = proven(make(SETS["box"], start))
    again = proven(make(SETS["box"], start))[1]
    lower, upper = proof.leaves
    assert (family.enclosure(np.ones(4), lower, upper).bounds <= 1e-9).all()
    assert np.array_equal(lower, again.leaves[0])
    assert np.array_equal(upper, again.leaves[1])
    corners = np.hstack([lower, upper]).tolist()
    assert corners == sorted(corners)


def test_what_is_not_proven_cell_by_cell_has_no_leaves():
    constraint = flat(SETS["box"], 0.3)
    lowered = FlatConstraint(
        "path", constraint.functionals, constraint.H, constraint.h - 1.0, 0.3, 2.0, constraint.parameters
    )
    family = ConstraintFamily(
        name="path", index_set=lowered.index_set, rows=lowered.rows, enclosure=lowered.enclosure, cells=lowered.cells
    )
    assert prove_family(family, np.ones(4)).leaves is None


@pytest.mark.parametrize("curved_set", [False, True])
def test_a_system_that_can_be_enclosed_on_small_cells_only_is_halved_until_it_can(curved_set):
    """The denominator is positive, but its Taylor model over the whole interval reaches zero."""

    def A(p):
        return np.array(
            [[-1 / (1 + 0.9 * p[0] * p[0] - 0.9 * p[0] * (p[0] ** 3) - 0.9 * p[0]), 0.0], [0.0, -1.0]], dtype=object
        )

    functionals = worst_case(
        LinearSystem(A, [[0.0], [1.0]], parameters=Box([-1.0], [0.7])), uniform(4, 1.0), initial_state=[1.0, 0.5]
    )
    index = ParameterIndex(functionals.response.system.parameters)
    with pytest.raises(NotEnclosable):
        functionals.over_cells.legs(np.array([-1.0]), np.array([0.7]))
    made = (
        CurvedConstraint("path", functionals, Ellipsoid([0.0, 0.0], 9 * np.eye(2)), 0.5, 1.0, index)
        if curved_set
        else FlatConstraint("path", functionals, np.eye(2), 3 * np.ones(2), 0.5, 1.0, index)
    )
    lower, _ = proven(made)[1].leaves
    assert np.unique(lower[:, 1]).size > 1


def test_a_system_that_has_no_enclosure_at_all_is_left_undecided():
    def A(p):
        return np.array([[-1.0 if float(p[0]) > 0 else -2.0, 0.0], [0.0, -1.0]])

    functionals = worst_case(
        LinearSystem(A, [[0.0], [1.0]], parameters=Box([-1.0], [1.0])), uniform(4, 1.0), initial_state=[1.0, 0.5]
    )
    index = ParameterIndex(functionals.response.system.parameters)
    made = CurvedConstraint("path", functionals, Ellipsoid([0.0, 0.0], 9 * np.eye(2)), 0.5, 1.0, index)
    family = ConstraintFamily(
        name="path",
        index_set=made.index_set,
        rows=made.rows,
        worst=made.worst,
        enclosure=made.enclosure,
        cells=made.cells,
    )
    proof = prove_family(family, np.ones(4))
    assert proof.verdict == "undecided"
    assert "enclos" in proof.reason
