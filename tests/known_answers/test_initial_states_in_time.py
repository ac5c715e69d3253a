"""Guards sets of feasible initial states of plants that change with time, with fixed final values and under feedback:
closed forms, linear programs from an integrator, what steps may be off by, single runs with their checks."""

from __future__ import annotations

import copy
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.control.response.response import Propagator
from sparserob_core.control.studies.initial_states import InitialPlane
from sparserob_core.control.transcription.transcribe import in_own_units
from sparserob_core.experiment.assemble import assemble, tools_of
from sparserob_core.experiment.check.check import check
from sparserob_core.experiment.config.load import load_config
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.result import Result

Config = dict[str, Any]
T, PIECES = 3.0, 6
SPRING: Config = {
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], ["-1 - 0.5*sin(2*t)", "-0.2*t"]], "B": [[0], ["exp(-t/4)"]], "E": [[0], [1]]},
        "horizon": T,
        "initial_state": [0.2, 0.1],
        "control": {"box": 1.0},
        "terminal": [{"equals": [0, 0.1]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": PIECES}},
    "observers": [],
}
ANSWERING = {"name": "affine", "causal_signals": 0}


def changed(config: Config, policy: Config | None = None, **problem: Any) -> Config:
    made = copy.deepcopy(config)
    made["problem"].update(problem)
    return made if policy is None else {**made, "policy": policy}


def moved(x: np.ndarray, u: float, start: float, stop: float) -> np.ndarray:
    """The state of the spring at ``stop`` from ``x`` at ``start``, by an integrator."""

    def rate(t: float, x: np.ndarray) -> list[float]:
        return [x[1], -(1 + 0.5 * np.sin(2 * t)) * x[0] - 0.2 * t * x[1] + np.exp(-t / 4) * u]

    return np.asarray(solve_ivp(rate, (start, stop), x, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1])


@pytest.fixture(scope="module")
def ends() -> np.ndarray:
    """What every piece of the control, then both initial states, make of the final state, ``(2, PIECES + 2)``."""
    breaks, columns = np.linspace(0.0, T, PIECES + 1), []
    for start, stop in pairwise(breaks):
        pushed = moved(np.zeros(2), 1.0, start, stop)
        columns.append(moved(pushed, 0.0, stop, T) if stop < T else pushed)
    return np.stack([*columns, *(moved(e, 0.0, 0.0, T) for e in np.eye(2))], axis=1)


def furthest(rows: np.ndarray, ends: np.ndarray, direction: np.ndarray, give: np.ndarray) -> float:
    """The support function of the initial states from which the final state is met up to ``give (2,)``."""
    found = linprog(
        np.concatenate([np.zeros(PIECES), -direction]),
        A_ub=np.vstack([rows, -rows]),
        b_ub=np.concatenate([ends + give, give - ends]),
        bounds=[(-1, 1)] * PIECES + [(None, None)] * 2,
    )
    return -float(found.fun)


@pytest.mark.first(1)
@pytest.mark.parametrize("policy", [None, ANSWERING], ids=["planned", "answering"])
def test_before_a_fixed_end_the_set_is_that_of_a_linear_program(ends: np.ndarray, policy: Config | None) -> None:
    found = sr.initial_states(changed(SPRING, policy), directions=6, values=0)
    assert found.status == "verified" and not found.remarks
    assert len(found.bounds) == 6
    for direction, bound, reached in zip(found.directions, found.bounds, found.reached, strict=True):
        exact = furthest(ends, np.array([0.0, 0.1]), direction, np.zeros(2))
        assert reached - 1e-9 <= exact <= bound + 1e-11
        assert bound - reached < 1e-9
    for point, control in zip(found.inner, found.controls, strict=True):
        np.testing.assert_allclose(ends @ np.append(control, point), [0.0, 0.1], atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.1], ids=["disturbed", "errors too"])
def test_with_no_fixed_end_a_measurable_disturbance_and_errors_take_their_share(ends: np.ndarray, share: float) -> None:
    half, bound, beside = np.array([0.3, 0.2]), 0.05, {"execution": [share]} if share else {}
    found = sr.initial_states(
        changed(
            SPRING,
            terminal=[{"box": half.tolist()}],
            disturbance={"box": bound},
            disturbance_class="measurable",
            **beside,
        ),
        directions=4,
        values=0,
    )
    assert found.status == "verified"
    times = (np.arange(300) + 0.5) * T / 300
    onward = np.array([moved(np.array([0.0, 1.0]), 0.0, s, T) for s in times])
    pushed = bound * np.abs(onward).mean(axis=0) * T
    acting = (onward * np.exp(-times / 4)[:, None]).reshape(PIECES, -1, 2)
    off = share * np.abs(acting).mean(axis=1).T * (T / PIECES)
    G = np.vstack([
        np.hstack([sign * ends[:, :PIECES] + off, off - sign * ends[:, :PIECES], sign * ends[:, PIECES:]])
        for sign in (1.0, -1.0)
    ])  # fmt: skip
    for direction, bounded, reached in zip(found.directions, found.bounds, found.reached, strict=True):
        exact = -linprog(
            np.concatenate([np.zeros(2 * PIECES), -direction]),
            A_ub=G,
            b_ub=np.tile(half - pushed, 2),
            bounds=[(0, 1)] * (2 * PIECES) + [(None, None)] * 2,
        ).fun
        assert reached - 1e-4 <= exact <= bounded + 1e-4
        assert bounded - reached < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("policy", [None, ANSWERING], ids=["planned", "answering"])
