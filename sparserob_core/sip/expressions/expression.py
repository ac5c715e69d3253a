"""Arithmetic expressions in named parameters, which are parsed against a whitelist and never executed as code."""

from __future__ import annotations

import ast
import difflib
import keyword
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import mul
from typing import Any, ClassVar, TypeAlias

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.shapes import Array
from sparserob_core.sip.expressions.elementary import FUNCTIONS, eccentric_anomaly

Value: TypeAlias = Any
"""A float, an array, or anything else with arithmetic, such as a `TaylorModel`."""
Evaluation: TypeAlias = Callable[[Mapping[str, Value]], Value]

CONSTANTS = {"pi": math.pi, "e": math.e}
KEPLER = "kepler"  # the one function of two arguments
MULTIPLIED = 64  # largest whole power of an object that is multiplied out: ten times as many take as many products


def _raise_object(base: Value, exponent: Value) -> Value:
    """Return a power of a number of another kind: by products where it is whole, for a ball around 0 has no other."""
    is_whole = isinstance(exponent, float) and exponent.is_integer() and abs(exponent) <= MULTIPLIED
    if not is_whole or exponent == 0.0:
        return base**exponent
    square, count, factors = base, int(abs(exponent)), list[Value]()
    while count:
        factors += [square] if count & 1 else []
        square, count = square * square if count > 1 else square, count >> 1
    product = reduce(mul, factors)
    return product if exponent > 0.0 else 1.0 / product


_raise_objects = np.frompyfunc(_raise_object, 2, 1)


def _raise_to_power(base: Value, exponent: Value) -> Value:
    """Return a power, entry by entry."""
    is_object = isinstance(base, np.ndarray) and base.dtype == object
    return _raise_objects(base, exponent) if is_object else np.power(base, exponent)


_OPERATORS: dict[type[ast.operator], Callable[[Value, Value], Value]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.true_divide,
    ast.Pow: _raise_to_power,
}
_LENGTH, _NODES, _DEPTH = 1000, 400, 40


@dataclass(frozen=True, eq=False)
class Expression:
    """A parsed expression in named parameters.

    Parameters
    ----------
    text : str
        The expression as the user wrote it.
    names : frozenset of str
        The names that occur in it.
    evaluation : function
        The function that takes a mapping from names to values and returns the value.
    """

    text: str
    names: frozenset[str]
    evaluation: Evaluation

    def __call__(self, values: Mapping[str, Value]) -> Value:
        """Return the value for the given values of the names.

        Arrays are taken entry by entry. The value is NaN or infinite where the expression is undefined.
        """
        with np.errstate(all="ignore"):
            return self.evaluation(values)

    def __reduce__(self) -> tuple[Callable[..., Expression], tuple[str, tuple[str, ...]]]:
        return parse_expression, (self.text, tuple(sorted(self.names)))


def parse_expression(source: str | float, names: Sequence[str]) -> Expression:
    """Return the expression that a text or a number stands for.

    An expression consists of numbers, the given names, ``pi``, ``e``, ``+ - * / **`` (or ``^``), parentheses, and the
    functions sin, cos, tan, exp, sqrt, log, tanh. ``kepler(M, e)`` is the ``E`` with ``E - e sin E = M``, for a number
    ``0 <= e < 1``.

    Parameters
    ----------
    source : str or float
        The text or the number.
    names : sequence of str
        The names that may occur.

    Returns
    -------
    Expression
        The parsed expression.

    Raises
    ------
    InputError
        If the text is no such expression, or is too long or too deeply nested. The error names the expression, the part
        at fault and the known parameters.
    """
    text = str(source)
    tree = parse_tree(text)
    return Parser(text, tuple(names)).expression(tree)


def parse_tree(text: str) -> ast.expr:
    """Return the syntax tree of a text of arithmetic; raise `InputError` for one that is too long or no expression."""
    if len(text) > _LENGTH:
        raise InputError(f"expression {text[:40] + '...'!r}: longer than {_LENGTH} characters")
    try:
        tree = ast.parse(text.strip().replace("^", "**"), mode="eval").body
        nodes = sum(1 for _ in ast.walk(tree))
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"expression {text!r}: cannot be read as arithmetic, such as '-2 + 3*p1' ({error})") from error
    if nodes > _NODES:
        raise InputError(f"expression {text!r}: more than {_NODES} terms")
    return tree


