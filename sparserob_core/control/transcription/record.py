"""The record that links a problem to its program."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.brief import noun
from sparserob_core.control.constraints.explanation import Source, TimedExplanation, in_numbers
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.reach.functional import WorstCase
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
    """How the control of a transcribed problem answers what it measures: its ``policy``, what that answers here,
    ``answers (K, K)``, what it is charged, and the closed ``loop``."""

    policy: Policy
    answers: np.ndarray
    charge: Charge
    loop: ClosedLoop


@dataclass(frozen=True, eq=False)
class RowUnits:
    """What the rows of a program in own units were divided by, beside those of its constraints: the slanted ``sides``
    of the controls, those of their ``steps``, and the terminal equalities, ``fixed (e,)``. ``entered (e,)``: whether a
    control enters that."""

    sides: Array
    steps: Array
    fixed: Array
    entered: Array

    def equalities(self, A: Array, b: Array) -> tuple[Array, Array]:
        """``A x = b`` in these units, without entries that are rounding."""
        return np.where(self.entered[:, None], A, 0.0) / self.fixed[:, None], b / self.fixed


@dataclass(frozen=True, eq=False, kw_only=True)
class Posed:
    """A problem on its dictionaries, with what its state does, before it is a program.

    ``held``: the same problem with those bounds and equalities alone that are rows of the nominal decision, whatever
    the control answers. ``constraints`` are the path and terminal constraints, named and ordered as the families of
    the program will be; terminal equalities are not among them. ``functionals`` are what every family is built from.
    ``rows``: what rows are divided by, in own units.
    """

    problem: OptimalControlProblem
    held: OptimalControlProblem
    control: Dictionary
    disturbance: Dictionary
    functionals: WorstCase
    parameters: ParameterIndex
    constraints: tuple[StateConstraint, ...]
    rows: RowUnits | None = None

    @property
    def response(self) -> Response:
        """The responses of the system on the merged grid."""
        return self.functionals.response

    def became(self, acting: Acting, program: SemiInfiniteProgram, feedback: Feedback | None = None) -> Transcription:
        """The program that it became, by a control that acts so."""
        parts = {each.name: getattr(self, each.name) for each in fields(Posed)}
        return Transcription(**parts, acting=acting, program=program, feedback=feedback)


@dataclass(frozen=True, eq=False, kw_only=True)
class Part:
    """What a program owes to how its control acts: the ``families``, and entries of the decision beside the nominal
    ones, with their bounds ``lower`` and ``upper (k,)``. ``weights (n,)`` are the prices where other entries than the
    nominal ones are charged, ``largest`` is then the largest cost; the rest is as in a `SemiInfiniteProgram`."""

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
    """How a control acts: it answers what it measures, or nothing, which is the least of it. In one set of units."""

    formulation: Formulation
    """What the indices of the families are."""

    @property
    @abstractmethod
    def answers_by(self) -> Policy | None:
        """The policy by which it answers; ``None`` where that is nothing."""

    @abstractmethod
    def in_own(self, theirs: Posed, own: Posed, units: Units) -> Acting:
        """The same in the problem's ``own`` units."""

    @abstractmethod
    def part(self, posed: Posed) -> Part:
        """What the program of a posed problem in these units owes to it."""

    @abstractmethod
    def from_state(self, model: Transcription, begun: Posed) -> Transcription:
        """The program of the same problem from another initial state, told as that of the ``model`` is."""

    @abstractmethod
    def free(self, model: Transcription) -> Transcription:
        """The program of a ``model`` that acts so where nothing has a price that needs variables of its own."""

    @abstractmethod
    def telling(self, own: Posed, units: Units) -> Telling:
        """How families in own units are told in the user's."""

    @abstractmethod
    def units_beside(self, own: Posed, units: Units) -> Array:
        """What one of every entry of a decision that comes after the nominal ones is in the user's units."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Transcription(Posed):
    """A problem on its dictionaries and the semi-infinite program that it became by how its control is ``acting``.

    ``given``: the problem as it was stated, with its integrals, which are states of ``problem``. ``feedback``: how the
    control answers what it measures; the decision then begins with the nominal control.
    """

    acting: Acting
    program: SemiInfiniteProgram
    feedback: Feedback | None = None
    given: OptimalControlProblem | None = None
    _explained: dict[tuple[str, Formulation, int, bytes], TimedExplanation | None] = field(
        default_factory=dict, init=False, repr=False
    )

    __repr__ = noun

    def explained(self, cuts: Sequence[Cut]) -> list[TimedExplanation | None]:
        """The constraints of a result in numbers, one for each; ``None`` for one whose index does not say them, such as
        the number of a sample. Made once: what a bound rests on is asked for by whoever rounds it, derives it, seeks
        another, and writes it down, and a disturbance that does what a measurable one may takes long to compose."""
        keys = [(cut.family, cut.formulation, cut.row, cut.index.tobytes()) for cut in cuts]
        fresh = {key: cut for key, cut in zip(keys, cuts, strict=True) if key not in self._explained}
        loop = None if self.feedback is None else self.feedback.loop
        if loop is not None and loop.measurable is not None and fresh:
            size = loop.spread.size  # of the deviations, which end an index: those of the initial state come last
            loop.measurable.compose([cut.index[-size:] for cut in fresh.values() if cut.index.size > size > 0])
        for key, cut in fresh.items():
            self._explained[key] = in_numbers(self.program, cut.family, cut.formulation, cut.index, cut.row)
        return [self._explained[key] for key in keys]

    @property
    def stated(self) -> OptimalControlProblem:
        """The problem as it was stated; its states come first among those of ``problem``."""
        return self.given or self.problem

    @property
    def formulation(self) -> Formulation:
        """What the indices of the families are."""
        return self.acting.formulation

    @property
    def policy(self) -> Policy | None:
        """The policy by which the control answers what it measures; ``None`` for one that answers nothing."""
        return self.acting.answers_by

    @property
    def answering(self) -> Feedback:
        """The feedback of a control that answers, which is asked for where there is one."""
        assert self.feedback is not None
        return self.feedback

    @property
    def observer(self) -> Observer | None:
        """What makes innovations of outputs; ``None`` where states are measured, or nothing is."""
        return None if self.feedback is None else self.feedback.loop.observer

    @property
    def noise(self) -> ConvexSet | None:
        """The set of the noise of what the control measures and answers; ``None`` where there is none."""
        measured = None if self.feedback is None else self.problem.measurements
        return None if measured is None else measured.noise

    def pieces(self, theta: Array) -> Array:
        """The control ``(m, K)`` on the pieces of its dictionary, of a decision ``theta (m, N)`` or ``(m N,)``; under
        feedback the nominal one."""
        return self.control.control(self.nominal(theta))

    def nominal(self, decision: Array) -> Array:
        """The coefficients ``(m N,)`` of the control, or under feedback of the nominal one, in a decision."""
        return np.asarray(decision, dtype=float).ravel()[: self.problem.system.controls * self.control.functions]

    def family(self, constraint: StateConstraint) -> ConstraintFamily:
        """The family of the program that was made of one of the constraints."""
        return next(family for family in self.program.families if family.source is constraint)

    def constraint(self, family: ConstraintFamily) -> StateConstraint | None:
        """The constraint on the state that a family was made of, in any formulation, also of an equality that must hold
        for every deviation; ``None`` for one on the control."""
        found = family.source.of_state if isinstance(family.source, Source) else None
        return found if isinstance(found, StateConstraint) else None
