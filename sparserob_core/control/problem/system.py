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
from sparserob_core.control.enclosures.dependence import Dependence, Spread, Superposed, dependence
from sparserob_core.control.problem.expression import parse_column, parse_definitions, parse_matrix
from sparserob_core.control.problem.phase import PARTS, TIME, Matrix, Phase, PhaseInUnits, and_time, boxed
from sparserob_core.control.term import SAME_TIME, over
from sparserob_core.errors import InputError
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

InTime: TypeAlias = tuple[
    Sequence[Sequence[str | float]],
    Sequence[Sequence[str | float]],
    Sequence[Sequence[str | float]] | None,
    Sequence[str | float] | None,
]
"""``A``, ``B``, ``E`` and ``c`` with entries in the time."""
PERIODIC = 1e-9
"""Of an entry, by how much its values at both ends of a period may differ. What a horizon of 53 bits misses of a period
is a tenth of it where an entry changes by its size in a millionth of the period; of ten times more a rounded decimal
would pass for the period."""
LOOKS = 65  # times at which the size of a system is looked at; with ten times fewer a short pericentre is overlooked


@dataclass(frozen=True, eq=False, repr=False)
class System:
    """``x'(t) = A(t, p) x(t) + B(t, p) u(t - delay) + E(t, p) w(t) + c(t, p)`` with state ``x (d,)``, control
    ``u (m,)``, disturbance ``w (mw,)`` and a constant, unknown parameter ``p (nu,)`` in the bounded set ``parameters``,
    which is ``None`` when everything is known.

    The ``phases`` hold one after another, the first from 0 on; the state goes on where it is. Their entries depend on
    the time in all of them, or in none. All have as many states, controls and disturbances. ``delay``: by how much
    later the control acts, through the ``B`` of the time at which it acts; until then ``initial_control`` of the
    problem acts. Made by `LinearSystem`, `SwitchedSystem` and `VaryingSystem`. Raises `InputError`.
    """

    phases: tuple[Phase, ...]
    parameters: ConvexSet | None = None
    delay: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "delay", _duration(self.delay))
        first, *others = self.phases
        for i, phase in enumerate(others, 1):
            for what in ("states", "controls", "disturbances"):
                if getattr(phase, what) != getattr(first, what):
                    raise InputError(
                        path=f"system.pieces.{i}",
                        expected=f"{getattr(first, what)} {what}, as the other pieces",
                        got=f"{getattr(phase, what)}",
                    )
        if len({phase.c is None for phase in self.phases}) > 1:
            object.__setattr__(self, "phases", tuple(phase.drifting() for phase in self.phases))
        _ = self._depends

    __repr__ = noun

    @property
    def noun_of(self) -> tuple[str, list[tuple[str, object]]]:
        """The name under which it is shown, and the fields that are."""
        every, own = {**vars(self.phases[0]), **vars(self)}, ("phases", "parameters", "delay")
        names = ("A", "B", "E", "parameters", "names", "c", "delay") if self.kind == "LinearSystem" else own
        return self.kind, [(name, every[name]) for name in names]

    @property
    def kind(self) -> str:
        """The constructor that makes such a system."""
        if self.varies:
            return "VaryingSystem"
        return "LinearSystem" if self.horizon == np.inf else "SwitchedSystem"

    @property
    def states(self) -> int:
        """Number ``d`` of states."""
        return self.phases[0].states

    @property
    def controls(self) -> int:
        """Number ``m`` of controls."""
        return self.phases[0].controls

    @property
    def disturbances(self) -> int:
        """Number ``mw`` of disturbances that ``E`` takes."""
        return self.phases[0].disturbances

    @property
    def parameter_count(self) -> int:
        """Number ``nu`` of parameters, 0 for a known system."""
        return 0 if self.parameters is None else self.parameters.dimension

    @property
    def box(self) -> Box:
        """The set of the parameters beside the time, which is a box."""
        assert isinstance(self.parameters, Box)
        return self.parameters

    @property
    def names(self) -> Sequence[str]:
        """Names of the parameters."""
        every = self.phases[0].names
        return every[len(every) - self.parameter_count :]

    @property
    def drifts(self) -> bool:
        """Whether there is a drift."""
        return self.phases[0].c is not None

    @property
    def varies(self) -> bool:
        """Whether entries depend on the time."""
        return self.phases[0].timed

    @property
    def horizon(self) -> float:
        """When the last phase ends; infinite where one lasts as long as one likes."""
        return self.phases[-1].until

    @property
    def switches(self) -> tuple[float, ...]:
        """When one phase follows another, where the entries are constant between; of a system that varies none: no
        piece of a grid has to end where another law takes over."""
        return () if self.varies else tuple(phase.begin for phase in self.phases[1:])

    @cached_property
    def forced(self) -> System:
        """The same system with its drift as one more column of ``B``, whose control is always 1; itself without a
        drift. Then it has no delay: that belongs to the times at which the controls act."""
        return System(tuple(phase.forced for phase in self.phases), self.parameters) if self.drifts else self

    @cached_property
    def modes(self) -> tuple[Phase, ...]:
        """The phases; of a system that varies what it is at several times, for what asks how large its numbers are:
        nothing is proven by them. Of parameters that the state depends on affinely they are those in the middle of the
        box."""
        if not self.varies:
            return self.phases
        found = list[Phase]()
        # Chebyshev's points, closer to the ends: an entry that is 0 at evenly spaced times is seen
        shares = (1.0 - np.cos(np.linspace(0.0, np.pi, LOOKS))[:, None]) / 2.0
        for phase in self.phases:
            times = phase.begin + (phase.until - phase.begin) * shares
            if self.powers is not None:
                found += [phase.during(time, self.parameters) for time in times[:, 0].tolist()]
                continue
            arguments = self._arguments(times)
            A, B, E = phase.matrices(arguments)
            drifts = list(phase.forced.matrices(arguments)[1][:, :, -1:]) if self.drifts else [None] * LOOKS
            found += [Phase(a, b, e, c=drift) for a, b, e, drift in zip(A, B, E, drifts, strict=True)]
        return tuple(found)

    def _arguments(self, times: Array) -> Array:
        """``times (k, 1)`` as arguments of a phase, the parameters being in the middle of their box."""
        middle = np.zeros(0) if self.parameters is None else self.parameters.interior_point()
        return np.hstack([times, np.tile(middle, (len(times), 1))])

    def until(self, horizon: float) -> tuple[Phase, ...]:
        """The phases, the last one up to the horizon."""
        last = self.phases[-1]
        return *self.phases[:-1], last.between(last.begin, horizon)

    def in_phases(self, phases: Sequence[Phase]) -> System:
        """The same system in other phases up to the same time; a constant one alone lasts as long as this one."""
        if len(phases) == 1:
            phases = [phases[0].between(0.0, self.horizon)]
        return System(tuple(phases), self.parameters, self.delay)

    def with_parameters(self, parameters: ConvexSet) -> System:
        """The same system with its parameters in another set."""
        phases = tuple(phase.within(parameters, self.names) for phase in self.phases)
        return System(phases, boxed(parameters) if self.varies else parameters, self.delay)

    def with_delay(self, delay: float) -> System:
        """The same system whose control acts so much later."""
        return System(self.phases, self.parameters, delay)

    def remaining(self, begin: float, horizon: float) -> System:
        """What is left of it from a time on, which is 0 then, for as long as ``horizon``."""
        if self.horizon == np.inf:
            return self
        left = [
            phase
            for phase in self.phases
            if not over(phase.until, begin, horizon) and not over(begin + horizon, phase.begin)
        ]
        switches = [phase.begin - begin for phase in left[1:]]
        times = [0.0, *switches, horizon if self.varies or len(left) > 1 else np.inf]
        phases = tuple(phase.later(*during, begin) for phase, during in zip(left, pairwise(times), strict=True))
        return System(phases, self.parameters, self.delay)

    def in_time(self, horizon: float) -> System:
        """The same system as one whose entries depend on the time, up to the ``horizon``; itself where they do. Raises
        `InputError` where its parameters are in no box."""
        if self.varies:
            return self
        ends = [*self.switches, horizon]
        phases = tuple(phase.in_time(end) for phase, end in zip(self.phases, ends, strict=True))
        return System(phases, None if self.parameters is None else boxed(self.parameters), self.delay)

    def check_horizon(self, horizon: float) -> None:
        """Raise `InputError` where the phases do not fill the horizon."""
        if self.varies or self.horizon < np.inf:
            _check_ends([phase.until for phase in self.phases], horizon, self.varies and len(self.phases) == 1)

    def check_period(self) -> None:
        """Raise `InputError` where the horizon is no period of a law, but for what rounding it explains. Nothing is
        proven by that: the law of a plan that repeats begins again at the horizon, as phases of a system do. Laws that
        take turns may differ there as at any other time, and so may constant phases."""
        if not self.varies or len(self.phases) > 1:
            return
        every = [[part[0] for part in mode.forced.matrices(mode.probes[:1])] for mode in self.modes]
        sizes = [np.abs(parts).max(axis=0) for parts in zip(*every, strict=True)]
        ends = self.phases[0].forced.matrices(self._arguments(np.array([[0.0], [self.horizon]])))
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
        """How the state depends on parameters beside the time, where that is affinely."""
        return None if isinstance(self._depends, int) else self._depends

    @property
    def powers(self) -> int | None:
        """Where the state depends on parameters beside the time, and not affinely, the largest degree of an entry that
        is a polynomial in them."""
        return self._depends if isinstance(self._depends, int) else None

    @cached_property
    def _depends(self) -> Dependence | int | None:
        """One of both; nothing without parameters beside the time."""
        if not self.varies or self.parameters is None:
            return None
        return dependence([[phase.entry(name) for name in PARTS] for phase in self.phases], *self.deviations)

    @property
    def deviations(self) -> tuple[Array, Array]:
        """The middle of a box of parameters, and the most that each deviates from it by."""
        if self.parameters is None:
            return np.zeros(0), np.zeros(0)
        centre, box = self.box.interior_point(), self.box
        sides = ((centre, box.upper), (box.lower, centre))
        return centre, np.max([[_difference(a, b) for a, b in zip(*ends, strict=True)] for ends in sides], axis=0)

    def superposed(self, depends: Dependence | Spread) -> System:
        """The known system of all states that a dependence tells of."""
        phases = []
        for phase in self.phases:
            parts = {name: phase.entry(name) for name in PARTS}
            made = {name: Superposed(name, part, depends) for name, part in parts.items() if part is not None}
            times = Box([phase.begin], [phase.until])
            every = made["A"], made["B"], made["E"], times, (TIME,), made.get("c")
            phases.append(Phase(*every, phase.begin, phase.until, timed=True))
        return System(tuple(phases), None, self.delay)

    def at(self, parameter: Array) -> System:
        """The known system at one parameter ``(nu,)``."""
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
        """The system whose matrices are ``A``, ``B``, ``E``, ``c`` times these factors, entry by entry, and whose
        parameters and times are this one's divided by ``parameters (nu,)`` and ``time``; exact for powers of two."""
        arguments = np.concatenate([[time], parameters]) if self.varies else parameters
        phases = tuple(phase.in_units(A, B, E, arguments, c, time) for phase in self.phases)
        bound = None if self.parameters is None else self.parameters.in_units(parameters)
        return System(phases, bound, self.delay / time)

    @property
    def stated(self) -> System:
        """The system in the units that it is stated in; itself where these are its own."""
        first = self.phases[0]
        if not isinstance(first, PhaseInUnits):
            return self
        units = first.units[first.count - self.parameter_count :]
        bound = None if self.parameters is None else self.parameters.in_units(1.0 / units)
        phases = tuple(phase.stated for phase in self.phases)
        return System(phases, bound, self.delay * first.clock)

    @shaped
    def describe(self, parameter: Float[Array, " nu"]) -> str:
        """A parameter vector in words, such as ``p1 = 0.1, p2 = -0.1``."""
        return self.phases[0].describe(parameter)


