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
from sparserob_core.control.problem.names import joined
from sparserob_core.control.response.response import Response
from sparserob_core.control.studies.laws import LawName, ParametersInTime, Uncertainty, noises
from sparserob_core.control.studies.simulate import fine_times, finer, walk
from sparserob_core.control.transcription.own_units import row_units
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.errors import InputError
from sparserob_core.experiment.directory.adversary import adversaries
from sparserob_core.experiment.directory.artefacts import RunDirectory, require_room
from sparserob_core.experiment.directory.finished import FinishedRun, read_finished
from sparserob_core.experiment.loop.controller import controller
from sparserob_core.experiment.loop.study import ClosedLoops
from sparserob_core.experiment.run.events import StudyProgress
from sparserob_core.experiment.run.given import GivenRun, as_run
from sparserob_core.experiment.simulation.simulation import ADVERSARY, LAWS
from sparserob_core.experiment.simulation.violations import ViolationCount
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.program import TOLERANCE

LOOPS, RESOLVED_LOOPS = 10, 1  # numbers of loops of every law by default, without and with a re-solve
SHOWN, DRAWN = 400, 3  # numbers of times, and of loops of every law, in the figure
CONTROL, STEP = "control", "control_step"
ROUNDING = 1e-12  # of the size of the set of controls

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
    from sparserob_core.experiment.figures.style import missing_matplotlib, require_writable
    from sparserob_core.experiment.loop.figure import write_loops

    count = (RESOLVED_LOOPS if resolve else LOOPS) if trajectories is None else whole("trajectories", trajectories, 1)
    whole("seed", seed, 0)
    whole("periods", periods, 1)
    if out is not None:
        require_writable(Path(out))
    began = clock.perf_counter()
    directory, experiment = as_run(run)
    finished = read_finished(directory, plugins, experiment)
    require_room(finished.directory)
    if periods > 1 and not finished.experiment.transcription.problem.repeat:
        raise InputError(f"periods: expected 1 of a plan that ends at its horizon, or problem.repeat, got {periods}")
    acting = controller(run, resolve, seconds=seconds, plugins=plugins)
    found = replace(
        _closed(finished, acting, resolve, (count, periods), seed, notify), seconds=clock.perf_counter() - began
    )
    RunDirectory(finished.directory).write_json("loop.json", found.summary())
    if out is not None and (missing := missing_matplotlib()):
        return replace(found, undrawn=missing)
    if out is not None:
        write_loops(Path(out), found, finished)
    return found


