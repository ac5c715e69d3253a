"""Guards checker/reach/varying/flow: balls around the flow of a system that changes with time hold closed forms, also
where the series are cut short, and stay narrow over many pieces."""

from __future__ import annotations

from dataclasses import replace
from decimal import Decimal
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("flint")
import sparserob_core.checker.reach.varying.flow as varying
from flint import arb, arb_poly, arb_series, ctx
from sparserob_core.checker.arithmetic.timed import Timed
from sparserob_core.checker.reach.varying.flow import VaryingFlow, products

from sparserob_core.checker.arithmetic.models import kepler_root, kepler_series
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.reach.varying.loop import VaryingLoop
from sparserob_core.control.problem.system import VaryingSystem
from tests.support.integration import mathieu

FADING = VaryingSystem.of([["-1/(1 + t)"]], [["t", 1]], 3.0, [["2 - t"]], c=["3*t^2"])
BITS = 160


def exact(start: float, stop: float) -> list[arb]:
    """The state's factor, and what both controls, the drift and the disturbance bring, in balls of their own."""
    a, b = arb(start), arb(stop)

    def primitive(*powers: int) -> arb:
        """The integral of ``(1 + t) (c_0 + c_1 t + ...)``."""
        total = arb(0)
        for k, c in enumerate(powers):
            for j in (k + 1, k + 2):
                total += c * (b**j - a**j) / j
        return total

    driven = [primitive(0, 1), primitive(1), primitive(0, 0, 3), primitive(2, -1)]
    return [(1 + a) / (1 + b), *(one / (1 + b) for one in driven)]


@pytest.mark.parametrize(("start", "stop"), [(0.0, 0.125), (0.5, 1.75), (0.0, 3.0), (2.0, 2.25)])
def test_balls_hold_the_closed_form_and_are_narrow(start: float, stop: float) -> None:
    with ctx.workprec(BITS):
        Phi, B, E = Flow(Plant.of(FADING, 3.0), 3.0).over(start, stop)
        for ball, truth in zip([Phi[0, 0], B[0, 0], B[0, 1], B[0, 2], E[0, 0]], exact(start, stop), strict=True):
            assert ball.overlaps(truth) and float(ball.rad()) < 1e-24
            assert abs(float((ball - truth).mid())) <= float(ball.rad()) + float(truth.rad())


