"""The keys of the problem ``linear``, an uncertain linear optimal control problem, as a config writes them."""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, TypeAlias, final

import numpy as np
import numpy.typing as npt
from pydantic import BeforeValidator, Discriminator, Field, Tag

from sparserob_core.control.policies.measurements import Measurements
from sparserob_core.control.problem.cost import Cost
from sparserob_core.control.problem.disturbances import Disturbance, DisturbanceClass
from sparserob_core.control.problem.names import Names
from sparserob_core.control.problem.phase import TIME
from sparserob_core.control.problem.problem import OptimalControlProblem, ProblemFactory
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, System, VaryingSystem
from sparserob_core.control.problem.terms.windows import MixedConstraint, PathConstraint
from sparserob_core.control.sets.budget import BudgetedBox
from sparserob_core.control.sets.sets import Box, ConvexSet, Equality
from sparserob_core.errors import InputError
from sparserob_core.experiment.config.matrices.packed import OrPacked, Packed
from sparserob_core.experiment.config.option_kinds import (
    LIST,
    NUMBER,
    Number,
    Numbers,
    NumbersInTime,
    OneOrMore,
    Sparse,
    broadcast,
    one_of,
)
from sparserob_core.experiment.config.set_options import (
    InitialStateOptions,
    IntegralOptions,
    PathOptions,
    SetOptions,
    TerminalOptions,
    TermOptions,
)
from sparserob_core.options import Options
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.elementary import FUNCTIONS
from sparserob_core.sip.expressions.expression import (
    CONSTANTS,
    KEPLER,
    Definitions,
    ExpressionMatrix,
    parse_column,
    parse_definitions,
    parse_matrix,
)


def _check_entry(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, int | float | str | np.number):
        raise InputError(expected="a number or an expression in the parameters such as '-2 + p1'", got=f"{value!r}")
    return value


Entry: TypeAlias = Annotated[float | str, BeforeValidator(_check_entry)]


def _check_interval(value: object) -> object:
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise InputError(expected="an interval [lower, upper]", got=f"{value!r}")
    return value


Interval: TypeAlias = Annotated[tuple[float, float], BeforeValidator(_check_interval)]
Rows: TypeAlias = Annotated[list[Annotated[list[Entry], Field(min_length=1)]], Field(min_length=1), OrPacked()]
Column: TypeAlias = Annotated[list[Entry], Field(min_length=1), OrPacked(column=True)]
MAX_CONFIG_PIECES = 1_000_000  # the same limit as that of a dictionary of equal pieces
Matrix: TypeAlias = Annotated[list[Annotated[list[float], Field(min_length=1)]], Field(min_length=1), OrPacked()]


@final
class ParameterSetOptions(SetOptions):
    """Parameters in any bounded set."""

    names: list[str] = Field(min_length=1)
    """Names of the parameters, in the order of the set's coordinates."""


def _tag_parameters(value: object) -> str | None:
    if isinstance(value, ParameterSetOptions) or (isinstance(value, Mapping) and "names" in value):
        return "set"
    return "intervals" if isinstance(value, Mapping) else None


Parameters: TypeAlias = Annotated[
    Annotated[dict[str, Interval], Tag("intervals")] | Annotated[ParameterSetOptions, Tag("set")],
    Discriminator(
        _tag_parameters,
        custom_error_type="kind",
        custom_error_message="expected {name: [lower, upper], ...} or {names: [...], polytope: ...}",
    ),
]


@final
class PieceOptions(Options):
    """A system that holds until a known time; entries are numbers, or arithmetic expressions in the parameters."""

    until: float = Field(gt=0.0)
    """End of this piece; that of the last one is the horizon."""

    A: Rows
    """Square matrix, row by row."""

    B: Rows
    """As many rows as ``A``, one column per control."""

    E: Rows | None = None
    """Matrix of the disturbance; the identity unless given."""

    c: Column | None = None
    """Constant drift, one entry per state; none unless given."""


