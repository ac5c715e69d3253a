"""Linear systems: uncertain ones ``x' = A(p) x + B(p) u + E(p) w + c(p)``, such that take turns, and such that change
with time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from typing import TypeAlias, final

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.control.enclosures.dependence import PARTS, Dependence, Spread, Superposed, dependence
from sparserob_core.control.enclosures.taylor import TaylorModel, TaylorSpace
from sparserob_core.control.problem.expression import (
    ExpressionMatrix,
    above,
    beside,
    parse_column,
    parse_definitions,
    parse_matrix,
)
from sparserob_core.control.problem.tracing import SAME
from sparserob_core.control.sets.sets import Box
from sparserob_core.control.sets.strangers import require_consistent
from sparserob_core.control.term import SAME_TIME, over
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.shapes import Float, dense, shaped
from sparserob_core.sip.convex_set import Array, ConvexSet

InTime: TypeAlias = tuple[
    Sequence[Sequence[str | float]],
    Sequence[Sequence[str | float]],
    Sequence[Sequence[str | float]] | None,
    Sequence[str | float] | None,
]
"""``A``, ``B``, ``E`` and ``c`` with entries in the time."""
Matrix: TypeAlias = npt.ArrayLike | Callable[..., object] | ExpressionMatrix
TIME = "t"
PERIODIC = 1e-9
"""Of an entry, by how much its values at both ends of a period may differ. What a horizon of 53 bits misses of a period
is a tenth of it where an entry changes by its size in a millionth of the period; of ten times more a rounded decimal
would pass for the period."""
LOOKS = 65  # times at which the size of a system is looked at; with ten times fewer a short pericentre is overlooked
_Entry: TypeAlias = Array | Callable[..., object] | ExpressionMatrix


@dataclass(frozen=True, eq=False)
class LinearSystem:
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

    A: Matrix
    B: Matrix
    E: Matrix | None = None
    parameters: ConvexSet | None = None
    names: Sequence[str] = ()
    c: Matrix | None = None
    delay: float = 0.0

    __repr__ = noun

    def __post_init__(self) -> None:
        self._check_parameters()
        object.__setattr__(self, "delay", _duration(self.delay))
        for name in ("A", "B"):
            object.__setattr__(self, name, self._matrix(name, getattr(self, name)))
        d, columns = self._shape("A")
        if d != columns:
            raise InputError(f"A must be square, got shape {(d, columns)}", path="system")
        object.__setattr__(self, "E", np.eye(d) if self.E is None else self._matrix("E", self.E))
        for name in ("B", "E"):
            if self._shape(name)[0] != d:
                raise InputError(f"{name} must have {d} rows, as A has, got shape {self._shape(name)}", path="system")
        if self.c is not None:
            self._check_drift(d)
        self.matrices(self.probes)

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

    @property
    def states(self) -> int:
        """Number ``d`` of states."""
        return self._shape("A")[0]

    @property
    def controls(self) -> int:
        """Number ``m`` of controls."""
        return self._shape("B")[1]

    @property
    def disturbances(self) -> int:
        """Number ``mw`` of disturbances that ``E`` takes."""
        return self._shape("E")[1]

    @cached_property
    def forced(self) -> LinearSystem:
        """The same system with its drift as one more column of ``B``, whose control is always 1; itself without a
        drift. It has no delay: that belongs to the times at which the controls act."""
        if self.c is None:
            return self
        return LinearSystem(self.A, beside(self._entry("B"), self._entry("c")), self.E, self.parameters, self.names)

    def with_parameters(self, parameters: ConvexSet) -> LinearSystem:
        """The same system with its parameters in another set."""
        return replace(self, parameters=parameters)

    def remaining(self, begin: float, horizon: float) -> LinearSystem:
        """Itself: it does not change with time."""
        return self

    def at_times(self, start: float, stop: float, later: float) -> LinearSystem:
        """The same law of a first parameter that is the time, from ``start`` to ``stop`` of a clock that shows 0 so
        much ``later``."""
        assert isinstance(self.parameters, Box)
        lower, upper = (
            np.append(end, side[1:])
            for end, side in zip((start, stop), (self.parameters.lower, self.parameters.upper), strict=True)
        )
        A, B, E, c = (_later(self.entry(name), later) for name in PARTS)
        assert A is not None and B is not None
        return LinearSystem(A, B, E, Box(lower, upper), self.names, c)

    @shaped
    def accumulating(self, rows: Float[Array, "k d"], inputs: Float[Array, "k m"]) -> LinearSystem:
        """The same system with ``k`` more states after its own, ``z' = rows x + inputs u(t - delay)``: integrals of
        what its state and its control do."""
        k, d = rows.shape
        below = {"B": inputs, "E": np.zeros((k, self.disturbances)), "c": np.zeros((k, 1))}
        known = {
            name: above(self._entry(name), part) for name, part in below.items() if name != "c" or self.c is not None
        }
        A = above(beside(self._entry("A"), np.zeros((d, k))), np.hstack([rows, np.zeros((k, k))]))
        return LinearSystem(A, known["B"], known["E"], self.parameters, self.names, known.get("c"), self.delay)

    @property
    def modes(self) -> tuple[LinearSystem, ...]:
        """The systems that take turns: this one alone."""
        return (self,)

    @property
    def switches(self) -> tuple[float, ...]:
        """When one mode follows another: never."""
        return ()

    @property
    def varies(self) -> bool:
        """Whether it changes with time all along, not at its switches alone."""
        return False

    def turns(self, horizon: float) -> tuple[tuple[float, float, LinearSystem], ...]:
        """Between which times which of the systems acts, or of the laws: this one until the horizon."""
        return ((0.0, horizon, self),)

    def taking(self, turns: Sequence[tuple[float, float, LinearSystem]]) -> LinearSystem | SwitchedSystem:
        """A system of the same kind whose `turns` are these."""
        return turns[0][2] if len(turns) == 1 else _switched(turns, self.delay)

    def check_horizon(self, horizon: float) -> None:
        """Raise `InputError` where it does not last until the horizon."""

    def check_period(self) -> None:
        """Raise `InputError` where it does not begin again at the horizon; what does not change does."""

    @property
    def parameter_count(self) -> int:
        """Number ``nu`` of parameters, 0 for a known system."""
        return 0 if self.parameters is None else self.parameters.dimension

    @shaped
    def matrices(
        self, parameters: Float[Array, "k nu"]
    ) -> tuple[Float[Array, "k d d"], Float[Array, "k d m"], Float[Array, "k d mw"]]:
        """``A (k, d, d)``, ``B (k, d, m)``, ``E (k, d, mw)`` at parameters ``(k, nu)``; raises `InputError` where they
        are not finite."""
        points = np.asarray(parameters, dtype=float)
        if points.ndim != 2 or points.shape[1] != self.parameter_count:
            raise InputError(
                f"parameters must have shape (k, {self.parameter_count}), got {points.shape}", path="system"
            )
        A, B, E = (self._values(name, points) for name in ("A", "B", "E"))
        return A, B, E

    @shaped
    def taylor(
        self, space: TaylorSpace, centre: Float[Array, " nu"], radius: Float[Array, " nu"]
    ) -> tuple[
        Float[Array, "M d d"],
        Float[Array, "d d"],
        Float[Array, "M d m"],
        Float[Array, "d m"],
        Float[Array, "M d mw"],
        Float[Array, "d mw"],
    ]:
        """Taylor models of all entries over the cell ``centre +- radius``, both ``(nu,)``.

        Returns ``A_coefficients (M, d, d), A_remainder (d, d)`` and the same for ``B`` and ``E``.
        Raises `NotEnclosable` when a function cannot be evaluated on Taylor models, or has a singularity on the cell.
        """
        p = np.empty(self.parameter_count, dtype=object)
        p[:] = space.variables(centre, radius)
        A, B, E = (self._enclosed(name, space, p) for name in ("A", "B", "E"))
        return *A, *B, *E

    @shaped
    def in_units(
        self,
        A: Float[Array, "d d"],
        B: Float[Array, "d m"],
        E: Float[Array, "d mw"],
        parameters: Float[Array, " nu"],
        c: Float[Array, "d 1"] | float = 1.0,
        time: float = 1.0,
    ) -> LinearSystem:
        """The system whose matrices are ``A``, ``B``, ``E``, ``c`` times these factors, entry by entry, and whose
        parameter and delay are this one's divided by ``parameters (nu,)`` and ``time``; exact for powers of two."""
        delay = self.delay / time
        if self.parameters is None:
            ours = [matrix[0] for matrix in self.matrices(np.zeros((1, 0)))]
            drift = None if self.c is None else self._values("c", np.zeros((1, 0)))[0] * c
            return LinearSystem(ours[0] * A, ours[1] * B, ours[2] * E, c=drift, delay=delay)
        return SystemInUnits(
            self.A,
            self.B,
            self.E,
            self.parameters.in_units(parameters),
            self.names,
            self.c,
            delay,
            base=self,
            factors={"A": A, "B": B, "E": E, "c": np.broadcast_to(c, (A.shape[0], 1))},
            units=parameters,
        )

    @shaped
    def describe(self, parameter: Float[Array, " nu"]) -> str:
        """A parameter vector in words, such as ``p1 = 0.1, p2 = -0.1``."""
        return ", ".join(f"{name} = {value:.6g}" for name, value in zip(self.names, parameter, strict=True))

    def entry(self, name: str) -> _Entry | None:
        """``A``, ``B``, ``E`` or ``c (d, 1)`` as an array, expressions, or a function of ``p (nu,)``."""
        return None if name == "c" and self.c is None else self._entry(name)

    def _entry(self, name: str) -> _Entry:
        entry: _Entry = getattr(self, name)
        return entry

    def _check_parameters(self) -> None:
        given: object = self.parameters
        if not isinstance(given, ConvexSet | None):
            raise InputError(
                path="system.parameters",
                expected="a convex set, such as Box([-0.1], [0.1]), or None; C and D of a plant have no place here",
                got=f"{type(given).__name__}",
            )
        if self.parameters is not None and not self.parameters.is_bounded:
            raise InputError("the set of parameters must be bounded", path="system")
        if self.parameters is not None:
            require_consistent("system.parameters", self.parameters)
        names = tuple(self.names) or tuple(f"p{i + 1}" for i in range(self.parameter_count))
        if len(names) != self.parameter_count:
            raise InputError(
                path="system",
                expected=f"{self.parameter_count} parameter names",
                got=f"{len(names)}: {', '.join(names)}",
            )
        object.__setattr__(self, "names", names)

    def _check_drift(self, d: int) -> None:
        """``c`` as a matrix of one column; raises `InputError` when it has not one number per state."""
        given = self.c
        if callable(given) and not isinstance(given, ExpressionMatrix | _AsColumn):
            given = _AsColumn(given)
        elif not callable(given):
            given = dense(given)
            array = np.asarray(given, dtype=object)
            if array.ndim == 0:
                raise InputError(path="system.c", expected=f"{d} numbers, one per state", got=f"{given!r}")
            given = array[:, None].tolist() if array.ndim == 1 else given
        object.__setattr__(self, "c", self._matrix("c", given))
        if self._shape("c") != (d, 1):
            rows, columns = self._shape("c")
            got = f"{rows}" if columns == 1 else f"shape {(rows, columns)}"
            raise InputError(path="system.c", expected=f"{d} numbers, one per state", got=got)
        self._values("c", self.probes)

    def _matrix(self, name: str, value: object) -> _Entry:
        if isinstance(value, ExpressionMatrix):
            return (
                value(np.zeros(len(value.names))).astype(float) if value.is_constant else self._known_names(name, value)
            )
        if callable(value):
            if self.parameters is None:
                raise InputError(
                    f"{name} is a function of the parameters, but no set of parameters is given", path="system"
                )
            return value
        try:
            array = np.array(dense(value), dtype=float)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{name} must be a matrix of numbers or a function of the parameters, got {value!r}", path="system"
            ) from error
        if array.ndim != 2 or array.size == 0 or not np.isfinite(array).all():
            raise InputError(
                f"{name} must be a matrix of finite numbers, rows by columns, got {_seen(array)}", path="system"
            )
        return array

    def _known_names(self, name: str, matrix: ExpressionMatrix) -> ExpressionMatrix:
        if matrix.names != tuple(self.names):
            raise InputError(
                f"the expressions of {name} are in the parameters {', '.join(matrix.names)}, the system has"
                f" {', '.join(self.names) or 'none'}",
                path="system",
            )
        return matrix

    def _shape(self, name: str) -> tuple[int, int]:
        entry = self._entry(name)
        if isinstance(entry, np.ndarray | ExpressionMatrix):
            rows, columns = entry.shape
            return rows, columns
        return self._probed_shape(name)

    def _probed_shape(self, name: str) -> tuple[int, int]:
        cache: dict[str, tuple[int, int]] = self.__dict__.setdefault("_shapes", {})
        if name not in cache:
            value = np.asarray(self._called(name, self.probes[0]))
            if value.ndim != 2 or value.size == 0:
                raise InputError(
                    f"the function {name} must return a matrix, rows by columns, got {_seen(value)}", path="system"
                )
            cache[name] = (value.shape[0], value.shape[1])
        return cache[name]

    @property
    def probes(self) -> Array:
        """A few parameters ``(k, nu)`` at which a system is tried out: a middle one and support points."""
        if self.parameters is None:
            return np.empty((1, 0))
        axes = np.eye(self.parameter_count)
        points = self.parameters.support_point(np.vstack([axes, -axes]))
        return np.vstack([self.parameters.interior_point(), points])

    def _called(self, name: str, parameter: Array) -> Array:
        function = self._entry(name)
        assert callable(function)
        try:
            with np.errstate(all="ignore"):  # what is not finite is reported with its parameter
                return np.asarray(function(parameter), dtype=float)
        except (TypeError, ValueError, ArithmeticError, IndexError, KeyError, AttributeError) as error:
            raise InputError(
                f"the function {name} failed at {self.describe(parameter)}: {error}", path="system"
            ) from error

    @shaped
    def _values(self, name: str, points: Float[Array, "k nu"]) -> Float[Array, "k rows columns"]:
        entry = self._entry(name)
        if isinstance(entry, np.ndarray):
            return np.broadcast_to(entry, (len(points), *entry.shape)) if len(points) != 1 else _still(entry[None])
        shape = self._shape(name)
        if isinstance(entry, ExpressionMatrix):
            values = entry.evaluate(points)
        else:
            rows = [self._called(name, point) for point in points]
            other = next((row.shape for row in rows if row.shape != shape), None)
            if other is not None:
                raise InputError(f"the function {name} must always return shape {shape}, got {other}", path="system")
            values = np.array(rows).reshape(len(points), *shape)
        finite = np.isfinite(values).all(axis=(1, 2))
        if not finite.all():
            raise InputError(
                f"{name} is not finite at {self.describe(points[np.flatnonzero(~finite)[0]])}", path="system"
            )
        return values

    def _enclosed(self, name: str, space: TaylorSpace, p: npt.NDArray[np.object_]) -> tuple[Array, Array]:
        entry, shape = self._entry(name), self._shape(name)
        coefficients, remainder = np.zeros((space.size, *shape)), np.zeros(shape)
        if isinstance(entry, np.ndarray):
            coefficients[0] = entry
            return coefficients, remainder
        try:
            models = np.array(entry(p), dtype=object)
        except NotEnclosable as error:
            raise NotEnclosable(f"system: {name}: {error}") from error
        except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
            raise NotEnclosable(
                f"system: the function {name} cannot be enclosed over parameters; use arithmetic and numpy's "
                f"sin, cos, tan, exp, log, sqrt, tanh on the entries of p only ({error})"
            ) from error
        if models.shape != shape:
            raise NotEnclosable(
                f"system: the function {name} returns shape {shape} for numbers, but {models.shape} for Taylor models"
            )
        every, left = coefficients.reshape(space.size, -1), remainder.reshape(-1)
        for place, model in enumerate(models.ravel().tolist()):
            if type(model) is int and not model:  # nearly all of them where states are coefficients of polynomials
                continue
            if isinstance(model, TaylorModel):
                every[:, place], left[place] = model.coefficients, model.remainder
            elif isinstance(model, int | float | np.integer | np.floating):
                every[0, place] = model
            else:
                raise NotEnclosable(
                    f"system: the function {name} returned {type(model).__name__} for an entry, expected a number"
                )
        if not isinstance(entry, ExpressionMatrix):
            self._require_same(name, np.array([one.coefficients[0] for one in p]), coefficients[0], remainder)
        return coefficients, remainder

    def _require_same(self, name: str, centre: Array, value: Array, remainder: Array) -> None:
        """Raise `InputError` where a function of the parameters is another one for numbers than for Taylor models,
        whose ``value`` at the ``centre (nu,)`` of a cell is told: rows would be those of one system, and proofs those
        of another. An expression is one and the same for both."""
        given = self._called(name, centre)
        apart = np.abs(given - value) - remainder
        if not (apart <= SAME * max(float(np.abs(given).max()), float(np.abs(value).max()))).all():
            row, column = (int(i) for i in np.unravel_index(int(apart.argmax()), apart.shape))
            raise InputError(
                path=f"system.{name}",
                expected="a function that depends on its argument alone, by arithmetic",
                got=f"{given[row, column]:.9g} and then {value[row, column]:.9g} in row {row + 1}, column {column + 1},"
                f" at {self.describe(centre)}",
            )


