"""Guards disturbances of a list that are constant on pieces of their own (control/response/disturbance.py,
`held_components`, and checker/problem/held.py): values by a linear program of integrals that no line of the package
had a part in, and by problems in which all of them share the dictionary's pieces."""

from __future__ import annotations

import json
import shutil
from itertools import pairwise

import numpy as np
import pytest
import yaml
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.claims.units import units_of

A, B = np.array([[0.0, 1.0], [-2.0, -0.3]]), np.array([[0.0], [1.0]])
HORIZON, PIECES, LIMIT = 3.0, 6, 0.4
FAST, SLOW = np.array([[0.3], [1.0]]), np.array([[1.0, 0.2], [0.0, -0.5]])
UNEVEN, EVEN, PLAIN = np.array([0.0, 1.0, 1.3, 3.0]), np.linspace(0.0, HORIZON, 6), np.linspace(0.0, HORIZON, 5)
OTHERS = {"control": {"name": "piecewise_constant", "pieces": PIECES}}
OTHERS["disturbance"] = {"name": "piecewise_constant", "pieces": PLAIN.size - 1}


def pushed(direction, E, begin, end):
    """``int c'e^{A (T - s)} E ds``."""
    return np.array(
        [quad(lambda s, e=e: float(direction @ expm(A * (HORIZON - s)) @ e), begin, end)[0] for e in E.T],
    )


def added(direction):
    """What three disturbances add at the horizon: in a box of 0.1, a disc of 0.08, and a box of 0.05."""
    every = [(UNEVEN, FAST, 0.1), (EVEN, SLOW, 0.08), (PLAIN, B, 0.05)]
    return sum(
        radius * float(np.linalg.norm(pushed(direction, E, begin, end)))
        for grid, E, radius in every
        for begin, end in pairwise(grid)
    )


def stated(**more):
    """The oscillator that is to be near rest at the end, whatever three disturbances on three grids do."""
    disturbances = [
        sr.Disturbance(sr.Box([-0.1], [0.1]), FAST, breakpoints=UNEVEN),
        sr.Disturbance(sr.NormBall(2.0, 0.08, dimension=2), SLOW, breakpoints=EVEN),
        sr.Disturbance(sr.Box([-0.05], [0.05]), B),
    ]
    given = {
        "system": sr.LinearSystem(A, B), "horizon": HORIZON, "initial_state": [1.0, 0.0],
        "control": sr.Box([-2.0], [2.0]), "terminal": [sr.Box([-LIMIT] * 2, [LIMIT] * 2)],
        "disturbances": disturbances,
    }  # fmt: skip
    return sr.OptimalControlProblem(**{**given, **more})


def value(ends):
    """The least cost of a control on pieces between ``ends``, by a linear program."""
    rows, right, lengths = [], [], np.tile(np.diff(ends), 2)
    for direction in (*np.eye(2), *-np.eye(2)):
        row = np.concatenate([pushed(direction, B, *span) for span in pairwise(ends)])
        rows.append(np.concatenate([row, -row]))
        right.append(LIMIT - direction @ expm(A * HORIZON) @ [1.0, 0.0] - added(direction))
    found = linprog(lengths, A_ub=rows, b_ub=right, bounds=[(0.0, 2.0)] * lengths.size)
    assert found.status == 0
    return float(found.fun)


@pytest.fixture(scope="module")
def least():
    """The value on six equal pieces."""
    return value(np.linspace(0.0, HORIZON, PIECES + 1))


def test_the_pieces_of_the_control_may_be_among_theirs():
    control = {"name": "piecewise_constant", "breakpoints": EVEN.tolist()}
    result = sr.solve(stated(), control=control, disturbance=OTHERS["disturbance"])
    assert result.status == "certified"
    assert result.cost == pytest.approx(value(EVEN), abs=1e-7)


