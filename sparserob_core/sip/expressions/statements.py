"""Rows and objectives of a program as text: arithmetic in decisions, indices, tables and the variables of sums."""

from __future__ import annotations

import ast
import keyword
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import ClassVar, cast, final

import numpy as np
import numpy.typing as npt

from sparserob_core.errors import InputError
from sparserob_core.shapes import Array
from sparserob_core.sip.expressions.elementary import FUNCTIONS
from sparserob_core.sip.expressions.expression import CONSTANTS, KEPLER, Evaluation, Parser, parse_tree
from sparserob_core.sip.expressions.forms import (
    AffineForm,
    ConvexCost,
    Numbers,
    Value,
    add_columns,
    join_columns,
    take_columns,
    widen,
)

CHEBYSHEV = "chebyshev"
SPECIAL = (*FUNCTIONS, *CONSTANTS, KEPLER, CHEBYSHEV, "sum", "range", "abs", "for", "in")
UNIT = " unit"  # key of the number 1 from which coefficients of the decision are made
AT = " at"  # key of a decision at which a row is evaluated as a number
TURNS = " turns"  # key of the number of turns of the sums around an expression; no name of a user has a space
PARTS = " parts"  # key of the values of parts outside of sums that were evaluated already, by their texts
MAX_TURNS = 1_000_000  # of all sums around an expression: ten times as many take gigabytes, a tenth refuses long tables
MAX_WHOLE = 2**53  # beyond it not every whole number is a double
MAX_DEGREE = 4096  # of a Chebyshev polynomial: ten times as many lose three more digits
Tables = Mapping[str, Array]


@final
@dataclass(frozen=True, eq=False)
class Decisions:
    """Names of the entries of a decision, with their sizes.

    Parameters
    ----------
    sizes : mapping from str to int or None
        Number of entries of every name, in the order in which they stand in the decision; ``None`` for a single entry
        without a number in brackets.
    hidden : int, default 0
        Number of further entries at the end, which have no names.
    """

    sizes: Mapping[str, int | None]
    hidden: int = 0

    def __post_init__(self) -> None:
        sizes: object = self.sizes
        if not isinstance(sizes, Mapping):
            raise InputError(path="decision", expected="names with their numbers of entries", got=repr(self.sizes))
        for name, size in self.sizes.items():
            check_name("decision", name)
            if size is not None and (type(size) is not int or size < 1):
                raise InputError(path=f"decision.{name}", expected="a number of entries, at least 1", got=repr(size))
        if not self.sizes:
            raise InputError(path="decision", expected="at least one name with its number of entries", got="none")

    @property
    def n(self) -> int:
        """Number of all entries."""
        return sum(size or 1 for size in self.sizes.values()) + self.hidden

    def positions(self, name: str) -> range:
        """Return the places of the entries of one name in the decision."""
        start = 0
        for entry, size in self.sizes.items():
            if entry == name:
                return range(start, start + (size or 1))
            start += size or 1
        raise KeyError(name)

    @property
    def labels(self) -> list[str]:
        """Names of all entries, such as ``a[2]``."""
        return [
            label
            for name, size in self.sizes.items()
            for label in ([name] if size is None else [f"{name}[{k}]" for k in range(size)])
        ]


def check_name(path: str, name: str) -> None:
    """Raise `InputError` unless a name is one word that means nothing else."""
    given: object = name
    if not isinstance(given, str) or not name.isidentifier() or keyword.iskeyword(name) or name in SPECIAL:
        raise InputError(
            path=f"{path}.{name}",
            expected="a name of letters, digits and underscores that means nothing else",
            got=repr(name),
        )


def read_tables(given: Mapping[str, npt.ArrayLike]) -> Tables:
    """Return tables as arrays of one or two dimensions; raise `InputError` with the name of one that is none."""
    tables: dict[str, Array] = {}
    data: object = given
    if not isinstance(data, Mapping):
        raise InputError(path="tables", expected="names with their numbers", got=repr(given))
    for name, entries in given.items():
        check_name("tables", name)
        try:
            table = np.asarray(entries, dtype=float)
        except (TypeError, ValueError):
            table = np.zeros((0, 0, 0))
        if table.ndim not in (1, 2) or not table.size or not np.isfinite(table).all():
            raise InputError(
                path=f"tables.{name}", expected="a list of finite numbers, or of such lists of one length", got="else"
            )
        tables[name] = table
    return tables


