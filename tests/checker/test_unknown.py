"""Guards checker: what it has no means to judge is refused where it stands, by its own sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

import sparserob_core as sr
from sparserob_core.checker.arithmetic.models import kepler_root
from sparserob_core.checker.claims import case, cells, constraints, followed
from sparserob_core.checker.claims.answers import feedback_of
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.cost import effort
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.outcome import Broken, Clock, Unchecked
from sparserob_core.checker.problem import disturbances
from sparserob_core.checker.problem.held import HeldComponents, on_one_grid
from sparserob_core.checker.problem.time_varying import make_time_varying
from sparserob_core.checker.reach import followed as followed_rows
from sparserob_core.checker.sets import flat
from sparserob_core.checker.sets.known import known
from sparserob_core.control.policies import policy
from sparserob_core.control.policies.affine import AffinePolicy
from sparserob_core.control.problem.system import LinearSystem, VaryingSystem
from sparserob_core.control.sets.sets import Box, Cylinder, Equality, NormBall, Polytope
from tests.checker.claims import test_lists
from tests.checker.claims.test_windows import case_of
from tests.support.worst_cases import DIRECTIONS, ENDS, kind

JUST_ABOVE_1 = float(np.nextafter(1.0, 2.0))
FEWER = sr.Dictionary(np.array([0.0, 1.0, 2.0]), np.array([[1.0, -1.0]]))


@pytest.fixture(autouse=True)
def precision() -> Any:
    with ctx.workprec(192):
        yield


def repeating(**more: Any) -> Case:
    """A plan that repeats, of two states of which one has a single initial value."""
    problem = sr.OptimalControlProblem(
        **{
            "system": LinearSystem(-np.eye(2), np.eye(2)),
            "horizon": 2.0,
            "initial_state": [0.0, 0.0],
            "control": Box([-1.0, -1.0], [1.0, 1.0]),
            "repeat": True,
            **more,
        }
    )
    grid = sr.Dictionary.indicators([0.0, 1.0, 2.0])
    return Case(problem, grid, grid, {"decision": np.zeros((2, 2)).tolist(), "repeat": True})


def forced(case: Case, **fields: Any) -> Case:
    """A case whose problem is what no constructor lets pass."""
    problem = replace(case.problem)
    for name, value in fields.items():
        object.__setattr__(problem, name, value)
    made = replace(case)
    object.__setattr__(made, "problem", problem)
    return made


UNSURE = LinearSystem([[0.0]], [[1.0]], parameters=NormBall(2.0, 0.1, dimension=2), names=("p", "q"))


def returning(case: Case) -> object:
    return replace(case, given=None)


def largest_effort(a: arb, limit: float) -> Callable[[], object]:
    return lambda: effort.prove_effort_limit([a], [[arb(0)]], lambda row: arb(0), np.zeros(1), arb(limit), Clock())


def observed() -> object:
    said = {"gains": np.zeros((2, 2, 1, 1)).tolist(), "observer": [[[1.0]]]}
    return feedback_of(case_of(policy=AffinePolicy(), measurements=sr.Measurements([[1.0]]), certificate=said)).observer


LISTS = test_lists.case_of("on own pieces").problem
ROOT = VaryingSystem.of([["1/(1.0000001 - t)"]], [[1]], 1.0)
UNKNOWN: dict[str, tuple[Callable[[], object], type[Exception], str]] = {
    "Kepler's equation of no number": (lambda: kepler_root(arb("nan"), arb(0.3)), Unchecked, "Kepler's equation"),
    "an observer of another shape": (observed, Broken, r"observer: shape \(1, 1, 1\), expected \(2, 1, 1\)"),
    "a flat set of initial states": (
        lambda: returning(
            forced(
                repeating(initial_set=Box([-0.25, 0.0], [0.25, 0.0])),
                initial_set=Polytope([[1, 0], [-1, 0], [0, 1], [0, -1]], [0.25, 0.25, 0.0, 0.0]),
            )
        ),
        Unchecked,
        "of a flat set of initial states, the checker knows boxes only",
    ),
    "no list": (lambda: disturbances._list_factors(Box([-1.0], [1.0])), Unchecked, "lists of sets only"),
    "measurable in a cylinder, in time": (
        lambda: (
            forced(
                test_lists.case_of("in time, measurable"), disturbance=Cylinder(NormBall(3.0, 0.1, dimension=1), 2)
            ).sources.measurable_input
        ),
        Unchecked,
        "measurable disturbances in boxes, polytopes, ellipsoids, balls, zonotopes, and products of",
    ),
    "errors of execution of a policy": (
        lambda: replace(kind("alone").case(execution=np.array([0.1, 0.2])), policy=AffinePolicy()).sources.execution,
        Unchecked,
        "errors of execution without feedback",
    ),
    "parameters in no box beside errors of execution": (
        lambda: make_time_varying(forced(test_lists.case_of("of two classes"), execution=[0.1], system=UNSURE).problem),
        Unchecked,
        "boxes of parameters",
    ),
    "fixed states under two classes": (
        lambda: constraints.compute_residuals(test_lists.case_of("of two classes", terminal=[Equality([0.0, None])])),
        Unchecked,
        "the uncertainty may reach x1",
    ),
    "times that have no middle": (
        lambda: cells._halve_interval((0, 1.0, JUST_ABOVE_1)),
        Unchecked,
        "cannot be halved any more",
    ),
    "a box that has no middle": (
        lambda: cells._halve_box(((1.0, 2.0), (JUST_ABOVE_1, 2.0)), np.ones(2)),
        Unchecked,
        "parameters cannot be halved any more",
    ),
    "an effort that is known roughly": (largest_effort(arb(0, 1), 0.5), Unchecked, "known too roughly"),
    "an effort that is larger": (largest_effort(arb(2), 0.5), Broken, "causes the effort 2.0"),
    "a system that is too fast": (
        lambda: VerifiedFlow(Plant.of(sr.LinearSystem([[-1e9]], [[1.0]]), 1.0), 1.0).marks([0.0, 1.0]),
        Unchecked,
        "too fast for its horizon",
    ),
    "a time before the system begins": (
        lambda: VerifiedFlow(Plant.of(ROOT, 1.0), 1.0).step(-0.5, 0.0),
        Unchecked,
        "not known from -0.5 to 0",
    ),
    "from one polynomial to the next": (
        lambda: VerifiedFlow(Plant.of(ROOT, 1.0), 1.0).step(0.0, 1.0),
        Unchecked,
        "no polynomial from 0.0 to 1.0",
    ),
    "no corners": (lambda: flat._find_intersections(((1.0, 0.0, 1.0),), ()), Unchecked, "has no corners"),
    "too many corners": (
        lambda: flat._find_intersections(tuple((*row, 1.0) for row in np.eye(40)[:, :12].tolist()), ()),
        Unchecked,
        "40 facets in 12 dimensions has too many corners",
    ),
    "the least of nothing": (lambda: flat._find_least([]), Unchecked, "the set of controls has no corners"),
    "a set without chords": (
        lambda: known(Cylinder(NormBall(3.0, 1.0, dimension=2), 3)).chords(np.zeros(3)),
        Unchecked,
        "how long the disturbance's set is along the axes",
    ),
    "few functions on own pieces": (lambda: on_one_grid(LISTS, FEWER), Unchecked, "take any value on each piece"),
    "own pieces of one set": (
        lambda: HeldComponents.of(
            forced(kind("known").case(), disturbance_breakpoints=(ENDS, ENDS)).problem, [0.0, 1.0]
        ),
        Unchecked,
        "with breakpoints of their own, the checker knows lists of sets only",
    ),
}


@pytest.mark.parametrize("what", UNKNOWN)
def test_what_is_not_known_is_refused_by_its_own_sentence(what: str) -> None:
    asked, refusal, sentence = UNKNOWN[what]
    with pytest.raises(refusal, match=sentence):
        asked()


def test_budgets_end_in_no_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(effort, "MAX_PARTS", 0)
    with pytest.raises(Unchecked, match="was not bounded by 1 parts"):
        largest_effort(arb(1), 2.0)()
    monkeypatch.setattr(cells, "MAX_BOXES", 0)
    proof = {"proof": {"path": {"tolerance": 1e-9, "lower": [[0.25]], "upper": [[1.875]]}}}
    wall = sr.PathConstraint(Polytope(DIRECTIONS, np.full(4, 9.0)), 0.25, 1.875)
    case = kind("turning").case(proof, path=[wall])
    with pytest.raises(Unchecked, match="neither shown nor refuted: after 6 cells a violation of more than 1e-09"):
        constraints.bounded(case, case.windows[0])
    monkeypatch.setattr(followed_rows, "FOLLOWED", 2)
    monkeypatch.setattr(followed, "MAX_CELLS", 0)
    case = kind("known").case(proof, path=[wall])
    with pytest.raises(Unchecked, match=r"neither shown nor refuted: after \d+ cells more than"):
        constraints.bounded(case, case.windows[0])


def test_disturbances_with_breakpoints_of_their_own_are_on_one_grid() -> None:
    dictionary = sr.Dictionary.indicators([0.0, 1.5, 2.0])
    own = np.array([0.0, 0.5, 1.0 + 1e-13, 2.0])
    case = test_lists.case_of("on own pieces")
    problem, joint = on_one_grid(forced(case, disturbance_breakpoints=(None, own)).problem, dictionary)
    assert [times.tolist() for times in problem.disturbance_breakpoints] == [[0.0, 1.5, 2.0], own.tolist()]
    assert joint.breakpoints.tolist() == [0.0, 0.5, own[2], 1.5, 2.0]
    both = np.array([0.0, 1.0, 2.0]), own
    problem, joint = on_one_grid(forced(case, disturbance_breakpoints=both).problem, dictionary)
    assert joint.breakpoints.tolist() == [0.0, 0.5, 1.0, 2.0]  # two that differ by rounding are one
    lasting = HeldComponents.of(problem, joint.breakpoints[:-1].tolist())
    assert lasting is not None and [one.tolist() for _, one in lasting.parts] == [[0, 2], [0, 1, 2]]
    assert [columns for columns, _ in lasting.parts] == [slice(0, 1), slice(1, 2)]
    assert HeldComponents.of(kind("known").case().problem, [0.0]) is None


def test_what_so_many_pieces_may_answer_is_no_array(monkeypatch: pytest.MonkeyPatch) -> None:
    """A million pieces, as a config may say in a few bytes, would be a terabyte of truth values."""
    for most in (3, policy.MAX_ANSWERING):
        monkeypatch.setattr(policy, "MAX_ANSWERING", most)
        monkeypatch.setattr(case, "MAX_ANSWERING", most)
        ends = np.arange(most + 2.0)
        with pytest.raises(sr.InputError, match=f"at most {most} pieces of a control that answers, got {most + 1}"):
            policy.answers_of(AffinePolicy(), ends)
        assert not policy.answers_of(policy.OpenLoop(), ends).size
        assert not policy.answers_of(None, ends).size
        said = {"policy": {"cost": "peak", "answers": [[] for _ in ends[1:]]}}
        with pytest.raises(Broken, match=f"expected at most {most}"):
            case.written_policy(said, most + 1)
    monkeypatch.setattr(policy, "MAX_ANSWERING", 3)
    monkeypatch.setattr(case, "MAX_ANSWERING", 3)
    assert policy.answers_of(AffinePolicy(), np.arange(4.0)).shape == (3, 3)
    assert case.written_policy({"policy": {"cost": "peak", "answers": [[], [], [[0, 1]]]}}, 3).mask.sum() == 2
