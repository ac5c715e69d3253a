"""Guards sparserob_core/testing/problems and every registered problem: each keeps the contract, and problems whose
parts do not agree fail it."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.testing import ContractBroken, ProblemContract
from tests.support.faults import fails

REGISTRY = sr.load_registry()
KNOWN = {
    "system": {"A": [[0, 1], ["-2 + p1", -0.5]], "B": [[0], ["1 + p1"]], "parameters": {"p1": [-0.1, 0.1]}},
    "horizon": 3.0,
    "initial_state": [-0.5, 0.2],
    "disturbance": {"box": 0.02},
    "path": [{"box": [2.0, None], "from": 1.0}],
    "terminal": [{"box": 1.0}, {"ellipsoid": {"shape": 1.0}}],
}
EXAMPLES = {
    "linear": {**KNOWN, "control": {"box": 1.0}},
    "minimum_attention": {**KNOWN, "rate": {"box": 2.0}, "control": {"box": 1.0}},
    "rendezvous": {
        "orbit": {"semi_major_axis": 1.0, "mu": 1.0},
        "horizon": 3.0,
        "initial_state": [-1.0, 0.2, 0.0, 0.0],
        "disturbance": {"box": 0.01},
        "path": [{"box": [2.0, None, None, None], "from": 1.0}],
        "terminal": [{"box": 0.5}],
        "control": {"box": 1.0},
    },
}


def test_every_registered_problem_has_an_example():
    own = {"linear", "minimum_attention", "rendezvous"}
    assert own <= set(REGISTRY.names("problem")) and own == set(EXAMPLES)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "minimum_attention" else ()) for name in EXAMPLES]
)
class TestRegisteredProblem(ProblemContract):
    @pytest.fixture(autouse=True)
    def named(self, name):
        self.name = name

    def create(self):
        return REGISTRY.build("problem", self.name, EXAMPLES[self.name])


def rows(index):
    """``x1 + x2 s + x3 t <= 1 + s t - t^2 / 4`` and ``-x1 <= s`` on the unit square."""
    s, t = index.T
    one, none = np.ones_like(s), np.zeros_like(s)
    G = np.stack([np.stack([one, s, t], axis=1), np.stack([-one, none, none], axis=1)], axis=1)
    return G, np.stack([1.0 + s * t - t**2 / 4, s], axis=1)


def gradient(x, index, which):
    s, t = index.T
    first = np.stack([x[1] - t, x[2] - s + t / 2], axis=1)
    return np.where(which[:, None] == 0, first, [-1.0, 0.0])


def enclosure(x, lower, upper):
    corners = [(s, t) for s in (lower[:, 0], upper[:, 0]) for t in (lower[:, 1], upper[:, 1])]
    first = np.max([x[0] + x[1] * s + x[2] * t - 1.0 - s * t for s, t in corners], axis=0) + upper[:, 1] ** 2 / 4
    return sr.Enclosure(np.maximum(first, -x[0] - lower[:, 0]), np.argmax(upper - lower, axis=1))


def worst(x):
    """Convex in t and linear in s: the worst index is a corner."""
    corners = np.array([[s, t] for s in (0.0, 1.0) for t in (0.0, 1.0)])
    G, h = rows(corners)
    found = G @ x - h
    order = np.argsort(-found, axis=None)
    k, r = np.unravel_index(order, found.shape)
    return sr.Separation(indices=corners[k], rows=r, violations=found[k, r], bound=float(found.max()))


HALVES = (np.array([[0.0, 0.0], [0.5, 0.0]]), np.array([[0.5, 1.0], [1.0, 1.0]]))
FAMILY = sr.ConstraintFamily(
    name="below", index_set=sr.Box(np.zeros(2), np.ones(2)), rows=rows, gradient=gradient, enclosure=enclosure,
    worst=worst, cells=HALVES,
)  # fmt: skip


class Square(sr.ProblemFactory):
    """A right problem, for wrong ones to inherit from."""

    changes: dict = {}  # noqa: RUF012

    def family(self):
        return replace(FAMILY, **{key: getattr(self, key) for key in self.changes})

    def build(self):
        return sr.SemiInfiniteProgram(n=3, q=[-1.0, 0.2, 0.1], lower=-2.0, upper=2.0, families=[self.family()])


class TestSquare(ProblemContract):
    component = Square


ANSWERED = {
    **KNOWN,
    "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
    "initial_state": {"centre": [-0.5, 0.2], "box": [0.02, 0.01]},
    "terminal": [{"box": 1.0}],
    "control_step": {"norm": {"p": 2, "radius": 0.8}},
    "control": {"box": 1.0},
}


class TestAnswered(ProblemContract):
    """A problem whose control answers what it measures."""

    policy = sr.AffinePolicy()

    def create(self):
        return REGISTRY.build("problem", "linear", ANSWERED)


class Answering(sr.ProblemFactory):
    """The program of such a problem, every family with other parts."""

    @staticmethod
    def parts(family):
        return {}

    def build(self):
        problem = REGISTRY.build("problem", "linear", ANSWERED).build()
        pieces = sr.Dictionary.indicators(np.linspace(0.0, 3.0, 4))
        program = sr.transcribe(problem, control=pieces, disturbance=pieces, policy=sr.AffinePolicy())
        return replace(program, families=[replace(one, **self.parts(one)) for one in program.families], twin=None)


def test_families_whose_rows_hold_for_every_deviation_are_looked_at_too():
    def lower(family):
        enclosure = family.enclosure
        return {"enclosure": lambda *q: replace(enclosure(*q), bounds=enclosure(*q).bounds - 1.0)}

    def looser(family):
        uncertain = family.uncertain
        return {"uncertain": lambda index: replace(uncertain(index), h=uncertain(index).h + 1e-3)}

    def careless(family):
        excess = family.excess
        return {"excess": lambda x, indices: excess(x, indices) - 1e-3 * (len(indices) > 1)}

    agree = "test_rows_that_hold_for_every_deviation_are_violated_by_what_the_family_says"
    for parts, test in (
        (lower, "test_an_enclosure_is_never_below_the_violation_and_closes"),
        (looser, agree),
        (careless, agree),
    ):
        error = fails(ProblemContract, type("Wrong", (Answering,), {"parts": staticmethod(parts)}), test)
        assert isinstance(error, ContractBroken)


def flawed(name, **changes):
    """The problem with other parts."""
    return type(name, (Square,), {"family": lambda self: replace(FAMILY, **changes)})


def shifted(**changes):
    """An enclosure or a separation that says something else."""
    return lambda *question: replace(
        (enclosure if len(question) == 3 else worst)(*question), **{k: c(*question) for k, c in changes.items()}
    )


def built(name, build):
    return type(name, (Square,), {"build": build})


SHAPES = "test_rows_have_their_shapes_for_one_index_and_for_many"
SLOPE = "test_a_gradient_is_the_derivative_of_its_row"
WORST = "test_a_separation_names_what_is_violated_most"
ABOVE = "test_an_enclosure_is_never_below_the_violation_and_closes"
COVER, SAME = "test_cells_cover_the_index_set_once", "test_it_is_built_the_same_each_time"
OTHER = "test_other_forms_of_a_family_ask_for_no_more_than_it_does"
SLIPPING = shifted(bounds=lambda x, a, b: enclosure(x, (a + b) / 2, (a + b) / 2).bounds)
WIDE = shifted(bounds=lambda x, a, b: enclosure(x, a, b).bounds + 0.5)
MISSING = shifted(bound=lambda x: worst(x).bound - 0.1)
ASIDE = shifted(indices=lambda x: worst(x).indices + np.array([2.0, 0.0]))
BACKWARDS = shifted(
    indices=lambda x: worst(x).indices[::-1], rows=lambda x: worst(x).rows[::-1],
    violations=lambda x: worst(x).violations[::-1],
)  # fmt: skip


def first_corner(x):
    """Looks at two corners only, and says that it knows nothing better."""
    found = worst(x)
    kept = found.indices[:, 0] == 0.0
    return sr.Separation(found.indices[kept], found.rows[kept], found.violations[kept])


FAULTS = [
    (built("Nothing", lambda self: None), SAME),
    (built("Failing", lambda self: self.horizon), SAME),
    (
        built(
            "Clocked",
            lambda self: sr.SemiInfiniteProgram(n=3, q=[-1.0, 0.2, time.perf_counter()], families=[FAMILY]),
        ),
        SAME,
    ),
    (
        built("Concave", lambda self: sr.SemiInfiniteProgram(n=3, P=-np.eye(3), lower=-1.0, upper=1.0)),
        "test_its_cost_is_convex",
    ),
    (
        built("Lopsided", lambda self: sr.SemiInfiniteProgram(n=2, P=np.array([[1.0, 1.0], [0.0, 1.0]]))),
        "test_its_cost_is_convex",
    ),
    (flawed("Unbatched", rows=lambda t: tuple(part[0] for part in rows(t))), SHAPES),
    (flawed("FirstIndexOnly", rows=lambda t: tuple(np.repeat(part[:1], len(t), axis=0) for part in rows(t))), SHAPES),
    (flawed("Centred", rows=lambda t: rows(t - t.mean(axis=0) + 0.5)), SHAPES),
    (flawed("Numberless", rows=lambda t: (rows(t)[0], rows(t)[1] / t[:, :1] * 0.0)), SHAPES),
    (flawed("Flat", rows=lambda t: (rows(t)[0][:, 0], rows(t)[1][:, 0])), SHAPES),
    (flawed("Endless", index_set=sr.Box(np.zeros(2), np.array([1.0, np.inf]))), SHAPES),
    (flawed("Uphill", gradient=lambda x, t, r: -gradient(x, t, r)), SLOPE),
    (flawed("OtherRow", gradient=lambda x, t, r: gradient(x, t, 1 - r)), SLOPE),
    (flawed("RowsOnly", gradient=lambda x, t, r: np.where(r[:, None] == 0, [x[1], x[2]], [0.0, 0.0])), SLOPE),
    (flawed("OneNumber", gradient=lambda x, t, r: gradient(x, t, r)[:, 0]), SLOPE),
    (flawed("Missing", worst=MISSING), WORST),
    (flawed("Louder", worst=shifted(violations=lambda x: worst(x).violations + 1.0)), WORST),
    (flawed("Aside", worst=ASIDE), WORST),
    (flawed("Backwards", worst=BACKWARDS), WORST),
    (flawed("FirstCorner", worst=first_corner), WORST),
    (flawed("Midpoints", enclosure=SLIPPING), ABOVE),
    (flawed("Wide", enclosure=WIDE), ABOVE),
    (flawed("ThirdCoordinate", enclosure=shifted(split=lambda x, a, b: np.full(len(a), 2))), ABOVE),
    (flawed("OneBound", enclosure=shifted(bounds=lambda x, a, b: enclosure(x, a, b).bounds.max())), ABOVE),
    (flawed("Gap", cells=(HALVES[0], HALVES[1] * [0.9, 1.0])), COVER),
    (flawed("Overlap", cells=(HALVES[0], np.ones((2, 2)))), COVER),
    (flawed("Outside", cells=(HALVES[0] - 0.5, HALVES[1] + 0.5)), COVER),
    (flawed("Stricter", nominal=replace(FAMILY, rows=lambda t: (rows(t)[0], rows(t)[1] - 5.0))), OTHER),
    (
        flawed("Sampling", sample=lambda n, rng: replace(FAMILY, rows=lambda t: (2 * rows(t)[0], rows(t)[1] - 2))),
        OTHER,
    ),
    (flawed("Speechless", explain=lambda index, row: "a constraint"), "test_a_constraint_is_explained_in_words"),
    (flawed("Unprovable", enclosure=None), "test_a_decision_can_be_proven"),
]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(("wrong", "test"), FAULTS, ids=[wrong.__name__ for wrong, _ in FAULTS])
def test_the_contract_catches_a_problem_whose_parts_do_not_agree(wrong, test):
    fails(ProblemContract, wrong, test)


class Branching(sr.ProblemFactory):
    """A control problem whose matrices ask which parameter they got: nothing can be proven of it."""

    def build(self):
        def A(p):
            return np.array([[0.0, 1.0], [-1.0 if float(p[0]) > 0 else -1.1, 0.0]])

        return sr.OptimalControlProblem(
            system=sr.LinearSystem(A, np.array([[0.0], [1.0]]), parameters=sr.Box([-1.0], [1.0])),
            horizon=1.0, initial_state=[0.1, 0.0], control=sr.Box([-1.0], [1.0]), terminal=[sr.Box([-1, -1], [1, 1])],
        )  # fmt: skip


def test_a_control_problem_that_cannot_be_enclosed_is_named():
    fails(ProblemContract, Branching, "test_a_decision_can_be_proven")
