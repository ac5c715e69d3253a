"""Guards the hook of sets: what a stranger writes with public names alone, as docs/extending.md tells, is solved,
proven and not believed by the checker; its answers are those of the shipped sets where it is one of them."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.testing import SetContract
from tests.support.stub import Command

SUM = '''"""A sum of sets (Minkowski 1911), by public names alone."""

from typing import ClassVar

import numpy as np

import sparserob_core as sr


class Sum(sr.ConvexSet):
    """``{a + b + ...}``; its support function is the sum of theirs."""

    def __init__(self, *members):
        self.members = members

    @property
    def dimension(self):
        return self.members[0].dimension

    def support(self, directions):
        return sum(member.support(directions) for member in self.members)

    def support_point(self, directions):
        return sum(member.support_point(directions) for member in self.members)

    def linearisation_excess(self, centre, spread):
        return sum(member.linearisation_excess(centre, spread) for member in self.members)

    def support_minorant(self, centre, spread):
        parts = [member.support_minorant(centre, spread) for member in self.members]
        return tuple(sum(part) for part in zip(*parts))


class Capsule(sr.SetFactory, sr.Options):
    """All points near a segment: the sum of a segment and a ball."""

    shorthand: ClassVar[str | None] = "axis"

    axis: list[float]
    """Half the segment."""

    radius: float = 0.01
    """Distance from it."""

    def build(self, dimension):
        if len(self.axis) != dimension:
            raise sr.InputError(f"axis: expected {dimension} numbers, got {len(self.axis)}")
        segment = sr.Zonotope(np.zeros(dimension), np.array([self.axis]))
        return Sum(segment, sr.NormBall(2, self.radius, dimension=dimension))


@sr.hookimpl
def sparserob_sets():
    yield sr.SetPlugin(name="capsule", factory=Capsule, summary="All points near a segment.", interface=1)
'''
CONFIG = """
title: capsules everywhere
problem:
  name: linear
  system: {A: [[0, 1], [0, 0]], B: [[0], [1]]}
  horizon: 4.0
  initial_state: {centre: [1, 0], capsule: {axis: [0.01, 0.005], radius: 0.005}}
  control: {box: 1.0}
  disturbance: {capsule: {axis: [0.004, 0.002], radius: 0.002}}
  path: [{capsule: {axis: [2.0, 0.5], radius: 1.0}}]
  terminal: [{capsule: {axis: [0.2, 0.1], radius: 0.4}}]
dictionaries: {control: {name: piecewise_constant, pieces: 12}}
plugins: [./capsule.py]
"""
NAMES: dict[str, type] = {}
exec(compile(SUM, "capsule.py", "exec"), NAMES)  # the file that a stranger would have
Sum = NAMES["Sum"]
BOX, ELLIPSOID = sr.Box([-0.03, -0.02], [0.03, 0.02]), sr.Ellipsoid([0.0, 0.0], np.diag([0.02, 0.01]) ** 2)
SEGMENTS = np.array([[0.03, 0.0], [0.0, 0.02], [0.01, 0.02]])


class TestSumOfABoxAndAnEllipsoid(SetContract):
    def create(self):
        return Sum(BOX, ELLIPSOID)


def solved(pieces=12, moves=4, **parts):
    problem = sr.OptimalControlProblem(
        **{
            "system": sr.LinearSystem(A=[[0, 1], [0, 0]], B=[[0], [1]], E=np.eye(2)),
            "horizon": 4.0,
            "initial_state": [1, 0],
            "control": sr.Box([-1], [1]),
            "terminal": [sr.Box([-0.4, -0.4], [0.4, 0.4])],
            **parts,
        }
    )
    control, disturbance = ({"name": "piecewise_constant", "pieces": count} for count in (pieces, moves))
    return sr.solve(problem, control=control, disturbance=disturbance)


def test_it_imports_nothing_but_public_names() -> None:
    modules = {
        node.module if isinstance(node, ast.ImportFrom) else node.names[0].name
        for node in ast.walk(ast.parse(SUM))
        if isinstance(node, ast.Import | ast.ImportFrom)
    }
    assert modules == {"typing", "numpy", "sparserob_core"}


@pytest.mark.first(2)
@pytest.mark.parametrize("place", ["initial_set", "disturbance", "terminal", "path"])
def test_a_sum_that_is_a_shipped_set_has_its_cost(place: str) -> None:
    factor = {"terminal": 8.0, "path": 60.0, "disturbance": 0.2}.get(place, 1.0)
    members = [sr.Zonotope(np.zeros(2), factor * SEGMENTS[:2]), sr.Zonotope(np.zeros(2), factor * SEGMENTS[2:])]
    shipped = sr.Zonotope(np.zeros(2), factor * SEGMENTS)

    def placed(convex):
        return {place: [convex] if place in ("terminal", "path") else convex}

    theirs, ours = solved(**placed(Sum(*members))), solved(**placed(shipped))
    assert theirs.status == ours.status == "certified"
    assert theirs.cost == pytest.approx(ours.cost, rel=1e-6)


def test_a_sum_lies_between_polytopes_and_so_does_its_cost() -> None:
    convex = Sum(BOX.scaled(8.0), ELLIPSOID.scaled(8.0))
    angles = np.linspace(0.0, 2 * np.pi, 64, endpoint=False)
    c = np.column_stack([np.cos(angles), np.sin(angles)])
    outer = sr.Polytope(c, convex.support(c))
    corners = convex.support_point(c)
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack([edges[:, 1], -edges[:, 0]])[np.linalg.norm(edges, axis=1) > 1e-9]
    inner = sr.Polytope(normals, (normals @ corners.T).max(axis=1))
    outside, exact, inside = (solved(terminal=[one]).cost for one in (outer, convex, inner))
    assert outside <= exact + 1e-7
    assert exact <= inside + 1e-7
    assert inside - outside < 0.02 * exact


class Ball(sr.ConvexSet):
    """All points whose 3-norm is at most ``radius``: the three members that a set must have."""

    def __init__(self, radius):
        self.radius = radius

    @property
    def dimension(self):
        return 2

    def support(self, directions):
        return self.radius * np.linalg.norm(directions, ord=1.5, axis=-1)

    def support_point(self, directions):
        lengths = np.linalg.norm(directions, ord=1.5, axis=-1, keepdims=True)
        return self.radius * np.sign(directions) * np.sqrt(np.abs(directions) / np.where(lengths > 0, lengths, 1.0))


def test_several_round_sets_of_three_members_are_certified() -> None:
    found = solved(4, 2, disturbance=Ball(0.02), terminal=[Ball(0.4)])  # bounds of first order did not end in a minute
    assert found.status == "certified"


@pytest.mark.slow
def test_a_config_names_it_the_run_is_proven_and_the_checker_does_not_say_so(tmp_path: Path, command: Command) -> None:
    (tmp_path / "capsule.py").write_text(SUM)
    (tmp_path / "capsule.yaml").write_text(CONFIG)
    done = command("run", "capsule.yaml", "--out", "out", "--no-figures", "--json")
    assert (done.returncode, '"status": "certified"' in done.stdout) == (0, True), done.stdout + done.stderr
    done = command("check", "out", "--plugins", "capsule.py")
    assert "not checked" in done.stdout
    assert done.returncode != 0 and "verified" not in done.stdout.splitlines()[-1]
