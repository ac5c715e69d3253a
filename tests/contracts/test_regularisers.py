"""Guards sparserob_core/testing/dictionaries and every registered regulariser: each keeps the contract, and
regularisers that are wrong on purpose fail it."""

from __future__ import annotations

import time

import numpy as np
import pytest
from scipy.sparse import csc_array, diags_array, eye_array

import sparserob_core as sr
from sparserob_core.testing import RegulariserContract
from tests.support.faults import fails

REGISTRY = sr.load_registry()
NAMES = REGISTRY.names("regulariser")


def test_there_are_regularisers_to_be_tested():
    assert {"ridge", "weighted_ridge", "smoothness"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
class TestRegisteredRegulariser(RegulariserContract):
    @pytest.fixture(autouse=True)
    def named(self, name):
        self.name = name

    def create(self):
        return REGISTRY.build("regulariser", self.name)


class Energy(sr.Regulariser):
    """A right regulariser, for wrong ones to inherit from: ``1/2 int |u|^2``."""

    def quadratic(self, image):
        S = image.S
        return csc_array(S.T @ diags_array(image.lengths) @ S), np.zeros(S.shape[1])


class TestEnergy(RegulariserContract):
    component = Energy


class Concave(Energy):
    def quadratic(self, image):
        P, q = super().quadratic(image)
        return -P, q


class Saddle(Energy):
    """One direction bends the wrong way."""

    def quadratic(self, image):
        P, q = super().quadratic(image)
        P = P.tolil()
        P[0, 0] = -P[0, 0]
        return csc_array(P), q


class JumpsOnly(Energy):
    """Convex, not strictly: a constant control costs nothing."""

    def quadratic(self, image):
        D = csc_array(np.diff(np.eye(image.S.shape[0]), axis=0)) @ image.S
        return csc_array(D.T @ D), np.zeros(image.S.shape[1])


class BarelyConvex(JumpsOnly):
    def quadratic(self, image):
        P, q = super().quadratic(image)
        return csc_array(P + 1e-14 * eye_array(q.size)), q


class Skew(Energy):
    """A wrong gradient: ``P`` is only its upper triangle."""

    def quadratic(self, image):
        P, q = super().quadratic(image)
        return csc_array(np.triu(P.toarray() + 0.1)), q


class FirstControlOnly(Energy):
    def quadratic(self, image):
        weights = np.where(np.arange(image.lengths.size) < image.pieces, image.lengths, 0.0)
        return csc_array(image.S.T @ diags_array(weights) @ image.S), np.zeros(image.S.shape[1])


class PiecesForFunctions(Energy):
    def quadratic(self, image):
        n = image.lengths.size
        return csc_array(eye_array(n)), np.zeros(n)


class Dense(Energy):
    def quadratic(self, image):
        P, q = super().quadratic(image)
        return P.toarray(), q


class Numberless(Energy):
    def quadratic(self, image):
        P, q = super().quadratic(image)
        return P / 0.0 if image.channels == 3 else P, q


class OnlyP(Energy):
    def quadratic(self, image):
        return super().quadratic(image)[0]


class OneChannelExpected(Energy):
    def quadratic(self, image):
        return csc_array(diags_array(image.lengths[: image.pieces])), np.zeros(image.pieces)


class Enormous(Energy):
    def quadratic(self, image):
        P, q = super().quadratic(image)
        return 1e13 * P, q


class Vanishing(Energy):
    def quadratic(self, image):
        P, q = super().quadratic(image)
        return 1e-13 * P, q


class Remembering(Energy):
    first = None

    def quadratic(self, image):
        P, q = super().quadratic(image)
        self.first = self.first or float(P.diagonal().max())
        return P / self.first, q


class Clocked(Energy):
    def quadratic(self, image):
        P, q = super().quadratic(image)
        return P * (1 + (time.perf_counter_ns() % 997) / 997), q


class Scribbling(Energy):
    def quadratic(self, image):
        image.lengths[:] /= image.lengths.sum()
        return super().quadratic(image)


class Rescaling(Energy):
    def quadratic(self, image):
        image.S.data *= 0.5
        return super().quadratic(image)


CONVEX = "test_it_is_strictly_convex"
SAME = "test_the_same_image_gives_the_same_term_whatever_came_before"
FAULTS = {
    Concave: CONVEX,
    Saddle: CONVEX,
    JumpsOnly: CONVEX,
    BarelyConvex: CONVEX,
    Skew: CONVEX,
    FirstControlOnly: "test_every_control_is_regularised",
    PiecesForFunctions: CONVEX,
    Dense: CONVEX,
    Numberless: CONVEX,
    OnlyP: CONVEX,
    OneChannelExpected: CONVEX,
    Enormous: "test_it_is_of_ordinary_size",
    Vanishing: "test_it_is_of_ordinary_size",
    Remembering: SAME,
    Clocked: SAME,
    Scribbling: "test_the_image_is_left_as_it_was",
    Rescaling: "test_the_image_is_left_as_it_was",
}


@pytest.mark.filterwarnings("ignore:divide by zero")
@pytest.mark.parametrize(("flawed", "test"), FAULTS.items(), ids=[one.__name__ for one in FAULTS])
def test_the_contract_catches_a_regulariser_that_is_wrong_on_purpose(flawed, test):
    fails(RegulariserContract, flawed, test)