class Parser:
    """A parser that visits each node of a syntax tree once; a node that is not on the whitelist is an error."""

    functions: ClassVar[tuple[str, ...]] = (*FUNCTIONS, KEPLER)

    def __init__(self, text: str, names: tuple[str, ...]) -> None:
        self.text, self.names = text, names
        self.used_names: set[str] = set()

    def expression(self, tree: ast.expr) -> Expression:
        """Return the expression of a syntax tree."""
        evaluation = self.parse(tree, 0)
        return Expression(self.text, frozenset(self.used_names), evaluation)

    def parse(self, node: ast.expr, depth: int) -> Evaluation:
        """Return the evaluation of a node; raise `InputError` for a node that is too deep or not on the whitelist."""
        if depth > _DEPTH:
            raise self.fault(f"nested more than {_DEPTH} deep")
        if isinstance(node, ast.Constant):
            return self.number(node)
        if isinstance(node, ast.Name):
            return self.name(node.id)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            return self.sign(node, depth)
        if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
            operator, left, right = (
                _OPERATORS[type(node.op)],
                self.parse(node.left, depth + 1),
                self.parse(node.right, depth + 1),
            )
            return lambda values: operator(left(values), right(values))
        if isinstance(node, ast.Call):
            return self.call(node, depth)
        raise self.fault(
            f"{ast.unparse(node)!r} is not allowed; expected numbers, + - * / **, parentheses and functions"
        )

    def number(self, node: ast.Constant) -> Evaluation:
        """Return the evaluation of a number."""
        if isinstance(node.value, bool) or not isinstance(node.value, int | float):
            raise self.fault(f"{node.value!r} is not a real number")
        try:
            value = np.float64(node.value)
        except OverflowError as error:
            raise self.fault("a number is too large") from error
        return lambda values: value

    def name(self, name: str) -> Evaluation:
        """Return the evaluation of a parameter or of a constant such as ``pi``."""
        if name in self.names:
            self.used_names.add(name)
            return lambda values: values[name]
        if name in CONSTANTS:
            value = np.float64(CONSTANTS[name])
            return lambda values: value
        raise self.fault(
            f"unknown name {name!r}{self.nearest(name)}; known parameters: {', '.join(self.names) or 'none'}"
        )

    def sign(self, node: ast.UnaryOp, depth: int) -> Evaluation:
        """Return the evaluation of a signed operand."""
        operand = self.parse(node.operand, depth + 1)
        return (lambda values: -operand(values)) if isinstance(node.op, ast.USub) else operand

    def call(self, node: ast.Call, depth: int) -> Evaluation:
        """Return the evaluation of a function of one argument, or of ``kepler``."""
        name = node.func.id if isinstance(node.func, ast.Name) else ast.unparse(node.func)
        if name == KEPLER:
            return self.kepler(node, depth)
        if name not in FUNCTIONS:
            raise self.fault(f"unknown function {name!r}; known functions: {', '.join(self.functions)}")
        if len(node.args) != 1 or node.keywords or isinstance(node.args[0], ast.Starred):
            raise self.fault(f"{name} takes one argument, as in {name}(p1)")
        function, argument = FUNCTIONS[name], self.parse(node.args[0], depth + 1)
        return lambda values: function(argument(values))

    def kepler(self, node: ast.Call, depth: int) -> Evaluation:
        """Return the evaluation of ``kepler(M, e)``, in which ``e`` is a number."""
        if len(node.args) != 2 or node.keywords or any(isinstance(argument, ast.Starred) for argument in node.args):
            raise self.fault("kepler takes two arguments, as in kepler(M, 0.2)")
        names_before, self.used_names = self.used_names, set()
        anomaly, anomaly_names = self.parse(node.args[0], depth + 1), self.used_names
        self.used_names = set()
        evaluation = self.parse(node.args[1], depth + 1)
        if self.used_names:
            raise self.fault(f"the eccentricity of kepler(M, e) must be a number, it depends on {min(self.used_names)}")
        self.used_names = names_before | anomaly_names
        with np.errstate(all="ignore"):
            eccentricity = float(evaluation({}))
        if not 0.0 <= eccentricity < 1.0:
            raise self.fault(f"the eccentricity of kepler(M, e) must be in [0, 1), got {eccentricity:g}")
        return lambda values: kepler(anomaly(values), eccentricity)

    def nearest(self, name: str) -> str:
        """Return a suggestion for an unknown name; empty where no known name is close."""
        close = difflib.get_close_matches(name, [*self.names, *CONSTANTS], n=1)
        return f", did you mean {close[0]!r}?" if close else ""

    def fault(self, reason: str) -> InputError:
        """Return the error for this expression."""
        return InputError(f"expression {self.text!r}: {reason}")


