"""Guards the checker's expansion of a state in parameters beside the time, in balls: closed forms are in it, and what
is beyond its degree is bounded by what is said."""

from __future__ import annotations

from math import factorial

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.checker.arithmetic.jets import Monomials
from sparserob_core.checker.arithmetic.series import Series
from sparserob_core.checker.reach.disturbance_support import Scene
from sparserob_core.checker.reach.flow import stacked
from sparserob_core.checker.reach.varying import spread as expansions
from sparserob_core.checker.reach.varying.spread import SpreadFlow, SpreadStates, SpreadTube
from tests.control.reach.test_spread_motion import FILLING, RELAXING, SYSTEM, decay

flint = pytest.importorskip("flint")


def flow(degree: int, system: sr.VaryingSystem = SYSTEM) -> SpreadFlow:
    made = SpreadFlow(system, system.horizon)
    made.__dict__["monomials"] = Monomials(1, degree)
    return made


@pytest.mark.slow
@pytest.mark.parametrize("degree", [2, 5])
def test_what_is_beyond_a_degree_is_bounded(degree: int) -> None:
    law = flow(degree)
    (scale,), (middle,) = law.parts.scales, law.parts.middle
    lost, points, off = float(law.lost(np.ones(1), np.zeros(2))[0]), np.linspace(-0.3, 0.6, 31), 0.0
    for time in (0.7, 1.5, 3.0):
        parts = [float(part[0, 0].mid()) for part in law.over(0.0, time)[0].parts]
        polynomial = np.polynomial.Polynomial(parts)((points - middle) / scale)
        off = max(off, float(np.abs(polynomial - decay(np.array(time), points)).max()))
    assert off <= lost <= 1e3 * off


def test_a_known_parameter_has_the_flow_of_its_own_system() -> None:
    found = SpreadFlow(SYSTEM, 3.0).at([0.4]).over(0.5, 2.0)[0][0, 0]
    exact = (-(flint.arb(1.5) / 2) - flint.arb(0.4) * (flint.arb(1).cos() - flint.arb(4).cos()) / 2).exp()
    assert abs(found - exact) < 1e-12


@pytest.mark.slow
def test_what_transitions_are_off_by_is_counted_degree_by_degree() -> None:
    law, degree, share = flow(20), 20, 1e-3
    exact, points = law.over, np.array(law.marks)

    def less(start: float, stop: float) -> tuple[Series, Series, Series]:
        found, *others = exact(start, stop)
        parts = [part * (1 - share) + stacked([[flint.arb(0, 2 * share * abs(float(part[0, 0].mid())))]])
                 for part in found.parts]  # fmt: skip
        return Series(found.monomials, parts), *others

    middle, unit = law.parts.middle[0], law.parts.scales[0]
    rates = (np.cos(2 * points[:, None]) - np.cos(2 * points)) / 2  # of what transitions are the exponential of
    first = np.exp((points - points[:, None]) / 2 + middle * rates)
    sizes = [np.tril(first * np.abs(unit * rates) ** j / factorial(j)).max() for j in range(degree + 1)]
    assert (law._carried >= np.array(sizes) * (1 - 1e-14)).all()
    assert (law._carried <= np.array(sizes) * 1.02).all()  # to a coefficient of 1e-26
    law = flow(20)
    law.__dict__["over"] = less
    assert (law._carried >= np.array(sizes) * (1 - 1e-14)).all()


