"""Guards sip/expressions/statements: what a text means, against numpy, and the refusal of every other text."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from flint import arb

from sparserob_core.errors import InputError
from sparserob_core.sip.expressions.elementary import FUNCTIONS
from sparserob_core.sip.expressions.rows import ExpressionRows
from sparserob_core.sip.expressions.statements import (
    Decisions,
    Words,
    check_name,
    parse_cost,
    parse_rows,
    read_tables,
)
from sparserob_core.sip.stated.terms import StatedObjective

DECISIONS = Decisions({"a": 4, "x": None})
TABLES = read_tables({"c": [1.0, 2.0, 3.0, 4.0], "F": [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]})
POINTS = np.random.default_rng(0).uniform(0.2, 0.9, (7, 2))
DECISION = np.array([0.3, -1.2, 2.5, 0.7, -0.4])
a, x, c, F = DECISION[:4], DECISION[4], TABLES["c"], TABLES["F"]
w, v = POINTS.T


def parse(*texts: str) -> ExpressionRows:
    return ExpressionRows.parse({"w": (0.2, 0.9), "v": (0.2, 0.9)}, texts, DECISIONS, TABLES)


def chebyshev(k: int, t: np.ndarray) -> np.ndarray:
    return np.polynomial.chebyshev.chebval(t, [0.0] * k + [1.0])


# texts that are affine in the decision, and what they are
VALUES: dict[str, Callable[[], np.ndarray]] = {
    "3": lambda: 3.0 + 0 * w,
    "1e-3*w": lambda: 1e-3 * w,
    "x": lambda: x + 0 * w,
    "-x": lambda: -x + 0 * w,
    "+x - +w": lambda: x - w,
    "w + v - 2": lambda: w + v - 2,
    "w*x/v": lambda: w * x / v,
    "(x + a[0])*w": lambda: (x + a[0]) * w,
    "x*2*w - x": lambda: x * 2 * w - x,
    "2^3 - w**2": lambda: 8 - w**2,
    "w**-1.5 + w**0 + w**v": lambda: w**-1.5 + 1 + w**v,
    "-w**2": lambda: -(w**2),
    "2**w": lambda: 2**w,
    "(w - 2)**3": lambda: (w - 2) ** 3,
    "pi*w + e": lambda: np.pi * w + np.e,
    "sin(w) + cos(v) - tan(w*v)": lambda: np.sin(w) + np.cos(v) - np.tan(w * v),
    "exp(w)*log(v) + sqrt(w) - tanh(3*v)": lambda: np.exp(w) * np.log(v) + np.sqrt(w) - np.tanh(3 * v),
    "abs(w - v) + abs(-3)": lambda: np.abs(w - v) + 3,
    "a[3]": lambda: a[3] + 0 * w,
    "a[1 + 1] - a[4/2 - 1]": lambda: a[2] - a[1] + 0 * w,
    "c[2] + F[2, 1]*w - F[1][0]": lambda: c[2] + F[2, 1] * w - F[1, 0],
    "a[c[0]] + c[F[0, 0]]": lambda: a[1] + c[1] + 0 * w,
    "chebyshev(0, w) + chebyshev(1, v)": lambda: 1 + v,
    "chebyshev(5, w)*x + chebyshev(12, v)": lambda: chebyshev(5, w) * x + chebyshev(12, v),
    "chebyshev(3, 2*w*v)": lambda: chebyshev(3, 2 * w * v),
    "sum(a[k]*w**k for k in range(4))": lambda: sum(a[k] * w**k for k in range(4)),
    "sum(x for k in range(3))": lambda: 3 * x + 0 * w,
    "sum(w for k in range(3))": lambda: 3 * w,
    "sum(2 for k in range(3))": lambda: 6 + 0 * w,
    "sum(k for k in range(1, 4))": lambda: 6 + 0 * w,
    "sum(k*w for k in range(7, 0, -2))": lambda: 16 * w,
    "sum(c[k]*a[3 - k] for k in range(4))": lambda: c @ a[::-1] + 0 * w,
    "sum(F[i, j]*a[i]*w**j for i in range(3) for j in range(2))": lambda: sum(
        F[i, j] * a[i] * w**j for i in range(3) for j in range(2)
    ),
    "sum(a[i]*v**j for i in range(4) for j in range(i))": lambda: sum(a[i] * v**j for i in range(4) for j in range(i)),
    "sum(sum(a[i]*v**j for j in range(i, 4)) - i for i in range(4))": lambda: sum(
        sum(a[i] * v**j for j in range(i, 4)) - i for i in range(4)
    ),
    "sum(w*sum(v**j for j in range(k)) + k for k in range(4))": lambda: sum(
        w * sum(v**j for j in range(k)) + k for k in range(4)
    ),
    "sum(chebyshev(k, w)*a[k] for k in range(4))": lambda: sum(chebyshev(k, w) * a[k] for k in range(4)),
    "sum(chebyshev(k, w/(k + 1))*a[k] for k in range(4))": lambda: sum(
        chebyshev(k, w / (k + 1)) * a[k] for k in range(4)
    ),
    "sum(chebyshev(2, k*w) for k in range(3))": lambda: sum(chebyshev(2, k * w) for k in range(3)),
    "sum(cos(k*w)*(a[k] + x/(k + 1)) for k in range(4))": lambda: sum(
        np.cos(k * w) * (a[k] + x / (k + 1)) for k in range(4)
    ),
    "sum(w**k*k**2 for k in range(4))": lambda: sum(w**k * k**2 for k in range(4)),
    "sum(a[k] for k in range(2, 2)) + w": lambda: w,
    "sum(c[k]*w for k in range(0)) + x": lambda: x + 0 * w,
    "sum(sum(a[k] for k in range(j)) for j in range(0)) + w": lambda: w,
    "sum(chebyshev(k, w)*a[k] for k in range(3, 1))": lambda: 0 * w,
    "0*x + w": lambda: w,
}


@pytest.mark.parametrize("text", VALUES)
def test_a_text_means_what_numpy_computes(text: str) -> None:
    """As coefficients of the decision, as a violation at a decision, and on both sides of a comparison."""
    truth = VALUES[text]()
    for row, sign in ((f"{text} <= 1", 1.0), (f"1 >= {text}", 1.0), (f"{text} >= 1", -1.0), (f"1 <= {text}", -1.0)):
        rows = parse(row)
        G, h = rows.evaluate(POINTS)
        assert G.shape == (7, 1, 5) and h.shape == (7, 1)
        assert G[:, 0] @ DECISION - h[:, 0] == pytest.approx(sign * (truth - 1), rel=1e-12, abs=1e-13)
        assert rows.violations(DECISION, POINTS)[:, 0] == pytest.approx(sign * (truth - 1), rel=1e-12, abs=1e-13)


def test_coefficients_are_those_of_their_entries() -> None:
    G, h = parse("2*a[1] - w*x + a[1] <= 3 - a[0]*v").evaluate(POINTS)
    expected = np.zeros((7, 5))
    expected[:, 0], expected[:, 1], expected[:, 4] = v, 3.0, -w
    assert G[:, 0] == pytest.approx(expected) and h == pytest.approx(np.full((7, 1), 3.0))


def test_every_comparison_of_a_chain_is_a_row() -> None:
    rows = parse("-1 <= x <= w", "x >= v >= 0.1 <= 4")
    assert len(rows.rows) == 5
    expected = np.stack([-1 - x + 0 * w, x - w, v - x, 0.1 - v, 0.1 - 4 + 0 * v], axis=1)
    assert rows.violations(DECISION, POINTS) == pytest.approx(expected)
    (less, equal) = parse_rows("0 <= x == 1", Words(DECISIONS), equalities=True)
    assert (less.is_equality, equal.is_equality) == (False, True)


def test_entries_have_their_places_and_labels() -> None:
    decisions = Decisions({"b": None, "a": 2, "z": 1}, hidden=2)
    assert decisions.n == 6 and decisions.labels == ["b", "a[0]", "a[1]", "z[0]"]
    assert [list(decisions.positions(name)) for name in ("b", "a", "z")] == [[0], [1, 2], [3]]


# rows that are none, and a part of the message
REFUSED = {
    "x": "expected <= or >= between two expressions",
    "x == 1": "expected <= or >= between its expressions",
    "x < 1": "expected <= or >= between its expressions",
    "x != 1": "expected <= or >= between its expressions",
    "x in w": "expected <= or >= between its expressions",
    "x is w": "expected <= or >= between its expressions",
    "not x <= 1": "expected <= or >= between two expressions",
    "x <= 1 and x >= 0": "expected <= or >= between two expressions",
    "x <= 1 if w else 2": "expected <= or >= between two expressions",
    "": "cannot be read as arithmetic",
    "x <= (": "cannot be read as arithmetic",
    "x <= 1; 1": "cannot be read as arithmetic",
    "x\x00 <= 1": "cannot be read as arithmetic",
    "yield <= 1": "cannot be read as arithmetic",
    "y <= 1": "unknown name 'y'",
    "a[0] <= ww": "did you mean 'w'",
    "k*x <= 1": "unknown name 'k'",
    "sum(a[k] for k in range(2)) <= k": "unknown name 'k'",
    "a <= 1": "a has 4 entries; expected one of them, such as a[0]",
    "c <= x": "c is a table; expected an entry of it, such as c[0]",
    "x[0] <= 1": "'x' has no entries",
    "w[0] <= 1": "'w' has no entries",
    "q[0] <= 1": "'q' has no entries",
    "a[4] <= x": "a[4]: expected a number from 0 to 3, got 4",
    "a[-1] <= x": "a[-1]: expected a number from 0 to 3, got -1",
    "sum(a[k] for k in range(5)) <= x": "a[k]: expected a number from 0 to 3, got 4",
    "sum(a[k - 1] for k in range(4)) <= x": "a[k - 1]: expected a number from 0 to 3, got -1",
    "F[3, 0] <= x": "F[3, 0]: expected a number from 0 to 2, got 3",
    "a[0.5] <= x": "'0.5': expected a whole number, got 0.5",
    "a[1/0] <= x": "expected a whole number",
    "a[w] <= x": "'w' depends on w; expected whole numbers",
    "a[a[0]] <= x": "depends on a; expected whole numbers",
    "a[1:2] <= x": "is not allowed",
    "a[0, 1] <= x": "a has 1 dimensions, got a[0, 1]",
    "a[()] <= x": "a has 1 dimensions",
    "c[0][1] <= x": "c has 1 dimensions, got c[0][1]",
    "F[0] <= x": "F has 2 dimensions, got F[0]",
    "sin(x) <= 1": "the decision stands in sin",
    "exp(a[0]) <= 1": "the decision stands in exp",
    "abs(x) <= 1": "it is not affine in the decisions",
    "abs(abs(x)) <= 1": "the decision stands in absolute",
    "x**2 <= 1": "it is not affine in the decisions",
    "x*a[0] <= 1": "it is not affine in the decisions",
    "x*x*x <= 1": "a product of more than two decisions",
    "x**3 <= 1": "a power of a decision",
    "2**x <= 1": "a power of a decision",
    "w**x <= 1": "a power of a decision",
    "1/x <= 1": "a decision stands in a divisor",
    "w/(x + w) <= 1": "a decision stands in a divisor",
    "abs(x)/x <= 1": "a decision stands in a divisor",
    "chebyshev(1, x) <= 1": "depends on x, which is a decision",
    "chebyshev(w, w) <= x": "depends on w; expected whole numbers",
    "chebyshev(-1, w) <= x": "must be from 0 to 4096",
    "chebyshev(5000, w) <= x": "must be from 0 to 4096",
    "chebyshev(1.5, w) <= x": "expected a whole number",
    "chebyshev(1) <= x": "chebyshev takes two arguments",
    "chebyshev(k=1, x=w) <= x": "chebyshev takes two arguments",
    "kepler(w, 0.1) <= x": "kepler is known in systems alone",
    "max(w, 1) <= x": "unknown function 'max'",
    "sin(w, w) <= x": "sin takes one argument",
    "sin(*c) <= x": "sin takes one argument",
    "abs(w, w) <= x": "unknown function 'abs'",
    "x(1) <= x": "unknown function 'x'",
    "sum([a[0]]) <= x": "expected sum(expression for k in range(10))",
    "sum(*a) <= x": "expected sum(expression for k in range(10))",
    "sum((a[k] for k in range(3)), 2) <= x": "expected sum(expression for k in range(10))",
    "sum(a[k] for k in a) <= x": "expected for k in range(10)",
    "sum(a[k] for k in range(2) if k) <= x": "expected for k in range(10)",
    "sum(a[k] for (k, j) in range(3)) <= x": "expected for k in range(10)",
    "sum(a[w] for w in range(2)) <= x": "the variable 'w' of a sum means something else already",
    "sum(a[pi] for pi in range(2)) <= x": "the variable 'pi' of a sum means something else already",
    "sum(sum(a[k] for k in range(2)) for k in range(2)) <= x": "means something else already",
    "sum(w for k in range()) <= x": "expected range(stop)",
    "sum(w for k in range(1, 2, 3, 4)) <= x": "expected range(stop)",
    "sum(w for k in range(0, 4, 0)) <= x": "a range with steps of 0",
    "sum(w for k in range(w)) <= x": "depends on w; expected whole numbers",
    "sum(w for k in range(1.5)) <= x": "expected a whole number",
    "sum(w for k in range(10**7)) <= x": "sums of 10000000 turns; expected at most 1000000",
    "sum(w for k in range(2000) for j in range(2000)) <= x": "expected at most 1000000",
    "x <= True": "is not a real number",
    "x <= '1'": "is not a real number",
    "x <= 1j": "is not a real number",
    "x <= None": "is not a real number",
    "x <= ...": "is not a real number",
    "x // 1 <= 1": "is not allowed",
    "x % 2 <= 1": "is not allowed",
    "x @ a <= 1": "is not allowed",
    "~x <= 1": "is not allowed",
    "[1] <= x": "is not allowed",
    "(x, 1) <= 2": "is not allowed",
    "{1: 2} <= x": "is not allowed",
    "(x := 1) <= 1": "is not allowed",
    "f'{x}' <= 1": "is not allowed",
    "x.real <= 1": "is not allowed",
    "(lambda: 1)() <= x": "unknown function",
    "__import__('os').system('false') <= x": "unknown function",
    "(await x) <= 1": "is not allowed",
    "x <= " + "9" * 400: "a number is too large",
    "x <= " + "1+" * 600 + "1": "longer than 1000 characters",
    "x <= " + "1+" * 250 + "1": "more than 400 terms",
    "x <= " + "(" * 60 + "-" * 60 + "1" + ")" * 60: "nested more than 40 deep",
}


@pytest.mark.parametrize("text", REFUSED, ids=lambda text: repr(text[:50]))
def test_every_other_text_is_refused_with_what_was_expected(text: str) -> None:
    with pytest.raises(InputError) as caught:
        parse(text)
    assert REFUSED[text] in str(caught.value)
    assert repr(text[:30])[1:-1] in str(caught.value)


def test_a_bracket_around_an_equality_is_known_where_rows_have_no_index() -> None:
    with pytest.raises(InputError, match="expected <=, >= or == between two expressions"):
        parse_rows("x + 1", Words(DECISIONS), equalities=True)
    with pytest.raises(InputError, match="expected <=, >= or == between its expressions"):
        parse_rows("x < 1", Words(DECISIONS), equalities=True)


@pytest.mark.parametrize("name", ["1a", "a b", "", "sum", "pi", "e", "sin", "abs", "for", "lambda", "chebyshev", " at"])
def test_names_are_words_that_mean_nothing_else(name: str) -> None:
    expected = "a name of letters, digits and underscores that means nothing else"
    for path, use in (
        ("decision", lambda: Decisions({name: 1})),
        ("index", lambda: Words(DECISIONS, (name,))),
        ("tables", lambda: read_tables({name: [1.0]})),
        ("key", lambda: check_name("key", name)),
    ):
        with pytest.raises(InputError, match=expected) as caught:
            use()
        assert str(caught.value).startswith(f"{path}.{name}".rstrip("."))


def test_a_name_stands_for_one_thing() -> None:
    for words, key in (
        (lambda: Words(DECISIONS, ("x",)), "index.x"),
        (lambda: Words(DECISIONS, ("c",), TABLES), "tables.c"),
        (lambda: Words(DECISIONS, (), {"a": np.ones(2)}), "tables.a"),
        (lambda: Words(DECISIONS, ("w", "w")), "index.w"),
    ):
        with pytest.raises(InputError, match="a name that stands for one thing") as caught:
            words()
        assert str(caught.value).startswith(key)


@pytest.mark.parametrize("size", [0, -1, 1.5, True, "3"])
def test_sizes_are_whole_numbers_from_1(size: object) -> None:
    with pytest.raises(InputError, match=r"decision\.a: expected a number of entries, at least 1"):
        Decisions({"a": size})  # type: ignore[dict-item]
    with pytest.raises(InputError, match="decision: expected at least one name"):
        Decisions({})


@pytest.mark.parametrize(
    "entries", [[], [[]], 3.0, "text", [1.0, np.nan], [np.inf], [[1.0], [1.0, 2.0]], [[[1.0]]], [None], ["a"]]
)
def test_tables_are_lists_of_finite_numbers(entries: object) -> None:
    with pytest.raises(InputError, match=r"tables\.c: expected a list of finite numbers"):
        read_tables({"c": entries})  # type: ignore[dict-item]


# objectives, and what they are
COSTS: dict[str, Callable[[np.ndarray, float], float]] = {
    "x": lambda a, x: x,
    "3": lambda a, x: 3.0,
    "2*x - a[1] + 4": lambda a, x: 2 * x - a[1] + 4,
    "x**2": lambda a, x: x**2,
    "(x - 3)**2/2": lambda a, x: (x - 3) ** 2 / 2,
    "2*(x + a[0])*(a[1] - 1)": lambda a, x: 2 * (x + a[0]) * (a[1] - 1),
    "x*x - -x**2": lambda a, x: 2 * x**2,
    "abs(x)": lambda a, x: abs(x),
    "3*abs(x - a[2]) + abs(-2)": lambda a, x: 3 * abs(x - a[2]) + 2,
    "sum(a[k]**2 for k in range(4))": lambda a, x: a @ a,
    "sum((k + 1)*a[k]**2 for k in range(4))": lambda a, x: sum((k + 1) * a[k] ** 2 for k in range(4)),
    "sum(abs(a[k] - c[k]) for k in range(4))": lambda a, x: np.abs(a - c).sum(),
    "sum(c[k]*abs(a[k]) for k in range(4)) + x": lambda a, x: c @ np.abs(a) + x,
    "sum((sum(F[i, j]*a[j] for j in range(2)) - i)**2 for i in range(3))": lambda a, x: sum(
        (F[i] @ a[:2] - i) ** 2 for i in range(3)
    ),
    "sum(a[i]*a[j]*(i + 2*j) for i in range(4) for j in range(4))": lambda a, x: sum(
        a[i] * a[j] * (i + 2 * j) for i in range(4) for j in range(4)
    ),
    "sum(sum(abs(a[i])*F[i, 1] for i in range(j)) for j in range(3))": lambda a, x: sum(
        sum(abs(a[i]) * F[i, 1] for i in range(j)) for j in range(3)
    ),
    "sum(x**2 for k in range(3)) - 2*sum(abs(x) for k in range(0))": lambda a, x: 3 * x**2,
    "sum(a[k]*x for k in range(4))/c[1]": lambda a, x: a.sum() * x / 2,
    "(a[0] + a[1])*(x + 1) + abs(x)/4": lambda a, x: (a[0] + a[1]) * (x + 1) + abs(x) / 4,
}


@pytest.mark.parametrize("text", COSTS)
def test_an_objective_means_what_numpy_computes(text: str) -> None:
    cost = StatedObjective.of(parse_cost(text, Words(DECISIONS, (), TABLES)))

    def value(term, point):
        return term.constant + term.coefficients @ point[term.positions]

    for point in np.random.default_rng(1).normal(size=(5, 5)):
        total = value(cost.linear, point)
        total += sum(weight * value(left, point) * value(right, point) for weight, left, right in cost.products)
        total += sum(weight * abs(value(inner, point)) for weight, inner in cost.absolutes)
        assert total == pytest.approx(COSTS[text](point[:4], point[4]), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("x**3", "a power of a decision"),
        ("x*x*x", "a product of more than two decisions"),
        ("x*abs(x)", "absolute value with a decision"),
        ("abs(x)**2", "the decision stands in power"),
        ("abs(abs(x))", "the decision stands in absolute"),
        ("abs(x**2)", "the decision stands in absolute"),
        ("1/x", "a decision stands in a divisor"),
        ("x/abs(x)", "a decision stands in a divisor"),
        ("sin(x)", "the decision stands in sin"),
        ("w", "unknown name 'w'"),
        ("x <= 1", "is not allowed"),
        ("sum(x**3 for k in range(2))", "a power of a decision"),
        ("chebyshev(2, x)", "which is a decision"),
    ],
)
def test_other_objectives_are_refused(text: str, part: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_cost(text, Words(DECISIONS, (), TABLES))
    assert part in str(caught.value) and repr(text) in str(caught.value)


def test_a_part_that_several_rows_contain_is_evaluated_once_and_stays_what_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shared, calls = "exp(w)*sum(a[k]*w^k*c[1] for k in range(4)) + v*x", []

    def count(values: np.ndarray) -> np.ndarray:
        calls.append(values)
        return np.exp(values)

    monkeypatch.setitem(FUNCTIONS, "exp", count)
    texts = [f"{shared} <= 1", f"{shared} >= v - 2", f"-2 <= {shared} <= 3", f"2*({shared}) - 3*w <= x"]
    G, h = parse(*texts).evaluate(POINTS)
    alone = [parse(text) for text in texts]
    assert np.array_equal(G, np.concatenate([rows.evaluate(POINTS)[0] for rows in alone], axis=1))
    assert np.array_equal(h, np.concatenate([rows.evaluate(POINTS)[1] for rows in alone], axis=1))
    family = parse(*texts)
    calls.clear()
    violations = family.violations(DECISION, POINTS)
    assert len(calls) == 1
    assert np.array_equal(violations, np.concatenate([rows.violations(DECISION, POINTS) for rows in alone], axis=1))
    calls.clear()
    family.evaluate(POINTS)
    assert len(calls) == 1


@pytest.mark.parametrize("power", [2.0, 3.0, -2.0, 64.0])
def test_a_power_of_a_ball_around_0_is_a_product(power: float) -> None:
    around = np.array([[arb(0.0, 1e-3), arb(0.5, 1e-9), arb(-2.0)]], dtype=object)
    words = Words(Decisions({"x": None}), ("t",))
    row = parse_rows(f"t^{power:g} <= x", words)[0]
    values = row.value({"t": around[:, 1:]}, np.array([[arb(0.0)]], dtype=object))[0]
    assert all(value.contains(point**power) for value, point in zip(values, (arb(0.5), arb(-2.0)), strict=True))
    if power > 0.0:
        value = row.value({"t": around[:, :1]}, np.array([[arb(0.0)]], dtype=object))[0, 0]
        assert value.is_finite() and value.contains(arb(1e-3) ** int(power))