@final
@dataclass(frozen=True, eq=False)
class Words:
    """Meaning of the names in a statement."""

    decisions: Decisions
    indices: tuple[str, ...] = ()
    tables: Tables = field(default_factory=dict)

    def __post_init__(self) -> None:
        groups = {"decision": self.decisions.sizes, "index": self.indices, "tables": self.tables}
        for name in self.indices:
            check_name("index", name)
        owners: dict[str, str] = {}
        for group, names in groups.items():
            for name in names:
                if owners.setdefault(name, group) != group or list(names).count(name) > 1:
                    raise InputError(
                        path=f"{group}.{name}",
                        expected="a name that stands for one thing",
                        got=f"one of {owners[name]}",
                    )


@final
@dataclass(frozen=True, eq=False)
class StatedRow:
    """A row ``form(index) <= 0``, or ``= 0``, as it was written.

    Parameters
    ----------
    text : str
        The statement.
    left, right : function
        The two sides, as functions of the values of the indices by name.
    is_equality : bool
        Whether the sides are equal.
    """

    text: str
    left: Evaluation
    right: Evaluation
    is_equality: bool = False

    def form(self, values: Mapping[str, Value], unit: Value = 1.0, parts: dict[str, Value] | None = None) -> AffineForm:
        """Return ``left - right`` at values of the indices: arrays ``(k, 1)``, or what stands for them.

        Coefficients of the decision are multiples of a ``unit``: of a float, or of a number that is never rounded.
        ``parts`` is shared by the rows of a family that are evaluated at the same values: a part that several of them
        contain is evaluated once.
        """
        scope = {**values, TURNS: 1, UNIT: unit, PARTS: {} if parts is None else parts}
        with np.errstate(all="ignore"):
            try:
                form = np.subtract(self.left(scope), self.right(scope))
            except InputError as error:
                raise InputError(f"row {self.text!r}: {error.sentence}") from None
        if isinstance(form, ConvexCost):
            raise InputError(f"row {self.text!r}: it is not affine in the decisions")
        return AffineForm.of(form)

    def value(self, values: Mapping[str, Value], x: Value, parts: dict[str, Value] | None = None) -> Value:
        """Return ``left - right`` at values of the indices and a decision ``(1, n)``; the row has a `form`. ``parts``
        is that of `form`, for the same decision."""
        scope = {**values, TURNS: 1, AT: x, PARTS: {} if parts is None else parts}
        with np.errstate(all="ignore"):
            return np.subtract(self.left(scope), self.right(scope))


def parse_rows(text: str, words: Words, equalities: bool = False) -> list[StatedRow]:
    """Return the rows that a text states.

    Parameters
    ----------
    text : str
        Two expressions with ``<=`` or ``>=`` between them, or three: ``-1 <= a[0] + w * a[1] <= 1``. Expressions know
        numbers, names, ``a[k]``, ``+ - * / **``, functions such as ``cos``, ``chebyshev(k, x)``, and
        ``sum(a[k] * cos(k*w) for k in range(10))``.
    words : Words
        The names.
    equalities : bool, default False
        Whether ``==`` is known too.

    Returns
    -------
    list of StatedRow
        One row for every comparison.

    Raises
    ------
    InputError
        If the text is no such statement; the error names the part at fault.
    """
    tree = parse_tree(text)
    comparisons = "<=, >= or ==" if equalities else "<= or >="
    if not isinstance(tree, ast.Compare):
        raise InputError(f"row {text!r}: expected {comparisons} between two expressions")
    parser = _Statement(text, words)
    sides = [parser.parse(side, 0) for side in (tree.left, *tree.comparators)]
    rows = []
    for left, right, operator in zip(sides, sides[1:], tree.ops, strict=False):
        if isinstance(operator, ast.LtE):
            rows.append(StatedRow(text, left, right))
        elif isinstance(operator, ast.GtE):
            rows.append(StatedRow(text, right, left))
        elif isinstance(operator, ast.Eq) and equalities:
            rows.append(StatedRow(text, left, right, True))
        else:
            raise InputError(f"row {text!r}: expected {comparisons} between its expressions")
    return rows


