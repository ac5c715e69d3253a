"""Guards checker/flow/flow: balls around the flow of a system hold closed forms and what an integrator says, of what is
constant, switched, changes with time, is uncertain, stiff or small, also where series are cut short."""

from __future__ import annotations

from decimal import Decimal
from fractions import Fraction
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("flint")
from flint import arb, arb_mat, ctx
from scipy.integrate import solve_ivp

import sparserob_core as sr
import sparserob_core.checker.flow.flow as flows
import sparserob_core.checker.flow.law as laws
import sparserob_core.checker.flow.segment as segments
from sparserob_core.checker.arithmetic.series import Series, stacked
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.law import ParameterBox
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.reach.closed_loop import VerifiedLoop
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, VaryingSystem
from sparserob_core.sip.expressions.expression import parse_matrix
from tests.support.integration import mathieu

FADING = VaryingSystem.of([["-1/(1 + t)"]], [["t", 1]], 3.0, [["2 - t"]], c=["3*t^2"])
BITS = 192


def of(system, until, box=None, degree=0) -> VerifiedFlow:
    return VerifiedFlow(Plant.of(system, until), until, box or ParameterBox(), degree)


def at(one: Series, point) -> arb_mat:
    used = np.asarray(point, dtype=float)[: one.monomials.count]
    powers = [np.prod(used ** np.array(e, dtype=int)) for e in one.monomials.exponents]
    return sum((part * arb(float(p)) for part, p in zip(one.parts, powers, strict=True)), one.parts[0] * 0)


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


def entries(flow: VerifiedFlow, start: float, stop: float) -> list[arb]:
    Phi, B, E = flow.over(start, stop)
    return Phi.append_columns(B).append_columns(E).matrix.entries()


@pytest.mark.parametrize(("start", "stop"), [(0.0, 0.125), (0.5, 1.75), (0.0, 3.0), (2.0, 2.25), (1.5, 1.5)])
def test_balls_hold_the_closed_form_and_are_narrow(start: float, stop: float) -> None:
    with ctx.workprec(BITS):
        for ball, truth in zip(entries(of(FADING, 3.0), start, stop), exact(start, stop), strict=True):
            assert ball.overlaps(truth) and float(ball.rad()) < 1e-24
            assert abs(float((ball - truth).mid())) <= float(ball.rad()) + float(truth.rad())


