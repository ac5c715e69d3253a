"""Guards sip/inner/simplex: the counterpart of uncertain rows has the optimum of the program that is written out at
every corner of the deviations, and its multipliers prove what the Lagrangian is at least."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.sparse import csc_array, csr_array

from sparserob_core.control.sets.sets import NormBall
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.finite import Blocks, FiniteProgram, Spread, UncertainRows, entries_of, table_of
from sparserob_core.sip.inner.simplex import growing as simplex
from sparserob_core.sip.inner.simplex.counterpart import Counterpart, RobustAnswer
from sparserob_core.sip.inner.simplex.growing import GrowingProgram
from sparserob_core.sip.inner.simplex.robust_bound import robust_bound

N, Q, EMPTY = 4, 3, np.zeros(0)
BOX = Spread(((1, Box(np.array([-0.5, -1.0]), np.array([0.5, 1.0]))), (1, Box(np.array([-0.25]), np.array([0.25])))))
POINTED = Spread(((1, NormBall(p=1.0, radius=0.75, dimension=2)), (1, Box(np.array([0.5]), np.array([2.0])))))
SPREADS = {"box": BOX, "pointed": POINTED}


def corners(spread: Spread) -> Array:
    """The corners of these two, as deviations from the middle."""
    if spread is BOX:
        return np.array(list(product((-0.5, 0.5), (-1.0, 1.0), (-0.25, 0.25))))
    return np.array([[*at, last] for at in ([0.75, 0], [-0.75, 0], [0, 0.75], [0, -0.75]) for last in (-0.75, 0.75)])


def program(rng: np.random.Generator) -> FiniteProgram:
    A = rng.standard_normal((1, N))
    inside = rng.uniform(-0.3, 0.3, N)
    lower, upper = -rng.uniform(1.0, 2.0, N), rng.uniform(1.0, 2.0, N)
    lower[0] = 0.1  # a variable that is never 0
    inside[0] = 0.3
    none = np.zeros((0, N))
    return FiniteProgram(
        0.2 * rng.standard_normal(N), rng.uniform(0.5, 1.5, N), lower, upper, none, np.zeros(0), A, A @ inside
    )


def rows(rng: np.random.Generator, kind: str, room: float = 0.6) -> UncertainRows:
    """Three rows of two parts, two of which look opposite ways; ``kind``: an entry is entered by several variables, by
    one each, or by none."""
    C = np.zeros((2, Q, N))
    d = rng.standard_normal((2, Q))
    if kind == "several":
        C = rng.standard_normal(C.shape)
        C[0, 1] = 0.0
    if kind == "single":
        C[0, 0, 1], C[0, 1, 2], C[1, 2, 3], C[1, 0, 1] = 1.5, -0.7, 0.8, -1.2
        d[C.any(axis=2)] = 0.0
    g = rng.standard_normal((3, N))
    g[1] = -g[0]
    part, factor = np.array([0, 0, 1]), np.array([0.8, -0.8, 1.1])
    return UncertainRows(
        csr_array(g), rng.uniform(0.7, 1.0, 3) + room, part, factor, tuple(csr_array(one) for one in C), 0.3 * d
    )


def written_out(block: UncertainRows, spread: Spread) -> tuple[Array, Array, Array]:
    """``G x <= h`` with one row for every row and corner, and what of ``h`` a factor multiplies."""
    G, h, moved = [], [], []
    for row, p in enumerate(block.part):
        for w in corners(spread):
            scaled = block.factor[row] * w
            G.append(block.g.toarray()[row] + scaled @ block.C[p].toarray())
            h.append(block.h[row])
            moved.append(scaled @ block.d[p])
    return np.array(G), np.array(h), np.array(moved)


@dataclass
class Known:
    """The optimum of what is written out in the parts of ``x`` that are not negative, and one more variable."""

    value: float
    extra: float


def known(
    base: FiniteProgram, blocks: list[UncertainRows], spread: Spread, extra: str = "", margin: float = 0.0
) -> Known | None:
    written = [written_out(block, spread) for block in blocks]
    G, h, moved = (np.concatenate(part) for part in zip(*written, strict=True))
    right = h - margin - (0.0 if extra == "factor" else moved)
    last = {"": 0.0 * h, "slack": -np.ones(h.size), "factor": moved}[extra][:, None]
    cost = np.concatenate([base.weights + base.q, base.weights - base.q, [0.0]])
    if extra:
        cost = np.append(np.zeros(2 * N), 1.0 if extra == "slack" else -1.0)
    positive = [(max(a, 0.0), max(b, 0.0)) for a, b in zip(base.lower, base.upper, strict=True)]
    negative = [(max(-b, 0.0), max(-a, 0.0)) for a, b in zip(base.lower, base.upper, strict=True)]
    found = linprog(
        cost,
        np.hstack([G, -G, last]),
        right,
        np.hstack([base.A, -base.A, np.zeros((base.b.size, 1))]),
        base.b,
        [*positive, *negative, (0.0, 50.0)],
    )
    return Known(found.fun, found.x[-1]) if found.status == 0 else None


def solved(counterpart: Counterpart, blocks: list[UncertainRows], margin: float = 0.0) -> RobustAnswer:
    for block in blocks:
        counterpart.add(block)
    answer = counterpart.solve(margin)
    for _ in range(40):
        # with a factor, variables that answer deviations are so many times their answers
        if not answer.solved or not counterpart.sharpen(answer.x / (answer.slack if counterpart.scales else 1.0)):
            return answer
        answer = counterpart.solve(margin)
    raise AssertionError("a set with few corners has few points")


CASES = [(seed, spread, kind) for seed in range(4) for spread in SPREADS for kind in ("several", "single", "none")]


@pytest.mark.first(12)
@pytest.mark.parametrize(("seed", "name", "kind"), CASES)
def test_the_optimum_is_that_of_what_is_written_out_and_its_multipliers_prove_it(
    seed: int, name: str, kind: str
) -> None:
    rng, spread = np.random.default_rng(seed), SPREADS[name]
    base, blocks = program(rng), [rows(rng, kind), rows(rng, "several")]
    for margin in (0.0, 0.01):
        answer, truth = solved(Counterpart(base, spread), blocks, margin), known(base, blocks, spread, "", margin)
        assert truth is not None
        assert answer.solved
        assert base.objective(answer.x) == pytest.approx(truth.value, abs=1e-8)
        assert max(float(block.excess(answer.x, spread).max()) for block in blocks) <= 1e-8 - margin
        assert (answer.y >= 0.0).all()
        assert all(spread.holds(w) for w in answer.deviations)
        proven, size, _ = robust_bound(base, blocks, answer.y, answer.deviations, answer.mu, priced=True)
        lost = margin * answer.y.sum()  # rows that were tightened are priced as they are
        assert truth.value - lost - 1e-7 <= proven <= truth.value + 1e-9
        assert size >= abs(proven) - 1e-12


@pytest.mark.first(3)
@pytest.mark.parametrize("seed", range(6))
def test_a_block_that_comes_late_and_another_margin_are_imposed_like_those_before(seed: int) -> None:
    rng = np.random.default_rng(seed)
    base, blocks = program(rng), [rows(rng, "several") for _ in range(3)]
    for spread in SPREADS.values():
        counterpart = Counterpart(base, spread)
        for number, margin in ((1, 0.0), (2, 0.02), (3, 0.02), (3, 0.0)):
            fresh = blocks[len(counterpart.blocks) : number]
            answer, truth = solved(counterpart, fresh, margin), known(base, blocks[:number], spread, "", margin)
            assert answer.solved == (truth is not None)
            if truth is not None:
                assert base.objective(answer.x) == pytest.approx(truth.value, abs=1e-8)


def test_what_comes_late_begins_with_its_equations_met(monkeypatch: pytest.MonkeyPatch) -> None:
    """Less than half of the steps of the simplex method, and the same optimum as where they begin slack."""
    steps, costs = {"met": 0, "slack": 0}, []
    for kind in steps:
        if kind == "slack":
            monkeypatch.setattr(GrowingProgram, "enter", lambda *_: None)
        for seed in range(2):
            rng = np.random.default_rng(seed)
            base, blocks = program(rng), [rows(rng, "several") for _ in range(4)]
            counterpart = Counterpart(base, BOX)
            solved(counterpart, blocks[:1])
            for block in blocks[1:]:
                answer = solved(counterpart, [block])
                steps[kind] += counterpart._linear.highs.getInfo().simplex_iteration_count
            costs.append(base.objective(answer.x))
    assert costs[:2] == pytest.approx(costs[2:], abs=1e-9)
    assert 2 * steps["met"] < steps["slack"]


@pytest.mark.first(12)
@pytest.mark.parametrize(("seed", "name", "kind"), CASES)
def test_what_nothing_meets_is_relaxed_as_little_as_possible_and_its_multipliers_refute_it(
    seed: int, name: str, kind: str
) -> None:
    rng, spread = np.random.default_rng(seed), SPREADS[name]
    base, blocks = program(rng), [rows(rng, kind, room=-1.5), rows(rng, "several", room=-1.5)]
    truth = known(base, blocks, spread, "slack")
    answer = solved(Counterpart(base, spread, elastic=True), blocks)
    assert truth is not None
    assert truth.extra > 0.1
    assert answer.slack == pytest.approx(truth.extra, abs=1e-8)
    assert answer.y.sum() == pytest.approx(1.0, abs=1e-9)
    proven = robust_bound(base, blocks, answer.y, answer.deviations, answer.mu, priced=False).value
    assert truth.extra - 1e-7 <= proven <= truth.extra + 1e-9


@pytest.mark.parametrize(("seed", "name"), [(seed, name) for seed in range(6) for name in SPREADS])
def test_a_factor_is_the_largest_by_which_what_no_decision_answers_can_grow(seed: int, name: str) -> None:
    rng, spread = np.random.default_rng(seed), SPREADS[name]
    base, blocks = program(rng), [rows(rng, "several"), rows(rng, "none")]
    truth, answer = (
        known(base, blocks, spread, "factor"),
        solved(Counterpart(base, spread, scales=True, highest=50.0), blocks),
    )
    assert truth is not None
    assert answer.slack == pytest.approx(truth.extra, rel=1e-7)


def convex_costs(base: FiniteProgram, kind: str) -> FiniteProgram:
    """A quadratic form without full rank, one that is diagonal, or the norm of two variables."""
    if kind == "block":
        weights = np.where(np.arange(N) < 2, base.weights[0], base.weights)
        return replace(base, weights=weights, blocks=Blocks(np.array([0, 0, -1, -1])))
    root = np.diag([1.0, 0.0, 0.5, 2.0])
    if kind == "full":
        root = np.random.default_rng(0).standard_normal((N, 3))
    return replace(base, P=csc_array(root @ root.T), constant=0.25)


@pytest.mark.parametrize("kind", ["full", "diagonal", "block"])
@pytest.mark.parametrize("seed", range(3))
def test_costs_that_are_not_linear_are_met_by_their_tangents_and_proven(seed: int, kind: str) -> None:
    """No decision near the answer, within the rows at every corner, costs less than what is proven."""
    rng = np.random.default_rng(seed)
    base, blocks = convex_costs(program(rng), kind), [rows(rng, "several")]
    answer = solved(Counterpart(base, BOX), blocks)
    assert answer.solved
    assert answer.at is not None
    cost = base.objective(answer.x)
    proven = robust_bound(base, blocks, answer.y, answer.deviations, answer.mu, True, answer.at).value
    assert cost - 1e-8 * (1.0 + abs(cost)) <= proven <= cost + 1e-9
    G, h, moved = written_out(blocks[0], BOX)
    for step in 0.1 * rng.standard_normal((300, N)):
        x = np.clip(answer.x + step - base.A[0] * (base.A[0] @ step) / (base.A[0] @ base.A[0]), base.lower, base.upper)
        if (G @ x <= h - moved).all() and abs(base.A @ x - base.b).max() <= 1e-9:
            assert base.objective(x) >= proven
    coarse = Counterpart(base, BOX)
    coarse.add(blocks[0])
    found = coarse.solve(accuracy=0.1)
    assert cost - 1e-8 <= base.objective(found.x) <= cost + 0.1


@pytest.mark.parametrize("name", SPREADS)
def test_a_basis_from_which_there_is_no_end_is_forgotten(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    base, blocks = program(rng), [rows(rng, "several")]
    steps = solved(Counterpart(base, SPREADS[name]), blocks)
    monkeypatch.setattr(simplex, "STALLED", 0)
    begun_anew = solved(Counterpart(base, SPREADS[name]), blocks)
    assert begun_anew.solved
    assert base.objective(begun_anew.x) == pytest.approx(base.objective(steps.x), abs=1e-9)


@pytest.mark.parametrize("patient", [0.0, 10.0])
@pytest.mark.parametrize("name", SPREADS)
def test_large_programs_are_begun_from_inside_and_end_at_the_same_optimum(
    name: str, patient: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first one, and where no step from the last basis is allowed, those after it."""
    rng = np.random.default_rng(3)  # one of which the second rows ask for steps of both
    base, blocks = program(rng), [rows(rng, "several"), rows(rng, "several", 0.3)]
    steps = solved(Counterpart(base, SPREADS[name]), blocks)
    monkeypatch.setattr(simplex, "INTERIOR_POINT_NUMBERS", 0)
    monkeypatch.setattr(simplex, "STEPS_PER_ROW_AND_COLUMN", patient)
    ways, run = list[bool](), GrowingProgram._run_highs
    monkeypatch.setattr(GrowingProgram, "_run_highs", lambda self, inside: ways.append(inside) or run(self, inside))
    large = Counterpart(base, SPREADS[name])
    first = solved(large, blocks[:1])
    again = solved(large, blocks[1:])
    assert first.solved
    assert again.solved
    assert ways[0]
    assert any(ways[1:]) == (patient == 0.0)
    assert base.objective(again.x) == pytest.approx(base.objective(steps.x), abs=1e-9)
    proven = robust_bound(base, blocks, again.y, again.deviations, again.mu, True, again.at).value
    assert proven == pytest.approx(base.objective(again.x), abs=1e-8)


