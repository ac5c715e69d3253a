"""The record that links a problem to its program."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.brief import noun
from sparserob_core.control.constraints.explanation import ConstraintSource, TimedExplanation, in_numbers
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.response import Response
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.finite import Spread
from sparserob_core.sip.program import ConstraintFamily, Formulation, SemiInfiniteProgram

if TYPE_CHECKING:
    from sparserob_core.control.feedback.closed_loop import ClosedLoop
    from sparserob_core.control.feedback.observer import Observer
    from sparserob_core.control.policies.policy import Charge, Policy
    from sparserob_core.control.problem.units import Units
    from sparserob_core.control.transcription.telling import Telling


@final
@dataclass(frozen=True, eq=False)
class Feedback:
    """Feedback of the control of a transcribed problem: its ``policy``, the measurements that each piece answers,
    ``answers (K, K)``, the cost by which it is chosen, ``charge``, and the closed ``loop``."""

    policy: Policy
    answers: np.ndarray
    charge: Charge
    loop: ClosedLoop


@dataclass(frozen=True, eq=False)
class RowUnits:
    """Divisors of the rows of a program in own units, except for the rows of its constraints: of the ``sides`` that
    bound several controls together, of the control's ``steps``, and of the terminal equalities, ``fixed (e,)``.
    ``entered (e,)``: true where the control enters the equality."""

    sides: Array
    steps: Array
    fixed: Array
    entered: Array

    def equalities(self, A: Array, b: Array) -> tuple[Array, Array]:
        """Return ``A x = b`` in these units. Rows of ``A`` that the control enters by rounding only are set to 0."""
        return np.where(self.entered[:, None], A, 0.0) / self.fixed[:, None], b / self.fixed


@dataclass(frozen=True, eq=False, kw_only=True)
class Posed:
    """Problem on its dictionaries, with the responses of its state, before it becomes a program.

    ``held``: the same problem with only those bounds and equalities that become rows of the nominal decision, whatever
    the control answers. ``constraints`` are the path and terminal constraints, named and ordered as the families of the
    program will be; terminal equalities are not among them. ``functionals``: the worst-case functionals from which
    every family is built. ``rows``: the divisors of rows, in own units.
    """

    problem: OptimalControlProblem
    held: OptimalControlProblem
    control: Dictionary
    disturbance: Dictionary
    functionals: WorstFunctionals
    parameters: ParameterIndex
    constraints: tuple[StateConstraint, ...]
    rows: RowUnits | None = None

    @property
    def response(self) -> Response:
        """The responses of the system on the merged grid."""
        return self.functionals.response

    def became(self, acting: Acting, program: SemiInfiniteProgram, feedback: Feedback | None = None) -> Transcription:
        """Return the transcription of this problem: the ``program`` that it became for a control that is ``acting``
        so."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(Posed)}
        return Transcription(**values, acting=acting, program=program, feedback=feedback)


@dataclass(frozen=True, eq=False, kw_only=True)
class ProgramPart:
    """Part of a program that depends on how its control acts: the ``families``, and further entries of the decision
    after the nominal ones, with their bounds ``lower`` and ``upper (k,)``.

    ``weights (n,)`` are the prices where other entries than the nominal ones are charged, and ``largest`` is then the
    largest cost. The other fields are as in a `SemiInfiniteProgram`.
    """

    families: Sequence[ConstraintFamily]
    lower: Array = field(default_factory=lambda: np.zeros(0))
    upper: Array = field(default_factory=lambda: np.zeros(0))
    weights: Array | None = None
    largest: float | None = None
    activity: Array | None = None
    spread: Spread | None = None
    settle: Callable[[Array], Array] | None = None
    guide: tuple[SemiInfiniteProgram, int] | None = None
    among: tuple[SemiInfiniteProgram, int] | None = None
    feedback: Feedback | None = None


