"""Expressions of a config from Python functions of the parameters.

A function is called once with symbols, which gives its expressions. These are compared with the function at numbers.
The function is not executed again where the expressions are read.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.elementary import FUNCTIONS
from sparserob_core.sip.expressions.expression import ExpressionMatrix, parse_matrix

EXPRESSION_ROUNDING = 1e-9
"""The relative difference between a function and its expressions that counts as rounding.

Arithmetic in another order differs by some 1e-15. With 1e-8 a coefficient that was written down wrongly might pass;
with 1e-10 a badly conditioned formula might be refused.
"""
NUMBER = int | float | np.integer | np.floating


@final
class Symbol:
    """A parameter, or arithmetic on parameters, as text."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text

    def __add__(self, other: object) -> Symbol:
        return _join_operands(self, "+", other)

    def __radd__(self, other: object) -> Symbol:
        return _join_operands(other, "+", self)

    def __sub__(self, other: object) -> Symbol:
        return _join_operands(self, "-", other)

    def __rsub__(self, other: object) -> Symbol:
        return _join_operands(other, "-", self)

    def __mul__(self, other: object) -> Symbol:
        return _join_operands(self, "*", other)

    def __rmul__(self, other: object) -> Symbol:
        return _join_operands(other, "*", self)

    def __truediv__(self, other: object) -> Symbol:
        return _join_operands(self, "/", other)

    def __rtruediv__(self, other: object) -> Symbol:
        return _join_operands(other, "/", self)

    def __pow__(self, other: object) -> Symbol:
        return _join_operands(self, "**", other)

    def __rpow__(self, other: object) -> Symbol:
        return _join_operands(other, "**", self)

    def __neg__(self) -> Symbol:
        return Symbol(f"(-{self.text})")

    def __pos__(self) -> Symbol:
        return self

    def __getattr__(self, name: str) -> Callable[[], Symbol]:
        """Return the method that numpy calls where it takes the sine, or another elementary function, of an object."""
        if name not in FUNCTIONS:
            raise AttributeError(f"{name} is none of {', '.join(FUNCTIONS)}")
        return lambda: Symbol(f"{name}({self.text})")

    def __bool__(self) -> bool:
        raise TypeError("it branches on a parameter")

    __eq__ = __lt__ = __le__ = __gt__ = __ge__ = __ne__ = lambda self, other: bool(self)
    __hash__ = None  # type: ignore[assignment]


def trace_entries(
    name: str, function: Callable[..., object], names: Sequence[str], probes: Array
) -> list[list[str | float]]:
    """Return the entries of a matrix that a function of the parameters returns, as numbers and expressions.

    Parameters
    ----------
    name : str
        The name of the matrix, for messages.
    function : function
        The function, which takes ``p (nu,)`` and returns a matrix.
    names : sequence of str
        The names of the parameters.
    probes : array (k, nu)
        The parameters at which the function and its expressions are compared.

    Returns
    -------
    list of lists of str and float
        The entries, row by row.

    Raises
    ------
    InputError
        If the function is more than arithmetic with numpy functions, or if an expression is too long for a config.
    """
    p = np.empty(len(names), dtype=object)
    p[:] = [Symbol(parameter) for parameter in names]
    try:
        matrix = np.atleast_2d(np.asarray(function(p), dtype=object))
        rows = [[_write_entry(value) for value in row] for row in matrix]
        written = parse_matrix(name, rows, names)
    except InputError as error:
        raise InputError(_write_refusal(name, error.sentence), path=f"system.{name}") from error
    except (TypeError, ValueError, ArithmeticError, AttributeError, IndexError) as error:
        raise InputError(_write_refusal(name, str(error)), path=f"system.{name}") from error
    for point in probes:
        if not _has_equal_values(written, function, point):
            raise InputError(
                _write_refusal(name, "its arithmetic depends on more than its argument"), path=f"system.{name}"
            )
    return rows


def _has_equal_values(written: ExpressionMatrix, function: Callable[..., object], point: Array) -> bool:
    """Return True where a matrix of expressions agrees with the function at one point ``(nu,)``, up to
    `EXPRESSION_ROUNDING`."""
    expected, actual = np.asarray(function(point), dtype=float), np.asarray(written(point), dtype=float)
    return expected.shape == actual.shape and bool(np.allclose(expected, actual, rtol=EXPRESSION_ROUNDING, atol=0.0))


def _write_refusal(name: str, why: str) -> str:
    """Return the message for a function that cannot be written as expressions."""
    return (
        f"the function {name} cannot be written into a config: {why}; expected arithmetic and numpy's"
        f" {', '.join(FUNCTIONS)} of the parameters, or a matrix of expressions in a config"
    )


def _write_entry(value: object) -> str | float:
    """Return an entry as text or number."""
    if isinstance(value, Symbol):
        return value.text
    if isinstance(value, NUMBER) and not isinstance(value, bool):
        return float(value)
    raise TypeError(f"it returns {type(value).__name__} for an entry")


def _join_operands(left: object, operator: str, right: object) -> Symbol:
    """Return both operands with an operator between them.

    Returns ``NotImplemented`` for an operand that is neither a symbol nor a number, such as an array, which then
    applies the operator to each of its entries.
    """
    if not all(isinstance(value, Symbol | NUMBER) and not isinstance(value, bool) for value in (left, right)):
        return NotImplemented  # type: ignore[no-any-return]
    return Symbol(f"({_write_operand(left)} {operator} {_write_operand(right)})")


def _write_operand(value: Any) -> str:
    """Return an operand as text, a negative number in parentheses."""
    if isinstance(value, Symbol):
        return value.text
    return repr(float(value)) if value >= 0 else f"({float(value)!r})"
