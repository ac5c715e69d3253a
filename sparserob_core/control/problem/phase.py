"""A phase of a linear system: ``x' = A x + B u + E w + c`` between two times.

Its entries are numbers, or functions of uncertain parameters, or functions of the time and of these parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TypeAlias, final

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.control.problem.tracing import EXPRESSION_ROUNDING
from sparserob_core.control.sets.sets import Box
from sparserob_core.control.sets.strangers import require_consistent
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.shapes import Float, dense, shaped
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.expressions.expression import ExpressionMatrix, join_columns, stack_matrices
from sparserob_core.sip.expressions.taylor import TaylorModel, TaylorSpace

Matrix: TypeAlias = npt.ArrayLike | Callable[..., object] | ExpressionMatrix
TIME = "t"
PARTS = ("A", "B", "E", "c")
_Entry: TypeAlias = Array | Callable[..., object] | ExpressionMatrix
_Arguments: TypeAlias = npt.NDArray[np.object_]


@dataclass(frozen=True, eq=False)
class Phase:
    """A phase ``x' = A x + B u + E w + c`` of a linear system, from the time ``begin`` until the time ``until``.

    The entries are arrays, or functions of arguments ``(n,)``. The arguments are the uncertain parameters; in a
    ``timed`` phase the time stands before them.

    Parameters
    ----------
    A : array (d, d) or function of the arguments
        The system matrix.
    B : array (d, m) or function of the arguments
        The input matrix.
    E : array (d, mw) or function of the arguments, optional
        The matrix by which the disturbance enters; the identity unless given.
    domain : ConvexSet, optional
        The bounded set of the arguments; ``None`` (the default) where there are no arguments.
    names : sequence of str, optional
        The names of the arguments in messages; ``p1``, ``p2``, ... unless given.
    c : array (d,) or (d, 1), or function of the arguments, optional
        The drift, kept as one column; no drift unless given.
    begin : float, default 0.0
        The time at which the phase begins.
    until : float, default infinity
        The time at which the phase ends.
    timed : bool, default False
        True where the first argument is the time.

    Raises
    ------
    InputError
        If shapes disagree, if the domain is no bounded set, if the number of names is wrong, or if an entry is not
        finite at one of the `probes`.
    """

    A: Matrix
    B: Matrix
    E: Matrix | None = None
    domain: ConvexSet | None = None
    names: Sequence[str] = ()
    c: Matrix | None = None
    begin: float = 0.0
    until: float = np.inf
    timed: bool = False

    __repr__ = noun

    def __post_init__(self) -> None:
        self._check_domain()
        for name in ("A", "B"):
            object.__setattr__(self, name, self._check_matrix(name, getattr(self, name)))
        d, columns = self._shape("A")
        if d != columns:
            raise InputError(f"A must be square, got shape {(d, columns)}", path="system")
        object.__setattr__(self, "E", np.eye(d) if self.E is None else self._check_matrix("E", self.E))
        for name in ("B", "E"):
            if self._shape(name)[0] != d:
                raise InputError(f"{name} must have {d} rows, as A has, got shape {self._shape(name)}", path="system")
        if self.c is not None:
            self._check_drift(d)
        self.matrices(self.probes)

    @property
    def states(self) -> int:
        """The number ``d`` of states."""
        return self._shape("A")[0]

    @property
    def controls(self) -> int:
        """The number ``m`` of controls."""
        return self._shape("B")[1]

    @property
    def disturbances(self) -> int:
        """The number ``mw`` of disturbances, which is the number of columns of ``E``."""
        return self._shape("E")[1]

    @property
    def count(self) -> int:
        """The number ``n`` of arguments, 0 where all entries are numbers."""
        return 0 if self.domain is None else self.domain.dimension

    @property
    def stated(self) -> Phase:
        """The phase in the units of the user, where the phase keeps them; here the phase itself."""
        return self

    @cached_property
    def forced(self) -> Phase:
        """The phase whose drift is the last column of ``B``, with a control that is always 1.

        It is the phase itself without a drift.
        """
        if self.c is None:
            return self
        return replace(self, B=join_columns(self._get_entry("B"), self._get_entry("c")), c=None)

    def between(self, begin: float, until: float) -> Phase:
        """Return the phase from another time and until another time.

        Parameters
        ----------
        begin, until : float
            The times, in the time unit of the system; the entries do not change.
        """
        return self if (begin, until) == (self.begin, self.until) else replace(self, begin=begin, until=until)

    def drifting(self) -> Phase:
        """Return the phase with a drift, which is 0 where the phase has none."""
        return self if self.c is not None else replace(self, c=np.zeros((self.states, 1)))

    def within(self, parameters: ConvexSet | None, names: Sequence[str]) -> Phase:
        """Return the phase whose uncertain parameters are in another set and have other names.

        Parameters
        ----------
        parameters : ConvexSet or None
            The set of the parameters without the time; a bounded box where the phase is timed.
        names : sequence of str
            The names of these parameters.

        Returns
        -------
        Phase
            The phase with the new domain; a timed phase keeps the name of its time.

        Raises
        ------
        InputError
            If the phase is timed and the set is no bounded box.
        """
        if self.timed:
            box = None if parameters is None else boxed(parameters)
            return replace(self, domain=and_time(self.begin, self.until, box), names=(*self.names[:1], *names))
        return self if parameters is self.domain else replace(self, domain=parameters, names=tuple(names))

    def later(self, begin: float, until: float, later: float) -> Phase:
        """Return the phase on a clock that shows 0 at the time ``later`` of the present clock.

        Parameters
        ----------
        begin, until : float
            The times between which the phase holds, on the new clock.
        later : float
            The time of the present clock at which the new clock shows 0.

        Returns
        -------
        Phase
            The phase whose entries at the time ``t`` are those of this phase at ``t + later``.
        """
        if not self.timed:
            return self.between(begin, until)
        assert isinstance(self.domain, Box)
        ends = zip((begin, self.until - later), (self.domain.lower, self.domain.upper), strict=True)
        domain = Box(*(np.append(time, side[1:]) for time, side in ends))
        return self._substitute_arguments(partial(_shift_time, later), domain, self.names, begin, until)

    def at(self, parameter: Array) -> Phase:
        """Return the known phase at one value ``(nu,)`` of the uncertain parameter."""
        if not self.timed:
            A, B, E = (matrix[0] for matrix in self.matrices(parameter[None]))
            drift = None if self.c is None else self._evaluate_matrix("c", parameter[None])[0]
            return Phase(A, B, E, c=drift, begin=self.begin, until=self.until)
        domain = and_time(self.begin, self.until, None)
        return self._substitute_arguments(
            partial(_append_parameter, parameter), domain, (TIME,), self.begin, self.until
        )

    def during(self, time: float, parameters: ConvexSet | None) -> Phase:
        """Return a timed phase at one time, as a phase with constant entries in time.

        Parameters
        ----------
        time : float
            The time.
        parameters : ConvexSet or None
            The set of the uncertain parameters, which are the arguments of the new phase.

        Returns
        -------
        Phase
            The phase, which is not timed and has no end.
        """
        return self._substitute_arguments(partial(_prepend_time, time), parameters, self.names[1:], timed=False)

    def in_time(self, until: float) -> Phase:
        """Return the phase as a timed phase that ends at ``until``.

        Raises `InputError` where the domain is no bounded box.
        """
        domain = and_time(self.begin, until, None if self.domain is None else boxed(self.domain))
        return self._substitute_arguments(_drop_time, domain, (TIME, *self.names), self.begin, until)

    def _substitute_arguments(
        self,
        arguments: Callable[[_Arguments], _Arguments],
        domain: ConvexSet | None,
        names: Sequence[str],
        begin: float = 0.0,
        until: float = np.inf,
        timed: bool = True,
    ) -> Phase:
        """Return the phase whose entries are functions of other arguments.

        Parameters
        ----------
        arguments : function
            The function that takes the new arguments and returns those of this phase.
        domain : ConvexSet or None
            The set of the new arguments.
        names : sequence of str
            The names of the new arguments.
        begin, until : float
            The times between which the new phase holds.
        timed : bool
            True where the first of the new arguments is the time.
        """
        A, B, E, c = (through(self.entry(name), arguments) for name in PARTS)
        assert A is not None and B is not None
        return Phase(A, B, E, domain, names, c, begin, until, timed)

    @shaped
    def accumulating(self, rows: Float[Array, "k d"], inputs: Float[Array, "k m"]) -> Phase:
        """Return the phase with ``k`` more states, ``z' = rows x + inputs u(t - delay)``, after its own states.

        Parameters
        ----------
        rows : array (k, d)
            The factors of the state in the derivatives of the new states.
        inputs : array (k, m)
            The factors of the control in the derivatives of the new states.

        Returns
        -------
        Phase
            The phase with ``d + k`` states, the last ``k`` of which are integrals of state and control.
        """
        k, d = rows.shape
        blocks = {"B": inputs, "E": np.zeros((k, self.disturbances)), "c": np.zeros((k, 1))}
        extended = {
            name: stack_matrices(self._get_entry(name), block)
            for name, block in blocks.items()
            if name != "c" or self.c is not None
        }
        A = stack_matrices(join_columns(self._get_entry("A"), np.zeros((d, k))), np.hstack([rows, np.zeros((k, k))]))
        return replace(self, A=A, B=extended["B"], E=extended["E"], c=extended.get("c"))

    @shaped
    def matrices(
        self, arguments: Float[Array, "k n"]
    ) -> tuple[Float[Array, "k d d"], Float[Array, "k d m"], Float[Array, "k d mw"]]:
        """Return the matrices at several arguments.

        Parameters
        ----------
        arguments : array (k, n)
            The arguments, one row each.

        Returns
        -------
        A, B, E : arrays (k, d, d), (k, d, m), (k, d, mw)
            The matrices at each row of the arguments.

        Raises
        ------
        InputError
            If the shape of the arguments is wrong, or an entry is not finite.
        """
        points = np.asarray(arguments, dtype=float)
        if points.ndim != 2 or points.shape[1] != self.count:
            raise InputError(f"parameters must have shape (k, {self.count}), got {points.shape}", path="system")
        A, B, E = (self._evaluate_matrix(name, points) for name in ("A", "B", "E"))
        return A, B, E

    @shaped
    def taylor(
        self, space: TaylorSpace, centre: Float[Array, " n"], radius: Float[Array, " n"]
    ) -> tuple[
        Float[Array, "M d d"],
        Float[Array, "d d"],
        Float[Array, "M d m"],
        Float[Array, "d m"],
        Float[Array, "M d mw"],
        Float[Array, "d mw"],
    ]:
        """Return Taylor models of all entries over the cell ``centre +- radius`` of the arguments.

        Parameters
        ----------
        space : TaylorSpace
            The space of polynomials with ``M`` coefficients.
        centre, radius : arrays (n,)
            The middle and the half-widths of the cell.

        Returns
        -------
        A_coefficients, A_remainder : arrays (M, d, d), (d, d)
            The coefficients of each entry of ``A``, and a bound of the remainder of each entry.
        B_coefficients, B_remainder : arrays (M, d, m), (d, m)
            The coefficients and the bounds for ``B``.
        E_coefficients, E_remainder : arrays (M, d, mw), (d, mw)
            The coefficients and the bounds for ``E``.

        Raises
        ------
        NotEnclosable
            If a function cannot be evaluated on Taylor models, or has a singularity on the cell.
        InputError
            If a function returns other values for numbers than for Taylor models.
        """
        p = np.empty(self.count, dtype=object)
        p[:] = space.variables(centre, radius)
        A, B, E = (self._enclose_matrix(name, space, p) for name in ("A", "B", "E"))
        return *A, *B, *E

    @shaped
    def in_units(
        self,
        A: Float[Array, "d d"],
        B: Float[Array, "d m"],
        E: Float[Array, "d mw"],
        arguments: Float[Array, " n"],
        c: Float[Array, "d 1"] | float = 1.0,
        time: float = 1.0,
    ) -> Phase:
        """Return the phase in other units; the change is exact where all factors are powers of two.

        Parameters
        ----------
        A, B, E : arrays (d, d), (d, m), (d, mw)
            The factors by which the matrices are multiplied, entry by entry.
        arguments : array (n,)
            The numbers by which the arguments are divided.
        c : array (d, 1) or float, default 1.0
            The factors by which the drift is multiplied.
        time : float, default 1.0
            The number by which the times of the phase are divided.

        Returns
        -------
        Phase
            The same phase in these units.
        """
        begin, until = self.begin / time, self.until / time
        if self.domain is None:
            ours = [matrix[0] for matrix in self.matrices(np.zeros((1, 0)))]
            drift = None if self.c is None else self._evaluate_matrix("c", np.zeros((1, 0)))[0] * c
            return Phase(ours[0] * A, ours[1] * B, ours[2] * E, c=drift, begin=begin, until=until)
        return PhaseInUnits(
            self.A,
            self.B,
            self.E,
            self.domain.in_units(arguments),
            self.names,
            self.c,
            begin,
            until,
            self.timed,
            base=self,
            factors={"A": A, "B": B, "E": E, "c": np.broadcast_to(c, (A.shape[0], 1))},
            units=arguments,
            clock=time,
        )

    @shaped
    def describe(self, arguments: Float[Array, " n"]) -> str:
        """Return arguments in words, such as ``p1 = 0.1, p2 = -0.1``.

        A vector that is shorter than ``n`` holds the last of the arguments.
        """
        names = self.names[len(self.names) - arguments.size :]
        return ", ".join(f"{name} = {value:.6g}" for name, value in zip(names, arguments, strict=True))

    def entry(self, name: str) -> _Entry | None:
        """Return ``A``, ``B``, ``E`` or ``c (d, 1)`` as an array, as expressions, or as a function of the arguments.

        The value is ``None`` for the drift of a phase without a drift.
        """
        return None if name == "c" and self.c is None else self._get_entry(name)

    def _get_entry(self, name: str) -> _Entry:
        """Return a matrix of the phase, which is known to exist, as an array, expressions or a function."""
        entry: _Entry = getattr(self, name)
        return entry

    def _check_domain(self) -> None:
        """Keep the names of the arguments; raise `InputError` where the domain or the names are unsuitable."""
        domain: object = self.domain
        if not isinstance(domain, ConvexSet | None):
            raise InputError(
                path="system.parameters",
                expected="a convex set, such as Box([-0.1], [0.1]), or None; C and D of a plant have no place here",
                got=f"{type(domain).__name__}",
            )
        if self.domain is not None and not self.domain.is_bounded:
            raise InputError("the set of parameters must be bounded", path="system")
        require_consistent("system.parameters", self.domain)
        names = tuple(self.names) or tuple(f"p{i + 1}" for i in range(self.count))
        if len(names) != self.count:
            raise InputError(
                path="system", expected=f"{self.count} parameter names", got=f"{len(names)}: {', '.join(names)}"
            )
        object.__setattr__(self, "names", names)

    def _check_drift(self, d: int) -> None:
        """Keep the drift as a matrix of one column; raise `InputError` where it does not fit ``d`` states."""
        drift = self.c
        if callable(drift) and not isinstance(drift, ExpressionMatrix | _ColumnFunction):
            drift = _ColumnFunction(drift)
        elif not callable(drift):
            drift = dense(drift)
            array = np.asarray(drift, dtype=object)
            if array.ndim == 0:
                raise InputError(path="system.c", expected=f"{d} numbers, one per state", got=f"{drift!r}")
            drift = array[:, None].tolist() if array.ndim == 1 else drift
        object.__setattr__(self, "c", self._check_matrix("c", drift))
        if self._shape("c") != (d, 1):
            rows, columns = self._shape("c")
            got = f"{rows}" if columns == 1 else f"shape {(rows, columns)}"
            raise InputError(path="system.c", expected=f"{d} numbers, one per state", got=got)
        self._evaluate_matrix("c", self.probes)

    def _check_matrix(self, name: str, value: object) -> _Entry:
        """Return a matrix of the user as a checked array, as expressions or as a function; raise `InputError`."""
        if isinstance(value, ExpressionMatrix):
            return (
                value(np.zeros(len(value.names))).astype(float)
                if value.is_constant
                else self._check_expression_names(name, value)
            )
        if callable(value):
            if self.domain is None:
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
                f"{name} must be a matrix of finite numbers, rows by columns, got {_describe_array(array)}",
                path="system",
            )
        return array

    def _check_expression_names(self, name: str, matrix: ExpressionMatrix) -> ExpressionMatrix:
        """Return the expressions; raise `InputError` where they are not in the names of this phase."""
        if matrix.names != tuple(self.names):
            raise InputError(
                f"the expressions of {name} are in the parameters {', '.join(matrix.names)}, the system has"
                f" {', '.join(self.names) or 'none'}",
                path="system",
            )
        return matrix

    def _shape(self, name: str) -> tuple[int, int]:
        """Return the numbers of rows and of columns of a matrix."""
        entry = self._get_entry(name)
        if isinstance(entry, np.ndarray | ExpressionMatrix):
            rows, columns = entry.shape
            return rows, columns
        return self._probe_shape(name)

    def _probe_shape(self, name: str) -> tuple[int, int]:
        """Return the shape of the matrix that a function returns, which is called once for it."""
        cache: dict[str, tuple[int, int]] = self.__dict__.setdefault("_shapes", {})
        if name not in cache:
            value = np.asarray(self._call_function(name, self.probes[0]))
            if value.ndim != 2 or value.size == 0:
                raise InputError(
                    f"the function {name} must return a matrix, rows by columns, got {_describe_array(value)}",
                    path="system",
                )
            cache[name] = (value.shape[0], value.shape[1])
        return cache[name]

    @property
    def probes(self) -> Array:
        """The arguments ``(k, n)`` at which entries are evaluated for checks: an interior point and support points."""
        if self.domain is None:
            return np.empty((1, 0))
        axes = np.eye(self.count)
        points = self.domain.support_point(np.vstack([axes, -axes]))
        return np.vstack([self.domain.interior_point(), points])

    def _call_function(self, name: str, parameter: Array) -> Array:
        """Return the value of a function at one argument ``(n,)``; raise `InputError` where the function fails."""
        function = self._get_entry(name)
        assert callable(function)
        try:
            with np.errstate(all="ignore"):  # entries that are not finite are reported with their arguments
                return np.asarray(function(parameter), dtype=float)
        except (TypeError, ValueError, ArithmeticError, IndexError, KeyError, AttributeError) as error:
            raise InputError(
                f"the function {name} failed at {self.describe(parameter)}: {error}", path="system"
            ) from error

    @shaped
    def _evaluate_matrix(self, name: str, points: Float[Array, "k n"]) -> Float[Array, "k rows columns"]:
        """Return a matrix at points ``(k, n)``; raise `InputError` where its shape changes or it is not finite."""
        entry = self._get_entry(name)
        if isinstance(entry, np.ndarray):
            return (
                np.broadcast_to(entry, (len(points), *entry.shape))
                if len(points) != 1
                else _make_read_only(entry[None])
            )
        shape = self._shape(name)
        if isinstance(entry, ExpressionMatrix) or (isinstance(entry, Through) and entry.takes_arrays):
            values = entry.evaluate(points)
        else:
            rows = [self._call_function(name, point) for point in points]
            other_shape = next((row.shape for row in rows if row.shape != shape), None)
            if other_shape is not None:
                raise InputError(
                    f"the function {name} must always return shape {shape}, got {other_shape}", path="system"
                )
            values = np.array(rows).reshape(len(points), *shape)
        finite = np.isfinite(values).all(axis=(1, 2))
        if not finite.all():
            raise InputError(
                f"{name} is not finite at {self.describe(points[np.flatnonzero(~finite)[0]])}", path="system"
            )
        return values

    def _enclose_matrix(self, name: str, space: TaylorSpace, p: npt.NDArray[np.object_]) -> tuple[Array, Array]:
        """Return the coefficients and the bounds of the remainders of one matrix, as Taylor models; see `taylor`."""
        entry, shape = self._get_entry(name), self._shape(name)
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
        flat_coefficients, flat_remainder = coefficients.reshape(space.size, -1), remainder.reshape(-1)
        for index, model in enumerate(models.ravel().tolist()):
            if type(model) is int and not model:  # most entries, where the states are coefficients of an expansion
                continue
            if isinstance(model, TaylorModel):
                flat_coefficients[:, index], flat_remainder[index] = model.coefficients, model.remainder
            elif isinstance(model, int | float | np.integer | np.floating):
                flat_coefficients[0, index] = model
            else:
                raise NotEnclosable(
                    f"system: the function {name} returned {type(model).__name__} for an entry, expected a number"
                )
        if not isinstance(entry, ExpressionMatrix):
            self._require_same(name, np.array([argument.coefficients[0] for argument in p]), coefficients[0], remainder)
        return coefficients, remainder

    def _require_same(self, name: str, centre: Array, value: Array, remainder: Array) -> None:
        """Raise `InputError` where a function returns another matrix for numbers than for Taylor models.

        The rows of the programs would then describe one system, and the proofs another. An expression needs no such
        check, because its arithmetic is the same for both.

        Parameters
        ----------
        name : str
            The name of the matrix.
        centre : array (n,)
            The middle of the cell, at which both are compared.
        value, remainder : arrays of the shape of the matrix
            The constant coefficients of the Taylor models, and the bounds of their remainders.
        """
        numeric = self._call_function(name, centre)
        excess = np.abs(numeric - value) - remainder
        if not (excess <= EXPRESSION_ROUNDING * np.abs(numeric).max()).all():
            i, j = (int(i) for i in np.unravel_index(int(excess.argmax()), excess.shape))
            raise InputError(
                path=f"system.{name}",
                expected="a function that depends on its argument alone, by arithmetic",
                got=f"{numeric[i, j]:.9g} and then {value[i, j]:.9g} in row {i + 1}, column {j + 1},"
                f" at {self.describe(centre)}",
            )


@final
@dataclass(frozen=True, eq=False)
class _ColumnFunction:
    """A function of the parameters that returns ``(d,)``, as a function that returns ``(d, 1)``."""

    function: Callable[..., object]

    def __call__(self, parameter: object) -> object:
        value = self.function(parameter)
        array = np.array(value, dtype=object if _has_models(value) else float)
        return array[:, None] if array.ndim == 1 else array


def _has_models(value: object) -> bool:
    """Return True where a value has entries that are no numbers, such as Taylor models."""
    return not all(
        isinstance(entry, int | float | np.integer | np.floating) for entry in np.asarray(value, dtype=object).flat
    )


@final
@dataclass(frozen=True, eq=False)
class Through:
    """An entry as a function of other arguments, times a ``factor (rows, columns)``.

    The function ``arguments`` takes the other arguments and returns those of the ``entry``.
    """

    entry: Callable[..., object]
    arguments: Callable[[_Arguments], _Arguments]
    factor: Array | None = None

    def __call__(self, p: _Arguments) -> object:
        """Return the matrix at other arguments ``(n,)``."""
        matrix = self.entry(self.arguments(p))
        return matrix if self.factor is None else np.asarray(matrix, dtype=object) * self.factor

    @property
    def takes_arrays(self) -> bool:
        """True where the entry is made of expressions, which `evaluate` takes at many points together."""
        entry = self.entry
        return isinstance(entry, ExpressionMatrix) or (isinstance(entry, Through) and entry.takes_arrays)

    def evaluate(self, points: Array) -> Array:
        """Return the matrices ``(k, rows, columns)`` at other arguments ``(k, n)``."""
        assert isinstance(self.entry, ExpressionMatrix | Through)
        columns = np.empty(points.shape[1], dtype=object)
        for i, column in enumerate(points.T):
            columns[i] = column
        arguments = self.arguments(columns)
        inner = np.empty((len(points), len(arguments)))
        for i, column in enumerate(arguments):
            inner[:, i] = column
        matrices = self.entry.evaluate(inner)
        return matrices if self.factor is None else matrices * self.factor


def through(entry: _Entry | None, arguments: Callable[[_Arguments], _Arguments]) -> _Entry | None:
    """Return an entry as a function of other arguments; an array is returned as it is.

    Parameters
    ----------
    entry : array, expressions, function or None
        The matrix.
    arguments : function
        The function that takes the other arguments and returns those of the entry.
    """
    return Through(entry, arguments) if callable(entry) else entry


def _shift_time(later: float, p: _Arguments) -> _Arguments:
    """Return the arguments ``p``, with ``later`` added to the time, which is the first of them."""
    shifted = p.copy()
    shifted[0] = p[0] + later
    return shifted


def _append_parameter(parameter: Array, p: _Arguments) -> _Arguments:
    """Return the time, followed by one parameter ``(nu,)``."""
    arguments = np.empty(1 + parameter.size, dtype=object)
    arguments[0], zero = p[0], 0.0 * p[0]
    for i, value in enumerate(parameter.tolist()):
        arguments[1 + i] = zero + value
    return arguments


def _prepend_time(time: float, p: _Arguments) -> _Arguments:
    """Return the parameters ``p``, after one time."""
    arguments = np.empty(1 + len(p), dtype=object)
    arguments[0], arguments[1:] = time, p
    return arguments


def _drop_time(p: _Arguments) -> _Arguments:
    """Return the parameters, which follow the time."""
    return p[1:]


def _multiply_by_units(units: Array, p: _Arguments) -> _Arguments:
    """Return arguments ``p (n,)`` times ``units (n,)``."""
    return np.asarray(np.asarray(p, dtype=object) * units)


def boxed(parameters: ConvexSet) -> Box:
    """Return the box of parameters that a system has besides the time.

    Raises `InputError` where the set of the parameters is no bounded box.
    """
    if not parameters.is_box or not parameters.is_bounded:
        raise InputError(
            path="system.parameters", expected="a bounded box beside the time t, one interval each", got=parameters.kind
        )
    return parameters.bounding_box()


def and_time(begin: float, until: float, parameters: Box | None) -> Box:
    """Return the box of the times of a phase and of its parameters.

    Parameters
    ----------
    begin, until : float
        The times between which the phase holds.
    parameters : Box or None
        The box of the parameters ``(nu,)``, or ``None`` where there are none.

    Returns
    -------
    Box
        The box in ``1 + nu`` coordinates, of which the time is the first.
    """
    if parameters is None:
        return Box([begin], [until])
    return Box(np.append(begin, parameters.lower), np.append(until, parameters.upper))


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class PhaseInUnits(Phase):
    """A phase in other units than those of the user.

    Its matrices are those of the ``base`` at arguments times ``units``, multiplied by ``factors``.

    Parameters
    ----------
    base : Phase
        The phase in the units of the user.
    factors : mapping of arrays
        The factors of ``A (d, d)``, ``B (d, m)``, ``E (d, mw)`` and ``c (d, 1)``, entry by entry.
    units : array (n,)
        The numbers by which arguments of this phase are multiplied to be those of the base.
    clock : float
        The number by which times of this phase are multiplied to be those of the base.
    """

    base: Phase
    factors: Mapping[str, Array]
    units: Array
    clock: float

    def __post_init__(self) -> None:
        pass  # the base has been checked, and units change no finding

    @property
    def stated(self) -> Phase:
        return self.base

    @cached_property
    def forced(self) -> Phase:
        if self.c is None:
            return self
        base, factors = self.base.forced, self.factors
        joined = {"A": factors["A"], "B": np.hstack([factors["B"], factors["c"]]), "E": factors["E"]}
        return replace(self, A=base.A, B=base.B, E=base.E, c=None, base=base, factors=joined)

    def between(self, begin: float, until: float) -> Phase:
        if (begin, until) == (self.begin, self.until):
            return self
        base = self.base.between(begin * self.clock, until * self.clock)
        return replace(self, begin=begin, until=until, base=base)

    def drifting(self) -> Phase:
        base = self.base.drifting()
        return self if self.c is not None else replace(self, c=base.c, base=base)

    def within(self, parameters: ConvexSet | None, names: Sequence[str]) -> Phase:
        phase = super().within(parameters, names)
        if phase is self or parameters is None:
            return phase
        base = self.base.within(parameters.in_units(1.0 / self.units[int(self.timed) :]), names)
        assert isinstance(phase, PhaseInUnits)
        return replace(phase, base=base)

    @shaped
    def describe(self, arguments: Float[Array, " n"]) -> str:
        return self.base.describe(arguments * self.units[self.units.size - arguments.size :])

    @shaped
    def in_units(
        self,
        A: Float[Array, "d d"],
        B: Float[Array, "d m"],
        E: Float[Array, "d mw"],
        arguments: Float[Array, " n"],
        c: Float[Array, "d 1"] | float = 1.0,
        time: float = 1.0,
    ) -> Phase:
        factors, units = self.factors, arguments * self.units
        return self.base.in_units(
            A * factors["A"], B * factors["B"], E * factors["E"], units, c * factors["c"], time * self.clock
        )

    def entry(self, name: str) -> _Entry | None:
        entry = self.base.entry(name)
        if entry is None:
            return None
        factor = self.factors[name]
        return Through(entry, partial(_multiply_by_units, self.units), factor) if callable(entry) else entry * factor

    def _shape(self, name: str) -> tuple[int, int]:
        return self.base._shape(name)

    @shaped
    def _evaluate_matrix(self, name: str, points: Float[Array, "k n"]) -> Float[Array, "k rows columns"]:
        return self.base._evaluate_matrix(name, points * self.units) * self.factors[name]

    @shaped
    def taylor(
        self, space: TaylorSpace, centre: Float[Array, " n"], radius: Float[Array, " n"]
    ) -> tuple[
        Float[Array, "M d d"],
        Float[Array, "d d"],
        Float[Array, "M d m"],
        Float[Array, "d m"],
        Float[Array, "M d mw"],
        Float[Array, "d mw"],
    ]:
        arrays = self.base.taylor(space, centre * self.units, radius * self.units)
        scaled = [array * self.factors[name] for name, array in zip("AABBEE", arrays, strict=True)]
        return scaled[0], scaled[1], scaled[2], scaled[3], scaled[4], scaled[5]


def _make_read_only(view: Array) -> Array:
    """Return the view after it was made read-only."""
    view.flags.writeable = False
    return view


def _describe_array(array: npt.NDArray[np.float64]) -> str:
    """Return an array in words: its entries where it is small, its shape elsewhere."""
    return str(array.tolist()) if array.size <= 8 else f"an array of shape {array.shape}"
