"""Guards checker/claims of controls that answer nothing: figures by hand, and what is a little beyond them refused.

``x' = u``, ``x(0) = 1``, two pieces of length 1, ``u = (-0.75, 0.25)``: steps of -0.75 (from 0) and 1, the cost is 1.
"""

from __future__ import annotations

import numpy as np
import pytest
from flint import arb, ctx

import sparserob_core as sr
from sparserob_core.checker.claims import activity, claims, constraints, replay
from sparserob_core.checker.claims import multipliers as bounds
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.outcome import FIGURES, Broken, Unchecked
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.sets.sets import Box, Equality, NormBall

TOO_MUCH, NOTHING = 5e-9, 3e-10


def box(size):
    return Box([-size], [size])


def case_of(control=1.0, decision=((-0.75, 0.25),), certificate=None, counts=False, letters=None, **more):
    decision = np.array(decision)
    m = len(decision)
    problem = sr.OptimalControlProblem(
        **{
            "system": LinearSystem(np.zeros((m, m)), np.eye(m)),
            "horizon": 2.0,
            "initial_state": np.ones(m),
            "control": box(control) if isinstance(control, float) else control,
            **more,
        }
    )
    grid = sr.Dictionary.indicators([0.0, 1.0, 2.0])
    said = {"decision": decision.tolist(), "status": "verified", **(certificate or {})}
    return Case(problem, grid, grid, said, counts=counts, letters=letters)


@pytest.fixture(autouse=True)
def precision():
    with ctx.workprec(96):
        yield


def test_the_control_and_its_steps_are_as_large_as_they_are():
    for size, kept in ((0.75 / (1 + NOTHING), True), (0.75 / (1 + TOO_MUCH), False), (0.7, False)):
        case = case_of(size)
        if kept:
            assert "2 pieces" in claims._verify_control(case)
        else:
            with pytest.raises(Broken, match="from t = 0"):
                claims._verify_control(case)
    for before in (None, [0.0]):
        for size, kept in ((1.0 / (1 + NOTHING), True), (1.0 / (1 + TOO_MUCH), False)):
            case = case_of(control_step=box(size), initial_control=before)
            if kept:
                assert f"{1 if before is None else 2} steps" in claims._verify_steps(case)
            else:
                with pytest.raises(Broken, match="t = 1"):
                    claims._verify_steps(case)
    # the first step is one where it is known what was before
    assert "1 steps" in claims._verify_steps(case_of(control_step=Box([-0.5], [1.0])))
    with pytest.raises(Broken, match="t = 0"):
        claims._verify_steps(case_of(control_step=Box([-0.5], [1.0]), initial_control=[0.0]))
    with pytest.raises(Broken, match="the change of the control leaves"):
        claims._verify_steps(case_of(control_step=NormBall(2.0, 0.9, dimension=2), decision=((-0.75, 0.25), (0.0, 0.0)),
                                control=Box([-1.0] * 2, [1.0] * 2)))  # fmt: skip


def test_a_cost_agrees_to_eleven_digits():
    for written, agrees in (
        (1.0, True),
        (1.0 + 3e-12, True),
        (1.0 + 1e-10, False),
        (1.0 - 1e-10, False),
        (-1.0, False),
    ):
        case = case_of(certificate={"cost": written})
        if agrees:
            assert claims._verify_cost(case) == "J = 1"
        else:
            with pytest.raises(Broken, match="cost"):
                claims._verify_cost(case)
    with pytest.raises(Broken):
        claims._require_agreement("a", 1e-13, arb(0), 1e-3)
    claims._require_agreement("a", 1e-15, arb(0), 1e-3)


