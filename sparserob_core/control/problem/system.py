"""Uncertain linear systems ``x' = A x + B u + E w + c`` in phases, whose entries may depend on parameters and time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from typing import TypeAlias, final

import numpy as np

from sparserob_core.brief import noun
from sparserob_core.control.enclosures.dependence import Dependence, ExpandedSystem, Superposed, dependence
from sparserob_core.control.problem.phase import PARTS, TIME, Matrix, Phase, PhaseInUnits, and_time, boxed
from sparserob_core.control.term import SAME_TIME, over
from sparserob_core.errors import InputError
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.expressions.expression import parse_column, parse_definitions, parse_matrix

InTime: TypeAlias = tuple[
    Sequence[Sequence[str | float]],
    Sequence[Sequence[str | float]],
    Sequence[Sequence[str | float]] | None,
    Sequence[str | float] | None,
]
"""The matrices ``A``, ``B``, ``E`` and ``c`` of one phase, whose entries are numbers or expressions in ``t``."""
PERIODIC = 1e-9
"""The largest relative difference between the values of one entry at both ends of a period.

A horizon is a double of 53 bits, and therefore differs from the exact period by rounding. An entry that changes by its
own size within a millionth of the period then differs by a tenth of this bound. With a bound that is ten times larger,
a decimal that is rounded too early would be accepted as the period.
"""
# Times per phase at which sizes are estimated; with ten times fewer a short pericentre is overlooked
SAMPLED_TIMES_PER_PHASE = 65


@dataclass(frozen=True, eq=False, repr=False)
class System:
    """A linear system ``x'(t) = A(t, p) x(t) + B(t, p) u(t - delay) + E(t, p) w(t) + c(t, p)`` in phases.

    The state is ``x (d,)``, the control ``u (m,)``, the disturbance ``w (mw,)``. The parameter ``p (nu,)`` is constant
    and unknown. Users make a system by `LinearSystem`, `SwitchedSystem` or `VaryingSystem`.

    Parameters
    ----------
    phases : tuple of Phase
        The phases in the order of time; the first one begins at time 0. All of them have the same numbers of states,
        controls and disturbances. Their entries depend on the time in all phases, or in none.
    parameters : ConvexSet, optional
        The bounded set of the parameter ``p (nu,)``; ``None`` (the default) where everything is known.
    delay : float, default 0.0
        The time, in the time unit of the system, by which the control acts later than it is commanded. A control acts
        through the ``B`` of the time at which it acts. Before ``delay`` the ``initial_control`` of the problem acts.

    Raises
    ------
    InputError
        If the delay is negative or not finite, or if the numbers of states, controls or disturbances differ between
        phases.

    Notes
    -----
    The state is continuous: each phase begins with the state in which the phase before it ends.
    """

    phases: tuple[Phase, ...]
    parameters: ConvexSet | None = None
    delay: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "delay", _check_delay(self.delay))
        if not self.phases:
            raise InputError(path="system.pieces", expected="at least one", got="none")
        first, *later = self.phases
        for i, phase in enumerate(later, 1):
            for dimension in ("states", "controls", "disturbances"):
                if getattr(phase, dimension) != getattr(first, dimension):
                    raise InputError(
                        path=f"system.pieces.{i}",
                        expected=f"{getattr(first, dimension)} {dimension}, as the other pieces",
                        got=f"{getattr(phase, dimension)}",
                    )
        if len({phase.c is None for phase in self.phases}) > 1:
            object.__setattr__(self, "phases", tuple(phase.drifting() for phase in self.phases))
        _ = self._parameter_dependence

    __repr__ = noun

    @property
    def noun_of(self) -> tuple[str, list[tuple[str, object]]]:
        """The name and the fields by which the system is shown in messages."""
        attributes, own_names = {**vars(self.phases[0]), **vars(self)}, ("phases", "parameters", "delay")
        names = ("A", "B", "E", "parameters", "names", "c", "delay") if self.kind == "LinearSystem" else own_names
        return self.kind, [(name, attributes[name]) for name in names]

    @property
    def kind(self) -> str:
        """The name of the constructor that makes such a system."""
        if self.varies:
            return "VaryingSystem"
        return "LinearSystem" if self.horizon == np.inf else "SwitchedSystem"

    @property
    def states(self) -> int:
        """The number ``d`` of states."""
        return self.phases[0].states

    @property
    def controls(self) -> int:
        """The number ``m`` of controls."""
        return self.phases[0].controls

    @property
    def disturbances(self) -> int:
        """The number ``mw`` of disturbances, which is the number of columns of ``E``."""
        return self.phases[0].disturbances

    @property
    def parameter_count(self) -> int:
        """The number ``nu`` of parameters, 0 for a known system; the time is not among them."""
        return 0 if self.parameters is None else self.parameters.dimension

    @property
    def box(self) -> Box:
        """The set of the parameters of a system that depends on time; this set is always a box."""
        assert isinstance(self.parameters, Box)
        return self.parameters

    @property
    def names(self) -> Sequence[str]:
        """The names of the parameters, without the time."""
        argument_names = self.phases[0].names
        return argument_names[len(argument_names) - self.parameter_count :]

    @property
    def drifts(self) -> bool:
        """True where the system has a drift ``c``."""
        return self.phases[0].c is not None

    @property
    def varies(self) -> bool:
        """True where entries of the matrices depend on the time."""
        return self.phases[0].timed

    @property
    def horizon(self) -> float:
        """The time at which the last phase ends; infinite for a `LinearSystem`, which has no end."""
        return self.phases[-1].until

    @property
    def switches(self) -> tuple[float, ...]:
        """The times at which a new phase begins, where the entries are constant within phases.

        The tuple is empty for a system whose entries depend on the time: there no piece of a grid has to end where the
        next phase begins.
        """
        return () if self.varies else tuple(phase.begin for phase in self.phases[1:])

    @property
    def is_constant(self) -> bool:
        """True where the same matrices hold all the time: the entries do not depend on it, and there is one phase."""
        return not self.varies and len(self.phases) == 1

    @cached_property
    def forced(self) -> System:
        """The system whose drift is the last column of ``B``, with a control that is always 1.

        It is the system itself without a drift.

        A system that is made so has no delay, because a delay belongs to the times at which the controls act.
        """
        return System(tuple(phase.forced for phase in self.phases), self.parameters) if self.drifts else self

    @cached_property
    def modes(self) -> tuple[Phase, ...]:
        """The phases at fixed times, from which the sizes of the numbers of a problem are estimated.

        Where the entries do not depend on the time, the modes are the `phases`. Otherwise they are the system at
        several times of each phase, and nothing is proven by them. Where the state is then an affine function of the
        parameters, these are in the middle of their box.
        """
        if not self.varies:
            return self.phases
        modes = list[Phase]()
        # Chebyshev points lie closer to the ends: an entry with zeros at evenly spaced times is not taken for 0
        shares = (1.0 - np.cos(np.linspace(0.0, np.pi, SAMPLED_TIMES_PER_PHASE))[:, None]) / 2.0
        for phase in self.phases:
            times = phase.begin + (phase.until - phase.begin) * shares
            if self.powers is not None:
                modes += [phase.during(time, self.parameters) for time in times[:, 0].tolist()]
                continue
            arguments = self._build_arguments(times)
            A, B, E = phase.matrices(arguments)
            drifts = (
                list(phase.forced.matrices(arguments)[1][:, :, -1:])
                if self.drifts
                else [None] * SAMPLED_TIMES_PER_PHASE
            )
            modes += [Phase(a, b, e, c=drift) for a, b, e, drift in zip(A, B, E, drifts, strict=True)]
        return tuple(modes)

    def _build_arguments(self, times: Array) -> Array:
        """Return times ``(k, 1)`` as arguments of a phase, with the parameters in the middle of their box."""
        middle = np.zeros(0) if self.parameters is None else self.parameters.interior_point()
        return np.hstack([times, np.tile(middle, (len(times), 1))])

    def until(self, horizon: float) -> tuple[Phase, ...]:
        """Return the phases, of which the last one ends at the ``horizon``."""
        last = self.phases[-1]
        return *self.phases[:-1], last.between(last.begin, horizon)

    def in_phases(self, phases: Sequence[Phase]) -> System:
        """Return the system with other phases up to the same time; a single phase lasts as long as this system."""
        if len(phases) == 1:
            phases = [phases[0].between(0.0, self.horizon)]
        return System(tuple(phases), self.parameters, self.delay)

    def with_parameters(self, parameters: ConvexSet) -> System:
        """Return the system with its parameters in another set."""
        phases = tuple(phase.within(parameters, self.names) for phase in self.phases)
        return System(phases, boxed(parameters) if self.varies else parameters, self.delay)

    def with_delay(self, delay: float) -> System:
        """Return the system with another ``delay``, in its time unit."""
        return System(self.phases, self.parameters, delay)

    def remaining(self, begin: float, horizon: float) -> System:
        """Return the system that remains from one time on, with a clock that is 0 at this time.

        A `LinearSystem` has no end, and is returned as it is.

        Parameters
        ----------
        begin : float
            The time from which the system remains, on the present clock.
        horizon : float
            The duration of the system that is returned.

        Returns
        -------
        System
            The phases that act in ``[begin, begin + horizon]`` for longer than rounding.
        """
        if self.horizon == np.inf:
            return self
        overlapping = [
            phase
            for phase in self.phases
            if not over(phase.until, begin, horizon) and not over(begin + horizon, phase.begin)
        ]
        switches = [phase.begin - begin for phase in overlapping[1:]]
        times = [0.0, *switches, horizon if self.varies or len(overlapping) > 1 else np.inf]
        phases = tuple(phase.later(*during, begin) for phase, during in zip(overlapping, pairwise(times), strict=True))
        return System(phases, self.parameters, self.delay)

    def in_time(self, horizon: float) -> System:
        """Return the system as a system whose entries depend on the time, up to the ``horizon``.

        A system that already depends on the time is returned as it is. Raises `InputError` where the parameters are not
        in a bounded box.
        """
        if self.varies:
            return self
        ends = [*self.switches, horizon]
        phases = tuple(phase.in_time(end) for phase, end in zip(self.phases, ends, strict=True))
        return System(phases, None if self.parameters is None else boxed(self.parameters), self.delay)

    def check_horizon(self, horizon: float) -> None:
        """Raise `InputError` where the last phase does not end at the horizon, or a phase is shorter than rounding."""
        if self.horizon < np.inf:
            _check_ends([phase.until for phase in self.phases], horizon, self.varies and len(self.phases) == 1)

    def check_period(self) -> None:
        """Raise `InputError` where the horizon is not a period of the entries, up to `PERIODIC`.

        No proof rests on this check: a plan that repeats begins again at the horizon with the entries of time 0, and
        phases do the same. A system in several phases is not checked. Its entries may jump at the horizon as they may
        between phases.
        """
        if not self.varies or len(self.phases) > 1:
            return
        matrices = [[matrix[0] for matrix in mode.forced.matrices(mode.probes[:1])] for mode in self.modes]
        sizes = [np.abs(values).max(axis=0) for values in zip(*matrices, strict=True)]
        ends = self.phases[0].forced.matrices(self._build_arguments(np.array([[0.0], [self.horizon]])))
        for name, size, (first, last) in zip("ABE", sizes, ends, strict=True):
            for i, j in np.argwhere(np.abs(last - first) > PERIODIC * size):
                entry = f"c[{i + 1}]" if name == "B" and j >= self.controls else f"{name}[{i + 1}][{j + 1}]"
                raise InputError(
                    path="repeat",
                    expected="a horizon that is a period of the system, which begins again there",
                    got=f"{entry} = {first[i, j]:.12g} at 0, and {last[i, j]:.12g} at {self.horizon:.12g}",
                )

    @property
    def dependence(self) -> Dependence | None:
        """The affine dependence of the state on the parameters, or ``None``.

        The value is ``None`` for a system that does not depend on the time or has no parameters, or whose state is not
        affine in them.
        """
        return None if isinstance(self._parameter_dependence, int) else self._parameter_dependence

    @property
    def powers(self) -> int | None:
        """The largest degree of the entries that are polynomials in the parameters, where the state is not affine.

        The value is ``None`` where the system does not depend on the time, has no parameters, or is affine in them.
        """
        return self._parameter_dependence if isinstance(self._parameter_dependence, int) else None

    @cached_property
    def _parameter_dependence(self) -> Dependence | int | None:
        """The `dependence` or the `powers`; ``None`` for a system without time or without parameters in its entries."""
        if not self.varies or self.parameters is None:
            return None
        return dependence([[phase.entry(name) for name in PARTS] for phase in self.phases], *self.deviations)

    @property
    def deviations(self) -> tuple[Array, Array]:
        """The middle ``(nu,)`` of the box of the parameters, and the largest deviations ``(nu,)``, rounded upwards."""
        if self.parameters is None:
            return np.zeros(0), np.zeros(0)
        centre, box = self.box.interior_point(), self.box
        sides = ((centre, box.upper), (box.lower, centre))
        return centre, np.max([[_subtract_upwards(a, b) for a, b in zip(*ends, strict=True)] for ends in sides], axis=0)

    def superposed(self, depends: Dependence | ExpandedSystem) -> System:
        """Return the known system of the coefficients of the state, where the state is expanded in the parameters.

        Parameters
        ----------
        depends : Dependence or Spread
            The affine dependence on the parameters, or the polynomial expansion in them.

        Returns
        -------
        System
            A system without parameters, whose entries depend on the time alone. Its state holds the coefficients one
            after another.
        """
        phases = []
        for phase in self.phases:
            entries = {name: phase.entry(name) for name in PARTS}
            expanded = {name: Superposed(name, entry, depends) for name, entry in entries.items() if entry is not None}
            times = Box([phase.begin], [phase.until])
            arguments = expanded["A"], expanded["B"], expanded["E"], times, (TIME,), expanded.get("c")
            phases.append(Phase(*arguments, phase.begin, phase.until, timed=True))
        return System(tuple(phases), None, self.delay)

    def at(self, parameter: Array) -> System:
        """Return the known system at one value ``(nu,)`` of the parameter."""
        if self.parameters is None:
            return self
        return System(tuple(phase.at(parameter) for phase in self.phases), None, self.delay)

    @shaped
    def in_units(
        self,
        A: Float[Array, "d d"],
        B: Float[Array, "d m"],
        E: Float[Array, "d mw"],
        parameters: Float[Array, " nu"],
        c: Float[Array, "d 1"] | float = 1.0,
        time: float = 1.0,
    ) -> System:
        """Return the system in other units; the change is exact where all factors are powers of two.

        Parameters
        ----------
        A, B, E : arrays (d, d), (d, m), (d, mw)
            The factors by which the matrices are multiplied, entry by entry.
        parameters : array (nu,)
            The numbers by which the parameters are divided.
        c : array (d, 1) or float, default 1.0
            The factors by which the drift is multiplied.
        time : float, default 1.0
            The number by which all times are divided.

        Returns
        -------
        System
            The same system in these units.
        """
        arguments = np.concatenate([[time], parameters]) if self.varies else parameters
        phases = tuple(phase.in_units(A, B, E, arguments, c, time) for phase in self.phases)
        bound = None if self.parameters is None else self.parameters.in_units(parameters)
        return System(phases, bound, self.delay / time)

    @property
    def stated(self) -> System:
        """The system in the units of the user, where its phases keep them; the system itself elsewhere.

        A constant system without parameters does not keep them.
        """
        first = self.phases[0]
        if not isinstance(first, PhaseInUnits):
            return self
        units = first.units[first.count - self.parameter_count :]
        bound = None if self.parameters is None else self.parameters.in_units(1.0 / units)
        phases = tuple(phase.stated for phase in self.phases)
        return System(phases, bound, self.delay * first.clock)

    @shaped
    def describe(self, parameter: Float[Array, " nu"]) -> str:
        """Return a parameter vector ``(nu,)`` in words, such as ``p1 = 0.1, p2 = -0.1``."""
        return self.phases[0].describe(parameter)


@final
class LinearSystem(System):
    """A system ``x'(t) = A(p) x(t) + B(p) u(t - delay) + E(p) w(t) + c(p)``, whose entries do not depend on the time.

    The state is ``x (d,)``, the control ``u (m,)``, the disturbance ``w (mw,)``. The parameter ``p (nu,)`` is constant
    and unknown.

    Parameters
    ----------
    A : array (d, d) or function of p
        The system matrix. A function takes ``p (nu,)`` and returns such an array.
    B : array (d, m) or function of p
        The input matrix.
    E : array (d, mw) or function of p, optional
        The matrix by which the disturbance enters; the identity unless given.
    parameters : ConvexSet, optional
        The bounded set of ``p``; ``None`` (the default) where everything is known.
    names : sequence of str, optional
        The names of the parameters in messages; ``p1``, ``p2``, ... unless given.
    c : array (d,) or function of p, optional
        A constant drift such as gravity, in units of the state per time; no drift unless given.
    delay : float, default 0.0
        The time, in the time unit of the system, by which the control acts later than it is commanded. Before ``delay``
        the ``initial_control`` of the problem acts.

    Raises
    ------
    InputError
        If shapes disagree, if an entry is not finite at one of the parameters that are tried, if the set of the
        parameters is not bounded, or if the delay is negative or not finite.

    Notes
    -----
    A function of ``p`` should consist of arithmetic and numpy functions. Proofs can then enclose the function over
    cells of parameters.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> sr.LinearSystem([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]).states
    2
    """

    def __init__(
        self,
        A: Matrix,
        B: Matrix,
        E: Matrix | None = None,
        parameters: ConvexSet | None = None,
        names: Sequence[str] = (),
        c: Matrix | None = None,
        delay: float = 0.0,
    ) -> None:
        super().__init__((Phase(A, B, E, parameters, names, c),), parameters, delay)

    @staticmethod
    def from_statespace(
        plant: object,
        E: Matrix | None = None,
        parameters: ConvexSet | None = None,
        names: Sequence[str] = (),
        c: Matrix | None = None,
        delay: float = 0.0,
    ) -> LinearSystem:
        """Return the system of a state-space model of another package.

        The model may come from python-control, scipy.signal, harold, or from any package whose models have ``A`` and
        ``B``.

        Parameters
        ----------
        plant : object
            A model in continuous time with the matrices ``A (d, d)`` and ``B (d, m)``. Its outputs are ignored.
        E, parameters, names, c, delay
            The arguments of `LinearSystem` with these names.

        Returns
        -------
        LinearSystem
            The system with the matrices of the model.

        Raises
        ------
        InputError
            If the model has no such matrices, or is in discrete time.
        """
        from sparserob_core.control.problem.statespace import matrices_of

        return LinearSystem(*matrices_of(plant), E, parameters, names, c, delay)


@final
class SwitchedSystem(System):
    """A system of several linear systems that follow one another at known times.

    Each of these phases has its own ``A``, ``B``, ``E`` and ``c``. All phases have the same numbers of states, controls
    and disturbances. The state is continuous at the switches.

    Parameters
    ----------
    pieces : sequence of pairs (float, LinearSystem)
        Each phase as the time until which it holds, and its system. The first phase begins at time 0; the last time is
        the horizon. All phases share their parameters; a phase without parameters is known.
    delay : float, default 0.0
        The time by which the control acts later than it is commanded. A control acts through the ``B`` of the time at
        which it acts.

    Raises
    ------
    InputError
        If there is no phase, if the times do not increase, if a phase is not a `LinearSystem` or has its own delay, or
        if phases differ in their parameters or in their numbers of states, controls or disturbances.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> slow = sr.LinearSystem([[-1.0]], [[1.0]])
    >>> fast = sr.LinearSystem([[-4.0]], [[1.0]])
    >>> sr.SwitchedSystem([(2.0, slow), (5.0, fast)]).switches
    (2.0,)
    """

    def __init__(self, pieces: Sequence[tuple[float, System]], delay: float = 0.0) -> None:
        pairs = list(pieces)
        if not pairs:
            raise InputError(path="system.pieces", expected="pairs of a time and a LinearSystem", got="none")
        for i, pair in enumerate(pairs):
            _check_piece(i, pair, pairs[i - 1][0] if i else 0.0)
        ends = [0.0, *(float(until) for until, _ in pairs)]
        reference = next((system for _, system in pairs if system.parameters is not None), pairs[0][1])
        for i, (_, system) in enumerate(pairs):
            parameters = system.parameters
            if parameters is not None and (
                not parameters.is_same(reference.parameters) or system.names != reference.names
            ):
                raise InputError(path=f"system.pieces.{i}", expected="the parameters of the other pieces", got="others")
        phases = tuple(
            system.phases[0].within(reference.parameters, reference.names).between(begin, until)
            for (_, system), (begin, until) in zip(pairs, pairwise(ends), strict=True)
        )
        super().__init__(phases, reference.parameters, delay)


@final
class VaryingSystem(System):
    """A system ``x'(t) = A(t) x(t) + B(t) u(t - delay) + E(t) w(t) + c(t)`` for ``t`` from 0 to the ``horizon``.

    Users whose entries are expressions make such a system by `of` or `taking_turns`.

    Parameters
    ----------
    law : LinearSystem
        A system whose first parameter is the time: its matrices at ``p = (t,)`` are those at the time ``t``. Uncertain
        parameters follow the time in ``p``.
    horizon : float
        The time until which the last law holds.
    delay : float, default 0.0
        The time by which the control acts later than it is commanded. A control acts through the ``B`` of the time at
        which it acts.
    later : sequence of pairs (float, LinearSystem), optional
        Increasing times, each with the law that holds from then on; none unless given.
    parameters : Box, optional
        The box of the uncertain parameters ``(nu,)``; ``None`` (the default) where everything is known.

    Raises
    ------
    InputError
        If a law has another number of parameters or a delay of its own, or if the times do not increase.
    """

    def __init__(
        self,
        law: System,
        horizon: float,
        delay: float = 0.0,
        later: Sequence[tuple[float, System]] = (),
        parameters: Box | None = None,
    ) -> None:
        laws, count = [law, *(piece for _, piece in later)], 0 if parameters is None else parameters.dimension
        if any(piece.parameter_count != 1 + count or piece.delay or len(piece.phases) > 1 for piece in laws):
            expected = "a law whose first parameter is the time, before those of the system, without a delay of its own"
            raise InputError(path="system", expected=expected, got="another")
        times = [0.0, *(begin for begin, _ in later), horizon]
        for i, (begin, until) in enumerate(pairwise(times)):
            if not begin < until < np.inf:
                where = f"system.pieces.{i}.until" if later else "system.until"
                raise InputError(path=where, expected=f"a time after {begin:g}", got=f"{until:g}")
        phases = tuple(
            replace(piece.phases[0], begin=begin, until=until, timed=True)
            for piece, (begin, until) in zip(laws, pairwise(times), strict=True)
        )
        super().__init__(phases, parameters, delay)

    @staticmethod
    def of(
        A: Sequence[Sequence[str | float]],
        B: Sequence[Sequence[str | float]],
        horizon: float,
        E: Sequence[Sequence[str | float]] | None = None,
        c: Sequence[str | float] | None = None,
        define: Mapping[str, str | float] | None = None,
        delay: float = 0.0,
        parameters: ConvexSet | None = None,
        names: Sequence[str] = (),
    ) -> System:
        """Return the system whose entries are numbers and expressions in the time ``t``.

        An entry may also contain the names of uncertain parameters and the names that ``define`` gives; see
        `parse_expression`.

        Parameters
        ----------
        A, B : rows of numbers and expressions
            The matrices ``(d, d)`` and ``(d, m)``.
        horizon : float
            The time at which the system ends.
        E : rows of numbers and expressions, optional
            The matrix ``(d, mw)``; the identity unless given.
        c : sequence of numbers and expressions, optional
            The drift ``(d,)``; no drift unless given.
        define : mapping, optional
            Names for expressions, which entries may use.
        delay : float, default 0.0
            The time by which the control acts later than it is commanded.
        parameters : ConvexSet, optional
            The bounded box of the uncertain parameters; ``None`` (the default) where everything is known.
        names : sequence of str, optional
            The names of the parameters; ``p1``, ``p2``, ... unless given.

        Returns
        -------
        System
            The system from time 0 to the horizon.

        Raises
        ------
        InputError
            If an entry cannot be read or the shapes disagree; where it can, the error begins with the key of a config.

        Examples
        --------
        >>> import sparserob_core as sr
        >>> sr.VaryingSystem.of([["-(1 + 0.4 * cos(2 * t))"]], [[1]], 5.0).varies
        True
        """
        uncertain = _ParameterBox.of(parameters, names)
        return System((_build_phase("system", (A, B, E, c), (0.0, horizon), define, uncertain),), uncertain.box, delay)

    @staticmethod
    def taking_turns(
        pieces: Sequence[tuple[float, InTime]],
        define: Mapping[str, str | float] | None = None,
        delay: float = 0.0,
        parameters: ConvexSet | None = None,
        names: Sequence[str] = (),
    ) -> System:
        """Return the system of several phases, whose entries are numbers and expressions in the time ``t``.

        The time ``t`` counts from 0 in all phases.

        Parameters
        ----------
        pieces : sequence of pairs (float, (A, B, E, c))
            Each phase as the time at which it ends, and its matrices. ``E`` and ``c`` may be ``None``. The last time is
            the horizon.
        define, delay, parameters, names
            The arguments of `VaryingSystem.of` with these names, for all phases together.

        Returns
        -------
        System
            The system from time 0 to the horizon.

        Raises
        ------
        InputError
            If an entry cannot be read, the times do not increase, or the shapes disagree.
        """
        ends, uncertain = [0.0, *(float(until) for until, _ in pieces)], _ParameterBox.of(parameters, names)
        phases = tuple(
            _build_phase(f"system.pieces.{i}", matrices, during, define, uncertain)
            for i, (during, (_, matrices)) in enumerate(zip(pairwise(ends), pieces, strict=True))
        )
        return System(phases, uncertain.box, delay)


def _check_delay(value: object) -> float:
    """Return the delay as a float; raise `InputError` where it is no finite number of at least 0."""
    usable = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not usable or not 0.0 <= float(value) < np.inf:  # type: ignore[arg-type]
        raise InputError(path="system.delay", expected="a finite time, not negative", got=f"{value!r}")
    return float(value)  # type: ignore[arg-type]


def _subtract_upwards(low: float, high: float) -> float:
    """Return ``high - low`` as a double, rounded upwards."""
    exact, difference = Fraction(float(high)) - Fraction(float(low)), float(high) - float(low)
    return difference if Fraction(difference) >= exact else float(np.nextafter(difference, np.inf))


def _check_ends(ends: Sequence[float], horizon: float, whole: bool) -> None:
    """Raise `InputError` where phases that end at the times ``ends`` do not fill the horizon.

    Where ``whole`` is true, the system is a single law, and messages name no piece of it.
    """
    last, begin = len(ends) - 1, 0.0
    if not abs(ends[last] - horizon) <= SAME_TIME * horizon:
        raise InputError(
            path="system" if whole else f"system.pieces.{last}.until",
            expected=f"a law up to {horizon:g}, the horizon"
            if whole
            else f"{horizon:g}, the horizon, since it is the last piece",
            got=f"up to {ends[last]:g}" if whole else f"{ends[last]:g}",
        )
    for i, until in enumerate(ends):
        if until - begin <= SAME_TIME * horizon:
            raise InputError(
                path=f"system.pieces.{i}.until",
                expected=f"a time that is after {begin:g} by more than rounding",
                got=f"{until!r}",
            )
        begin = until


def _check_piece(i: int, pair: object, before: float) -> None:
    """Raise `InputError` where a phase of a switched system is no pair of a later time and a `LinearSystem`.

    A delay of its own is refused too.
    """
    if not isinstance(pair, Sequence) or len(pair) != 2:
        raise InputError(path=f"system.pieces.{i}", expected="a pair of a time and a LinearSystem", got=f"{pair!r}")
    until, system = pair
    if isinstance(until, bool) or not isinstance(until, int | float | np.integer | np.floating):
        raise InputError(path=f"system.pieces.{i}.until", expected="a time", got=f"{until!r}")
    if not before < until < np.inf:
        raise InputError(path=f"system.pieces.{i}.until", expected=f"a time after {before:g}", got=f"{until:g}")
    kind = system.kind if isinstance(system, System) else type(system).__name__
    if kind != "LinearSystem" or system.delay:
        got = "a delay of its own" if kind == "LinearSystem" else kind
        raise InputError(path=f"system.pieces.{i}", expected="a LinearSystem without delay", got=got)


@final
@dataclass(frozen=True, eq=False)
class _ParameterBox:
    """The box of the uncertain parameters, and the names of the time and of these parameters."""

    box: Box | None
    names: tuple[str, ...]

    @staticmethod
    def of(parameters: ConvexSet | None, names: Sequence[str]) -> _ParameterBox:
        """Return the box and the names; raise `InputError` for another set or for unsuitable names."""
        box = None if parameters is None else boxed(parameters)
        count = 0 if box is None else box.dimension
        parameter_names = tuple(names) or tuple(f"p{i + 1}" for i in range(count))
        if len(parameter_names) != count or TIME in parameter_names:
            expected = f"{count} names, none of them {TIME}, which is the time"
            raise InputError(path="system.parameters", expected=expected, got=", ".join(parameter_names))
        return _ParameterBox(box, (TIME, *parameter_names))


def _build_phase(
    where: str,
    given: InTime,
    during: tuple[float, float],
    define: Mapping[str, str | float] | None,
    uncertain: _ParameterBox,
) -> Phase:
    """Return the phase with the given matrices, whose entries are expressions in the time and the parameters.

    Parameters
    ----------
    where : str
        The key of a config at which the matrices stand, for messages.
    given : tuple (A, B, E, c)
        The matrices; ``E`` and ``c`` may be ``None``.
    during : tuple of two floats
        The times from which and until which the phase holds.
    define : mapping or None
        Names for expressions, which entries may use.
    uncertain : _ParameterBox
        The box of the parameters, and the names of the time and of the parameters.

    Returns
    -------
    Phase
        The timed phase between these times.

    Raises
    ------
    InputError
        If an entry cannot be read, or the phase does not end after it begins.
    """
    names, (A, B, E, c) = uncertain.names, given
    try:
        defined = parse_definitions(define or {}, names)
    except InputError as error:
        raise error.under("system") from None
    begin, until = during
    if not begin < until < np.inf:
        raise InputError(path=f"{where}.until", expected=f"a time after {begin:g}", got=f"{until:g}")
    return Phase(
        parse_matrix(f"{where}.A", A, names, defined),
        parse_matrix(f"{where}.B", B, names, defined),
        None if E is None else parse_matrix(f"{where}.E", E, names, defined),
        and_time(begin, until, uncertain.box),
        names,
        None if c is None else parse_column(f"{where}.c", c, names, defined),
        begin,
        until,
        timed=True,
    )
