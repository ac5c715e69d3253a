"""Guards lists of disturbances (control/problem/disturbances): together they are one disturbance in the product of
their sets, whatever their class, with values by hand."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.sets.sets import Product

FOUR = {"name": "piecewise_constant", "pieces": 4}
KINDS = ["piecewise_constant", "measurable"]
CART = {
    "name": "linear", "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]}, "horizon": 2.0, "initial_state": [1.0, 0.0],
    "control": {"box": 2.0}, "path": [{"box": [1.15, None]}], "terminal": [{"box": [0.4, 0.4]}],
}  # fmt: skip


def listed(*sets, kind="piecewise_constant"):
    """A box, and how it enters, each."""
    return [{"set": one, "E": E, "class": kind} for one, E in sets]


def config(disturbance, system=None, policy="open_loop", **more):
    problem = {**CART, "disturbance": disturbance, **more, "system": {**CART["system"], **(system or {})}}
    pieces = {"control": {"name": "piecewise_constant", "pieces": 3}}
    return {"problem": problem, "dictionaries": pieces, "policy": policy, "observers": []}


def ran(place, *given, **more):
    return sr.run(config(*given, **more), out=place, quiet=True, figures=False)


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("kind", "policy"),
    [
        ("piecewise_constant", "open_loop"),
        ("piecewise_constant", "affine"),
        ("measurable", "open_loop"),
    ],
)
def test_a_list_of_boxes_is_one_box(tmp_path, kind, policy):
    two = listed(({"box": 0.05}, [[1], [0.5]]), ({"box": [[-0.04, 0.02]]}, [[0], [2]]), kind=kind)
    one = {"box": {"lower": [-0.05, -0.04], "upper": [0.05, 0.02]}}
    two[1]["set"] = {"box": {"lower": [-0.04], "upper": [0.02]}}
    many = ran(tmp_path / "many", two, policy=policy)
    single = ran(tmp_path / "one", one, {"E": [[1, 0], [0.5, 2]]}, policy, disturbance_class=kind)
    assert many.result.status == single.result.status == "certified"
    assert many.result.cost == pytest.approx(single.result.cost, rel=1e-7)
    assert sr.check(many.directory).status == "verified"


def integrator(*disturbances, **more):
    """``x' = u + noise`` from 1 to at most 0.4 within 2, ``|u| <= 1``: what the disturbances push is paid for."""
    return sr.OptimalControlProblem(
        **{
            "system": sr.LinearSystem([[0.0]], [[1.0]]),
            "horizon": 2.0,
            "initial_state": [1.0],
            "control": sr.Box([-1.0], [1.0]),
            "terminal": [sr.Box([-9.0], [0.4])],
            "disturbances": list(disturbances),
            **more,
        }
    )


BALL = sr.NormBall(2.0, 0.05, dimension=2)
SMALL = sr.Box([-0.1], [0.1])


@pytest.mark.parametrize("other", KINDS)
@pytest.mark.parametrize("kind", KINDS)
def test_what_disturbances_push_adds_up(kind, other):
    """``0.6 + 2 (0.05 |(3, 4)| + 2 * 0.1)``."""
    problem = integrator(sr.Disturbance(BALL, [[3.0, 4.0]], kind), sr.Disturbance(SMALL, [[2.0]], other))
    result = sr.solve(problem, control=FOUR)
    assert isinstance(problem.disturbance, Product) and problem.system.disturbances == 3
    assert result.status == "certified"
    assert result.cost == pytest.approx(0.6 + 2 * (0.25 + 0.2), rel=1e-6)


def test_a_run_of_curved_sets_is_saved_and_checked(tmp_path):
    problem = integrator(sr.Disturbance(BALL, [[3.0, 4.0]]), sr.Disturbance(SMALL))
    result = sr.solve(problem, control=FOUR)
    directory = result.save(tmp_path / "run", figures=False)
    assert sr.check(directory).status == "verified"
    assert result.cost == pytest.approx(0.6 + 2 * (0.25 + 0.1), rel=1e-6)
    drawn = sr.simulate(directory, trajectories=20)
    assert drawn is not None


def test_under_feedback_only_what_was_not_seen_is_paid_for(tmp_path):
    """Of four pieces the last one's noise, a quarter of it, comes too late; the rest is answered."""
    problem = integrator(sr.Disturbance(BALL, [[3.0, 4.0]]), sr.Disturbance(SMALL))
    result = sr.solve(problem, control=FOUR, policy=sr.AffinePolicy(among=None))
    assert result.cost == pytest.approx(0.6 + 0.5 * (0.25 + 0.1), rel=1e-6)
    assert sr.check(result.save(tmp_path / "run", figures=False)).status == "verified"