def test_squares_that_are_to_be_0_are_answered_though_no_tangent_is_sharp_enough() -> None:
    """No share of a cost that tends to 0 is ever met, so that the rounds end by their number."""
    none = np.zeros((0, N))
    base = FiniteProgram(
        np.zeros(N), np.zeros(N), -np.ones(N), np.ones(N), none, np.zeros(0), none, np.zeros(0), csc_array(np.eye(N))
    )
    block = replace(rows(np.random.default_rng(0), "several"), h=np.full(3, 9.0))
    counterpart = Counterpart(base, BOX)
    counterpart.add(block)
    answer = counterpart.solve()
    assert answer.solved
    assert base.objective(answer.x) <= 1e-10
    proven = robust_bound(base, [block], answer.y, answer.deviations, answer.mu, True, answer.at).value
    assert -1e-9 <= proven <= 0.0


@pytest.mark.parametrize("seed", range(4))
def test_a_ceiling_keeps_the_weighted_sum_of_absolute_values(seed: int) -> None:
    rng = np.random.default_rng(seed)
    base, blocks = program(rng), [rows(rng, "several")]
    least = known(base, blocks, BOX)
    assert least is not None
    towards = replace(base, weights=np.zeros(N), q=rng.standard_normal(N))
    weights = np.array([0.0, 1.0, 2.0, 0.5])
    free = solved(Counterpart(towards, BOX), blocks).x
    most = 0.8 * float(weights @ np.abs(free))
    kept = solved(Counterpart(towards, BOX, ceiling=(weights, most)), blocks)
    assert kept.solved
    assert weights @ np.abs(kept.x) == pytest.approx(most, abs=1e-8)
    assert not solved(Counterpart(towards, BOX, ceiling=(weights, -0.1)), blocks).solved