def _closed(
    finished: FinishedRun, acting: Controller, resolve: bool, counts: tuple[int, int], seed: int, notify: Notify
) -> ClosedLoops:
    periods, model = counts[1], finished.experiment.transcription
    worst = adversaries(finished.experiment, finished.decision)
    breaks = worst.get("breakpoints", model.response.grid.breakpoints)
    grid = model.response.grid.refined(breaks)
    ends = [moment for one in model.constraints for moment in (one.start, one.stop)]
    times = fine_times(
        Response(model.response.system, grid, model.response.initial_state),
        model.parameters,
        np.concatenate([ends, worst.get("times", np.zeros(0))]),
    )
    shown = np.unique(np.linspace(0, times.size - 1, min(times.size, SHOWN)).round().astype(int))
    beside = ParametersInTime.of(model.stated)
    drawn = [*_replayed(worst, beside, periods), *_sampled(model, worst, beside, counts, np.random.default_rng(seed))]
    spent, paid, kept, laws = list[float](), list[float](), list[tuple[str, Array, Array]](), dict[str, int]()
    found = {one.name: -np.inf for one in model.constraints}
    limits = {one.name: TOLERANCE * float(row_units(one, model.problem.control).min()) for one in model.constraints}
    resolved, uncovered, outside, stepped = 0, 0, -np.inf, -np.inf
    for number, (law, disturbances, parameter, here, begun, seen) in enumerate(drawn):
        told = None if beside is None or here is None else partial(beside.at, rows=here)
        on = grid if law == ADVERSARY else model.response.grid
        fine = Response(model.response.system, finer(on, times), model.response.initial_state)
        laws[law] = laws.get(law, 0) + 1
        acting.reset()
        costs, before = list[float](), np.zeros((0, model.problem.system.controls))
        for period, (disturbance, noise) in enumerate(zip(disturbances, seen, strict=True)):
            which = on.control_piece if law == ADVERSARY else np.arange(on.pieces)
            closing = _Closing(model, acting, which, noise, period * model.problem.horizon, told)
            path = walk(fine, closing, parameter, disturbance, begun)
            states = np.stack(list(path if told is None else map(told, path)))
            for name, largest in _violations(model, finished, states, times, closing.applied).items():
                found[name] = max(found[name], largest)
            outside = max(outside, float(model.problem.control.violation(closing.applied.T).max()))
            stepped = max(stepped, _stepped(model, np.vstack([before, closing.applied.T])))
            costs.append(_paid(model, closing.applied))
            if laws[law] <= DRAWN and not period:
                kept.append((law, states[shown, :, 0].T, closing.applied))
            before, begun = closing.applied[:, -1:].T, states[-1].T.copy()
            begun[:, model.stated.system.states :] = 0.0  # integrals, and states that parameters add, begin at 0 again
        spent += [1e3 * one.seconds for one in acting.steps]
        resolved += sum(one.resolved for one in acting.steps)
        uncovered += max(sum(not one.covered for one in acting.steps), int(acting.ever_uncovered))
        paid.append(float(np.mean(costs)))
        notify(StudyProgress(text=f"{number + 1} of {len(drawn)} loops", done=number + 1, total=len(drawn)))
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
            **{name: (found[name], limits[name]) for name in found},
            CONTROL: (outside, TOLERANCE * size),
            **({} if np.isinf(stepped) else {STEP: (stepped, TOLERANCE * size)}),
        },
        milliseconds=np.array(spent),
        resolved=resolved,
        uncovered=uncovered,
        cost=float(finished.summary["cost"]),
        planned=_paid(model, model.pieces(finished.decision)),
        costs=np.array(paid),
        seconds=0.0,
        shown=times[shown],
        paths=[(law, path) for law, path, _ in kept],
        controls=[(law, control) for law, _, control in kept],
        cost_unit=str((finished.summary.get("units") or {}).get("cost") or ""),
        paid_in=model.problem.cost_unit,
        units={
            **{one.name: joined(one.measured).strip() for one in model.constraints},
            CONTROL: joined(model.problem.names.control_units).strip() if model.problem.control.halfspaces() else "",
            STEP: joined(model.problem.names.control_units).strip() if model.problem.control.halfspaces() else "",
        },
    )


