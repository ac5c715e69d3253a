"""Guards checker: deviations that are seen as given, where breakpoints of control and disturbance differ."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from flint import arb, arb_mat, ctx

import sparserob_core as sr
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.plant import Plant, modes_at
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.reach.closed_loop import VerifiedLoop
from sparserob_core.checker.reach.preimages import MeasuredDeviations, ReachableSubspace
from sparserob_core.control.problem.system import LinearSystem, VaryingSystem
from sparserob_core.control.sets.sets import Box

PLANTS = {
    "one state": (np.array([[-0.1]]), np.array([[1.0]])),
    "one push on two states": (np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([[0.0], [1.0]])),
    "two pushes that are one": (np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([[0.5, 1.0], [1.0, 2.0]])),
    "a state that nothing reaches": (np.diag([-1.0, -0.5, 0.3]), np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])),
    "decoupled": (np.diag([-1.0, -0.5, 0.2, 0.4]), np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0], [0.0, 1.0]])),
}
GRIDS = {
    "alike": [0.0, 1.0, 2.0, 3.0, 4.0],
    "four at first": [0.0, 0.2, 0.4, 0.6, 3.5, 4.0],
    "finer": [0.0, 0.4, 0.9, 1.3, 1.6, 2.2, 2.7, 3.1, 4.0],
    "coarser": [0.0, 2.5, 4.0],
}


def seen_of(A: np.ndarray, E: np.ndarray, changes: list[float]) -> MeasuredDeviations:
    """What all innovations at 1, 2 and 3 see of a disturbance that may jump at these times."""
    d, mw = E.shape
    system = LinearSystem(A, np.ones((d, 1)), E)
    ends = [0.0, 1.0, 2.0, 3.0, 4.0]
    loop = VerifiedLoop(
        system,
        [0.0] * d,
        [arb_mat(1, 1)] * 4,
        np.zeros((4, 4, 1, d)),
        sorted({*ends, *changes}),
        ends,
        changes[:-1],
        Box(-np.ones(mw), np.ones(mw)),
    )
    pushed = ReachableSubspace.of(
        [(mode["A"], mode["E"]) for mode in modes_at(system, ())], np.eye(mw, dtype=int).tolist()
    )
    blocks = sorted({block for seen in loop.innovation_matrices for block in seen})
    table = np.empty((3 * d, len(blocks) * mw), dtype=object)
    table[:] = arb(0)
    pattern = np.zeros(table.shape, dtype=bool)
    for j in (1, 2, 3):
        for place, block in enumerate(blocks):
            if block in loop.innovation_matrices[j]:
                where = slice((j - 1) * d, j * d), slice(place * mw, (place + 1) * mw)
                table[where], pattern[where] = (
                    np.array(loop.innovation_matrices[j][block].tolist(), dtype=object),
                    pushed.pattern,
                )
    rows = [(d * j, pushed.states) for j in (1, 2, 3)]
    columns = [(mw * (k + 1), pushed.entries) for k in range(len(blocks))]
    return MeasuredDeviations(arb_mat(table.tolist()), pattern, rows, columns)


def floats(matrix: arb_mat) -> np.ndarray:
    return np.array([[float(x.mid()) for x in row] for row in matrix.tolist()])


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("name", PLANTS)
def test_a_preimage_is_seen_as_what_it_is_a_preimage_of(name: str, grid: str) -> None:
    with ctx.workprec(96):
        seen = seen_of(*PLANTS[name], GRIDS[grid])
        D, X = seen.matrix, seen.inverse()
        off = D * X * D - D
        assert all(abs(x) < 1e-12 for x in off.entries())
        assert seen.rank_bound == np.linalg.matrix_rank(floats(D), tol=1e-9)


def test_no_rank_is_above_the_bound_whatever_the_numbers_are() -> None:
    rng = np.random.default_rng(3)
    for _ in range(40):
        r, c = rng.integers(2, 5, size=2), rng.integers(1, 4, size=3)
        most_r, most_c = (np.array([int(rng.integers(1, size + 1)) for size in sizes]) for sizes in (r, c))
        sees = rng.random((2, 3)) < 0.6
        parts = [
            [
                sees[i, j] * (rng.normal(size=(r[i], k := min(most_r[i], most_c[j]))) @ rng.normal(size=(k, c[j])))
                for j in range(3)
            ]
            for i in range(2)
        ]
        for i in range(2):  # every block of columns and of rows of the rank that it may have
            left = np.linalg.qr(rng.normal(size=(r[i], r[i])))[0][:, : most_r[i]]
            parts[i] = [left @ left.T @ part for part in parts[i]]
        for j in range(3):
            right = np.linalg.qr(rng.normal(size=(c[j], c[j])))[0][:, : most_c[j]]
            for i in range(2):
                parts[i][j] = parts[i][j] @ right @ right.T
        D, pattern = (
            np.block(parts),
            np.block([[np.full(parts[i][j].shape, sees[i, j]) for j in range(3)] for i in range(2)]),
        )
        ends = [
            list(zip(np.cumsum(sizes).tolist(), most.tolist(), strict=True))
            for sizes, most in ((r, most_r), (c, most_c))
        ]
        seen = MeasuredDeviations(arb_mat(D.tolist()), pattern, *ends)
        assert (
            np.linalg.matrix_rank(D, tol=1e-9) <= seen.rank_bound <= min(most_r.sum(), most_c.sum(), r.sum(), c.sum())
        )


def test_of_all_deviations_that_are_seen_alike_those_of_least_squares_are_told() -> None:
    """Whatever the sizes of the columns: how far each reaches is its unit."""
    for sizes in ([1.0, 1000.0], [1.0, 1.0], [0.01, 3.0]):
        D = np.array([sizes])
        seen = MeasuredDeviations(
            arb_mat(D.tolist()), np.ones((1, 2), dtype=bool), [(1, 1)], [(1, 1), (2, 1)], np.ones(2)
        )
        found = np.array([[float(x.mid()) for x in row] for row in seen.inverse().tolist()])
        np.testing.assert_allclose(found, np.linalg.pinv(D), rtol=1e-12)


def test_what_balls_cannot_tell_is_not_inverted() -> None:
    """A period of an oscillator leaves next to nothing of a constant push: with few bits it may be 0."""
    A = np.array([[0.0, 2.0 * np.pi], [-2.0 * np.pi, 0.0]])
    with ctx.workprec(40), pytest.raises(Unchecked):
        seen_of(A, np.eye(2), GRIDS["alike"]).inverse()


@pytest.mark.parametrize("breakpoints", [[0, 0.2, 0.4, 0.6, 3.5, 4], [0, 1.5, 1.7, 4], [0, 0.3, 2, 2.1, 2.2, 4]])
def test_the_lower_bound_of_a_policy_is_verified_where_the_disturbance_has_breakpoints_of_its_own(
    breakpoints: list[float], tmp_path: object
) -> None:
    config = {
        "problem": {
            "name": "linear",
            "system": {"A": [[-0.1]], "B": [[1]], "E": [[1]]},
            "horizon": 4.0,
            "initial_state": [2],
            "control": {"box": 1.0},
            "disturbance": {"box": [0.2]},
            "terminal": [{"box": [0.3]}],
        },
        "dictionaries": {
            "control": {"name": "piecewise_constant", "pieces": 4},
            "disturbance": {"name": "piecewise_constant", "breakpoints": breakpoints},
        },
        "policy": {"name": "affine", "cost": "peak"},
        "observers": [],
    }
    sr.run(config, out=f"{tmp_path}/run", quiet=True, figures=False)
    assert sr.check(f"{tmp_path}/run").status == "verified"


def test_what_systems_that_take_turns_bring_to_a_state_counts_wherever_any_of_them_does() -> None:
    """``w`` enters the first state; one system leads it to the second one, another from there to the third."""
    entry = arb_mat([[1], [0], [0]])
    lead = [arb_mat([[0, 0, 0], [1, 0, 0], [0, 0, 0]]), arb_mat([[0, 0, 0], [0, 0, 0], [0, 1, 0]])]
    alone = [ReachableSubspace.of([(A, entry)], [[1]]) for A in lead]
    assert [one.states for one in alone] == [2, 1] and not alone[0].pattern[2, 0]
    together = ReachableSubspace.of([(A, entry) for A in lead], [[1]])
    assert together.states == 3 and together.entries == 1 and together.pattern.all()
    elsewhere = ReachableSubspace.of([(lead[0], entry), (lead[0], arb_mat([[0], [0], [1]]))], [[1]])
    assert elsewhere.states == 3 and elsewhere.entries == 1


def test_rows_that_are_nothing_but_rounding_do_not_hide_the_others() -> None:
    """What an observer leaves of what was seen before: entries of 1e-17 and 1e-32 that balls know to 1e-29."""
    told, left = [[3.0, -8.0], [-1e-5, -2e-5]], [[-9e-16, -9e-15], [-6e-32, -7e-31]]
    with ctx.workprec(96):
        table = [[arb(v) for v in row] for row in told] + [[arb(v, 1e-28) for v in row] for row in left]
        seen = MeasuredDeviations(arb_mat(table), np.ones((4, 2), dtype=bool), [(2, 2), (4, 2)], [(2, 2)])
        X = seen.inverse()
        assert np.abs(floats(X * seen.matrix) - np.eye(2)).max() < 1e-15
        assert not floats(X)[:, 2:].any()
        assert max(float(x.rad()) for x in (X * seen.matrix).entries()) < 1e-20
        with pytest.raises(Unchecked):
            MeasuredDeviations(arb_mat(table[2:]), np.ones((2, 2), dtype=bool), [(2, 2)], [(2, 2)]).inverse()


def test_of_deviations_that_are_seen_alike_those_are_taken_that_reach_farthest() -> None:
    """One number is seen of three deviations: the third is seen a thousandfold and can hardly deviate."""
    one = [(1, 1)]
    with ctx.workprec(96):
        for reach in ([1.0, 1.0, 1e-9], [1e-9, 1.0, 1e-12], [1.0, 2.0, 1e-3]):
            X = MeasuredDeviations(
                arb_mat([[1.0, 1.0, 1e3]]), np.ones((1, 3), dtype=bool), one, [(3, 3)], np.array(reach)
            ).inverse()
            share = np.abs(floats(X)[:, 0]) / reach
            best = np.array([1.0, 1.0, 1e3]) * reach
            assert floats(X)[:, 0] @ [1.0, 1.0, 1e3] == pytest.approx(1.0, abs=1e-12)
            assert share.max() < 8.0 / best.max()  # powers of two near the reach


def test_what_may_change_with_time_is_not_taken_for_exact_where_it_seems_still() -> None:
    """Columns that differ by 1e-17 are two: floats of one time would call them one."""
    system = VaryingSystem.of([["0", "0"], ["0", "0"]], [["1"], ["0"]], 1.0, [["1", "1"], ["1", "exp(1e-17 + 0*t)"]])
    with ctx.workprec(192):
        law, ends = VerifiedFlow(Plant.of(system, 1.0), 1.0), [0.0, 0.5, 1.0]
        still, none = [arb_mat(1, 1)] * 2, np.zeros((2, 2, 1, 2))
        loop = VerifiedLoop(system, [0.0, 0.0], still, none, ends, ends, ends[:2], Box([-1, -1], [1, 1]), law=law)
        found = loop.find_reachable_subspace([[Fraction(1), Fraction(0)], [Fraction(0), Fraction(1)]])
    assert law.law.is_still and (found.states, found.entries) == (2, 2)