def test_a_cost_whose_terms_cancel_agrees_to_the_rounding_of_its_terms():
    """``x' = u`` from 1 to 0 under ``(-1, 0)`` costs ``x(2)^2 = 1 - 2 + 1``: to 1e-14 of these 4, and no further."""
    for off, agrees in ((3e-16, True), (-1e-14, True), (1e-13, False), (-1e-13, False)):
        cost = sr.Cost(l1=0.0, final={"Q": [[1.0]]})
        plant = {"system": LinearSystem(np.zeros((1, 1)), np.ones((1, 1))), "disturbance": None, "cost": cost}
        case = case_of(decision=((-1.0, 0.0),), certificate={"cost": off}, **plant)
        if agrees:
            assert claims._verify_cost(case) == "J = 0"
        else:
            with pytest.raises(Broken, match="cost"):
                claims._verify_cost(case)


def test_a_cost_that_cancels_within_one_matrix_agrees_to_the_rounding_of_its_products():
    """``(u_1 - u_2)^2 + 2^-30 u_2^2`` of equal controls, integrated: what is left of products that add up to 1.25. To
    1e-14 of these a cost may be written, but where it is written lower the gap is that of the cost there is."""
    cost, R = 0.3125 * 2.0**-30, [[1.0, -1.0], [-1.0, 1.0 + 2.0**-30]]
    plant = {
        "control": Box([-1.0] * 2, [1.0] * 2),
        "cost": sr.Cost(l1=0.0, control={"R": R}),
        "decision": ((-0.5, -0.25), (-0.5, -0.25)),
    }
    for off, agrees in ((0.0, True), (1e-14, True), (-1e-14, True), (3e-14, False), (-3e-14, False)):
        said = {"cost": cost + off, "lower_bound": cost + off, "gap_tolerance": 1e-6, "status": "certified"}
        case = case_of(certificate=said, **plant)
        if agrees:
            assert claims._verify_cost(case).startswith("J = 2.91038304")
        else:
            with pytest.raises(Broken, match="cost"):
                claims._verify_cost(case)
        if off < 0.0:
            with pytest.raises(Broken, match="certified, but the gap is"):
                claims._verify_status(case, "certified", 1e-6, [])
        else:
            assert "within 0.00e+00" in claims._verify_status(case, "certified", 1e-6, [])


def entry(y=1.0, **more):
    said = {"constraint": "terminal", "time": 2.0, "direction": [1.0], "parameter": [], "multiplier": y}
    return {**said, **more}


def multipliers(*entries, equalities=(), pieces=None):
    return {"multipliers": {"constraints": list(entries), "equalities": list(equalities), "pieces": pieces}}


def lower(written, *entries, **more):
    return claims._verify_lower_bound(case_of(certificate={"lower_bound": written, **multipliers(*entries)}, **more))


def test_a_lower_bound_is_what_its_multipliers_prove_and_no_more():
    """``x(2) = 1 + u_0 + u_1 <= 0.5`` asks for a cost of 0.5."""
    end = {"terminal": [box(0.5)]}
    assert "no control costs less than 0.5" in lower(0.5, entry(), **end)
    assert "prove 0.5" in lower(0.4, entry(), **end)
    assert "no term of the cost is negative" in lower(0.0, **end)
    for written, y in ((0.5 + 1e-12, 1.0), (0.5, 0.99), (0.5, 1.01)):
        with pytest.raises(Broken):
            lower(written, entry(y), **end)
    for wrong in (
        {"multiplier": 0.0},
        {"multiplier": -1e-9},
        {"time": 1.0},
        {"time": 2.0 + 1e-12},
        {"direction": [1.0, 0.0]},
        {"direction": [0.5]},
        {"parameter": [0.0]},
        {"constraint": "nobody"},
    ):
        if wrong == {"direction": [0.5]}:  # a multiple of a normal is the row, half of it
            assert lower(0.25, entry(**wrong), **end)
            continue
        with pytest.raises(Broken):
            lower(0.1, entry(**wrong), **end)
    for wrong in ("nothing", None, 3):
        with pytest.raises(Broken):
            lower(0.1, wrong, **end)
    with pytest.raises(Unchecked):
        claims._verify_lower_bound(case_of(certificate={"lower_bound": 0.1}, **end))
    with pytest.raises(Broken):
        claims._verify_lower_bound(case_of(certificate={"lower_bound": 0.1, "multipliers": 3}, **end))


