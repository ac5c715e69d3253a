"""Guards the proof over every kind of family that problems make: what is violated by five billionths of a row's unit is
never proven, and what holds by more is.

The limits of every family are moved to where the largest violation that was met is just that much.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sparserob_core.sip.program import TOLERANCE, Separation
from sparserob_core.sip.proof.branch_and_bound import prove_family
from tests.support.families import KINDS, program

SMALL = 5e-9  # of a row's unit


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
    most = float(family.violations(x, indices[:: 1 + len(indices) // 150]).max())
    return most if family.worst is None else max(most, float(family.worst(x).violations[0]))


@pytest.mark.parametrize(
    "kind", [kind if kind == "feedback" else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS]
)
def test_five_billionths_too_much_are_never_proven_and_a_little_room_is(kind):
    rng, made = np.random.default_rng(1), program(kind)
    names = [family.name for family in made.families]
    for name in ("path", "moving", "mixed"):
        assert name in names
    if kind.startswith("feedback"):
        assert {"control", "control_step"} <= set(names), names
    for family in made.families:
        x, most = rng.normal(size=made.n), -1.0
        while most <= 0.0:  # below 0 the scale of a row of directions is its own affair
            x = -1.5 * x  # of a bound on one side, to that side
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
