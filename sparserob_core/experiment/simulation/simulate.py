"""The simulation of a finished run: random trajectories together with the worst case, or the worst cases themselves."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np

from sparserob_core.arguments import whole
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.problem.names import join_units
from sparserob_core.control.response.response import Response
from sparserob_core.control.studies.laws import LawName, ParametersInTime, Uncertainty, noises
from sparserob_core.control.studies.simulate import (
    deliver_control,
    fine_times,
    refine_grid,
    simulate_states,
    times_inside,
    trajectories_at_once,
)
from sparserob_core.control.transcription.own_units import row_units
from sparserob_core.errors import InputError
from sparserob_core.experiment.directory.adversary import (
    adversaries,
    attained,
    controlled,
    propagated,
    read_adversaries,
)
from sparserob_core.experiment.directory.finished import FinishedRun
from sparserob_core.experiment.plugins.messages import nearest
from sparserob_core.experiment.run.events import StudyProgress
from sparserob_core.experiment.run.given import GivenRun
from sparserob_core.experiment.simulation.simulation import (
    ADVERSARY,
    ANY,
    LAWS,
    ConstraintShare,
    Simulation,
    clopper_pearson,
)
from sparserob_core.experiment.simulation.violations import ViolationCount
from sparserob_core.experiment.study.kit import open_run, write_into_run
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.program import TOLERANCE

TRAJECTORIES = 10_000  # that are drawn unless stated otherwise: a probability is known to about 0.01
FAN, SHOWN = 120, 400  # numbers of trajectories and of times that are kept for the figure


def simulate(
    run: GivenRun,
    trajectories: int | None = None,
    law: str = "iid",
    seed: int = 0,
    *,
    out: str | Path | None = None,
    plugins: Iterable[str | Path] = (),
    notify: Notify = ignore,
) -> Simulation:
    """Propagate trajectories of a finished run exactly, as ``sparserob simulate RUN`` does.

    The result is written to ``simulation-<law>.json`` in the run's directory.

    Parameters
    ----------
    run : str, Path, Outcome or SolvedProblem
        The run (`as_run`).
    trajectories : int, optional
        The number of trajectories; 10 000 unless given. The law ``adversary`` takes no number.
    law : str, default "iid"
        The law of the uncertainty: ``iid``, ``vertices``, ``slow`` or ``neighbours``; or ``adversary``, which replays
        the worst case of every constraint.
    seed : int, default 0
        The seed of random numbers.
    out : str or Path, optional
        The file of a figure. Where matplotlib is missing there is no figure, and the ``remarks`` of the result say so.
    plugins : iterable of str or Path, default ()
        Files of plugins that the run was made with. The directory itself is data: no plugin that it names is loaded.
    notify : callable, optional
        A function that receives `StudyProgress`.

    Returns
    -------
    Simulation
        The shares of trajectories that violate each constraint, and the largest violations.

    Raises
    ------
    InputError
        If the directory is no finished run with a control, or another argument is at fault. It is raised before
        anything is written.
    """
    from sparserob_core.experiment.figures.adversary_figure import draw_adversary
    from sparserob_core.experiment.simulation.figure import draw_simulation

    count = _check_arguments(law, trajectories, seed)
    finished = open_run(run, plugins, out)
    model = finished.experiment.transcription
    if not model.constraints:
        raise InputError(
            f"{finished.directory}: there is no path or terminal constraint that a trajectory could violate"
        )
    started = time.perf_counter()
    worst = adversaries(finished.experiment, finished.decision)
    replayed: Mapping[str, Array] | None = None
    if law == ADVERSARY:
        replayed = read_adversaries(finished.directory, model) or worst
        moments, states = propagated(model, finished.decision, replayed)
        if (parameters_in_time := ParametersInTime.of(model.stated)) is not None:
            pairs = zip(states, replayed["directions"], strict=True)
            states = np.stack(
                [
                    parameters_in_time.at(trajectory, parameters_in_time.find_corner(direction)[None])
                    for trajectory, direction in pairs
                ]
            )
        replayed = {**replayed, "state_times": moments, "states": states}
        simulation = _replay_worst_cases(finished, replayed, started)
    else:
        simulation = _simulate_samples(finished, worst, cast(LawName, law), count, seed, notify, started)
    draw, drawn = (draw_simulation, simulation) if replayed is None else (draw_adversary, replayed)
    return write_into_run(finished, f"simulation-{law}", simulation, out, draw, drawn)


def _simulate_samples(
    finished: FinishedRun,
    worst: Mapping[str, Array],
    law: LawName,
    count: int,
    seed: int,
    notify: Notify,
    started: float,
) -> Simulation:
    model = finished.experiment.transcription
    response, parameters = model.response, model.parameters
    acting, parameters_in_time = _FeedbackControl(), ParametersInTime.of(model.stated)
    ends = [moment for constraint in model.constraints for moment in (constraint.start, constraint.stop)]
    times = fine_times(response, parameters, np.concatenate([ends, worst.get("times", np.zeros(0))]))
    fine = Response(response.system, refine_grid(response.grid, times), response.initial_state)
    shown = np.unique(np.linspace(0, times.size - 1, min(times.size, SHOWN)).round().astype(int))
    worst_points = tuple(worst[name] for name in ("times", "directions", "parameters"))
    uncertainty = Uncertainty(
        model.functionals, parameters, model.constraints, (worst_points[0], worst_points[1], worst_points[2])
    )
    violation_counts, envelope = (
        [
            ViolationCount(constraint, times, row_units(constraint, model.problem.control), finished.theta.ravel())
            for constraint in model.constraints
        ],
        _Envelope(shown, response.initial_state.size),
    )
    rng, block, simulated, violating = (
        np.random.default_rng(seed),
        trajectories_at_once(fine, parameters.count > 0),
        0,
        0,
    )
    while simulated < count:
        size = min(block, count - simulated)
        bases = uncertainty.bases(law, size, rng)
        disturbances, drawn_parameters, initial_states = uncertainty.draw(law, size, rng, bases)
        directions = None if bases is None else uncertainty.directions(bases)
        parameter_rows = None if parameters_in_time is None else parameters_in_time.draw(law, size, directions, rng)
        noise_signals = noises(model.noise, law, size, model.control.pieces, rng)
        control = controlled(model, finished.decision, np.arange(response.grid.pieces), noise_signals)
        if callable(control):
            control = acting.of(control)
        elif (errors := uncertainty.errors(law, size, model.nominal(finished.decision), rng)) is not None:
            control = deliver_control(control, errors)
        for violation_count in violation_counts:
            violation_count.begin(size)
        for position, state in enumerate(
            simulate_states(fine, control, drawn_parameters, disturbances, initial_states)
        ):
            if parameters_in_time is not None and parameter_rows is not None:
                state = parameters_in_time.at(state, parameter_rows)
            envelope.add(position, state)
            for violation_count in violation_counts:
                violation_count.add(position, state, acting.now(position, model.functionals.channels))
        violating += int(np.any([violation_count.close() for violation_count in violation_counts], axis=0).sum())
        simulated += size
        notify(StudyProgress(text=f"{simulated} of {count} trajectories", done=simulated, total=count))
    shares = _compute_shares(violation_counts, worst, count)
    return Simulation(
        title=finished.experiment.title,
        directory=finished.directory,
        status=str(finished.summary["status"]),
        law=law,
        trajectories=count,
        seed=seed,
        times=times.size,
        inside=times_inside(times, response.grid.breakpoints),
        constraints=shares,
        any_violated=_merge_shares(shares, violating) if len(shares) > 1 else None,
        shown=times[shown],
        fan=envelope.fan(),
        lower=envelope.lower,
        upper=envelope.upper,
        seconds=time.perf_counter() - started,
    )


class _FeedbackControl:
    """The control of each trajectory at a moment, where it answers the states."""

    def __init__(self) -> None:
        self._current_control: Array | None = None

    def of(self, control: Callable[[int, Array], Array]) -> Callable[[int, Array], Array]:
        """Return the same control as a function whose last value is kept."""

        def answered(piece: int, state: Array) -> Array:
            self._current_control = control(piece, state)
            return self._current_control

        return answered

    def now(self, position: int, channels: int) -> Array | None:
        """Return the control ``(m, n)`` that acted until a position; ``None`` at the beginning, and without
        feedback."""
        return None if self._current_control is None or position == 0 else self._current_control[:channels]


class _Envelope:
    """The part of many trajectories that is drawn: the first few, and the envelope of all, at some of the times."""

    def __init__(self, shown: np.ndarray, states: int) -> None:
        self._columns = {int(position): column for column, position in enumerate(shown)}
        self.lower, self.upper = np.full((states, shown.size), np.inf), np.full((states, shown.size), -np.inf)
        self._first_states: list[Array] = []

    def add(self, position: int, state: Array) -> None:
        """Add the states ``(d, n)`` at one of the times."""
        column = self._columns.get(position)
        if column is None:
            return
        if len(self._first_states) < len(self._columns):
            self._first_states.append(state[:, :FAN].copy())
        np.minimum(self.lower[:, column], state.min(axis=1), out=self.lower[:, column])
        np.maximum(self.upper[:, column], state.max(axis=1), out=self.upper[:, column])

    def fan(self) -> Array:
        """Return the first few trajectories ``(n, d, S)``."""
        return np.ascontiguousarray(np.stack(self._first_states).transpose(2, 1, 0))


def _replay_worst_cases(finished: FinishedRun, stored: Mapping[str, Array], started: float) -> Simulation:
    times, states = stored["state_times"], stored["states"]
    attained_violations = attained(stored, times, states)
    shares = []
    for position, name in enumerate(stored["names"].tolist()):
        model = finished.experiment.transcription
        constraint = next(candidate for candidate in model.constraints if candidate.name == name)
        tolerance = TOLERANCE * float(row_units(constraint, model.problem.control).min())
        violated = int(attained_violations[position] > tolerance)
        worst_time = float(stored["times"][position])
        shares.append(
            ConstraintShare(
                name=name,
                violated=violated,
                trajectories=1,
                lower=np.nan,
                upper=np.nan,
                tolerance=tolerance,
                largest=float(attained_violations[position]),
                time=worst_time,
                worst=float(stored["violations"][position]),
                worst_time=worst_time,
                worst_parameter=stored["parameters"][position].tolist(),
                **_get_units(constraint),
            )
        )
    shown = np.unique(np.linspace(0, times.size - 1, min(times.size, SHOWN)).round().astype(int))
    return Simulation(
        title=finished.experiment.title,
        directory=finished.directory,
        status=str(finished.summary["status"]),
        law=ADVERSARY,
        trajectories=len(shares),
        seed=0,
        times=times.size,
        inside=times_inside(times, finished.experiment.transcription.response.grid.breakpoints),
        constraints=shares,
        any_violated=None,
        shown=times[shown],
        fan=states[:, :, shown],
        lower=states[:, :, shown].min(axis=0),
        upper=states[:, :, shown].max(axis=0),
        seconds=time.perf_counter() - started,
    )


def _compute_shares(counts: Sequence[ViolationCount], worst: Mapping[str, Array], count: int) -> list[ConstraintShare]:
    rows = {name: position for position, name in enumerate(worst["names"].tolist())} if worst else {}
    shares = []
    for violation_count in counts:
        row, (lower, upper) = (
            rows.get(violation_count.constraint.name),
            clopper_pearson(violation_count.violated, count),
        )
        shares.append(
            ConstraintShare(
                name=violation_count.constraint.name,
                violated=violation_count.violated,
                trajectories=count,
                lower=lower,
                upper=upper,
                tolerance=violation_count.tolerance,
                largest=violation_count.largest,
                time=violation_count.time,
                worst=np.nan if row is None else float(worst["violations"][row]),
                worst_time=np.nan if row is None else float(worst["times"][row]),
                worst_parameter=() if row is None else worst["parameters"][row].tolist(),
                **_get_units(violation_count.constraint),
            )
        )
    return shares


def _get_units(constraint: StateConstraint) -> dict[str, str]:
    """Return the unit of a constraint's violations, and that of times."""
    return {"unit": join_units(constraint.measured).strip(), "time_unit": constraint.functionals.names.time}