@pytest.mark.parametrize("priced", [True, False])
@pytest.mark.parametrize("seed", range(8))
def test_what_multipliers_prove_is_the_least_of_the_lagrangian(seed: int, priced: bool) -> None:
    rng = np.random.default_rng(seed)
    base, blocks = program(rng), [rows(rng, "several"), rows(rng, "single")]
    count = sum(block.h.size for block in blocks)
    y = np.where(rng.random(count) < 0.3, 0.0, rng.exponential(1.0, count))
    w, mu = rng.uniform(-1.0, 1.0, (count, Q)) * BOX.radii, rng.standard_normal(1)
    ends = [{low, high, float(np.clip(0.0, low, high))} for low, high in zip(base.lower, base.upper, strict=True)]
    least, largest = np.inf, 0.0
    for corner in product(*ends):
        x, first = np.array(corner), 0
        terms = [*(mu * base.A @ x), *(-mu * base.b)]
        if priced:
            terms += [*(base.q * x), *(base.weights * np.abs(x))]
        for block in blocks:
            for row, p in enumerate(block.part):
                answered = block.C[p].toarray() @ x + block.d[p]
                said = [block.g.toarray()[row] @ x, block.factor[row] * w[first] @ answered, -block.h[row]]
                terms += [y[first] * one for one in said]
                first += 1
        least, largest = min(least, sum(terms)), max(largest, sum(abs(term) for term in terms))
    proven, size, _ = robust_bound(base, blocks, y, w, mu, priced)
    assert proven == pytest.approx(least, abs=1e-12 * largest)
    assert size >= largest * (1.0 - 1e-12)  # all that is added up, so that its rounding is