@final
class LinearSystem(System):
    """``x'(t) = A(p) x(t) + B(p) u(t - delay) + E(p) w(t) + c(p)`` with state ``x (d,)``, control ``u (m,)``,
    disturbance ``w (mw,)`` and a constant, unknown parameter ``p (nu,)`` in ``parameters``.

    ``A (d, d)``, ``B (d, m)``, ``E (d, mw)`` are arrays, or functions of ``p`` that return such arrays; ``E`` is the
    identity unless given. ``parameters`` is a bounded set, or ``None`` when everything is known; ``names`` are for
    messages, p1, p2, ... unless given. ``c (d,)``, an array or a function of ``p``, is a constant drift such as
    gravity, in units of the state per time; none unless given. ``delay``: by how much later the control acts, in the
    time unit of the system; until then ``initial_control`` of the problem acts. A function should be arithmetic with
    numpy functions: then it can be enclosed over cells of parameters, for proofs. Raises `InputError` when shapes
    disagree or an entry is not finite somewhere that was looked at.
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
        """The system of a state-space model of another package (python-control, scipy.signal, harold, or whatever has
        ``A`` and ``B``); its outputs play no part. The other arguments are those of the class. Raises `InputError` for
        a plant without these matrices and for one in discrete time."""
        from sparserob_core.control.problem.statespace import matrices_of

        return LinearSystem(*matrices_of(plant), E, parameters, names, c, delay)


@final
class SwitchedSystem(System):
    """Linear systems that take turns at known times: ``pieces`` are pairs ``(until, LinearSystem)``, each with its own
    ``A``, ``B``, ``E`` and ``c``; the first begins at time 0, the last ``until`` is the horizon. The state goes on
    where it is.

    All of them have as many states, controls and disturbances, and share their parameters: a piece without any is a
    known one. ``delay``, as that of a `LinearSystem`: what was commanded acts through the ``B`` of the time at which it
    acts. Raises `InputError`.
    """

    def __init__(self, pieces: Sequence[tuple[float, System]], delay: float = 0.0) -> None:
        given = list(pieces)
        if not given:
            raise InputError(path="system.pieces", expected="pairs of a time and a LinearSystem", got="none")
        for i, pair in enumerate(given):
            _check_piece(i, pair, given[i - 1][0] if i else 0.0)
        ends = [0.0, *(float(until) for until, _ in given)]
        first = next((one for _, one in given if one.parameters is not None), given[0][1])
        for i, (_, one) in enumerate(given):
            other = one.parameters
            if other is not None and (not other.is_same(first.parameters) or one.names != first.names):
                raise InputError(path=f"system.pieces.{i}", expected="the parameters of the other pieces", got="others")
        phases = tuple(
            one.phases[0].within(first.parameters, first.names).between(begin, until)
            for (_, one), (begin, until) in zip(given, pairwise(ends), strict=True)
        )
        super().__init__(phases, first.parameters, delay)


@final
class VaryingSystem(System):
    """``x'(t) = A(t) x(t) + B(t) u(t - delay) + E(t) w(t) + c(t)`` for ``t`` from 0 to the ``horizon``.

    ``law``: a `LinearSystem` whose first parameter is the time: its matrices at ``p = (t,)`` are those at the time
    ``t``. ``later``: times, one after another, each with the law that holds from then on. ``delay``, as that of a
    `LinearSystem`: what was commanded acts through the ``B`` of the time at which it acts. ``parameters``: a box of
    uncertain parameters, which follow the time in the laws; ``None`` where everything is known. Made of expressions by
    `of` and `taking_turns`. Raises `InputError`.
    """

    def __init__(
        self,
        law: System,
        horizon: float,
        delay: float = 0.0,
        later: Sequence[tuple[float, System]] = (),
        parameters: Box | None = None,
    ) -> None:
        every, count = [law, *(one for _, one in later)], 0 if parameters is None else parameters.dimension
        if any(one.parameter_count != 1 + count or one.delay or len(one.phases) > 1 for one in every):
            expected = "a law whose first parameter is the time, before those of the system, without a delay of its own"
            raise InputError(path="system", expected=expected, got="another")
        times = [0.0, *(begin for begin, _ in later), horizon]
        for i, (begin, until) in enumerate(pairwise(times)):
            if later and not begin < until:
                raise InputError(path=f"system.pieces.{i}.until", expected=f"a time after {begin:g}", got=f"{until:g}")
        phases = tuple(
            replace(one.phases[0], begin=begin, until=until, timed=True)
            for one, (begin, until) in zip(every, pairwise(times), strict=True)
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
        """The system whose entries are numbers and expressions in ``t``, in the ``names`` of uncertain ``parameters``
        (p1, p2, ... unless given), and in those that ``define`` gives to such expressions; see `parse_expression`.
        Raises `InputError` that begins with the key of a config."""
        known = _Uncertain.of(parameters, names)
        return System((_phase("system", (A, B, E, c), (0.0, horizon), define, known),), known.box, delay)

    @staticmethod
    def taking_turns(
        pieces: Sequence[tuple[float, InTime]],
        define: Mapping[str, str | float] | None = None,
        delay: float = 0.0,
        parameters: ConvexSet | None = None,
        names: Sequence[str] = (),
    ) -> System:
        """Systems as those of `of`, each up to a time with its ``A``, ``B``, ``E`` and ``c``; ``t`` counts from 0 in
        all of them, and the last one ends at the horizon."""
        ends, known = [0.0, *(float(until) for until, _ in pieces)], _Uncertain.of(parameters, names)
        phases = tuple(
            _phase(f"system.pieces.{i}", given, during, define, known)
            for i, (during, (_, given)) in enumerate(zip(pairwise(ends), pieces, strict=True))
        )
        return System(phases, known.box, delay)


def _duration(value: object) -> float:
    """A finite number that is not negative; raises `InputError`."""
    usable = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not usable or not 0.0 <= float(value) < np.inf:  # type: ignore[arg-type]
        raise InputError(path="system.delay", expected="a finite time, not negative", got=f"{value!r}")
    return float(value)  # type: ignore[arg-type]


def _difference(low: float, high: float) -> float:
    """``high - low``, or the next double above it."""
    exact, found = Fraction(float(high)) - Fraction(float(low)), float(high) - float(low)
    return found if Fraction(found) >= exact else float(np.nextafter(found, np.inf))


def _check_ends(ends: Sequence[float], horizon: float, whole: bool) -> None:
    """Raise `InputError` where the systems, or laws, that end at these times do not fill the horizon; ``whole``: it is
    one law, of which no piece is named."""
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
    if not isinstance(pair, Sequence) or len(pair) != 2:
        raise InputError(path=f"system.pieces.{i}", expected="a pair of a time and a LinearSystem", got=f"{pair!r}")
    until, system = pair
    if isinstance(until, bool) or not isinstance(until, int | float | np.integer | np.floating):
        raise InputError(path=f"system.pieces.{i}.until", expected="a time", got=f"{until!r}")
    if not before < until < np.inf:
        raise InputError(path=f"system.pieces.{i}.until", expected=f"a time after {before:g}", got=f"{until:g}")
    kind = system.kind if isinstance(system, System) else type(system).__name__
    if kind != "LinearSystem" or system.delay:
        said = "a delay of its own" if kind == "LinearSystem" else kind
        raise InputError(path=f"system.pieces.{i}", expected="a LinearSystem without delay", got=said)


@final
@dataclass(frozen=True, eq=False)
class _Uncertain:
    """The box of parameters beside the time, and the names of both."""

    box: Box | None
    names: tuple[str, ...]

    @staticmethod
    def of(parameters: ConvexSet | None, names: Sequence[str]) -> _Uncertain:
        """Those that are given; raises `InputError` for a set that is no box, or as many names."""
        box = None if parameters is None else boxed(parameters)
        count = 0 if box is None else box.dimension
        given = tuple(names) or tuple(f"p{i + 1}" for i in range(count))
        if len(given) != count or TIME in given:
            expected = f"{count} names, none of them {TIME}, which is the time"
            raise InputError(path="system.parameters", expected=expected, got=", ".join(given))
        return _Uncertain(box, (TIME, *given))


def _phase(
    where: str,
    given: InTime,
    during: tuple[float, float],
    define: Mapping[str, str | float] | None,
    uncertain: _Uncertain,
) -> Phase:
    """The phase that is ``given`` at a key of a config, whose entries speak of the time between two."""
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
