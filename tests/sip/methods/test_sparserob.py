"""Guards sip/methods/sparserob: the paper's algorithm: bounds that hold, decisions that are judged, four pieces that
can be replaced."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.methods import sparserob
from sparserob_core.sip.relaxed.tuples import TupleValue
from sparserob_core.sip.rules import Progress
from tests.support.places import CONFIGS

COARSE = {"observers": [], "dictionaries.control.pieces": 50, "dictionaries.disturbance.pieces": 50}


def experiment1(out, method, maximiser, **changes):
    overrides = {**COARSE, "method": {"name": "sparserob", **method}, "maximiser": maximiser, **changes}
    return sr.run(CONFIGS / "experiment1_repaired.yaml", overrides, out=out, figures=False)


@pytest.fixture(scope="module")
def exact(tmp_path_factory):
    outcome = sr.run(
        CONFIGS / "experiment1_repaired.yaml", COARSE, out=tmp_path_factory.mktemp("exact") / "run", figures=False
    )
    assert outcome.status == "certified"
    return outcome.result


def parabola(**arguments):
    """min (x - 1)^2 with x <= 1/2 + (t - 1/2)^2 for all t in [0, 1]: 1/4 at 1/2."""
    family = sr.ConstraintFamily(
        name="above", index_set=sr.Box([0.0], [1.0]), rows=lambda t: (np.ones((len(t), 1, 1)), 0.5 + (t - 0.5) ** 2)
    )
    program = sr.SemiInfiniteProgram(n=1, P=[[2.0]], q=[-2.0], lower=-10.0, upper=10.0, families=[family])
    return sr.solve(program, **arguments)


def test_a_general_program_is_solved_to_the_accuracy_of_the_search():
    result = parabola(method="sparserob", maximiser="direct", budget=200)
    assert result.value + 1 == pytest.approx(0.25, abs=1e-6)
    assert result.lower_bound + 1 <= 0.25 + 1e-9
    assert result.status == "undecided"


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "name",
    [
        "simulated_annealing",
        "sequool",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("random_search", "gradient_ascent")),
    ],
)
def test_the_lower_bound_never_exceeds_the_exact_value(name, exact, tmp_path):
    result = experiment1(
        tmp_path / "run", {"indices": 4, "sc1": {"name": "iterations", "count": 3}}, {"name": name, "budget": 60}
    ).result
    assert np.isfinite(result.lower_bound)
    assert result.lower_bound <= exact.upper_bound + 1e-8
    assert (result.trace.bound <= exact.upper_bound + 1e-8).all()
    assert (np.diff(result.trace.bound) >= 0).all()


def test_a_literal_search_is_refuted_by_a_disturbance_that_breaks_it(exact, tmp_path):
    outcome = experiment1(
        tmp_path / "run",
        {"formulation": "literal", "indices": 10, "sc1": {"name": "iterations", "count": 2}},
        {"name": "simulated_annealing", "budget": 60, "polish": 0.0},
    )
    result = outcome.result
    assert result.status == "refuted"
    assert result.lower_bound <= exact.upper_bound
    assert result.upper_bound == np.inf
    worst = result.worst
    assert np.abs(worst.disturbance).max() <= 0.06 + 1e-12
    state = simulated(outcome, worst.disturbance, worst.time)
    excess = np.abs(state) - (0.7, np.inf) if worst.constraint == "path" else np.abs(state) - (0.3, 0.3)
    assert excess.max() == pytest.approx(worst.violation, abs=1e-9)
    assert f"{worst.constraint} is violated by {worst.violation:.4g}" in result.message
    assert result.message.endswith("more evaluations (maximiser.budget) or indices (method.indices) would help")


# Two searches without a polish, which leave the path violated by little.
NEAR = (
    {"indices": 8, "sc1": {"name": "iterations", "count": 2}},
    {"name": "simulated_annealing", "budget": 100, "polish": 0.0},
)
FEW = {"dictionaries.control.pieces": 20, "dictionaries.disturbance.pieces": 20}


def test_what_misses_the_constraints_by_little_is_backed_off_by_as_much_and_proven(tmp_path, monkeypatch):
    result = experiment1(tmp_path / "run", *NEAR, **FEW).result
    assert result.status == "verified"
    assert "misses them by (path is violated by" in result.message
    assert result.cost == result.upper_bound
    assert all(proof.verdict == "proven" for proof in result.proofs)
    assert sr.check(tmp_path / "run").status == "verified"

    monkeypatch.setattr(sparserob, "back_off", lambda *_: None)
    refuted = experiment1(tmp_path / "refuted", *NEAR, **FEW).result  # the same search, of which nothing is proven
    assert refuted.status == "refuted" and refuted.upper_bound == np.inf
    assert 0.0 < refuted.worst.violation < 1e-5
    np.testing.assert_array_equal(refuted.trace.value, result.trace.value)
    np.testing.assert_array_equal(refuted.trace.bound, result.trace.bound)
    # That of g, but for rounding: what is imposed to back off is not of the tuple.
    assert result.lower_bound == pytest.approx(refuted.lower_bound, rel=1e-11)
    assert result.value == refuted.value
    assert abs(result.cost - refuted.cost) < 1e-4 * refuted.cost


def test_an_interrupted_search_returns_what_it_has_proven(tmp_path, monkeypatch):
    evaluated = TupleValue.at

    def interrupted(g, point):
        interrupted.weights.append(g.epsilon)
        if (len(set(interrupted.weights)), interrupted.weights.count(g.epsilon)) == interrupted.at:
            raise KeyboardInterrupt
        return evaluated(g, point)

    monkeypatch.setattr(TupleValue, "at", interrupted)
    three = {"indices": 8, "sc1": {"name": "iterations", "count": 3}}, NEAR[1]
    for at, status in (((1, 30), "refuted"), ((3, 5), "verified")):  # the second search is as near as `NEAR` is
        interrupted.weights, interrupted.at = [], at  # of which search which evaluation
        result = experiment1(tmp_path / status, *three, **FEW).result
        assert result.status == status, at
        assert result.stopped == "interrupted from the keyboard"
        assert np.isfinite(result.upper_bound) == (status == "verified")


def test_a_search_at_its_limit_returns_what_it_has_proven_and_was_not_interrupted(tmp_path, monkeypatch):
    """The time is over after as many evaluations as prove something, however slow the machine is."""
    evaluated, left = TupleValue.at, [500]

    def counted(g, point):
        left[0] -= 1
        return evaluated(g, point)

    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + (3600.0 if left[0] <= 0 else 0.0))
    monkeypatch.setattr(TupleValue, "at", counted)
    monkeypatch.setattr("sparserob_core.sip.limits.deadline.time", clock)
    method, maximiser = {"indices": 8}, {"name": "simulated_annealing", "budget": 60}
    limits = FEW | {"continuation": {"factor": 0.99999, "stop": 1e-6}, "limits.seconds": 3600.0}
    outcome = experiment1(
        tmp_path / "run", method | {"sc1": {"name": "iterations", "count": 10**6}}, maximiser, **limits
    )
    assert outcome.status == "verified"
    assert "the limit of 3600 s is reached" in outcome.result.message
    assert not outcome.interrupted
    assert left[0] >= -1, "a search goes on after its time"


def simulated(outcome, disturbance, time):
    """The state at a time, by scipy's integrator piece by piece."""
    from scipy.integrate import solve_ivp

    A, ends = np.array([[0.0, 1.0], [-2.0, -0.5]]), np.linspace(0, 5, 51)
    state = np.array([-1.0, 1.0])
    for piece, (left, right) in enumerate(zip(ends[:-1], np.minimum(ends[1:], time), strict=True)):
        if right <= left:
            break
        force = np.array([0.0, outcome.control[0, piece]]) + disturbance[:, piece]
        state = solve_ivp(lambda t, x, force=force: A @ x + force, (left, right), state, rtol=1e-12, atol=1e-13).y[
            :, -1
        ]
    return state


