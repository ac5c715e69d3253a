"""Guards the proof over every kind of family that problems make: what is violated by five billionths of a row's unit is
never proven, and what holds by more is.

The limits of every family are moved to where the largest violation that was met is just that much.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.problem.problem import MixedConstraint, OptimalControlProblem, PathConstraint
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.sets.sets import Box, Ellipsoid, NormBall
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.sip.program import TOLERANCE, Separation
from sparserob_core.sip.proof.branch_and_bound import prove_family
from tests.support.plants import uniform

HORIZON = 2.0
SMALL = 5e-9  # of a row's unit
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
    if kind.endswith("measurable"):
        path, terminal = FLAT, terminal[:1]
        more["disturbance_class"] = "measurable"
    if kind.startswith("feedback"):
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


KINDS = ("known", "parametric", "measurable", "feedback", "feedback, measurable")


@cache
def program(kind):
    made, policy = problem(kind)
    return prepare(made, uniform(4, HORIZON), uniform(4, HORIZON), policy=policy).program


def moved(family, amount):
    """The same family where every violation is larger by an amount."""

    def rows(indices):
        G, h = family.rows(indices)
        return G, h - amount

    def worst(x):
        found = family.worst(x)
        return Separation(found.indices, found.rows, found.violations + amount, found.bound + amount)

    def enclosure(x, lower, upper):
        found = family.enclosure(x, lower, upper)
        return replace(found, bounds=found.bounds + amount)

    excess = None if family.excess is None else lambda x, indices: family.excess(x, indices) + amount
    return replace(
        family, rows=rows, excess=excess, worst=None if family.worst is None else worst, enclosure=enclosure,
        chosen=None, gradient=None, steepest=None, linear=None, literal=None, nominal=None, sample=None,
    )  # fmt: skip


def met(family, x, rng):
    """The largest violation that samples and separation meet, which is one indeed."""
    lower, upper = family.cells
    share = rng.uniform(size=(300, len(lower), lower.shape[1]))
    share[:2] = np.array([0.0, 1.0])[:, None, None]
    indices = (lower + share * (upper - lower)).reshape(-1, lower.shape[1])
    most = float(family.violations(x, indices[:: 1 + len(indices) // 400]).max())
    return most if family.worst is None else max(most, float(family.worst(x).violations[0]))


@pytest.mark.parametrize("kind", KINDS)
def test_five_billionths_too_much_are_never_proven_and_a_little_room_is(kind):
    rng, made = np.random.default_rng(1), program(kind)
    names = [family.name for family in made.families]
    for name in ("path", "moving", "mixed"):
        assert name in names
    if kind.startswith("feedback"):
        assert {"control", "control_step"} <= set(names), names
    for family in made.families:
        x, most = 0.5 * rng.normal(size=made.n), -1.0
        while most <= 0.0:  # below 0 the scale of a row of directions is its own affair
            x = 1.5 * x
            most = met(family, x, rng)
        proof = prove_family(moved(family, SMALL - most), x, cells=1500)
        assert proof.verdict != "proven", (kind, family.name, proof)
        if proof.verdict == "refuted":
            assert proof.violation > TOLERANCE
        exact = "parametric" not in kind and proof.index is not None and proof.index.size == 1
        if exact:
            assert proof.verdict == "refuted", (kind, family.name, proof)
        room = 1e-5 if exact else 3e-2
        assert prove_family(moved(family, -room - most), x, cells=20_000).verdict == "proven", (kind, family.name)


@pytest.mark.parametrize("kind", KINDS)
def test_no_cell_is_bounded_below_what_is_met_in_it(kind):
    """On cells of every width: the families' own, and halves of them again and again."""
    rng, made = np.random.default_rng(2), program(kind)
    for family in made.families:
        x = 0.3 * rng.normal(size=made.n)
        lower, upper = family.cells
        for _ in range(5):
            chosen = rng.integers(0, len(lower), 8)
            low, high = lower[chosen], upper[chosen]
            bounds = family.enclosure(x, low, high).bounds
            share = rng.uniform(size=(8, 60, low.shape[1]))
            share[:, 0], share[:, 1] = 1e-12, 1.0 - 1e-12  # a jump is in the cell that it ends, or in none
            indices = low[:, None] + share * (high - low)[:, None]
            values = family.violations(x, indices.reshape(-1, low.shape[1])).reshape(8, 60, -1).max(axis=2)
            # below 0 the scale of a row of directions is its own affair
            assert (values.max(axis=1) <= np.maximum(bounds, 0.0) + 1e-12).all(), (kind, family.name)
            split = family.enclosure(x, low, high).split
            middle = (low + high)[np.arange(8), split] / 2
            upper = high.copy()
            upper[np.arange(8), split] = middle
            lower = low