def test_a_variable_without_an_end_that_a_slope_draws_there_has_no_bound() -> None:
    rng = np.random.default_rng(0)
    base, block = program(rng), rows(rng, "several")
    free = replace(base, upper=np.full(N, np.inf), weights=np.zeros(N))
    y, w = np.ones(3), np.zeros((3, Q))
    assert robust_bound(free, [block], y, w, np.zeros(1), priced=True).value == -np.inf


@pytest.mark.parametrize("scales", [False, True])
def test_exact_rows_hold_at_every_deviation(scales: bool) -> None:
    rng = np.random.default_rng(3)
    base = replace(program(rng), A=np.zeros((0, N)), b=np.zeros(0))
    g, C = np.array([[1.0, 1.0, 0.0, 0.0]]), np.zeros((1, Q, N))
    C[0, 0, 2], C[0, 1, 3] = 2.0, 1.0
    d = np.array([[0.6, -0.2, 0.0]])
    both = UncertainRows(
        csr_array(np.vstack([g, -g])), np.array([0.7, -0.7]), np.zeros(2, dtype=int), np.array([1.0, -1.0]),
        (csr_array(C[0]),), d, exact=True,
    )  # fmt: skip
    counterpart = Counterpart(base, BOX, scales=scales, highest=3.0)
    answer = solved(counterpart, [both])
    assert answer.solved
    factor = answer.slack if scales else 1.0
    assert answer.x[2:] == pytest.approx(factor * np.array([-0.3, 0.2]), abs=1e-9)
    assert answer.x[:2].sum() == pytest.approx(0.7, abs=1e-9)
    if not scales:
        proven = robust_bound(base, [both], answer.y, answer.deviations, answer.mu, priced=True).value
        assert proven == pytest.approx(base.objective(answer.x), abs=1e-8)
        assert (answer.y >= 0.0).all()
        assert all(BOX.holds(one) for one in answer.deviations)