def test_multipliers_of_fixed_states_of_steps_and_of_the_control_are_rows_too():
    fixed = {"terminal": [Equality([0.5])]}
    said = {"lower_bound": 0.5, **multipliers(equalities=[1.0])}
    assert "0.5" in claims._verify_lower_bound(case_of(certificate=said, **fixed))
    for wrong in ([], [1.0, 0.0], [-1.0]):
        with pytest.raises(Broken):
            claims._verify_lower_bound(
                case_of(certificate={"lower_bound": 0.1, **multipliers(equalities=wrong)}, **fixed)
            )
    # |u| <= 0.2 a piece does not reach it: the sum of rows is above 0 whatever the control
    weak = case_of(0.2, certificate=multipliers(equalities=[1.0]), **fixed)
    assert float(bounds.multiplied(weak, priced=False).mid()) == pytest.approx(0.5 - 0.4)
    step = entry(0.5, constraint="control_step", time=1.0)
    case = case_of(certificate=multipliers(step, equalities=[1.0]), control_step=box(0.1), **fixed)
    # slopes 1 - 1/2 and 1 + 1/2 against the weight 1 with |u| <= 1
    assert float(bounds.multiplied(case, priced=True).mid()) == pytest.approx(0.5 - 0.05 - 0.5)
    own = entry(0.5, constraint="control", time=0.0, direction=[-1.0])
    case = case_of(0.2, certificate=multipliers(own, equalities=[1.0]), **fixed)
    # the row of the control adds -u_0 - 0.2 <= 0, half of it
    assert float(bounds.multiplied(case, priced=False).mid()) == pytest.approx(0.5 - 0.1 - 0.1 - 0.2)
    for wrong in (step, own):
        with pytest.raises(Broken):
            bad = multipliers({**wrong, "direction": [1.0, 0.0]}, equalities=[1.0])
            bounds.multiplied(case_of(certificate=bad, control_step=box(0.1), **fixed), priced=True)


def test_a_final_state_is_met_to_rounding():
    for goal, met in ((0.5, True), (0.5 + 1e-8, False), (0.5 - 1e-8, False)):
        case = case_of(terminal=[Equality([goal])])
        if met:
            assert "kept to" in constraints.equalities(case)
        else:
            with pytest.raises(Broken, match="x1 is missed"):
                constraints.equalities(case)
    for begun in ({"initial_set": box(1e-3)}, {"disturbance": box(1e-3)}):
        E = (
            {"system": LinearSystem(np.zeros((1, 1)), np.ones((1, 1)), E=np.ones((1, 1)))}
            if "disturbance" in begun
            else {}
        )
        with pytest.raises(Unchecked, match="may reach x1"):
            constraints.equalities(case_of(terminal=[Equality([0.5])], **begun, **E))


def test_what_fixed_states_miss_is_told_with_the_rounding_of_the_largest(monkeypatch):
    case = case_of(terminal=[Equality([0.5])])
    said = {"constraint": replay.EQUALS, "time": 2.0, "violation": 3.0}
    monkeypatch.setattr(replay, "compute_residuals", lambda case: [(arb(3), 2.0), (arb(-1), 64.0), (arb(2), 0.5)])
    assert replay.exceeded(case, said) == ([3.0, -1.0, 2.0], 64.0 * replay.TOLERANCE)


def tree(*nodes, constraints=()):
    return {"tree": {"nodes": list(nodes), "constraints": list(constraints)}}


def split(piece, first, second, **more):
    return {"channel": 0, "piece": piece, "first": first, "second": second, **more}


def leaf(*pairs, feasible=True):
    return {"multipliers": [list(pair) for pair in pairs], "feasible": feasible, "equalities": []}


