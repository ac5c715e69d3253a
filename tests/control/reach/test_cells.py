"""Guards control/response: cells of constraints are bounded by no less than dense samples meet in them, and by little
more on narrow ones, under disturbances of a list, over turns, late, drifting and of few functions."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.problem.disturbances import join_disturbances
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, VaryingSystem
from sparserob_core.control.problem.terms.windows import PathConstraint
from sparserob_core.control.sets.sets import Box, Ellipsoid, NormBall, Polytope
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.errors import NotEnclosable
from tests.support.families import FLAT
from tests.support.plants import indicators, uniform, walsh

HORIZON = 2.0
A = np.array([[0.0, 1.0], [-2.0, -0.3]])
B, E = np.array([[0.0], [1.0]]), np.array([[0.3, 0.1], [1.0, -0.4]])
PLAIN = LinearSystem(A, B, E)
TURNS = SwitchedSystem([(0.9, PLAIN), (1.3, LinearSystem(A.T, 2.0 * B, -E)), (HORIZON, PLAIN)])
UNSURE = LinearSystem(lambda p: A + p[0] * np.array([[0.0, 0.0], [1.0, 0.2]]), B, E, parameters=Box([-0.05], [0.05]))
BOX = Box([-0.1, 0.0], [0.2, 0.1])
TRIANGLE = Polytope([[1.0, 1.0], [-1.0, 0.2], [0.0, -1.0]], [0.3, 0.2, 0.1])
LIST = Box([-0.1], [0.2]), Box([-0.1], [0.1])
OWN = np.array([0.0, 1.0, HORIZON]), np.array([0.0, 0.5, 1.5, HORIZON])
KINDS: dict[str, dict[str, Any]] = {
    "measurable over turns": {"system": TURNS, "disturbance": BOX, "disturbance_class": "measurable"},
    "over turns, from a ball": {
        "system": TURNS, "disturbance": TRIANGLE, "initial_set": Ellipsoid(np.zeros(2), [[0.01, 0.0], [0.0, 0.02]])
    },
    "measurable in a triangle": {"disturbance": TRIANGLE, "disturbance_class": "measurable"},
    "late and drifting": {
        "system": LinearSystem(A, B, E, c=np.array([0.1, -0.4]), delay=0.3), "disturbance": BOX,
        "initial_control": [0.4], "initial_set": Box([-0.05, -0.02], [0.05, 0.02]),
    },
    "late and unsure": {
        "system": UNSURE.with_delay(0.3), "disturbance": TRIANGLE,
        "initial_set": NormBall(p=3.0, radius=0.05, dimension=2),
    },
    "few functions": {"disturbance": BOX, "noise": walsh(4, HORIZON, 3), "control_in": walsh(4, HORIZON, 2)},
    "l1 ball": {
        "disturbance": Box([-0.1, -0.2], [0.1, 0.2]), "disturbance_class": "l1_ball", "noise": walsh(4, HORIZON)
    },
    "on own pieces": {"list": ("piecewise_constant", "piecewise_constant"), "own": OWN},
    "on own pieces, unsure": {"system": UNSURE, "list": ("piecewise_constant", "piecewise_constant"), "own": OWN},
    "on own pieces, in time": {
        "system": VaryingSystem.of([[0, 1], ["cos(3*t)/2 - 2", "-0.3"]], [[0], ["1/(3 - t)"]], HORIZON, E.tolist()),
        "list": ("piecewise_constant", "piecewise_constant"), "own": OWN,
    },
    "erring": {"execution": [0.1], "disturbance": BOX},
    "erring and measurable, in time": {
        "system": VaryingSystem.of([[0, 1], ["cos(3*t)/2 - 2", "-0.3"]], [[0], ["1/(3 - t)"]], HORIZON, E.tolist()),
        "execution": [0.1], "disturbance": TRIANGLE, "disturbance_class": "measurable",
    },
    "of two classes": {"list": ("piecewise_constant", "measurable"), "own": (None, None)},
    "of two classes over turns": {"system": TURNS, "list": ("measurable", "piecewise_constant"), "own": (None, None)},
}  # fmt: skip


@cache
def program(name: str) -> Any:
    more = dict(KINDS[name])
    grids = more.pop("control_in", uniform(4, HORIZON)), more.pop("noise", indicators([0.0, 0.7, HORIZON]))
    if "list" in more:
        every = [
            sr.Disturbance(one, E[:, i : i + 1], kind, breakpoints=pieces)
            for i, (one, kind, pieces) in enumerate(zip(LIST, more.pop("list"), more.pop("own"), strict=True))
        ]
        names = "system", "disturbance", "disturbance_class", "disturbance_breakpoints"
        more |= dict(zip(names, join_disturbances(more.get("system", PLAIN), every, HORIZON), strict=True))
    path = [*FLAT[:2], *([] if "late" in name else [FLAT[2]])]
    path.append(PathConstraint(Ellipsoid(np.zeros(2), [[3.0, 0.5], [0.5, 4.0]]), 0.15, 1.85, "curved"))
    made = OptimalControlProblem(
        **{"system": PLAIN, "horizon": HORIZON, "initial_state": [-1.0, 0.5], "control": Box([-1.0], [1.0]), **more},
        path=path,
    )
    return prepare(made, *grids).program


@pytest.mark.first(6)
@pytest.mark.parametrize("name", KINDS)
def test_no_cell_is_bounded_below_what_is_met_in_it_and_narrow_ones_hardly_above(name: str) -> None:
    rng, made = np.random.default_rng(5), program(name)
    for family in made.families:
        if family.enclosure is None or family.name.startswith("control"):
            continue
        x = rng.normal(size=made.n)
        lower, upper = family.cells
        for share in (0.5, 1e-5):
            chosen = rng.integers(0, len(lower), 2)
            low, sides = lower[chosen], (upper - lower)[chosen]
            low = low + rng.uniform(size=low.shape) * (1.0 - share) * sides
            high = low + share * sides
            inside = rng.uniform(size=(len(low), 9, low.shape[1]))
            inside[:, 0], inside[:, 1] = 1e-12, 1.0 - 1e-12
            indices = (low[:, None] + inside * (high - low)[:, None]).reshape(-1, low.shape[1])
            top = family.violations(x, indices).reshape(len(low), 9, -1).max(axis=(1, 2))
            bounds = family.enclosure(x, low, high).bounds
            assert (top <= np.maximum(bounds, 0.0) + 1e-12).all(), (name, family.name, share)
            if low.shape[1] == 1:
                assert (top <= bounds + 1e-12).all(), (name, family.name, share)
            if share < 0.1:
                near = top > 0.0
                assert (bounds - top)[near].max(initial=0.0) <= 1e-2, (name, family.name, bounds, top)


def test_measurable_disturbances_beside_parameters_in_no_box_have_no_enclosure_and_that_is_said() -> None:
    round_ = LinearSystem(UNSURE.phases[0].A, B, E, parameters=Ellipsoid([0.0], [[0.0025]]))
    said = {"system": round_, "disturbance": BOX, "disturbance_class": "measurable", "path": FLAT[:1]}
    made = OptimalControlProblem(horizon=HORIZON, initial_state=[-1.0, 0.5], control=Box([-1.0], [1.0]), **said)
    family = prepare(made, uniform(4, HORIZON), uniform(4, HORIZON)).program.families[0]
    assert family.enclosure is not None
    with pytest.raises(NotEnclosable, match="with disturbance_class piecewise_constant there is one"):
        family.enclosure(np.zeros(4), *family.cells)
