"""Guards checker/reach/adjoint: rows and integrals against others with more digits, cells against dense samples, and a
witness that is neither more nor less than it is."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import factorial
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from flint import arb, arb_mat, ctx

from sparserob_core.checker.outcome import Clock, Unchecked
from sparserob_core.checker.reach import adjoint as module
from sparserob_core.checker.reach.adjoint import DEAR, Adjoint, Motion, Powers, Worst
from sparserob_core.checker.sets.polynomials import Enclosed
from sparserob_core.control.sets.sets import Box, Polytope

A = [[0.0, 1.0, 0.0], [-9.0, -0.4, 2.0], [0.3, 0.0, -1.5]]
F = [[0.0, 0.2], [1.0, 0.0], [0.0, 1.0]]
C, HORIZON = np.array([1.0, 0.3, -0.5]), 4.0
GRID = np.array([0.0, 0.7, 1.9, 3.1, 4.0])
TIMES = np.array([0.0, 0.3, 1.0, 2.2, 3.99, 4.0])


def adjoint() -> Adjoint:
    return Adjoint.of(Motion.of(arb_mat(A), arb_mat(F), HORIZON, Clock()), C)


def worst(kind: str) -> Worst:
    changes = None if kind == "measurable" else GRID
    drives = Enclosed(np.array([[0.3, -1.0, 0.0, 0.8]]), np.zeros((1, 4)))
    begun = Polytope([[1, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], [0.1, 0.1, 0.1, 0.05, 0.05])
    return Worst(adjoint(), np.array([0.2, -1.0, 0.4]), begun, GRID, drives, Box([-0.2], [0.5]), changes)


def exact(t: float) -> tuple[list[float], list[float]]:
    """``l(t)`` and ``int_0^t l'F`` by one exponential of twice the digits."""
    with ctx.workprec(400):
        both = arb_mat([[*a, *f] for a, f in zip(A, F, strict=True)] + [[0.0] * 5] * 2)
        row = arb_mat([[*C.tolist(), 0.0, 0.0]]) * (both * arb(t)).exp()
        return [float(x.mid()) for x in row.entries()[:3]], [float(x.mid()) for x in row.entries()[3:]]