END = {"terminal": [Box([-9.0], [-0.2])], "counts": True}
"""``1 + u_0 + u_1 <= -0.2`` with ``|u| <= 1``: both pieces must act."""
TREE = (split(0, 1, 2), leaf((0, 1.0), feasible=False), split(1, 3, 4), leaf((0, 1.0), feasible=False), leaf())
ROWS = (entry(),)


def test_the_leaves_of_a_tree_prove_how_long_a_control_acts():
    assert claims._bound_by_tree(case_of(certificate=tree(*TREE, constraints=ROWS), **END)) == 2.0
    # without the division: 1.2 by the slope, rounded up to whole pieces
    once = tree(leaf((0, 1.0)), constraints=ROWS)
    assert claims._bound_by_tree(case_of(certificate=once, **END)) == 2.0
    loose = {"terminal": [Box([-9.0], [0.2])], "counts": True}
    assert claims._bound_by_tree(case_of(certificate=once, **loose)) == 1.0
    assert activity.longest_time(case_of()) == 2.0
    weighted = case_of(certificate=once, weights=[3.0], **loose)
    assert claims._bound_by_tree(weighted) == 3.0
    assert activity.longest_time(weighted) == 6.0
    written = {"lower_bound": 2.0, **tree(*TREE, constraints=ROWS)}
    assert "acts for less than 2" in claims._verify_lower_bound(case_of(certificate=written, **END))
    with pytest.raises(Broken):
        claims._verify_lower_bound(case_of(certificate={**written, "lower_bound": 2.0 + 1e-9}, **END))


@pytest.mark.parametrize(
    "nodes",
    [
        (split(0, 1, 1), leaf()),  # the same half twice
        (split(0, 0, 1), leaf()),
        (split(0, 1, 7), leaf()),
        (split(0, 1, -1), leaf()),
        (split(2, 1, 2), leaf(), leaf()),
        (split(-1, 1, 2), leaf(), leaf()),
        (split(0.0, 1, 2), leaf(), leaf()),
        (split(0, "1", 2), leaf(), leaf()),
        ({**split(0, 1, 2), "channel": 1}, leaf(), leaf()),
        ({**split(0, 1, 2), "channel": True}, leaf(), leaf()),
        (leaf((0, 1.0), feasible=False),),  # something is feasible there
        (leaf((1, 1.0)),),
        (leaf((-1, 1.0)),),
        (leaf((0.0, 1.0)),),
        (leaf((0, -1.0)),),
        (split(0, 1, 2), leaf(feasible=False), leaf()),
        ("nothing",),
        (),
    ],
)
def test_a_tree_that_leaves_something_out_proves_nothing(nodes):
    with pytest.raises(Broken):
        claims._bound_by_tree(
            case_of(certificate=tree(*nodes, constraints=ROWS), terminal=[Box([-9.0], [0.2])], counts=True)
        )


def test_letters_are_divided_between_neighbours_only():
    end = {"terminal": [Box([-9.0], [0.2])], "counts": True, "letters": (-1.0, 0.0, 0.5), "decision": ((-1.0, 0.0),)}
    nodes = (split(0, 1, 2, at=[-1.0, 0.0]), leaf((0, 1.0)), leaf((0, 1.0)))
    assert claims._bound_by_tree(case_of(certificate=tree(*nodes, constraints=ROWS), **end)) == 1.0
    for at in ([-1.0, 0.5], [0.0, -1.0], [0.0, 0.25], [0.0], None, [0.0, 0.0]):
        with pytest.raises(Broken):
            bad = (split(0, 1, 2, at=at), leaf(), leaf())
            claims._bound_by_tree(case_of(certificate=tree(*bad, constraints=ROWS), **end))
    # the half from 0 up cannot come down: infeasible for the one piece if the other is from 0 up as well
    up = (
        split(0, 1, 2, at=[-1.0, 0.0]),
        leaf((0, 1.0)),
        split(1, 3, 4, at=[-1.0, 0.0]),
        leaf((0, 1.0)),
        leaf((0, 1.0), feasible=False),
    )
    assert claims._bound_by_tree(case_of(certificate=tree(*up, constraints=ROWS), **end)) == 1.0
    with pytest.raises(Broken):
        case = case_of(certificate={"cost": 1.0, "J": 1.0}, **{**end, "decision": ((-0.75, 0.0),)})
        claims._verify_active_time(case)
    counted = case_of(certificate={"cost": 1.0, "J": 1.0}, **end)
    assert claims._verify_active_time(counted).startswith("it acts for 1 of 2, J = 1")
    for wrong in ({"cost": 2.0, "J": 1.0}, {"cost": 1.0, "J": 1.1}):
        with pytest.raises(Broken):
            claims._verify_active_time(case_of(certificate=wrong, **end))