def test_costs_before_a_fixed_end_are_those_of_a_linear_program(ends: np.ndarray, policy: Config | None) -> None:
    found = sr.initial_states(changed(SPRING, policy), directions=4, values=2)
    assert len(found.costs) > 4
    both = np.hstack([ends[:, :PIECES], -ends[:, :PIECES]])
    for point, cost, lower in zip(found.points, found.costs, found.lower_bounds, strict=True):
        rest = np.array([0.0, 0.1]) - ends[:, PIECES:] @ point
        least = linprog(np.full(2 * PIECES, T / PIECES), A_eq=both, b_eq=rest, bounds=[(0, 1)] * (2 * PIECES)).fun
        assert lower <= least * (1 + 1e-10)
        assert cost == pytest.approx(least, rel=1e-7)
        assert cost - lower <= 1e-6 * cost


@pytest.mark.slow
def test_other_units_of_time_and_length_change_nothing_but_the_units(ends: np.ndarray) -> None:
    time, length = 1e3, np.array([2e-3, 5e2])
    t = f"(t / {time!r})"
    rate = length / time
    A = [[0, rate[0] / length[1]],
         [f"(-1 - 0.5*sin(2*{t})) * {float(rate[1] / length[0])!r}", f"-0.2*{t} * {1 / time!r}"]]  # fmt: skip
    system = {"A": A, "B": [[0], [f"exp(-{t}/4) * {float(rate[1])!r}"]]}
    config = changed(SPRING, system=system, horizon=T * time, initial_state=(length * [0.2, 0.1]).tolist(),
                     terminal=[{"equals": [0, 0.1 * length[1]]}])  # fmt: skip
    found = sr.initial_states(config, directions=6, values=0)
    for normal, bound, reached in zip(found.directions, found.bounds, found.reached, strict=True):
        size = np.linalg.norm(normal * length)
        exact = furthest(ends, np.array([0.0, 0.1]), normal * length / size, np.zeros(2))
        assert reached / size - 1e-9 <= exact <= bound / size + 1e-11
        assert bound - reached < 1e-9 * size


OFF, RADIUS = 3e-3, 8.0


def asked(config: Config, direction: np.ndarray, radius: float = RADIUS) -> tuple[InitialPlane, Result]:
    """The plane about 0, and what it says of its support function in a direction."""
    loaded = load_config(config)
    own, units = in_own_units(assemble(loaded).of_control("").transcription)
    plane = InitialPlane(own, (0, 1), np.zeros(2), radius / units.states)
    return plane, plane.weakened(Exchange().solve(plane.support(direction), tools_of(loaded)))


