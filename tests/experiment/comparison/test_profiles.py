"""Guards experiment/comparison/profiles: performance and data profiles against cases computed by hand, and studies as
they are on disk."""

from __future__ import annotations

import json
import shutil
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sparserob_core as sr
from sparserob_core.experiment.comparison.profiles import LOWER, MIDDLE, UPPER, Instance, Profiles
from sparserob_core.experiment.comparison.profiles_figure import draw_profiles
from sparserob_core.experiment.figures.style import save_figure

NEVER = np.inf


def profiles_of(*problems, unit=5.0, measure="evaluations", certified=True):
    """Of each problem, for each contender, its times over the seeds."""
    times = [[np.array(one, dtype=float) for one in problem] for problem in problems]
    count = len(times[0])
    return Profiles(
        title="by hand",
        measure=measure,
        accuracy=0.01,
        contenders=[f"contender {s}" for s in range(count)],
        problems=[Instance(f"problem {p}", 1.0, certified, unit) for p in range(len(times))],
        seeds=[range(max(one.size for one in row)) for row in times],
        times=times,
        failed=[0] * count,
    )


BY_HAND = profiles_of([[10], [20]], [[40], [10]], [[NEVER], [30]])


def test_ratios_are_those_of_dolan_and_more():
    np.testing.assert_array_equal(BY_HAND.ratios(), [[1.0, 2.0], [4.0, 1.0], [NEVER, 1.0]])


@pytest.mark.parametrize(
    ("factor", "shares"),
    [(1.0, [1 / 3, 2 / 3]), (1.99, [1 / 3, 2 / 3]), (2.0, [1 / 3, 1.0]), (4.0, [2 / 3, 1.0]), (np.inf, [2 / 3, 1.0])],
)
def test_performance_profiles_by_hand(factor, shares):
    np.testing.assert_allclose(BY_HAND.performance(factor), shares)


@pytest.mark.parametrize(
    ("budget", "shares"), [(1.9, [0, 0]), (2.0, [1 / 3, 1 / 3]), (4.0, [1 / 3, 2 / 3]), (8.0, [2 / 3, 1.0])]
)
def test_data_profiles_by_hand_count_gradients_by_differences(budget, shares):
    np.testing.assert_allclose(BY_HAND.data(budget), shares)


def test_data_profiles_of_seconds_have_no_unit():
    seconds = profiles_of([[10], [20]], measure="seconds")
    np.testing.assert_array_equal(seconds.data(10.0), [1.0, 0.0])


@pytest.mark.parametrize(
    ("times", "quartiles"),
    [
        ([4, 1, 3, 2], (1, 2, 3)),
        ([5, 9, 7], (5, 7, 9)),
        ([1, NEVER, NEVER], (1, NEVER, NEVER)),
        ([NEVER, 2, 1, 3], (1, 2, 3)),
        ([6], (6, 6, 6)),
    ],
)
def test_quartiles_are_times_within_which_that_share_of_the_seeds_came_there(times, quartiles):
    one = profiles_of([times, times])
    assert [one.quantile(share)[0, 0] for share in (LOWER, MIDDLE, UPPER)] == list(quartiles)


def test_a_problem_that_nobody_solves_counts_for_nobody():
    one = profiles_of([[NEVER], [NEVER]], [[3], [6]])
    np.testing.assert_array_equal(one.performance(np.inf), [0.5, 0.5])
    np.testing.assert_array_equal(one.data(1e9), [0.5, 0.5])
    np.testing.assert_array_equal(one.solved(), [0.5, 0.5])


values = st.one_of(st.integers(1, 50).map(float), st.just(NEVER))