@pytest.mark.parametrize(
    ("module", "name", "value"),
    [(segments, "TERMS", 3), (segments, "TERMS", 6), (laws, "ORDER", 2), (laws, "SHARP", 1e-6)],
)
def test_balls_hold_the_closed_form_where_series_are_cut_short(
    module, name: str, value: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(laws, "SHARP", 1e-6)  # or stretches become so short that nothing is left out
    monkeypatch.setattr(module, name, value)
    with ctx.workprec(BITS):
        flow, wide = of(FADING, 3.0), 0.0
        for start in np.linspace(0.0, 2.5, 11):
            balls = entries(flow, float(start), float(start) + 0.375)
            assert all(one.overlaps(other) for one, other in zip(balls, exact(start, start + 0.375), strict=True))
            wide = max(wide, *(float(one.rad()) for one in balls))
        assert wide > 1e-12, "nothing was left out"


def test_a_chord_of_a_loop_is_missed_by_its_powers_and_twice_what_is_left_of_them() -> None:
    """``2 s^2`` and ``-3 s^3`` of a nominal state of 1, off by up to 0.5, and half of all of it for a deviation of
    4."""
    told = SimpleNamespace(
        flow=SimpleNamespace(
            within=lambda *_: (
                [Series.known(stacked([[arb(x), arb(0)]])) for x in (1, 5, 2, -3)],
                np.array([[0.5, 0.0]]),
            )
        ),
        state=lambda *_: stacked([[arb(1), arb(0.5)]]),
        drives=[stacked([[arb(7), arb(7)]])],
        deviations=SimpleNamespace(radii=np.array([4.0])),
    )
    with ctx.workprec(BITS):
        bound = VerifiedLoop.bound_chord_error(told, 0, 0.0, 1.0, np.array([[1.0]]))
    share = np.linspace(0.0, 1.0, 10001)
    chords = [float((share - share**n).max()) for n in (2, 3)]
    expected = (2 * chords[0] + 3 * chords[1] + 2 * 0.5) * (1.0 + 0.5 * 4.0)
    assert expected * (1 - 1e-7) <= bound[0] <= expected * (1 + 1e-6)


def test_nothing_is_said_beyond_what_was_expanded() -> None:
    with ctx.workprec(BITS):
        late = float(np.nextafter(3.0, 4.0))
        flow = of(FADING, 3.0)
        for ask in (flow.over, flow.step, flow.kernel, flow.sizes, flow.kind, flow.segment):
            for start, stop in ((2.5, late), (-0.1, 0.1), (1.0, 0.5)):
                with pytest.raises(Unchecked, match="not known"):
                    ask(start, stop)
        first = flow.law.stretches[0].stop
        for ask in (flow.step, flow.kernel, flow.segment):
            with pytest.raises(Unchecked, match="no polynomial"):
                ask(0.0, float(np.nextafter(first, 4.0)))


def test_an_interval_of_what_does_not_change_is_no_longer_than_its_polynomial() -> None:
    with ctx.workprec(BITS):
        flow = of(LinearSystem(np.array([[3.0]]), np.ones((1, 1))), 4.0)
        stride = flow.law.stretches[0].stride
        assert stride == 0.5
        flow.segment(1.0, 1.5)
        flow.segment(1.0, float(np.nextafter(1.5, 2.0)))  # an end that is rounded
        with pytest.raises(Unchecked, match="no polynomial"):
            flow.segment(1.0, 1.5 + 1e-6)
        assert flow.kind(0.0, 0.25) == flow.kind(1.0, 1.25) != flow.kind(0.0, 0.5)
        assert flow.kind(1e-18, 0.5) != flow.kind(0.0, 0.5)  # which are not equally long, though 0.5 - 1e-18 is rounded


def test_the_weights_of_many_pieces_are_products_of_their_flows() -> None:
    grid = np.linspace(0.0, 3.0, 38).tolist()  # an odd number of pieces on some levels
    with ctx.workprec(BITS):
        flow = of(FADING, 3.0)
        weights = flow.weights(grid)
        assert weights.free[0, 0].overlaps(exact(0.0, 3.0)[0]) and float(weights.free[0, 0].rad()) < 1e-22
        for k in (0, 1, 17, 36):
            after = exact(grid[k + 1], 3.0)[0]
            assert weights.control[k][0, 1].overlaps(after * exact(grid[k], grid[k + 1])[2])
            assert weights.disturbance[k][0, 0].overlaps(after * exact(grid[k], grid[k + 1])[4])


def test_mathieus_equation_agrees_with_fifty_digits() -> None:
    system = VaryingSystem.of([[0, 1], ["-(1.5 - 0.75*cos(2*t))", 0]], [[0], [1]], 3.0)
    with ctx.workprec(BITS):
        Phi = of(system, 3.0).over(0.0, 3.0)[0].matrix
        for row, truth in zip(Phi.tolist(), mathieu("1.5", "0.375", Decimal(3)), strict=True):
            for ball, value in zip(row, truth, strict=True):
                assert abs(float(ball.mid()) - value) <= 2e-16 * max(1.0, abs(value)) and float(ball.rad()) < 1e-24


NAMES = ("p1", "p2")
UNSURE = sr.Box([-0.1, -0.1], [0.1, 0.1])


def spring(spread: float = 0.1) -> LinearSystem:
    box, names = sr.Box([-spread, -spread], [spread, spread]), NAMES
    A, B, E, c = (parse_matrix(name, rows, names) for name, rows in (
        ("A", [["0", "1"], ["-2 + p1", "-0.5 + p2**2"]]), ("B", [["p1"], ["1 + p2"]]),
        ("E", [["1", "0"], ["0.3", "1"]]), ("c", [["0.2"], ["-p2"]])))  # fmt: skip
    return LinearSystem(A, B, E, box, names, c)


def turned() -> SwitchedSystem:
    A = parse_matrix("A", [["0.3", "-3"], ["1 + p1", "p2"]], NAMES)
    return SwitchedSystem([(0.9, spring()), (2.0, LinearSystem(A, np.array([[1.0], [0.0]]), np.eye(2), UNSURE, NAMES,
                                                               np.array([[0.0], [0.4]])))])  # fmt: skip


def moving(**more) -> VaryingSystem:
    return VaryingSystem.of(
        [[0, 1], ["-(1 + p1) - (0.4 + p2)*cos(2*t)", "-0.2"]], [["t*p1"], ["1/(4 - t)"]], 2.0,
        [["exp(-t)", 0], [0, "1 + p2*t"]], parameters=UNSURE, names=list(NAMES), c=["0", "sin(3*t)"], **more,
    )  # fmt: skip


STIFF = LinearSystem(np.array([[-400.0, 3.0], [1.0, -0.1]]), np.array([[1.0], [0.0]]), np.eye(2))
APART = LinearSystem(np.array([[0.0, 1e6], [-2e-6, -0.5]]), np.array([[1e5], [1.0]]), np.array([[1e6], [0.0]]))
FAST = VaryingSystem.of([["-300*(2 + cos(t))", 1], [0, "-t"]], [[1], ["t"]], 2.0)
NONE, POINT = ParameterBox(), ParameterBox((0.03, -0.05), (0.0, 0.0))
ONE, BOTH = ParameterBox((0.0, 0.02), (0.05, 0.0)), ParameterBox((0.0, 0.0), (0.03, 0.05))
CASES = {
    "known": (spring(), 2.0, POINT, 0, 1e-24),
    "uncertain": (spring(), 2.0, ONE, 8, 1e-10),
    "uncertain in two": (spring(), 2.0, BOTH, 5, 1e-7),
    "uncertain, few powers": (spring(), 2.0, BOTH, 1, 0.3),
    "switched": (turned(), 2.0, POINT, 0, 1e-24),
    "switched, uncertain": (turned(), 2.0, BOTH, 5, 1e-6),
    "moving": (moving(), 2.0, POINT, 0, 1e-24),
    "moving, uncertain": (moving(), 2.0, ONE, 6, 1e-8),
    "moving, uncertain in two": (moving(), 2.0, BOTH, 3, 1e-3),
    "stiff": (STIFF, 2.0, NONE, 0, 1e-20),
    "apart": (APART, 2.0, NONE, 0, 1e-17),
    "fast": (FAST, 2.0, NONE, 0, 1e-20),
}  # fmt: skip
SLOW = {"moving, uncertain in two", "fast"}
EACH = pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in CASES])