@pytest.mark.parametrize("seed", range(6))
def test_entries_in_any_order_are_the_sparse_table_that_scipy_makes_of_them(seed: int) -> None:
    rng, shape = np.random.default_rng(seed), (seed, 5)
    count = 4 * seed
    row, column, value = rng.integers(0, max(seed, 1), count), rng.integers(0, 5, count), rng.standard_normal(count)
    table, theirs = table_of(row, column, value, shape), csr_array((value, (row, column)), shape=shape)
    for name in ("indptr", "indices", "data"):
        mine, known = getattr(table, name), getattr(theirs, name)
        assert mine == pytest.approx(known, abs=1e-15)
    assert [one.tolist() for one in entries_of(table)[:2]] == [one.tolist() for one in theirs.tocoo().coords]


@pytest.mark.parametrize("count", [10, 100_000])
def test_the_rounding_of_a_bound_is_counted_for_as_many_rows_as_there_are(count: int) -> None:
    """One variable with a slope of as many terms as rows, each rounded downwards; many of them exceed a fixed 2^-46."""
    y, g = np.ones(count), np.full(count, 1.0 + 0.4 * 2.0**-36)
    none = np.zeros((0, 1))
    base = FiniteProgram(np.zeros(1), np.zeros(1), -np.ones(1), np.ones(1), none, np.zeros(0), none, np.zeros(0))
    part = np.zeros(count, dtype=int)
    block = UncertainRows(csr_array(g[:, None]), y * 0.0, part, np.zeros(count), (csr_array((Q, 1)),), np.zeros((1, Q)))
    found = robust_bound(base, [block], y, np.zeros((count, Q)), np.zeros(0), priced=True)
    truth = -count * Fraction(y[0]) * Fraction(g[0])
    assert Fraction(found.value - found.rounding * found.size) <= truth
    assert (Fraction(found.value - 2.0**-46 * found.size) > truth) == (count == 100_000)