@final
@dataclass(frozen=True, eq=False)
class _AsColumn:
    """A function of the parameters that returns ``(d,)`` as one that returns ``(d, 1)``."""

    function: Callable[..., object]

    def __call__(self, parameter: object) -> object:
        value = self.function(parameter)
        array = np.array(value, dtype=object if _holds_models(value) else float)
        return array[:, None] if array.ndim == 1 else array


def _holds_models(value: object) -> bool:
    return np.asarray(value, dtype=object).dtype == object and not all(
        isinstance(entry, int | float | np.integer | np.floating) for entry in np.asarray(value, dtype=object).flat
    )


def _duration(value: object) -> float:
    """A finite number that is not negative; raises `InputError`."""
    usable = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not usable or not 0.0 <= float(value) < np.inf:  # type: ignore[arg-type]
        raise InputError(path="system.delay", expected="a finite time, not negative", got=f"{value!r}")
    return float(value)  # type: ignore[arg-type]


@final
@dataclass(frozen=True, eq=False)
class SwitchedSystem:
    """Linear systems that take turns at known times: ``pieces`` are pairs ``(until, LinearSystem)``, each with its own
    ``A``, ``B``, ``E`` and ``c``; the first begins at time 0, the last ``until`` is the horizon. The state goes on
    where it is.

    All of them have as many states, controls and disturbances, and share their parameters: a piece without any is a
    known one. ``delay``, as that of a `LinearSystem`: what was commanded acts through the ``B`` of the time at which it
    acts. Raises `InputError`.
    """

    pieces: Sequence[tuple[float, LinearSystem]]
    delay: float = 0.0

    __repr__ = noun

    def __post_init__(self) -> None:
        object.__setattr__(self, "delay", _duration(self.delay))
        given = list(self.pieces)
        if not given:
            raise InputError(path="system.pieces", expected="pairs of a time and a LinearSystem", got="none")
        for i, pair in enumerate(given):
            _check_piece(i, pair, given[i - 1][0] if i else 0.0)
        first = next((one for _, one in given if one.parameters is not None), given[0][1])
        for i, (_, system) in enumerate(given):
            _check_alike(i, system, first)
        drifts = any(one.c is not None for _, one in given)
        known = [(float(until), _completed(one, first, drifts)) for until, one in given]
        object.__setattr__(self, "pieces", tuple(known))

    def with_parameters(self, parameters: ConvexSet) -> SwitchedSystem:
        """As `LinearSystem.with_parameters`."""
        return SwitchedSystem([(until, one.with_parameters(parameters)) for until, one in self.pieces], self.delay)

    def remaining(self, begin: float, horizon: float) -> LinearSystem | SwitchedSystem:
        """Those that still take their turn from the time ``begin`` on, for as long as ``horizon``."""
        left = [
            (until - begin, one)
            for start, (until, one) in zip((0.0, *self.switches), self.pieces, strict=True)
            if not over(until, begin, horizon) and not over(begin + horizon, start)
        ]
        return SwitchedSystem([*left[:-1], (horizon, left[-1][1])], self.delay) if len(left) > 1 else left[-1][1]

    @property
    def modes(self) -> tuple[LinearSystem, ...]:
        """The systems that take turns."""
        return tuple(system for _, system in self.pieces)

    @property
    def switches(self) -> tuple[float, ...]:
        """When one follows another, ``(modes - 1,)``."""
        return tuple(until for until, _ in self.pieces[:-1])

    @property
    def varies(self) -> bool:
        """As `LinearSystem.varies`."""
        return False

    def turns(self, horizon: float) -> tuple[tuple[float, float, LinearSystem], ...]:
        """As `LinearSystem.turns`."""
        return _turns((0.0, *self.switches), self.modes, horizon)

    def taking(self, turns: Sequence[tuple[float, float, LinearSystem]]) -> SwitchedSystem:
        """As `LinearSystem.taking`."""
        return _switched(turns, self.delay)

    def check_horizon(self, horizon: float) -> None:
        """As `LinearSystem.check_horizon`."""
        _check_ends([until for until, _ in self.pieces], horizon, whole=False)

    def check_period(self) -> None:
        """As `LinearSystem.check_period`: its pieces take their turns again."""

    @property
    def states(self) -> int:
        """Number ``d`` of states."""
        return self.modes[0].states

    @property
    def controls(self) -> int:
        """Number ``m`` of controls."""
        return self.modes[0].controls

    @property
    def disturbances(self) -> int:
        """Number ``mw`` of disturbances."""
        return self.modes[0].disturbances

    @property
    def parameters(self) -> ConvexSet | None:
        """The set of the parameters."""
        return self.modes[0].parameters

    @property
    def parameter_count(self) -> int:
        """Number ``nu`` of parameters."""
        return self.modes[0].parameter_count

    @property
    def names(self) -> Sequence[str]:
        """Names of the parameters."""
        return self.modes[0].names

    @property
    def c(self) -> Matrix | None:
        """Whether there is a drift: that of the first piece."""
        return self.modes[0].c

    @cached_property
    def forced(self) -> SwitchedSystem:
        """As `LinearSystem.forced`, piece by piece."""
        if self.c is None:
            return self
        return SwitchedSystem([(until, one.forced) for until, one in self.pieces])

    @shaped
    def in_units(
        self,
        A: Float[Array, "d d"],
        B: Float[Array, "d m"],
        E: Float[Array, "d mw"],
        parameters: Float[Array, " nu"],
        c: Float[Array, "d 1"] | float = 1.0,
        time: float = 1.0,
    ) -> SwitchedSystem:
        """As `LinearSystem.in_units`."""
        moved = [(until / time, one.in_units(A, B, E, parameters, c, time)) for until, one in self.pieces]
        return SwitchedSystem(moved, self.delay / time)

    @shaped
    def describe(self, parameter: Float[Array, " nu"]) -> str:
        """As `LinearSystem.describe`."""
        return self.modes[0].describe(parameter)


