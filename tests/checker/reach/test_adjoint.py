"""Guards checker/reach/adjoint: rows and integrals against others with more digits, cells against dense samples, and a
witness that is neither more nor less than it is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from flint import arb, arb_mat, ctx

from sparserob_core.checker.flow.segment import VerifiedSegment
from sparserob_core.checker.outcome import Clock, Unchecked
from sparserob_core.checker.reach import adjoint as module
from sparserob_core.checker.reach.adjoint import DEAR, AdjointFlow, AdjointRow, Worst
from sparserob_core.checker.sets import polynomials
from sparserob_core.checker.sets.polynomials import Enclosed
from sparserob_core.control.sets.sets import Box, Polytope

A = [[0.0, 1.0, 0.0], [-9.0, -0.4, 2.0], [0.3, 0.0, -1.5]]
F = [[0.0, 0.2], [1.0, 0.0], [0.0, 1.0]]
C, HORIZON = np.array([1.0, 0.3, -0.5]), 4.0
GRID = np.array([0.0, 0.7, 1.9, 3.1, 4.0])
TIMES = np.array([0.0, 0.3, 1.0, 2.2, 3.99, 4.0])


def adjoint() -> AdjointRow:
    return AdjointRow.of(AdjointFlow.of(arb_mat(A), arb_mat(F), HORIZON, Clock()), C)


def worst() -> Worst:
    drives = Enclosed(np.array([[0.3, -1.0, 0.0, 0.8]]), np.zeros((1, 4)))
    begun = Polytope([[1, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], [0.1, 0.1, 0.1, 0.05, 0.05])
    return Worst(adjoint(), np.array([0.2, -1.0, 0.4]), begun, GRID, drives, Box([-0.2], [0.5]), GRID)


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


def test_cells_bound_every_value_in_them_closely() -> None:
    row = worst()
    times = row.cuts([])
    times = times[times <= HORIZON]
    bounds = row.over(times[:-1], times[1:])
    inside = times[:-1, None] + np.diff(times)[:, None] * np.linspace(0.0, 1.0, 17)
    tops, wide = (part.reshape(inside.shape) for part in row.bound_largest_value(inside.ravel()))
    values = tops - wide
    assert wide.max() < 1e-11
    assert (bounds[:, None] >= values).all()
    assert (bounds - values.max(axis=1)).max() <= 40.0 * np.diff(times).max() ** 2
    chords = np.maximum(values[:, 0], values[:, -1])
    above = values.max(axis=1) - chords
    assert above.max() > 0.1 * (bounds - chords)[above.argmax()]


def test_a_system_that_is_too_fast_is_not_followed() -> None:
    with pytest.raises(Unchecked):
        AdjointFlow.of(arb_mat([[-1e9]]), arb_mat([[1.0]]), 1.0, Clock())


@pytest.mark.parametrize("order", [3, 5])
def test_terms_that_are_left_out_are_in_what_rows_and_inputs_are_off_by(
    order: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With so few terms that what is left out shows: it is added to no more than a few times what it is."""
    motion = AdjointFlow.of(arb_mat(A), arb_mat(F), HORIZON, Clock())
    monkeypatch.setattr(module, "ORDER", order)
    known, times = AdjointRow.of(motion, C), np.arange(1, 64) * motion.step - motion.step / 1024
    rows, (sums, rounded) = known.at(times), known.integrals(times)
    truth = [exact(t) for t in times.tolist()]
    missed = np.array([np.abs(rows.mid[i] - row) for i, (row, _) in enumerate(truth)])
    assert (missed <= rows.rad).all() and missed.max() > 1e-12
    assert rows.rad.max() <= 20.0 * missed.max()
    added = np.array([np.abs(sums.mid[i] - moved) for i, (_, moved) in enumerate(truth)])
    assert (added <= sums.rad + rounded).all()
    heights = [float(np.abs(np.array(truth[i][0]) @ np.array(F)).max()) for i in range(len(truth))]
    assert known.driven.rad.sum(axis=1).max() <= 20.0 * missed.max() * max(heights)


def test_rows_of_a_system_whose_series_ends_are_exact() -> None:
    """``l = (1, s)``, and what an input of 1 adds grows as ``s^2 / 2``."""
    known = AdjointRow.of(
        AdjointFlow.of(arb_mat([[0.0, 1.0], [0.0, 0.0]]), arb_mat([[0.0], [1.0]]), HORIZON, Clock()), C[:2]
    )
    rows, (sums, rounded) = known.at(TIMES), known.integrals(TIMES)
    truth = np.stack([np.full(6, 1.0), TIMES + 0.3], axis=1)
    assert (np.abs(rows.mid - truth) <= rows.rad + 1e-16 * truth).all() and rows.rad.max() < 1e-13
    added = (TIMES**2 / 2.0 + 0.3 * TIMES)[:, None]
    assert (np.abs(sums.mid - added) <= sums.rad + rounded + 1e-15 * added).all() and sums.rad.max() < 1e-13