@pytest.mark.parametrize(("name", "value"), [("TERMS", (3,)), ("TERMS", (6,)), ("ORDER", 1), ("ORDER", 3)])
def test_balls_hold_the_closed_form_where_series_are_cut_short(
    name: str, value: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(varying, "SHARP", 1.0)
    monkeypatch.setattr(varying, name, value)
    with ctx.workprec(BITS):
        flow, wide = Flow(Plant.of(FADING, 3.0), 3.0), 0.0
        for start in np.linspace(0.0, 2.5, 11):
            Phi, B, E = flow.over(float(start), float(start) + 0.375)
            balls = [Phi[0, 0], B[0, 0], B[0, 1], B[0, 2], E[0, 0]]
            assert all(one.overlaps(other) for one, other in zip(balls, exact(start, start + 0.375), strict=True))
            wide = max(wide, *(float(one.rad()) for one in balls))
        assert wide > 1e-12, "nothing was left out"


def test_what_a_series_leaves_out_widens_every_entry_in_its_units() -> None:
    """With tails that are told: 1 of the state, 2 of what is forced, and nothing beside them."""
    with ctx.workprec(BITS):
        flow = Flow(Plant.of(FADING, 3.0), 3.0)
        (segment, *_) = flow.segments
        still = replace(segment, left=[[arb(0)] * len(row) for row in segment.left])
        table = [[(entry(arb_poly([0, 1]))).coeffs() for entry in row] for row in still.law]
        tails = SimpleNamespace(sizes=[arb(0)], of=lambda count, forced: arb(1 if forced is None else 2))
        found = flow._left_out([[arb(0)] * len(table[0])], still, table, arb(1), tails, 3)
        (u,) = flow.units
        expected = [1.0, *[2.0 * u] * (len(table[0]) - 1)]
        for ball, size in zip(found.entries(), expected, strict=True):
            assert size <= float(ball.rad()) <= size * 1.001


def test_what_is_left_of_an_expansion_is_in_every_entry_of_what_an_interval_makes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With rests that are told, one for each entry; what is beyond an order joins them."""
    with ctx.workprec(BITS):
        flow = Flow(Plant.of(FADING, 3.0), 3.0)
        stop = 0.5 * flow.segments[0].stop
        terms, rest = flow._series(flow.segments[0], 0.0, stop)
        sizes = [1.0 + i for i in range(rest.ncols())]
        told = stacked([[arb(0, size) for size in sizes]])
        monkeypatch.setattr(VaryingFlow, "_series", lambda *_: (terms, told))
        Phi, both = flow._within(flow.segments[0], 0.0, stop)
        wide = [float(x.rad()) for x in [*Phi.entries(), *both.entries()]]
        assert all(size <= found <= size * 1.001 for size, found in zip(sizes, wide, strict=True))
        kept, left = flow.within(0.0, stop, 1)
        assert len(kept) == 2
        beyond = [sum(abs(float(term[0, i].mid())) for term in terms[2:]) for i in range(rest.ncols())]
        for size, more, found in zip(sizes, beyond, left.entries(), strict=True):
            assert (size + more) * (1 - 1e-9) <= float(found.rad()) <= (size + more) * 1.001


def test_a_chord_of_a_loop_is_missed_by_its_powers_and_twice_what_is_left_of_them() -> None:
    """``2 s^2`` and ``-3 s^3`` of a nominal state of 1, a rest from -0.5 to -0.1, and half of all of it for a deviation
    of 4."""
    told = SimpleNamespace(
        _flow=SimpleNamespace(within=lambda *_: ([stacked([[arb(x), arb(0)]]) for x in (1, 5, 2, -3)], told_rest)),
        state=lambda *_: stacked([[arb(1), arb(0.5)]]),
        drives=[stacked([[arb(7), arb(7)]])],
        radii=np.array([4.0]),
    )
    told_rest = stacked([[arb(-0.3, 0.2), arb(0)]])
    with ctx.workprec(BITS):
        bound = VaryingLoop.bent(told, 0, 0.0, 1.0, np.array([[1.0]]))
    share = np.linspace(0.0, 1.0, 10001)
    chords = [float((share - share**n).max()) for n in (2, 3)]
    expected = (2 * chords[0] + 3 * chords[1] + 2 * 0.5) * (1.0 + 0.5 * 4.0)
    assert expected * (1 - 1e-7) <= bound[0] <= expected * (1 + 1e-6)


def test_nothing_is_said_beyond_what_was_expanded() -> None:
    with ctx.workprec(BITS), pytest.raises(Unchecked, match="not known"):
        Flow(Plant.of(FADING, 3.0), 3.0).over(2.5, float(np.nextafter(3.0, 4.0)))


def test_a_series_that_is_too_short_is_no_expansion() -> None:
    with pytest.raises(Unchecked, match="no expansion"):
        Timed(arb_series([1, 2], 3)).coefficients(4)


def test_the_weights_of_many_pieces_are_products_of_their_flows() -> None:
    grid = np.linspace(0.0, 3.0, 38).tolist()  # an odd number of pieces on some levels
    with ctx.workprec(BITS):
        flow = Flow(Plant.of(FADING, 3.0), 3.0)
        weights = flow.weights(grid)
        assert weights.free[0, 0].overlaps(exact(0.0, 3.0)[0]) and float(weights.free[0, 0].rad()) < 1e-22
        for k in (0, 1, 17, 36):
            after = exact(grid[k + 1], 3.0)[0]
            assert weights.control[k][0, 1].overlaps(after * exact(grid[k], grid[k + 1])[2])
            assert weights.disturbance[k][0, 0].overlaps(after * exact(grid[k], grid[k + 1])[4])


def test_mathieus_equation_agrees_with_fifty_digits() -> None:
    system = VaryingSystem.of([[0, 1], ["-(1.5 - 0.75*cos(2*t))", 0]], [[0], [1]], 3.0)
    with ctx.workprec(BITS):
        Phi = Flow(Plant.of(system, 3.0), 3.0).over(0.0, 3.0)[0]
        for row, truth in zip(Phi.tolist(), mathieu("1.5", "0.375", Decimal(3)), strict=True):
            for ball, value in zip(row, truth, strict=True):
                assert abs(float(ball.mid()) - value) <= 2e-16 * max(1.0, abs(value)) and float(ball.rad()) < 1e-24


@pytest.mark.parametrize(("M", "e"), [(0.0, 0.9), (0.3, 0.9), (-5.0, 0.2), (40.0, 0.99), (1.0, 0.0)])
def test_keplers_equation_is_solved_in_balls(M: float, e: float) -> None:
    with ctx.workprec(BITS):
        E = kepler_root(arb(M), arb(e))
        assert (E - arb(e) * E.sin()).overlaps(arb(M)) and float(E.rad()) < 1e-36
        before, ctx.cap = ctx.cap, 9
        try:
            anomaly = arb_series([arb(M), 2, 1], 9)
            found = kepler_series(anomaly, e, 9)
            left = found - arb_series([arb(e)], 9) * found.sin() - anomaly
            assert all(left[k].contains(0) and float(left[k].rad()) < 1e-20 for k in range(9))
            wide = kepler_series(arb_series([arb(M).union(arb(M + 2**-20)), 2, 1], 9), e, 9)
            other = kepler_series(arb_series([arb(M + 2**-21), 2, 1], 9), e, 9)
            assert all(wide[k].contains(other[k]) and wide[k].contains(found[k]) for k in range(9))
        finally:
            ctx.cap = before


@pytest.mark.slow
def test_a_slow_part_has_units_of_its_own_and_balls_hold_what_shorter_parts_make() -> None:
    terms = ["-1 / (1 - 0.9 * cos(kepler(t, 0.9)))^3", "exp(-t)"]
    system = VaryingSystem.of([[0, 1], [terms[0], 0]], [[0], [1]], 2 * np.pi, [[terms[1]], [0]])
    with ctx.workprec(BITS):
        flow = VaryingFlow(system, system.horizon)
        slow = max(flow.segments, key=lambda one: one.units[0])
        assert slow.units[0] > flow.units[0] and len(flow.segments) < 240  # 246 in the units of the pericentre
        ends = [slow.start, *np.linspace(slow.start, slow.stop, 9).tolist()[1:-1], slow.stop]
        whole, parts = flow.over(slow.start, slow.stop), [flow.over(*each) for each in pairwise(ends)]
        after = products([part[0] for part in parts])
        pushed = [sum((Z * part[k] for Z, part in zip(after[2:], parts[1:], strict=True)), after[1] * parts[0][k])
                  for k in (1, 2)]  # fmt: skip
        for mine, other in zip(whole, (after[0], *pushed), strict=True):
            for one, two in zip(mine.entries(), other.entries(), strict=True):
                assert one.overlaps(two) and one.rad() < 1e-18 * (1 + abs(two))
        assert flow.over(slow.start, slow.stop)[0] is whole[0] and len(flow._whole) == 1
