"""Guards checker/reach/tube and checker/reach/states: polynomials on cells of time and boxes of parameters are above
the worst case, by closed forms and by an integrator, close on small cells, and where series are cut short."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("flint")
from flint import arb, arb_mat, ctx

import sparserob_core as sr
import sparserob_core.checker.flow.law as laws
import sparserob_core.checker.flow.segment as segments
import sparserob_core.checker.reach.tube as tubes
from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.arithmetic.series import Series
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.law import ParameterBox
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.flow.segment import VerifiedSegment
from sparserob_core.checker.problem.held import HeldComponents
from sparserob_core.checker.reach.states import Lines, Scene, States, _list_blocks, enclosed, ring
from sparserob_core.checker.reach.tube import Polynomial, ProjectedStates, VerifiedTube
from sparserob_core.checker.sets.polynomials import Enclosed
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.control.sets.sets import Ellipsoid, NormBall
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from tests.checker.flow.test_flow import BOTH, NONE, ONE, POINT, integrated, moving, spring, turned

FADING = VaryingSystem.of([["-1/(1 + t)"]], [["t"]], 3.0, [["2 - t", "1"]], c=["3*t^2"])
GRID = [0.0, 0.25, 0.75, 1.0, 1.5, 1.75, 2.5, 3.0]
CONTROL = [1.0, -0.5, 0.75, -2.0, 0.5, 1.0, -1.0]
CHANGES = [0.0, 0.75, 1.5]  # pieces of the disturbance, some of which are several of the grid
CENTRE, WIDTH = 0.5, 0.25
NOISES: list[ConvexSet] = [Box([-0.2, -0.1], [0.3, 0.1]), Ellipsoid([0.0, 0.1], [[0.04, 0.01], [0.01, 0.02]])]
Z = np.array([[1.0], [-0.5]])


def moved(times: Array, powers: list[float], starts: Array | float) -> Array:
    """The integral of ``(1 + s) (c_0 + c_1 s + ...)`` from ``starts`` to ``times``."""
    total = np.zeros_like(times)
    for k, c in enumerate(powers):
        for j in (k + 1, k + 2):
            total = total + c * (times**j - starts**j) / j
    return total


def worst(times: Array, noise: ConvexSet) -> Array:
    """``max z x(t)`` for both ``z``, ``(2, T)``: ``(1 + t) x`` is the integral of ``(1 + t)`` times what drives it."""
    state = CENTRE + moved(times, [0, 0, 3], 0.0)
    for a, b, u in zip(GRID[:-1], GRID[1:], CONTROL, strict=True):
        state = state + u * moved(np.clip(times, a, b), [0, 1], a)
    found = Z * state + np.abs(Z) * WIDTH
    for a, b in zip(CHANGES, [*CHANGES[1:], 3.0], strict=True):
        pushes = np.stack([moved(np.clip(times, a, b), powers, a) for powers in ([2, -1], [1])], axis=1)
        found = found + np.stack([noise.support(z * pushes) for z in Z[:, 0]])
    return found / (1.0 + times)


def fading(noise: ConvexSet) -> VerifiedTube:
    inputs = [arb_mat([[u], [1]]) for u in CONTROL]
    deviations = Box([-WIDTH], [WIDTH])
    scene = Scene(GRID, inputs, [CENTRE], noise, CHANGES, deviations)
    return VerifiedTube(ProjectedStates(States(VerifiedFlow(Plant.of(FADING, 3.0), 3.0), scene), np.ones((1, 1))), NONE)


def until(seen: VerifiedTube, start: float, stop: float) -> float:
    """The end of a cell from ``start`` that is within one segment."""
    return min([stop, *(end for end in seen.rows.states.marks if end > start)])


def above(poly: Polynomial, shares: Array) -> Array:
    return np.polynomial.polynomial.polyval(shares, poly.coefficients[:, 0]) + poly.error


@pytest.mark.parametrize("noise", NOISES, ids=["box", "ellipsoid"])
def test_the_worst_case_is_below_its_polynomials_and_near_them(noise: ConvexSet) -> None:
    shares = np.linspace(0.0, 1.0, 9)
    with ctx.workprec(192):
        seen = fading(noise)
        for piece, (begin, end) in enumerate(pairwise(GRID)):
            for start, stop in ((begin, end), (begin + 0.1, begin + 0.101), (end, end)):
                stop = until(seen, start, stop)
                found, truths = seen.cells(piece, start, stop, Z), worst(start + shares * (stop - start), noise)
                for poly, truth in zip(found, truths, strict=True):
                    tops = above(poly, shares)
                    assert (truth <= tops + 1e-14).all()
                    # a root of the shape is widened
                    assert (tops <= truth + 2.0 * poly.error + poly.kinks + 1e-12).all()
                    if stop - start < 0.01:
                        assert poly.error + poly.kinks < 1e-5
        (last, _) = seen.cells(len(GRID) - 1, 3.0, 3.0, Z)
        assert abs(last.coefficients[0, 0] - worst(np.array([3.0]), noise)[0, 0]) <= last.error < 1e-12


@pytest.mark.parametrize(
    ("module", "name", "value"), [(segments, "TERMS", 4), (laws, "ORDER", 2), (tubes, "ORDER", 2), (tubes, "ORDER", 1)]
)
def test_what_a_series_leaves_out_is_in_the_error(
    module, name: str, value: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if module is not tubes:
        monkeypatch.setattr(laws, "SHARP", 1e-6)
    monkeypatch.setattr(module, name, value)
    shares, off = np.linspace(0.0, 1.0, 17), 0.0
    with ctx.workprec(192):
        seen = fading(NOISES[0])
        for piece, start, stop in ((0, 0.0, 0.25), (1, 0.25, 0.75), (4, 1.5, 1.7)):
            stop = until(seen, start, stop)
            truths = worst(start + shares * (stop - start), NOISES[0])
            for poly, truth in zip(seen.cells(piece, start, stop, Z), truths, strict=True):
                assert (truth <= above(poly, shares) + 1e-14).all()
                off = max(off, float((truth - above(poly, shares) + poly.error).max()))
    assert off > 1e-8, "nothing was left out"


SYSTEM = sr.VaryingSystem.of(
    [["-0.5 - p*sin(2*t)"]], [["1 + p^2"]], 3.0, [[1]], parameters=sr.Box([-0.3], [0.6]), names=["p"]
)


def decay(t: Array, p: Array) -> Array:
    """What an initial state of 1 becomes."""
    return np.asarray(np.exp(-t / 2 - p * (1 - np.cos(2 * t)) / 2))


@pytest.mark.parametrize("degree", [2, 6])
def test_polynomials_on_boxes_hold_what_the_closed_form_gives_there(degree: int) -> None:
    """Also on boxes within that of the flow, about their own middles; one that is a single parameter; and such as
    nearly all of it."""
    rng, whole, lost = np.random.default_rng(30), ParameterBox.between([-0.3], [0.6]), []
    with ctx.workprec(192):
        flow = VerifiedFlow(Plant.of(SYSTEM, 3.0), 3.0, whole, degree)
        scene = Scene([0.0, 1.5, 3.0], [arb_mat([[0]])] * 2, [1.0], None, [], sr.Box([-0.1], [0.2]))
        rows = ProjectedStates(States(flow, scene), np.ones((1, 1)))
        for box in (whole, *(ParameterBox.between([a], [b]) for a, b in ((0.1, 0.2), (-0.3, -0.3), (-0.29, 0.1)))):
            tube = VerifiedTube(rows, box)
            assert (tube.flow.centre, tube.flow.radius) == (box.middle, box.halves)
            for start, stop in ((0.0, 0.4), (2.0, 3.0), (3.0, 3.0)):
                stop = until(tube, start, stop)
                (found,) = tube.cells(int(start >= 1.5), start, stop, np.ones((1, 1)))
                s, e = rng.uniform(0.0, 1.0, 50), rng.uniform(-1.0, 1.0, 50)
                s[:2], e[:4] = (0.0, 1.0), (1.0, -1.0, 1.0, -1.0)
                truth = 1.2 * decay(start + s * (stop - start), box.middle[0] + e * box.halves[0])
                told = np.einsum("jm,kj,km->k", found.coefficients, np.vander(s, found.coefficients.shape[0], True),
                                 np.vander(e, degree + 1, increasing=True))  # fmt: skip
                assert (truth <= told + found.error + 1e-14).all()
                assert (told - found.error - found.kinks * 2 <= truth + 1e-9).all()
                lost.append(found.error)
    assert max(lost) < (1.0 if degree == 2 else 3e-3)


EVENTS = [0.0, 0.3, 0.5, 0.8, 1.2, 2.0]
PUSHES = [0.8, -1.0, 0.3, 0.6, -0.4]
BREAKS = [0.0, 0.5, 1.2]
START, BEGUN = np.array([-1.0, 0.5]), NormBall(p=1.0, radius=0.2, dimension=2)
LASTS = HeldComponents(BREAKS, ((slice(0, 1), np.array([0, 1, 2])), (slice(1, 2), np.array([0, 2]))))
PLANTS = {
    "known": (spring(), POINT, 0), "one": (spring(), ONE, 8), "two": (spring(), BOTH, 6), "turns": (turned(), BOTH, 6),
    "few powers": (spring(), BOTH, 1), "moving": (moving(), POINT, 0), "moving, one": (moving(), ONE, 6),
}  # fmt: skip
SETS: dict[str, ConvexSet] = {
    "box": Box([-0.3, -0.1], [0.2, 0.4]),
    "disc": NormBall(p=2.0, radius=0.3, centre=[0.1, 0.0]),
}


def seen_at(system, bound, lasting, begun, c: Array, time: float, p: Array) -> float:
    """``max c'x(time)``, by steps of an integrator backwards from one event to the one before."""
    weights, total, row = np.zeros((len(BREAKS), 2)), 0.0, c
    for k, (left, right) in reversed(list(enumerate(pairwise([*(a for a in EVENTS if a < time), time])))):
        moved = row @ integrated(system, left, right, p)
        total += float(moved[2] * PUSHES[k] + moved[3])
        weights[np.searchsorted(BREAKS, (left + right) / 2) - 1] += moved[4:]
        row = moved[:2]
    for columns, firsts in lasting.parts if lasting is not None else ():
        for piece in reversed(range(len(BREAKS))):
            if piece not in firsts:
                weights[piece - 1, columns] += weights[piece, columns]
                weights[piece, columns] = 0.0
    total += float(row @ START) + (0.0 if begun is None else float(begun.support(row)))
    return total + (0.0 if bound is None else float(bound.support(weights).sum()))