def test_what_the_flow_is_off_by_on_a_step_is_in_the_terms_of_rows_and_in_those_after_it() -> None:
    motion, off = AdjointFlow.of(arb_mat(A), arb_mat(F), HORIZON, Clock()), np.array([[1.0, 2.0, 3.0]] * 3) * 1e-3
    wide = replace(motion, segment=VerifiedSegment(motion.segment.terms, motion.segment.off + off))
    for terms, of_wide, columns in (
        (motion.rows, wide.rows, np.eye(3)),
        (motion.inputs, wide.inputs, np.array(F)),
        (
            motion.derivative_terms,
            wide.derivative_terms,
            np.hstack([np.array(A) @ A, np.array(A) @ F, np.array(A) @ A @ F]),
        ),
    ):
        more = of_wide.rad - terms.rad
        np.testing.assert_allclose(more[0], off @ np.abs(columns), rtol=1e-6)
        assert not more[1:].any()
    onward = Enclosed.of(wide.over(0)).rad - Enclosed.of(motion.over(0)).rad
    assert (onward >= off * (1.0 - 1e-6)).all()


def test_steps_are_as_long_as_powers_of_the_system_allow_and_not_its_norm() -> None:
    """``[[-1, 40], [0, -2]]`` has powers that are far smaller than those of its norm."""
    slow, fast = (module.choose_step(np.array(one), 1e3) for one in ([[-1.0, 40.0], [0.0, -2.0]], [[-41.0]]))
    assert slow >= 4.0 * fast
    assert module.choose_step(np.zeros((2, 2)), 64.0) == 1.0
    assert module.choose_step(np.array([[0.0, 1e6], [0.0, 0.0]]), 64.0) * 1e6 <= module.LONGEST
    for matrix, speed in (([[-1.0, 40.0], [0.0, -2.0]], 1.0), ([[0.0, 1.0], [-9.0, 0.0]], 3.0)):
        step = module.choose_step(np.array(matrix), 1e3)
        motion = AdjointFlow.of(arb_mat(matrix), arb_mat([[0.0], [speed]]), 1e3, Clock())
        left = motion.segment.first(module.ORDER + 1)[1]
        assert motion.step == step or motion.step >= step / 4.0
        assert left.max() <= 40.0 * 8.0 * module.REST


def test_what_rows_are_off_by_is_in_every_bound_and_counts_once() -> None:
    """Rows and integrals that are moved by as much as they may be off, to the corners that matter."""
    plain, off = worst(), 1e-3
    times = np.array([0.3, 2.2, 4.0])

    def moved(of_state: np.ndarray, of_input: np.ndarray, wide: float) -> Worst:
        known = plain.adjoint

        def at(t: np.ndarray) -> Enclosed:
            rows = known.at(t)
            return Enclosed(rows.mid + of_state, rows.rad + wide)

        def between(t: np.ndarray, start: np.ndarray | float, stop: np.ndarray | float) -> Enclosed:
            part = known.between(t, start, stop)
            sign = np.ones((len(part.mid), 2))  # of what is driven on each piece, so that nothing cancels
            sign[:, 0] = np.sign(plain.drives.mid[0, np.searchsorted(GRID, start)])
            return Enclosed(part.mid + of_input * sign, part.rad + wide)

        stub = SimpleNamespace(at=at, between=between, step=known.step, count=known.count)
        return replace(plain, adjoint=cast(AdjointRow, stub))

    sides = np.sign(plain.centre)
    up, blurred = moved(off * sides, off * np.ones(2), 0.0), moved(np.zeros(3), np.zeros(2), off)
    # with sets, whose support functions may be more than is met; and without
    for some, slack in (
        (lambda one: one, 8e-3),
        (lambda one: replace(one, disturbance_set=None, initial_set=None), 1e-9),
    ):
        tops, highest = some(blurred).bound_largest_value(times)[0], some(up).bound_largest_value(times)[0]
        assert (highest <= tops + 1e-12).all()
        assert (tops <= highest + slack).all()


def told(monkeypatch: pytest.MonkeyPatch, unit: float, half: float, outward: float) -> None:
    """Let the module, and what it multiplies with, believe that its arithmetic is as coarse as it is told."""
    for one in (module, polynomials):
        monkeypatch.setattr(one, "rounding", lambda count: count * unit)
        monkeypatch.setattr(one, "HALF_ULP", half)
        monkeypatch.setattr(one, "OUTWARD", outward)