def _merge_shares(shares: Sequence[ConstraintShare], violated: int) -> ConstraintShare:
    """Return all constraints as one, which a trajectory violates when it violates any of them."""
    most_violated, worst = max(shares, key=lambda share: share.largest), max(shares, key=lambda share: share.worst)
    lower, upper = clopper_pearson(violated, most_violated.trajectories)
    return ConstraintShare(
        name=ANY,
        violated=violated,
        trajectories=most_violated.trajectories,
        lower=lower,
        upper=upper,
        tolerance=most_violated.tolerance,
        largest=most_violated.largest,
        time=most_violated.time,
        worst=worst.worst,
        worst_time=worst.worst_time,
        worst_parameter=worst.worst_parameter,
        unit=most_violated.unit if len({share.unit for share in shares}) == 1 else "",
        time_unit=most_violated.time_unit,
    )


def _check_arguments(law: str, trajectories: int | None, seed: int) -> int:
    if law not in LAWS:
        raise InputError(f"law: there is none called {law!r}{nearest(str(law), LAWS)}")
    if law == ADVERSARY and trajectories is not None:
        raise InputError(
            "trajectories: the law adversary replays one trajectory per constraint; expected no number, got"
            f" {trajectories!r}"
        )
    whole("seed", seed, 0)
    return TRAJECTORIES if trajectories is None else whole("trajectories", trajectories, 1)