@pytest.mark.parametrize(
    ("name", "noise", "lasting", "part"),
    [
        ("known", "box", False, False), ("known", "disc", True, False), ("one", "box", True, True),
        ("one", None, False, False), ("two", "box", False, True), ("two", "disc", False, False),
        ("turns", "box", True, True), ("few powers", "box", False, False), ("moving", "box", True, False),
        ("moving, one", "disc", True, True),
    ],
)  # fmt: skip
def test_cells_are_above_the_worst_case_of_an_integrator_and_not_far_above(
    name: str, noise: str | None, lasting: bool, part: bool
) -> None:
    """With a drift, an initial set, disturbances that jump elsewhere than the control and of which one lasts longer;
    over the flow's box, or a smaller one about another middle."""
    (system, box, degree), bound, rng = PLANTS[name], None if noise is None else SETS[noise], np.random.default_rng(9)
    small = ParameterBox(tuple(m + 0.4 * h for m, h in zip(box.middle, box.halves, strict=True)),
                         tuple(0.5 * h for h in box.halves)) if part else box  # fmt: skip
    with ctx.workprec(192):
        flow = VerifiedFlow(Plant.of(system, 2.0), 2.0, box, degree)
        inputs = [arb_mat([[u], [1]]) for u in PUSHES]
        lasts = LASTS if lasting else None
        scene = Scene(EVENTS, inputs, START.tolist(), bound, BREAKS if bound else [], BEGUN, lasts)
        tube = VerifiedTube(ProjectedStates(States(flow, scene), np.eye(2)), small)
        assert tube.rows.states.last.shape == (2, 1)
        for piece, (a, b) in list(enumerate(pairwise([*EVENTS, 2.0])))[1::2]:
            start = a + 0.4 * (b - a)
            for stop in {until(tube, start, b), until(tube, start, start + 0.001 * (b - a))}:
                z = rng.normal(size=(2, 2))
                for c, poly in zip(z, tube.cells(min(piece, len(PUSHES) - 1), start, stop, z),
                                   strict=True):  # fmt: skip
                    for share in (0.0, 1.0):
                        delta = rng.choice([-1.0, 1.0], 2) if degree else np.zeros(2)
                        delta = delta * (np.array(small.halves) > 0.0)
                        powers = [np.prod(delta**e) for e in np.array(flow.monomials.exponents)] if degree else [1.0]
                        value = float(share ** np.arange(len(poly.coefficients)) @ poly.coefficients @ powers)
                        p = np.array(small.middle) + np.array(small.halves) * delta
                        truth = seen_at(system, bound, lasts, BEGUN, c, start + share * (stop - start), p)
                        assert truth <= value + poly.error + 1e-11
                        assert value - poly.error - poly.kinks <= truth + 1e-11
                if stop - start < 0.002 and not degree:
                    assert poly.error - poly.kinks < 1e-7