def numbers(system, time: float, p) -> np.ndarray:
    """``[A B c E]`` in floats."""
    if system.varies:
        law, given = next(one for one in reversed(system.phases) if one.begin <= time), np.array([time, *p])
    else:
        law, given = system.modes[int(np.searchsorted(system.switches, time, side="right"))], np.array(p)
    parts = [law.entry(name) for name in ("A", "B", "c", "E")]
    return np.hstack([np.array(part(given) if callable(part) else part, dtype=float)
                      for part in parts if part is not None])  # fmt: skip


def integrated(system, start: float, stop: float, p) -> np.ndarray:
    """``[Phi Gamma]`` by an integrator, from one switch to the next."""
    width = numbers(system, start, p).shape
    found = np.hstack([np.eye(width[0]), np.zeros((width[0], width[1] - width[0]))])
    cuts = getattr(system, "switches", ())
    for a, b in pairwise([start, *(s for s in cuts if start < s < stop), stop]):

        def slope(t, x, a=a, b=b):
            M = numbers(system, min(max(t, a), np.nextafter(b, a)), p)
            x = x.reshape(width)
            out = M[:, : width[0]] @ x
            out[:, width[0] :] += M[:, width[0] :]
            return out.ravel()

        if b > a:
            method, rtol = ("Radau", 1e-12) if abs(numbers(system, a, p)[0, 0]) > 100.0 else ("DOP853", 3e-14)
            atol = 1e-15 * np.abs(numbers(system, a, p)).max()
            path = solve_ivp(slope, (a, b), found.ravel(), method, rtol=rtol, atol=atol)
            found = path.y[:, -1].reshape(width)
    return found


def points(box: ParameterBox, count: int = 2) -> list[np.ndarray]:
    rng, wide = np.random.default_rng(5), np.array(box.halves) > 0.0
    if not wide.any():
        return [np.zeros(len(box.middle))]
    return [*(rng.choice([-1.0, 1.0], len(wide)) * wide for _ in range(count)), rng.uniform(-1, 1, len(wide)) * wide]


def close(ball: arb_mat, off, truth: np.ndarray, system, near: float) -> None:
    """Each number is within its ball and what that is off by, but for what an integrator misses."""
    sizes = np.abs(truth).max(axis=1, keepdims=True) + 1e-3 * np.abs(truth).max()
    slack = 2e-8 if system is STIFF or system is FAST else 2e-11
    mid, rad = (np.array([[float(f(x)) for x in row] for row in ball.tolist()])
                for f in (lambda x: x.mid(), lambda x: x.rad()))  # fmt: skip
    assert (np.abs(mid - truth) <= rad + off + slack * (sizes + 1e-6)).all()
    assert (rad + off <= near * (1.0 + sizes)).all()