@final
class SystemOptions(Options):
    """``x'(t) = A(p) x(t) + B(p) u(t - delay) + E(p) w(t) + c(p)``, or ``pieces``: such systems that follow one another
    at known times. Entries are numbers, or arithmetic expressions in the parameters, in the time ``t`` and in the names
    of ``define``."""

    A: Rows | None = None
    """Square matrix, row by row."""

    B: Rows | None = None
    """As many rows as ``A``, one column per control."""

    E: Rows | None = None
    """Matrix of the disturbance, one column per component of it; the identity unless given."""

    pieces: Annotated[list[PieceOptions], Field(min_length=1)] | None = None
    """Instead of ``A``, ``B``, ``E`` and ``c``: systems with their own, each ``until`` a known time; they share the
    parameters and the delay."""

    parameters: Parameters | None = None
    """Intervals ``{name: [lower, upper]}``, or names and a set, as ``{names: [...], polytope: {H: ..., h: ...}}``; none
    where all is known. With entries in ``t`` only intervals."""

    c: Column | None = None
    """Constant drift such as gravity, one entry per state, in units of the state per time; none unless given."""

    define: dict[str, Entry] | None = None
    """Names for expressions, in order, that ``A``, ``B``, ``E`` and ``c`` may use, as in ``{M: n * t, E: "kepler(M,
    0.2)"}``: ``kepler(M, e)`` is the ``E`` with ``E - e sin E = M``, ``0 <= e < 1``; none unless given."""

    delay: float = Field(default=0.0, ge=0.0)
    """Delay of the control, less than the horizon; until then ``initial_control`` acts."""

    def names(self) -> tuple[str, ...]:
        """Return the names of the parameters; raises `InputError` where one cannot be used in an expression."""
        names = (
            self.parameters.names if isinstance(self.parameters, ParameterSetOptions) else list(self.parameters or {})
        )
        for name in names:
            if not name.isidentifier() or keyword.iskeyword(name) or name in {*CONSTANTS, *FUNCTIONS, KEPLER}:
                raise InputError(
                    f"{name!r} cannot name a parameter; expected letters, digits and underscores, and not one of"
                    f" {', '.join([*CONSTANTS, *FUNCTIONS, KEPLER])}",
                    path="system.parameters",
                )
        if len(set(names)) < len(names):
            raise InputError(f"a name occurs twice, got {', '.join(names)}", path="system.parameters.names")
        return tuple(names)

    def matrices(self) -> list[tuple[str, float | None, Matrices]]:
        """Return for each piece its key, its end, and its matrices ``A``, ``B``, ``E`` and ``c``.

        A system without pieces is one without an end. Raises `InputError` where both a system and pieces are given, or
        neither.
        """
        if self.pieces is None:
            for key, rows in (("A", self.A), ("B", self.B)):
                if rows is None:
                    raise InputError(path=f"system.{key}", expected="a matrix, or pieces of the system", got="none")
            assert self.A is not None and self.B is not None
            return [("system", None, (self.A, self.B, self.E, self.c))]
        for key in ("A", "B", "E", "c"):
            if getattr(self, key) is not None:
                raise InputError(path=f"system.{key}", expected="none beside pieces, which have their own", got="both")
        return [
            (f"system.pieces.{i}", piece.until, (piece.A, piece.B, piece.E, piece.c))
            for i, piece in enumerate(self.pieces)
        ]

    def build(self, horizon: float | None = None) -> System:
        """Return the system.

        Parameters
        ----------
        horizon : float, optional
            The final time; a system whose entries depend on the time needs it.

        Returns
        -------
        System
            The system.

        Raises
        ------
        InputError
            If a key is at fault; the error begins with the key.
        """
        names = self.names()
        parameters, pieces = self._build_parameter_set(names), self.matrices()
        where, until, first = pieces[0]
        if self._is_time_varying(names, pieces):
            return self._build_varying_system(pieces, horizon, parameters)
        try:
            defined = parse_definitions(self.define or {}, names)
        except InputError as error:
            raise error.under("system") from None
        if until is None:
            return _build_system(where, first, parameters, names, self.delay, defined)
        phases = [
            (float(stop or 0.0), _build_system(key, matrices, parameters, names, 0.0, defined))
            for key, stop, matrices in pieces
        ]
        return SwitchedSystem(phases, self.delay)

    def _is_time_varying(self, names: tuple[str, ...], every: list[tuple[str, float | None, Matrices]]) -> bool:
        """Return whether an entry or a definition contains the time ``t``, where no parameter has that name."""
        if TIME in names:
            return False
        texts = [*(self.define or {}).values()]
        for _, _, (A, B, E, c) in every:
            texts += [entry for rows in (A, B, E or []) for row in rows for entry in row] + (c or [])
        return any(TIME in re.findall(r"[A-Za-z_]\w*", text) for text in texts if isinstance(text, str))

    def _build_varying_system(
        self, every: list[tuple[str, float | None, Matrices]], horizon: float | None, parameters: ConvexSet | None
    ) -> System:
        if horizon is None:
            raise InputError(path="system", expected="a system that stays the same with time here", got="one in t")
        for where, _, of in every:
            _check_shapes(where, of)
        if self.pieces is None:
            A, B, E, c = every[0][2]
            return VaryingSystem.of(A, B, horizon, E, c, self.define, self.delay, parameters, self.names())
        phases = [(float(until or 0.0), matrices) for _, until, matrices in every]
        return VaryingSystem.taking_turns(phases, self.define, self.delay, parameters, self.names())

    def _build_parameter_set(self, names: tuple[str, ...]) -> ConvexSet | None:
        if isinstance(self.parameters, ParameterSetOptions):
            return self.parameters.build("system.parameters", len(names))
        if not self.parameters:
            return None
        for name, (lower, upper) in self.parameters.items():
            if lower > upper:
                raise InputError(
                    path=f"system.parameters.{name}",
                    expected="[lower, upper] with lower <= upper",
                    got=f"[{lower:g}, {upper:g}]",
                )
        return Box(*np.array(list(self.parameters.values())).T)