@pytest.mark.parametrize("dear", [0, DEAR])
def test_rows_and_integrals_hold_the_truth_and_are_close(dear: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether all rows are made of balls, or those between of floats."""
    monkeypatch.setattr("sparserob_core.checker.reach.adjoint.DEAR", dear)
    known = adjoint()
    assert known.motion.apart == (1 if dear else 16)
    rows, (sums, rounded) = known.at(TIMES), known.integrals(TIMES)
    for i, t in enumerate(TIMES.tolist()):
        row, moved = exact(t)
        assert (np.abs(rows.mid[i] - row) <= rows.rad[i] + 1e-16).all()
        assert (np.abs(sums.mid[i] - moved) <= sums.rad[i] + rounded[i] + 1e-16).all()
    assert max(rows.rad.max(), sums.rad.max()) < 1e-12
    assert (adjoint().reversed().at(TIMES).mid == -rows.mid).all()


def test_what_an_input_adds_between_two_times_is_known_better_than_the_sums() -> None:
    known = adjoint()
    part = known.between(np.array([3.5]), 1.25, 1.5)
    late, early = exact(2.25)[1], exact(2.0)[1]
    assert (np.abs(part.mid[0] - (np.array(late) - early)) <= part.rad[0] + 1e-16).all()
    off = known.between(np.array([0.3]), 0.1, 0.2)  # differences that are rounded
    assert (off.rad >= known.between(np.array([0.5]), 0.25, 0.375).rad * 0.1).all()


@pytest.mark.parametrize("kind", ["constant", "measurable"])
def test_cells_bound_every_value_in_them_closely(kind: str) -> None:
    row = worst(kind)
    times = row.cuts([])
    times = times[times <= HORIZON]
    bounds = row.over(times[:-1], times[1:])
    inside = times[:-1, None] + np.diff(times)[:, None] * np.linspace(0.0, 1.0, 17)
    tops, wide = (part.reshape(inside.shape) for part in row.most(inside.ravel()))
    values = tops - wide
    assert wide.max() < 1e-11
    assert (bounds[:, None] >= values).all()
    assert (bounds - values.max(axis=1)).max() <= 40.0 * np.diff(times).max() ** 2
    chords = np.maximum(values[:, 0], values[:, -1])
    above = values.max(axis=1) - chords
    assert above.max() > 0.1 * (bounds - chords)[above.argmax()]


@pytest.mark.parametrize("kind", ["constant", "measurable"])
def test_a_signal_reaches_no_more_than_the_worst_and_its_value_is_known(kind: str) -> None:
    row, rng = worst(kind), np.random.default_rng(0)
    best = -np.inf
    for _ in range(40):
        signal = rng.choice([-0.2, 0.5], size=(1, 4))
        deviation = np.array([0.0, 0.1, 0.05]) * rng.choice([-1.0, 1.0])
        low, high = row.along(3.5, deviation, GRID, signal)
        assert high - low < 1e-12
        best = max(best, low)
    assert best <= row.most(np.array([3.5]))[0][0]


def test_the_measurable_worst_is_that_of_ever_shorter_pieces() -> None:
    whole = worst("measurable").most(np.array([HORIZON]))[0][0]
    row = worst("constant")
    short = [
        Worst(row.adjoint, row.centre, row.begun, GRID, row.drives, row.pushed, np.linspace(0.0, HORIZON, n + 1)).most(
            np.array([HORIZON])
        )[0][0]
        for n in (4, 64, 512)
    ]
    assert all(a < b for a, b in pairwise(short))
    assert short[-1] <= whole <= short[-1] + 1e-4


def test_products_of_many_terms_hold_the_truth_and_round_as_sums_of_sums() -> None:
    rng = np.random.default_rng(5)
    for d in (1, 31, 32, 33, 300):
        left, right = rng.normal(size=(3, d)), rng.normal(size=(2, d, 4))
        found = module._product(Enclosed(left, 0.0 * left), Enclosed(right, 0.0 * right))
        for j, part in enumerate(right):
            exact = (arb_mat(left.tolist()) * arb_mat(part.tolist())).tolist()
            pairs = zip(found[0][:, j].tolist(), exact, strict=True)
            off = [[abs(arb(m) - x) for m, x in zip(*pair, strict=True)] for pair in pairs]
            assert (np.array([[float(x.upper()) for x in row] for row in off]) <= found[1][:, j]).all()
        assert (found[1] <= 6e-15 * np.einsum("kd,jdn->kjn", np.abs(left), np.abs(right))).all()


def test_a_system_that_is_too_fast_is_not_followed() -> None:
    with pytest.raises(Unchecked):
        Motion.of(arb_mat([[-1e9]]), arb_mat([[1.0]]), 1.0, Clock())


def test_what_is_left_of_an_exponential_series_is_bounded_closely_however_large_the_matrix_is() -> None:
    """``[[-1, 40], [0, -2]]`` has powers that are far smaller than those of its norm."""
    matrix = [[-1.0, 40.0], [0.0, -2.0]]
    powers = Powers.of(arb_mat(matrix), Clock())
    for step, order in ((0.01, 13), (0.1, 13), (0.25, 7), (0.01, 7)):
        with ctx.workprec(400):
            term, whole = arb_mat([[1, 0], [0, 1]]), (arb_mat(matrix) * arb(step)).exp()
            for j in range(order + 1):
                whole, term = whole - term, term * arb_mat(matrix) * (arb(step) / (j + 1))
            exact = max(float(sum((abs(x) for x in row), arb(0)).mid()) for row in whole.tolist())
        found = powers.left(step, order)
        assert exact <= found <= 40.0 * exact
        short = 41.0 * step
        assert found < 0.1 * short ** (order + 1) / factorial(order + 1)
    none = Powers.of(arb_mat([[0.0]]), Clock())
    assert none.left(1.0, 13) < 1e-200


def test_what_is_left_of_an_expansion_is_in_what_inputs_add() -> None:
    """In own units: the largest entry of every column, times what is left of the row."""
    known = adjoint()
    sizes = (np.abs(np.array(F)) / known.motion.units[:, None]).max(axis=0)
    assert (sizes <= known.pushes).all() and (known.pushes <= sizes * (1 + 1e-9)).all()
    wide = replace(known)
    wide.__dict__["left"] = known.left + 1.0
    grown = wide.driven.rad - known.driven.rad
    assert (np.abs(grown[:, 0] - known.pushes) <= 1e-9 * known.pushes).all()
    assert not grown[:, 1:].any()


def test_what_rows_are_off_by_is_in_every_bound_and_counts_once() -> None:
    """Rows and integrals that are moved by as much as they may be off, to the corners that matter."""
    plain, off = worst("constant"), 1e-3
    deviation, signal = np.array([0.02, -0.05, 0.03]), np.array([[0.5, -0.2, 0.4, -0.1]])
    times = np.array([0.3, 2.2, 4.0])

    def moved(of_state: np.ndarray, of_input: np.ndarray, wide: float) -> Worst:
        known = plain.adjoint

        def at(t: np.ndarray) -> Enclosed:
            rows = known.at(t)
            return Enclosed(rows.mid + of_state, rows.rad + wide)

        def between(t: np.ndarray, start: np.ndarray | float, stop: np.ndarray | float) -> Enclosed:
            part = known.between(t, start, stop)
            sign = np.ones((len(part.mid), 2))  # of what is driven and signalled on each piece, so that nothing cancels
            if np.ndim(start):
                sign[:, 1] = np.sign(signal[0])
            else:
                sign[:, 0] = np.sign(plain.drives.mid[0, np.searchsorted(GRID, start)])
            return Enclosed(part.mid + of_input * sign, part.rad + wide)

        stub = SimpleNamespace(at=at, between=between, step=known.step, count=known.count)
        return replace(plain, adjoint=cast(Adjoint, stub))

    sides = np.sign(plain.centre)
    up, down = (moved(side * off * sides, side * off * np.ones(2), 0.0) for side in (1.0, -1.0))
    blurred = moved(np.zeros(3), np.zeros(2), off)
    for t in times.tolist():
        low, high = blurred.along(t, deviation, GRID, signal)
        assert low <= down.along(t, deviation, GRID, signal)[0] + 1e-12
        assert high >= up.along(t, deviation, GRID, signal)[1] - 1e-12
        assert high - low <= up.along(t, deviation, GRID, signal)[1] - down.along(t, deviation, GRID, signal)[0] + 1e-9
    # with sets, whose support functions may be more than is met; and without
    for some, slack in ((lambda one: one, 8e-3), (lambda one: replace(one, pushed=None, begun=None), 1e-9)):
        tops, highest = some(blurred).most(times)[0], some(up).most(times)[0]
        assert (highest <= tops + 1e-12).all()
        assert (tops <= highest + slack).all()


def told(monkeypatch: pytest.MonkeyPatch, unit: float, half: float, outward: float) -> None:
    """Let the module believe that its arithmetic is as coarse as it is told."""
    monkeypatch.setattr(module, "rounding", lambda count: count * unit)
    monkeypatch.setattr(module, "HALF_ULP", half)
    monkeypatch.setattr(module, "OUTWARD", outward)


COARSE = 1e-6


def radii(kind: str) -> dict[str, np.ndarray]:
    """Every radius that is told of one row, in a name each."""
    row = worst(kind)
    known, times = row.adjoint, np.array([0.3, 2.2, 3.99])
    sums, rounded = known.integrals(times)
    low, high = row.along(2.2, np.array([0.05, 0.02, -0.01]), GRID, np.array([[0.5, -0.2, 0.1, 0.3]]))
    found = {
        "at": known.at(times).rad,
        "driven": known.driven.rad,
        "sums": known.sums.rad[1:],
        "integrals": sums.rad,
        "rounded": rounded,
        "between": known.between(times, 0.1, 0.2).rad,
        "drives": row._driven(times)[1],
        "most": row.most(times)[1],
        "along": np.array([high - low]),
        "supported": module._supported(Box([-0.2], [0.5]), Enclosed(np.array([[0.7]]), np.array([[1e-9]])))[1],
    }
    if kind == "measurable":
        found |= {"swept": row._swept[1][1:], "part": row._part(np.array([3, 9]), np.array([0.25, 0.75]))[1]}
        found["measurable"] = row._measurable(times)[1]
    return found


@pytest.mark.parametrize("kind", ["constant", "measurable"])
def test_what_rounding_may_lose_is_in_every_radius(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sum of ``n`` products is off by at most ``n u`` of the sum of their sizes (Higham 2002, section 3.1): with a
    unit that is told, every radius is at least that, of the sizes that are summed up."""
    with monkeypatch.context() as patched:
        told(patched, 0.0, 0.0, 1.0)
        plain, row = radii(kind), worst(kind)
        known, times = row.adjoint, np.array([0.3, 2.2, 3.99])
        steps, shares = known.placed(times)
        d, order = 3, module.ORDER
        sizes = np.abs(known.nodes.mid[steps])
        terms = np.einsum("kd,jdn->kjn", sizes, np.abs(known.motion.rows.mid))
        powers = shares[:, None] ** np.arange(order + 1)
        at = np.einsum("kjn,kj->kn", terms, powers)
        values = np.abs(known.at(times).mid)
        driven = np.abs(known.nodes.mid[:-1]) @ np.abs(known.motion.inputs.mid).transpose(1, 0, 2).reshape(d, -1)
        driven = driven.reshape(-1, order + 1, 2)
        moved = known.step * np.einsum("kjq,j->kq", np.abs(known.driven.mid), 1.0 / np.arange(1.0, order + 2.0))
        part = known.between(times, 0.7, 1.9)
        used = np.abs(part.mid[1:, :1]) @ np.array([1.0])  # of the second drive, which is -1
        states = np.abs(known.at(times).mid) @ np.abs(row.centre)
    with monkeypatch.context() as patched:
        told(patched, COARSE, 0.0, 1.0)
        rough = radii(kind)
    more = {name: (rough[name] - plain[name]) / COARSE for name in plain}
    share = 1.0 - 1e-6
    assert (more["at"] >= share * d * at).all()
    assert (more["at"] >= share * 3 * order * values).all()
    assert (more["driven"] >= share * d * driven).all()
    assert (more["sums"] >= share * (order + 2) * np.cumsum(moved, axis=0)).all()
    assert (more["integrals"] >= share * (order + 2) * np.cumsum(moved, axis=0)[np.maximum(steps - 1, 0)]).all()
    assert (more["drives"][1:] >= share * (1 + GRID.size) * used).all()
    assert (more["most"] >= 3.0 * share * d * states).all()
    assert (more["along"] >= 2.0 * share * d * states[1]).all()
    assert more["supported"] == pytest.approx([0.7 * 0.5], rel=1e-6)
    for name, each in more.items():
        assert (each[..., :1] > 0.0).any(), name


@pytest.mark.parametrize("kind", ["constant", "measurable"])
def test_every_radius_is_enlarged_by_what_its_own_sum_may_round(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        told(patched, COARSE, 0.0, 1.0)
        plain = radii(kind)
    with monkeypatch.context() as patched:
        told(patched, COARSE, 0.0, 2.0)
        outward = radii(kind)
    for name in plain:
        if name in ("drives", "measurable"):  # whoever adds these up enlarges their sum
            continue
        larger = plain[name] > 0.0
        assert larger.any() and (outward[name][larger] >= 1.999 * plain[name][larger]).all(), name
    with monkeypatch.context() as patched:
        told(patched, 0.0, 0.0, 1.0)
        plain = radii(kind)
    with monkeypatch.context() as patched:
        told(patched, 0.0, COARSE, 1.0)
        half = radii(kind)
    values = np.abs(worst(kind).most(np.array([0.3, 2.2, 3.99]))[0])
    assert (half["most"] - plain["most"] >= 3.0 * 8.0 * COARSE * values * 0.99).all()
    assert (half["along"] > plain["along"]).all()
    assert (half["rounded"] > plain["rounded"]).all() and (half["between"] > plain["between"]).all()


@pytest.mark.parametrize("rate", [2.0, 5.0])
def test_what_is_left_of_the_expansion_of_a_bend_is_in_its_bound(rate: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """``l = e^{a s}`` grows on every step, so that its bend is largest at the end; one term is expanded."""
    monkeypatch.setattr(module, "BENDING", 0)
    known = Adjoint.of(Motion.of(arb_mat([[rate]]), arb_mat([[1.0]]), HORIZON, Clock()), np.ones(1))
    ends = known.nodes.mid[1:, 0]
    rows, once, twice = (part[:, 0] for part in known.bends)
    for bound, power in ((rows, 2), (once, 1), (twice, 2)):
        assert (rate**power * ends <= bound).all()
        assert (bound <= rate**power * ends * (1.0 + 1e-9)).all()