class _Closing:
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
    told : callable, optional
        The states at the parameters of a system that depends on the time.
    """

    def __init__(
        self,
        model: Transcription,
        acting: Controller,
        which: np.ndarray,
        noise: Array | None,
        begins: float,
        told: Callable[[Array], Array] | None = None,
    ) -> None:
        self.model, self.acting, self.which, self.noise, self.begins = model, acting, which, noise, begins
        self.told = told
        self.applied = np.zeros((model.problem.system.controls, model.control.pieces))
        self._asked = 0

    def __call__(self, number: int, state: Array) -> Array:
        """Return the inputs ``(m + constants, 1)`` on a piece that begins in ``state (d, 1)``."""
        piece, points = int(self.which[number]), self.model.control.breakpoints
        grid = self.model.response.grid
        middle = (grid.breakpoints[piece] + grid.breakpoints[piece + 1]) / 2
        if self._asked < points.size - 1 and middle > points[self._asked]:
            time = self.begins + float(points[self._asked])
            here = state if self.told is None else self.told(state)
            self.applied[:, self._asked] = self.acting.step(time, self._measured(here[:, 0]))
            self._asked += 1
        return np.asarray(grid.inputs(self.applied)[:, piece, None])

    def _measured(self, state: Array) -> Array:
        """Return the measurement of a state ``(d,)``."""
        observer = self.model.observer
        if observer is None:
            return state[: self.model.stated.system.states]
        noise = None if self.noise is None else self.noise[self._asked, :, None]
        return observer.outputs(state[:, None], noise)[:, 0]


def _replayed(worst: Mapping[str, Array], beside: ParametersInTime | None, periods: int) -> Iterator[Drawn]:
    """Yield the worst case of every constraint under the plan; in the next period that of the next constraint
    follows."""
    count = worst["names"].size if worst else 0
    for row in range(count):
        turns = [(row + period) % count for period in range(periods)]
        disturbances = [worst["disturbances"][at : at + 1] if worst["disturbances"].shape[1] else None for at in turns]
        seen = [worst["noises"][at] if "noises" in worst else None for at in turns]
        one = slice(row, row + 1)
        here = None if beside is None else beside.seen(worst["directions"][row])[None]
        yield ADVERSARY, disturbances, worst["parameters"][one], here, worst["initial_states"][one], seen


def _sampled(
    model: Transcription,
    worst: Mapping[str, Array],
    beside: ParametersInTime | None,
    counts: tuple[int, int],
    rng: np.random.Generator,
) -> Iterator[Drawn]:
    """Yield some loops of every law, for a number of periods; a single loop where nothing is uncertain."""
    functionals, parameters, (count, periods) = model.functionals, model.parameters, counts
    if not functionals.disturbed and parameters.set is None and model.noise is None and beside is None:
        yield "iid", [None] * periods, np.zeros((1, 0)), None, None, [None] * periods
        return
    known = tuple(worst[name] for name in ("times", "directions", "parameters")) if worst else (np.zeros(0),) * 3
    uncertainty = Uncertainty(functionals, parameters, model.constraints, (known[0], known[1], known[2]))
    for law in (law for law in LAWS if law != ADVERSARY and (worst or law != "neighbours")):
        disturbances, drawn, begun = uncertainty.draw(cast(LawName, law), count * periods, rng)
        seen = noises(model.noise, cast(LawName, law), count * periods, model.control.pieces, rng)
        here = None if beside is None else beside.draw(cast(LawName, law), count, None, rng)
        for row in range(count):
            one, turns = slice(row, row + 1), range(row, count * periods, count)
            every = [None if disturbances is None else disturbances[p : p + 1] for p in turns]
            heard = [None if seen is None else seen[:, :, p] for p in turns]
            rows = None if here is None else here[one]
            yield law, every, drawn[one], rows, None if begun is None else begun[one], heard


def _stepped(model: Transcription, applied: Array) -> float:
    """Return by how much the steps of consecutive controls ``(k, m)`` leave their set at most."""
    step = model.problem.control_step
    return -np.inf if step is None or len(applied) < 2 else float(step.violation(np.diff(applied, axis=0)).max())


def _violations(
    model: Transcription, finished: FinishedRun, states: Array, times: Array, applied: Array
) -> dict[str, float]:
    """Return the largest violation of every constraint along states ``(T, d, 1)``.

    ``applied (m, K)`` is the control that was applied.
    """
    theta = applied.ravel() if model.control.is_indicators else finished.theta.ravel()
    counts: Sequence[ViolationCount] = [_count(one, model, times, theta) for one in model.constraints]
    for position, state in enumerate(states):
        for one in counts:
            one.add(position, state)
    for one in counts:
        one.close()
    return {one.constraint.name: one.largest for one in counts}


def _count(one: StateConstraint, model: Transcription, times: Array, theta: Array) -> ViolationCount:
    counted = ViolationCount(one, times, row_units(one, model.problem.control), theta)
    counted.begin(1)
    return counted


def _paid(model: Transcription, control: Array) -> float:
    """Return the first term of the cost of a control ``(m, K)``."""
    problem, prices = model.problem, model.problem.prices(model.control.breakpoints)
    sizes = np.abs(control)
    for block in problem.cost.blocks:
        sizes[list(block)] = np.linalg.norm(control[list(block)], axis=0) / len(block)
    return float((prices * sizes).sum())