@pytest.mark.first(2)
@pytest.mark.parametrize("policy", [None, ANSWERING], ids=["planned", "answering"])
@pytest.mark.parametrize("terminal", [{"equals": [0, 0.1]}, {"box": [0.05, 0.2]}], ids=["fixed", "box"])
def test_bounds_hold_for_all_steps_that_are_as_far_off_as_they_may_be(
    ends: np.ndarray, policy: Config | None, terminal: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where steps may be off by 3 in 1 000 of what is added up, the furthest initial state is that of a linear program.
    Its rows give way by as much, from the farthest initial state of the plane."""
    monkeypatch.setattr(Propagator, "slack", OFF)
    direction = np.array([0.6, -0.8])
    _, result = asked(changed(SPRING, policy, terminal=[terminal]), direction)
    give = OFF * np.abs(ends) @ np.concatenate([np.ones(PIECES), np.full(2, RADIUS)])
    middle, wide = (np.array([0.0, 0.1]), 0.0) if "equals" in terminal else (np.zeros(2), np.array(terminal["box"]))
    exact, wider = (furthest(ends, middle, direction, wide + more) for more in (0.0 * give, give))
    bound = -result.lower_bound * RADIUS
    assert wider <= bound * (1 + 1e-9)
    # an equation of all deviations is told as two rows, of up to twice its multiplier and once
    most = 3.0 if policy is not None and "equals" in terminal else 1.0 + 1e-6
    assert bound - exact <= most * (wider - exact)


@pytest.mark.first(1)
@pytest.mark.parametrize("policy", [None, ANSWERING], ids=["planned", "answering"])
def test_what_only_steps_that_are_off_could_reach_is_not_called_infeasible(
    ends: np.ndarray, policy: Config | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the plane within 1e-3, a final state just beyond what it reaches is proven out of reach of steps that are
    exact, not of steps that are off."""
    both = np.stack([[1.0] * PIECES + [1e-3] * 2]) * ends
    beyond = np.abs(both[0]).sum() + 2e-3 * np.linalg.norm(ends[0])
    config = changed(SPRING, policy, terminal=[{"equals": [beyond, None]}])
    for off, status in ((1e-5, "infeasible"), (5e-2, "undecided")):
        monkeypatch.setattr(Propagator, "slack", off)
        _, result = asked(config, np.array([0.6, -0.8]), 1e-3)
        assert result.status == status
        assert (result.lower_bound == -np.inf) == (status == "undecided")


@pytest.mark.first(1)
@pytest.mark.parametrize("policy", [None, ANSWERING], ids=["planned", "answering"])
def test_the_bound_of_a_cost_gives_way_as_the_final_state_may_be_off(
    ends: np.ndarray, policy: Config | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of what is added up to the final state, only pieces that act count: the others are off by nothing."""
    monkeypatch.setattr(Propagator, "slack", OFF)
    loaded = load_config(changed(SPRING, policy))
    own, units = in_own_units(assemble(loaded).of_control("").transcription)
    plane, x0 = InitialPlane(own, (0, 1), np.zeros(2), RADIUS / units.states), np.array([0.4, -0.8])
    tools = tools_of(loaded)
    result = Exchange().solve(plane.at(x0 / RADIUS), tools)
    rest, rows = np.array([0.0, 0.1]) - ends[:, PIECES:] @ x0, np.hstack([ends[:, :PIECES], -ends[:, :PIECES]])
    limits = {"bounds": [(0, 1)] * (2 * PIECES), "c": np.full(2 * PIECES, T / PIECES)}
    exact = linprog(**limits, A_eq=rows, b_eq=rest)
    acting = exact.x[:PIECES] + exact.x[PIECES:] > 0.0
    off = OFF * np.abs(ends) @ np.concatenate([acting, np.abs(x0)])
    wider = linprog(**limits, A_ub=np.vstack([rows, -rows]), b_ub=np.concatenate([rest + off, off - rest]))
    assert result.upper_bound * units.cost == pytest.approx(exact.fun, rel=1e-7)
    bound = plane.rounded(x0 / RADIUS, result).lower_bound * units.cost
    assert bound <= wider.fun * (1 + 1e-9)
    assert exact.fun - bound <= 5.0 * (exact.fun - wider.fun)


def test_an_equality_that_holds_by_itself_is_not_taken_for_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second state keeps what it is and is 0.25, whatever is done; of the first 0.9, 1.0 that the control can be,
    and the cost of 0.6 are off by a share."""
    monkeypatch.setattr(Propagator, "slack", OFF)
    config = changed(
        SPRING,
        system={"A": [["0*t", 0], [0, 0]], "B": [[1], [0]]},
        horizon=1.0,
        initial_state=[0.9, 0.25],
        terminal=[{"equals": [None, 0.25]}, {"equals": [0.3, None]}],
    )
    loaded = load_config(config)
    own, units = in_own_units(assemble(loaded).of_control("").transcription)
    plane, z = InitialPlane(own, (0, 1), np.array([0.9, 0.25]) / units.states, 1.0 / units.states), np.zeros(2)
    result = Exchange().solve(plane.at(z), tools_of(loaded))
    assert result.upper_bound * units.cost == pytest.approx(0.6, rel=1e-9)
    assert plane.rounded(z, result).lower_bound * units.cost == pytest.approx(0.6 - OFF * (0.9 + 1.0 + 0.6), rel=1e-9)


KINDS: dict[str, Config] = {
    "fixed": changed(SPRING),
    "one fixed": changed(SPRING, terminal=[{"equals": [0, None]}, {"box": [None, 0.3]}], disturbance={"box": [0.0]}),
    "answering": changed(SPRING, ANSWERING, disturbance={"box": [0.05]}, terminal=[{"box": [0.3, 0.3]}]),
    "answering a box of navigation": changed(
        SPRING, ANSWERING, initial_state={"centre": [0.2, 0.1], "box": [0.1, 0.1]}, terminal=[{"equals": [0, 0]}]
    ),
    "outputs": changed(
        SPRING,
        ANSWERING,
        measurements={"C": [[1, 0]], "noise": {"box": [0.02]}},
        disturbance={"box": [0.05]},
        terminal=[{"box": [0.4, 0.4]}],
    ),
    "mixed and steps": changed(
        SPRING,
        ANSWERING,
        disturbance={"box": [0.05]},
        path=[{"mixed": {"H": [[0, 0.5], [0, -0.5]], "G": [[1], [-1]], "h": 1.0}}],
        control_step={"box": 0.8},
        terminal=[{"box": [0.3, 0.3]}],
    ),
    "round": changed(
        SPRING,
        disturbance={"box": [0.05]},
        terminal=[{"ellipsoid": {"centre": [0, 0], "shape": [[0.2, 0], [0, 0.2]]}}],
    ),
    "errors of execution": changed(
        SPRING,
        execution=[0.03],
        system={"A": [[0, 1], ["-1 - p*sin(2*t)", -0.2]], "B": [[0], [1]], "parameters": {"p": [0.2, 0.4]}},
        terminal=[{"box": [0.2, 0.2]}],
    ),
    "errors of execution, a constant plant": changed(
        SPRING,
        execution=[0.03],
        system={"A": [[0, 1], ["-1 - p", -0.2]], "B": [[0], [1]], "parameters": {"p": [-0.1, 0.1]}},
        terminal=[{"box": [0.2, 0.2]}],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_runs_are_checked_inside_and_infeasible_outside(name: str, tmp_path: Path) -> None:
    config = KINDS[name]
    found = sr.initial_states(config, directions=6, values=0)
    assert found.status in ("certified", "verified")
    assert not found.remarks

    def ended(x0: np.ndarray, out: Path) -> str:
        start = config["problem"]["initial_state"]
        begun = {**start, "centre": x0.tolist()} if isinstance(start, dict) else x0.tolist()
        status = sr.run(changed(config, initial_state=begun), out=out, quiet=True, figures=False).status
        assert check(out).status == "verified"
        return status

    middle = found.inner.mean(axis=0)
    for number, vertex in enumerate(found.inner[::3]):
        assert ended(middle + 0.999 * (vertex - middle), tmp_path / f"in{number}") == "certified"
    for number in range(0, len(found.bounds), 3):
        normal = found.directions[number]
        vertex = found.inner[int((found.inner @ normal).argmax())]
        beyond = vertex + (found.bounds[number] - normal @ vertex + 1e-3) * normal
        assert ended(beyond, tmp_path / f"out{number}") == "infeasible"


DRESSED = ("fixed", "one fixed", "answering", "answering a box of navigation", "mixed and steps")


@pytest.mark.slow
@pytest.mark.parametrize("name", DRESSED)
def test_a_dressed_constant_plant_has_the_set_and_the_costs_that_it_has_plain(name: str) -> None:
    plain = changed(KINDS[name], system={"A": [[0, 1], [-1, -0.2]], "B": [[0], [1]], "E": [[0], [1]]})
    dressed = changed(plain, system={"A": [["0*t", 1], [-1, "-0.2 + 0*t"]], "B": [[0], [1]], "E": [[0], [1]]})
    one, other = (sr.initial_states(config, directions=6, values=2) for config in (plain, dressed))
    np.testing.assert_allclose(other.bounds, one.bounds, rtol=1e-9)
    np.testing.assert_allclose(other.reached, one.reached, rtol=1e-9)
    assert len(one.costs) == len(other.costs) > 4
    np.testing.assert_allclose(other.costs, one.costs, rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_a_coordinate_that_an_equality_pins_makes_a_segment_in_closed_form() -> None:
    """The second state keeps exp(-1/2) of what it is; the first gains its integral and at most 1 by the control."""
    config = changed(
        SPRING,
        system={"A": [[0, 1], [0, "-t"]], "B": [[1], [0]]},
        horizon=1.0,
        terminal=[{"box": [0.5, None]}, {"equals": [None, 0.25]}],
    )
    found = sr.initial_states(config, directions=6, values=3)
    pinned, t = 0.25 * np.exp(0.5), np.linspace(0.0, 1.0, 100_001)
    gained = pinned * float(np.trapezoid(np.exp(-(t**2) / 2), t))
    assert found.status == "certified" and "no interior" in found.message
    np.testing.assert_allclose(found.outer[:, 1], pinned, rtol=1e-9)
    np.testing.assert_allclose([found.outer[:, 0].min(), found.outer[:, 0].max()], [-1.5 - gained, 1.5 - gained],
                               rtol=1e-9)  # fmt: skip
    assert len(found.costs) == 3
    np.testing.assert_allclose(found.costs, np.maximum(np.abs(found.points[:, 0] + gained) - 0.5, 0.0), atol=1e-6)
