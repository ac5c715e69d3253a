"""Where a source file can be made a little wrong, and what it says then.

A kind of mutant is a rule from a node of the syntax tree to pieces of text that replace it. Beside what every mutation
tool does (comparisons, signs, extrema, constants, connectives) there are the kinds that unsound enclosures are made of:
an outward rounding that is left out, a part of a remainder that is halved, a maximum over fewer corners, a tolerance
that is ten times larger, a refusal that is passed over, an absolute value that is none. What no test can be asked to
notice has no site: annotations, decorators, assertions, sentences of errors, indices of axes.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

Span = tuple[int, int]
"""From where to where in the bytes of a file."""

OPPOSITE = {
    "<": ">=", "<=": ">", ">": "<=", ">=": "<", "==": "!=", "!=": "==", "is": "is not", "is not": "is", "in": "not in",
    "not in": "in",
}  # fmt: skip
COMPARED = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=", ast.Is: "is",
    ast.IsNot: "is not", ast.In: "in", ast.NotIn: "not in",
}  # fmt: skip
EXTREMA = [
    ("max", "min"), ("maximum", "minimum"), ("argmax", "argmin"), ("upper", "lower"), ("above", "below"),
    ("ceil", "floor"),
]  # fmt: skip
OTHER = {a: b for pair in EXTREMA for a, b in (pair, pair[::-1])}
OUTWARD = re.compile(
    r"^_?((\w+_)?OUTWARD(_FACTOR)?|(\w+_)?ROUND(ING|ED|OFF|INGS_PER_STEP)|HALF_ULP|ULP|EPS|ABOVE|TINY"
    r"|NEGLIGIBLE(_DIRECTION)?_ENTRY|OUTSIDE_SPAN_SHARE)$"
)
TOLERANCES = re.compile(r"tolerance", re.IGNORECASE)
REST = re.compile(
    r"^_?(tails?|rests?|remainders?|lost|errors?|excess|rad|radius|radii|slack|bends?|bent|off|left_out|kinks|spare|"
    r"truncation_errors?|rounding_errors?|state_errors|error_bounds|chord_errors?|curvatures?|"
    r"dropped|spread|loss|blur|wrong|dips|expansion|pushed)$"
)
UNSEEN = {"axis", "axes", "maxsize", "ndmin", "repeat"}


@dataclass(frozen=True)
class Mutant:
    """One change of one file, ``path`` relative to the repository: ``after`` instead of ``before`` at the ``span``.
    ``function``: the line on which the innermost function around it begins, decorators included; 0 outside of any."""

    path: str
    line: int
    kind: str
    span: Span
    before: str
    after: str
    function: int

    def applied(self, source: bytes) -> bytes:
        """The file with the change."""
        return source[: self.span[0]] + self.after.encode() + source[self.span[1] :]

    def __str__(self) -> str:
        old, new = (" ".join(text.split()) for text in (self.before, self.after))
        return f"{self.path}:{self.line}: {self.kind}: {old} -> {new}"


class Source:
    """The bytes of a file, and where the nodes of its syntax tree stand in them."""

    def __init__(self, path: str, data: bytes) -> None:
        self.path, self.data, self.tree = path, data, ast.parse(data)
        self._lines = [0]
        for line in data.splitlines(keepends=True):
            self._lines.append(self._lines[-1] + len(line))

    def span(self, node: ast.AST) -> Span:
        """That of a node."""
        assert isinstance(node, ast.expr | ast.stmt) and node.end_lineno is not None and node.end_col_offset is not None
        return self._lines[node.lineno - 1] + node.col_offset, self._lines[node.end_lineno - 1] + node.end_col_offset

    def text(self, span: Span) -> str:
        """What stands there."""
        return self.data[span[0] : span[1]].decode()

    def between(self, left: ast.AST, right: ast.AST, operator: str) -> Span | None:
        """Where an operator stands between its operands; ``None`` where a comment hides it."""
        start, stop = self.span(left)[1], self.span(right)[0]
        pattern = r"\s+".join(map(re.escape, operator.split())).encode()
        matches = list(re.finditer(pattern, self.data[start:stop]))
        return (start + matches[0].start(), start + matches[0].end()) if len(matches) == 1 else None


Changes = Iterator[tuple[Span | None, str]]


def _comparison(source: Source, node: ast.AST) -> Changes:
    if isinstance(node, ast.Compare):
        operands = [node.left, *node.comparators]
        for left, right, operator in zip(operands, operands[1:], node.ops, strict=False):
            word = COMPARED[type(operator)]
            yield source.between(left, right, word), OPPOSITE[word]


def _sign(source: Source, node: ast.AST) -> Changes:
    signs = {ast.Add: ("+", "-"), ast.Sub: ("-", "+")}
    if isinstance(node, ast.BinOp) and type(node.op) in signs:
        before, after = signs[type(node.op)]
        yield source.between(node.left, node.right, before), after
    if isinstance(node, ast.AugAssign) and type(node.op) in signs:
        before, after = signs[type(node.op)]
        yield source.between(node.target, node.value, before), after


def _extremum(source: Source, node: ast.AST) -> Changes:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
        name = node.func.id if isinstance(node.func, ast.Name) else node.func.attr
        if name in OTHER:
            stop = source.span(node.func)[1]
            yield (stop - len(name), stop), OTHER[name]


def _number(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value != 0


def _constant(source: Source, node: ast.AST) -> Changes:
    if _number(node):
        assert isinstance(node, ast.Constant) and isinstance(node.value, int | float)
        yield source.span(node), repr(node.value // 2 if isinstance(node.value, int) else node.value / 2)


def _outward(source: Source, node: ast.AST) -> Changes:
    if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load) and OUTWARD.match(node.id):
        yield source.span(node), "1.0" if "OUTWARD" in node.id else "0.0"
    if isinstance(node, ast.Call):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name == "nextafter" and node.args:
            yield source.span(node), source.text(source.span(node.args[0]))
        if name == "rounding":
            yield source.span(node), "0.0"


def _remainder(source: Source, node: ast.AST) -> Changes:
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div) and _number(node.right):
        yield source.span(node.right), f"({source.text(source.span(node.right))} * 2)"
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Mult):
        for side in (node.left, node.right):
            name = side.attr if isinstance(side, ast.Attribute) else getattr(side, "id", "")
            if REST.match(name):
                yield source.span(side), f"({source.text(source.span(side))} / 2)"


def _fewer(source: Source, node: ast.AST) -> Changes:
    """``x.max(axis=k)`` is the first along the axis, ``max(items)`` leaves the last out, as loops over corners do."""
    if not isinstance(node, ast.Call):
        return
    if isinstance(node.func, ast.Attribute) and node.func.attr == "max":
        axis = next((k.value for k in node.keywords if k.arg == "axis"), None)
        owner = source.text(source.span(node.func.value))
        if isinstance(axis, ast.Constant) and len(node.keywords) == 1 and not node.args:
            yield source.span(node), f"{owner}.take(0, axis={axis.value})"
        elif not node.args and not node.keywords:
            yield source.span(node), f"{owner}.flat[0]"
    if isinstance(node.func, ast.Name) and node.func.id == "max" and len(node.args) > 1 and not node.keywords:
        first = source.span(node.args[0])[0], source.span(node.args[-2])[1]
        yield source.span(node), f"max({source.text(first)}, {source.text(source.span(node.args[0]))})"
    if isinstance(node.func, ast.Name) and node.func.id == "product":
        yield source.span(node), f"list({source.text(source.span(node))})[:-1]"


def _tolerance(source: Source, node: ast.AST) -> Changes:
    name = node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""
    if TOLERANCES.search(name) and isinstance(getattr(node, "ctx", None), ast.Load):
        yield source.span(node), f"(10 * {source.text(source.span(node))})"


def _connective(source: Source, node: ast.AST) -> Changes:
    if isinstance(node, ast.BoolOp):
        before, after = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        for left, right in zip(node.values, node.values[1:], strict=False):
            yield source.between(left, right, before), after
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
        name = node.func.id if isinstance(node.func, ast.Name) else node.func.attr
        if name in ("all", "any"):
            stop = source.span(node.func)[1]
            yield (stop - 3, stop), "any" if name == "all" else "all"
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield source.span(node), f"bool({source.text(source.span(node.operand))})"


def _refusal(source: Source, node: ast.AST) -> Changes:
    if isinstance(node, ast.Raise):
        yield source.span(node), "pass"


def _modulus(source: Source, node: ast.AST) -> Changes:
    if isinstance(node, ast.Call) and len(node.args) == 1 and not node.keywords:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in ("abs", "absolute"):
            yield source.span(node), f"({source.text(source.span(node.args[0]))})"


KINDS: dict[str, Callable[[Source, ast.AST], Changes]] = {
    "comparison flipped": _comparison,
    "plus for minus": _sign,
    "maximum for minimum": _extremum,
    "constant halved": _constant,
    "outward rounding removed": _outward,
    "remainder halved": _remainder,
    "fewer corners": _fewer,
    "tolerance loosened": _tolerance,
    "connective changed": _connective,
    "refusal passed over": _refusal,
    "absolute value removed": _modulus,
}


def mutants(path: str, data: bytes) -> list[Mutant]:
    """Every mutant of a file, in the order of its text."""
    source = Source(path, data)
    found = []
    for node, function in _seen(source.tree, 0):
        for kind, rule in KINDS.items():
            for span, after in rule(source, node):
                if span is not None:
                    line = data.count(b"\n", 0, span[0]) + 1
                    found.append(Mutant(path, line, kind, span, source.text(span), after, function))
    return sorted(found, key=lambda mutant: (mutant.span, mutant.kind))


def _seen(node: ast.AST, function: int) -> Iterator[tuple[ast.AST, int]]:
    """Every node that may be changed, with the line on which its function begins."""
    if isinstance(node, ast.FunctionDef):
        function = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
    yield node, function
    for name, value in ast.iter_fields(node):
        if _unseen(node, name):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _seen(child, function)


def _unseen(node: ast.AST, field: str) -> bool:
    return (
        isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr | ast.Import | ast.ImportFrom)
        or field in ("annotation", "returns", "decorator_list")
        or (isinstance(node, ast.Subscript) and field == "slice")
        or (isinstance(node, ast.keyword) and node.arg in UNSEEN)
        or (isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING")
        or (isinstance(node, ast.AnnAssign) and "TypeAlias" in ast.unparse(node.annotation))
    )