@pytest.mark.first(1)
@pytest.mark.parametrize("cut", [0.7, 1.9])
def test_one_that_jumps_once_less_than_another_is_no_freer(cut):
    """Of two pieces of the one the other has one."""
    two = np.array([0.0, cut, HORIZON])
    disturbances = [
        sr.Disturbance(sr.Box([-0.1], [0.1]), FAST, breakpoints=two),
        sr.Disturbance(sr.Box([-0.1], [0.1]), B, breakpoints=[0.0, HORIZON]),
    ]
    problem = stated(
        disturbances=disturbances, control=sr.Box([-1e-9], [1e-9]), terminal=[sr.Box([-9.0] * 2, [9.0] * 2)]
    )
    for row in sr.bound(problem).rows:
        c = np.asarray(row.direction)
        reach = abs(pushed(c, FAST, 0.0, cut)) + abs(pushed(c, FAST, cut, HORIZON)) + abs(pushed(c, B, 0.0, HORIZON))
        worst = c @ expm(A * HORIZON) @ [1.0, 0.0] + 0.1 * float(reach[0])
        assert (row.upper if row.sense == "sup" else -row.lower) == pytest.approx(worst, abs=1e-5)


def test_each_is_constant_on_its_own_pieces(least, tmp_path):
    result = sr.solve(stated(), **OTHERS)
    assert result.status == "certified"
    assert result.lower_bound <= least + 1e-8 and result.cost >= least - 1e-8
    assert result.cost == pytest.approx(least, abs=1e-7)
    directory = result.save(tmp_path / "run", figures=False)
    assert sr.check(directory).status == "verified"
    written = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["problem"]["disturbance"]
    assert [one.get("breakpoints") for one in written] == [UNEVEN.tolist(), EVEN.tolist(), PLAIN.tolist()]


def test_pieces_that_are_shared_would_cost_more(least):
    """On one grid that is as fine as all of them a disturbance may jump where it cannot."""
    plain = [sr.Disturbance(one.set, one.E) for one in (
        sr.Disturbance(sr.Box([-0.1], [0.1]), FAST), sr.Disturbance(sr.NormBall(2.0, 0.08, dimension=2), SLOW),
        sr.Disturbance(sr.Box([-0.05], [0.05]), B),
    )]  # fmt: skip
    finer = {"name": "piecewise_constant", "breakpoints": np.unique([*UNEVEN, *EVEN, *PLAIN]).tolist()}
    result = sr.solve(stated(disturbances=plain), control=OTHERS["control"], disturbance=finer)
    assert result.lower_bound > least + 1e-3


@pytest.fixture(scope="module")
def bounded(tmp_path_factory):
    """A run, and the directory of the worst cases of its control."""
    place = tmp_path_factory.mktemp("bounded")
    result = sr.solve(stated(), **OTHERS)
    result.save(place / "run", figures=False)
    return result, sr.bound(place / "run", out=place / "bound"), place / "bound"


def test_worst_cases_are_those_sums_and_their_signals_stay_what_they_are(bounded):
    result, found, directory = bounded
    ends, control = np.linspace(0.0, HORIZON, PIECES + 1), np.asarray(result.decision).ravel()
    for row in found.rows:
        direction = np.asarray(row.direction)
        moved = sum(pushed(direction, B, *ends[k : k + 2])[0] * control[k] for k in range(PIECES))
        value = direction @ expm(A * HORIZON) @ [1.0, 0.0] + moved + added(direction)
        value = value if row.sense == "sup" else -value
        assert row.lower - 1e-8 <= value <= row.upper + 1e-8
        assert row.upper - row.lower < 1e-6
    assert sr.check(directory).status == "verified"


def test_a_signal_that_jumps_within_a_piece_of_its_own_is_refused(bounded, tmp_path):
    shutil.copytree(bounded[2], tmp_path / "bound")
    path = tmp_path / "bound" / "bound.json"
    told = json.loads(path.read_text())
    signal, changes = np.array(told["rows"][0]["disturbance"]), told["rows"][0]["changes"]
    inside = next(k for k in range(1, signal.shape[1]) if not np.isclose(UNEVEN, changes[k]).any())
    signal[0, inside] = 0.9 * signal[0, inside - 1]
    told["rows"][0]["disturbance"] = signal.tolist()
    path.write_text(json.dumps(told))
    checked = sr.check(tmp_path / "bound")
    assert checked.status == "refuted"
    assert "the disturbance jumps within a piece" in str(checked.claims)