class Acting(ABC):
    """Law by which a control acts, in one set of units: feedback from measurements, or open loop, the simplest case."""

    formulation: Formulation
    """Formulation that the indices of the families belong to."""

    @property
    @abstractmethod
    def answers_by(self) -> Policy | None:
        """Policy by which the control answers measurements; ``None`` in open loop."""

    @abstractmethod
    def in_own(self, theirs: Posed, own: Posed, units: Units) -> Acting:
        """Return this law in the problem's ``own`` units."""

    @abstractmethod
    def part(self, posed: Posed) -> ProgramPart:
        """Return the part of the program of a posed problem, in these units, that depends on this law."""

    @abstractmethod
    def widen(self, posed: Posed, around: Array) -> Posed:
        """Return the problem with the range that the decision has from its initial state, and from every one that
        differs from it by at most ``around (d,)``."""

    @abstractmethod
    def from_state(self, model: Transcription, posed: Posed) -> Transcription:
        """Return the program of the same problem from another initial state, explained as the program of ``model``
        is."""

    @abstractmethod
    def free(self, model: Transcription) -> Transcription:
        """Return the program of a ``model`` with this law in which nothing has a price that needs variables of its
        own."""

    @abstractmethod
    def telling(self, own: Posed, units: Units) -> Telling:
        """Return the conversion of families in own units to the user's units."""

    @abstractmethod
    def compute_extra_units(self, own: Posed, units: Units) -> Array:
        """Return one unit of every entry of a decision after the nominal entries, in the user's units."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Transcription(Posed):
    """Problem on its dictionaries, with the semi-infinite program into which it was transcribed by how its control is
    ``acting``.

    ``given``: the problem as the user stated it, with its integrals, which are states of ``problem``. ``feedback``: the
    feedback of the control, ``None`` in open loop; with feedback, the decision begins with the nominal control.
    """

    acting: Acting
    program: SemiInfiniteProgram
    feedback: Feedback | None = None
    given: OptimalControlProblem | None = None
    _explanation_cache: dict[tuple[str, Formulation, int, bytes], TimedExplanation | None] = field(
        default_factory=dict, init=False, repr=False
    )

    __repr__ = noun

    def explained(self, cuts: Sequence[Cut]) -> list[TimedExplanation | None]:
        """Return the constraints of a result in numbers, one explanation for each cut; ``None`` for a cut whose index
        does not contain these numbers, such as the number of a sample.

        Explanations are computed once and remembered. Several callers need the same ones: those that round a bound,
        derive it, seek another bound, and write it down.
        """
        keys = [(cut.family, cut.formulation, cut.row, cut.index.tobytes()) for cut in cuts]
        fresh = {key: cut for key, cut in zip(keys, cuts, strict=True) if key not in self._explanation_cache}
        for key, cut in fresh.items():
            self._explanation_cache[key] = in_numbers(self.program, cut.family, cut.formulation, cut.index, cut.row)
        return [self._explanation_cache[key] for key in keys]

    @property
    def stated(self) -> OptimalControlProblem:
        """Problem as the user stated it; its states come first among the states of ``problem``."""
        return self.given or self.problem

    @property
    def formulation(self) -> Formulation:
        """Formulation that the indices of the families belong to."""
        return self.acting.formulation

    @property
    def policy(self) -> Policy | None:
        """Policy by which the control answers measurements; ``None`` in open loop."""
        return self.acting.answers_by

    @property
    def answering(self) -> Feedback:
        """Feedback of a control that answers measurements; only for a transcription with feedback."""
        assert self.feedback is not None
        return self.feedback

    @property
    def observer(self) -> Observer | None:
        """Observer that makes innovations of outputs; ``None`` where states are measured, or nothing is."""
        return None if self.feedback is None else self.feedback.loop.observer

    @property
    def noise(self) -> ConvexSet | None:
        """Set of the noise of the measurements that the control answers; ``None`` where there is none."""
        measured = None if self.feedback is None else self.problem.measurements
        return None if measured is None else measured.noise

    def pieces(self, theta: Array) -> Array:
        """Return the control ``(m, K)`` on the pieces of its dictionary, of a decision ``theta (m, N)`` or ``(m N,)``;
        under feedback the nominal control, which a whole decision gives."""
        if self.feedback is not None and self.feedback.loop.inner.acts:
            return self.feedback.loop.nominal(np.asarray(theta, dtype=float))
        return self.control.control(self.nominal(theta))

    def nominal(self, decision: Array) -> Array:
        """Return the coefficients ``(m N,)`` of the control in a decision, or under feedback those of the nominal
        control."""
        return np.asarray(decision, dtype=float).ravel()[: self.problem.system.controls * self.control.functions]

    def family(self, constraint: StateConstraint) -> ConstraintFamily:
        """Return the family of the program that was made of one of the constraints."""
        return next(family for family in self.program.families if family.source is constraint)

    def constraint(self, family: ConstraintFamily) -> StateConstraint | None:
        """Return the constraint on the state from which a family was made, in any formulation, also for an equality
        that must hold for every deviation; ``None`` for a constraint on the control."""
        source = family.source.of_state if isinstance(family.source, ConstraintSource) else None
        return source if isinstance(source, StateConstraint) else None