@given(st.lists(st.lists(st.lists(values, min_size=3, max_size=3), min_size=2, max_size=2), min_size=1, max_size=4))
def test_profiles_rise_from_0_to_the_share_of_what_was_solved(problems):
    one = profiles_of(*problems)
    factors = [0.5, 1.0, 2.0, 10.0, np.inf]
    for profile, first in ((one.performance, 0.5), (one.data, 0.1)):
        shares = [profile(factor) for factor in factors]
        assert (profile(first * 0.3) == 0).all()
        assert all((early <= late).all() for early, late in pairwise(shares))
        np.testing.assert_array_equal(shares[-1], np.isfinite(one.quantile(MIDDLE)).mean(axis=0))
    someone = np.isfinite(one.quantile(MIDDLE)).any(axis=1)
    assert one.performance(1.0).sum() >= someone.mean() - 1e-12, "the best of a problem that was solved has ratio 1"
    assert (one.quantile(LOWER) <= one.quantile(UPPER)).all()


def test_the_summary_has_the_steps_and_is_plain_data():
    told = json.loads(json.dumps(BY_HAND.summary()))
    assert told["contenders"][0]["performance_profile"] == {"at": [1.0, 4.0], "share": [1 / 3, 2 / 3]}
    assert told["contenders"][1]["data_profile"] == {"at": [2.0, 4.0, 6.0], "share": [1 / 3, 2 / 3, 1.0]}
    assert told["problems"][0]["times"]["contender 1"]["median"] == 20.0


def test_a_value_that_nobody_has_certified_is_told():
    assert any("no certified run of problem 0" in line for line in profiles_of([[1], [2]], certified=False).remarks())
    assert not any("no certified run" in line for line in BY_HAND.remarks())


def test_the_figure_shows_the_steps_of_every_contender():
    pytest.importorskip("matplotlib")
    left, right = draw_profiles(profiles_of([[10], [20]], [[40], [10]], [[NEVER], [NEVER]])).axes
    steps = {line.get_label(): (line.get_xdata(), line.get_ydata()) for line in left.get_lines()}
    np.testing.assert_allclose(steps["contender 0"][0][1:-1], [1.0, 4.0])
    np.testing.assert_allclose(steps["contender 0"][1][1:], [1 / 3, 2 / 3, 2 / 3])
    assert right.get_xlabel() == "evaluations / $(n + 1)$"


def test_contenders_who_solve_nothing_are_drawn_too(tmp_path):
    pytest.importorskip("matplotlib")
    save_figure(tmp_path / "none.png", draw_profiles, profiles_of([[NEVER, NEVER], [NEVER, NEVER]]))
    assert (tmp_path / "none.png").stat().st_size


BASE = {
    "title": "A cart",
    "problem": {
        "name": "linear", "horizon": 1.0, "system": {"A": [[0.0]], "B": [[1.0]]}, "initial_state": [1.0],
        "control": {"box": 4.0}, "disturbance": {"box": [0.01]}, "terminal": [{"box": 0.1}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}}, "observers": [],
}  # fmt: skip


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    axes = {"solver.name": ["piqp", "clarabel"], "problem.terminal.0.box": [0.1, 0.2], "seed": [0, 1]}
    sr.sweep(BASE, axes, out=folder / "study")
    return folder / "study"


@pytest.mark.slow
def test_a_study_is_compared_over_its_problems_and_seeds(study, tmp_path):
    found = sr.compare([study], out=tmp_path / "profiles.png")
    assert isinstance(found, sr.Profiles)
    assert list(found.contenders) == ["exchange, solver piqp", "exchange, solver clarabel"]
    assert [problem.label for problem in found.problems] == ["terminal.0.box 0.1", "terminal.0.box 0.2"]
    assert [list(one) for one in found.seeds] == [[0, 1], [0, 1]]
    assert all(problem.certified for problem in found.problems)
    assert found.measure == "seconds"
    for problem, box in zip(found.problems, (0.1, 0.2), strict=True):  # |w| <= 0.01 widens the end by 0.01
        assert problem.exact == pytest.approx(1.0 - (box - 0.01), rel=1e-6)
    np.testing.assert_array_equal(found.solved(), [1.0, 1.0])
    assert (tmp_path / "profiles.png").is_file()