@pytest.mark.first(1)
@pytest.mark.parametrize("kind", ["known", "entries in t"])
def test_a_bound_that_a_disturbance_on_shorter_pieces_would_have_is_refuted(kind, tmp_path):
    """What is derived is what disturbances do that stay what they are; one that is a little larger does not follow."""
    system = {} if kind == "known" else {"system": {"A": [[0, 1], ["-9 + 0*t", -0.3]], "B": [[0], [1]]}}
    keys = {**WALLED, **system, "disturbance": [{"set": {"box": 0.1}, "E": LONG, "pieces": 3}, STILL]}
    fine = {**OTHERS, "disturbance": {"name": "piecewise_constant", "pieces": 14}}
    given = {"problem": keys, "dictionaries": fine, "observers": []}
    sr.run(given, out=tmp_path / "run", quiet=True, figures=False)
    path = tmp_path / "run" / "certificate.json"
    told = json.loads(path.read_text())
    told["lower_bound"] += 1e-6
    path.write_text(json.dumps(told))
    assert any(one.name == "lower bound" and one.verdict == "fails" for one in sr.check(tmp_path / "run").claims)


def test_the_units_of_rows_are_those_of_what_disturbances_do_on_their_own_pieces():
    """As on a dictionary of long pieces, and less than where the same disturbance may jump on short ones."""
    system, box = sr.LinearSystem([[0.0, 1.0], [-9.0, -0.3]], [[0.0], [1.0]]), sr.Box([-0.1], [0.1])
    still, control = sr.Disturbance(sr.Box([0.0], [0.0]), LONG), sr.Dictionary.indicators(np.linspace(0.0, 2.0, 6))
    found, none = [], {"decision": np.zeros((1, 5)).tolist()}
    for pieces, own in ((14, np.linspace(0.0, 2.0, 4)), (3, None), (14, None)):
        disturbances = [sr.Disturbance(box, LONG, breakpoints=own), still]
        problem = sr.OptimalControlProblem(
            system=system, horizon=2.0, initial_state=[0.0, 0.0], control=sr.Box([-1e-6], [1e-6]),
            terminal=[sr.Box([-1.0] * 2, [1.0] * 2)], disturbances=disturbances,
        )  # fmt: skip
        case = Case(problem, control, sr.Dictionary.indicators(np.linspace(0.0, 2.0, pieces + 1)), none)
        found.append(units_of(case, case.windows[0]).rows)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-5)
    assert (found[0] < 0.99 * found[2]).all()


def test_ends_of_pieces_that_differ_by_rounding_are_one(tmp_path):
    """``3 * 0.6`` is not 1.8."""
    disturbances = [
        sr.Disturbance(sr.Box([-0.1], [0.1]), FAST, breakpoints=[0.0, 1.8, HORIZON]),
        sr.Disturbance(sr.Box([-0.1], [0.1]), B, breakpoints=EVEN),
    ]
    assert EVEN[3] != 1.8
    result = sr.solve(stated(disturbances=disturbances), **OTHERS)
    assert result.status == "certified"
    assert sr.check(result.save(tmp_path / "run", figures=False)).status == "verified"


@pytest.mark.slow
def test_a_chain_of_many_states_is_checked_on_their_own_pieces(tmp_path):
    """Where rows are followed by their adjoints when all disturbances share their pieces."""
    masses = 16
    stiffness = 9.0 * (2.0 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1))
    chain = np.block([[np.zeros((masses, masses)), np.eye(masses)], [-stiffness, -0.3 * np.eye(masses)]])
    first, last = (np.eye(1, 2 * masses, masses + k).T.tolist() for k in (0, masses - 1))
    keys = {
        "name": "linear", "system": {"A": chain.tolist(), "B": first}, "horizon": 2.0, "initial_state": 0.0,
        "control": {"box": 1.0}, "path": [{"polytope": {"H": np.eye(1, 2 * masses).tolist(), "h": [0.02]}}],
        "disturbance": [{"set": {"box": 0.1}, "E": first, "pieces": 3}, {"set": {"box": 0.1}, "E": last}],
    }  # fmt: skip
    fine = {**OTHERS, "disturbance": {"name": "piecewise_constant", "pieces": 14}}
    run = sr.run(
        {"problem": keys, "dictionaries": fine, "observers": []}, out=tmp_path / "run", quiet=True, figures=False
    )
    assert run.status == "certified"
    assert sr.check(tmp_path / "run").status == "verified"


