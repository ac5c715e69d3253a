"""Families of every kind that problems make: flat, moving, mixed and curved path sets, terminal sets, steps and the
control's own set. They are of known systems, of uncertain ones, of those that change with time, and with integrals.
Disturbances jump or are measurable, commands have errors, and controls answer measurements or not."""

from __future__ import annotations

from functools import cache

import numpy as np

import sparserob_core as sr
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, VaryingSystem
from sparserob_core.control.problem.terms.integral import IntegralConstraint
from sparserob_core.control.problem.terms.windows import MixedConstraint, PathConstraint
from sparserob_core.control.sets.sets import Box, Ellipsoid, NormBall
from sparserob_core.control.transcription.transcribe import prepare
from tests.support.plants import uniform

HORIZON = 2.0
A = np.array([[0.0, 1.0], [-2.0, -0.3]])
B, E = np.array([[0.0], [1.0]]), np.array([[0.3], [1.0]])
MOVING = PathConstraint(
    Box([-2.0, -3.0], [2.0, 3.0]), 0.3, 1.7, "moving", [[0.0, 0.0, 0.0], [1.1, 0.4, 0.2], [2.0, 0.1, 0.0]]
)
FLAT = [
    PathConstraint(Box([-1.5, -2.0], [1.5, 2.0]), 0.15, 1.85, "path"),
    MOVING,
    MixedConstraint([[1.0, 0.2], [0.0, -1.0]], [[0.5], [0.1]], [1.2, 2.0], 0.2, 1.6, "mixed"),
]
CURVED = [
    PathConstraint(Ellipsoid(np.zeros(2), np.array([[3.0, 0.5], [0.5, 4.0]])), 0.15, 1.85, "curved"),
    PathConstraint(NormBall(p=3.0, radius=2.0, centre=np.zeros(2)), 0.4, 1.5, "moving and curved", MOVING.relative_to),
]


def problem(kind):
    """The problem of a kind of uncertainty, and the policy that it is put to."""
    terminal = [Box([-0.5, -0.5], [0.5, 0.5]), Ellipsoid(np.zeros(2), 0.5 * np.eye(2))]
    more = {"disturbance": Box([-0.1], [0.2])}
    path, policy, system = [*FLAT, *CURVED], None, LinearSystem(A, B, E)
    if kind == "parametric":
        system = LinearSystem(
            lambda p: np.array([[0.0 * p[0], 1.0 + 0.0 * p[0]], [-2.0 + p[0], -0.3 + 0.0 * p[0]]]),
            B, E, parameters=Box([-0.02], [0.02]),
        )  # fmt: skip
    if kind == "taking turns":
        first = LinearSystem(lambda p: A + p[0] * np.eye(2), B, E, parameters=Box([-0.02], [0.02]))
        second = LinearSystem(lambda p: A.T * (1.0 + p[0]), B, E, parameters=Box([-0.02], [0.02]))
        system, more["initial_set"] = (
            SwitchedSystem([(0.9, first), (HORIZON, second)]),
            Box([-0.05, -0.02], [0.05, 0.02]),
        )
    if kind == "varying":
        path, terminal = [*FLAT, CURVED[0]], terminal[:1]
        system = VaryingSystem.of(
            [[0, 1], ["-(2 - 0.5*cos(3*t))", "-0.3"]], [[0], ["1/(3 - t)"]], HORIZON, [[0.3], ["1 + t"]]
        )
        more["initial_set"] = Box([-0.05, -0.02], [0.05, 0.02])
    if kind == "execution":
        path, terminal = FLAT, terminal[:1]
        more |= {"execution": [0.05], "control_step": Box([-0.4], [0.4])}
    if kind.endswith("integrals"):
        more["integral"] = [
            IntegralConstraint(H=[[1.0, 0.3]], G=[[0.5]], lower=-0.4, upper=0.7, start=0.3, stop=1.7),
            IntegralConstraint(G=[[1.0]], upper=0.9),
        ]
    if kind == "measurable":
        path, terminal = FLAT, terminal[:1]
        more["disturbance_class"] = "measurable"
    if kind.startswith("feedback"):
        path, terminal = FLAT, terminal[:1]
        policy = sr.AffinePolicy()
        more |= {"control_step": Box([-0.4], [0.4]), "initial_set": Box([-0.05, -0.02], [0.05, 0.02])}
    return OptimalControlProblem(
        system=system,
        horizon=HORIZON,
        initial_state=[-1.0, 0.5],
        control=Box([-1.0], [1.0]),
        path=path,
        terminal=terminal,
        **more,
    ), policy


FIRST = ("known", "parametric", "taking turns", "measurable", "feedback")
KINDS = (*FIRST, "varying", "execution", "integrals", "feedback, integrals")


@cache
def program(kind):
    made, policy = problem(kind)
    return prepare(made, uniform(4, HORIZON), uniform(4, HORIZON), policy=policy).program