@final
@dataclass(frozen=True, eq=False)
class VaryingSystem:
    """``x'(t) = A(t) x(t) + B(t) u(t - delay) + E(t) w(t) + c(t)`` for ``t`` from 0 to the ``horizon``.

    ``law``: a `LinearSystem` whose first parameter is the time: its matrices at ``p = (t,)`` are those at the time
    ``t``. ``later``: times, one after another, each with the law that holds from then on. ``delay``, as that of a
    `LinearSystem`: what was commanded acts through the ``B`` of the time at which it acts. ``parameters``: a box of
    uncertain parameters, which follow the time in the laws; ``None`` where everything is known. Made of expressions by
    `of` and `taking_turns`. Raises `InputError`.
    """

    law: LinearSystem
    horizon: float
    delay: float = 0.0
    later: tuple[tuple[float, LinearSystem], ...] = ()
    parameters: Box | None = None

    __repr__ = noun

    def __post_init__(self) -> None:
        object.__setattr__(self, "delay", _duration(self.delay))
        every = [self.law, *(law for _, law in self.later)]
        if any(law.parameter_count != 1 + self.parameter_count or law.delay for law in every):
            expected = "a law whose first parameter is the time, before those of the system, without a delay of its own"
            raise InputError(path="system", expected=expected, got="another")
        times = [0.0, *(begin for begin, _ in self.later), self.horizon]
        for i, (begin, until) in enumerate(pairwise(times)):
            if self.later and not begin < until:
                raise InputError(path=f"system.pieces.{i}.until", expected=f"a time after {begin:g}", got=f"{until:g}")
        for i, law in enumerate(every[1:], 1):
            for what in ("states", "controls", "disturbances"):
                _check_as_many(i, what, law, self.law)
        if self.later and len({law.c is None for law in every}) > 1:
            drifting = [law if law.c is not None else replace(law, c=np.zeros((law.states, 1))) for law in every]
            object.__setattr__(self, "law", drifting[0])
            object.__setattr__(self, "later", tuple(zip(times[1:-1], drifting[1:], strict=True)))
        if self.parameters is not None:
            _ = self._depends

    @property
    def dependence(self) -> Dependence | None:
        """How the state depends on the parameters, where that is affinely."""
        return None if isinstance(self._depends, int) else self._depends

    @cached_property
    def _depends(self) -> Dependence | int:
        """That, or the largest degree of an entry that is a polynomial in them."""
        return dependence([[law.entry(name) for name in PARTS] for _, _, law in self.laws], *self.deviations)

    @property
    def deviations(self) -> tuple[Array, Array]:
        """The middle of the parameters, and the most that each deviates from it by."""
        if self.parameters is None:
            return np.zeros(0), np.zeros(0)
        centre, box = self.parameters.interior_point(), self.parameters
        sides = ((centre, box.upper), (box.lower, centre))
        return centre, np.max([[_difference(a, b) for a, b in zip(*ends, strict=True)] for ends in sides], axis=0)

    @property
    def powers(self) -> int | None:
        """Of a system whose state is no affine function of its parameters, the largest degree of an entry that is a
        polynomial in them."""
        return self._depends if isinstance(self._depends, int) else None

    def superposed(self, depends: Dependence | Spread) -> VaryingSystem:
        """The known system of all states that a dependence tells of."""
        laws = []
        for begin, until, law in self.laws:
            parts = {name: law.entry(name) for name in PARTS}
            made = {name: Superposed(name, part, depends) for name, part in parts.items() if part is not None}
            times = Box([begin], [until])
            laws.append((begin, LinearSystem(made["A"], made["B"], made["E"], times, (TIME,), made.get("c"))))
        return VaryingSystem(laws[0][1], self.horizon, self.delay, tuple(laws[1:]))

    def at(self, parameter: Array) -> VaryingSystem:
        """The known system at one parameter ``(nu,)``."""
        if self.parameters is None:
            return self
        laws = []
        for begin, until, law in self.laws:
            A, B, E, c = (_at(law.entry(name), parameter) for name in PARTS)
            assert A is not None and B is not None
            laws.append((begin, LinearSystem(A, B, E, Box([begin], [until]), (TIME,), c)))
        return VaryingSystem(laws[0][1], self.horizon, self.delay, tuple(laws[1:]))

    def with_parameters(self, parameters: ConvexSet) -> VaryingSystem:
        """The same system with its parameters in another box."""
        box = boxed(parameters)
        laws = [(begin, law.with_parameters(_and_time(begin, until, box))) for begin, until, law in self.laws]
        return replace(self, law=laws[0][1], later=tuple(laws[1:]), parameters=box)

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
    ) -> VaryingSystem:
        """The system whose entries are numbers and expressions in ``t``, in the ``names`` of uncertain ``parameters``
        (p1, p2, ... unless given), and in those that ``define`` gives to such expressions; see `parse_expression`.
        Raises `InputError` that begins with the key of a config."""
        known = _Uncertain.of(parameters, names)
        law = _law("system", (A, B, E, c), (0.0, horizon), define, known)
        return VaryingSystem(law, horizon, delay, parameters=known.box)

    @staticmethod
    def taking_turns(
        pieces: Sequence[tuple[float, InTime]],
        define: Mapping[str, str | float] | None = None,
        delay: float = 0.0,
        parameters: ConvexSet | None = None,
        names: Sequence[str] = (),
    ) -> VaryingSystem:
        """Systems as those of `of`, each up to a time with its ``A``, ``B``, ``E`` and ``c``; ``t`` counts from 0 in
        all of them, and the last one ends at the horizon."""
        begins, known = [0.0, *(float(until) for until, _ in pieces[:-1])], _Uncertain.of(parameters, names)
        laws = [
            _law(f"system.pieces.{i}", given, (begin, float(until)), define, known)
            for i, (begin, (until, given)) in enumerate(zip(begins, pieces, strict=True))
        ]
        later = tuple(zip(begins[1:], laws[1:], strict=True))
        return VaryingSystem(laws[0], float(pieces[-1][0]), delay, later, known.box)

    @staticmethod
    def made_of(system: LinearSystem | SwitchedSystem, horizon: float) -> VaryingSystem:
        """A system that does not change, or takes turns, as one whose law is constant in every turn. Raises
        `InputError` where its parameters are in no box."""
        begins, modes = [0.0, *system.switches], system.modes
        ends, box = [*begins[1:], horizon], None if system.parameters is None else boxed(system.parameters)
        laws = [
            LinearSystem(
                _at_any_time(mode.A),
                _at_any_time(mode.B),
                None if mode.E is None else _at_any_time(mode.E),
                _and_time(begin, end, box),
                (TIME, *mode.names[: 0 if box is None else box.dimension]),
                None if mode.c is None else _at_any_time(mode.c),
            )
            for begin, end, mode in zip(begins, ends, modes, strict=True)
        ]
        return VaryingSystem(laws[0], horizon, system.delay, tuple(zip(begins[1:], laws[1:], strict=True)), box)

    @property
    def laws(self) -> tuple[tuple[float, float, LinearSystem], ...]:
        """Between which times which law holds."""
        ends = [*(begin for begin, _ in self.later), self.horizon]
        begun = ((0.0, self.law), *self.later)
        return tuple((begin, until, law) for (begin, law), until in zip(begun, ends, strict=True))

    @property
    def varies(self) -> bool:
        """As `LinearSystem.varies`."""
        return True

    def turns(self, horizon: float) -> tuple[tuple[float, float, LinearSystem], ...]:
        """As `LinearSystem.turns`: its laws."""
        return _turns([begin for begin, _, _ in self.laws], [law for _, _, law in self.laws], horizon)

    def taking(self, turns: Sequence[tuple[float, float, LinearSystem]]) -> VaryingSystem:
        """As `LinearSystem.taking`."""
        return self.lawful([(begin, law) for begin, _, law in turns])

    def check_horizon(self, horizon: float) -> None:
        """As `LinearSystem.check_horizon`."""
        _check_ends([until for _, until, _ in self.laws], horizon, whole=not self.later)

    def check_period(self) -> None:
        """Raise `InputError` where the horizon is no period of a law, but for what rounding it explains. Nothing is
        proven by that: the law of a plan that repeats begins again at the horizon, as pieces of a system do. Laws that
        take turns may differ there as at any other time."""
        if self.later:
            return
        every = [[part[0] for part in mode.forced.matrices(mode.probes[:1])] for mode in self.modes]
        sizes = [np.abs(parts).max(axis=0) for parts in zip(*every, strict=True)]
        ends = self.law.forced.matrices(self._points(np.array([[0.0], [self.horizon]])))
        for name, size, (first, last) in zip("ABE", sizes, ends, strict=True):
            for i, j in np.argwhere(np.abs(last - first) > PERIODIC * size):
                entry = f"c[{i + 1}]" if name == "B" and j >= self.controls else f"{name}[{i + 1}][{j + 1}]"
                raise InputError(
                    path="repeat",
                    expected="a horizon that is a period of the system, which begins again there",
                    got=f"{entry} = {first[i, j]:.12g} at 0, and {last[i, j]:.12g} at {self.horizon:.12g}",
                )

    def lawful(self, laws: Sequence[tuple[float, LinearSystem]]) -> VaryingSystem:
        """The same with other ``laws``, each with the time from which it holds, the first from 0 on."""
        return replace(self, law=laws[0][1], later=tuple(laws[1:]))

    def remaining(self, begin: float, horizon: float) -> VaryingSystem:
        """What is left of it from a time on, which is 0 then."""
        left = [
            (max(0.0, start - begin), law.at_times(max(0.0, start - begin), until - begin, begin))
            for start, until, law in self.laws
            if not over(until, begin, horizon)
        ]
        return VaryingSystem(left[0][1], horizon, self.delay, tuple(left[1:]), self.parameters)

    @property
    def states(self) -> int:
        """Number ``d`` of states."""
        return self.law.states

    @property
    def controls(self) -> int:
        """Number ``m`` of controls."""
        return self.law.controls

    @property
    def disturbances(self) -> int:
        """Number ``mw`` of disturbances."""
        return self.law.disturbances

    @property
    def parameter_count(self) -> int:
        """Number ``nu`` of uncertain parameters."""
        return 0 if self.parameters is None else self.parameters.dimension

    @property
    def names(self) -> Sequence[str]:
        """Names of the uncertain parameters."""
        return self.law.names[1:]

    @property
    def switches(self) -> tuple[float, ...]:
        """None: where another law takes over, no piece of a grid has to end."""
        return ()

    @property
    def c(self) -> Matrix | None:
        """Whether there is a drift."""
        return self.law.c

    @cached_property
    def forced(self) -> VaryingSystem:
        """As `LinearSystem.forced`."""
        return self if self.law.c is None else self.lawful([(begin, law.forced) for begin, _, law in self.laws])

    @cached_property
    def modes(self) -> tuple[LinearSystem, ...]:
        """The system as it is at several times, for what asks how large its numbers are; nothing is proven by them. Of
        parameters that the state depends on affinely they are those in the middle of the box."""
        found = list[LinearSystem]()
        # Chebyshev's points, closer to the ends: an entry that is 0 at evenly spaced times is seen
        shares = (1.0 - np.cos(np.linspace(0.0, np.pi, LOOKS))[:, None]) / 2.0
        for begin, until, law in self.laws:
            if self.powers is not None:
                times = (begin + (until - begin) * shares[:, 0]).tolist()
                every = [[_during(law.entry(name), time) for name in PARTS] for time in times]
                bound, names = self.parameters, self.names
                found += [LinearSystem(A, B, E, bound, names, c) for A, B, E, c in every]  # type: ignore[arg-type]
                continue
            times = self._points(begin + (until - begin) * shares)
            A, B, E = law.matrices(times)
            drifts = [None] * LOOKS if self.c is None else list(law.forced.matrices(times)[1][:, :, -1:])
            found += [LinearSystem(a, b, e, c=drift) for a, b, e, drift in zip(A, B, E, drifts, strict=True)]
        return tuple(found)

    @shaped
    def in_units(
        self,
        A: Float[Array, "d d"],
        B: Float[Array, "d m"],
        E: Float[Array, "d mw"],
        parameters: Float[Array, " nu"],
        c: Float[Array, "d 1"] | float = 1.0,
        time: float = 1.0,
    ) -> VaryingSystem:
        """As `LinearSystem.in_units`; the time of the law is divided too."""
        every = np.concatenate([[time], parameters])
        first, *others = (law.in_units(A, B, E, every, c, 1.0) for _, _, law in self.laws)
        later = tuple((begin / time, law) for (begin, _), law in zip(self.later, others, strict=True))
        bound = None if self.parameters is None else boxed(self.parameters.in_units(parameters))
        return VaryingSystem(first, self.horizon / time, self.delay / time, later, bound)

    def _points(self, times: Array) -> Array:
        """``times (k, 1)`` as parameters of the law, with those of the system in the middle of their box."""
        middle = np.zeros(0) if self.parameters is None else self.parameters.interior_point()
        return np.hstack([times, np.tile(middle, (len(times), 1))])

    @shaped
    def describe(self, parameter: Float[Array, " nu"]) -> str:
        """As `LinearSystem.describe`."""
        return ", ".join(f"{name} = {value:.6g}" for name, value in zip(self.names, parameter, strict=True))


