"""From a problem whose control answers what it measures to a program, exactly: nominal control and gains together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sparserob_core.control.constraints.feedback import FeedbackConstraint, FeedbackControl
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.policies.affine import AffinePolicy
from sparserob_core.control.problem.cost import Cost
from sparserob_core.control.problem.units import Units
from sparserob_core.control.response.closed_loop import ClosedLoop, deviations_of
from sparserob_core.control.response.innovations import Answers, answers, innovations_seen
from sparserob_core.control.sets.sets import Equality
from sparserob_core.control.transcription.record import Feedback, Transcription
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.program import ConstraintFamily, OwnUnits, SemiInfiniteProgram

CONTROL, PEAK = "control", "peak"  # names of the families that are about the control


def with_feedback(model: Transcription, own: Transcription, units: Units, policy: AffinePolicy) -> Transcription:
    """The program of a problem under a policy, from its transcription ``model`` without feedback and the same in its
    ``own`` ``units``. Raises `InputError` for what a policy cannot be transcribed with."""
    _refuse(model)
    blocks = 0 if own.functionals.disturbance is None else own.functionals.disturbance.block_count
    deviations = np.tile(units.disturbances[: own.problem.system.disturbances], blocks)
    seen = innovations_seen(own.response, own.control, own.functionals.disturbance)
    memory = None if policy.memory is None else policy.memory / units.time
    scaled = answers(seen, own.control.breakpoints, own.problem.system.controls, memory)
    known = _in_users(scaled, units, deviations)

    mine, theirs = (
        _program(one, policy, each, blocks) for one, each in ((model, known), (own, scaled))
    )
    told = [
        _told_by(family, other, units, deviations, own)
        for family, other in zip(theirs[0].families, mine[0].families, strict=True)
    ]
    scaled_program = replace(theirs[0], families=told, cost_unit=units.cost)
    pieces = own.control.pieces
    decision = np.concatenate(
        [
            np.repeat(units.controls, pieces),
            units.controls[scaled.channel] / deviations[scaled.entry],
            np.repeat(units.controls, pieces),
        ]
    )[: scaled_program.n]
    program = mine[0].mirrored(lambda _: OwnUnits(scaled_program, decision, decision, np.zeros(0), units.cost))
    return replace(model, program=program, feedback=Feedback(policy, mine[1]))


def _refuse(model: Transcription) -> None:
    """Raise `InputError` for what a policy is not built for, in one sentence."""
    problem, disturbed = model.problem, model.problem.disturbance is not None
    curved = [one.name for one in model.constraints if not isinstance(one, FlatConstraint)]
    named = [one.name for one in model.constraints if one.name in (CONTROL, PEAK)]
    reasons = [
        (not model.control.is_indicators, "control in indicators of its pieces (piecewise_constant)"),
        (problem.system.parameter_count > 0, "system without uncertain parameters: else what is measured is not the"
         " disturbance alone"),
        (disturbed and problem.disturbance_class != "piecewise_constant", "disturbance of the class piecewise_constant,"
         f" not {problem.disturbance_class}"),
        (disturbed and not model.disturbance.is_complete, "disturbance that takes any value on each of its pieces"),
        (bool(curved), f"state in sets with flat sides, which those of {', '.join(curved)} have not"),
        (problem.control.halfspaces() is None, f"control in a set with flat sides, which the {problem.control.kind} has not"),
        (bool(named), f"state constraint of another name than {', '.join(named)}, which is one on the control"),
        (problem.system.delay > 0.0, "control that acts at once, without a delay"),
        (problem.initial_set is not None, "single initial state"),
        (problem.control_step is not None, "control whose steps are free, without control_step"),
        (problem.cost != Cost(), "cost that is the L1 norm alone"),
        (any(isinstance(end, Equality) for end in problem.terminal), "terminal set with an interior: equals is not built"
         " for feedback"),
    ]  # fmt: skip
    for hindered, wanted in reasons:
        if hindered:
            raise InputError(f"affine needs a {wanted}", path="policy.name")


def _in_users(own: Answers, units: Units, deviations: Array) -> Answers:
    """The same coordinates of gains in the user's units; powers of two change no number but its exponent."""
    _, m, Q, d = own.shape
    at, which, value = own.effect
    effect = (at, which, value * deviations[own.entry[which]] / deviations[at % Q])
    at, which, value = own.gain
    gain = (at, which, value * deviations[own.entry[which]] / units.states[at % d])
    return replace(own, effect=effect, gain=gain)


def _program(
    model: Transcription, policy: AffinePolicy, known: Answers, blocks: int
) -> tuple[SemiInfiniteProgram, ClosedLoop]:
    """The program of one transcription, in its units."""
    functionals, problem, pieces = model.functionals, model.problem, model.control.pieces
    nominal, first = functionals.variables, functionals.variables + known.variables
    size = first + (nominal if policy.cost == "peak" else 0)
    loop = ClosedLoop(functionals, known, deviations_of(problem.disturbance, blocks), size)
    families = [
        FeedbackConstraint(constraint, loop).family()
        for constraint in model.constraints
        if isinstance(constraint, FlatConstraint)
    ]
    flat = problem.control.halfspaces()
    assert flat is not None
    families.append(FeedbackControl(CONTROL, loop, *flat).family())
    axes = np.eye(problem.system.controls)
    low, high = -problem.control.support(-axes), problem.control.support(axes)
    most = (high - low)[known.channel] / loop.spread.chords[known.entry]
    low, high = np.repeat(low, pieces), np.repeat(high, pieces)
    weights, lower, upper = np.zeros(size), np.concatenate([low, -most]), np.concatenate([high, most])
    cost = np.kron(np.asarray(problem.weights, dtype=float), model.control.lengths)
    if policy.cost == "peak":
        both = np.vstack([axes, -axes])
        families.append(FeedbackControl(PEAK, loop, both, np.zeros(len(both)), first).family())
        weights[first:] = cost
        lower = np.concatenate([lower, np.zeros(nominal)])
        upper = np.concatenate([upper, np.maximum(np.abs(low), np.abs(high))])
    else:
        weights[:nominal] = cost
    program = SemiInfiniteProgram(
        n=size,
        families=families,
        weights=weights,
        lower=lower,
        upper=upper,
        channels=problem.system.controls,
        lengths=np.tile(model.control.lengths, problem.system.controls),
        spread=loop.spread,
    )
    return program, loop


def _told_by(
    family: ConstraintFamily, theirs: ConstraintFamily, units: Units, deviations: Array, own: Transcription
) -> ConstraintFamily:
    """A family in own units, in both of its forms, that is explained as the user's is."""
    literal, other = family.literal, theirs.literal
    assert literal is not None and other is not None
    if isinstance(family.source, FlatConstraint):
        rows = own.family(family.source).row_units
    else:
        mine, others = family.source, theirs.source
        assert isinstance(mine, FeedbackControl) and isinstance(others, FeedbackControl)
        at = np.abs(mine.H).argmax(axis=1)[:, None]
        shares = np.take_along_axis(others.H * units.controls, at, axis=1) / np.take_along_axis(mine.H, at, axis=1)
        rows = shares[:, 0]

    def told(one: ConstraintFamily, scale: Array) -> ConstraintFamily:
        said = other.explain
        assert said is not None
        return replace(one, explain=lambda index, row: said(index * scale, row), row_units=rows, index_units=scale)

    time = np.array([units.time])
    reduced = told(family, time)
    return replace(reduced, literal=replace(told(literal, np.concatenate([time, deviations])), reduced=reduced))
