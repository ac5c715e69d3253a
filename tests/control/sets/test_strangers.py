"""Guards control/sets/strangers: a set of somebody else's kind that contradicts itself is refused wherever it stands,
and one that does not is believed, which a claim says."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.sets.strangers import require_consistent, strangers
from sparserob_core.control.transcription.provable import unproven_assumptions


def norm(c):
    return np.linalg.norm(c, axis=-1)


def unit(c):
    lengths = norm(c)[..., None]
    return c / np.where(lengths > 0.0, lengths, 1.0)


class Stranger(sr.ConvexSet):
    """A set by two functions, and half-spaces where it has some."""

    def __init__(self, support=norm, point=unit, sides=None, dimension=2):
        self.functions, self.sides, self._dimension = (support, point), sides, dimension

    @property
    def dimension(self):
        return self._dimension

    def support(self, directions):
        return self.functions[0](np.asarray(directions, dtype=float))

    def support_point(self, directions):
        return self.functions[1](np.asarray(directions, dtype=float))

    def halfspaces(self):
        return self.sides


def squares(c):
    """The largest of two bumps, attained at no point of a convex set."""
    return np.where(np.abs(c[..., 0]) > np.abs(c[..., 1]), np.abs(c[..., 0]), 2.0 * np.abs(c[..., 1]))


FLAWED = {
    "a square": (Stranger(lambda c: norm(c) ** 2), "not attained"),
    "too low": (Stranger(lambda c: 0.9 * norm(c)), "not attained"),
    "points outside": (Stranger(point=lambda c: 1.01 * unit(c)), "not attained"),
    "no cone": (Stranger(lambda c: norm(c) + (norm(c) > 0.0), lambda c: unit(c) * (1.0 + 1.0 / np.maximum(
        norm(c), 1e-9))[..., None]), "bound its own support points|2.5 h"),
    "not convex": (Stranger(squares, lambda c: squares(c)[..., None] * unit(c) / np.maximum(
        norm(c), 1e-9)[..., None]), "not sublinear"),
    "no number": (Stranger(lambda c: np.where(c[..., 0] > 0.5, np.nan, norm(c))), "no number"),
    "no point": (Stranger(point=lambda c: c / norm(c)[..., None]), "no point"),
    "sides too near": (Stranger(sides=(np.eye(2), np.full(2, 0.9))), "half-space"),
    "sides of another set": (Stranger(sides=(np.array([[1.0, 1.0]]), np.array([1.3]))), "half-space"),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("name", FLAWED)
def test_a_set_that_contradicts_itself_is_refused(name):
    convex, words = FLAWED[name]
    with pytest.raises(sr.InputError, match=f"where: expected the support function of a convex set, .*({words})"):
        require_consistent("where", convex)


def problem(**parts):
    return sr.OptimalControlProblem(**{
        "system": sr.LinearSystem(-np.eye(2), np.eye(2)), "horizon": 1.0, "initial_state": [1.0, 1.0],
        "control": sr.Box([-4.0] * 2, [4.0] * 2), "terminal": [sr.Box([-0.9] * 2, [0.9] * 2)], **parts,
    })  # fmt: skip


PLACES = {
    "control": lambda one: {"control": one},
    "control_step": lambda one: {"control_step": one},
    "initial_set": lambda one: {"initial_set": one},
    "disturbance": lambda one: {"disturbance": one},
    r"path\.0": lambda one: {"path": [one]},
    r"path\.0 ": lambda one: {"path": [sr.PathConstraint(one)]},
    r"terminal\.0": lambda one: {"terminal": [one]},
    "disturbance ": lambda one: {"disturbances": [sr.Disturbance(one, E=np.eye(2))]},
    "disturbance  ": lambda one: {"disturbance": one.in_units(np.array([2.0, 4.0]))},
    r"measurements\.noise": lambda one: {"measurements": sr.Measurements(C=np.eye(2), noise=one)},
    r"system\.parameters": lambda one: {
        "system": sr.LinearSystem(lambda p: [[p[0], 0.0], [0.0, p[1]]], np.eye(2), parameters=one)
    },
}


@pytest.mark.parametrize("place", PLACES)
def test_a_set_is_looked_at_wherever_it_stands(place):
    low = Stranger(lambda c: 0.9 * norm(c))
    with pytest.raises(sr.InputError, match=place.strip() + ": .*stranger: it is not attained"):
        problem(**PLACES[place](low))
    made = problem(**PLACES[place](Stranger()))
    assert "stranger" in {one.kind for one in strangers(made)}
    assert "what sets of the kind stranger say of themselves is believed" in unproven_assumptions(made)


def test_a_set_of_a_plugin_that_is_a_file_is_one_of_others(tmp_path):
    (tmp_path / "low.py").write_text(
        "import numpy as np\nimport sparserob_core as sr\n"
        "class Low(sr.ConvexSet):\n    dimension = 2\n"
        "    def support(self, c): return 0.9 * np.linalg.norm(c, axis=-1)\n"
        "    def support_point(self, c):\n"
        "        return c / np.maximum(np.linalg.norm(c, axis=-1, keepdims=True), 1e-300)\n"
        "class Lows(sr.SetFactory, sr.Options):\n    def build(self, dimension): return Low()\n"
        "@sr.hookimpl\ndef sparserob_sets():\n    yield sr.SetPlugin(name='low', factory=Lows)\n"
    )
    low = sr.load_registry([tmp_path / "low.py"]).build("set", "low").build(2)
    with pytest.raises(sr.InputError, match=r"terminal\.0: .*the kind low: it is not attained"):
        problem(terminal=[low])


def test_sets_of_this_distribution_are_known():
    made = problem(disturbance=sr.Ellipsoid([0.0, 0.0], np.eye(2)), path=[sr.Box([-3.0] * 2, [3.0] * 2)])
    assert not list(strangers(made)) and unproven_assumptions(made) == ""


def test_a_set_that_is_unbounded_is_looked_at_where_it_is_finite():
    def support(c):
        return np.where(np.abs(c[..., 1]) > 0.0, np.inf, np.abs(c[..., 0]))

    require_consistent("where", Stranger(support, lambda c: np.stack([np.sign(c[..., 0]), 0.0 * c[..., 1]], axis=-1)))
    with pytest.raises(sr.InputError, match="not attained"):
        require_consistent("where", Stranger(support, lambda c: 0.5 * np.sign(c)))


def test_a_claim_says_what_it_believes():
    result = sr.solve(
        problem(disturbance=Stranger(lambda c: 0.01 * norm(c), lambda c: 0.01 * unit(c))),
        control={"name": "piecewise_constant", "pieces": 4},
    )
    assert result.status == "certified"
    assert "what sets of the kind stranger say of themselves is believed" in result.message