def kepler(anomaly: Value, eccentricity: float) -> Value:
    """Return the eccentric anomaly ``E`` with ``E - e sin E = M``.

    Parameters
    ----------
    anomaly : float, array or object with a method ``kepler``
        The mean anomaly ``M``, in radians.
    eccentricity : float
        The eccentricity ``e``, from 0 to below 1.
    """
    return anomaly.kepler(eccentricity) if hasattr(anomaly, "kepler") else eccentric_anomaly(anomaly, eccentricity)


Definitions: TypeAlias = "tuple[tuple[str, Expression], ...]"


def parse_definitions(given: Mapping[str, str | float], names: Sequence[str]) -> Definitions:
    """Return named expressions in an order in which each follows those that it uses.

    Parameters
    ----------
    given : mapping
        The names and their expressions, in any order.
    names : sequence of str
        The names of the parameters, which the expressions may contain besides each other's names.

    Returns
    -------
    tuple of pairs (str, Expression)
        The names with their parsed expressions.

    Raises
    ------
    InputError
        If a name has another meaning already, an expression cannot be read, or definitions depend on one another in a
        cycle.
    """
    for name in given:
        usable = name.isidentifier() and name not in CONSTANTS and name not in FUNCTIONS and name != KEPLER
        if not usable or name in names or name in keyword.kwlist:
            raise InputError(
                path=f"define.{name}",
                expected="a name of letters, digits and underscores that means nothing else",
                got=repr(name),
            )
    waiting: dict[str, Expression] = {}
    for name, text in given.items():
        try:
            waiting[name] = parse_expression(text, [*names, *given])
        except InputError as error:
            raise error.under("define", name) from None
    definitions: list[tuple[str, Expression]] = []
    while waiting:
        ready = [name for name, expression in waiting.items() if not expression.names & waiting.keys()]
        if not ready:
            raise InputError(
                path=f"define.{next(iter(waiting))}",
                expected="names that are not defined by themselves",
                got=f"a circle of {', '.join(waiting)}",
            )
        definitions += [(name, waiting.pop(name)) for name in ready]
    return tuple(definitions)


@dataclass(frozen=True, eq=False)
class ExpressionMatrix:
    """A matrix whose entries are expressions in parameters, as a function of the parameter vector ``p (nu,)``.

    It may be called with any sequence of ``nu`` numbers, arrays or Taylor models.

    Parameters
    ----------
    entries : tuple of tuples of Expression
        The entries, row by row, in the names of the parameters and of the definitions.
    names : tuple of str
        The names of the parameters.
    defined : tuple of pairs (str, Expression), optional
        The definitions, as `parse_definitions` returns them.
    """

    entries: tuple[tuple[Expression, ...], ...]
    names: tuple[str, ...]
    defined: Definitions = ()

    @property
    def shape(self) -> tuple[int, int]:
        """The numbers of rows and of columns."""
        return len(self.entries), len(self.entries[0])

    @property
    def is_constant(self) -> bool:
        """True where no entry depends on a parameter or a definition."""
        return not any(entry.names for row in self.entries for entry in row)

    def __call__(self, p: Iterable[Value]) -> Value:
        """Return the matrix at one parameter vector ``p (nu,)``.

        It is an array of floats, or an object array where ``p`` holds other things than numbers.
        """
        values = self._add_definitions(dict(zip(self.names, p, strict=True)))
        return np.array([[entry(values) for entry in row] for row in self.entries])

    def _add_definitions(self, values: dict[str, Value]) -> dict[str, Value]:
        """Return the values with those of the definitions, where an entry uses any; each one is evaluated once."""
        if any(name in self._defined_names for row in self.entries for entry in row for name in entry.names):
            for name, expression in self.defined:
                values[name] = expression(values)
        return values

    @cached_property
    def _defined_names(self) -> frozenset[str]:
        """The names that are defined."""
        return frozenset(name for name, _ in self.defined)

    def evaluate(self, parameters: Array) -> Array:
        """Return the matrices ``(k, rows, columns)`` at parameters ``(k, nu)``."""
        values = self._add_definitions({name: parameters[:, i] for i, name in enumerate(self.names)})
        matrices = np.empty((len(parameters), *self.shape))
        for i, row in enumerate(self.entries):
            for j, entry in enumerate(row):
                matrices[:, i, j] = entry(values)
        return matrices


Entries: TypeAlias = "Array | Callable[..., object] | ExpressionMatrix"