@final
class UnitsOptions(Options):
    """Units, one text each; an empty text where no unit is known."""

    states: list[str] = Field(default_factory=list)
    """Units of the states."""

    controls: list[str] = Field(default_factory=list)
    """Units of the controls."""

    disturbances: list[str] = Field(default_factory=list)
    """Units of the disturbance's components."""

    time: str = ""
    """Unit of time."""


@final
class NamesOptions(Sparse):
    """Names in messages, tables, figures and recordings; no number changes."""

    states: list[str] = Field(default_factory=list)
    """Names of the states; x1, x2, ... unless given."""

    controls: list[str] = Field(default_factory=list)
    """Names of the controls; u1, u2, ... unless given."""

    disturbances: list[str] = Field(default_factory=list)
    """Names of the disturbance's components; w1, w2, ... unless given."""

    units: UnitsOptions = UnitsOptions()
    """Units of states, controls, disturbances and time."""

    plane: list[str] | None = None
    """The two states that are a position, drawn to the right and upwards: the run then has a figure of the plane in
    which the system moves."""

    def build(self) -> Names:
        """Return the names; raises `InputError` that begins with the key."""
        units = self.units
        return Names(
            states=self.states,
            controls=self.controls,
            disturbances=self.disturbances,
            state_units=units.states,
            control_units=units.controls,
            disturbance_units=units.disturbances,
            time=units.time,
            plane=self.plane or (),
        )


@final
class StateCostOptions(Options):
    """``(x - reference)' Q (x - reference)``."""

    Q: Matrix
    """Symmetric positive semidefinite matrix, row by row."""

    reference: OneOrMore = 0.0
    """The state at which the term is 0, one number per state; a number holds for every state."""

    def term(self, key: str, states: int) -> Mapping[str, npt.ArrayLike]:
        """Return the term of the ``key``, as `Cost` takes it; raises `InputError`."""
        try:
            return {"Q": self.Q, "reference": broadcast("reference", self.reference, states)}
        except InputError as error:
            raise error.under("cost", key) from None


@final
class ControlCostOptions(Options):
    """``u'R u``."""

    R: Matrix
    """Symmetric positive semidefinite matrix, row by row."""


