"""Guards plugins/sparserob_gradient_ascent: gradient ascent: finds the local maxima that it can reach, with and without
gradients, and keeps what matters of a tuple."""

from __future__ import annotations

import numpy as np

import sparserob_core as sr
from sparserob_core.sip.search.search import Target, maximise

BOX = sr.Box([-2.0] * 6, [3.0] * 6)
PEAK = np.array([0.3, -1.7, 2.9, 0.0, 1.1, -0.4])


def valley(points):
    return -((points - PEAK) ** 2 * [1, 100, 10, 1, 5, 50]).sum(axis=1)


def valley_slope(point):
    return -2 * (point - PEAK) * [1, 100, 10, 1, 5, 50]


def test_a_gradient_replaces_an_evaluation_per_coordinate():
    with_gradient = sr.maximise(valley, BOX, "gradient_ascent", budget=30, gradient=valley_slope, polish=0.0)
    without = sr.maximise(valley, BOX, "gradient_ascent", budget=30, polish=0.0)
    assert with_gradient.best_value >= -1e-8
    assert with_gradient.best_value > without.best_value
    assert sr.maximise(valley, BOX, "gradient_ascent", budget=300, polish=0.0).best_value >= -1e-6


def test_a_maximum_on_the_boundary_is_met_exactly():
    report = sr.maximise(
        lambda points: points @ np.arange(1.0, 7.0),
        BOX,
        "gradient_ascent",
        budget=40,
        gradient=lambda p: np.arange(1.0, 7.0),
        polish=0.0,
    )
    np.testing.assert_array_equal(report.best_point, BOX.upper)


def test_restarts_leave_a_local_maximum():
    def hills(points):
        return (np.cos(6 * points) - 0.1 * (points - 1.0) ** 2).sum(axis=1)

    def slope(point):
        return -6 * np.sin(6 * point) - 0.2 * (point - 1.0)

    box = sr.Box([-3.0], [3.0])
    values = [
        sr.maximise(hills, box, "gradient_ascent", budget=300, gradient=slope, seed=seed, polish=0.0).best_value
        for seed in range(5)
    ]
    assert min(values) >= 1.0 - 1e-3


def test_restarts_keep_the_blocks_with_a_gradient():
    """Of three blocks only the first two matter: a redraw changes the third and nothing else."""
    matters = np.arange(6) < 4

    def value(points):
        return -(np.abs(points - PEAK) ** 1.5)[:, matters].sum(axis=1)

    def slope(point):
        return np.where(matters, -1.5 * np.sign(point - PEAK) * np.sqrt(np.abs(point - PEAK)) + 1e-12, 0.0)

    registry, target = sr.load_registry(), Target(value, BOX, slope, block=2)
    report = maximise(
        target,
        registry.build("maximiser", "gradient_ascent", {"redraw": 1.0, "steps": 20}),
        200,
        np.random.default_rng(0),
    )
    ascents = report.trace.points[40:]
    assert np.abs(ascents[:, :4] - PEAK[:4]).max() < 0.1
    assert np.ptp(ascents[:, 4:], axis=0).min() > 1.0
