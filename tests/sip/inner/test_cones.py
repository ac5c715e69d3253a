"""Guards norms of groups as second-order cones: one program instead of dozens of tangents, and the same value."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csc_array

from sparserob_core.experiment.plugins.registry import load_registry
from sparserob_core.sip.finite import Blocks, FiniteProgram, FiniteSolution
from sparserob_core.sip.inner.solve import solve_finite
from sparserob_core.sip.inner.standard_form import has_cones, standard_form
from sparserob_core.sip.solver import AccountedSolver, Claim, QuadraticProgram, Solver

REGISTRY = load_registry()


def drawn(seed: int, image: bool = False, curved: bool = False) -> FiniteProgram:
    """Blocks of one to three entries and entries alone, with rows that a point inside the bounds keeps."""
    rng = np.random.default_rng(seed)
    number = np.array([0, 0, 0, 1, 1, -1, 2, 3, 3, 3, -1, 4, 4])
    n = number.size
    S = csc_array(np.eye(n) + 0.2 * rng.normal(size=(n, n))) if image else None
    x = rng.uniform(-0.5, 0.5, n)
    G, A = rng.normal(size=(9, n)), rng.normal(size=(1, n))
    weights = rng.uniform(0.5, 2.0, n)[np.where(number < 0, np.arange(n), number)]
    return FiniteProgram(
        np.zeros(n),
        weights,
        np.full(n, -1.5),
        np.full(n, 1.5),
        G,
        G @ x - rng.uniform(0.0, 1.0, 9) * (np.arange(9) < 3),
        A,
        A @ x,
        csc_array(0.3 * np.eye(n)) if curved else None,
        S,
        blocks=Blocks(number),
    )


def both(program: FiniteProgram) -> tuple[FiniteSolution, FiniteSolution]:
    """By cones, and by directions."""
    cones = solve_finite(program, REGISTRY.build("solver", "auto"))
    return cones, solve_finite(program, REGISTRY.build("solver", "piqp"))


@pytest.mark.first(2)
@pytest.mark.parametrize("curved", [False, True])
@pytest.mark.parametrize("image", [False, True])
def test_cones_and_directions_have_one_value_that_is_proven(image: bool, curved: bool) -> None:
    cones, directions = both(drawn(1, image, curved))
    assert cones.by == "clarabel"
    assert cones.status == directions.status == "optimal"
    assert cones.value == pytest.approx(directions.value, rel=1e-7)
    assert cones.lower_bound <= directions.value + 1e-9
    assert cones.attempts == ()


def test_cones_beside_rows_that_nothing_keeps_are_proven_infeasible_by_multipliers() -> None:
    program = drawn(1)
    row = np.zeros(program.n)
    row[0] = 1.0
    out = replace(program, G=np.vstack([program.G, -row]), h=np.append(program.h, -2.0))
    cones, directions = both(out)
    assert cones.status == directions.status == "infeasible"
    assert cones.infeasibility > 0.0


def test_an_entry_fixed_at_0_is_in_no_cone_and_one_fixed_elsewhere_leaves_it_to_directions() -> None:
    program = drawn(2)
    program = replace(program, h=program.h + 2.0, A=np.zeros((0, program.n)), b=np.zeros(0), q=3.0 * program.G[0])
    free = program.lower.copy(), program.upper.copy()
    for value, has in ((0.0, True), (0.25, False)):
        lower, upper = free[0].copy(), free[1].copy()
        lower[[0, 6]] = upper[[0, 6]] = value
        fixed = replace(program, lower=lower, upper=upper)
        assert fixed.blocks is not None
        assert has_cones(fixed, fixed.blocks) == has
        cones, directions = both(fixed)
        assert cones.status == directions.status == "optimal"
        assert any("with cones" in said for said in cones.attempts) == has  # Newton's method went on from there
        assert cones.value == pytest.approx(directions.value, rel=1e-7)


class Liar(Solver):
    """A solver that says that it is conic, and forgets the cones."""

    conic = True

    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """That of the program without them."""
        claim: Claim = REGISTRY.build("solver", "piqp").solve(replace(program, cones=()), accuracy)
        return claim


def test_a_solver_that_forgets_the_cones_is_not_believed() -> None:
    program = drawn(3)
    answer = solve_finite(program, Liar())
    assert answer.status == "optimal"
    assert answer.directions is not None
    assert any("with cones" in said and "not believed" in said for said in answer.attempts)
    assert answer.value == pytest.approx(both(program)[1].value, rel=1e-7)


def test_a_claim_that_leaves_a_cone_or_whose_multiplier_does_is_no_solution() -> None:
    program, _ = standard_form(drawn(0), "cones")
    claim = REGISTRY.build("solver", "clarabel").solve(program, 1e-9)
    assert claim.met(program, 1e-7)
    cone = program.cones[0]
    outside, turned = claim.x.copy(), claim.z_box.copy()
    outside[cone[0]] -= 1e-3
    turned[cone[0]] -= 10.0
    assert not replace(claim, x=outside).met(program, 1e-7)
    assert not replace(claim, z_box=turned).met(program, 1e-7)


def test_who_answers_cones() -> None:
    build = REGISTRY.build
    assert AccountedSolver.of(build("solver", "piqp")).cones is None
    asked = AccountedSolver.of(build("solver", "clarabel")).cones
    assert asked is not None
    auto = AccountedSolver.of(build("solver", "auto")).cones
    assert auto is not None
    assert auto[1] == "clarabel"
    assert AccountedSolver.of(build("solver", "auto", {"cones": {"name": "piqp"}})).cones is None
    with pytest.raises(ValueError, match=r"cones: .*expected a solver that answers by itself"):
        build("solver", "auto", {"cones": {"name": "auto"}})
