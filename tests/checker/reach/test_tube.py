"""Guards checker/reach/varying/tube: polynomials on cells of time of systems that change with time are above closed
forms of the worst case, close to them on short cells, and where series are cut short."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("flint")
import sparserob_core as sr
import sparserob_core.checker.flow.law as laws
import sparserob_core.checker.flow.segment as segments
import sparserob_core.checker.reach.tube as tubes
from flint import arb_mat, ctx
from sparserob_core.checker.reach.varying.tube import VaryingTube

from sparserob_core.checker.flow.flow import Flow
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.sets.polynomials import Enclosed
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.control.sets.sets import Ellipsoid
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

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


def tube(noise: ConvexSet) -> VaryingTube:
    inputs = [arb_mat([[u], [1]]) for u in CONTROL]
    deviations = Box([-WIDTH], [WIDTH])
    scene = Scene(GRID, inputs, [CENTRE], noise, CHANGES, deviations)
    return VaryingTube(Flow(Plant.of(FADING, 3.0), 3.0), scene, np.ones((1, 1)))


def until(seen: VaryingTube, start: float, stop: float) -> float:
    """The end of a cell from ``start`` that is within one segment."""
    return min([stop, *(end for end in seen.law.ends if end > start)])


def above(poly: Polynomial, shares: Array) -> Array:
    return np.polynomial.polynomial.polyval(shares, poly.coefficients[:, 0]) + poly.error


@pytest.mark.parametrize("sharp", [False, True])
@pytest.mark.parametrize("noise", NOISES, ids=["box", "ellipsoid"])
def test_the_worst_case_is_below_its_polynomials_and_near_them(noise: ConvexSet, sharp: bool) -> None:
    shares = np.linspace(0.0, 1.0, 9)
    with ctx.workprec(192):
        seen = tube(noise)
        for piece, (begin, end) in enumerate(pairwise(GRID)):
            for start, stop in ((begin, end), (begin + 0.1, begin + 0.101), (end, end)):
                stop = until(seen, start, stop)
                found, truths = seen.cells(piece, start, stop, Z, sharp), worst(start + shares * (stop - start), noise)
                for poly, truth in zip(found, truths, strict=True):
                    tops = above(poly, shares)
                    assert (truth <= tops + 1e-14).all()
                    assert (
                        tops <= truth + 2.0 * poly.error + poly.kinks + 1e-12
                    ).all()  # a root of the shape is widened
                    if stop - start < 0.01:
                        assert poly.error + poly.kinks < 1e-5
        (last, _) = seen.cells(len(GRID) - 1, 3.0, 3.0, Z)
        assert abs(last.coefficients[0, 0] - worst(np.array([3.0]), noise)[0, 0]) <= last.error < 1e-12


@pytest.mark.parametrize("name", ["TERMS", "ORDER", "cell"])
def test_what_a_series_leaves_out_is_in_the_error(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(varying, "SHARP", 1.0)
    monkeypatch.setattr(varying_tube if name == "cell" else varying, "ORDER", 2)
    if name == "TERMS":
        monkeypatch.undo()
        monkeypatch.setattr(varying, "TERMS", (4,))
        monkeypatch.setattr(varying, "SHARP", 1.0)
    shares, off = np.linspace(0.0, 1.0, 17), 0.0
    with ctx.workprec(192):
        seen = tube(NOISES[0])
        for piece, start, stop in ((0, 0.0, 0.25), (1, 0.25, 0.75), (4, 1.5, 1.7)):
            stop = until(seen, start, stop)
            truths = worst(start + shares * (stop - start), NOISES[0])
            for poly, truth in zip(seen.cells(piece, start, stop, Z), truths, strict=True):
                assert (truth <= above(poly, shares) + 1e-14).all()
                off = max(off, float((truth - above(poly, shares) + poly.error).max()))
    assert off > 1e-8, "nothing was left out"


def test_a_product_holds_that_of_every_two_matrices_within_both_and_no_more() -> None:
    rng = np.random.default_rng(4)
    (a, da), (b, db) = ((rng.uniform(0.5, 1.0, size), rng.uniform(0.0, 0.3, size)) for size in ((2, 3, 4), (4, 5)))
    for signs in (np.ones(4), np.array([1.0, -1.0, 1.0, -1.0])):
        found = varying_tube._product(Enclosed(a, da), Enclosed(signs[:, None] * b, db))
        far = (a + da) @ (b + db) if signs.min() > 0.0 else (a + signs * da) @ (signs[:, None] * b + db)
        assert ((far - found.mid) <= found.rad).all()
        if signs.min() > 0.0:
            assert (found.rad <= (1.0 + 1e-9) * (far - found.mid)).all()
    rounded = varying_tube._product(Enclosed(a, 0.0 * a), Enclosed(b, 0.0 * b))
    for place in np.ndindex(rounded.mid.shape):
        pairs = zip(a[place[:-1]].tolist(), b[:, place[-1]].tolist(), strict=True)
        exact = sum((Fraction(x) * Fraction(y) for x, y in pairs), Fraction(0))
        assert abs(exact - Fraction(float(rounded.mid[place]))) <= Fraction(float(rounded.rad[place]))


def test_entries_that_are_ever_other_than_0_are_links() -> None:
    # sin(64 pi t / 3) is 0 at 65 times that are evenly spaced
    system = VaryingSystem.of([["0*t", "sin(67.02064327658225*t)"], [0, 1]], [[0], ["t"]], 3.0, [[0], ["t - t"]])
    with ctx.workprec(128):
        links = {name: part[0].tolist() for name, part in Flow(Plant.of(system, 3.0), 3.0).links.items()}
    assert links == {"A": [[0, 1], [0, 1]], "B": [[0], [1]], "E": [[0], [0]]}