def test_the_margin_enlarges_all_of_them():
    """``0.6 + f 2 (0.05 * 5 + 0.2) = 2`` at the largest factor."""
    stated = {
        "problem": {
            "name": "linear", "system": {"A": [[0]], "B": [[1]]}, "horizon": 2.0, "initial_state": [1.0],
            "control": {"box": 1.0}, "terminal": [{"box": {"lower": [-9.0], "upper": [0.4]}}],
            "disturbance": listed(({"norm": {"p": 2, "radius": 0.05}}, [[3, 4]]), ({"box": 0.1}, [[2]])),
        },
        "dictionaries": {"control": FOUR},
        "observers": [],
    }  # fmt: skip
    found = sr.margin(stated, of="disturbance")
    assert found.lower <= (2.0 - 0.6) / 0.9 + 1e-9
    assert found.upper >= (2.0 - 0.6) / 0.9 - 1e-9
    assert found.upper - found.lower < 1e-5


def test_an_entry_without_E_enters_as_the_system_says_and_one_with_parameters_is_written_in_them(tmp_path):
    system = {"E": [[0], ["1 + p"]], "parameters": {"p": [-0.1, 0.1]}}
    many = ran(tmp_path / "many", [{"set": {"box": 0.04}}, {"set": {"box": 0.02}, "E": [["p"], [1]]}], system)
    both = {**system, "E": [[0, "p"], ["1 + p", 1]]}
    one = ran(tmp_path / "one", {"box": [0.04, 0.02]}, both)
    assert many.result.cost == pytest.approx(one.result.cost, rel=1e-7)
    assert sr.check(many.directory).status == "verified"


def test_every_piece_of_a_system_has_the_columns_of_all():
    first, second = sr.LinearSystem([[0.0]], [[1.0]]), sr.LinearSystem([[0.0]], [[1.0]], E=[[3.0]])
    system = sr.SwitchedSystem([(1.0, first), (2.0, second)])
    problem = integrator(sr.Disturbance(SMALL), sr.Disturbance(SMALL, [[2.0]]), system=system)
    assert [np.asarray(mode.E).tolist() for mode in problem.system.modes] == [[[1.0, 2.0]], [[3.0, 2.0]]]
    assert sr.solve(problem, control=FOUR).cost == pytest.approx(0.6 + 0.1 * (1 + 2) + 0.1 * (3 + 2), rel=1e-6)


@pytest.mark.first(2)
@pytest.mark.parametrize(("start", "stop"), [(0.5, 1.5), (0.25, 1.6), (0.0, 1.0), (1.9, None), (1.0, 2.0)])
def test_in_a_window_a_disturbance_pushes_as_long_as_it_acts(start, stop, tmp_path):
    """``0.6 + 2 * 0.05 + 0.1 * 2 * (stop - start)``, wherever the ends lie among the pieces of the dictionaries."""
    within = sr.Disturbance(SMALL, [[2.0]], start=start, stop=stop)
    result = sr.solve(integrator(sr.Disturbance(sr.Box([-0.05], [0.05])), within), control=FOUR)
    assert result.status == "certified"
    assert result.cost == pytest.approx(0.6 + 2 * 0.05 + 0.2 * ((2.0 if stop is None else stop) - start), rel=1e-6)
    assert sr.check(result.save(tmp_path / "run", figures=False)).status == "verified"


def test_what_acts_in_a_window_is_answered_once_it_is_over(tmp_path):
    """Of a window that ends with the last but one piece nothing is left to pay for."""
    problem = integrator(sr.Disturbance(SMALL, [[2.0]], start=0.4, stop=1.5))
    result = sr.solve(problem, control=FOUR, policy=sr.AffinePolicy(among=None, causal_signals=0))
    assert result.cost == pytest.approx(0.6, rel=1e-6)
    assert sr.check(result.save(tmp_path / "run", figures=False)).status == "verified"


def test_windows_cut_the_pieces_of_a_system_and_share_their_ends():
    first, second = sr.LinearSystem([[0.0]], [[1.0]]), sr.LinearSystem([[0.0]], [[1.0]], E=[[3.0]])
    system = sr.SwitchedSystem([(1.0, first), (2.0, second)], delay=0.25)
    every = [sr.Disturbance(SMALL, start=0.5, stop=1.5), sr.Disturbance(SMALL, [[2.0]], start=1.0 + 1e-13)]
    problem = integrator(*every, system=system, initial_control=[0.0])
    assert [phase.until for phase in problem.system.phases] == [0.5, 1.0, 1.5, 2.0]
    assert [np.asarray(mode.E).tolist() for mode in problem.system.modes] == [
        [[0.0, 0.0]], [[1.0, 0.0]], [[3.0, 2.0]], [[0.0, 2.0]],
    ]  # fmt: skip
    assert problem.system.delay == 0.25