@pytest.mark.slow
def test_the_command_prints_both_tables_and_json(study, tmp_path, command):
    done = command("compare", study, "--measure", "evaluations", "--out", tmp_path / "a.png")
    assert done.returncode == 0, done.stderr
    assert "within 10x" in done.stdout
    assert "median evaluations" in done.stdout
    assert "an evaluation of a method that does not search is a relaxed program" in done.stdout
    told = json.loads(command("compare", study, "--json", "--out", tmp_path / "a.png").stdout)
    assert [one["label"] for one in told["contenders"]] == ["exchange, solver piqp", "exchange, solver clarabel"]


def test_runs_are_told_as_json_too(study, tmp_path, command):
    run = next((study / "runs").iterdir())
    told = json.loads(command("compare", run, "--json", "--out", tmp_path / "a.png").stdout)
    assert told["runs"][0]["status"] == "certified"


@pytest.mark.slow
def test_a_study_in_two_halves_is_the_whole(study, tmp_path):
    for box in (0.1, 0.2):
        sr.sweep(
            {**BASE, "problem": {**BASE["problem"], "terminal": [{"box": box}]}},
            {"solver.name": ["piqp", "clarabel"], "seed": [0, 1]},
            out=tmp_path / f"{box}",
        )
    whole, halves = (
        sr.compare([study], measure="evaluations"),
        sr.compare([tmp_path / "0.1", tmp_path / "0.2"], measure="evaluations"),
    )
    np.testing.assert_array_equal(whole.quantile(MIDDLE), halves.quantile(MIDDLE))
    assert halves.contenders == whole.contenders


def broken(study, folder, change):
    copy = folder / "broken"
    shutil.copytree(study, copy)
    change(copy)
    return copy


def test_a_point_without_a_run_counts_as_not_solved(study, tmp_path):
    def change(copy):
        shutil.rmtree(next((copy / "runs").iterdir()))

    found = sr.compare([broken(study, tmp_path, change)])
    assert np.isinf(np.concatenate([times for row in found.times for times in row])).sum() == 1
    assert any("count as not solved" in line for line in found.remarks())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda copy: cut(copy / "table.csv"), "expected a finished study, got 7 of 8 points"),
        (lambda copy: (copy / "table.csv").unlink(), "table.csv"),
        (lambda copy: (copy / "sweep.yaml").write_text("axes: 3\n"), "sweep.yaml"),
    ],
)
def test_a_study_at_fault_is_named(study, tmp_path, change, words):
    with pytest.raises(sr.InputError, match=words):
        sr.compare([broken(study, tmp_path, change)])


def cut(file):
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join(lines[:-1]))


def test_one_contender_is_no_comparison(tmp_path):
    sr.sweep(BASE, {"seed": [0, 1]}, out=tmp_path / "one")
    with pytest.raises(sr.InputError, match="at least two contenders"):
        sr.compare([tmp_path / "one"])


def test_a_run_is_not_compared_with_a_study(study):
    run = next((study / "runs").iterdir())
    with pytest.raises(sr.InputError, match="a study is compared with studies only"):
        sr.compare([study, run])


@pytest.mark.parametrize(("name", "value"), [("accuracy", 0.0), ("accuracy", 1.5), ("measure", "hours")])
def test_an_argument_at_fault_is_named(study, name, value):
    with pytest.raises(sr.InputError, match=f"{name}: expected"):
        sr.compare([study], **{name: value})


def test_without_matplotlib_the_numbers_are_there_and_the_remarks_say_why_there_is_no_picture(
    study, tmp_path, monkeypatch
):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for found in (
        sr.compare([study], out=tmp_path / "a.png"),
        sr.compare([next((study / "runs").iterdir())], out=tmp_path / "a.png"),
    ):
        assert "no figure: matplotlib is not installed" in found.undrawn
    assert not (tmp_path / "a.png").exists()
    simulation = sr.simulate(next((study / "runs").iterdir()), 10, out=tmp_path / "b.png")
    assert "no figure: matplotlib is not installed" in list(simulation.remarks())[-1]