def test_a_witness_that_jumps_within_a_piece_of_its_own_is_refused(tmp_path):
    keys = {**WALLED, "disturbance": [{"set": {"box": 0.1}, "E": LONG, "pieces": 3}, STILL]}
    given = {"problem": keys, "dictionaries": OTHERS, "method": {"name": "nominal"}, "observers": []}
    assert sr.run(given, out=tmp_path / "run", quiet=True, figures=False).status == "refuted"
    assert sr.check(tmp_path / "run").status == "verified"
    path = tmp_path / "run" / "certificate.json"
    told = json.loads(path.read_text())
    signal = np.array(told["witness"]["disturbance"])
    signal[0, 1] = 0.999 * signal[0, 0]
    told["witness"]["disturbance"] = signal.tolist()
    path.write_text(json.dumps(told))
    assert "jumps within a piece, at t = 0.333" in str(sr.check(tmp_path / "run").claims)


LONG, STILL = [[0.3], [1]], {"set": {"box": 0.0}, "E": [[0.3], [1]]}
# within pieces of 0.5 and more its rows change their signs, so that a disturbance which may jump there does more
WALLED = {
    "name": "linear", "system": {"A": [[0, 1], [-9, -0.3]], "B": [[0], [1]]}, "horizon": 2.0,
    "initial_state": [0.5, 0.0], "control": {"box": 3.0}, "path": [{"box": [0.8, None]}],
    "terminal": [{"box": [0.2, 0.8]}],
}  # fmt: skip
VARIANTS = {
    "plain": {},
    "parameters": {"system": {"A": [[0, 1], ["-9 + p", -0.3]], "B": [[0], [1]], "parameters": {"p": [-0.1, 0.1]}}},
    "pieces of the system": {
        "system": {
            "pieces": [
                {"until": 0.7, "A": [[0, 1], [-9, -0.3]], "B": [[0], [1]]},
                {"until": 2.0, "A": [[0, 1], [-12, 0]], "B": [[0], [1.5]]},
            ]
        }
    },
    "entries in t": {"system": {"A": [[0, 1], ["-9 - 2*sin(t)", -0.3]], "B": [[0], [1]]}},
    "delay": {
        "system": {"A": [[0, 1], [-9, -0.3]], "B": [[0], [1]], "delay": 0.1}, "initial_control": 0.0,
        "control_step": {"box": 5.0},
    },
    "initial set": {"initial_state": {"centre": [0.5, 0.0], "box": 0.02}},
    "curved path": {"path": [{"ellipsoid": {"centre": [0, 0], "shape": [[0.64, 0], [0, 5.0]]}}]},
    "moving set": {"path": [{"box": [0.8, None], "relative_to": [[0, 0, 0], [2, -0.05, 0]]}]},
    "mixed": {"path": [{"mixed": {"H": [[1, 0]], "G": [[0.1]], "h": [0.9]}}]},
    "integral": {"integral": [{"H": [[1, 0]], "upper": [0.5]}]},
    "quadratic cost": {"cost": {"control": {"R": [[0.1]]}}},
    "repeat": {
        "system": {"A": [[-1, 4], [-4, -1]], "B": [[0], [1]]}, "repeat": True,
        "initial_state": {"centre": [0.0, 0.0], "box": 0.3}, "path": [{"box": [0.8, None]}], "terminal": [],
    },
}  # fmt: skip