System: TypeAlias = LinearSystem | SwitchedSystem | VaryingSystem


@final
@dataclass(frozen=True, eq=False)
class _At:
    """A function of the time, and of parameters after it, at one ``parameter (nu,)``."""

    entry: Callable[..., object]
    parameter: Array

    def __call__(self, p: npt.NDArray[np.object_]) -> object:
        whole = np.empty(1 + self.parameter.size, dtype=object)
        whole[0], nothing = p[0], 0.0 * p[0]
        for i, value in enumerate(self.parameter.tolist()):
            whole[1 + i] = nothing + value
        return self.entry(whole)


@final
@dataclass(frozen=True, eq=False)
class _During:
    """A function of the time, and of parameters after it, at one ``time``, as one of the parameters."""

    entry: Callable[..., object]
    time: float

    def __call__(self, p: npt.NDArray[np.object_]) -> object:
        whole = np.empty(1 + len(p), dtype=object)
        whole[0], whole[1:] = self.time, p
        return self.entry(whole)


def _during(entry: _Entry | None, time: float) -> _Entry | None:
    return _During(entry, time) if callable(entry) else entry


def _at(entry: _Entry | None, parameter: Array) -> _Entry | None:
    return _At(entry, parameter) if callable(entry) else entry


def _difference(low: float, high: float) -> float:
    """``high - low``, or the next double above it."""
    exact, found = Fraction(float(high)) - Fraction(float(low)), float(high) - float(low)
    return found if Fraction(found) >= exact else float(np.nextafter(found, np.inf))


