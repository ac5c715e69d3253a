"""Guards that a stranger can read the checker: its classes are small, and none is called as one outside of it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from tests.support.places import ROOT

CORE = ROOT / "sparserob_core"
CHECKER = CORE / "checker"
MAX_METHODS = 25


def classes(path: Path) -> Iterator[ast.ClassDef]:
    return (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ClassDef))


def methods(node: ast.ClassDef) -> int:
    return sum(isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef) for one in node.body)


def modules(place: Path) -> list[Path]:
    return sorted(place.rglob("*.py"))


def test_no_class_of_the_checker_is_called_as_one_elsewhere_in_the_core() -> None:
    inside = {node.name: path for path in modules(CHECKER) for node in classes(path)}
    others = [path for path in modules(CORE) if not path.is_relative_to(CHECKER)]
    outside = {node.name: path for path in others for node in classes(path)}
    assert len(inside) > 50
    assert len(outside) > 500
    both = sorted(inside.keys() & outside.keys())
    assert not [f"{name}: {inside[name].relative_to(ROOT)}, {outside[name].relative_to(ROOT)}" for name in both]


def test_no_class_of_the_checker_has_more_than_twenty_five_methods() -> None:
    large = [(path, node) for path in modules(CHECKER) for node in classes(path) if methods(node) > MAX_METHODS]
    assert not [f"{node.name} in {path.relative_to(ROOT)}: {methods(node)}" for path, node in large]