def test_beyond_the_degree_all_is_in_the_error_of_a_state_that_cancels() -> None:
    """``x' = p x``: ``e^p - 1 - p - p^2 / 2`` at the ends, whatever the state and the disturbances are made of."""
    system = sr.LinearSystem(
        lambda p: np.array([[p[0] * 1.0]]), np.ones((1, 1)), np.ones((1, 1)), sr.Box([-1.0], [1.0])
    )
    for bound, begun in ((None, None), (Box([-1.0], [1.0]), None), (None, Box([-1.0], [1.0]))):
        with ctx.workprec(96):
            flow = VerifiedFlow(Plant.of(system, 1.0), 1.0, ParameterBox((0.0,), (1.0,)), 2)
            scene = Scene([0.0, 1.0], [arb_mat([[0]])], [1.0], bound, [0.0] if bound else [], begun)
            (poly,) = VerifiedTube(ProjectedStates(States(flow, scene), np.eye(1)), flow.box).cells(
                0, 1.0, 1.0, np.eye(1)
            )
        for p in (-1.0, 1.0):
            truth = np.exp(p) * (2.0 if begun else 1.0) + (np.expm1(p) / p if bound else 0.0)
            told = float(poly.coefficients[0] @ np.array([1.0, p, p * p]))
            assert truth <= told + poly.error and told - poly.error - 2 * poly.kinks <= truth
        assert poly.error - poly.kinks < 4.0