@final
class CostOptions(Sparse):
    """Cost of a control; quadratic terms are those of the nominal trajectory, integrated exactly."""

    l1: float = Field(default=1.0, ge=0.0)
    """Factor of the integral of the weighted absolute values; 0 for a purely quadratic cost."""

    group: (
        Annotated[
            Annotated[Literal["all"], Tag("all")]
            | Annotated[list[Annotated[list[int], Field(min_length=1)]], Tag("lists")],
            one_of("lists of channels counted from 1, as [[1, 2], [3]], or all", all=str, lists=LIST),
        ]
        | None
    ) = None
    """Channels that count with their Euclidean norm, as one vector, instead of their absolute values."""

    state: StateCostOptions | None = None
    """Quadratic cost of the state, integrated over time; none unless given."""

    control: ControlCostOptions | None = None
    """Quadratic cost of the control, integrated over time; none unless given."""

    final: StateCostOptions | None = None
    """Quadratic cost of the state at the horizon; none unless given."""

    def build(self, states: int) -> Cost:
        """Return the cost; raises `InputError` that begins with the key."""
        return Cost(
            l1=self.l1,
            group=self.group,
            state=None if self.state is None else self.state.term("state", states),
            control=None if self.control is None else {"R": self.control.R},
            final=None if self.final is None else self.final.term("final", states),
        )


@final
class BudgetOptions(Sparse):
    """A budget of a disturbance over time: ``int sum_i |w_i|^p dt <= size``."""

    p: Literal[1, 2]
    """1: the integral of the sum of the absolute values; 2: that of the square of the Euclidean norm."""

    size: float = Field(gt=0.0, allow_inf_nan=False)
    """The largest value of the integral over the horizon, in units of ``|w|^p`` times the unit of time."""


@final
class DisturbedOptions(SetOptions):
    """The set of the values of a disturbance; with a ``budget`` a box that is symmetric about 0."""

    budget: BudgetOptions | None = None
    """Bound of an integral of the disturbance over the horizon, such as ``{p: 1, size: 0.5}``."""

    def build(self, where: str, dimension: int) -> ConvexSet:
        """Return the set; raises `InputError` that begins with the key."""
        bound = super().build(where, dimension)
        if self.budget is None:
            return bound
        if not isinstance(bound, Box):
            raise InputError(path=where, expected="a box beside the budget, such as box: 0.1", got=f"a {bound.kind}")
        try:
            return BudgetedBox(bound.lower, bound.upper, self.budget.p, self.budget.size)
        except InputError as error:
            raise error.under(where) from None


@final
class DisturbanceOptions(Sparse):
    """A disturbance of a list of several."""

    bound: SetOptions = Field(alias="set")
    """Set of its values."""

    E: Rows | None = None
    """Its matrix, as many rows as there are states, one column per component of it; that of the system unless given."""

    kind: DisturbanceClass = Field(default="piecewise_constant", alias="class")
    """Its class of functions, as in ``disturbance_class``; ``l1_ball`` holds for all of a list, or for none."""

    start: float | None = Field(default=None, alias="from", ge=0.0)
    """Time at which it begins to act; 0 unless given."""

    stop: float | None = Field(default=None, alias="to", ge=0.0)
    """Time at which it ceases to act; the horizon unless given."""

    pieces: int | None = Field(default=None, ge=1, le=MAX_CONFIG_PIECES)
    """Number of equal pieces on which it is constant; those of ``dictionaries.disturbance`` unless ``pieces`` or
    ``breakpoints`` is given."""

    breakpoints: Annotated[list[float], Field(min_length=2)] | None = None
    """Ends of the pieces on which it is constant, increasing from 0 to the horizon."""

    def times(self, where: str, horizon: float) -> list[float] | Array | None:
        """Return the ends of its pieces; ``None`` where it has none of its own.

        Raises `InputError` where both ``pieces`` and ``breakpoints`` are given.
        """
        if self.pieces is not None and self.breakpoints is not None:
            raise InputError(path=where, expected="one of pieces and breakpoints", got="both")
        return self.breakpoints if self.pieces is None else np.linspace(0.0, horizon, self.pieces + 1)


