"""Guards control/constraints: every family bounds its violations on cells of every width, by little more on narrow
ones, and its separation finds what samples find."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.errors import InputError
from tests.support.families import FIRST, KINDS, program

STAGED = [kind if kind in FIRST else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS]


def drawn(family, rng, share, count=8):
    """Cells that are a share of those of the family in every coordinate."""
    lower, upper = family.cells
    chosen = rng.integers(0, len(lower), count)
    low, sides = lower[chosen], (upper - lower)[chosen]
    low = low + rng.uniform(size=low.shape) * (1.0 - share) * sides
    return low, low + share * sides


def highest(family, x, low, high, rng, count=40):
    """The largest violation that is met in each cell, at its ends nearly too: a jump is in one cell or in none."""
    share = rng.uniform(size=(len(low), count, low.shape[1]))
    share[:, 0], share[:, 1] = 1e-12, 1.0 - 1e-12
    indices = (low[:, None] + share * (high - low)[:, None]).reshape(-1, low.shape[1])
    return family.violations(x, indices).reshape(len(low), count, -1).max(axis=(1, 2))


@pytest.mark.first(2)
@pytest.mark.parametrize("kind", STAGED)
def test_no_cell_is_bounded_below_what_is_met_in_it_and_narrow_ones_hardly_above(kind):
    rng, made = np.random.default_rng(2), program(kind)
    for family in made.families:
        x = rng.normal(size=made.n)
        for share in (0.3, 1e-5) if kind == "taking turns" else (1.0, 0.3, 0.05, 1e-5):
            low, high = drawn(family, rng, share)
            found, top = family.enclosure(x, low, high), highest(family, x, low, high, rng)
            # below 0 the scale of a row of directions is its own affair
            assert (top <= np.maximum(found.bounds, 0.0) + 1e-12).all(), (kind, family.name, share)
            assert ((found.split >= 0) & (found.split < low.shape[1])).all()
            if low.shape[1] == 1:
                assert (top <= found.bounds + 1e-12).all(), (kind, family.name, share)
                slack = 30.0 * (high - low)[:, 0] ** 2 + 30.0 * (high - low)[:, 0] * (share < 1e-3) + 1e-8
                assert (found.bounds - top <= slack + (share > 0.1)).all(), (kind, family.name, share)
            if share == 1e-5:
                inside = top > 0.0
                assert (found.bounds - top)[inside].max(initial=0.0) <= 1e-2, (kind, family.name)


@pytest.mark.parametrize("kind", STAGED)
def test_a_separation_is_no_less_than_what_samples_meet_and_is_met_where_it_says(kind):
    rng, made = np.random.default_rng(3), program(kind)
    for family in made.families:
        if family.worst is None or kind in ("parametric", "taking turns"):
            continue
        x = rng.normal(size=made.n)
        low, high = drawn(family, rng, 1.0, 24)
        found, top = family.worst(x), highest(family, x, low, high, rng, 20).max()
        assert found.violations[0] >= top - 1e-7, (kind, family.name)
        assert found.bound >= max(top, found.violations[0]) - 1e-12, (kind, family.name)
        assert (np.diff(found.violations) <= 1e-9).all()
        few = slice(0, 3)
        real = family.violations(x, found.indices[few])
        assert real[np.arange(len(real)), found.rows[few]] == pytest.approx(found.violations[few], abs=1e-9)


@pytest.mark.parametrize("kind", [kind for kind in FIRST if kind.startswith("feedback")])
def test_rows_for_every_deviation_are_violated_by_what_the_family_says(kind):
    rng, made = np.random.default_rng(4), program(kind)
    for family in made.families:
        x = rng.normal(size=made.n)
        low, high = family.cells
        inside = (low + rng.uniform(0.1, 0.9, size=low.shape) * (high - low))[:6]
        jumps = inside[inside[:, 0] > 0.3].copy()  # a row on the control is one before a jump and another behind it
        jumps[:, 0] = np.round(2.0 * jumps[:, 0]) / 2.0
        if not family.name.startswith("mixed"):
            jumps = jumps[:0]
        for index in np.concatenate([inside, jumps]):
            rows = family.uncertain(index)
            assert rows.excess(x, made.spread) == pytest.approx(family.violations(x, index[None])[0], abs=1e-9)
            assert rows.h.size == rows.part.size == rows.factor.size
        with pytest.raises(InputError, match="no row of the decision"):
            family.rows(low[:1])
