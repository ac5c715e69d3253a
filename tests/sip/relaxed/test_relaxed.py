"""Guards sip/relaxed/relaxed: the relaxed program ``g``: monotone in added indices, invariant under permutation, the
same with lazy rows as with all of them."""

from __future__ import annotations

from dataclasses import replace
from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.sparse import csc_array

import sparserob_core as sr
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram, Rows, rows_at
from sparserob_core.testing.solvers import by_linear_programming

EMPTY = np.zeros((0, 1))


@pytest.fixture(scope="module")
def piqp():
    from sparserob_piqp import Piqp

    return Piqp()


@pytest.fixture(scope="module")
def ridge():
    from sparserob_regularisers import Ridge

    return Ridge()


def random_program(rng, n=5, equality=False):
    """Two families of smooth rows, satisfied strictly by a known decision; bounds on every variable."""
    inside = rng.uniform(-0.5, 0.5, n)
    frequencies, phases = rng.uniform(0, 4, (2, n)), rng.uniform(0, 6, (2, n))

    def rows(which):
        def of(t):
            G = np.cos(t * frequencies[which] + phases[which])[:, None, :]
            return G, G @ inside + 0.2 + 0.2 * np.sin(3 * t) ** 2

        return of

    families = [
        sr.ConstraintFamily(name=name, index_set=sr.Box([0.0], [2.0]), rows=rows(i)) for i, name in enumerate("ab")
    ]
    A = rng.normal(size=(1, n)) if equality else None
    return sr.SemiInfiniteProgram(
        n=n,
        q=rng.normal(size=n),
        weights=rng.uniform(0, 1, n),
        lower=-1.0,
        upper=1.0,
        families=families,
        A=A,
        b=None if A is None else A @ inside,
    )


def by_linear_program(program, indices):
    """The same finite program by HiGHS: ``x``, then ``s >= |x|``."""
    G, h = zip(*[program.family(name).rows(points) for name, points in indices.items() if len(points)], strict=True)
    G, h = np.concatenate([g.reshape(-1, program.n) for g in G]), np.concatenate([b.ravel() for b in h])
    n, base, identity = program.n, program.finite, np.eye(program.n)
    rows = np.vstack(
        [np.hstack([G, np.zeros_like(G)]), np.hstack([identity, -identity]), np.hstack([-identity, -identity])]
    )
    equal = None if not base.b.size else np.hstack([base.A, np.zeros_like(base.A)])
    return linprog(
        np.concatenate([base.q, base.weights]),
        rows,
        np.concatenate([h, np.zeros(2 * n)]),
        equal,
        base.b if base.b.size else None,
        bounds=[*zip(base.lower, base.upper, strict=True), *[(0, None)] * n],
        method="highs",
    )


def points(rng, count):
    return rng.uniform(0, 2, (count, 1))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), equality=st.booleans())