@dataclass(frozen=True, eq=False)
class Joined:
    """A matrix of arrays and functions of the parameters, one above another (``axis`` 0) or in a row (1)."""

    parts: tuple[Entries, ...]
    axis: int

    def __call__(self, p: Iterable[Value]) -> Value:
        """Return the matrix at one parameter vector."""
        return np.concatenate(
            [np.asarray(matrix(p) if callable(matrix) else matrix) for matrix in self.parts], self.axis
        )


def join_columns(left: Entries, right: Entries) -> Entries:
    """Return two matrices as one, in a row.

    Parameters
    ----------
    left, right : array, expressions or function of the parameters
        The matrices, which have as many rows.

    Returns
    -------
    array, expressions or function of the parameters
        The matrix; a function where one of the two is a function.
    """
    return _join_matrices(left, right, 1)


def stack_matrices(upper: Entries, lower: Entries) -> Entries:
    """Return two matrices as one, one above the other.

    Parameters
    ----------
    upper, lower : array, expressions or function of the parameters
        The matrices, which have as many columns.

    Returns
    -------
    array, expressions or function of the parameters
        The matrix; a function where one of the two is a function.
    """
    return _join_matrices(upper, lower, 0)


def _join_matrices(one: Entries, other: Entries, axis: int) -> Entries:
    """Return two matrices as one along an axis: as an array, as expressions, or as a function."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return np.concatenate([one, other], axis)
    expressions = next((matrix for matrix in (one, other) if isinstance(matrix, ExpressionMatrix)), None)
    names, defined = ((), ()) if expressions is None else (expressions.names, expressions.defined)
    first, second = _list_expressions(one), _list_expressions(other)
    if first is None or second is None:
        return Joined((one, other), axis)
    rows = first + second if axis == 0 else tuple(a + b for a, b in zip(first, second, strict=True))
    return ExpressionMatrix(rows, names, defined)


def _list_expressions(part: Entries) -> tuple[tuple[Expression, ...], ...] | None:
    """Return the entries of a matrix as expressions, or ``None`` for a function."""
    if isinstance(part, ExpressionMatrix):
        return part.entries
    if not isinstance(part, np.ndarray):
        return None
    return tuple(tuple(_convert_number(value) for value in row) for row in part)


def _convert_number(value: np.float64) -> Expression:
    """Return a number as an expression."""
    return Expression(repr(float(value)), frozenset(), lambda values: value)


def parse_matrix(
    name: str, rows: Sequence[Sequence[str | float]], names: Sequence[str], defined: Definitions = ()
) -> ExpressionMatrix:
    """Return a matrix of numbers and expressions.

    Parameters
    ----------
    name : str
        The key of a config at which the matrix stands, for messages.
    rows : rows of numbers and expressions
        The entries, row by row.
    names : sequence of str
        The names of the parameters.
    defined : tuple of pairs (str, Expression), optional
        The definitions that entries may use.

    Returns
    -------
    ExpressionMatrix
        The parsed matrix.

    Raises
    ------
    InputError
        If rows differ in length, an entry cannot be read, or a constant entry is not finite.
    """
    allowed_names = [*names, *(definition for definition, _ in defined)]
    if not rows or not rows[0] or len({len(row) for row in rows}) > 1:
        raise InputError(
            path=name, expected="a matrix, rows of equal length", got=f"rows of lengths {[len(row) for row in rows]}"
        )
    entries: list[list[Expression]] = []
    for i, row in enumerate(rows):
        entries.append([])
        for j, entry in enumerate(row):
            try:
                entries[i].append(_require_finite(parse_expression(entry, allowed_names)))
            except InputError as error:
                raise error.under(name, i, j) from None
    return ExpressionMatrix(tuple(map(tuple, entries)), tuple(names), defined)


def parse_column(
    name: str, entries: Sequence[str | float], names: Sequence[str], defined: Definitions = ()
) -> ExpressionMatrix:
    """Return a matrix of one column from its entries, which are numbers and expressions.

    Parameters
    ----------
    name : str
        The key of a config at which the column stands, for messages.
    entries : sequence of str and float
        The entries.
    names : sequence of str
        The names of the parameters.
    defined : tuple of pairs (str, Expression), optional
        The definitions that entries may use.

    Raises
    ------
    InputError
        If an entry cannot be read, or a constant entry is not finite.
    """
    try:
        return parse_matrix(name, [[entry] for entry in entries], names, defined)
    except InputError as error:
        error.path = error.path[:-1]  # a row has one entry, whose index in the row says nothing
        raise


def _require_finite(expression: Expression) -> Expression:
    """Return the expression itself; raise `InputError` where it is a constant that is not a finite number."""
    if not expression.names and not np.isfinite(expression({})):
        raise InputError(f"expression {expression.text!r}: its value is not a finite number")
    return expression