def test_blocks_of_intervals_are_all_those_before_a_mark() -> None:
    for mark in range(40):
        found = [k for level, number in _list_blocks(mark) for k in range(number << level, (number + 1) << level)]
        assert found == list(range(mark))


def test_effects_are_those_of_every_interval_carried_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """By blocks or one by one: ``Phi(t, t_k) Gamma_k`` by an integrator."""
    with ctx.workprec(192):
        flow = VerifiedFlow(Plant.of(spring(), 2.0), 2.0, POINT)
        scene = Scene(EVENTS, [arb_mat([[u], [1]]) for u in PUSHES], START.tolist(), SETS["box"], BREAKS, BEGUN)
        states = States(flow, scene)
        marks = states.marks
        for mark in range(len(marks)):
            begun, pushed = states.effect(mark)
            whole = integrated(spring(), 0.0, marks[mark], POINT.middle)
            assert (np.abs(begun.mid[0] - whole[:, :2]) <= begun.rad[0] + 1e-12).all()
            assert pushed.mid.shape == (1, 2, 2 * mark) and (pushed.rad < 1e-14).all()
            for k in range(mark):
                onward = integrated(spring(), marks[k + 1], marks[mark], POINT.middle)[:, :2]
                each = onward @ integrated(spring(), marks[k], marks[k + 1], POINT.middle)[:, 4:]
                assert np.abs(pushed.mid[0][:, 2 * k : 2 * k + 2] - each).max() < 1e-12
            node = np.array([float(x.mid()) for x in states.node(mark).matrix.entries()])
            truth = [seen_at(spring(), None, None, None, c, marks[mark], np.array(POINT.middle)) for c in np.eye(2)]
            assert node == pytest.approx(truth, abs=1e-12)