def test_data_without_any_feasible_control_are_told_from_the_tuple(tmp_path):
    overrides = {
        **COARSE,
        "method": {"name": "sparserob", "indices": 3},
        "maximiser": {"name": "random_search", "budget": 20},
    }
    result = sr.run(CONFIGS / "experiment1_printed.yaml", overrides, out=tmp_path / "run", figures=False).result
    assert result.status == "infeasible"
    assert "whatever the decision" in result.message
    assert result.lower_bound == np.inf
    assert all(cut.multiplier > 0 for cut in result.indices)


def test_the_same_seed_gives_the_same_trace(tmp_path):
    method, maximiser = (
        {"indices": 3, "sc1": {"name": "iterations", "count": 2}},
        {"name": "simulated_annealing", "budget": 40},
    )
    first, second = (experiment1(tmp_path / name, method, maximiser).result for name in "ab")
    other = experiment1(tmp_path / "c", method, maximiser, seed=1).result
    np.testing.assert_array_equal(first.trace.value, second.trace.value)
    assert not np.array_equal(first.trace.value, other.trace.value)


def test_a_polish_is_written_down_and_read_back_and_replayed_as_one(tmp_path):
    from sparserob_core.experiment.run.inspection import Inspection
    from sparserob_core.experiment.run.replay import BATCHES, _replay_searches

    outcome = experiment1(
        tmp_path / "run",
        {"indices": 3, "sc1": {"name": "iterations", "count": 2}},
        {"name": "random_search", "budget": 30, "polish": 0.3},
    )
    trace = outcome.result.trace
    with np.load(outcome.directory / "evaluations.npz") as columns:
        read = sr.SearchTrace.stored(columns)
    assert trace.polished.tolist() == read.polished.tolist()
    assert np.flatnonzero(~read.polished).tolist() == [*range(21), *range(30, 51)]
    told = [event for _, event in _replay_searches(read, Inspection.read(outcome.directory))]
    for event in told:
        mine = read.polished[read.outer == event.round - 1][event.total - event.count : event.total]
        assert mine.tolist() == [event.phase == "polish"] * event.count
    assert sum(event.count for event in told) == 60
    assert len(told) <= 2 * BATCHES


