"""Guards control/problem/delivery: the mean of what is delivered, and what scales the deviation from it."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.control.problem.delivery import Delivery, late_breakpoints
from sparserob_core.control.problem.dictionary import Dictionary

ENDS = np.array([0.0, 0.5, 1.25, 2.0])
HAAR = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 0.5]])


@pytest.mark.parametrize("dictionary", [Dictionary.indicators(ENDS), Dictionary(ENDS, HAAR)], ids=["pieces", "others"])
def test_mean_and_deviation_make_the_old_and_the_new_value(dictionary: Dictionary) -> None:
    delivery, rng = Delivery(np.ones(2), 0.2), np.random.default_rng(0)
    theta = rng.normal(size=2 * dictionary.functions)
    mean = delivery.mean(dictionary)
    plan, middle = dictionary.control(theta), mean.control(theta)
    deviation = middle @ delivery.scaling(mean)
    np.testing.assert_allclose(mean.breakpoints, [0.0, 0.5, 0.7, 1.25, 1.45, 2.0])
    np.testing.assert_allclose(middle[:, ::2], plan)
    np.testing.assert_allclose(deviation[:, ::2], 0.0)
    np.testing.assert_allclose((middle + deviation)[:, 1::2], plan[:, 1:])
    np.testing.assert_allclose((middle - deviation)[:, 1::2], plan[:, :-1])


def test_without_jitter_the_command_scales_its_own_deviation() -> None:
    dictionary, delivery = Dictionary.indicators(ENDS), Delivery(np.array([0.1]))
    assert delivery.mean(dictionary) is dictionary
    assert np.array_equal(delivery.scaling(dictionary).toarray(), np.eye(3))


def test_every_interval_names_the_piece_of_its_new_value() -> None:
    times, owner = late_breakpoints(ENDS, 0.2)
    assert times.size == owner.size + 1 and owner.tolist() == [0, 1, 1, 2, 2]