def test_g_is_the_value_of_the_finite_linear_program(piqp, seed, equality):
    rng = np.random.default_rng(seed)
    program = random_program(rng, equality=equality)
    indices = {"a": points(rng, 8), "b": points(rng, 5)}
    truth = by_linear_program(program, indices)
    found = RelaxedProgram(program, piqp).evaluate(indices, 0.0)
    assert truth.status == 0
    assert abs(found.value - truth.fun) <= 1e-7
    assert found.finite.lower_bound <= truth.fun + 1e-9


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10**6), epsilon=st.sampled_from([0.0, 1e-4, 1.0]))
def test_g_never_decreases_when_indices_are_added(piqp, ridge, seed, epsilon):
    rng = np.random.default_rng(seed)
    program = random_program(rng)
    relaxed = RelaxedProgram(program, piqp, ridge)
    indices, last = {"a": points(rng, 1), "b": EMPTY}, -np.inf
    for _ in range(5):
        value = relaxed.evaluate(indices, epsilon).value
        assert value >= last - 1e-8
        last = value
        indices = {name: np.vstack([old, points(rng, int(rng.integers(0, 4)))]) for name, old in indices.items()}


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10**6), epsilon=st.sampled_from([0.0, 1e-3, 1.0]))
def test_g_does_not_depend_on_the_order_of_its_indices_or_on_what_was_asked_before(piqp, ridge, seed, epsilon):
    rng = np.random.default_rng(seed)
    program = random_program(rng)
    indices = {"a": points(rng, 9), "b": points(rng, 6)}
    fresh = RelaxedProgram(program, piqp, ridge).evaluate(indices, epsilon).value
    used = RelaxedProgram(program, piqp, ridge)
    used.evaluate({"b": points(rng, 7), "a": points(rng, 3)}, 0.5)
    shuffled = {name: rng.permutation(indices[name]) for name in ("b", "a")}
    assert abs(used.evaluate(shuffled, epsilon).value - fresh) <= 2e-8
    doubled = {name: np.vstack([at, at]) for name, at in indices.items()}
    assert abs(used.evaluate(doubled, epsilon).value - fresh) <= 2e-8


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10**6), epsilon=st.sampled_from([0.0, 1e-3]))
def test_lazy_rows_give_what_all_rows_give(piqp, ridge, seed, epsilon):
    rng = np.random.default_rng(seed)
    program = random_program(rng)
    indices = {"a": points(rng, 60), "b": points(rng, 40)}
    relaxed = RelaxedProgram(program, piqp, ridge)
    every = rows_at(program, "a", indices["a"]).joined(rows_at(program, "b", indices["b"]))
    lazy, full = relaxed.evaluate(indices, epsilon), relaxed.solve(every, epsilon)
    assert full.status == "optimal"
    assert abs(lazy.value - full.value) <= 2e-8
    assert (every.G @ lazy.decision - every.h).max() <= 1e-8
    assert lazy.rows.h.size <= every.h.size


def test_no_indices_are_the_finite_constraints_alone(piqp):
    program = random_program(np.random.default_rng(0))
    found = RelaxedProgram(program, piqp).evaluate({"a": EMPTY, "b": EMPTY}, 0.0)
    base = program.finite
    truth = np.minimum(0.0, base.weights - np.abs(base.q)).sum()
    assert abs(found.value - truth) <= 1e-9
    assert RelaxedProgram(program, piqp).evaluate({}, 0.0).value == found.value


def test_indices_that_contradict_each_other_make_g_infinite_with_a_certificate(piqp):
    family = sr.ConstraintFamily(
        name="a", index_set=sr.Box([-1.0], [1.0]), rows=lambda t: (np.sign(t)[:, None, :], -np.ones((t.shape[0], 1)))
    )
    program = sr.SemiInfiniteProgram(n=1, q=np.ones(1), lower=-9.0, upper=9.0, families=[family])
    found = RelaxedProgram(program, piqp).evaluate({"a": np.array([[-0.5], [0.5]])}, 0.0)
    assert found.value == np.inf
    assert found.finite.infeasibility > 0.5
    assert np.isfinite(RelaxedProgram(program, piqp).evaluate({"a": np.array([[0.5]])}, 0.0).value)


def test_a_tightened_program_is_feasible_with_the_margin_to_spare(piqp):
    rng = np.random.default_rng(1)
    program = random_program(rng)
    relaxed = RelaxedProgram(program, piqp)
    rows = rows_at(program, "a", points(rng, 30))
    solution = relaxed.solve(rows, 0.0, margin=1e-4)
    norms = np.linalg.norm(rows.G, axis=1)
    assert ((rows.G @ solution.x - rows.h) / norms).max() <= -1e-4 + 1e-8
    assert relaxed.lower_bound(rows, solution).bound <= relaxed.solve(rows, 0.0).value + 1e-10


def test_the_lower_bound_holds_for_any_multipliers():
    from dataclasses import replace

    from sparserob_piqp import Piqp

    rng = np.random.default_rng(2)
    program = random_program(rng)
    relaxed = RelaxedProgram(program, Piqp())
    rows = rows_at(program, "a", points(rng, 10))
    solution = relaxed.solve(rows, 0.0)
    truth = by_linear_program(program, {"a": np.array([cut.index for cut in rows.cuts])}).fun
    assert abs(relaxed.lower_bound(rows, solution).bound - truth) <= 1e-8
    for _ in range(20):
        wrong = replace(
            solution,
            y=solution.y + rng.normal(size=solution.y.size) * 10 ** rng.uniform(-8, 1),
            x=solution.x + rng.normal(size=5),
        )
        assert relaxed.lower_bound(rows, wrong).bound <= truth + 1e-9


