"""A Python function of the parameters as the expressions that it computes: run once on symbols, and compared with
itself on numbers. Nothing of it is executed again where the expressions are read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np

from sparserob_core.control.enclosures.elementary import FUNCTIONS
from sparserob_core.control.problem.expression import ExpressionMatrix, parse_matrix
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

SAME = 1e-9
"""Relative difference between a function and its expressions that is rounding. Arithmetic in another order differs by
some 1e-15; with 1e-8 a coefficient that was written down wrongly might pass, with 1e-10 a badly conditioned formula
might be refused."""
NUMBER = int | float | np.integer | np.floating


@final
class Symbol:
    """A parameter, or arithmetic on parameters, as text."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text

    def __add__(self, other: object) -> Symbol:
        return _joined(self, "+", other)

    def __radd__(self, other: object) -> Symbol:
        return _joined(other, "+", self)

    def __sub__(self, other: object) -> Symbol:
        return _joined(self, "-", other)

    def __rsub__(self, other: object) -> Symbol:
        return _joined(other, "-", self)

    def __mul__(self, other: object) -> Symbol:
        return _joined(self, "*", other)

    def __rmul__(self, other: object) -> Symbol:
        return _joined(other, "*", self)

    def __truediv__(self, other: object) -> Symbol:
        return _joined(self, "/", other)

    def __rtruediv__(self, other: object) -> Symbol:
        return _joined(other, "/", self)

    def __pow__(self, other: object) -> Symbol:
        return _joined(self, "**", other)

    def __rpow__(self, other: object) -> Symbol:
        return _joined(other, "**", self)

    def __neg__(self) -> Symbol:
        return Symbol(f"(-{self.text})")

    def __pos__(self) -> Symbol:
        return self

    def __getattr__(self, name: str) -> Callable[[], Symbol]:
        """What numpy calls where it takes the sine and so on of an object."""
        if name not in FUNCTIONS:
            raise AttributeError(f"{name} is none of {', '.join(FUNCTIONS)}")
        return lambda: Symbol(f"{name}({self.text})")

    def __bool__(self) -> bool:
        raise TypeError("it branches on a parameter")

    __eq__ = __lt__ = __le__ = __gt__ = __ge__ = __ne__ = lambda self, other: bool(self)
    __hash__ = None  # type: ignore[assignment]


def traced(name: str, function: Callable[..., object], names: Sequence[str], probes: Array) -> list[list[str | float]]:
    """The entries, row by row, of a matrix that a function of the parameters ``names`` returns: numbers, and
    expressions in the parameters. ``probes (k, nu)``: parameters at which both are compared.

    Raises `InputError` where the function is more than arithmetic with numpy's functions, and where an expression is
    longer than a config takes.
    """
    p = np.empty(len(names), dtype=object)
    p[:] = [Symbol(one) for one in names]
    try:
        matrix = np.atleast_2d(np.asarray(function(p), dtype=object))
        rows = [[_entry(value) for value in row] for row in matrix]
        written = parse_matrix(name, rows, names)
    except InputError as error:
        raise InputError(_refused(name, error.sentence), path=f"system.{name}") from error
    except (TypeError, ValueError, ArithmeticError, AttributeError, IndexError) as error:
        raise InputError(_refused(name, str(error)), path=f"system.{name}") from error
    for point in probes:
        if not _agree(written, function, point):
            raise InputError(_refused(name, "its arithmetic depends on more than its argument"), path=f"system.{name}")
    return rows


def _agree(written: ExpressionMatrix, function: Callable[..., object], point: Array) -> bool:
    given, found = np.asarray(function(point), dtype=float), np.asarray(written(point), dtype=float)
    return given.shape == found.shape and bool(np.allclose(given, found, rtol=SAME, atol=0.0))


def _refused(name: str, why: str) -> str:
    return (
        f"the function {name} cannot be written into a config: {why}; expected arithmetic and numpy's"
        f" {', '.join(FUNCTIONS)} of the parameters, or a matrix of expressions in a config"
    )


def _entry(value: object) -> str | float:
    if isinstance(value, Symbol):
        return value.text
    if isinstance(value, NUMBER) and not isinstance(value, bool):
        return float(value)
    raise TypeError(f"it returns {type(value).__name__} for an entry")


def _joined(left: object, operator: str, right: object) -> Symbol:
    """Both with an operator between them; ``NotImplemented`` beside an array, which then takes its turn."""
    if not all(isinstance(value, Symbol | NUMBER) and not isinstance(value, bool) for value in (left, right)):
        return NotImplemented  # type: ignore[no-any-return]
    return Symbol(f"({_text(left)} {operator} {_text(right)})")


def _text(value: Any) -> str:
    if isinstance(value, Symbol):
        return value.text
    return repr(float(value)) if value >= 0 else f"({float(value)!r})"