Matrices: TypeAlias = tuple[list[list[Any]], list[list[Any]], list[list[Any]] | None, list[Any] | None]


def _check_shapes(where: str, of: Matrices) -> None:
    """Raise `InputError` where matrices do not fit each other."""
    A, B, E, c = of
    d = len(A)
    for key, rows in (("A", A), ("B", B), ("E", E)):
        if rows is not None and len(rows) != d:
            raise InputError(path=f"{where}.{key}", expected=f"{d} rows, as A has", got=f"{len(rows)}")
    if any(len(row) != d for row in A):
        raise InputError(
            path=f"{where}.A",
            expected=f"a square matrix, {d} numbers in each of its {d} rows",
            got=f"{[len(row) for row in A]}",
        )
    if c is not None and len(c) != d:
        raise InputError(path=f"{where}.c", expected=f"{d} entries, one per state", got=f"{len(c)}")


def _build_system(
    where: str,
    of: Matrices,
    parameters: ConvexSet | None,
    names: tuple[str, ...],
    delay: float = 0.0,
    defined: Definitions = (),
) -> System:
    _check_shapes(where, of)
    A, B, E, c = of

    def entries(key: str, rows: list[list[Any]]) -> Array | ExpressionMatrix:
        return rows.array if isinstance(rows, Packed) else parse_matrix(f"{where}.{key}", rows, names, defined)

    return LinearSystem(
        entries("A", A),
        entries("B", B),
        None if E is None else entries("E", E),
        parameters,
        names,
        None if c is None else parse_column(f"{where}.c", c, names, defined),
        delay,
    )


@final
class MeasurementOptions(Options):
    """Measurement at every breakpoint of the control's dictionary: ``C x`` and a noise."""

    C: Matrix
    """One row per output, one number per state."""

    noise: SetOptions | None = None
    """Bounded set of the noise of the outputs; none unless given."""

    latency: float = Field(default=0.0, ge=0.0)
    """Time until a measurement is known to the control; 0 unless given."""

    def build(self) -> Measurements:
        """Return the measurements; raises `InputError` that begins with the key."""
        noise = None if self.noise is None else self.noise.build("measurements.noise", len(self.C))
        lengths = {len(row) for row in self.C}
        if len(lengths) > 1:
            raise InputError(path="measurements.C", expected="rows of one length", got=f"{sorted(lengths)}")
        return Measurements(self.C, noise, self.latency)