def test_the_share_of_time_that_a_control_acts_is_that_of_what_is_not_dust():
    assert activity.active_share(case_of()) == 1.0
    assert activity.active_share(case_of(decision=((-0.75, 0.0),))) == 0.5
    two = {"control": Box([-1.0] * 2, [1.0] * 2), "decision": ((-0.75, 0.0), (0.0, 0.0))}
    assert activity.active_share(case_of(**two)) == 0.25
    assert activity.active_share(case_of(**two, weights=[3.0, 1.0])) == 0.375
    case = case_of(Box([-1.0], [2.0]), terminal=[Box([-9.0], [0.2])])
    rows = bounds.rows_of(case, entry())
    assert activity.bound_by_multipliers(case, rows, None) == 0.5  # 0.8, rounded up to one piece of two
    assert activity.bound_by_multipliers(case, [(0.5, rows[0][1])], None) == 0.5
    assert activity.bound_by_multipliers(case, [], None) == 0.0
    assert activity.bound_by_cost(case, arb(0.8)) == 0.5  # at most 2 a piece
    assert activity.bound_by_cost(case, arb(2.1)) == 1.0
    # where 0 is outside, a piece always counts
    always = case_of(Box([0.25], [1.0]), decision=((0.5, 0.5),))
    assert activity.bound_by_multipliers(always, [], None) == 1.0
    # beside another channel that need not act: half of all, and nothing for the values that it must have
    half = case_of(Box([0.25, -1.0], [1.0, 1.0]), decision=((0.5, 0.5), (0.0, 0.0)))
    assert activity.bound_by_multipliers(half, [], None) == 0.5
    below = case_of(Box([-1.0, -1.0], [-0.25, 1.0]), decision=((-0.5, -0.5), (0.0, 0.0)))
    assert activity.bound_by_multipliers(below, [], None) == 0.5
    scaled = activity.convert_multipliers(case, rows, None)[0][0]
    assert scaled[0] == pytest.approx(0.5)


def test_how_little_a_control_may_act_is_between_what_multipliers_prove_and_what_one_does():
    """``x(2) = 1 + u_0 + u_1 <= 0.25`` with ``|u| <= 1`` asks for one piece of two at least."""
    own = {"constraints": [entry(1.0)], "equalities": []}
    end = {"terminal": [Box([-9.0], [0.25])]}

    def fewest(status="verified", own_decision=((-0.75, 0.0),), **said):
        data = {"lower": 0.5, "upper": 0.5, "multipliers": own, **said}
        more = {"fewest_active": data, "status": status, "multipliers": own}
        return claims._verify_fewest_active(case_of(decision=own_decision, certificate=more, **end), status)

    assert "at least 50.0% of the time, this one 50.0%" in fewest()
    assert "at least 25.0%" in fewest(lower=0.25)
    assert "at least 50.0%" in fewest("certified", multipliers=None)
    assert "this one 100.0%" in fewest(own_decision=((-0.5, -0.25),), upper=1.0)
    for status in ("refuted", "undecided"):
        assert fewest(status, upper=None).endswith("of the time")
    for status, wrong in (
        ("verified", {"lower": 0.5 + 1e-6}),
        ("verified", {"lower": -1e-6}),
        ("verified", {"upper": 0.5 + 1e-6}),
        ("verified", {"upper": 0.5 - 1e-6}),
        ("verified", {"upper": None}),
        ("certified", {"upper": None}),
        ("refuted", {}),
        ("undecided", {}),
        ("refuted", {"upper": None, "lower": 0.75}),
        ("verified", {"multipliers": {"constraints": [], "equalities": []}}),
    ):
        with pytest.raises(Broken):
            fewest(status, **wrong)
    # another control that acts less, which must be admissible too
    end_of = {"terminal": {"tolerance": 1e-9, "lower": [[2.0]], "upper": [[2.0]]}}
    idle = {"decision": [[-0.75, 0.0]], "proof": end_of}
    assert "another one 50.0%" in fewest(own_decision=((-0.5, -0.25),), **idle)
    for wrong in ([[-0.7, 0.0]], [[-1.1, 0.0]]):
        with pytest.raises(Broken):
            fewest(own_decision=((-0.5, -0.25),), **{**idle, "decision": wrong})
    with pytest.raises(Broken, match="expected lower"):
        claims._verify_fewest_active(case_of(certificate={"fewest_active": 3}, **end), "verified")


