"""The worst case of each row over all uncertainty, enclosed from both sides: ``sparserob bound``."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from sparserob_core.control.policies.policy import answers_of
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.studies.suprema import bound_rows
from sparserob_core.control.transcription.terms.accumulated import integrals_as_states
from sparserob_core.errors import InputError
from sparserob_core.experiment.assemble import build, control_problem_of, dictionaries_of, name_of
from sparserob_core.experiment.bound.record import Bound, WorstCase, envelopes, worst_case
from sparserob_core.experiment.config.load import Loaded, load_config
from sparserob_core.experiment.config.matrices.arrays import read_arrays
from sparserob_core.experiment.run.events import StudyProgress
from sparserob_core.experiment.run.given import GivenConfig, as_config, as_run
from sparserob_core.experiment.run.outcome import Outcome, SolvedProblem
from sparserob_core.experiment.study.kit import open_study, write_study
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.limits.deadline import Deadline

__all__ = ["Bound", "WorstCase", "bound"]

NARROWEST = 1e-7  # smallest tolerance, relative to a worst case: with a tenth of it rounding errors would matter


def bound(
    config: GivenConfig,
    overrides: Mapping[str, object] | Iterable[str] | None = None,
    *,
    tolerance: float = 1e-6,
    seconds: float | None = None,
    out: str | Path | None = None,
    write: bool = False,
    notify: Notify = ignore,
) -> Bound:
    """Enclose the worst case of each row over all uncertainty, as ``sparserob bound CONFIG key=value ...`` does.

    Rows are those of path, mixed and terminal constraints with flat sides. A problem without such a constraint has as
    rows the outputs that it measures, or else its states, in both directions and over the whole horizon.

    Parameters
    ----------
    config : str, Path, mapping, OptimalControlProblem or finished run
        A config or a problem, for worst cases without any control; or a run (`as_run`), for those with its control.
    overrides : mapping or iterable of str, optional
        Changes of the config.
    tolerance : float, default 1e-6
        The distance of the two sides that is asked for: relative to the worst case, or to a thousandth of the largest
        value of the row where that is larger.
    seconds : float, optional
        The time limit; ``limits.seconds`` of the config unless given. The bounds that are known by then hold.
    out : str or Path, optional
        The directory for the config, ``bound.json``, ``envelopes.npz`` and ``bound.png``, new or empty. `check`
        verifies it.
    write : bool, default False
        Whether to write ``runs/NAME-bound/STAMP-HASH`` where ``out`` is not given.
    notify : callable, optional
        A function that receives `StudyProgress`.

    Returns
    -------
    Bound
        The worst cases.

    Raises
    ------
    InputError
        If an argument, the config or the run is at fault. A run whose control answers measurements is refused too.
    """
    from sparserob_core.experiment.bound.figure import draw_bound

    if not hasattr(tolerance, "__float__") or not NARROWEST <= float(tolerance) <= 0.1:
        raise InputError(f"tolerance: expected a number from {NARROWEST:g} to 0.1, got {tolerance!r}")
    if seconds is not None and (not hasattr(seconds, "__float__") or not float(seconds) > 0.0):
        raise InputError(f"seconds: expected a positive number, got {seconds!r}")
    started = time.perf_counter()
    control = _read_control(config)
    loaded = load_config(as_config(config), overrides)
    problem = control_problem_of(loaded, "config: expected a control problem, whose rows have worst cases")
    dictionaries = dictionaries_of(loaded, problem.horizon)
    problem, shape = integrals_as_states(problem), (problem.system.controls, dictionaries[0].functions)
    if control is not None:
        _require_matching_control(control, shape, loaded, _has_answering_policy(loaded, problem, dictionaries[0]))
    deadline = Deadline(loaded.config.limits.seconds if seconds is None else float(seconds))

    def report_progress(text: str, done: int, total: int) -> None:
        notify(StudyProgress(text=text, done=done, total=total))

    with open_study(loaded, out, "The experiment whose worst cases were bounded.", "-bound", write) as directory:
        theta = np.zeros(shape) if control is None else control
        try:
            bounded_rows = bound_rows(problem, dictionaries, theta, float(tolerance), report_progress, notify, deadline)
        except InputError as error:
            raise loaded.located(("problem",), error) from error
        rows = tuple(worst_case(problem, row) for row in bounded_rows)
        result = Bound(
            loaded.config.title or name_of(loaded),
            "undecided" if any(row.reason for row in rows) else "certified",
            rows,
            float(tolerance),
            control,
            time.perf_counter() - started,
            remarks=tuple(
                f"{row.constraint}: {row.sense} {row.quantity}"
                + (f" at {row.corner}" if row.corner else "")
                + f": {row.reason}"
                for row in rows
                if row.reason
            ),
            time_unit=problem.names.time,
        )
        if directory is None:
            return result
        draw = draw_bound if any(row.edges.size for row in rows) else None
        more = {"config": loaded.config.digest()}
        return write_study(directory, "bound", result, draw, arrays={"envelopes.npz": envelopes(result)}, more=more)


def _has_answering_policy(loaded: Loaded, problem: OptimalControlProblem, control: Dictionary) -> bool:
    """Return whether the policy of a config answers any measurement."""
    policy = build(loaded, "policy", loaded.config.policy)
    return bool(answers_of(policy, control.breakpoints, problem.measurements).any())


def _require_matching_control(theta: Array, shape: tuple[int, int], loaded: Loaded, answering: bool) -> None:
    """Raise `InputError` unless the control of a run belongs to the config, and answers no measurement."""
    if answering:
        expected = "open_loop, for worst cases with the control of a run"
        raise loaded.located((), InputError(path="policy.name", expected=expected, got=loaded.config.policy.name))
    if theta.shape != shape or theta.dtype.kind != "f" or not np.isfinite(theta).all():
        raise InputError(
            f"solution.npz: theta: expected finite numbers of shape {shape}, as the config says, got shape"
            f" {theta.shape}"
        )


def _read_control(config: object) -> Array | None:
    """Return the coefficients of the control of a run; ``None`` where no run was given."""
    if isinstance(config, Outcome | SolvedProblem):
        path = as_run(config)[0]
    elif isinstance(config, str | Path) and (Path(config) / "result.json").is_file():
        path = Path(config)
    else:
        return None
    solution = read_arrays(path / "solution.npz")
    if "theta" not in solution:
        raise InputError(f"{path}: there is no control in it; a config bounds worst cases without any")
    return solution["theta"]
