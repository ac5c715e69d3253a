"""The simulation in closed loop: a controller and the exact system, under disturbances of every law."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np

from sparserob_core.arguments import whole
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.loop.controller import Controller
from sparserob_core.control.problem.names import join_units
from sparserob_core.control.response.response import Response
from sparserob_core.control.studies.laws import LawName, ParametersInTime, Uncertainty, noises
from sparserob_core.control.studies.simulate import fine_times, refine_grid, simulate_states
from sparserob_core.control.transcription.own_units import row_units
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.errors import InputError
from sparserob_core.experiment.directory.adversary import adversaries
from sparserob_core.experiment.directory.finished import FinishedRun
from sparserob_core.experiment.loop.controller import controller
from sparserob_core.experiment.loop.study import ClosedLoops
from sparserob_core.experiment.run.events import StudyProgress
from sparserob_core.experiment.run.given import GivenRun
from sparserob_core.experiment.simulation.simulation import ADVERSARY, LAWS
from sparserob_core.experiment.simulation.violations import ViolationCount
from sparserob_core.experiment.study.kit import open_run, write_into_run
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.program import TOLERANCE

LOOPS, RESOLVED_LOOPS = 10, 1  # numbers of loops of every law by default, without and with a re-solve
SHOWN, DRAWN = 400, 3  # numbers of times, and of loops of every law, in the figure
CONTROL, STEP = "control", "control_step"

# law, disturbance (1, mw, M) of every period, parameter (1, nu), parameters of a system that depends on the time
# (1, d, size), state (1, d), noise (K, p) of every period
Drawn = tuple[str, list[Array | None], Array, Array | None, Array | None, list[Array | None]]


def loop(
    run: GivenRun,
    resolve: bool = False,
    trajectories: int | None = None,
    seed: int = 0,
    *,
    seconds: float | None = None,
    periods: int = 1,
    out: str | Path | None = None,
    plugins: Iterable[str | Path] = (),
    notify: Notify = ignore,
) -> ClosedLoops:
    """Run the controller of a finished run in closed loop, as ``sparserob loop RUN`` does.

    The worst case of every constraint is replayed once, and every law of `simulate` drives some loops. The state is
    propagated exactly, and the constraints are also checked within the pieces. The result is written to ``loop.json``
    in the run's directory.

    Parameters
    ----------
    run : str, Path, Outcome or SolvedProblem
        The run (`as_run`).
    resolve : bool, default False
        Whether the remaining horizon is solved anew at every step, as for `controller`.
    trajectories : int, optional
        The number of loops of every law; 10 unless given, or 1 with ``resolve``.
    seed : int, default 0
        The seed of random numbers.
    seconds : float, optional
        The approximate limit of the time of one step, as for `controller`.
    periods : int, default 1
        The number of periods, for a plan that repeats. Each law draws a disturbance for every period, and worst cases
        follow one another.
    out : str or Path, optional
        The file of a figure.
    plugins : iterable of str or Path, default ()
        Files of plugins that the run was made with.
    notify : callable, optional
        A function that receives `StudyProgress`.

    Returns
    -------
    ClosedLoops
        The violations, the costs and the times of the steps.

    Raises
    ------
    InputError
        If the directory is no finished run with a proven control, or another argument is at fault. It is raised before
        anything is written.
    """
    from sparserob_core.experiment.loop.figure import draw_loops

    count = (RESOLVED_LOOPS if resolve else LOOPS) if trajectories is None else whole("trajectories", trajectories, 1)
    whole("seed", seed, 0)
    whole("periods", periods, 1)
    start = clock.perf_counter()
    finished = open_run(run, plugins, out)
    if periods > 1 and not finished.experiment.transcription.problem.repeat:
        raise InputError(f"periods: expected 1 of a plan that ends at its horizon, or problem.repeat, got {periods}")
    acting = controller(run, resolve, seconds=seconds, plugins=plugins)
    loops = replace(
        _simulate_loops(finished, acting, resolve, (count, periods), seed, notify), seconds=clock.perf_counter() - start
    )
    return write_into_run(finished, "loop", loops, out, draw_loops, loops)


def _simulate_loops(
    finished: FinishedRun, acting: Controller, resolve: bool, counts: tuple[int, int], seed: int, notify: Notify
) -> ClosedLoops:
    periods, model = counts[1], finished.experiment.transcription
    worst = adversaries(finished.experiment, finished.decision)
    breaks = worst.get("breakpoints", model.response.grid.breakpoints)
    grid = model.response.grid.refined(breaks)
    ends = [moment for constraint in model.constraints for moment in (constraint.start, constraint.stop)]
    times = fine_times(
        Response(model.response.system, grid, model.response.initial_state),
        model.parameters,
        np.concatenate([ends, worst.get("times", np.zeros(0))]),
    )
    shown = np.unique(np.linspace(0, times.size - 1, min(times.size, SHOWN)).round().astype(int))
    parameters_in_time = ParametersInTime.of(model.stated)
    draws = [
        *_replay_worst_cases(worst, parameters_in_time, periods),
        *_sample_loops(model, worst, parameters_in_time, counts, np.random.default_rng(seed)),
    ]
    milliseconds, mean_costs, kept_loops, laws = (
        list[float](),
        list[float](),
        list[tuple[str, Array, Array]](),
        dict[str, int](),
    )
    largest_violations = {constraint.name: -np.inf for constraint in model.constraints}
    limits = {
        constraint.name: TOLERANCE * float(row_units(constraint, model.problem.control).min())
        for constraint in model.constraints
    }
    resolved, uncovered, control_violation, step_violation = 0, 0, -np.inf, -np.inf
    for number, (law, disturbances, parameter, parameter_rows, initial_state, noise_signals) in enumerate(draws):
        to_user_states = (
            None
            if parameters_in_time is None or parameter_rows is None
            else partial(parameters_in_time.at, rows=parameter_rows)
        )
        law_grid = grid if law == ADVERSARY else model.response.grid
        fine = Response(model.response.system, refine_grid(law_grid, times), model.response.initial_state)
        laws[law] = laws.get(law, 0) + 1
        acting.reset()
        costs, previous_control = list[float](), np.zeros((0, model.problem.system.controls))
        for period, (disturbance, noise) in enumerate(zip(disturbances, noise_signals, strict=True)):
            pieces = law_grid.control_piece if law == ADVERSARY else np.arange(law_grid.pieces)
            closing = _LoopInput(model, acting, pieces, noise, period * model.problem.horizon, to_user_states)
            path = simulate_states(fine, closing, parameter, disturbance, initial_state)
            states = np.stack(list(path if to_user_states is None else map(to_user_states, path)))
            for name, largest in _measure_violations(model, finished, states, times, closing.applied).items():
                largest_violations[name] = max(largest_violations[name], largest)
            control_violation = max(control_violation, float(model.problem.control.violation(closing.applied.T).max()))
            step_violation = max(
                step_violation, _measure_step_violation(model, np.vstack([previous_control, closing.applied.T]))
            )
            costs.append(_compute_control_cost(model, closing.applied))
            if laws[law] <= DRAWN and not period:
                kept_loops.append((law, states[shown, :, 0].T, closing.applied))
            previous_control, initial_state = closing.applied[:, -1:].T, states[-1].T.copy()
            # integrals, and states that parameters add, begin at 0 again
            initial_state[:, model.stated.system.states :] = 0.0
        milliseconds += [1e3 * step.seconds for step in acting.steps]
        resolved += sum(step.resolved for step in acting.steps)
        uncovered += max(sum(not step.covered for step in acting.steps), int(acting.ever_uncovered))
        mean_costs.append(float(np.mean(costs)))
        notify(StudyProgress(text=f"{number + 1} of {len(draws)} loops", done=number + 1, total=len(draws)))
    size = float(model.problem.control.reach(np.eye(model.problem.system.controls)).max())
    return ClosedLoops(
        title=finished.experiment.title,
        directory=finished.directory,
        status=str(finished.summary["status"]),
        resolve=resolve,
        periods=periods,
        seed=seed,
        laws=laws,
        constraints={
            **{name: (largest_violations[name], limits[name]) for name in largest_violations},
            CONTROL: (control_violation, TOLERANCE * size),
            **({} if np.isinf(step_violation) else {STEP: (step_violation, TOLERANCE * size)}),
        },
        milliseconds=np.array(milliseconds),
        resolved=resolved,
        uncovered=uncovered,
        cost=float(finished.summary["cost"]),
        planned=_compute_control_cost(model, model.pieces(finished.decision)),
        costs=np.array(mean_costs),
        seconds=0.0,
        shown=times[shown],
        paths=[(law, path) for law, path, _ in kept_loops],
        controls=[(law, control) for law, _, control in kept_loops],
        cost_unit=str((finished.summary.get("units") or {}).get("cost") or ""),
        paid_in=model.problem.cost_unit,
        units={
            **{constraint.name: join_units(constraint.measured).strip() for constraint in model.constraints},
            CONTROL: join_units(model.problem.names.control_units).strip()
            if model.problem.control.halfspaces()
            else "",
            STEP: join_units(model.problem.names.control_units).strip() if model.problem.control.halfspaces() else "",
        },
    )


class _LoopInput:
    """The input of a system: a controller, called at the breakpoints of the control in their order.

    Parameters
    ----------
    model : Transcription
        The problem on its dictionaries.
    acting : Controller
        The controller.
    which : array of int
        For each piece of the simulation the piece of the model's grid that contains it.
    noise : array (K, p) or None
        The noise of measured outputs.
    begins : float
        The time at which the period begins, for the controller.
    to_user_states : callable, optional
        The states at the parameters of a system that depends on the time.
    """

    def __init__(
        self,
        model: Transcription,
        acting: Controller,
        which: np.ndarray,
        noise: Array | None,
        begins: float,
        to_user_states: Callable[[Array], Array] | None = None,
    ) -> None:
        self.model, self.acting, self.which, self.noise, self.begins = model, acting, which, noise, begins
        self.to_user_states = to_user_states
        self.applied = np.zeros((model.problem.system.controls, model.control.pieces))
        self._next_piece = 0

    def __call__(self, number: int, state: Array) -> Array:
        """Return the inputs ``(m + constants, 1)`` on a piece that begins in ``state (d, 1)``."""
        piece, points = int(self.which[number]), self.model.control.breakpoints
        grid = self.model.response.grid
        middle = (grid.breakpoints[piece] + grid.breakpoints[piece + 1]) / 2
        if self._next_piece < points.size - 1 and middle > points[self._next_piece]:
            time = self.begins + float(points[self._next_piece])
            user_state = state if self.to_user_states is None else self.to_user_states(state)
            self.applied[:, self._next_piece] = self.acting.step(time, self._measure_state(user_state[:, 0]))
            self._next_piece += 1
        return np.asarray(grid.inputs(self.applied)[:, piece, None])

    def _measure_state(self, state: Array) -> Array:
        """Return the measurement of a state ``(d,)``."""
        observer = self.model.observer
        if observer is None:
            return state[: self.model.stated.system.states]
        noise = None if self.noise is None else self.noise[self._next_piece, :, None]
        return observer.outputs(state[:, None], noise)[:, 0]


def _replay_worst_cases(
    worst: Mapping[str, Array], parameters_in_time: ParametersInTime | None, periods: int
) -> Iterator[Drawn]:
    """Yield the worst case of every constraint under the plan; in the next period that of the next constraint
    follows."""
    count = worst["names"].size if worst else 0
    for row in range(count):
        cases = [(row + period) % count for period in range(periods)]
        disturbances = [
            worst["disturbances"][case : case + 1] if worst["disturbances"].shape[1] else None for case in cases
        ]
        noise_signals = [worst["noises"][case] if "noises" in worst else None for case in cases]
        row_slice = slice(row, row + 1)
        parameter_rows = (
            None if parameters_in_time is None else parameters_in_time.find_corner(worst["directions"][row])[None]
        )
        yield (
            ADVERSARY,
            disturbances,
            worst["parameters"][row_slice],
            parameter_rows,
            worst["initial_states"][row_slice],
            noise_signals,
        )


def _sample_loops(
    model: Transcription,
    worst: Mapping[str, Array],
    parameters_in_time: ParametersInTime | None,
    counts: tuple[int, int],
    rng: np.random.Generator,
) -> Iterator[Drawn]:
    """Yield some loops of every law, for a number of periods; a single loop where nothing is uncertain."""
    functionals, parameters, (count, periods) = model.functionals, model.parameters, counts
    if not functionals.disturbed and parameters.set is None and model.noise is None and parameters_in_time is None:
        yield "iid", [None] * periods, np.zeros((1, 0)), None, None, [None] * periods
        return
    worst_points = tuple(worst[name] for name in ("times", "directions", "parameters")) if worst else (np.zeros(0),) * 3
    uncertainty = Uncertainty(
        functionals, parameters, model.constraints, (worst_points[0], worst_points[1], worst_points[2])
    )
    for law in (law for law in LAWS if law != ADVERSARY and (worst or law != "neighbours")):
        disturbances, drawn_parameters, initial_states = uncertainty.draw(cast(LawName, law), count * periods, rng)
        noise_signals = noises(model.noise, cast(LawName, law), count * periods, model.control.pieces, rng)
        parameter_rows = (
            None if parameters_in_time is None else parameters_in_time.draw(cast(LawName, law), count, None, rng)
        )
        for row in range(count):
            row_slice, draws = slice(row, row + 1), range(row, count * periods, count)
            loop_disturbances = [None if disturbances is None else disturbances[p : p + 1] for p in draws]
            loop_noises = [None if noise_signals is None else noise_signals[:, :, p] for p in draws]
            loop_rows = None if parameter_rows is None else parameter_rows[row_slice]
            yield (
                law,
                loop_disturbances,
                drawn_parameters[row_slice],
                loop_rows,
                None if initial_states is None else initial_states[row_slice],
                loop_noises,
            )


def _measure_step_violation(model: Transcription, applied: Array) -> float:
    """Return by how much the steps of consecutive controls ``(k, m)`` leave their set at most."""
    step = model.problem.control_step
    return -np.inf if step is None or len(applied) < 2 else float(step.violation(np.diff(applied, axis=0)).max())


def _measure_violations(
    model: Transcription, finished: FinishedRun, states: Array, times: Array, applied: Array
) -> dict[str, float]:
    """Return the largest violation of every constraint along states ``(T, d, 1)``.

    ``applied (m, K)`` is the control that was applied.
    """
    theta = applied.ravel() if model.control.is_indicators else finished.theta.ravel()
    counts: Sequence[ViolationCount] = [
        _make_count(constraint, model, times, theta) for constraint in model.constraints
    ]
    for position, state in enumerate(states):
        for count in counts:
            count.add(position, state)
    for count in counts:
        count.close()
    return {count.constraint.name: count.largest for count in counts}


def _make_count(one: StateConstraint, model: Transcription, times: Array, theta: Array) -> ViolationCount:
    counted = ViolationCount(one, times, row_units(one, model.problem.control), theta)
    counted.begin(1)
    return counted


def _compute_control_cost(model: Transcription, control: Array) -> float:
    """Return the first term of the cost of a control ``(m, K)``."""
    problem, prices = model.problem, model.problem.prices(model.control.breakpoints)
    sizes = np.abs(control)
    for block in problem.cost.blocks:
        sizes[list(block)] = np.linalg.norm(control[list(block)], axis=0) / len(block)
    return float((prices * sizes).sum())