def parse_cost(text: str | float, words: Words) -> ConvexCost:
    """Return the objective that a text states: affine terms, squares and products of affine terms, absolute values."""
    parser = _Statement(str(text), words)
    evaluation = parser.parse(parse_tree(str(text)), 0)
    try:
        with np.errstate(all="ignore"):
            cost = ConvexCost.of(evaluation({TURNS: 1, UNIT: 1.0}))
    except InputError as error:
        raise InputError(f"objective {str(text)!r}: {error.sentence}") from None
    return cost


@final
class _Statement(Parser):
    """A parser of statements, with sums, tables and decisions beside the arithmetic of entries."""

    functions: ClassVar[tuple[str, ...]] = (*FUNCTIONS, "abs", CHEBYSHEV, "sum")

    def __init__(self, text: str, words: Words) -> None:
        self.words, self.turning = words, list[str]()
        super().__init__(text, (*words.decisions.sizes, *words.indices, *words.tables))

    def parse(self, node: ast.expr, depth: int) -> Evaluation:
        evaluation = self.entry(node, depth) if isinstance(node, ast.Subscript) else super().parse(node, depth)
        if self.turning or isinstance(node, ast.Constant | ast.Name):
            return evaluation
        text = ast.unparse(node)

        def remember(values: Mapping[str, Value]) -> Value:
            parts = values.get(PARTS)
            if parts is None:
                return evaluation(values)
            if text not in parts:
                parts[text] = evaluation(values)
            return parts[text]

        return remember

    def number(self, node: ast.Constant) -> Evaluation:
        value = np.full((1, 1), super().number(node)({}))
        return lambda values: value

    def name(self, name: str) -> Evaluation:
        if name in self.turning or name in self.words.indices:
            return lambda values: values[name]
        sizes, tables = self.words.decisions.sizes, self.words.tables
        if name in sizes:
            if sizes[name] is not None:
                raise self.fault(f"{name} has {sizes[name]} entries; expected one of them, such as {name}[0]")
            positions = np.array(self.words.decisions.positions(name))
            return lambda values: _pick_entries(positions, values)
        if name in tables:
            raise self.fault(f"{name} is a table; expected an entry of it, such as {name}[0]")
        evaluation = super().name(name)
        return lambda values: np.full((1, 1), evaluation({}))

    def call(self, node: ast.Call, depth: int) -> Evaluation:
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name == "sum":
            return self.sum(node, depth)
        if name == "abs" and len(node.args) == 1 and not node.keywords:
            argument = self.parse(node.args[0], depth + 1)
            return lambda values: np.absolute(argument(values))
        if name == CHEBYSHEV:
            return self.chebyshev(node, depth)
        if name == KEPLER:
            raise self.fault("kepler is known in systems alone")
        return super().call(node, depth)

    def chebyshev(self, node: ast.Call, depth: int) -> Evaluation:
        """Return the evaluation of ``chebyshev(k, x)``, the polynomial ``T_k`` at ``x``."""
        if len(node.args) != 2 or node.keywords:
            raise self.fault("chebyshev takes two arguments, as in chebyshev(k, x)")
        for part in ast.walk(node.args[1]):
            if isinstance(part, ast.Name) and part.id in self.words.decisions.sizes:
                raise self.fault(f"{ast.unparse(node)!r}: the argument depends on {part.id}, which is a decision")
        degree, argument = self.whole(node.args[0], depth), self.parse(node.args[1], depth + 1)

        def evaluate(values: Mapping[str, Value]) -> Value:
            degrees = np.broadcast_to(degree(values), (1, values[TURNS]))[0]
            if degrees.min(initial=0) < 0 or degrees.max(initial=0) > MAX_DEGREE:
                raise InputError(f"the degree of chebyshev(k, x) must be from 0 to {MAX_DEGREE}")
            return _evaluate_chebyshev(degrees, argument(values))

        return evaluate

    def entry(self, node: ast.Subscript, depth: int) -> Evaluation:
        """Return the evaluation of an entry of a decision or of a table, such as ``a[k]`` or ``F[i, k]``."""
        places, base = list[ast.expr](), cast("ast.expr", node)
        while isinstance(base, ast.Subscript):
            inside = base.slice.elts if isinstance(base.slice, ast.Tuple) else [base.slice]
            places, base = [*inside, *places], base.value
        name = base.id if isinstance(base, ast.Name) else ast.unparse(base)
        size = self.words.decisions.sizes.get(name)
        shape = (size,) if size is not None else getattr(self.words.tables.get(name), "shape", None)
        if shape is None:
            raise self.fault(f"{name!r} has no entries{self.nearest(name)}")
        if len(places) != len(shape):
            raise self.fault(f"{name} has {len(shape)} dimensions, got {ast.unparse(node)}")
        evaluations = [self.whole(place, depth) for place in places]
        text = ast.unparse(node)

        def find(values: Mapping[str, Value]) -> list[Numbers]:
            positions = [np.broadcast_to(evaluate(values), (1, values[TURNS]))[0] for evaluate in evaluations]
            for position, count in zip(positions, shape, strict=True):
                if position.min(initial=0) < 0 or position.max(initial=0) >= count:
                    outside = position.min() if position.min() < 0 else position.max()
                    raise InputError(f"{text}: expected a number from 0 to {count - 1}, got {outside}")
            return positions

        is_fixed = not any(isinstance(part, ast.Name) for place in places for part in ast.walk(place))
        find_fixed = lru_cache(maxsize=4)(lambda turns: find({TURNS: turns}))

        def locate(values: Mapping[str, Value]) -> list[Numbers]:
            return find_fixed(values[TURNS]) if is_fixed else find(values)

        if size is not None:
            first = self.words.decisions.positions(name).start
            return lambda values: _pick_entries(first + locate(values)[0], values)
        table = self.words.tables[name]
        return lambda values: table[tuple(locate(values))][None]

    def whole(self, node: ast.expr, depth: int) -> Callable[[Mapping[str, Value]], Numbers]:
        """Return the evaluation of a whole number, in numbers and the variables of sums alone."""
        for part in ast.walk(node):
            if isinstance(part, ast.Name) and part.id in (*self.words.indices, *self.words.decisions.sizes):
                raise self.fault(f"{ast.unparse(node)!r} depends on {part.id}; expected whole numbers")
        evaluation, text = self.parse(node, depth + 1), ast.unparse(node)

        def evaluate(values: Mapping[str, Value]) -> Numbers:
            numbers = np.asarray(evaluation(values), dtype=float)
            if not (np.isfinite(numbers).all() and (numbers == np.rint(numbers)).all()):
                raise InputError(f"{text!r}: expected a whole number, got {numbers.ravel()[0]:g}")
            if np.abs(numbers).max(initial=0.0) > MAX_WHOLE:
                raise InputError(f"{text!r}: expected a whole number up to {MAX_WHOLE}, got {numbers.ravel()[0]:g}")
            return numbers.astype(int)

        return evaluate

    def sum(self, node: ast.Call, depth: int) -> Evaluation:
        """Return the evaluation of ``sum(expression for k in range(10) for ...)``."""
        generator = node.args[0] if len(node.args) == 1 and not node.keywords else None
        if not isinstance(generator, ast.GeneratorExp):
            raise self.fault("expected sum(expression for k in range(10))")
        loops = list[tuple[str, list[Callable[[Mapping[str, Value]], Numbers]]]]()
        for turn in generator.generators:
            name, calls = self.loop(turn, depth)
            loops.append((name, calls))
            self.turning.append(name)
        body = self.parse(generator.elt, depth + 1)
        del self.turning[-len(loops) :]

        def evaluate(values: Mapping[str, Value]) -> Value:
            count, scope, owner = values[TURNS], dict(values), np.arange(values[TURNS])
            for name, calls in loops:
                scope, turn_owner = _unroll(scope, name, [call(scope) for call in calls])
                owner = owner[turn_owner]
            if not owner.size:
                return np.zeros((1, count))
            return add_columns(widen(body(scope), owner.size), owner, count)

        return evaluate

    def loop(self, turn: ast.comprehension, depth: int) -> tuple[str, list[Callable[[Mapping[str, Value]], Numbers]]]:
        """Return the variable of a sum, and the evaluations of what its range is made of."""
        call, target = turn.iter, turn.target
        is_range = isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "range"
        if not is_range or not isinstance(target, ast.Name) or turn.ifs or turn.is_async:
            raise self.fault(f"{ast.unparse(turn).strip()!r}: expected for k in range(10)")
        assert isinstance(call, ast.Call)
        if target.id in (*self.names, *self.turning, *SPECIAL):
            raise self.fault(f"the variable {target.id!r} of a sum means something else already")
        if not 1 <= len(call.args) <= 3 or call.keywords:
            raise self.fault(
                f"{ast.unparse(call)}: expected range(stop), range(start, stop) or range(start, stop, step)"
            )
        return target.id, [self.whole(argument, depth) for argument in call.args]

    def nearest(self, name: str) -> str:
        names, self.names = self.names, (*self.names, *self.turning)
        text = super().nearest(name)
        self.names = names
        return text