def _turns(
    begins: Sequence[float], systems: Sequence[LinearSystem], horizon: float
) -> tuple[tuple[float, float, LinearSystem], ...]:
    return tuple(zip(begins, (*begins[1:], horizon), systems, strict=True))


def _switched(turns: Sequence[tuple[float, float, LinearSystem]], delay: float) -> SwitchedSystem:
    return SwitchedSystem([(until, replace(one, delay=0.0)) for _, until, one in turns], delay)


def _check_ends(ends: Sequence[float], horizon: float, whole: bool) -> None:
    """Raise `InputError` where the systems, or laws, that end at these times do not fill the horizon; ``whole``: it is
    one law, of which no piece is named."""
    last, begin = len(ends) - 1, 0.0
    if abs(ends[last] - horizon) > SAME_TIME * horizon:
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
    if not isinstance(system, LinearSystem) or system.delay:
        said = "a delay of its own" if isinstance(system, LinearSystem) else type(system).__name__
        raise InputError(path=f"system.pieces.{i}", expected="a LinearSystem without delay", got=said)


@final
@dataclass(frozen=True, eq=False)
class _Later:
    """A function of the time, and of parameters after it, on a clock that shows 0 at the time ``begin``."""

    entry: Callable[..., object]
    begin: float

    def __call__(self, p: npt.NDArray[np.object_]) -> object:
        moved = p.copy()
        moved[0] = p[0] + self.begin
        return self.entry(moved)