def test_every_claim_of_a_certificate_has_a_verdict():
    end = {"terminal": {"tolerance": 1e-9, "lower": [[2.0]], "upper": [[2.0]]}}
    honest = {
        "format": 1, "status": "certified", "cost": 0.75, "lower_bound": 0.75, "gap_tolerance": 1e-6, "proof": end,
        "multipliers": {"constraints": [entry(1.0)], "equalities": []},
    }  # fmt: skip

    def verdicts(gap=1e-6, **said):
        case = case_of(decision=((-0.75, 0.0),), certificate={**honest, **said}, terminal=[Box([-9.0], [0.25])])
        return {one.name: one.verdict for one in claims.check(case, gap)}

    assert verdicts() == dict.fromkeys(["control", "cost", "lower bound", "terminal", "status"], "holds")
    for wrong in ({"format": 2}, {"format": True}, {"format": "1"}, {"format": None}):
        assert verdicts(**wrong) == {"certificate": "fails"}
    for status in ("proven", None, 1):
        assert verdicts(status=status) == {"status": "fails"}
    assert verdicts(gap=1e-7)["status"] == "fails"
    assert verdicts(cost=0.7)["cost"] == "fails"
    assert verdicts(decision=[[-0.7, 0.0]], cost=0.7)["terminal"] == "fails"
    assert verdicts(decision=[[-1.1, 0.0]], cost=1.1)["control"] == "fails"
    assert verdicts(lower_bound=0.76)["lower bound"] == "fails"
    assert verdicts(lower_bound=0.5)["status"] == "fails"
    assert verdicts(status="infeasible") == {"infeasibility": "fails"}
    assert verdicts(status="refuted")["violation"] == "not checked"
    assert verdicts(repeat=True)["repeat"] == "fails"


def test_a_figure_agrees_to_a_share_of_its_own_size_whatever_its_sign():
    for sign in (1.0, -1.0):
        claims._require_agreement("cost", sign * 1000.0 * (1.0 + 0.9 * FIGURES), arb(sign * 1000.0), 1.0)
        claims._require_agreement("cost", sign * 1000.0 * (1.0 - 0.9 * FIGURES), arb(sign * 1000.0), 1.0)
        claims._require_agreement("cost", 1.9 * FIGURES * sign, arb(0.0), 2.0)
        for wrong, size in (
            (1000.0 * (1.0 + 1.1 * FIGURES), 1000.0),
            (1000.0 * (1.0 - 1.1 * FIGURES), 1000.0),
        ):
            with pytest.raises(Broken, match="is written"):
                claims._require_agreement("cost", sign * wrong, arb(sign * size), 1.0)
        with pytest.raises(Broken, match="cost"):
            claims._require_agreement("cost", 2.1 * FIGURES * sign, arb(0.0), 2.0)