def test_no_weight_is_a_rounding_error_above_the_last_one():
    steps, weights = sr.Continuation(start=1.0, factor=0.1, stop=1e-3), [1.0]
    while weights[-1] > steps.stop:
        weights.append(steps.lighter(weights[-1]))
    assert weights == pytest.approx([1.0, 0.1, 0.01, 0.001], rel=1e-12)
    assert steps.lighter(0.01) == steps.stop
    assert steps.lighter(0.0100001) > steps.stop


def test_every_evaluation_is_written_down(tmp_path):
    outcome = experiment1(
        tmp_path / "run",
        {"indices": 3, "sc1": {"name": "iterations", "count": 2}},
        {"name": "random_search", "budget": 30},
    )
    with np.load(outcome.directory / "evaluations.npz") as columns:
        assert {name: columns[name].shape for name in columns if name != "points"} == dict.fromkeys(
            ["outer", "epsilon", "value", "bound", "seconds"], (60,)
        )
        assert columns["points"].shape == (60, 3 * outcome.program.families[0].index_set.dimension)
        assert columns["epsilon"].tolist() == [1.0] * 30 + [0.5] * 30
        assert not sr.SearchTrace.stored(columns).polished.any()
        assert (np.diff(columns["seconds"]) >= 0).all()
    assert outcome.summary["counts"]["evaluations"] == 60


