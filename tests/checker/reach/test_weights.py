"""Guards checker/reach/tube: bounds of the support at weights that are off by what is told."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.reach.tube import bound_supports
from sparserob_core.checker.sets.known import known
from sparserob_core.control.sets.sets import Box, Ellipsoid, NormBall

SETS = {
    "ball": NormBall(2.0, 0.7, centre=[0.1, 0.0]),
    "ellipsoid": Ellipsoid([0.0, 0.05], [[0.5, 0.2], [0.2, 0.3]]),
    "box": Box([-0.3, -0.2], [0.4, 0.2]),
}


@pytest.mark.parametrize("channel", [0, 1])
@pytest.mark.parametrize("name", SETS)
def test_a_bound_holds_for_every_weight_that_is_off_by_no_more_than_is_told(name, channel):
    """Errors of one channel, along which the weights point, so that all that is told is needed."""
    rng, monomials, pieces = np.random.default_rng(channel), Monomials(1, 2), 3
    every = 0.05 * rng.normal(size=(pieces, 2, monomials.size, 2, 1))
    every[:, 0, 0, :, 0] = 0.02
    every[:, 0, 0, channel, 0] = rng.choice([-1.0, 1.0], pieces) * 2.0
    errors = np.zeros_like(every)
    errors[:, :, :, channel] = rng.uniform(0.01, 0.03, size=errors[:, :, :, channel].shape)
    z = np.array([[1.0], [-0.5]])
    shape = known(SETS[name])
    moved, error, kinks, _ = bound_supports(shape, every, errors, z)
    exponents = np.array(monomials.exponents).reshape(-1)
    tight = np.inf
    for t in (0.0, 0.4, 1.0):
        for p in (-1.0, -0.3, 0.6, 1.0):
            powers = t ** np.arange(2)[:, None] * p**exponents
            weights = np.einsum("ljmwb,jm->lwb", every, powers)[..., 0]
            off = np.einsum("ljmwb,jm->lwb", errors, np.abs(powers))[..., 0]
            for k, factor in enumerate(z[:, 0]):
                at = factor * weights
                worst = at + np.sign(at) * np.abs(factor) * off
                truth = SETS[name].support(worst).sum()
                told = (moved[k] * powers).sum() + error[k]
                assert truth <= told + 1e-12, (t, p, factor)
                tight = min(tight, told - kinks[k] - SETS[name].support(at).sum())
    lost = float(SETS[name].support(np.eye(2)[channel]) * errors.sum(axis=(0, 1, 2))[channel, 0])
    assert tight <= 2.0 * lost