@pytest.mark.first(2)
@pytest.mark.parametrize("variant", [*VARIANTS, "literal", "sparsest", "execution", "haar"])
def test_a_disturbance_on_long_pieces_beside_one_that_does_nothing_is_one_on_a_dictionary_of_long_pieces(
    variant, tmp_path
):
    """The other one has short pieces and the value 0, so that the long ones are parts of a finer grid here, and the
    dictionary itself there, where nothing of this is met."""
    box = {"box": 0.1}
    keys = {**WALLED, **VARIANTS.get(variant, {})}
    rest = {"dictionaries": {"control": {"name": "piecewise_constant", "pieces": 5}}, "observers": []}
    if variant == "literal":
        rest |= {"method": {"name": "sparserob", "formulation": "literal", "indices": 4}}
        rest |= {"maximiser": {"name": "random_search", "budget": 50}}
    if variant == "sparsest":
        rest["method"] = "sparsest"
    if variant == "execution":
        keys["execution"] = 0.02
    if variant == "haar":
        rest["dictionaries"]["control"] = {"name": "haar", "pieces": 8}

    def made(name, disturbance, pieces, **other):
        dictionaries = {**rest["dictionaries"], "disturbance": {"name": "piecewise_constant", "pieces": pieces}}
        problem = {**keys, "disturbance": disturbance}
        given = {**rest, "problem": problem, "dictionaries": dictionaries, **other}
        return sr.run(given, out=tmp_path / name, quiet=True, figures=False)

    own = made("own", [{"set": box, "E": LONG, "pieces": 3}, STILL], 14)
    plain = made("plain", [{"set": box, "E": LONG}, STILL], 3)
    if variant == "literal":  # what a search finds differs; what is claimed is checked
        assert own.result.lower_bound <= made("exact", [{"set": box, "E": LONG}], 3, method="exchange").result.cost
        assert sr.check(own.directory).status == "verified"
        return
    assert own.result.status == plain.result.status == "certified"
    assert own.result.cost == pytest.approx(plain.result.cost, rel=1e-6)
    assert own.result.lower_bound == pytest.approx(plain.result.lower_bound, rel=1e-6)
    assert sr.check(own.directory).status == "verified"


def test_the_margin_enlarges_all_of_them(bounded):
    """What they add at the end grows with the factor; of the rows of the end the one with the least room decides, with
    a control that makes room where it can: the largest factor is that of a linear program in the control and it."""
    ends, rows, right = np.linspace(0.0, HORIZON, PIECES + 1), [], []
    for direction in (*np.eye(2), *-np.eye(2)):
        row = np.concatenate([pushed(direction, B, *span) for span in pairwise(ends)])
        rows.append(np.append(row, added(direction)))
        right.append(LIMIT - direction @ expm(A * HORIZON) @ [1.0, 0.0])
    cost = np.append(np.zeros(PIECES), -1.0)
    largest = linprog(cost, A_ub=rows, b_ub=right, bounds=[(-2.0, 2.0)] * PIECES + [(0.0, None)])
    found = sr.margin(bounded[2].parent / "run" / "config.yaml", of="disturbance")
    assert found.lower - 1e-6 <= -largest.fun <= found.upper + 1e-6 and found.upper - found.lower < 1e-4


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"breakpoints": [0.0, 1.0]}, "disturbance.0.breakpoints: expected times that increase from 0 to 2"),
        ({"breakpoints": [0.0, 1.0, 1.0, 2.0]}, "disturbance.0.breakpoints: expected times that increase"),
        ({"breakpoints": [0.5, 2.0]}, "disturbance.0.breakpoints: expected times that increase"),
        ({"pieces": 2, "breakpoints": [0.0, 2.0]}, "disturbance.0: expected one of pieces and breakpoints, got both"),
        ({"pieces": 0}, "disturbance.0.pieces"),
    ],
)
def test_pieces_that_do_not_fit_are_refused(more, said):
    keys = {**WALLED, "disturbance": [{"set": {"box": 0.1}, "E": LONG, **more}]}
    with pytest.raises(sr.InputError) as error:
        sr.run({"problem": keys, "dictionaries": {"control": OTHERS["control"]}}, quiet=True, figures=False)
    assert said in str(error.value)