@pytest.mark.parametrize("constant", [0.0, 1e-9, -1e-9, 1e-3, -1e-3])
def test_deviations_move_only_where_this_raises_the_bound(constant: float) -> None:
    """Two nearly dependent rows: a slope of rounding asks for a large change, which may cost more than it gains."""
    counterpart, columns = Counterpart(program(np.random.default_rng(1)), BOX), np.array([1, 2])
    table, constants = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-6]]), np.array([constant, 0.0])
    slope, shares = np.array([0.0, 1e-8, 0.0, 0.0]), np.array([0.5, -0.25])
    change = np.linalg.solve(table, -slope[columns])
    lower, upper = counterpart.program.lower[columns], counterpart.program.upper[columns]

    def bound(slope: Array, shares: Array) -> float:
        return float(constants @ shares + np.minimum(slope[columns] * lower, slope[columns] * upper).sum())

    before, moved = bound(slope, shares), slope.copy()
    found = counterpart._move_shares(moved, columns, table, constants, (shares, change))
    is_better = bound(np.zeros(4), shares + change) > before
    assert is_better == (constant * change[0] > -1e-8)  # of a change of 1e-2, and of a slope of 1e-8
    assert bound(moved, found) == pytest.approx(max(before, bound(np.zeros(4), shares + change)), abs=1e-15)
    assert np.array_equal(found, shares + change if is_better else shares)
    assert np.array_equal(moved, slope) != is_better


@pytest.mark.filterwarnings("error")
def test_a_variable_without_an_end_adds_nothing_where_no_slope_is_left() -> None:
    none = np.zeros((0, 2))
    free = FiniteProgram(
        np.zeros(2), np.zeros(2), np.array([-np.inf, -2.0]), np.array([np.inf, 3.0]), none, EMPTY, none, EMPTY
    )
    counterpart, columns = Counterpart(free, BOX), np.array([0, 1])
    assert counterpart._bound_variables(columns, np.array([0.0, 1.5])) == -3.0
    assert counterpart._bound_variables(columns, np.array([0.0, -1.5])) == -4.5
    assert counterpart._bound_variables(columns, np.array([1e-300, 1.5])) == -np.inf


@pytest.mark.parametrize("left_out", [0.0, 1e-8])
def test_multipliers_that_a_solver_leaves_out_or_rounds_are_found_for_a_plan_that_ends_at_a_point(
    left_out: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``x_{k+1} = x_k/10 + v_k`` with ``u_k = v_k - 2 x_k``, and ``sum |u_k|`` least. Multipliers decay by a tenth."""
    count, reach = 12, 100.0
    after = np.array([[0.1 ** (k - 1 - j) if j < k else 0.0 for j in range(count)] for k in range(count + 1)])
    free = 0.1 ** np.arange(count + 1)
    u = np.hstack([np.eye(count) - 2.0 * after[:-1], np.zeros((count, count))])
    peaks = np.hstack([np.zeros((count, count)), np.eye(count)])
    none, lower = np.zeros((0, 2 * count)), np.repeat([-reach, 0.0], count)
    base = FiniteProgram(
        np.zeros(2 * count), np.repeat([0.0, 1.0], count), lower, np.full(2 * count, reach), none, EMPTY, none, EMPTY
    )

    def block(g: Array, h: Array, exact: bool = False) -> UncertainRows:
        table = csr_array((Q, 2 * count))
        return UncertainRows(
            csr_array(g), h, np.zeros(h.size, dtype=int), np.ones(h.size), (table,), np.zeros((1, Q)), exact
        )

    end = np.append(after[-1], np.zeros(count))
    blocks = [
        block(np.vstack([u - peaks, -u - peaks]), np.concatenate([2.0 * free[:-1], -2.0 * free[:-1]])),
        block(np.vstack([end, -end]), np.array([-free[-1], free[-1]]), exact=True),
    ]
    counterpart, rng = Counterpart(base, BOX), np.random.default_rng(1)
    for each in blocks:
        counterpart.add(each)
    solve = counterpart._linear.solve

    def solve_roughly(seconds: float = np.inf) -> tuple[bool, str, Array, Array]:
        solved, message, columns, multipliers = solve(seconds)
        rough = multipliers * (1.0 + 1e-8 * rng.standard_normal(multipliers.size))
        return solved, message, columns, np.where(np.abs(rough) < left_out, 0.0, rough)

    monkeypatch.setattr(counterpart._linear, "solve", solve_roughly)
    answer = counterpart.solve()
    proven = robust_bound(base, blocks, answer.y, answer.deviations, answer.mu, priced=True).value
    assert (answer.y >= 0.0).all() and proven == pytest.approx(base.objective(answer.x), abs=1e-12)