def _later(entry: _Entry | None, begin: float) -> _Entry | None:
    return _Later(entry, begin) if callable(entry) else entry


def _at_any_time(entry: Matrix) -> Matrix:
    """A matrix, or a function of the parameters, as one of the time and of them."""
    if not callable(entry):
        return entry
    function = entry
    return lambda p: function(p[1:])


def boxed(parameters: ConvexSet) -> Box:
    """A set of parameters beside the time, which must be a box."""
    if not parameters.is_box or not parameters.is_bounded:
        raise InputError(
            path="system.parameters", expected="a bounded box beside the time t, one interval each", got=parameters.kind
        )
    return parameters.bounding_box()


def _and_time(begin: float, until: float, parameters: Box | None) -> Box:
    """The times from one to another, and the parameters."""
    if parameters is None:
        return Box([begin], [until])
    return Box(np.append(begin, parameters.lower), np.append(until, parameters.upper))


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


def _law(
    where: str,
    given: InTime,
    during: tuple[float, float],
    define: Mapping[str, str | float] | None,
    uncertain: _Uncertain,
) -> LinearSystem:
    """The law that is ``given`` at a key of a config, whose entries speak of the time between two."""
    names, (A, B, E, c) = uncertain.names, given
    try:
        defined = parse_definitions(define or {}, names)
    except InputError as error:
        raise error.under("system") from None
    begin, until = during
    if not begin < until < np.inf:
        raise InputError(path=f"{where}.until", expected=f"a time after {begin:g}", got=f"{until:g}")
    return LinearSystem(
        parse_matrix(f"{where}.A", A, names, defined),
        parse_matrix(f"{where}.B", B, names, defined),
        None if E is None else parse_matrix(f"{where}.E", E, names, defined),
        _and_time(begin, until, uncertain.box),
        names,
        None if c is None else parse_column(f"{where}.c", c, names, defined),
    )