class TestTheFourPieces:
    def test_are_called_with_what_the_paper_hands_them(self):
        heard = {"regu": [], "sc1": [], "sc2": [], "slcr": []}

        def regu(epsilon, j):
            heard["regu"].append((epsilon, j))
            return epsilon / 10

        def sc1(steps):
            heard["sc1"].append(len(steps))
            return len(steps) == 3

        def sc2(progress):
            heard["sc2"].append(progress.evaluations)
            return progress.evaluations >= 25

        def slcr(current, candidate, temperature, rng):
            heard["slcr"].append(temperature)
            return candidate >= current

        result = parabola(
            method={"name": "sparserob", "regu": regu, "sc1": sc1, "sc2": sc2, "slcr": slcr},
            maximiser="simulated_annealing",
            regulariser="ridge",
            budget=100,
            polish=0.0,
        )
        assert heard["regu"] == [(1.0, 1), (0.1, 2)]
        assert heard["sc1"] == [1, 2, 3]
        assert max(heard["sc2"]) == 25
        assert result.counts["evaluations"] == 75
        assert len(heard["slcr"]) > 30

    @pytest.mark.parametrize("weight", [1.0, 2.0, 0.0, -1.0, float("nan"), "half", None])
    def test_a_schedule_that_does_not_decrease_is_refused(self, weight):
        with pytest.raises(sr.InputError, match="regu: expected a positive weight below"):
            parabola(
                method={"name": "sparserob", "regu": lambda epsilon, j: weight},
                maximiser="random_search",
                regulariser="ridge",
                budget=5,
            )

    def test_come_by_name_with_options(self, tmp_path):
        result = experiment1(
            tmp_path / "run",
            {
                "indices": 2,
                "regu": {"name": "accelerating", "factor": 0.1},
                "sc1": {"name": "iterations", "count": 3},
                "sc2": {"name": "stalled", "window": 5},
                "slcr": "improvement",
            },
            {"name": "simulated_annealing", "budget": 200},
        ).result
        assert np.unique(result.trace.epsilon).tolist() == pytest.approx([1e-3, 0.1, 1.0])
        assert result.counts["evaluations"] < 600

    @pytest.mark.parametrize(
        ("option", "words"),
        [
            ({"regu": "geometrical"}, "no rule of the class Schedule is named 'geometrical'; did you mean 'geometric'"),
            (
                {"sc2": "metropolis"},
                r"no rule of the class InnerStop is named 'metropolis'; known: evaluations, stalled",
            ),
            ({"regu": {"name": "geometric", "factor": 1.5}}, r"method\.regu\.factor: .*less than 1"),
            ({"regu": {"name": "geometric", "faktor": 0.5}}, r"method\.regu\.faktor: unknown key"),
            ({"sc2": {"window": 3}}, r"method\.sc2\.name: expected the name of one of evaluations, stalled"),
            ({"indices": 0}, r"method\.indices"),
            ({"indices": True}, r"method\.indices"),
            ({"formulation": "lateral"}, r"method\.formulation"),
        ],
    )
    def test_a_mistake_names_its_key(self, option, words, tmp_path):
        with pytest.raises(sr.ConfigError, match=words):
            experiment1(tmp_path / "run", option, {"name": "random_search"})

    def test_what_is_no_rule_is_refused(self):
        with pytest.raises(
            sr.InputError, match="sc1: expected the name of a rule, a mapping with a name, or a function, got 3"
        ):
            parabola(method={"name": "sparserob", "sc1": 3})

    def test_are_written_out_in_the_config_of_the_run(self, tmp_path):
        outcome = experiment1(
            tmp_path / "run",
            {"indices": 2, "sc1": {"name": "iterations", "count": 1}, "sc2": "stalled"},
            {"name": "random_search", "budget": 5},
        )
        again = sr.run(outcome.directory / "config.yaml", {"observers": []}, out=tmp_path / "again", figures=False)
        assert "window: 200" in (outcome.directory / "config.yaml").read_text()
        np.testing.assert_array_equal(again.result.trace.value, outcome.result.trace.value)


def test_the_literal_formulation_needs_a_disturbance_in_the_index():
    with pytest.raises(sr.InputError, match="formulation: literal needs families"):
        parabola(method={"name": "sparserob", "formulation": "literal"}, maximiser="random_search")


def test_the_gain_of_a_search_looks_back_over_its_window():
    progress = Progress(100, 5.0, {}, [(1, 1.0), (40, 3.0), (90, 5.0)])
    assert progress.gain(5) == 0.0
    assert progress.gain(20) == 2.0
    assert progress.gain(70) == 4.0
    assert progress.gain(100) == np.inf


@pytest.mark.parametrize("G", [np.ones((1, 1, 2)), np.ones((1, 1)), np.ones((2, 1, 1))])
def test_rows_of_the_wrong_shape_name_their_family(G):
    family = sr.ConstraintFamily(name="odd", index_set=sr.Box([0.0], [1.0]), rows=lambda t: (G, np.ones((len(t), 1))))
    program = sr.SemiInfiniteProgram(n=1, q=[1.0], lower=-1.0, upper=1.0, families=[family])
    with pytest.raises(sr.InputError, match=r"family 'odd': expected rows of shape \(1, r, 1\)"):
        sr.solve(program, method="sparserob", maximiser="random_search", budget=5)