def _pick_entries(positions: Numbers, values: Mapping[str, Value]) -> Value:
    """Return entries of the decision: numbers where it is given, else affine forms."""
    return values[AT][:, positions] if AT in values else AffineForm.variables(positions, values[UNIT])


def _unroll(scope: dict[str, Value], name: str, bounds: Sequence[Numbers]) -> tuple[dict[str, Value], Numbers]:
    """Return the scope of every turn of a sum, and the turn around it to which each belongs."""
    count = scope[TURNS]
    columns = [np.broadcast_to(bound, (1, count))[0].tolist() for bound in bounds]
    ranges = [_make_range(*arguments) for arguments in zip(*columns, strict=True)]
    total = sum(map(len, ranges))
    if total > MAX_TURNS:
        raise InputError(f"sums of {total} turns; expected at most {MAX_TURNS}")
    owner = np.repeat(np.arange(count), [len(turns) for turns in ranges])
    turned = {
        key: value[:, owner] if isinstance(value, np.ndarray) and value.shape[1] == count and count > 1 else value
        for key, value in scope.items()
        if key not in (TURNS, AT, UNIT, PARTS)
    }
    variable = np.concatenate([np.asarray(turns, dtype=float) for turns in ranges]) if ranges else np.zeros(0)
    kept = {key: scope[key] for key in (AT, UNIT) if key in scope}
    return {**turned, **kept, name: variable[None], TURNS: total}, owner