def _check_as_many(i: int, what: str, system: LinearSystem, first: LinearSystem) -> None:
    if getattr(system, what) != getattr(first, what):
        raise InputError(
            path=f"system.pieces.{i}",
            expected=f"{getattr(first, what)} {what}, as the other pieces",
            got=f"{getattr(system, what)}",
        )


def _check_alike(i: int, system: LinearSystem, first: LinearSystem) -> None:
    for what in ("states", "controls", "disturbances"):
        _check_as_many(i, what, system, first)
    mine, other = system.parameters, first.parameters
    if mine is None:
        return
    if not mine.is_same(other) or system.names != first.names:
        raise InputError(path=f"system.pieces.{i}", expected="the parameters of the other pieces", got="others")


def _completed(system: LinearSystem, first: LinearSystem, drifts: bool) -> LinearSystem:
    """The same system with the parameters of ``first``, and with a drift, of 0 where it has none."""
    c = np.zeros((system.states, 1)) if system.c is None and drifts else system.c
    if c is system.c and system.parameters is first.parameters:
        return system
    if isinstance(system, SystemInUnits):
        return replace(system, c=c) if c is not None else system
    return LinearSystem(system.A, system.B, system.E, first.parameters, first.names, c)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class SystemInUnits(LinearSystem):
    """An uncertain system in other units: ``base`` at parameters times ``units (nu,)``, its matrices times
    ``factors``."""

    base: LinearSystem
    factors: Mapping[str, Array]
    units: Array

    def __post_init__(self) -> None:
        pass  # the base was checked

    @cached_property
    def forced(self) -> LinearSystem:
        if self.c is None:
            return self
        base, factors = self.base.forced, self.factors
        joined = {"A": factors["A"], "B": np.hstack([factors["B"], factors["c"]]), "E": factors["E"]}
        return SystemInUnits(
            base.A, base.B, base.E, self.parameters, self.names, base=base, factors=joined, units=self.units
        )

    @shaped
    def describe(self, parameter: Float[Array, " nu"]) -> str:
        return self.base.describe(parameter * self.units)

    @shaped
    def in_units(
        self,
        A: Float[Array, "d d"],
        B: Float[Array, "d m"],
        E: Float[Array, "d mw"],
        parameters: Float[Array, " nu"],
        c: Float[Array, "d 1"] | float = 1.0,
        time: float = 1.0,
    ) -> LinearSystem:
        mine, units = self.factors, parameters * self.units
        earlier = self.base.delay / self.delay if self.delay else 1.0
        return self.base.in_units(A * mine["A"], B * mine["B"], E * mine["E"], units, c * mine["c"], time * earlier)

    def entry(self, name: str) -> _Entry | None:
        base, units = self.base.entry(name), self.units
        if base is None:
            return None
        factor = self.factors[name]
        if callable(base):
            function = base
            return lambda p: np.asarray(function(np.asarray(p, dtype=object) * units), dtype=object) * factor
        return base * factor

    def _shape(self, name: str) -> tuple[int, int]:
        return self.base._shape(name)

    @shaped
    def _values(self, name: str, points: Float[Array, "k nu"]) -> Float[Array, "k rows columns"]:
        return self.base._values(name, points * self.units) * self.factors[name]

    @shaped
    def taylor(
        self, space: TaylorSpace, centre: Float[Array, " nu"], radius: Float[Array, " nu"]
    ) -> tuple[
        Float[Array, "M d d"],
        Float[Array, "d d"],
        Float[Array, "M d m"],
        Float[Array, "d m"],
        Float[Array, "M d mw"],
        Float[Array, "d mw"],
    ]:
        found = self.base.taylor(space, centre * self.units, radius * self.units)
        every = [part * self.factors[name] for name, part in zip("AABBEE", found, strict=True)]
        return every[0], every[1], every[2], every[3], every[4], every[5]


def _still(view: Array) -> Array:
    """A view that nobody writes to."""
    view.flags.writeable = False
    return view


def _seen(array: npt.NDArray[np.float64]) -> str:
    return str(array.tolist()) if array.size <= 8 else f"an array of shape {array.shape}"
