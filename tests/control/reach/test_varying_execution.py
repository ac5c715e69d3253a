"""Guards control/reach/varying_execution: errors of execution of systems that change with time, against closed
forms, an integrator and the constant system; enclosed on cells of time, also where series are cut short."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import sparserob_core as sr
import sparserob_core.control.response.varying.expansion as expansion
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.problem.system import System, VaryingSystem
from sparserob_core.control.reach.execution import Execution
from sparserob_core.control.reach.varying_execution import VaryingExecution
from sparserob_core.control.response.varying.expansion import Expansion, Flow
from sparserob_core.control.sets.integrals import enclose_absolute_integrals
from sparserob_core.control.transcription.transcribe import Transcription, prepare
from sparserob_core.sip.convex_set import Array
from tests.support.enclosed import assert_bounded_on_cells

HORIZON, PIECES = 3.0, 6
SHARES = np.array([0.1, 0.03])
CONTROL = np.array([[0.0, 0.8, -0.8, 0.0, 0.3, 0.0], [0.5, 0.0, 0.0, -0.2, 0.0, 1.0]])
A, B = np.array([[0.0, 1.0], [-4.0, -0.3]]), np.array([[0.2, 0.0], [1.0, -0.7]])
MATHIEU = [[0, 1], ["-(1.5 - 0.8*cos(2*t))", -0.1]], [["0.2*sin(t)", 0], [1, "-0.7 + t/4"]]
ROCKET = [[0, 1], [0, 0]], [[0, 0], ["1/(4 - t)", 0]]
FADING = VaryingSystem.of([["-1/(1 + t)"]], [["t", 1]], HORIZON, [["exp(-t)"]])
TIMES = np.array([0.0, 0.3, 0.5, 1.23, 2.2, HORIZON])
C = np.array([1.0, -0.4])


def model(system: System) -> Transcription:
    dictionary = sr.Dictionary.indicators(np.linspace(0.0, HORIZON, PIECES + 1))
    problem = sr.OptimalControlProblem(
        system=system,
        horizon=HORIZON,
        initial_state=[-1.0, 0.3],
        control=sr.Box([-1.0, -1.0], [1.0, 1.0]),
        path=[sr.PathConstraint(sr.Box([-0.6, -2.0], [0.7, 2.0]), start=0.4)],
        terminal=[sr.Box([-0.4, -0.4], [0.4, 0.4])],
        execution=SHARES,
    )
    return prepare(problem, dictionary, dictionary)


def executed(system: System) -> Execution:
    found = model(system).functionals.execution
    assert found is not None
    return found


def dressed(matrix: Array) -> list[list[str | float]]:
    return [[f"{entry} + 0*t" for entry in row] for row in matrix]


def mathieu() -> VaryingExecution:
    found = executed(VaryingSystem.of(*MATHIEU, HORIZON))
    assert isinstance(found, VaryingExecution)
    return found


def test_a_constant_that_is_dressed_is_the_constant() -> None:
    plain, found = executed(sr.LinearSystem(A, B)), executed(VaryingSystem.of(dressed(A), dressed(B), HORIZON))
    at = TIMES, np.tile(C, (TIMES.size, 1))
    np.testing.assert_allclose(found.lengths(*at), plain.lengths(*at), atol=1e-14)
    bounds, same = found.enclosed(CONTROL, *at), plain.enclosed(CONTROL, *at)
    assert (bounds[:, 0] <= same[:, 1]).all() and (same[:, 0] <= bounds[:, 1]).all()
    assert (bounds[:, 1] - bounds[:, 0] < 1e-12).all()
    np.testing.assert_allclose(found.slope(CONTROL, *at), plain.slope(CONTROL, *at), rtol=1e-4)
    np.testing.assert_allclose(found.sampled(CONTROL, *at), found.added(CONTROL, *at), atol=1e-14)


@pytest.mark.parametrize("time", [0.5, 1.7, HORIZON])
def test_a_falling_mass_is_the_closed_form(time: float) -> None:
    found = executed(VaryingSystem.of(*ROCKET, HORIZON)).lengths(np.array([time]), C[None])[0].reshape(2, -1)

    def primitive(s: float) -> float:
        """That of ``(time - s - 0.4) / (4 - s)``."""
        return s + (4.4 - time) * float(np.log(4.0 - s))

    turn, truth = time - 0.4, []
    for begin in np.arange(PIECES) / 2:
        ends = [min(begin, time), np.clip(turn, min(begin, time), min(begin + 0.5, time)), min(begin + 0.5, time)]
        low, middle, high = (primitive(float(one)) for one in ends)
        truth.append(abs(middle - low) + abs(high - middle))
    np.testing.assert_allclose(found[0], 0.1 * np.array(truth), atol=1e-14)
    assert not found[1].any()


def test_mathieus_equation_agrees_with_an_integrator() -> None:
    time, found = 2.2, mathieu().lengths(np.array([2.2]), C[None])[0].reshape(2, -1)

    def backwards(s: float, row: Array) -> Array:
        return -row @ np.array([[0, 1], [-(1.5 - 0.8 * np.cos(2 * s)), -0.1]])

    adjoint = solve_ivp(backwards, (time, 0.0), C, rtol=1e-12, atol=1e-13, dense_output=True).sol
    inputs = [lambda s: np.array([0.2 * np.sin(s), 1.0]), lambda s: np.array([0.0, -0.7 + s / 4])]
    for j, entering in enumerate(inputs):
        for k in range(PIECES):
            ends = min(k / 2, time), min(k / 2 + 0.5, time)
            fine = np.linspace(*ends, 65)
            heights = [float(adjoint(s) @ entering(s)) for s in fine]
            turns = [float(fine[i]) for i in range(64) if heights[i] * heights[i + 1] < 0.0]
            truth = quad(
                lambda s, e=entering: abs(float(adjoint(s) @ e(s))), *ends, points=turns or None, epsabs=1e-10
            )[0]
            assert found[j, k] == pytest.approx(SHARES[j] * truth, abs=1e-7)


@pytest.mark.parametrize(
    ("name", "value"),
    [(None, 0), ("TERMS", 4), ("TERMS", 7), ("DEGREE", 3), ("IDLE", 1e-4)],
    ids=["sharp", "4", "7", "degree 3", "idle"],
)
def test_a_kernel_is_the_closed_form_but_for_its_error(
    name: str | None, value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name is not None:
        for rough in ("SHARPEST", "BLUNTEST"):
            monkeypatch.setattr(expansion, rough, 1.0)
        monkeypatch.setattr(expansion, name, value)
    made = Expansion._expand_system(FADING)
    starts, stops = made.ends[:-1], made.ends[1:]
    found, left = made.kernel(starts, stops), np.linspace(0.0, 1.0, 21)
    s = stops[:, None] - left * (stops - starts)[:, None]
    exact = np.stack([s, np.ones_like(s), np.exp(-s)], axis=2) * ((1 + s) / (1 + stops[:, None]))[..., None]
    exact *= (stops - starts)[:, None, None]
    powers = left[:, None] ** np.arange(found.terms.shape[1])
    off = np.abs(np.einsum("rp,kpw->krw", powers, found.terms[:, :, 0]) - exact).max(axis=1)
    assert (off <= found.error[:, None] * found.sizes[:, 0]).all()
    assert off.max() > 1e-9 if name else (found.error < 1e-11).all()


@pytest.mark.first(1)
@pytest.mark.parametrize("name", ["TERMS", "DEGREE", "kernel"])
def test_bounds_hold_what_coarse_transitions_are_off_by(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    H = np.array([[1.0, 0.3], [-0.2, 1.0]])
    times = np.linspace(0.0, HORIZON, 31)
    at = np.repeat(times, 2), np.tile(H, (31, 1))
    truths = mathieu().added(CONTROL, *at).reshape(-1, 2)
    for rough in ("SHARPEST", "BLUNTEST"):
        monkeypatch.setattr(expansion, rough, 1.0)
    if name == "kernel":  # these alone, which are to say so themselves
        kernel = Expansion.kernel

        def coarse_kernel(self: Expansion, *ends: Array) -> expansion.Kernel:
            with pytest.MonkeyPatch.context() as inner:
                inner.setattr(expansion, "TERMS", 3)
                return kernel(self, *ends)

        monkeypatch.setattr(Expansion, "kernel", coarse_kernel)
    else:
        monkeypatch.setattr(expansion, name, 5)
    coarse = mathieu()
    support = coarse.on_functionals(CONTROL, H, coarse.motion)
    middle, excess = support.at(times, np.zeros((31, 2, 0)))
    off = np.abs(middle[..., 0] - truths)
    assert off.max() > 1e-8, "nothing was left out"
    piece = np.minimum(coarse.motion.place(times), coarse.motion.origin.size - 1)
    assert (off <= excess + support.neglected[:, piece].T + 1e-14).all()
    if name == "kernel":
        assert (off <= excess + 1e-14).all()


def test_what_every_step_is_off_by_is_carried_on(monkeypatch: pytest.MonkeyPatch) -> None:
    # a state that stays, by steps that each make a little more of it, and say so
    flow, off = Expansion.flow, 1e-6

    def more(self: Expansion, starts: Array, stops: Array) -> Flow:
        found, lasts = flow(self, starts, stops), stops > starts
        state = found.state * (1.0 + off * lasts)[:, None, None]
        return found._replace(state=state, error=found.error + off * lasts)

    monkeypatch.setattr(Expansion, "flow", more)
    zero: list[list[str | float]] = [["0*t", 0], [0, 0]]
    found, c = executed(VaryingSystem.of(zero, [[1, 0], [0, 1]], HORIZON)), np.array([[1.0, 0.0]])
    assert isinstance(found, VaryingExecution)
    support = found.on_functionals(CONTROL, c, found.motion)
    true = 0.1 * 0.5 * np.abs(CONTROL[0]).sum()
    wrong = float(found.added(CONTROL, np.array([HORIZON]), c)[0]) - true
    assert 1e-8 < wrong <= support.neglected[0, -1] <= 100 * wrong


@pytest.mark.slow
@pytest.mark.parametrize("plant", [MATHIEU, ROCKET, ([["-t", 2], [-1, "t"]], [["t^2", 0], ["cos(9*t)", 1]])])
def test_it_is_nowhere_above_its_chord_by_more_than_is_said_and_hardly_less(plant: tuple[list, list]) -> None:
    found = executed(VaryingSystem.of(*plant, HORIZON))
    assert isinstance(found, VaryingExecution)
    motion, H = found.motion, np.array([[1.0, -0.4], [0.3, 1.0], [-1.0, -0.2]])
    support, share, ratios = found.on_functionals(CONTROL, H, motion), np.linspace(0.0, 1.0, 25), []
    marks = motion.grid.breakpoints
    starts = np.concatenate([marks[:-1], marks[:-1] + 0.3 * np.diff(marks)])
    widths = np.concatenate([np.diff(marks), 0.01 * np.diff(marks)])
    said = support.deviation(starts, widths)
    for start, width, bounds in zip(starts, widths, said, strict=True):
        times = np.minimum(start + width * share, HORIZON)
        path = found.added(CONTROL, np.repeat(times, 3), np.tile(H, (25, 1))).reshape(-1, 3)
        above = (path - np.outer(1 - share, path[0]) - np.outer(share, path[-1])).max(axis=0)
        assert (above <= bounds * (1 + 1e-9) + 1e-14).all()
        ratios.append((above / np.maximum(bounds, 1e-12)).max())
    assert max(ratios) > 0.5  # an enclosure that is a little smaller would be wrong


@pytest.mark.parametrize("start", [0.5, 1.0, 2.0])
def test_what_bends_within_a_cell_is_counted(start: float) -> None:
    # x1'' = (start - t) x2'' and the like: the second derivative is 0 where a cell begins
    plant = [["0*t", f"t - {start}"], [0, 0]], [[0, 0], [-1, 0]]
    found, c = executed(VaryingSystem.of(*plant, HORIZON)), np.array([[1.0, 0.0]])
    assert isinstance(found, VaryingExecution)
    control = np.zeros((2, PIECES))
    control[0, int(2 * start)] = 1.0
    width, share = 0.3, np.linspace(0.0, 1.0, 25)
    path = found.added(control, start + width * share, np.tile(c, (25, 1)))
    above = (path - (1 - share) * path[0] - share * path[-1]).max()
    said = found.on_functionals(control, c, found.motion).deviation(np.array([start]), np.array([width]))
    assert above <= said[0, 0]


def test_no_error_brings_a_state_further_than_is_said() -> None:
    found, full = mathieu(), np.ones_like(CONTROL)
    support = found.on_functionals(full, np.eye(2), found.motion)
    marks = found.motion.grid.breakpoints
    for share in (0.3, 1.0):
        times = marks[:-1] + share * np.diff(marks)
        made = found.added(full, np.repeat(times, 2), np.tile(np.eye(2), (times.size, 1))).reshape(-1, 2)
        assert (made <= support.effect_bounds * (1 + 1e-12)).all()


@pytest.mark.slow
def test_the_bound_of_a_constraint_holds_on_every_cell_and_closes() -> None:
    one = model(VaryingSystem.of(*MATHIEU, HORIZON)).constraints[0]
    assert isinstance(one, FlatConstraint)
    x = np.concatenate([CONTROL.ravel(), np.abs(CONTROL).ravel()])
    assert_bounded_on_cells(one, x)


def test_integrals_of_absolute_values_are_enclosed_whatever_signs_the_polynomials_have() -> None:
    rng = np.random.default_rng(3)
    terms = rng.normal(size=(40, 9)) / (1.0 + np.arange(9))
    terms[0], terms[1] = 0.0, np.eye(9)[1] - 0.25 * np.eye(9)[0]  # nothing, and u - 1/4, of which |.| is 5/16
    terms[2] = 0.25 * np.eye(9)[0] - np.eye(9)[1] + np.eye(9)[2]  # (u - 1/2)^2, which changes no sign
    sizes = np.abs(terms).sum(axis=1)
    found = enclose_absolute_integrals(terms, np.maximum(1e-14 * sizes, 1e-300))
    points = (np.arange(40_000) + 0.5) / 40_000
    sampled = np.abs(np.polynomial.polynomial.polyval(points, terms.T)).mean(axis=1)
    assert (np.abs(found - sampled[:, None]) <= 1e-7).all()
    assert (found[:, 0] <= found[:, 1]).all() and (found[:, 1] - found[:, 0] <= 1e-13 * sizes + 1e-300).all()
    assert found[:3].mean(axis=1) == pytest.approx([0.0, 5.0 / 16.0, 1.0 / 12.0], abs=1e-15)


def test_what_is_remembered_of_times_is_what_was_made_of_them() -> None:
    execution = model(VaryingSystem.of(*MATHIEU, HORIZON)).functionals.execution
    assert isinstance(execution, VaryingExecution)
    for c in ([1.0, 0.0], [0.0, 1.0], [1.0, 0.0]):
        at = TIMES, np.tile(c, (TIMES.size, 1))
        again = replace(execution, _transitions={})
        assert (execution.lengths(*at) == again.lengths(*at)).all()