def _make_range(*arguments: int) -> range:
    if len(arguments) == 3 and arguments[2] == 0:
        raise InputError("a range with steps of 0")
    return range(*arguments)


def _evaluate_chebyshev(degrees: Numbers, x: Value) -> Value:
    """Return ``T_k(x)`` for degrees ``(K,)``, by ``T_{a+b} = 2 T_a T_b - T_{a-b}`` with halves, so that errors grow
    with the square of the degree and no faster."""
    if not degrees.size:
        return np.zeros((1, 0))
    distinct, inverse = np.unique(degrees, return_inverse=True)
    cache: dict[int, Value] = {0: np.ones((1, 1)), 1: x}

    def polynomial(k: int) -> Value:
        if k not in cache:
            low = polynomial(k // 2)
            cache[k] = 2.0 * low * low - 1.0 if k % 2 == 0 else 2.0 * low * polynomial(k // 2 + 1) - x
        return cache[k]

    if x.shape[1] > 1:  # the argument turns with the sums
        columns = [
            take_columns(polynomial(k), np.array([j])) if k else np.ones((1, 1)) for j, k in enumerate(degrees.tolist())
        ]
        return join_columns(columns)
    table = join_columns([polynomial(k) for k in distinct.tolist()])
    return table[:, inverse.reshape(-1)]