class ProblemKeys(ProblemFactory, Options):
    """The keys that all problems with a linear system share; each problem adds those of its system and its control."""

    horizon: float = Field(gt=0.0)
    """Final time."""

    initial_state: Annotated[
        Number | Numbers | Annotated[InitialStateOptions, Tag("set")],
        one_of(
            "a number, a list of numbers, or {centre: ..., box: ...} for all initial states of a set",
            number=NUMBER,
            list=LIST,
            set=(Mapping, InitialStateOptions),
        ),
    ]
    """State at time 0, one number per state; a number holds for every state. Or a set of states: a ``centre`` and any
    set of deviations from it, such as ``{centre: [-1, 1], box: 0.05}``."""

    weights: NumbersInTime | None = None
    """Weight of every control in the cost, positive; 1 unless given. Or rows of a time and the weights from then on,
    which are not negative, such as ``[[0, 1], [12, 2]]`` for one control; the first time is 0."""

    cost: CostOptions = Field(default_factory=CostOptions)
    """Cost that is minimised; the integral of the weighted absolute values of the control unless given."""

    disturbance: (
        Annotated[
            Annotated[DisturbedOptions, Tag("set")] | Annotated[list[DisturbanceOptions], Tag("list")],
            one_of(
                "a set, such as {box: 0.1}, or a list of disturbances, such as [{set: {box: 0.1}, E: [[0], [1]]}]",
                set=(Mapping, DisturbedOptions),
                list=LIST,
            ),
        ]
        | None
    ) = None
    """Set of the values of the disturbance; none unless given. A ``budget`` beside a box bounds an integral over the
    horizon, as in ``{box: 0.1, budget: {p: 1, size: 0.5}}``. Or a list of disturbances, each with its set, its ``E``,
    its class and its pieces, such as ``[{set: {box: 0.1}, E: [[0], [1]]}, {set: {box: 0.02}, E: [[1], [0]], pieces:
    8}]``."""

    disturbance_class: DisturbanceClass = "piecewise_constant"
    """``piecewise_constant``: in the disturbance's dictionary; ``measurable``: any measurable function, in open loop;
    ``l1_ball``: the coefficients of each channel have absolute sum at most the box's bound (a far smaller set)."""

    path: list[PathOptions] = Field(default_factory=list)
    """Sets in which the state stays, each from ``from`` (0 unless given) to ``to`` (the horizon unless given)."""

    terminal: list[TerminalOptions] = Field(default_factory=list)
    """Sets in which the state ends, and fixed final values."""

    integral: list[IntegralOptions] = Field(default_factory=list)
    """Bounds of integrals of state and control over windows: fuel of a channel, energy of a battery, a mean; as
    ``[{G: [[1]], to: 5, upper: [2]}]``."""

    names: NamesOptions = NamesOptions()
    """Names and units for messages, tables, figures and recordings."""

    def initial(self, states: int) -> list[float]:
        """Return the initial state, or the centre of the initial states, one number per state; raises `InputError`."""
        if isinstance(self.initial_state, InitialStateOptions):
            return [float(value) for value in self.initial_state.around("initial_state", states)[0]]
        values = self.initial_state if isinstance(self.initial_state, list) else [self.initial_state] * states
        if len(values) != states:
            raise InputError(path="initial_state", expected=f"{states} numbers, one per state", got=f"{len(values)}")
        return values

    def deviations(self, states: int) -> ConvexSet | None:
        """Return the set of deviations from `initial`; ``None`` for a single initial state. Raises `InputError`."""
        if not isinstance(self.initial_state, InitialStateOptions):
            return None
        return self.initial_state.around("initial_state", states)[1]

    def noise(self, system: System) -> ConvexSet | None:
        """Return the set of the disturbance; ``None`` where there is none, or a list (`disturbances`). Raises
        `InputError`."""
        if self.disturbance is None or isinstance(self.disturbance, list):
            return None
        return self.disturbance.build("disturbance", system.disturbances)

    def disturbances(self, system: System, below: int = 0) -> list[Disturbance]:
        """Return the disturbances of a list; there are none where no list is given.

        Parameters
        ----------
        system : System
            The system.
        below : int, default 0
            The number of rows of zeros that are added below each ``E``.

        Returns
        -------
        list of Disturbance
            The disturbances.

        Raises
        ------
        InputError
            If a key is at fault; the error begins with the key.
        """
        disturbances: list[Disturbance] = []
        for i, entry in enumerate(self.disturbance if isinstance(self.disturbance, list) else ()):
            where = f"disturbance.{i}"
            if entry.E is not None and len(entry.E) != system.states:
                raise InputError(
                    path=f"{where}.E", expected=f"{system.states} rows, one per state", got=f"{len(entry.E)}"
                )
            rows = None if entry.E is None else entry.E + [[0.0] * len(entry.E[0])] * below
            names = tuple(system.phases[0].names)
            E = None if rows is None else parse_matrix(f"{where}.E", rows, names)
            width = system.disturbances if entry.E is None else len(entry.E[0])
            bound, times = entry.bound.build(f"{where}.set", width), entry.times(where, self.horizon)
            disturbances.append(Disturbance(bound, E, entry.kind, entry.start or 0.0, entry.stop, times))
        return disturbances

    def constraints(self) -> dict[str, Any]:
        """Return the constraints that are written field by field, by the key of their list in the problem."""
        values = {name: getattr(self, name) for name in type(self).model_fields}
        return {
            name: [term.build() for term in terms]
            for name, terms in values.items()
            if isinstance(terms, list) and terms and isinstance(terms[0], TermOptions)
        }

    def windows(self, states: int) -> list[PathConstraint | MixedConstraint]:
        """Return the path constraints, one per set or bound of state and control together; raises `InputError`."""
        listed = enumerate(self.path)
        return [constraint for i, item in listed for constraint in item.entries(f"path.{i}", states, self.horizon)]

    def ends(self, states: int) -> list[ConvexSet | Equality]:
        """Return the terminal sets and equalities; raises `InputError`."""
        return [end for i, item in enumerate(self.terminal) for end in item.ends(f"terminal.{i}", states)]


