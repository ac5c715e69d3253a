"""The contents of ``result.json`` and ``solution.npz``, from the result of a run."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cache
from importlib import metadata
from types import MappingProxyType
from typing import Any

import numpy as np

from sparserob_core.control.constraints.control import of_control
from sparserob_core.control.constraints.explanation import Witness
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.names import measured_in
from sparserob_core.control.transcription.own_units import fixed
from sparserob_core.control.transcription.program import EQUALS
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.experiment.directory.rounds import BOUND
from sparserob_core.experiment.directory.sparsity import sparsity, verdict
from sparserob_core.quantities import statistics
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Cut, Proof
from sparserob_core.sip.program import TOLERANCE, EqualityErrors, SemiInfiniteProgram, WorstConstraint
from sparserob_core.sip.result import Result

PROVEN = ("certified", "verified")
"""Statuses with an upper bound: without a proof of the constraints the cost is no bound, whatever a search suggests."""
PACKAGES = ("sparserob", "numpy", "scipy", "piqp", "proxsuite", "clarabel")


def summary_of(result: Result, control: Array | None, model: Transcription | None) -> dict[str, Any]:
    """Return the contents of ``result.json`` except for what only the run knows (title, seed, versions).

    ``control (m, K)`` and ``model`` are those of a control problem.
    """
    acting = asdict(sparsity(control, model.control.breakpoints)) if control is not None and model is not None else None
    units = {} if model is None else units_of(model, result)
    parameters = () if model is None or model.problem.system.parameters is None else model.problem.system.names
    is_proven = result.status in PROVEN
    numbers = dict[str, Any]()
    for name, described in statistics(type(result)).items():
        numbers[name] = getattr(result, name) if is_proven or not described.proven else None
        if name == "cost" and result.sparsest is not None and result.decision is not None:
            numbers["J"] = result.sparsest.norm
    seconds = numbers.pop("seconds")
    return {
        **numbers,
        "worst": _report_worst(result.worst, None if model is None else model.stated.system.states),
        **({"units": units} if units else {}),
        **({"parameters": list(parameters)} if parameters else {}),
        "tolerances": {proof.family: _report_tolerance(proof) for proof in result.proofs if proof.verdict == "proven"},
        **({} if result.errors is None else {"equalities": _report_equalities(result.errors)}),
        "sparsity": {
            **(acting or {"active_fraction": None, "switches": None}),
            **({} if model is None else {"channels": model.problem.system.controls}),
            "fewest_active": None
            if result.activity is None
            else {"lower": result.activity.lower, "upper": result.activity.upper},
            "verdict": verdict(result),
        },
        "counts": {
            "relaxed_programs": 0,
            "rounds": len(result.history),
            "active_indices": len(result.indices),
            **result.counts,
            **({"solved_by": dict(result.solved_by)} if result.solved_by else {}),
        },
        **({} if result.scenario_bound is None else {"scenario_bound": asdict(result.scenario_bound)}),
        "seconds": seconds,
    }


def units_of(model: Transcription, result: Result) -> dict[str, Any]:
    """Return the units of ``result.json``; none where the problem names none.

    They are those of ``time``, of the ``states``, of the ``cost`` and its bounds, and of ``J``. ``rows`` has those of
    every row of a constraint, by its name; ``worst`` is that of the worst violation.
    """
    names = model.problem.names
    if not (names.time or names.state_units or names.control_units):
        return {}
    rows = {constraint.name: list(constraint.measured) for constraint in model.constraints}
    control_units = set(names.control_units)
    control_unit = (
        control_units.pop() if len(control_units) == 1 and model.problem.control.halfspaces() is not None else ""
    )
    rows |= {EQUALS: [measured_in(axis, names).strip() for axis in fixed(model.problem)[0]]}
    rows |= {name: [control_unit] for name in (of_control(model.problem), "control_step") if name not in rows}
    worst = result.worst
    row_units = [] if worst is None else rows.get(worst.constraint, [])
    measured = row_units[0 if len(row_units) == 1 else worst.row] if worst is not None and row_units else ""
    effort = model.problem.cost_unit
    return {
        "time": names.time,
        "states": list(names.state_units)[: model.stated.system.states],
        "cost": effort if result.sparsest is None else names.time,
        "J": effort,
        "rows": rows,
        "worst": measured,
    }


def _report_tolerance(proof: Proof) -> dict[str, Any]:
    """Return what was proven of one constraint.

    A violation is at most ``proven`` of each row's own unit (negative: a margin), and ``kept`` of every row in the
    user's units. ``rows`` is the violation of every row that counts as none, in the user's units: at most `TOLERANCE`
    of its size.
    """
    share = proof.bound if proof.share is None else proof.share
    return {
        "own": TOLERANCE,
        "proven": share,
        "kept": None if proof.units is None else share * proof.units,
        "rows": None if proof.units is None else proof.allowed * proof.units,
    }


def _report_equalities(errors: EqualityErrors) -> dict[str, Any]:
    """Return the error bound of every fixed final state (``missed``), and the error that is allowed (``excused``), in
    its unit."""
    return {"missed": errors.missed, "excused": errors.allowed}


def _report_worst(worst: WorstConstraint | None, states: int | None) -> dict[str, Any]:
    """Return the worst constraint; its initial state has the first ``states`` coordinates, those of the user."""
    return {
        "violation": None if worst is None else worst.violation,
        "constraint": None if worst is None else worst.constraint,
        "time": worst.time if isinstance(worst, Witness) else None,
        "parameter": worst.parameter if isinstance(worst, Witness) else None,
        **(
            {"initial_state": worst.initial_state[:states]}
            if isinstance(worst, Witness) and worst.initial_state is not None
            else {}
        ),
        **({"corner": worst.corner} if isinstance(worst, Witness) and worst.corner else {}),
    }


def control_of(result: Result, model: Transcription | None) -> Array | None:
    """Return the control ``(m, K)`` on every piece of the dictionary; under feedback the nominal one.

    Returns ``None`` without a decision, and for a program of another kind.
    """
    if result.decision is None or model is None:
        return None
    return model.pieces(np.asarray(result.decision))


def _extract_nominal(decision: Array | None, program: SemiInfiniteProgram, dictionary: Dictionary) -> Array:
    """Return the coefficients ``(m, N)`` of the control; under feedback of the nominal one, with which a decision
    begins."""
    count = program.channels * dictionary.functions
    return np.asarray(decision)[:count].reshape(program.channels, dictionary.functions)


def arrays_of(
    result: Result,
    program: SemiInfiniteProgram,
    dictionary: Dictionary | None,
    control: Array | None,
    answers: Mapping[str, Array] = MappingProxyType({}),
) -> dict[str, Any]:
    """Return the arrays of ``solution.npz``.

    Parameters
    ----------
    result : Result
        The result of a run.
    program : SemiInfiniteProgram
        Its program.
    dictionary : Dictionary or None
        The dictionary of the control, for a control problem.
    control : array (m, K) or None
        The control on its pieces.
    answers : mapping
        Under feedback ``gains (K, K, m, p)`` and, for outputs, the ``observer (K, d, p)``.

    Returns
    -------
    dict of arrays
        The ``decision``; for a control problem also ``breakpoints``, ``control`` and ``theta``; and the ``answers``.
        For each imposed index one row of ``times``, ``indices`` (padded with NaN where families differ in dimension),
        ``rows``, ``families``, ``formulations`` (the meaning of the index) and ``multipliers``. ``worst_disturbance
        (mw, pieces)`` where the worst constraint has one. The constraints that prove the lower bound are
        ``bound_indices``, ``bound_rows``, and so on; ``bound_equalities`` are the multipliers of the equalities. Under
        feedback the index of each constraint of the bound is followed by its deviation.
    """
    columns = _stack_cuts(result.indices)
    count, width = columns["indices"].shape
    arrays = {
        "decision": np.zeros(0) if result.decision is None else result.decision,
        "times": columns["indices"][:, 0] if dictionary is not None and width else np.full(count, np.nan),
        **columns,
    }
    if answers or result.dual.mu.size or result.dual.cuts:
        proving = {**_stack_cuts(result.dual.cuts), "equalities": result.dual.mu}
        arrays |= {f"{BOUND}{name}": column for name, column in proving.items()}
    if dictionary is not None:
        arrays["breakpoints"] = dictionary.breakpoints
    if isinstance(result.worst, Witness) and result.worst.disturbance is not None:
        arrays["worst_disturbance"] = result.worst.disturbance
    arrays |= answers
    if control is not None and dictionary is not None:
        arrays |= {
            "control": control,
            "theta": _extract_nominal(result.decision, program, dictionary),
        }
    return arrays


def _stack_cuts(cuts: Sequence[Cut]) -> dict[str, Array]:
    """Return constraints as arrays, one row each."""
    indices = np.full((len(cuts), max((np.size(cut.index) for cut in cuts), default=0)), np.nan)
    for position, cut in enumerate(cuts):
        indices[position, : np.size(cut.index)] = cut.index
    return {
        "indices": indices,
        "rows": np.array([cut.row for cut in cuts], dtype=int),
        "families": np.array([cut.family for cut in cuts], dtype=str),
        "formulations": np.array([cut.formulation for cut in cuts], dtype=str),
        "multipliers": np.array([cut.multiplier for cut in cuts], dtype=float),
    }


def versions(packages: tuple[str, ...] = PACKAGES) -> dict[str, str]:
    """Return the versions of Python and of the packages that decide the numbers."""
    installed = {package: _find_version(package) for package in packages}
    return {
        "python": platform.python_version(),
        **{name: version for name, version in installed.items() if version is not None},
    }


@cache
def _find_version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except Exception:  # noqa: BLE001  not installed, or a broken folder, for which each Python raises another error
        return None