@EACH
def test_intervals_from_anywhere_to_anywhere_hold_what_an_integrator_says(name: str) -> None:
    system, until, box, degree, near = CASES[name]
    with ctx.workprec(BITS):
        flow = of(system, until, box, degree)
        edge = flow.law.stretches[0]
        edge = min(edge.stop, edge.stride)
        for start, stop in ((0.0, until), (0.37, 1.61), (0.0, edge), (edge / 2, min(until, 1.5 * edge)), (1.3, 1.3)):
            Phi, B, E = flow.over(start, stop)
            whole = Phi.append_columns(B).append_columns(E)
            for point in points(box):
                p = np.array(box.middle) + np.array(box.halves) * point
                close(at(whole, point), 0.0, integrated(system, start, stop, p), system, near)


@EACH
def test_parts_between_marks_hold_what_an_integrator_says(name: str) -> None:
    """Also at the very ends of strides and of stretches, with as many terms as there are and with few."""
    system, until, box, degree, near = CASES[name]
    with ctx.workprec(BITS):
        flow = of(system, until, box, degree)
        marks = flow.marks([0.0, 0.31, until])
        assert marks[0] == 0.0 and 0.31 in marks and marks[-1] == until and marks == sorted(set(marks))
        chosen = list(pairwise(marks))[:: max(1, len(marks) // 3)]
        for begin, end in chosen:
            step = flow.step(begin, end)
            for point in points(box, 1):
                p = np.array(box.middle) + np.array(box.halves) * point
                close(at(step, point), 0.0, integrated(system, begin, end, p), system, near)
                for start, stop, order in ((begin, end, 99), (begin + 0.25 * (end - begin), end, 6), (end, end, 3),
                                           (begin, begin + 0.01 * (end - begin), 3)):  # fmt: skip
                    terms, off = flow.within(begin, end, start, stop, order)
                    for share in (0.0, 0.5, 1.0):
                        ball = sum((at(one, point) * arb(share) ** n for n, one in enumerate(terms[1:], 1)),
                                   at(terms[0], point))  # fmt: skip
                        truth = integrated(system, begin, start + share * (stop - start), p)
                        close(ball, off, truth, system, near if order == 99 else np.inf)


@EACH
def test_kernels_hold_what_inputs_at_any_time_make_of_the_end(name: str) -> None:
    system, until, box, degree, near = CASES[name]
    with ctx.workprec(BITS):
        flow = of(system, until, box, degree)
        marks = flow.marks([0.0, until])
        d = flow.states
        for begin, end in list(pairwise(marks))[:: max(1, len(marks) // 2)]:
            for start, stop in ((begin, end), (begin + 0.25 * (end - begin), begin + 0.9 * (end - begin))):
                terms, off = flow.kernel(start, stop)
                for point in points(box, 1):
                    p = np.array(box.middle) + np.array(box.halves) * point
                    for left in (0.0, 0.4, 1.0):
                        s = stop - left * (stop - start)
                        inputs = numbers(system, min(s, np.nextafter(stop, start)), p)[:, d:]
                        moved = integrated(system, s, stop, p)[:, :d]
                        ball = sum((at(one, point) * arb(left) ** n for n, one in enumerate(terms[1:], 1)),
                                   at(terms[0], point))  # fmt: skip
                        close(ball, off, (stop - start) * moved @ inputs, system, max(1e-17, near))


@pytest.mark.parametrize("enough", [2.0**-64, 1e-2])
def test_what_a_kernel_leaves_out_is_said(enough: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flows, "ENOUGH", enough)
    with ctx.workprec(BITS):
        flow = of(FADING, 3.0)
        part = flow.law.stretches[0]
        terms, off = flow.kernel(part.start, part.stop)
        for left in np.linspace(0.0, 1.0, 5):
            s = arb(part.stop) - arb(float(left)) * (arb(part.stop) - arb(part.start))
            h = arb(part.stop) - arb(part.start)
            truths = [h * one * (1 + s) / (1 + arb(part.stop)) for one in (s, arb(1), 3 * s * s, 2 - s)]
            for j, truth in enumerate(truths):
                found = sum((one.matrix[0, j] * arb(float(left)) ** n for n, one in enumerate(terms)), arb(0))
                assert abs(found - truth) <= off[0, j] + 1e-30
    assert off.max() > 1e-9 if enough > 1e-9 else off.max() < 1e-17


def test_what_a_kernel_leaves_out_is_rounded_upwards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flows, "ENOUGH", 1e30)  # all terms but the first
    with ctx.workprec(BITS):
        flow = of(FADING, 3.0)
        part = flow.law.stretches[0]
        for start in np.linspace(part.start, part.stop, 12)[:-1]:
            A, F = part.between(start, part.stop, backwards=True)
            moved, error = flow._solve_backwards(part, A, start, part.stop)
            left, right = ([one.size for one in terms] for terms in (moved, F))
            off = flow.kernel(start, part.stop)[1]
            for i, j in np.ndindex(off.shape):
                pairs = [(error, one) for one in right]
                pairs += [(a, b) for n, a in enumerate(left) for k, b in enumerate(right) if n + k]
                exact = sum(
                    Fraction(float(a[i, m])) * Fraction(float(b[m, j])) for a, b in pairs for m in range(a.shape[1])
                )
                assert exact <= Fraction(float(off[i, j])) <= exact * (1 + Fraction(1, 10**9))


def test_a_flow_at_one_parameter_is_that_of_the_known_system_and_is_remembered() -> None:
    with ctx.workprec(BITS):
        flow = of(spring(), 2.0, BOTH, 4)
        known = flow.at([0.01, -0.02])
        assert known is flow.at((0.01, -0.02)) and known.monomials.size == 1 and known.at((0.01, -0.02)) is known
        whole = known.over(0.0, 2.0)
        close(whole[0].append_columns(whole[1]).append_columns(whole[2]).matrix, 0.0,
              integrated(spring(), 0.0, 2.0, (0.01, -0.02)), spring, 1e-24)  # fmt: skip
        assert flow.driven == 2 and flow.states == 2


def test_marks_hold_every_time_that_is_asked_for_and_where_a_law_ends() -> None:
    with ctx.workprec(BITS):
        flow = of(turned(), 2.0, POINT)
        stride = min(one.stride for one in flow.law.stretches)
        marks = flow.marks([0.0, 0.2, 2.0])
        assert {0.0, 0.2, 0.9, 2.0} <= set(marks)
        assert max(b - a for a, b in pairwise(marks)) <= stride * (1 + 1e-9)
        assert flow.marks([0.2, 0.3]) == [0.2, 0.3]
        exactly = of(LinearSystem(np.array([[1.9]]), np.ones((1, 1))), 4.0)
        assert exactly.marks([0.0, 1.0, 4.0]) == [0.0, 1.0, 2.0, 3.0, 4.0]
        for ends in pairwise(flow.marks(np.linspace(0.0, 2.0, 98).tolist())):
            flow.segment(*ends)


@pytest.mark.slow
def test_balls_of_the_longest_stretch_hold_what_its_halves_make() -> None:
    terms = ["-1 / (1 - 0.9 * cos(kepler(t, 0.9)))^3", "exp(-t)"]
    system = VaryingSystem.of([[0, 1], [terms[0], 0]], [[0], [1]], 2 * np.pi, [[terms[1]], [0]])
    with ctx.workprec(BITS):
        flow = of(system, system.horizon)
        slow = max(flow.law.stretches, key=lambda one: one.stop - one.start)
        assert len(flow.law.stretches) < 400
        whole = of(system, system.horizon).over(slow.start, slow.stop)
        middle = (slow.start + slow.stop) / 2
        one, two = flow.over(slow.start, middle), flow.over(middle, slow.stop)
        for mine, other in zip(whole, (two[0] * one[0], *(two[0] * one[k] + two[k] for k in (1, 2))), strict=True):
            for a, b in zip(mine.matrix.entries(), other.matrix.entries(), strict=True):
                assert a.overlaps(b) and a.rad() < 1e-18 * (1 + abs(b))


@pytest.mark.parametrize("rate", [1e9, 1e200, 1e305, 1.7e308])
def test_what_is_too_fast_for_its_horizon_is_refused_at_once(rate: float) -> None:
    with ctx.workprec(BITS), pytest.raises(Unchecked, match="too fast"):
        of(LinearSystem(np.array([[0.0, rate], [-rate, 0.0]]), np.ones((2, 1))), 1.0).marks([0.0, 1.0])