class LinearKeys(ProblemKeys):
    """The keys of problems that write their system as matrices; each problem adds those of its control."""

    system: SystemOptions
    """The system."""


class ControlKeys(ProblemKeys):
    """The keys of problems whose control is that of the system; each problem adds those of its system."""

    makes: ClassVar[type[OptimalControlProblem]] = OptimalControlProblem

    control: SetOptions
    """Bounded set of the values of the control."""

    initial_control: OneOrMore | None = None
    """Control before time 0, one number per control; a number holds for every control. Unknown unless given."""

    control_step: SetOptions | None = None
    """Set of the change of the control from one piece of its dictionary to the next, and from ``initial_control`` to
    the first piece where that is given; any change unless given."""

    measurements: MeasurementOptions | None = None
    """Measurements that a policy answers: ``{C: ..., noise: ..., latency: ...}``; all states, without noise and at
    once, unless given."""

    execution: OneOrMore | None = None
    """Share of the control, from 0 to 1, by which the delivered control may differ from the command: one number per
    control, or one for all, such as 0.02. The command is delivered exactly unless given."""

    jitter: float = 0.0
    """Time by which every change of the control may come late, less than every piece of the control: until then each
    delivered control may be anything between the old and the new value."""

    repeat: bool = False
    """Whether the plan is repeated for ever from the horizon on: every final state is then one of the initial states,
    and ``control_step`` also holds from the last control to the first one. Not with a delay."""

    def problem(self, system: System, names: Names | None = None) -> OptimalControlProblem:
        """Return the problem of a system.

        Parameters
        ----------
        system : System
            The system.
        names : Names, optional
            The names that replace those of the keys.

        Returns
        -------
        OptimalControlProblem
            The problem.

        Raises
        ------
        InputError
            If a key is at fault; the error begins with the key.
        """
        if self.initial_control is not None and self.control_step is None and not system.delay > 0.0:
            raise InputError(
                path="initial_control",
                expected="control_step or a system.delay beside it, since the control before time 0 does nothing else",
                got="neither of them",
            )
        return self.makes(
            system=system,
            horizon=self.horizon,
            initial_state=self.initial(system.states),
            initial_set=self.deviations(system.states),
            control=self.control.build("control", system.controls),
            weights=self.weights,
            disturbance=self.noise(system),
            disturbance_class=self.disturbance_class,
            disturbances=self.disturbances(system),
            path=self.windows(system.states),
            terminal=self.ends(system.states),
            **self.constraints(),
            cost=self.cost.build(system.states),
            initial_control=self._expand_initial_control(system.controls),
            control_step=(
                None if self.control_step is None else self.control_step.build("control_step", system.controls)
            ),
            names=self.names.build() if names is None else names,
            measurements=None if self.measurements is None else self.measurements.build(),
            repeat=self.repeat,
            execution=None if self.execution is None else broadcast("execution", self.execution, system.controls),
            jitter=self.jitter,
        )

    def _expand_initial_control(self, controls: int) -> list[float] | None:
        control = self.initial_control
        if control is None or isinstance(control, list):
            return control
        return [control] * controls


@final
class LinearProblem(ControlKeys, LinearKeys):
    """Sparse robust control of ``x' = A(p) x + B(p) u + E w`` from an initial state, at the least integral of
    ``|u|``."""

    def build(self) -> OptimalControlProblem:
        """Return the problem; raises `InputError` that begins with the key at fault."""
        return self.problem(self.system.build(self.horizon))