def test_what_is_about_beyond_a_degree_is_the_rest_of_an_exponential() -> None:
    found = SpreadFlow._beyond_degrees(np.array([0.3, 0.5]))
    assert found[0] == pytest.approx(np.exp(0.8) - 1)
    assert found[2] == pytest.approx(np.exp(0.8) - 1 - 0.3 - 0.3**2 / 2 - 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("most", [160, 12])
def test_polynomials_on_boxes_hold_what_the_closed_form_gives_there(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expansions, "LEFT", ((1e-14, most),))
    whole = SpreadFlow(SYSTEM, 3.0)
    assert len(whole.divided) == (1 if most == 160 else 4)
    grid, none = [0.0, 1.5, 3.0], stacked([[flint.arb(0)]])
    scene = Scene(grid, [none, none], [1.0], None, [], sr.Box([-0.1], [0.2]), ())
    rng = np.random.default_rng(30)
    asked = [((-0.3,), (0.6,)), ((0.1,), (0.2,)), ((-0.3,), (-0.3,))]
    for ((low,), (high,)), law in [found for box in asked for found in whole.parted(box)]:
        states, cuts = SpreadStates(law, scene), sorted({*grid, *law.ends})
        tube = SpreadTube(states, np.ones((1, 1)), ((low,), (high,)))
        for start, stop in ((cuts[2], cuts[3]), (cuts[-2], (cuts[-2] + 2 * cuts[-1]) / 3)):
            (found,) = tube.cells(int(start >= 1.5), start, stop, np.ones((1, 1)))
            s, e = rng.uniform(0.0, 1.0, 50), rng.uniform(-1.0, 1.0, 50)
            truth = 1.2 * decay(start + s * (stop - start), (low + high) / 2 + e * (high - low) / 2)
            orders = [s**j for j in range(len(found.coefficients))]
            powers = [e ** sum(one) for one in law.monomials.exponents]
            told = np.einsum("jm,jk,mk->k", found.coefficients, orders, powers)
            assert (truth <= told + found.error).all()
            assert (told - found.error - found.kinks * 2 <= truth + 1e-9).all()


@pytest.mark.parametrize("degree", [2, 3, 5])
@pytest.mark.parametrize("name", ["relaxing", "filling"])
def test_what_power_series_leave_of_entries_is_in_what_is_beyond(name: str, degree: int) -> None:
    law = flow(degree, RELAXING if name == "relaxing" else FILLING)
    shares = np.linspace(-1.0, 1.0, 31)
    p = 0.05 + 0.25 * shares
    moved, pushed, shaken = (
        np.polynomial.Polynomial([float(part[0, 0].mid()) for part in one.parts])(shares) for one in law.over(0.0, 2.0)
    )
    gone = np.exp(-2.0 / (1.0 + p)) if name == "relaxing" else np.ones(31)
    exact = [gone, 1.0 - gone if name == "relaxing" else 2.0 / (1.0 + p)]
    for seen, true, begun, inputs in (
        (moved, exact[0], [1.0], [0.0, 0.0]),
        (pushed, exact[1], [0.0], [1.0, 0.0]),
        (moved - 2.0 * pushed, exact[0] - 2.0 * exact[1], [1.0], [2.0, 0.0]),
        *([] if name == "relaxing" else [(shaken, 2.0 * np.exp(p), [0.0], [0.0, 1.0])]),
    ):
        off, lost = float(np.abs(seen - true).max()), float(law.lost(np.array(begun), np.array(inputs))[0])
        assert off <= lost * (1.0 + 1e-9) + 1e-14
        assert lost <= 1e5 * off + 1e-14
    if name == "relaxing":  # of a state that falls to exp(-2.5)
        lost = float(law.lost(np.ones(1), np.zeros(2))[0])
        rest = 1.0 / (1.0 + p) - sum((-0.25) ** n / 1.05 ** (n + 1) * shares**n for n in range(degree + 1))
        bare = flow(degree, RELAXING)
        bare.__dict__["_off"] = tuple(0.0 * one for one in law._off)
        assert lost - float(bare.lost(np.ones(1), np.zeros(2))[0]) >= 2.0 * np.abs(rest).max() * np.exp(-2.5)


ENTRIES = [
    "exp(-p*t)", "1/(1+p)", "sin(p*t)*cos(p)", "sqrt(1+p*cos(t))", "log(2+p*t)", "tan(p*t/4)", "tanh(p+t)",
    "(1+p)^1.5", "p^9*t", "exp(sin(p*t))/(2+p^2)", "(2+p)^(-2)", "(1+t)^p",
    pytest.param("kepler(t+p+p^2, 0.3)", marks=pytest.mark.slow),
]  # fmt: skip


@pytest.mark.parametrize("text", ENTRIES)
def test_what_is_beyond_the_monomials_of_an_entry_is_bounded(text: str) -> None:
    box = sr.Box([-0.3], [0.4])
    system = sr.VaryingSystem.of([[text]], [["1"]], 2.0, [[1]], parameters=box, names=["p"])
    shares, entry = np.linspace(-1.0, 1.0, 41), system.law.entry("A")
    for degree in (1, 4, 7):
        law = flow(degree, system)
        (scale,), (middle,) = law.parts.scales, law.parts.middle
        for start, stop in ((0.0, 0.1), (1.8, 2.0)):
            left, off = law.beyond(system.law, start, stop), 0.0
            assert (left[:, 1:] == 0.0).all()
            for t in (start, (start + stop) / 2, stop):
                found, _ = law.parts.coefficients(entry, np.float64(t), degree)
                seen = sum(float(table[0, 0]) * shares ** len(key) for key, table in found.items())
                exact = [float(entry(np.array([t, middle + scale * s], dtype=object))[0, 0]) for s in shares]
                off = max(off, float(np.abs(seen - exact).max()))
            assert off <= left[0, 0] * (1.0 + 1e-9) + 1e-14
            assert left[0, 0] <= 1e3 * off + 1e-14


def test_boxes_are_cut_where_parts_of_the_parameters_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expansions, "LEFT", ((1e-8, 84),))
    box = sr.Box([-0.3, 0.0, 1.0], [0.6, 0.5, 1.0])
    system = sr.VaryingSystem.of([["-q*r - p*sin(2*t)"]], [[1]], 3.0, [[1]], parameters=box, names=["p", "q", "r"])
    flow = SpreadFlow(system, 3.0)
    assert len(flow.divided) > 2
    for (a, b), part in flow.divided:
        assert part.system.parameters is not None
        within = part.system.parameters.bounding_box()
        assert (within.lower.tolist(), within.upper.tolist()) == (list(a), list(b))
    low, high = (-0.2, 0.1, 1.0), (0.4, 0.5, 1.0)
    pieces = [box for box, _ in flow.parted((low, high))]
    sizes = [np.prod(np.subtract(b, a)[:2]) for a, b in pieces]
    assert sum(sizes) == pytest.approx(0.6 * 0.4)
    for p in np.random.default_rng(30).uniform(low, high, (200, 3)):
        assert any((np.array(a) <= p).all() and (p <= np.array(b)).all() for a, b in pieces)
    for (a, b), part in flow.parted((low, high)):
        assert part.system.parameters is not None
        whole = part.system.parameters.bounding_box()
        assert (whole.lower <= a).all() and (np.array(b) <= whole.upper).all()


