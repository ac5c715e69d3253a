"""The record of a run in its directory: its rounds as they come, and its outcome or the point at which it ended."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, final

import numpy as np

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.studies.answer import ControlResult
from sparserob_core.errors import Path, SparseRobError, dotted
from sparserob_core.experiment.assemble import Experiment, build
from sparserob_core.experiment.config.load import Loaded
from sparserob_core.experiment.config.run_config import RunConfig
from sparserob_core.experiment.directory.adversary import FILE as ADVERSARY
from sparserob_core.experiment.directory.adversary import adversaries
from sparserob_core.experiment.directory.artefacts import RunDirectory, trace_columns
from sparserob_core.experiment.directory.certificate import certificate
from sparserob_core.experiment.directory.record import arrays_of, control_of, summary_of, versions
from sparserob_core.experiment.directory.rounds import round_arrays
from sparserob_core.experiment.run.events import EvaluationsFinished, Event, Observer, RoundFinished, StudyProgress
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.result import Result
from sparserob_core.sip.solver import AUTO, Unanswered, whole_name

STOPPED = "no figures: the run was stopped; sparserob figures draws them"


@final
class Journal(Observer):
    """The observer that keeps the rounds of a run and writes its files.

    A run that ends early leaves the rounds that it has finished.
    """

    def __init__(self, directory: RunDirectory, experiment: Experiment, origin: Mapping[str, Any]) -> None:
        self.directory, self.experiment, self.origin = directory, experiment, origin
        self.rounds: list[RoundFinished] = []
        self.asked = False

    def receive(self, event: Event) -> None:
        """Keep every round, and the fact that the maximiser was called."""
        self.asked |= isinstance(event, EvaluationsFinished)
        if isinstance(event, RoundFinished):
            self.rounds.append(event)

    def record(self, result: Result) -> tuple[Array | None, dict[str, Any]]:
        """Write ``result.json``; returns the control ``(m, K)`` and the contents of the file."""
        control = control_of(result, self.experiment.model)
        config = self.experiment.loaded.config
        summary = {
            "title": self.experiment.title,
            **summary_of(result, control, self.experiment.model),
            **self._describe_cost(result),
            **self._report_causal_bound(result),
            "notes": list(_list_notes(self.experiment.loaded, result, self.asked)),
            "seed": config.seed,
            "versions": versions(),
            "config": config.digest(),
            "provenance": self.origin,
        }
        self.directory.write_json("result.json", summary)
        return control, summary

    def _describe_cost(self, result: Result) -> dict[str, str]:
        """Return the terms of the cost in words, where it is not the L1 norm alone."""
        problem = self.experiment.problem
        if problem is None or result.sparsest is not None:
            return {}
        words = problem.cost.words()
        return {"cost_of": words} if words else {}

    def _report_causal_bound(self, result: Result) -> dict[str, Any]:
        """Return the entries of ``result.json`` about causal policies; there are none without feedback.

        They are the least cost of any causal policy, whether none exists, and the reason for which the search ended.
        The cost is ``null`` where nothing is proven or no policy exists.
        """
        model = self.experiment.model
        if model is None or model.feedback is None:
            return {}
        bound = result.causal if isinstance(result, ControlResult) else None
        lower = None if bound is None or not np.isfinite(bound.lower) else bound.lower
        return {
            "causal_lower_bound": lower,
            "causal_infeasible": bound is not None and bound.lower == np.inf,
            "causal_ended": None if bound is None else bound.ended,
        }

    @property
    def _dictionary(self) -> Dictionary | None:
        model = self.experiment.model
        return None if model is None else model.control

    def known(self, said: str, seconds: float) -> Result | None:
        """Return the result of a run whose method was interrupted: the decision of the last round, undecided.

        Parameters
        ----------
        said : str
            The reason of the interrupt, in words.
        seconds : float
            The seconds since the run began.

        Returns
        -------
        Result or None
            The result; ``None`` where no round had a decision.
        """
        last = next((entry for entry in reversed(self.rounds) if entry.decision is not None), None)
        if last is None:
            return None
        multipliers = last.multipliers if len(last.multipliers) == len(last.imposed) else np.zeros(len(last.imposed))
        return replace(
            self._build_unfinished_result(said, seconds),
            status="undecided",
            message=f"{said} after round {last.round}; nothing is proven of its control",
            stopped=said,
            decision=last.decision,
            cost=last.cost,
            indices=[replace(cut, multiplier=float(y)) for cut, y in zip(last.imposed, multipliers, strict=True)],
        )

    def record_unfinished(self, said: str, seconds: float) -> None:
        """Write the results of a run that ended early, with the reason ``said``."""
        try:
            self.record(self._build_unfinished_result(said, seconds))
            self.directory.write_arrays("trace.npz", trace_columns(self.rounds))
        except SparseRobError:
            return  # the error that ended the run is the one to be shown

    def _build_unfinished_result(self, said: str, seconds: float) -> Result:
        result = Result(status="failed", message=said, history=tuple(self.rounds), seconds=seconds)
        if not self.rounds:
            return result
        last = self.rounds[-1]
        counts = {"relaxed_programs": last.relaxed_programs, "active_indices": last.active_indices}
        return replace(result, lower_bound=last.lower_bound, epsilon=last.epsilon, counts=counts)

    def finish(
        self,
        result: Result,
        figures: bool,
        notify: Notify = ignore,
        deadline: Deadline | None = None,
    ) -> tuple[Array | None, dict[str, Any], Sequence[str]]:
        """Write the outcome of a run, its certificate and its figures.

        Parameters
        ----------
        result : Result
            The result.
        figures : bool
            Whether figures are drawn. A result that was stopped is not drawn.
        notify : callable, optional
            A function that receives `StudyProgress`, for each phase and where a figure takes longer.
        deadline : Deadline, optional
            The time after which nothing is drawn.

        Returns
        -------
        control : array (m, K) or None
            The control on its pieces.
        summary : dict
            The contents of ``result.json``.
        drawn : sequence of str
            Warnings about figures that could not be drawn.
        """
        experiment, write, time_left = self.experiment, self.directory, deadline or Deadline()
        control, summary = self.record(result)
        model = self.experiment.model
        feedback = None if model is None or result.decision is None else model.feedback
        answers = {} if feedback is None else feedback.loop.written(np.asarray(result.decision))
        write.write_arrays("solution.npz", arrays_of(result, experiment.program, self._dictionary, control, answers))
        rounds = self.rounds or list(result.history)
        write.write_arrays("trace.npz", trace_columns(rounds))
        kept = round_arrays(rounds)
        if kept:
            write.write_arrays("rounds.npz", kept)
        notify(StudyProgress(text="certificate: written down", phase=True))
        proof = certificate(experiment, result)
        if proof is not None:
            write.write_json("certificate.json", proof)
        if result.trace is not None:
            write.write_arrays("evaluations.npz", result.trace.arrays())
        drawn: tuple[str, ...] = (STOPPED,) if figures else ()
        if not result.stopped:  # what is drawn may take longer than what was solved
            notify(StudyProgress(text="figures: the worst cases, and what there is to draw", phase=True))
            drawn = time_left.attempt(lambda: self._write_figures(result, control, figures, notify), lambda: drawn)
        return control, summary, drawn

    def _write_figures(self, result: Result, control: Array | None, figures: bool, notify: Notify) -> tuple[str, ...]:
        """Write the worst cases and the figures; returns warnings about figures that could not be drawn."""
        worst = adversaries(self.experiment, np.asarray(result.decision)) if control is not None else {}
        if worst:
            self.directory.write_arrays(ADVERSARY, worst)
        if not figures:
            return ()
        from sparserob_core.experiment.run.drawing import drawn

        return drawn(self.experiment, result, self.directory.path, worst, notify)


def _list_notes(loaded: Loaded, result: Result, asked: bool) -> Iterator[Mapping[str, str]]:
    """Yield notes on components that the config of a run names: the key, its place and the note.

    There is a note where a component had nothing to do, or where a solver left programs to another. ``asked`` says
    whether the maximiser was called.
    """
    yield from _list_solver_notes(loaded, result)
    if not result.history:
        return  # the run ended before any component was needed
    if not asked:
        note = "it was never asked: the worst cases of this problem are known in closed form, or nothing can be moved"
        yield from _list_component_notes(loaded, ("maximiser",), note)
    weights = [event.epsilon for event in result.history]
    searched = [] if result.trace is None else list(result.trace.epsilon)
    if not any(weight > 0.0 for weight in (*weights, *searched, result.epsilon)):
        yield from _list_component_notes(
            loaded, ("regulariser",), "it had no effect: every program was solved without it (epsilon is 0)"
        )


def _list_solver_notes(loaded: Loaded, result: Result) -> Iterator[Mapping[str, str]]:
    chosen = loaded.config.solver.name
    name = whole_name(build(loaded, "solver", loaded.config.solver), chosen)
    groups: dict[tuple[str, str], list[Unanswered]] = {}
    for item in result.unanswered:
        groups.setdefault((item.kind, item.by), []).append(item)
    for (kind, by), items in groups.items():  # one note, whose number is that of the table, for all reasons together
        reason = (
            items[0].reason if len(items) == 1 else "; ".join(f"{item.count} of them: {item.reason}" for item in items)
        )
        note = f"{name} did not answer {sum(item.count for item in items)} of the {kind} programs, {by} did: {reason}"
        yield from _list_component_notes(loaded, ("solver",), note)
    if chosen != AUTO and not result.counts.get("solver_calls"):
        yield from _list_component_notes(
            loaded, ("solver",), f"{name} was not asked: this run came to its end without a finite program"
        )


def _list_component_notes(loaded: Loaded, slot: Path, note: str) -> Iterator[Mapping[str, str]]:
    """Yield a note on a component, where the config or an override names it.

    A complete config, such as that of a run directory, names every component. A note is then given only for one that is
    not the default.
    """
    location, written = loaded.place(slot), loaded.config.plain()
    if not written[str(slot[0])]:
        return  # the config says that there is none
    if set(written) <= set(loaded.source.data) and written[str(slot[0])]["name"] == _find_default(slot):
        location = None
    if location is not None:
        yield {"key": dotted((*slot, "name")), "place": location, "note": note}


def _find_default(slot: Path) -> str:
    """Return the name of the component that is the default of a slot."""
    return str(RunConfig.model_fields[str(slot[0])].default.name)
