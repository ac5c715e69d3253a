"""Guards checker/claims/activity and the trees of claims: what a part of the controls counts at least is held against
every control of a fine grid in it, and a tree against every choice of which pieces act."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

import sparserob_core as sr
from sparserob_core.checker.claims import activity, claims
from sparserob_core.checker.claims.activity import ANY
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.control.sets.sets import Box, NormBall, Polytope

OFF, ON = (0.0, 0.0, False), (-np.inf, np.inf, True)
SETS = {
    "box": Box([-1.0, -0.5], [2.0, 0.7]),
    "box that always acts": Box([0.3, -0.5], [2.0, 0.7]),
    "polytope": Polytope([[1.0, 1.0], [-1.0, 0.2], [0.1, -1.0]], [1.0, 0.6, 0.5]),
    "ball": NormBall(2.0, 0.8, dimension=2),
}


@pytest.fixture(autouse=True)
def precision() -> Any:
    with ctx.workprec(96):
        yield


def case_of(control: Any, certificate: Any = None, **more: Any) -> Case:
    m = control.dimension
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(np.zeros((1, 1)), np.ones((1, m))),
        horizon=2.0,
        initial_state=[1.0],
        control=control,
        **{"terminal": [Box([-9.0], [0.2])], **more},
    )
    grid = sr.Dictionary.indicators([0.0, 1.0, 2.0])
    return Case(problem, grid, grid, certificate or {}, counts=True)


def numbers(values: Any) -> list[arb]:
    return [arb(float(v)) for v in values]


@pytest.mark.parametrize("name", SETS)
def test_a_part_counts_what_no_control_in_it_goes_below(name: str) -> None:
    """Of a box exactly the least, of other sets the least where a value counts in proportion to the largest one of its
    sign."""
    rng, shape = np.random.default_rng(7), SETS[name]
    case, box = case_of(shape), shape.bounding_box()
    axes = [np.unique([*np.linspace(a, b, 141), 0.0]) for a, b in zip(box.lower, box.upper, strict=True)]
    grid = np.array([u for u in product(*axes) if (box.lower <= u).all() and (u <= box.upper).all()])
    inside = grid[(shape.violation(grid) if shape.is_box else np.array([shape.violation(u) for u in grid])) <= 1e-12]
    reach = np.where(inside > 0.0, box.upper, np.abs(box.lower))
    for parts in product((ANY, OFF, ON), repeat=2):
        off, on = (np.array([part == kind for part in parts]) for kind in (OFF, ON))
        allowed = (inside[:, off] == 0.0).all(axis=1)
        for number in range(8):
            counts, slope = rng.uniform(0.2, 2.0, 2), rng.normal(size=2) * rng.choice([0.3, 3.0])
            sizes = rng.uniform(0.1, 1.0, 2) * (number % 2)
            bound = activity._bound_piece_in_part(case, parts, numbers(counts), numbers(slope), numbers(sizes))
            if not allowed.any():
                assert bound == arb("inf")
                continue
            whole = ((inside != 0.0) | on) @ counts + inside @ slope + np.abs(inside) @ sizes
            least, found = float(whole[allowed].min()), float(bound.mid())
            assert found <= least + 1e-12
            if shape.is_box:
                assert found == pytest.approx(least)
            else:
                # a value that has to be 0 is as dear as what its slope would bring
                charged = np.abs(inside) * sizes
                costly = np.where(on, counts + charged, np.abs(inside) / reach * counts + charged)
                prices = np.where(off, np.abs(slope * inside), costly)
                shares = prices.sum(axis=1) + inside @ slope
                assert found == pytest.approx(float(shares.min()), abs=0.03 * (counts.sum() + np.abs(slope).sum()))


def test_letters_are_all_that_a_part_of_an_alphabet_offers() -> None:
    case = replace(case_of(Box([-2.0], [2.0])), letters=(-2.0, -0.5, 0.0, 1.0, 2.0))
    for part, letters in (((-2.0, -0.5, False), [-2.0, -0.5]), ((0.0, 1.0, False), [0.0, 1.0]), (ANY, case.letters)):
        assert activity._list_candidate_values(case, part, -2.0, 2.0) == list(letters or ())
        for slope in (-0.7, 0.1, 3.0):
            found = activity._bound_piece_in_part(case, [part], numbers([1.0]), numbers([slope]), numbers([0.25]))
            assert float(found.mid()) == min((v != 0.0) + slope * v + 0.25 * abs(v) for v in letters or ())
    node = {"channel": 0, "piece": 1, "at": [-0.5, 0.0]}
    low, high = activity._divide_part(case, node, {(0, 1): (-2.0, 1.0, False)})
    assert low == {(0, 1): (-2.0, -0.5, False)} and high == {(0, 1): (0.0, 1.0, False)}
    for at in ([-0.5, 1.0], [0.0, 0.0], [1.0, 0.0], [0.0, 0.5], [0.0], None):
        with pytest.raises(Broken, match="tree"):
            activity._divide_part(case, {**node, "at": at}, {})


def written(nodes: list[Any], **more: Any) -> dict[str, Any]:
    wall = {"constraint": "terminal", "time": 2.0, "direction": [1.0], "parameter": []}
    return {"tree": {"constraints": [wall], "nodes": nodes}, **more}


SPLIT = {"channel": 0, "piece": 0, "first": 1, "second": 2}
NOT_ONE = {"multipliers": [[0, 1.0]], "equalities": [], "feasible": False}  # without piece 0 no control is admissible
BOTH = {"multipliers": [[0, 1.0]], "equalities": []}


def test_a_tree_proves_that_both_pieces_act_where_one_alone_does_not_bring_the_state_down() -> None:
    """From 1 to -0.5 by controls of 1: piece 0 alone is too little, and so is piece 1."""
    down = {"terminal": [Box([-9.0], [-0.5])]}
    tree = written([SPLIT, NOT_ONE, BOTH], lower_bound=2.0)
    assert claims._bound_by_tree(case_of(Box([-1.0], [1.0]), tree, **down)) == 2.0
    assert "acts for less than 2" in claims._verify_lower_bound(case_of(Box([-1.0], [1.0]), tree, **down))
    with pytest.raises(Broken, match="the leaves prove"):
        claims._verify_lower_bound(case_of(Box([-1.0], [1.0]), {**tree, "lower_bound": 2.0 + 1e-6}, **down))
    # where 0.8 is enough, the leaf that says that nothing is feasible without piece 0 is wrong
    with pytest.raises(Broken, match="multipliers of a part prove"):
        claims._bound_by_tree(case_of(Box([-1.0], [1.0]), tree))
    plain = {**NOT_ONE, "feasible": True}
    assert claims._bound_by_tree(case_of(Box([-1.0], [1.0]), written([SPLIT, plain, BOTH]))) == 1.0
    # more than two pieces can bring: every part is empty
    none = written([SPLIT, NOT_ONE, NOT_ONE])
    assert "excluded" in claims._verify_infeasibility(case_of(Box([-1.0], [1.0]), none, terminal=[Box([-9.0], [-1.1])]))
    with pytest.raises(Broken):
        claims._verify_infeasibility(case_of(Box([-1.0], [1.0]), none, **down))
    with pytest.raises(Broken, match="leave some control"):
        claims._verify_infeasibility(case_of(Box([-1.0], [1.0]), tree, **down))


@pytest.mark.parametrize(
    "nodes",
    [
        [],
        [None],
        [{**SPLIT, "second": 1}, NOT_ONE, BOTH],
        [{**SPLIT, "second": 0}, NOT_ONE, BOTH],
        [{**SPLIT, "second": 3}, NOT_ONE, BOTH],
        [{**SPLIT, "second": -1}, NOT_ONE, BOTH],
        [{**SPLIT, "first": True}, NOT_ONE, BOTH],
        [{**SPLIT, "channel": 1}, NOT_ONE, BOTH],
        [{**SPLIT, "channel": -1}, NOT_ONE, BOTH],
        [{**SPLIT, "piece": 2}, NOT_ONE, BOTH],
        [{**SPLIT, "piece": -1}, NOT_ONE, BOTH],
        [{**SPLIT, "piece": 0.0}, NOT_ONE, BOTH],
        [SPLIT, {**NOT_ONE, "multipliers": [[0, -1.0]]}, BOTH],
        [SPLIT, {**NOT_ONE, "multipliers": [[0, 0.0]]}, BOTH],
        [SPLIT, {**NOT_ONE, "multipliers": [[1, 1.0]]}, BOTH],
        [SPLIT, {**NOT_ONE, "multipliers": [[-1, 1.0]]}, BOTH],
        [SPLIT, {**NOT_ONE, "multipliers": [[0]]}, BOTH],
        [SPLIT, {**NOT_ONE, "multipliers": [[True, 1.0]]}, BOTH],
        [SPLIT, {**NOT_ONE, "equalities": [1.0]}, BOTH],
        [SPLIT, {**NOT_ONE, "multipliers": []}, BOTH],
    ],
)
def test_what_is_no_tree_of_parts_proves_nothing(nodes: list[Any]) -> None:
    with pytest.raises(Broken):
        claims._bound_by_tree(case_of(Box([-1.0], [1.0]), written(nodes), terminal=[Box([-9.0], [-0.5])]))


def test_a_tree_is_asked_for_where_time_counts_and_letters_are_kept_to() -> None:
    with pytest.raises(Unchecked, match="no tree"):
        claims._verify_lower_bound(case_of(Box([-1.0], [1.0]), {"lower_bound": 1.0}))
    said = {"decision": [[-1.0, 0.0]], "cost": 1.0, "J": 1.0}
    case = case_of(Box([-1.0], [1.0]), said)
    assert claims._verify_cost(case).startswith("it acts for 1 of 2, J = 1")
    assert claims._verify_cost(replace(case, letters=(-1.0, 0.0)))
    with pytest.raises(Broken, match="other values"):
        claims._verify_cost(replace(case, letters=(-0.5, 0.0)))
    for wrong in ({"cost": 2.0}, {"cost": 1.0 + 1e-6}, {"J": 0.9}):
        with pytest.raises(Broken):
            claims._verify_cost(replace(case, certificate={**said, **wrong}))


def test_what_counts_alike_is_rounded_up_to_whole_pieces_and_what_does_not_is_a_share() -> None:
    """Two channels on two pieces of one length: four that count alike."""
    case = case_of(SETS["box"])
    one = activity.longest_time(case) / 4.0
    for count, pieces in ((-1.0, 0), (0.3, 1), (1.0 + 1e-3, 2), (2.0, 2), (2.0 - 1e-9, 2), (3.9, 4), (4.7, 4)):
        assert activity._bound_active_share(case, arb(count * one)) == pieces / 4.0
    apart = case_of(SETS["box"], weights=[1.0, 3.0])
    most = activity.longest_time(apart)
    for share in (-0.5, 0.0, 0.3, 0.9):
        found = activity._bound_active_share(apart, arb(share * most))
        assert max(0.0, share) - 1e-12 <= found <= max(0.0, share)


def test_the_share_of_time_that_a_control_acts_is_what_the_leaves_prove_and_no_more_than_one_does() -> None:
    down = {"terminal": [Box([-9.0], [-0.5])]}

    def fewest(status: str = "verified", last: float = -0.75, **said: Any) -> str:
        told = {"lower": 1.0, "upper": 1.0, **said}
        more = {"fewest_active": told, "decision": [[-0.75, last]], "status": status, "multipliers": None}
        return claims._verify_fewest_active(
            case_of(Box([-1.0], [1.0]), written([SPLIT, NOT_ONE, BOTH], **more), **down), status
        )

    assert fewest() == "every admissible control acts at least 100.0% of the time"
    assert "at least 50.0%" in fewest(lower=0.5)
    assert "at least 100.0%" in fewest("refuted", upper=None)
    wrongs: list[tuple[dict[str, Any], str]] = [
        ({"lower": 1.0 + 1e-6}, "lower is 1.000001, the leaves prove 1.0"),
        ({"lower": -0.1}, "lower is -0.1"),
        ({"upper": None}, "upper is None where the status is verified"),
        ({"upper": 0.5}, "upper is 0.5, the control acts for a share of 1.0"),
        ({"last": 0.0, "upper": 0.5}, "lower is 1.0"),  # that one acts less than is proven
    ]
    for wrong, sentence in wrongs:
        with pytest.raises(Broken, match=sentence):
            fewest(**wrong)
    with pytest.raises(Broken, match=r"upper is 1\.0 where the status is refuted"):
        fewest("refuted")