def test_rows_remember_where_they_come_from():
    program = random_program(np.random.default_rng(3))
    at = np.array([[0.5], [1.5]])
    rows = rows_at(program, "b", at)
    assert [(cut.family, float(cut.index[0]), cut.row) for cut in rows.cuts] == [("b", 0.5, 0), ("b", 1.5, 0)]
    both = Rows.none(5).joined(rows).take(np.array([False, True]))
    assert both.cuts[0].index[0] == 1.5
    assert np.array_equal(both.G[0], program.family("b").rows(at)[0][1, 0])


def test_a_bound_is_recorded_with_the_very_multipliers_that_prove_it(piqp):
    """Slanted sides of the controls are images without a lower bound; multipliers of the wrong sign, by the accuracy of
    a solver, prove nothing there and are moved."""
    rng = np.random.default_rng(3)
    n, moved = 3, 0
    for _ in range(20):
        sides = rng.normal(size=(2, n))
        program = sr.SemiInfiniteProgram(
            n=n,
            q=rng.normal(size=n),
            weights=np.concatenate([rng.uniform(0, 1, n), np.zeros(2)]),
            lower=np.concatenate([-np.ones(n), np.full(2, -np.inf)]),
            upper=np.concatenate([np.ones(n), np.full(2, 0.3)]),
            S=csc_array(np.vstack([np.eye(n), sides])),
            families=[],
        )
        rows = Rows(
            rng.normal(size=(2, n)), rng.uniform(0.1, 0.3, 2), tuple(sr.Cut("a", np.zeros(1), i) for i in range(2))
        )
        relaxed = RelaxedProgram(program, piqp)
        solution = relaxed.solve(rows, 0.0)
        off = replace(solution, z=solution.z + 1e-4 * rng.normal(size=n + 2))
        off = replace(off, y=np.abs(solution.y + 1e-4 * rng.normal(size=2)))
        dual = relaxed.lower_bound(rows, off)
        y = np.zeros(2)
        y[[cut.row for cut in dual.cuts]] = [cut.multiplier for cut in dual.cuts]
        moved += bool(dual.cuts and (np.abs(y - off.y).max() > 0.0 or np.abs(dual.z - off.z).max() > 0.0))
        free = relaxed.finite(np.zeros((0, n)), np.zeros(0), 0.0)
        priced = by_linear_programming("", replace(free, q=free.q + y @ rows.G))
        assert dual.bound <= priced.highest - y @ rows.h
    assert moved >= 5


@pytest.mark.parametrize("power", [1e-7, 1e-9])
def test_a_lower_bound_counts_the_rounding_of_terms_that_cancel(power: float) -> None:
    """The largest ``t - t^(1 + p)`` is about ``p/e``, and both terms about ``1/e``."""
    text = f"-(t^{1.0 + power!r}) + t <= r"
    family = sr.ConstraintFamily.from_expressions("f", index={"t": (0, 1)}, rows=[text], decision={"r": None})
    result = sr.solve(sr.SemiInfiniteProgram(n=1, q=[1], families=[family]))
    with localcontext() as context:
        context.prec = 50
        a = Decimal(1.0 + power)
        t = a ** (-1 / (a - 1))
        exact = t - t**a
        assert Decimal(result.lower_bound) <= exact
    assert result.lower_bound == pytest.approx(float(exact), rel=0.1)


def test_a_lower_bound_counts_the_rounding_of_entries_that_are_0_in_the_answer() -> None:
    """The coefficient of ``a`` is 1. Its terms cancel to 0 in doubles, so that ``a`` looks worthless."""
    family = sr.ConstraintFamily.from_expressions(
        "f", index={"t": (1, 1)}, rows=["r + a*((1e16 + t) - 1e16) >= 1"], decision={"r": None, "a": None}
    )
    program = sr.SemiInfiniteProgram(n=2, q=[1, 0], weights=[0, 0.1], lower=[0, -1], upper=[9, 1], families=[family])
    assert sr.solve(program).lower_bound <= 0.1