@pytest.mark.parametrize(("count", "degree"), [(0, 0), (1, 2), (2, 2)])
def test_products_of_numbers_hold_those_of_every_two_within_both_and_what_is_beyond(count: int, degree: int) -> None:
    rng, known = np.random.default_rng(4), Monomials(count, degree)
    size = known.size
    (a, da), (b, db) = ((rng.uniform(0.5, 1.0, n), rng.uniform(0.0, 0.3, n)) for n in ((size, 2, 3), (size, 3, 4)))
    found = ring(known, Enclosed(a, da), Enclosed(b, db))
    far, near = ((a + s * da).sum(axis=0) @ (b + s * db).sum(axis=0) for s in (1.0, -1.0))
    mid, rad = found.mid.sum(axis=0), found.rad.sum(axis=0)
    assert (far - mid <= rad).all() and (mid - near <= rad).all()
    assert (rad <= (1.0 + 1e-9) * (far - mid)).all()  # at the corner of all of them nothing cancels
    for _ in range(20):
        s = rng.choice([-1.0, 1.0], count)
        powers = np.array([np.prod(s ** np.array(e)) for e in known.exponents])
        left, right = (np.einsum("m,mij->ij", powers, one + off * rng.uniform(-1, 1, one.shape))
                       for one, off in ((a, da), (b, db)))  # fmt: skip
        value = np.einsum("m,mij->ij", powers, found.mid)
        assert (np.abs(left @ right - value) <= rad + 1e-14).all()
    with ctx.workprec(96):
        series = Series(known, [arb_mat([[arb(float(x)) for x in row] for row in part]) for part in a])
        assert (enclosed([series]).mid[0] == a).all()


@pytest.mark.parametrize("order", [1, 3, 9])
def test_rows_of_a_segment_are_off_by_what_it_is_and_by_the_terms_that_are_not_kept(order: int) -> None:
    """Of positive numbers, for which nothing cancels: at the end of a part all of it is needed."""
    rng = np.random.default_rng(8)
    tables, off, basis = rng.uniform(0.1, 1.0, (6, 2, 3)), rng.uniform(0.1, 1.0, (2, 3)), rng.uniform(0.5, 1.0, (3, 2))
    with ctx.workprec(96):
        terms = [Series.known(arb_mat([[arb(float(x)) for x in row] for row in one])) for one in tables]
        lines = Lines.of(VerifiedSegment(terms, off), basis)
        for first, width in ((0.0, 1.0), (0.3, 0.5), (0.9, 0.0)):
            found = lines.shifted(first, width, order)
            assert len(found.mid) == min(order, len(tables))
            truth = basis @ np.einsum("n,nij->ij", (first + width) ** np.arange(6), tables)
            missed = np.abs(truth - found.mid[:, 0].sum(axis=0)) + basis @ off
            assert (missed <= found.rad.sum(axis=(0, 1)) * (1 + 1e-12)).all()
            assert (found.rad.sum(axis=(0, 1)) <= missed * (1 + 1e-9)).all()
