"""Guards control/response/parameters: the map of a box onto a set, its slopes, and what a set says of a cell."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from sparserob_core.control.response.parameters import LATTICE, ParameterIndex
from sparserob_core.control.sets.sets import NormBall
from sparserob_core.sip.convex_set import Box, ConvexSet
from tests.control.constraints.test_sensitivity import SETS


class Egg(ConvexSet):
    """A convex set that only its violation is known of in closed form: ``x^2 + y^4 <= 1``."""

    @property
    def dimension(self):
        return 2

    def support(self, directions):
        return (np.asarray(directions) * self.support_point(directions)).sum(axis=-1)

    def support_point(self, directions):
        y = np.linspace(-1, 1, 20001)
        curve = np.stack([np.sqrt(1 - y**4), y], axis=1)
        directions = np.asarray(directions)
        curve = np.vstack([curve, curve * [-1, 1]])
        return curve[(directions @ curve.T).argmax(axis=-1)]

    def violation(self, points):
        points = np.asarray(points)
        return points[..., 0] ** 2 + points[..., 1] ** 4 - 1


@pytest.mark.first(4)
@pytest.mark.parametrize("convex", [*sorted(SETS), "egg", "long diamond"])
def test_the_map_of_a_box_onto_a_set_has_the_slopes_that_it_has(convex):
    rng = np.random.default_rng(12)
    index = ParameterIndex({**SETS, "egg": Egg(), "long diamond": NormBall(p=1.0, radius=1.0, dimension=12)}[convex])
    box = index.box
    points = rng.uniform(box.lower, box.upper, size=(40, index.count))
    weights = rng.normal(size=points.shape)
    claimed = index.pulled_back(points, weights)
    inside = index.set.contains(points, 0.0)
    assert np.array_equal(claimed[inside], weights[inside])
    close = 0
    for axis in range(index.count):
        move = 1e-6 * np.eye(index.count)[axis]
        slope = ((index.clamp(points + move) - index.clamp(points - move)) * weights).sum(axis=1) / 2e-6
        close += (np.abs(claimed[:, axis] - slope) <= 1e-6 * (1 + np.abs(slope))).sum()
    assert close >= 0.97 * points.size
    assert np.array_equal(index.pulled_back(index.set.interior_point()[None], weights[:1]), weights[:1])


@pytest.mark.parametrize("name", sorted(SETS))
def test_the_lattice_is_in_the_set_and_reaches_its_ends(name):
    index = ParameterIndex(SETS[name])
    points, shape = index.lattice()
    assert points.shape == (81, 2) and shape == (9, 9)
    assert index.set.contains(points, 1e-9).all()
    for axis in np.eye(2):
        assert (points @ axis).max() == pytest.approx(float(index.set.support(axis)), abs=2e-2)
    corners = np.array(list(product(*zip(index.box.lower, index.box.upper, strict=True))))
    assert index.clamp(points) == pytest.approx(points, abs=1e-12)
    drawn = index.clamp(corners) - index.set.interior_point()
    ray = corners - index.set.interior_point()
    assert (drawn[:, 0] * ray[:, 1]).tolist() == pytest.approx((drawn[:, 1] * ray[:, 0]).tolist(), abs=1e-12)
    if name != "box":
        outside = ~index.set.contains(corners, 1e-12)
        assert index.set.violation(index.clamp(corners)[outside]) == pytest.approx(np.zeros(outside.sum()), abs=1e-9)
    assert ParameterIndex(None).lattice()[0].shape == (1, 0)


@pytest.mark.parametrize("name", sorted(SETS))
def test_a_cell_that_does_not_touch_has_no_point_of_the_set_and_cuts_keep_every_point(name):
    """Sampled: no point of the set is in a cell that is told apart, or is cut off."""
    rng, index = np.random.default_rng(5), ParameterIndex(SETS[name])
    box, inside = index.box, SETS[name].sample(600, rng)
    told_apart = cut = 0
    for width in (0.5, 0.15, 0.04):
        for _ in range(4 if name == "3-norm" else 20):
            low = rng.uniform(box.lower - 0.05, box.upper)
            high = low + width * (box.upper - box.lower)
            here = inside[((inside >= low) & (inside <= high)).all(axis=1)]
            if not index.touches(low[None], high[None])[0]:
                told_apart += 1
                assert here.size == 0
            cuts = index.cuts(low, high)
            if cuts is None:
                grid = low + (high - low) * np.stack(np.meshgrid(*[np.linspace(0, 1, 5)] * 2), -1).reshape(-1, 2)
                assert index.set.is_box or index.set.contains(grid, 1e-9).all()
                continue
            cut += 1
            within = (here - (low + high) / 2) / np.where(high > low, (high - low) / 2, 1.0)
            over = within @ cuts.slopes.T - cuts.slack
            assert (over <= 1e-12).all()
            # every cut crosses the cell: one of its corners is beyond it
            assert (np.abs(cuts.slopes).sum(axis=1) > cuts.slack).all()
    assert name in ("box", "segment") or (told_apart and cut)


@pytest.mark.parametrize(("count", "per_axis"), [(1, 9), (2, 9), (3, 5), (4, 3), (5, 3), (6, 3), (8, 2), (20, 1)])
def test_the_lattice_is_as_fine_as_its_points_may_be_many(count, per_axis):
    """Of 9, 7 and 5 on every axis no more than 125 points, of fewer no more than are kept."""
    assert (per_axis <= 3 or per_axis**count <= 125) and per_axis**count <= LATTICE
    points, shape = ParameterIndex(Box(-np.ones(count), np.ones(count))).lattice()
    assert shape == (per_axis,) * count and points.shape == (per_axis**count, count)
    assert points.min() == -1.0 and (per_axis == 1 or points.max() == 1.0)
