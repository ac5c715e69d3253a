"""The contents of ``certificate.json``: the claims of a run and everything that proves them, but not how it was
found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.control.constraints.explanation import TimedExplanation, in_numbers
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.sets.sets import ConvexSet
from sparserob_core.control.studies.answer import ControlResult
from sparserob_core.control.transcription.program import slanted_sides
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.control.transcription.steps import Steps
from sparserob_core.experiment.assemble import ControlExperiment, Experiment, PlainExperiment
from sparserob_core.quantities import statistics
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Activity, Branch, Dual, Proof
from sparserob_core.sip.program import TOLERANCE
from sparserob_core.sip.result import Result
from sparserob_core.sip.stated.statement import StatedProgram
from sparserob_core.sip.working.unbounded import complete_multipliers

if TYPE_CHECKING:
    from sparserob_core.control.studies.causal import CausalBound

FORMAT = 1  # the version of `certificate.json`, by which older ones are read
MANY_CELLS = 1000  # number of cells from which neighbours that are whole pieces are written as one
INWARD_FACTOR = 1.0 - 1e-13  # factor by which points of a curved set are moved inwards, against rounding errors
WELL = 1e-14  # distance from the boundary at which a point need not be moved, relative to that from the middle


def certificate(experiment: Experiment, result: Result) -> dict[str, Any] | None:
    """Return the certificate of a result, as plain data.

    ``cost`` and ``lower_bound`` are those of ``result.json``. The other keys:

    ``multipliers``
        They belong to constraints at a time, a parameter and a normal direction (of the state, or of the control and
        its steps), and to equalities. Others belong to the control's pieces where the dictionary is not that of their
        indicators. ``tangent`` is the control at which the bound replaces quadratic terms and norms of the cost by
        their tangents. ``norms`` are vectors that may replace norms, on every piece, where the control's set has
        slanted sides.
    ``proof``
        For each constraint the cells ``[lower, upper]`` of (time, parameters, directions) on which it was shown, to a
        ``tolerance`` in each row's own unit (decision 0016). A direction ``z`` of a curved set stands for ``z
        normals``.
    ``fewest_active``
        The bounds of the least share of time for which any admissible control must act. Their multipliers are those of
        a program of its own, or those of the cost where there are none. The decision that acts least and its proof are
        added where this is another one.
    ``J``, ``tree``
        Where the cost is the time for which the control acts: the usual cost, and the parts of the controls, each with
        multipliers of its own.
    ``witness``
        The case that refutes the decision.
    ``repeat``
        The plan is repeated for ever from the horizon on. Its steps across the seam are constraints of ``control_step``
        at the horizon. Under feedback each is also at a deviation ``following`` of the next period's initial state.

    Under feedback ``decision`` is the nominal control, and ``gains (K, K, m, p)`` answer the innovations. The
    ``observer (K, d, p)`` makes innovations of outputs. ``policy`` has the cost that is charged, and the breakpoints
    that every piece answers, as ranges ``[first, last]`` counted from 0. Every constraint with a multiplier is at a
    ``disturbance``. It is also at a ``deviation`` of the initial state from its centre where there is a set of them,
    and at a ``noise (K, p)`` of the outputs. ``causal`` is the bound for every causal policy.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    result : Result
        Its result.

    Returns
    -------
    dict or None
        The certificate; ``None`` for a program that was not stated as text, and for a run that failed. A run that was
        stopped before it was transcribed has the lower bound alone (`bare_certificate`). So has a run that was stopped
        before there was a decision.
    """
    if result.status == "failed":
        return None
    if isinstance(experiment, PlainExperiment):
        return _certify_program(experiment, result)
    if not isinstance(experiment, ControlExperiment):
        return bare_certificate(experiment, result)
    program = experiment.program
    theta = (
        None
        if result.decision is None
        else experiment.transcription.nominal(result.decision).reshape(program.channels, experiment.control.functions)
    )
    feedback = experiment.transcription.feedback
    policy_keys: dict[str, Any] = {}
    if feedback is not None:
        policy_keys["policy"] = {
            "cost": feedback.charge.cost,
            "answers": [_find_ranges(row) for row in feedback.answers],
        }
        policy_keys |= feedback.loop.written(None if result.decision is None else np.asarray(result.decision))
    causal = result.causal if isinstance(result, ControlResult) and result.causal and result.causal.rows else None
    return {
        "format": FORMAT,
        "config": experiment.loaded.config.digest(),
        **_write_claims(result),
        "gap_tolerance": experiment.gap_tolerance,
        **({"repeat": True} if experiment.transcription.problem.repeat else {}),
        "decision": theta,
        **policy_keys,
        **_write_bound_proof(experiment, result),
        **_write_fewest_active(experiment, result.activity),
        **({} if causal is None else {"causal": causal_data(causal)}),
        "proof": _write_proofs(experiment, result.proofs),
        "witness": _write_witness(experiment, result) if result.status == "refuted" else None,
    }


def _certify_program(experiment: PlainExperiment, result: Result) -> dict[str, Any] | None:
    """Return the certificate of a program that was stated as text; ``None`` for another one, whose rows nobody knows.

    ``multipliers`` are those of ``constraints``, each a row of a family at an index, of the ``rows`` without an index,
    and of the ``equalities``, to which those that define residuals belong; ``tangent`` is the point at which products
    of the objective are replaced by their tangent. A ``decision`` ends with the residuals.
    """
    if not isinstance(experiment.program.origin, StatedProgram):
        return None
    dual, worst = complete_multipliers(experiment.program, result.dual, result.status != "infeasible"), result.worst
    has_multipliers = dual.mu.size == experiment.program.finite.b.size
    witness = (
        None
        if result.status != "refuted" or worst is None
        else {"family": worst.constraint, "index": worst.index, "row": worst.row, "violation": worst.violation}
    )
    return {
        "format": FORMAT,
        "config": experiment.loaded.config.digest(),
        **_write_claims(result),
        "gap_tolerance": experiment.gap_tolerance,
        "decision": result.decision,
        "multipliers": None
        if not has_multipliers
        else {
            "constraints": [
                {"family": cut.family, "index": cut.index, "row": cut.row, "multiplier": cut.multiplier}
                for cut in dual.cuts
            ],
            "rows": dual.of_fixed_rows(experiment.program.finite.h.size),
            "equalities": dual.mu,
            "tangent": dual.at,
        },
        "witness": witness,
    }


def bare_certificate(experiment: Experiment, result: Result) -> dict[str, Any]:
    """Return the certificate of a result of which only the lower bound 0 is proven: no term of a cost is negative."""
    return {
        "format": FORMAT,
        "config": experiment.loaded.config.digest(),
        **_write_claims(result),
        "decision": None,
        "multipliers": None,
        "proof": {},
    }


def _write_claims(result: Result) -> dict[str, Any]:
    """Return the statistics of a result that its certificate claims."""
    return {name: getattr(result, name) for name, entry in statistics(type(result)).items() if entry.certified == name}


def _find_ranges(row: np.ndarray) -> list[list[int]]:
    """Return the ranges ``[first, last]`` of consecutive true values among ``(K,)``."""
    changes = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
    return [[int(first), int(end) - 1] for first, end in changes.reshape(-1, 2)]


def causal_data(bound: CausalBound) -> dict[str, Any]:
    """Return a bound for every causal policy, as plain data.

    ``lower_bound`` is ``null`` where no policy exists. ``signals`` are disturbances ``(mw, blocks)``, and the
    ``multipliers`` belong to constraints under one of them. With the cost ``worst`` the ``shares`` are the weights of
    the effort under every signal.
    """
    return {
        "lower_bound": bound.lower if np.isfinite(bound.lower) else None,
        "signals": list(bound.signals),
        **({"shares": list(bound.shares)} if bound.shares else {}),
        "multipliers": [
            {
                "signal": row.signal,
                "constraint": row.constraint,
                "time": row.time,
                "direction": row.direction + 0.0,
                "multiplier": row.multiplier,
            }
            for row in bound.rows
        ],
    }


def _write_bound_proof(experiment: ControlExperiment, result: Result) -> dict[str, Any]:
    """Return the multipliers of the cost; or, where the time of action is the cost, the usual cost and the tree of
    parts."""
    if result.sparsest is None:
        return {"multipliers": _write_multipliers(experiment, result.dual)}
    numbers: dict[str, int] = {}
    distinct_constraints: list[dict[str, Any]] = []
    nodes: list[dict[str, Any]] = []
    for node in result.sparsest.tree:
        if isinstance(node, Branch):
            channel, piece = divmod(node.image, experiment.control.pieces)
            at = {} if node.at is None else {"at": list(node.at)}
            nodes.append({"channel": channel, "piece": piece, "first": node.first, "second": node.second, **at})
            continue
        multipliers = (
            _write_multipliers(experiment, node.dual) if node.dual.mu.size == experiment.program.finite.b.size else None
        )
        if multipliers is None:
            return {"multipliers": None, "J": result.sparsest.norm}
        pairs = []
        for entry in multipliers["constraints"]:
            plain = {name: value for name, value in entry.items() if name != "multiplier"}
            number = numbers.setdefault(repr(plain), len(numbers))
            if number == len(distinct_constraints):
                distinct_constraints.append(plain)
            pairs.append([number, entry["multiplier"]])
        others: dict[str, Any] = {name: multipliers[name] for name in ("equalities", "late") if name in multipliers}
        nodes.append({"multipliers": pairs, **others, "feasible": node.feasible})
    tree = {"constraints": distinct_constraints, "nodes": nodes}
    norm = {} if result.status == "infeasible" else {"J": result.sparsest.norm}
    return {"multipliers": None, **norm, "tree": tree}


def _write_fewest_active(experiment: ControlExperiment, activity: Activity | None) -> dict[str, dict[str, Any]]:
    if activity is None:
        return {}
    program = experiment.program
    own = None if activity.dual is None else _write_multipliers(experiment, activity.dual)
    entries: dict[str, Any] = {}
    if activity.decision is not None:
        theta = experiment.transcription.nominal(activity.decision)
        theta = theta.reshape(program.channels, experiment.control.functions)
        entries = {"decision": theta, "proof": _write_proofs(experiment, activity.proofs)}
    return {"fewest_active": {"lower": activity.lower, "upper": activity.upper, "multipliers": own, **entries}}


def _write_proofs(experiment: ControlExperiment, proofs: Sequence[Proof]) -> dict[str, Any]:
    """Return the proof of each constraint; under feedback constraints on the control have none, as they need no
    cells."""
    names = {constraint.name for constraint in experiment.transcription.constraints}
    kept = [proof for proof in proofs if experiment.transcription.feedback is None or proof.family in names]
    return {proof.family: _write_cells(experiment, proof) for proof in kept if proof.verdict == "proven"}


def _write_multipliers(experiment: ControlExperiment, dual: Dual) -> dict[str, Any] | None:
    """Return the multipliers of a bound with their constraints, as plain data.

    Returns ``None`` unless every constraint can be written in numbers, which is not so for a sample of the scenario
    approach. Under feedback a constraint is at a disturbance, on its own pieces ``(mw, pieces)``.
    """
    problem, program = experiment.problem, experiment.program
    z, late = _split_multipliers(experiment.transcription, dual.z)
    steps = Steps.of(problem, experiment.control)
    pairs = zip(dual.cuts, experiment.transcription.explained(dual.cuts), strict=True)
    explained = [(cut, explanation) for cut, explanation in pairs if explanation is not None]
    if len(explained) < len(dual.cuts) or dual.mu.size != program.finite.b.size:
        return None
    return {
        "constraints": [
            {
                "constraint": cut.family,
                "time": explanation.time,
                "parameter": [] if cut.family == "control_step" else _write_parameter(problem, explanation),
                **_write_direction(explanation),
                "multiplier": cut.multiplier,
                **({} if program.spread is None else {"disturbance": _write_disturbance(problem, explanation)}),
                **({} if program.spread is None else _write_deviations(problem, explanation)),
                **_write_noise(problem, explanation),
            }
            for cut, explanation in explained
        ]
        + [
            {"constraint": "control_step", "time": t, "parameter": [], "direction": c + 0.0, "multiplier": y}
            for t, c, y in ([] if z is None or not steps.count else steps.priced(z[-steps.count :]))
        ],
        "equalities": dual.mu,
        **({} if late is None else {"late": late}),
        "pieces": _sum_piece_multipliers(problem, z, experiment.control.pieces),
        **(
            {}
            if z is None or problem.cost.group is None
            else {"norms": _extract_norm_multipliers(problem, z, experiment.control.pieces)}
        ),
        **(
            {}
            if dual.at is None
            else {"tangent": experiment.transcription.nominal(dual.at).reshape(problem.system.controls, -1)}
        ),
    }


def _split_multipliers(model: Transcription, z: Array | None) -> tuple[Array | None, Array | None]:
    """Return multipliers of the images without those of the bounds of sizes; and those of changes ``(m, K - 1)`` that
    may come late, ``None`` where every size is that of a value.

    Two bounds limit each size, one from either side; their multipliers enter with opposite signs.
    """
    execution = model.functionals.execution
    if z is None or execution is None:
        return z, None
    size, m, values = execution.size, model.problem.system.controls, model.program.image_size
    above, below = z[-2 * size : -size], z[-size:]
    sizes = (below - above).reshape(m, -1)
    if not model.problem.jitter:
        return np.concatenate([z[:values] + sizes.ravel(), z[values : -2 * size]]), None
    return z[: -2 * size], sizes[:, 1::2]


def _sum_piece_multipliers(problem: OptimalControlProblem, z: Array | None, pieces: int) -> Array | None:
    """Return the multipliers of the control ``(m, K)`` on its ``pieces``, with those of its set's slanted sides
    added."""
    if z is None:
        return None
    m, (sides, _) = problem.system.controls, slanted_sides(problem.control)
    rows = z[: (m + sides.shape[0]) * pieces].reshape(-1, pieces)
    answer: Array = rows[:m] + sides.T @ rows[m:]
    return answer


def _extract_norm_multipliers(problem: OptimalControlProblem, z: Array, pieces: int) -> Array:
    """Return the multipliers of the control ``(m, K)`` on its ``pieces`` without those of its set's slanted sides.

    The bound replaces norms by them; neither slopes nor tangent give them accurately.
    """
    answer: Array = z[: problem.system.controls * pieces].reshape(-1, pieces)
    return answer


def _write_parameter(problem: OptimalControlProblem, said: TimedExplanation) -> Array:
    """Return the parameter of a constraint, certainly inside its set; without uncertainty the middle one."""
    bound = problem.system.parameters
    if bound is None:
        return np.zeros(0)
    middle = bound.interior_point()
    return _move_inside(bound, np.asarray(said.parameter_or(middle)), middle)


def _write_direction(said: TimedExplanation) -> dict[str, Any]:
    """Return the normal of a constraint; for a mixed one also its part on the control, and the piece of that."""
    if said.gain is None:
        return {"direction": said.direction + 0.0}  # no negative zeros
    return {"direction": np.concatenate([said.direction, said.gain]) + 0.0, "piece": said.piece}


def _write_disturbance(problem: OptimalControlProblem, said: TimedExplanation) -> Array | None:
    """Return the disturbance of a constraint, certainly in its set on every piece; ``None`` where there is none."""
    bound = problem.disturbance
    if bound is None or said.disturbance is None:
        return None
    middle = bound.interior_point()
    return (
        np.array([_move_inside(bound, column, middle) for column in said.disturbance.T]).reshape(-1, bound.dimension).T
    )


def _write_deviations(problem: OptimalControlProblem, said: TimedExplanation) -> dict[str, Array]:
    """Return the deviations of the initial states of this and of the next period, certainly in their set.

    The mapping is empty where the constraint has none.
    """
    bound = problem.initial_set
    if bound is None or said.deviation is None:
        return {}
    deviations = {"deviation": said.deviation, "following": said.following}
    middle = bound.interior_point()
    return {
        name: _move_inside(bound, deviation, middle) for name, deviation in deviations.items() if deviation is not None
    }


def _write_noise(problem: OptimalControlProblem, said: TimedExplanation) -> dict[str, Array]:
    """Return the noise ``(K, p)`` of a constraint, certainly in its set; the mapping is empty where there is none."""
    bound = None if problem.measurements is None else problem.measurements.noise
    if bound is None or said.noise is None:
        return {}
    return {"noise": np.array([_move_inside(bound, row, bound.interior_point()) for row in said.noise])}


def _move_inside(bound: ConvexSet, point: Array, middle: Array) -> Array:
    if bound.is_box:
        box = bound.bounding_box()
        return np.asarray(np.clip(point, box.lower, box.upper))
    if float(bound.violation(point)) < -WELL * float(np.abs(point - middle).max()):
        return point
    answer: Array = middle + INWARD_FACTOR * (point - middle)
    return answer


def _write_cells(experiment: ControlExperiment, proof: Proof) -> dict[str, Any]:
    lower, upper = proof.leaves if proof.leaves is not None else (np.zeros((0, 0)), np.zeros((0, 0)))
    constraint = next(
        (constraint for constraint in experiment.transcription.constraints if constraint.name == proof.family), None
    )
    normals = {} if constraint is None or constraint.shape is None else {"normals": constraint.shape.frame}
    if constraint is not None and lower.shape[0] >= MANY_CELLS and lower.shape[1] == 1:
        lower, upper = _join_cells(lower[:, 0], upper[:, 0], *constraint.cells)
    return {"tolerance": TOLERANCE, **normals, "lower": lower, "upper": upper}


def _join_cells(lower: Array, upper: Array, first: Array, last: Array) -> tuple[Array, Array]:
    """Return cells of time ``[lower_i, upper_i]``, where neighbours that are whole pieces are joined.

    Whole pieces are those among ``[first_j, last_j]`` (``(k, 1)``). A check divides the cells wherever the signals have
    a corner or a jump.
    """
    order = np.argsort(lower, kind="stable")
    lower, upper = lower[order], upper[order]
    is_piece = np.isin(lower, first) & np.isin(upper, last)
    begins = np.append(True, ~(is_piece[1:] & is_piece[:-1] & (upper[:-1] == lower[1:])))
    return lower[begins, None], upper[np.append(begins[1:], True), None]


def _write_witness(experiment: ControlExperiment, result: Result) -> dict[str, Any] | None:
    worst, problem = result.worst, experiment.problem
    if worst is None:
        return None
    explanation = in_numbers(experiment.program, worst.constraint, worst.formulation, worst.index, worst.row)
    if explanation is None:
        return None
    explanation = _apply_worst_deviations(experiment, explanation, np.asarray(result.decision))
    signal: Sequence[Any] | Array | None = explanation.disturbance
    if signal is not None and problem.disturbance is not None:
        middle = problem.disturbance.interior_point()
        signal = np.array([_move_inside(problem.disturbance, column, middle) for column in np.asarray(signal).T]).T
    return {
        "constraint": worst.constraint,
        "time": explanation.time,
        "parameter": _write_parameter(problem, explanation),
        **_write_direction(explanation),
        "disturbance": signal,
        **_write_deviations(problem, explanation),
        **_write_noise(problem, explanation),
        "violation": worst.violation,
    }


def _apply_worst_deviations(experiment: ControlExperiment, said: TimedExplanation, decision: Array) -> TimedExplanation:
    """Return a constraint at the deviations that drive a closed loop to it most, where there is a loop."""
    feedback = experiment.transcription.feedback
    if feedback is None:
        return said
    from sparserob_core.control.constraints.control import STEP, of_control
    from sparserob_core.control.constraints.feedback import describe_deviations

    loop, time, controls = feedback.loop, said.time, feedback.loop.controls(decision)
    piece = int(np.searchsorted(experiment.control.breakpoints[1:-1], time, side="right"))
    if said.constraint == STEP:
        along = said.direction @ (controls[piece] - controls[piece - 1] * (piece > 0))
    elif said.constraint == of_control(experiment.problem):
        along = said.direction @ controls[piece]
    else:
        along = said.direction @ loop.states(decision, np.array([time]))[0]
        along = along if said.gain is None or said.piece is None else along + said.gain @ controls[said.piece]
    return describe_deviations(said, loop, loop.spread.worst(along[1:]))
