"""Guards the interior point method for uncertain rows: the simplex method's optimum, its bound proven, rows added
later, refutations, programs that it leaves to others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array
from threadpoolctl import threadpool_info, threadpool_limits

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.finite import FiniteProgram, Spread, UncertainRows
from sparserob_core.sip.inner.central import layout
from sparserob_core.sip.inner.central.interior import Interior
from sparserob_core.sip.inner.simplex.counterpart import Counterpart, robust_bound
from tests.support.problems import spring

BLOCKS, EACH, JOINT = 6, 4, 5  # entries of the deviations, variables that answer each, and variables that answer none


@pytest.fixture(autouse=True)
def worth_it_always(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layout, "WORTH", 0)


def spread() -> Spread:
    return Spread(((BLOCKS, Box(np.array([-0.3]), np.array([0.3]))),))


def program() -> FiniteProgram:
    n = JOINT + BLOCKS * EACH
    weights = np.zeros(n)
    weights[:JOINT] = np.linspace(0.5, 1.5, JOINT)
    bound = np.concatenate([np.full(JOINT, 4.0), np.full(n - JOINT, 10.0)])
    none = np.zeros((0, n))
    return FiniteProgram(np.zeros(n), weights, -bound, bound, none, np.zeros(0), none, np.zeros(0))


def rows(rng: np.random.Generator, limit: float, offset: float = 1.0) -> UncertainRows:
    """Two rows that look opposite ways; what enters an entry are its own variables."""
    n = JOINT + BLOCKS * EACH
    row, column = np.repeat(np.arange(BLOCKS), EACH), JOINT + np.arange(BLOCKS * EACH)
    C = csr_array((rng.standard_normal(row.size), (row, column)), shape=(BLOCKS, n))
    g = np.zeros((2, n))
    g[0, :JOINT] = rng.standard_normal(JOINT)
    g[1] = -g[0]
    h = np.array([limit, limit]) + np.array([-1.0, 1.0])
    return UncertainRows(
        csr_array(g), h, np.zeros(2, dtype=int), np.array([1.0, -1.0]), (C,), offset * rng.standard_normal((1, BLOCKS))
    )


def answering(name: int, piece: int) -> UncertainRows:
    """``|u| <= 1`` of one variable of each block, with one joint variable."""
    n = JOINT + BLOCKS * EACH
    at = JOINT + np.arange(BLOCKS) * EACH + piece
    C = csr_array((np.ones(BLOCKS), (np.arange(BLOCKS), at)), shape=(BLOCKS, n))
    g = csr_array((np.array([1.0, -1.0]), (np.arange(2), np.full(2, name))), shape=(2, n))
    d = np.zeros((1, BLOCKS))
    return UncertainRows(g, np.ones(2), np.zeros(2, dtype=int), np.array([1.0, -1.0]), (C,), d)


def bound(x: Interior | Counterpart, y: Array, deviations: Array) -> float:
    return robust_bound(program(), x.blocks, y, deviations, np.zeros(0), priced=True).value


def test_multipliers_leave_no_slope_in_what_answers_however_far_that_may_go() -> None:
    far = replace(program(), lower=np.where(np.arange(JOINT + BLOCKS * EACH) < JOINT, program().lower, -1e7))
    far = replace(far, upper=-far.lower)
    central, rng = Interior(far, spread()), np.random.default_rng(0)
    for block in [answering(k, k) for k in range(EACH)] + [rows(rng, 1.5) for _ in range(6)]:
        central.add(block)
    found = central.solve(0.0, 1e-9)
    assert found.solved
    lower = robust_bound(far, central.blocks, found.y, found.deviations, np.zeros(0), priced=True).value
    cost = float(far.weights @ np.abs(found.x))
    assert cost - 1e-7 <= lower <= cost + 1e-9  # 5e-4 where what rounding leaves stays


@pytest.mark.first(2)
@pytest.mark.parametrize("seed", range(4))
def test_both_methods_meet_at_one_optimum_and_rows_that_come_later_move_it_alike(seed: int) -> None:
    rng = np.random.default_rng(seed)
    central, simplex = Interior(program(), spread()), Counterpart(program(), spread())
    imposed = [answering(k, k) for k in range(EACH)] + [rows(rng, 2.0) for _ in range(6)]
    last = 0.0
    for block in imposed:
        central.add(block)
        simplex.add(block)
    assert central.fits()
    for _ in range(3):
        found, wanted = central.solve(0.0, 1e-9), simplex.solve()
        assert found.solved and wanted.solved
        cost = program().objective(found.x)
        assert cost == pytest.approx(program().objective(wanted.x), abs=1e-7)
        proven = bound(central, found.y, found.deviations)
        assert cost - 1e-6 <= proven <= cost + 1e-9
        assert (np.abs(found.deviations) <= spread().radii).all()
        assert max(float(block.excess(found.x, spread()).max()) for block in central.blocks) <= 1e-8
        assert cost >= last - 1e-9
        last = cost
        fresh = rows(rng, 2.0)
        central.add(fresh)
        simplex.add(fresh)


def test_what_no_decision_meets_is_refuted_by_multipliers_at_deviations_in_the_set() -> None:
    rng = np.random.default_rng(1)
    central = Interior(program(), spread())
    for k in range(EACH):
        central.add(answering(k, k))
    for _ in range(6):
        central.add(rows(rng, -30.0))
    found = central.solve(0.0, 1e-9)
    assert not found.solved
    y = found.y / found.y.sum()
    assert robust_bound(program(), central.blocks, y, found.deviations, np.zeros(0), priced=False).value > 1e-3


def test_a_solve_that_is_out_of_time_says_how_far_it_has_come() -> None:
    rng = np.random.default_rng(2)
    central = Interior(program(), spread())
    for k in range(EACH):
        central.add(answering(k, k))
    central.add(rows(rng, 2.0))
    broken_off = central.solve(0.0, 1e-9, seconds=0.0)
    assert not broken_off.solved and "out of time" in broken_off.said
    assert broken_off.x.shape == (program().n,) and central.steps == 0
    answer = central.solve(0.0, 1e-9)  # from where it was
    assert answer.solved
    least = float(program().weights @ np.abs(answer.x))
    assert bound(central, broken_off.y, broken_off.deviations) <= least + 1e-7


@pytest.mark.parametrize("fresh", [0, 1])
def test_the_way_back_from_rows_that_were_tightened_is_not_walked(fresh: int) -> None:
    """Rows that come in between are there on the way back too, and both optima are those of a program begun anew."""

    def begun(count: int) -> Interior:
        rng, central = np.random.default_rng(5), Interior(program(), spread())
        for block in [answering(k, k) for k in range(EACH)] + [rows(rng, 2.0) for _ in range(6 + count)]:
            central.add(block)
        return central

    central, anew = begun(0), begun(fresh)
    assert central.solve(0.0, 1e-6).solved
    if fresh:
        central.add(anew.blocks[-1])
    tightened, before = central.solve(0.05, 1e-6), central.steps
    back = central.solve(0.0, 1e-6)
    assert tightened.solved and back.solved
    assert fresh or central.steps - before <= 1
    for found, margin in ((tightened, 0.05), (back, 0.0)):
        wanted = anew.solve(margin, 1e-9)
        assert program().objective(found.x) == pytest.approx(program().objective(wanted.x), abs=2e-6)
        assert max(float(block.excess(found.x, spread()).max()) for block in anew.blocks) <= 1e-6 - margin
    assert bound(central, back.y, back.deviations) <= program().objective(anew.solve(0.0, 1e-9).x) + 1e-9


def test_a_new_row_leaves_residuals_of_the_size_of_its_violation() -> None:
    """Slacks that are large stay as they are: multipliers grow instead."""
    rng, central = np.random.default_rng(5), Interior(program(), spread())
    for block in [answering(k, k) for k in range(EACH)] + [rows(rng, 2.0) for _ in range(6)]:
        central.add(block)
    x = central.solve(0.0, 1e-9).x
    fresh = rows(rng, 2.0)
    violated = float(fresh.excess(x, spread()).max())
    fresh = replace(fresh, h=fresh.h + violated - 1e-3)
    assert fresh.excess(x, spread()).max() == pytest.approx(1e-3)
    central.add(fresh)
    central._extend_iterate(0.0)
    assert central._compute_residuals()[2] < 10 * 1e-3


def test_what_costs_nothing_costs_exactly_nothing() -> None:
    """A gap is relative to the cost, and that of 1e-160 to a bound of 0 stayed open."""
    rng, central = np.random.default_rng(7), Interior(program(), spread())
    for block in [answering(k, k) for k in range(EACH)] + [rows(rng, 30.0) for _ in range(4)]:
        central.add(block)
    found = central.solve(0.0, 1e-9)
    for _ in range(12):
        found = central.solve(0.0, 1e-30)
    assert program().objective(found.x) == 0.0


def test_rows_that_are_there_already_are_known_by_a_short_name() -> None:
    rng = np.random.default_rng(3)
    central = Interior(program(), spread())
    fresh = rows(rng, 2.0)
    central.add(fresh)
    central.add(fresh)
    central.add(rows(rng, 2.0))
    layout_ = central._layout
    assert layout_.parts == 2 and all(isinstance(name, bytes) and len(name) <= 32 for name in layout_._part_numbers)


def test_equalities_and_sets_that_are_no_boxes_are_left_to_the_simplex_method() -> None:
    rng = np.random.default_rng(0)
    plain = program()
    tied = FiniteProgram(**{**plain.__dict__, "A": np.ones((1, plain.n)), "b": np.ones(1)})
    central = Interior(tied, spread())
    central.add(rows(rng, 2.0))
    assert not central.fits()


SPRING = spring(0.25, since=0.5)


@pytest.mark.slow
@pytest.mark.parametrize(("cost", "w", "value"), [("peak", 0.25, 2.68082505), ("nominal", 0.3, 0.74611518)])
def test_a_policy_found_in_the_middle_is_certified_and_checked(
    cost: str, w: float, value: float, tmp_path: Path
) -> None:
    """The values come from programs that see the path at finitely many times: a proof over all times costs more."""
    config = {
        "problem": {**SPRING, "disturbance": {"box": [w, w]}},
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 20}},
        "policy": {"name": "affine", "cost": cost, "among": None},
        "observers": [],
    }
    outcome = sr.run(config, out=tmp_path / "run", quiet=True, figures=False)
    assert outcome.status == "certified", outcome.result.message
    assert outcome.result.solved_by["interior_point"] > 0 and "highs" not in outcome.result.solved_by
    assert value <= outcome.result.lower_bound * (1 + 1e-9)
    assert outcome.result.cost == pytest.approx(value, rel=6e-6)
    assert check(outcome.directory).status == "verified"


def test_linear_algebra_has_one_thread_while_it_solves(monkeypatch: pytest.MonkeyPatch) -> None:
    central, rng, threads = Interior(program(), spread()), np.random.default_rng(0), list[int]()
    for block in [answering(k, k) for k in range(EACH)] + [rows(rng, 2.0) for _ in range(6)]:
        central.add(block)
    step = Interior._take_step

    def counted(self: Interior) -> bool:
        threads.extend(one["num_threads"] for one in threadpool_info())
        return step(self)

    monkeypatch.setattr(Interior, "_take_step", counted)
    with threadpool_limits(limits=2):
        assert central.solve(0.0, 1e-9).solved
    assert threads and set(threads) == {1}