def test_a_config_says_when_a_disturbance_acts(tmp_path):
    whole = {"set": {"box": 0.05}, "E": [[0], [1]]}
    cut = [{**whole, "from": 0.0, "to": 0.8}, {**whole, "from": 0.8}]
    halves, one = ran(tmp_path / "halves", cut), ran(tmp_path / "one", [whole])
    assert halves.result.status == one.result.status == "certified"
    later = ran(tmp_path / "later", [{**whole, "from": 0.8}])
    assert later.result.cost < one.result.cost - 1e-3
    assert halves.result.cost >= one.result.cost - 1e-6  # on a piece that both act on they need not agree
    assert sr.check(later.directory).status == "verified"


def test_minimum_attention_takes_a_list(tmp_path):
    problem = {
        "name": "minimum_attention", "system": {"A": [[0]], "B": [[1]]}, "horizon": 2.0, "initial_state": [1.0],
        "rate": {"box": 4.0}, "terminal": [{"box": [0.5]}],
    }  # fmt: skip
    costs = []
    for name, more in {
        "many": {"disturbance": listed(({"box": 0.05}, [[1]]), ({"box": 0.02}, [[2]]))},
        "one": {"disturbance": {"box": [0.05, 0.02]}, "system": {"A": [[0]], "B": [[1]], "E": [[1, 2]]}},
    }.items():
        pieces = {"control": {"name": "piecewise_constant", "pieces": 5}}
        told = {"problem": {**problem, **more}, "dictionaries": pieces, "observers": []}
        costs.append(sr.run(told, out=tmp_path / name, quiet=True, figures=False).result.cost)
    assert costs[0] == pytest.approx(costs[1], rel=1e-7)


@pytest.mark.parametrize(
    ("disturbance", "key"),
    [
        (
            [{"set": {"box": 0.1}, "class": "measurable"}, {"set": {"box": 0.1}, "class": "l1_ball"}],
            "disturbance.1.class",
        ),
        ([{"set": {"box": 0.1}, "E": [[1]]}], "disturbance.0.E"),
        ([{"set": {"box": 0.1}, "E": [[1], ["q"]]}], "disturbance.0.E.1.0"),
        ([{"set": {"box": [0.1, 0.1]}, "E": [[1], [1]]}], "disturbance.0.set.box"),
        ([{"E": [[1], [1]]}], "disturbance.0.set"),
        ([{"set": {"box": 0.1}, "window": [0, 1]}], "disturbance.0.window"),
        ([{"set": {"box": 0.1}, "class": "smooth"}], "disturbance.0.class"),
        ([{"set": {"box": 0.1}, "from": 1.5, "to": 1.0}], "disturbance.0"),
        ([{"set": {"box": 0.1}, "to": 3.0}], "disturbance.0"),
        ([{"set": {"box": 0.1}, "from": -1.0}], "disturbance.0.from"),
        ("all", "disturbance"),
    ],
)
def test_what_is_wrong_with_an_entry_is_named_by_its_key(tmp_path, disturbance, key):
    with pytest.raises(sr.ConfigError) as caught:
        ran(tmp_path / "run", disturbance)
    assert f"problem.{key}: " in str(caught.value)


@pytest.mark.parametrize(
    ("more", "key"),
    [
        ({"disturbance": SMALL, "disturbances": [sr.Disturbance(SMALL)]}, "disturbance"),
        ({"disturbance_class": "l1_ball", "disturbances": [sr.Disturbance(SMALL)]}, "disturbance_class"),
        ({"disturbances": [SMALL]}, "disturbance"),
        ({"disturbances": [sr.Disturbance(SMALL), sr.Disturbance(BALL)]}, "disturbance.1.set"),
        ({"disturbances": [sr.Disturbance(sr.Box([0.0], [np.inf]))]}, "disturbance.0.set"),
        ({"disturbances": [sr.Disturbance(SMALL, [[1.0], [1.0]])]}, "disturbance.0.E"),
        ({"disturbances": [sr.Disturbance(SMALL, kind="smooth")]}, "disturbance.0.class"),  # type: ignore[arg-type]
    ],
)
def test_what_is_wrong_with_a_list_is_named_in_python_too(more, key):
    with pytest.raises(sr.InputError) as caught:
        integrator(**more)
    assert ".".join(map(str, caught.value.path)) == key