COARSE = 1e-6


def radii() -> dict[str, np.ndarray]:
    """Every radius that is told of one row, in a name each."""
    row = worst()
    known, times = row.adjoint, np.array([0.3, 2.2, 3.99])
    sums, rounded = known.integrals(times)
    return {
        "at": known.at(times).rad,
        "driven": known.driven.rad,
        "sums": known.sums.rad[1:],
        "integrals": sums.rad,
        "rounded": rounded,
        "between": known.between(times, 0.1, 0.2).rad,
        "drives": row._evaluate_inputs(times)[1],
        "most": row.bound_largest_value(times)[1],
        "supported": module._evaluate_support(Box([-0.2], [0.5]), Enclosed(np.array([[0.7]]), np.array([[1e-9]])))[1],
    }


def test_what_rounding_may_lose_is_in_every_radius(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sum of ``n`` products is off by at most ``n u`` of the sum of their sizes (Higham 2002, section 3.1): with a
    unit that is told, every radius is at least that, of the sizes that are summed up."""
    with monkeypatch.context() as patched:
        told(patched, 0.0, 0.0, 1.0)
        plain, row = radii(), worst()
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
        rough = radii()
    more = {name: (rough[name] - plain[name]) / COARSE for name in plain}
    share = 1.0 - 1e-6
    assert (more["at"] >= share * d * at).all()
    assert (more["at"] >= share * 3 * order * values).all()
    assert (more["driven"] >= share * d * driven).all()
    assert (more["sums"] >= share * (order + 2) * np.cumsum(moved, axis=0)).all()
    assert (more["integrals"] >= share * (order + 2) * np.cumsum(moved, axis=0)[np.maximum(steps - 1, 0)]).all()
    assert (more["drives"][1:] >= share * (1 + GRID.size) * used).all()
    assert (more["most"] >= 3.0 * share * d * states).all()
    assert more["supported"] == pytest.approx([0.7 * 0.5], rel=1e-6)
    for name, each in more.items():
        assert (each[..., :1] > 0.0).any(), name


def test_every_radius_is_enlarged_by_what_its_own_sum_may_round(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        told(patched, COARSE, 0.0, 1.0)
        plain = radii()
    with monkeypatch.context() as patched:
        told(patched, COARSE, 0.0, 2.0)
        outward = radii()
    for name in plain:
        if name == "drives":  # whoever adds these up enlarges their sum
            continue
        larger = plain[name] > 0.0
        assert larger.any() and (outward[name][larger] >= 1.999 * plain[name][larger]).all(), name
    with monkeypatch.context() as patched:
        told(patched, 0.0, 0.0, 1.0)
        plain = radii()
    with monkeypatch.context() as patched:
        told(patched, 0.0, COARSE, 1.0)
        half = radii()
    values = np.abs(worst().bound_largest_value(np.array([0.3, 2.2, 3.99]))[0])
    assert (half["most"] - plain["most"] >= 3.0 * 8.0 * COARSE * values * 0.99).all()
    assert (half["rounded"] > plain["rounded"]).all() and (half["between"] > plain["between"]).all()


@pytest.mark.parametrize("rate", [2.0, 5.0])
def test_what_is_left_of_the_expansion_of_a_bend_is_in_its_bound(rate: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """``l = e^{a s}`` grows on every step, so that its bend is largest at the end; one term is expanded."""
    monkeypatch.setattr(module, "DERIVATIVE_DEGREE", 0)
    known = AdjointRow.of(AdjointFlow.of(arb_mat([[rate]]), arb_mat([[1.0]]), HORIZON, Clock()), np.ones(1))
    ends = known.nodes.mid[1:, 0]
    rows, once, twice = (part[:, 0] for part in known.derivative_bounds)
    for bound, power in ((rows, 2), (once, 1), (twice, 2)):
        assert (rate**power * ends <= bound).all()
        assert (bound <= rate**power * ends * (1.0 + 1e-9)).all()


def test_sums_of_many_numbers_are_rounded_once() -> None:
    values = np.array([[1e16, 0.1], [1.0, 0.1], [-1e16, 0.1], [1.0, -0.3]])
    with ctx.workprec(128):
        found = module.accumulate_exactly(values)
        assert abs(arb(found[4, 1]) - (3 * arb(0.1) - arb(0.3))) < 1e-30
    assert found[:, 0].tolist() == [0.0, 1e16, 1e16 + 1.0, 1.0, 2.0]
    assert module.accumulate_exactly(np.zeros((3, 0))).shape == (4, 0)
