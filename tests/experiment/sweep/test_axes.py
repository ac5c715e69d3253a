"""Guards experiment/sweep/axes and plan: what the text of an axis means, how points are arranged, and which mistakes
are told."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.sweep.axes import parse_axes, split
from sparserob_core.experiment.sweep.plan import make_plan, read_plan


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("a,b,c", ["a", "b", "c"]),
        (" a , b ", ["a", "b"]),
        ("[1,2],[3,4]", ["[1,2]", "[3,4]"]),
        ("{name: lipo, k: [1,2]}, sequool", ["{name: lipo, k: [1,2]}", "sequool"]),
        ("f(1,2),'a,b',\"c,d\"", ["f(1,2)", "'a,b'", '"c,d"']),
        ("it's,so", ["it's", "so"]),
        ("{a: 'x,}'},2", ["{a: 'x,}'}", "2"]),
        ("", [""]),
        ("a,,b", ["a", "", "b"]),
    ],
)
def test_commas_inside_brackets_braces_and_quotes_do_not_split(text: str, parts: list[str]) -> None:
    assert list(split(text)) == parts


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("seed=0:19:20", list(range(20))),
        ("seed=0:10:3", [0, 5, 10]),
        ("seed=10:0:3", [10, 5, 0]),
        ("x=0:1:3", [0.0, 0.5, 1.0]),  # the step is no whole number
        ("x=0.0:2.0:3", [0.0, 1.0, 2.0]),
        ("x=0:1:11", [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]),
        ("x=log:1e-6:1:4", [1e-6, 1e-4, 1e-2, 1.0]),
        ("x=log:1:1e-3:4", [1.0, 0.1, 0.01, 0.001]),
        ("x=5:5:1", [5]),
        ("x=0,0.5:1:2", [0, 0.5, 1.0]),
        ("method=exchange,scenario", ["exchange", "scenario"]),
        ("box=[1,2],[3,null]", [[1, 2], [3, None]]),
        ("box=[1,2]", [[1, 2]]),
        ("maximiser=[{name: lipo, budget: 3}, sequool]", [{"name": "lipo", "budget": 3}, "sequool"]),
        ("method={name: scenario, scenarios: 10},nominal", [{"name": "scenario", "scenarios": 10}, "nominal"]),
        ("on=true,false", [True, False]),
        ("title=one, two", ["one, two"]),
        ("observers=[{name: rerun}]", [[{"name": "rerun"}]]),
        ("x=", [None]),
    ],
)
def test_the_text_of_an_axis_has_one_meaning(text: str, values: list[Any]) -> None:
    (axis,) = parse_axes([text])
    assert list(axis.values) == values
    assert [type(value) for value in axis.values] == [type(value) for value in values]


def test_a_mapping_says_the_same_as_texts() -> None:
    given = {"a": "0:4:5", "b": [[1, 2], [3, 4]], "c": np.linspace(0.0, 1.0, 3), "d": range(2), "e": 7}
    axes = parse_axes(given)
    assert [list(axis.values) for axis in axes] == [[0, 1, 2, 3, 4], [[1, 2], [3, 4]], [0.0, 0.5, 1.0], [0, 1], [7]]
    assert [axis.single for axis in axes] == [False, False, False, False, True]


@pytest.mark.parametrize(
    ("text", "log"),
    [("x=log:1e-6:1:3", True), ("x=0:1:3", False), ("x=1,0.1,0.01", True), ("x=1,2,3", False), ("x=a,b,c", False)],
)
def test_an_axis_knows_whether_it_is_logarithmic(text: str, log: bool) -> None:
    assert parse_axes([text])[0].log is log


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        (["seed"], "axis 'seed': expected key=values"),
        (["=1,2"], "expected a key such as problem.horizon"),
        (["a..b=1,2"], "expected a key such as problem.horizon"),
        (["x=a,,b"], "x: expected a value between commas, got nothing"),
        (["x=1,2,"], "x: expected a value between commas, got nothing"),
        (["x=0:1:0"], "x: expected a whole number of values at the end of '0:1:0', from 2 to 100000, got 0"),
        (["x=0:1:2.5"], "x: expected a whole number of values"),
        (["x=0:1:1"], "x: expected a whole number of values"),
        (["x=0:1:1000000"], "x: expected a whole number of values"),
        (["x=log:0:1:3"], "x: expected positive numbers in a logarithmic range, got 'log:0:1:3'"),
        (["x=log:a:b:c"], "x: expected values such as 1,2,3, start:stop:count such as 0:1:11"),
        (["x=1:1e999:3"], "x: expected finite numbers"),
        (["x=2:1"], "x: expected a range that goes up, got '2:1'"),
        (["x=1,2:3"], "x: expected one range, or values such as"),
        (["x=1,2", "x=3,4"], "x: expected every key once, got it twice"),
        (["x=1,1"], "x: expected every value once, got 1 twice"),
        (["x=[1,2"], "x: override value '[1,2': not valid YAML"),
    ],
)
def test_a_mistake_in_an_axis_is_one_sentence_with_its_key(texts: list[str], said: str) -> None:
    with pytest.raises(sr.InputError) as caught:
        parse_axes(texts)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def values_of(config: Path, axes: list[str], **arrangement: Any) -> list[tuple[Any, ...]]:
    return make_plan(config, axes, **arrangement).values()


def test_a_grid_has_all_combinations_and_its_last_axis_changes_first(config: Path) -> None:
    assert values_of(config, ["seed=0,1", "method.rounds=3,4"]) == [(0, 3), (0, 4), (1, 3), (1, 4)]


def test_zipped_axes_go_together_and_must_be_equally_long(config: Path) -> None:
    assert values_of(config, ["seed=0,1", "method.rounds=3,4"], points="zip") == [(0, 3), (1, 4)]
    with pytest.raises(sr.InputError, match=r"zip: expected axes with equally many values, got 2 of seed, 3 of m"):
        values_of(config, ["seed=0,1", "method.rounds=3,4,5"], points="zip")


@pytest.mark.parametrize("points", ["random", "sobol"])
def test_drawn_points_are_those_of_the_seed_and_more_points_begin_with_them(config: Path, points: Any) -> None:
    axes = ["problem.horizon=1.0:3.0", "method.wait=log:1e-6:1", "seed=0:9", "method.rounds=1,2,3"]
    few = values_of(config, axes, points=points, number=24)
    assert few == values_of(config, axes, points=points, number=50)[:24]
    assert few == values_of(config, axes, points=points, number=24)
    assert few != values_of(config, [*axes[:2], *axes[3:], "seed=5"], points=points, number=24)
    horizon, wait, seed, rounds = (list(column) for column in zip(*few, strict=True))
    assert all(1.0 <= one < 3.0 for one in horizon)
    assert sum(one < 1e-3 for one in wait) == pytest.approx(12, abs=4)  # evenly in the logarithm
    assert all(type(one) is int and 0 <= one <= 9 for one in seed)
    assert set(rounds) == {1, 2, 3}


def test_a_sequence_of_sobol_fills_evenly(config: Path) -> None:
    (column,) = zip(*values_of(config, ["problem.horizon=0.0:1.0"], points="sobol", number=16), strict=True)
    assert all(0.0 < b - a < 2 / 16 for a, b in pairwise(sorted(column)))


@pytest.mark.parametrize(
    ("axes", "arrangement", "said"),
    [
        (["problem.horizon=1:2"], {}, "problem.horizon: expected start:stop:count, or a number of points to draw"),
        (["seed=1,2"], {"points": "random", "number": 3}, "random: expected at least one range to draw from"),
        (["seed=0:999:1000", "method.rounds=1:1000:1000"], {}, "axes: expected at most 100000 points, got 1000000"),
    ],
)
def test_points_that_cannot_be_had_are_refused(config: Path, axes: Any, arrangement: Any, said: str) -> None:
    with pytest.raises(sr.InputError) as caught:
        values_of(config, axes, **arrangement)
    assert said in str(caught.value)


def test_the_file_of_a_study_says_the_same_again(config: Path, tmp_path: Path) -> None:
    axes = ["method.rounds=2", "seed=0:3:4", "problem.control.box=1.0,2.0", "method.wait=0"]
    plan = make_plan(config, axes, {"problem.horizon": 2.5})
    (tmp_path / "sweep.yaml").write_text(plan.written())
    again = read_plan(tmp_path / "sweep.yaml")
    assert [point.hash for point in plan.checked()] == [point.hash for point in again.checked()]
    assert again.written() == plan.written()
    assert [axis.key for axis in again.axes] == ["seed", "problem.control.box"]


def test_drawn_points_are_the_same_again_from_the_file(config: Path, tmp_path: Path) -> None:
    plan = make_plan(config, ["problem.horizon=1.0:3.0", "seed=3"], points="sobol", number=5)
    (tmp_path / "sweep.yaml").write_text(plan.written())
    assert read_plan(tmp_path / "sweep.yaml").values() == plan.values()


def test_a_file_names_its_base_and_a_command_adds_to_it(config: Path, tmp_path: Path) -> None:
    (tmp_path / "below").mkdir()
    file = tmp_path / "below" / "study.yaml"
    file.write_text(
        "base: ../small.yaml\noverrides: {method.rounds: 3}\naxes: {seed: 0:2:3, method.wait: [0.0, 0.5]}\n"
    )
    plan = make_plan(file, ["seed=7,8", "problem.horizon=1.0,2.0"])
    assert [(axis.key, list(axis.values)) for axis in plan.axes] == [
        ("seed", [7, 8]),
        ("method.wait", [0.0, 0.5]),
        ("problem.horizon", [1.0, 2.0]),
    ]
    first = plan.checked()[0].config
    assert (first["method"]["rounds"], first["title"]) == (3, "A double integrator")
    assert first["plugins"] == [str((tmp_path / "stub.py").resolve())]


def test_a_study_is_no_config_and_a_key_is_not_both_an_axis_and_an_override(config: Path, tmp_path: Path) -> None:
    file = tmp_path / "study.yaml"
    file.write_text("base: small.yaml\naxes: {seed: [0, 1]}\n")
    with pytest.raises(sr.ConfigError, match=r"study.yaml: expected a config, got a study, which has axes"):
        sr.run(file)
    with pytest.raises(sr.InputError, match="seed: expected an axis or an override, got both"):
        make_plan(config, {"seed": [0, 1]}, {"seed": 3})
    assert not make_plan(file, None, {"seed": 3}).axes  # what a call says holds, whatever the file says


@pytest.mark.slow
def test_the_check_of_many_configs_is_told(config: Path) -> None:
    heard: list[str] = []
    make_plan(config, ["seed=1:250:250"]).checked(lambda event: heard.append(getattr(event, "text", "")))
    assert heard == ["100 of 250 configs are checked", "200 of 250 configs are checked"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("axes: {seed: [0, 1]}", ":1:1: base: must be a config, or the name of its file (got null)"),
        ("base: nothing.yaml\naxes: {seed: [0, 1]}", "nothing.yaml: there is no such file"),
        ("base: small.yaml\naxes: [seed]", ":2:1: axes: must be a mapping of keys of the config to values"),
        ("base: small.yaml\naxis: {seed: [0, 1]}", ":2:1: axis: unknown key; did you mean 'axes'?"),
        ("base: small.yaml\naxes: {seed: 0:1:0}", ":2:8: seed: expected a whole number of values"),
        ("base: small.yaml\naxes: {seed: []}", ":2:8: seed: expected 1 to 100000 values, got 0"),
        ("base: small.yaml\naxes: {seed: [0, 1]}\npoints: some", ":3:1: points: must be one of grid, zip, random"),
        ("base: small.yaml\naxes: {seed: [0, 1]}\nnumber: 3", ":3:1: number: is for points that are drawn"),
        ("base: small.yaml\naxes: {seed: 0:1}\npoints: random", ":1:1: number: must be a whole number"),
        ("base: small.yaml\naxes: {seed: 0:1}\npoints: random\nnumber: true", ":4:1: number: must be a whole number"),
    ],
)
def test_a_study_file_at_fault_is_told_with_its_place(config: Path, tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "study.yaml"
    file.write_text(text)
    with pytest.raises(sr.InputError) as caught:
        make_plan(file)
    assert said in str(caught.value)


def test_a_value_at_fault_is_found_before_anything_is_run(config: Path, tmp_path: Path) -> None:
    with pytest.raises(sr.ConfigError, match=r"override solver.name=nosuch: .*no solver is named 'nosuch'"):
        sr.sweep(config, ["solver.name=piqp,nosuch"], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_decides_no_result_is_not_in_the_hash(config: Path) -> None:
    def hashes(changes: dict[str, Any]) -> set[str]:
        return {point.hash for point in make_plan(config, ["seed=0,1"], changes).checked()}

    plain = hashes({})
    assert plain == hashes({"title": "Other", "limits.seconds": 5.0, "observers": [], "executor": "serial"})
    assert not plain & hashes({"problem.horizon": 2.5})


SMALL = {
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 5.0,
        "initial_state": [4, 0],
        "control": {"box": 1},
    }
}
PAIRED = "problem.horizon,dictionaries.control.pieces"


def test_paired_keys_are_one_axis_of_a_product() -> None:
    plan = make_plan(SMALL, [f"{PAIRED}=[4.0,40],[5.0,40],[6.0,60]", "seed=1,2"])
    assert [axis.key for axis in plan.axes] == ["problem.horizon", "dictionaries.control.pieces", "seed"]
    pairs = [(4.0, 40), (5.0, 40), (6.0, 60)]
    assert plan.values() == [(*pair, seed) for pair in pairs for seed in (1, 2)]
    crossed = make_plan(SMALL, {"seed": [1, 2], PAIRED: np.array([[4.0, 40], [5.0, 50]])})
    assert crossed.values() == [(seed, *pair) for seed in (1, 2) for pair in ((4.0, 40.0), (5.0, 50.0))]
    config = plan.loaded(plan.values()[-1]).config.plain()
    assert (config["problem"]["horizon"], config["dictionaries"]["control"]["pieces"], config["seed"]) == (6.0, 60, 2)


@pytest.mark.parametrize("text", ["[4.0,40],[5.0,50]", "[[4.0,40],[5.0,50]]", " [4.0, 40] , [5.0, 50] "])
def test_paired_keys_are_written_in_brackets_or_without(text: str) -> None:
    assert make_plan(SMALL, [f"{PAIRED}={text}"]).values() == [(4.0, 40), (5.0, 50)]


def test_paired_keys_stand_in_the_file_of_a_study_and_are_read_again(tmp_path: Path) -> None:
    plan = make_plan(
        SMALL, [f"{PAIRED}=[4.0,40],[5.0,50]", "seed=0:2:3", "method,problem.control.box=[exchange,1],[nominal,2]"]
    )
    (tmp_path / "sweep.yaml").write_text(plan.written())
    again = read_plan(tmp_path / "sweep.yaml")
    assert again.values() == plan.values()
    assert len(plan.values()) == 12
    assert again.written() == plan.written()
    wider = make_plan(tmp_path / "sweep.yaml", [f"{PAIRED}=[7.0,70],[8.0,80]"])
    assert {row[:2] for row in wider.values()} == {(7.0, 70), (8.0, 80)}


def test_paired_keys_are_drawn_together_and_a_single_pair_is_a_change() -> None:
    for points in ("random", "sobol"):
        plan = make_plan(SMALL, [f"{PAIRED}=[4.0,40],[5.0,50]", "problem.control.box=0.5:1.0"], points=points, number=8)
        rows = plan.values()
        assert {row[:2] for row in rows} == {(4.0, 40), (5.0, 50)}
        assert len({row[2] for row in rows}) == 8
    single = make_plan(SMALL, [f"{PAIRED}=[4.0,40]", "seed=1,2"])
    assert single.values() == [(1,), (2,)]
    assert single.loaded((1,)).config.plain()["problem"]["horizon"] == 4.0


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        ([f"{PAIRED}=4,5"], "expected lists of 2 values, one for each key, such as"),
        ([f"{PAIRED}=[4.0,40],[5.0]"], "expected lists of 2 values"),
        ([f"{PAIRED}=[4.0,40],[4.0,40]"], "every value once"),
        ([f"{PAIRED}=[4.0,40],[5.0,50]", "problem.horizon=4,5"], "every key once"),
        (["seed,title=[1,a],[2,b]"], "a key that decides a result"),
    ],
)
def test_pairs_that_make_no_sense_are_refused(axes: list[str], words: str) -> None:
    with pytest.raises(sr.InputError, match=words):
        make_plan(SMALL, axes)


@pytest.mark.parametrize("change", [{"axes": ["problem.horizon=4,5"]}, {"overrides": ["problem.horizon=4"]}])
def test_one_of_two_paired_keys_is_not_changed_alone(change: dict[str, list[str]], tmp_path: Path) -> None:
    (tmp_path / "sweep.yaml").write_text(make_plan(SMALL, [f"{PAIRED}=[4.0,40],[5.0,50]"]).written())
    with pytest.raises(sr.InputError, match="together, since these keys are paired"):
        make_plan(tmp_path / "sweep.yaml", **change)


def test_a_study_of_pairs_has_a_table_and_a_figure(tmp_path: Path) -> None:
    axes = {PAIRED: [[4.5, 10], [5.0, 10], [5.5, 20]], "solver.name": ["piqp", "clarabel"]}
    study = sr.sweep(SMALL, axes, out=tmp_path / "study")
    assert [
        (row["problem.horizon"], row["dictionaries.control.pieces"], row["solver.name"]) for row in study.table
    ] == [(horizon, pieces, name) for horizon, pieces in axes[PAIRED] for name in axes["solver.name"]]
    assert {row["status"] for row in study.table} == {"certified"}
    assert (tmp_path / "study" / "sweep.png").stat().st_size > 0
    assert len(sr.sweep(tmp_path / "study").table) == 6