SQUARED = sr.VaryingSystem.of(
    [["-0.5 - p^2*sin(2*t)"]], [["(1 + p^2)*exp(-t)"]], 3.0, [[1]], parameters=sr.Box([-0.3], [0.3]), names=["p"]
)


@pytest.mark.parametrize("sharp", [2.0**-100, 1e-2])
def test_transitions_hold_what_is_left_out_of_a_series_whose_higher_powers_of_the_time_are(
    sharp: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(expansions, "SHARP", sharp)
    law, fine = flow(4, SQUARED), flow(4, SQUARED)
    (unit,) = law.parts.scales
    found = {ends: law.over(*ends) for ends in ((0.0, 0.05), (0.3, 0.9), (1.0, 2.9))}
    monkeypatch.undo()
    for (start, stop), (states, pushed, _) in found.items():
        turned = (flint.arb(2 * stop).cos() - flint.arb(2 * start).cos()) / 2  # integral of -sin(2 t)
        still = ((flint.arb(start) - flint.arb(stop)) / 2).exp()
        for j, part in enumerate(states.parts):
            exact = still * (flint.arb(unit) ** 2 * turned) ** (j // 2) / factorial(j // 2) if j % 2 == 0 else 0
            assert part[0, 0].overlaps(flint.arb(exact))
            assert float(part[0, 0].rad()) < (3.0 if sharp > 1e-9 else 1e-14)
        for one, other in zip(pushed.parts, fine.over(start, stop)[1].parts, strict=True):
            assert one[0, 0].overlaps(other[0, 0])
        exact = still * 2 * (1 - ((flint.arb(start) - flint.arb(stop)) / 2).exp()) * (-flint.arb(start)).exp()
        assert pushed.parts[0][0, 0].overlaps(exact)  # of e^(-t / 2) and e^-t


def test_what_is_left_out_of_what_inputs_do_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    still = sr.VaryingSystem.of(
        [["0"]], [["p^2 + 2*cos(t)^2"]], 3.0, [[1]], parameters=sr.Box([-0.3], [0.3]), names=["p"]
    )
    monkeypatch.setattr(expansions, "SHARP", 0.3)
    law = flow(2, still)
    monkeypatch.setattr(law, "_kept", lambda states, inputs: 1)
    for start, stop in ((0.0, 0.2), (0.3, 0.5), (1.0, 1.2)):
        exact = flint.arb(stop) - flint.arb(start) + (flint.arb(2 * stop).sin() - flint.arb(2 * start).sin()) / 2
        assert law.over(start, stop)[1].parts[0][0, 0].contains(exact)
