"""Guards experiment/comparison/compare: runs side by side: honest bounds, labels that say what differs, and one message
for everything that is no run."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Mapping
from copy import deepcopy
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.comparison.compare import compare, comparison_remarks, comparison_table
from sparserob_core.experiment.comparison.figure import draw_comparison
from sparserob_core.experiment.comparison.labels import labels
from sparserob_core.experiment.config.reading.reader import write_yaml
from sparserob_core.experiment.directory.artefacts import RunDirectory
from sparserob_core.experiment.figures.style import save_figure
from tests.support.stub import Command

EXACT = 2.0
PROBLEM = {"name": "linear", "horizon": 1.0, "disturbance": {"box": [0.1, 0.1]}, "path": [{"box": [1.0, None]}]}
BASE: dict[str, Any] = {
    "title": "A plant",
    "problem": PROBLEM,
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 10}, "disturbance": None},
    "method": {"name": "exchange", "tolerance": 1e-7},
    "maximiser": {"name": "direct", "budget": 2000},
    "solver": {"name": "piqp"},
    "seed": 0,
    "observers": [],
    "plugins": [],
}
SEARCH = {
    "method": {"name": "sparserob", "formulation": "reduced"},
    "maximiser": {"name": "random_search", "budget": 2000},
}


def config_of(**changes: Any) -> dict[str, Any]:
    return {**deepcopy(BASE), **changes}


def summary_of(status: str, lower: float, cost: float, counts: Mapping[str, int]) -> dict[str, Any]:
    return {
        "title": "A plant",
        "status": status,
        "message": f"it is {status}",
        "cost": cost,
        "lower_bound": lower,
        "upper_bound": cost if status == "certified" else np.inf,
        "worst": {"violation": 1e-3},
        "counts": counts,
        "seconds": 2.5,
    }


class Runs:
    """Writes run directories as a run does."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def rounds(self, name: str, status: str = "certified", **changes: Any) -> Path:
        summary = summary_of(status, EXACT - 2e-8, EXACT + 2e-8, {"relaxed_programs": 9})
        trace = {
            "lower_bound": [-np.inf, 1.0, 1.9, 1.5, EXACT - 2e-8],
            "relaxed_programs": [1, 3, 5, 7, 9],
            "seconds": [0.1, 0.2, 0.3, 0.4, 0.5],
        }
        return self.write(name, config_of(**changes), summary, {"trace.npz": trace})

    def search(
        self,
        name: str,
        values: tuple[float, ...] = (1.0, 1.0, 1.81, 1.81, 1.99),
        final: float | None = None,
        **changes: Any,
    ) -> Path:
        summary = summary_of(
            "refuted",
            values[-1] if final is None else final,
            1.995,
            {"relaxed_programs": 40, "evaluations": len(values)},
        )
        columns = {"bound": np.array(values), "seconds": np.arange(1.0, len(values) + 1) / 10}
        return self.write(name, config_of(**{**SEARCH, **changes}), summary, {"evaluations.npz": columns})

    def write(
        self, name: str, config: Mapping[str, Any], summary: Mapping[str, Any], arrays: Mapping[str, Mapping[str, Any]]
    ) -> Path:
        path = self.folder / name
        path.mkdir()
        directory = RunDirectory(path)
        directory.write_text("config.yaml", write_yaml(config))
        directory.write_json("result.json", summary)
        for file, columns in arrays.items():
            directory.write_arrays(file, columns)
        return path


@pytest.fixture
def runs(tmp_path: Path) -> Runs:
    return Runs(tmp_path)


def test_the_exact_value_is_the_mean_of_the_bounds_of_the_certified_run(runs: Runs) -> None:
    comparison = compare([runs.search("a"), runs.rounds("b")])
    assert comparison.certified == 1
    assert comparison.exact == pytest.approx(EXACT, abs=1e-12)


def test_without_a_certified_run_nothing_is_exact_and_no_line_is_drawn(runs: Runs) -> None:
    comparison = compare([runs.search("a"), runs.rounds("b", status="verified")])
    assert comparison.certified is None
    assert "no run is certified" in next(comparison_remarks(comparison))
    assert "share of exact" not in comparison_table(comparison)[0]
    assert not [
        line
        for axes in draw_comparison(comparison).axes
        for line in axes.get_lines()
        if "exact" in str(line.get_label())
    ]


def test_evaluations_count_until_the_bound_is_within_a_share_of_the_exact_value(runs: Runs) -> None:
    columns, rows = comparison_table(compare([runs.search("a"), runs.rounds("b")]))
    first, second = (dict(zip(columns, row, strict=True)) for row in rows)
    assert (first["to 10 %"], first["to 1 %"], first["to 0.1 %"]) == ("3", "5", "-")
    assert (second["to 10 %"], second["to 1 %"], second["to 0.1 %"]) == ("5", "9", "9")
    assert (first["share of exact"], first["worst violation"], first["evaluations"]) == ("99.5000%", "1.00e-03", "5")


@pytest.mark.parametrize(("exact", "bound", "share"), [(2.0, 1.5, 0.75), (-2.0, -2.5, 0.75), (2.0, 2.0, 1.0)])
def test_the_share_is_one_less_the_relative_shortfall_whatever_the_sign(
    exact: float, bound: float, share: float
) -> None:
    assert sr.Comparison((), (), exact, 0).share(bound) == pytest.approx(share)


def test_a_share_of_zero_is_not_defined() -> None:
    assert np.isnan(sr.Comparison((), (), 0.0, 0).share(-1.0))


def test_a_curve_never_falls_and_leaves_out_what_is_not_proven(runs: Runs) -> None:
    curve = compare([runs.rounds("a")]).curves[0]
    assert curve.bound.tolist() == [1.0, 1.9, 1.9, EXACT - 2e-8]
    assert curve.evaluations.tolist() == [3, 5, 7, 9]


def test_a_search_is_kept_by_its_improvements(runs: Runs) -> None:
    curve = compare([runs.search("a")]).curves[0]
    assert curve.bound.tolist() == [1.0, 1.81, 1.99]
    assert curve.evaluations.tolist() == [1, 3, 5]


def test_a_bound_that_was_proven_after_the_last_evaluation_ends_the_curve(runs: Runs) -> None:
    curve = compare([runs.search("a", final=1.995)]).curves[0]
    assert (curve.evaluations[-1], curve.seconds[-1], curve.bound[-1]) == (5, 2.5, 1.995)


def test_labels_say_what_differs_and_nothing_else() -> None:
    annealing = {"name": "simulated_annealing", "budget": 2000}
    literal = {"name": "sparserob", "formulation": "literal"}
    configs = [
        config_of(),
        config_of(**SEARCH),
        config_of(**{**SEARCH, "seed": 7}),
        config_of(method=literal, maximiser=annealing),
    ]
    assert labels(configs, [False, True, True, True]) == [
        "exchange",
        "sparserob with random_search, reduced, seed 0",
        "sparserob with random_search, reduced, seed 7",
        "sparserob with simulated_annealing, literal",
    ]
    assert labels([config_of(**SEARCH), config_of(method=SEARCH["method"], maximiser=annealing)], [True, True]) == [
        "random_search",
        "simulated_annealing",
    ]
    assert labels([config_of(), config_of(solver={"name": "clarabel"})], [False, False]) == [
        "exchange, solver piqp",
        "exchange, solver clarabel",
    ]
    assert labels([config_of()], [False]) == ["exchange"]


def test_a_solver_that_hands_the_work_to_another_is_told_with_it() -> None:
    osqp, daqp = ({"name": "qpsolvers", "solver": name} for name in ("osqp", "daqp"))
    exact = {**osqp, "eps_abs": 1e-9}
    assert labels([config_of(), config_of(solver=osqp)], [False, False]) == [
        "exchange, solver piqp",
        "exchange, solver qpsolvers (osqp)",
    ]
    assert labels([config_of(solver=one) for one in ({"name": "piqp"}, osqp, daqp, exact)], [False] * 4) == [
        "exchange, solver piqp",
        "exchange, solver qpsolvers (osqp)",
        "exchange, solver qpsolvers (daqp)",
        "exchange, solver qpsolvers (osqp), solver eps_abs 1e-09",
    ]
    assert labels([config_of(solver=osqp), config_of(solver=daqp)], [False, False]) == [
        "exchange, solver qpsolvers (osqp)",
        "exchange, solver qpsolvers (daqp)",
    ]


def test_options_of_a_component_are_compared_between_runs_that_have_it() -> None:
    wide = {"name": "random_search", "budget": 50, "rule": {"name": "geometric", "factor": 0.5}}
    configs = [config_of(**SEARCH), config_of(method=SEARCH["method"], maximiser=wide)]
    assert labels(configs, [True, True]) == [
        "random_search, budget 2000",
        "random_search, budget 50, rule geometric (factor 0.5)",
    ]


def test_equal_labels_are_told_apart_by_a_number(runs: Runs) -> None:
    run = runs.rounds("a")
    assert list(compare([run, run]).labels) == ["exchange (1)", "exchange (2)"]


@pytest.mark.parametrize("status", ["failed", "infeasible"])
def test_a_run_without_an_answer_keeps_its_row_and_has_no_curve(runs: Runs, status: str) -> None:
    comparison = compare([runs.rounds("a"), runs.rounds("b", status=status, seed=1)])
    _, rows = comparison_table(comparison)
    assert rows[1][:2] == ["exchange, seed 1", status]
    assert f"no curve of exchange, seed 1: {status}: it is {status}" in list(comparison_remarks(comparison))
    assert not comparison.curves[1].bound.size
    assert draw_comparison(comparison).axes


def test_a_bound_above_the_certified_value_is_told(runs: Runs) -> None:
    said = list(comparison_remarks(compare([runs.rounds("a"), runs.search("b", values=(1.0, 2.1))])))
    assert "the lower bound of sparserob with random_search exceeds the certified upper bound" in said[-1]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"problem": {**PROBLEM, "horizon": 2.0}}, "problem.horizon is 2 here and 1 there"),
        ({"problem": {**PROBLEM, "disturbance": None}}, "problem.disturbance is none here"),
        (
            {"problem": {**PROBLEM, "path": [{"box": [0.5, None]}]}},
            r"problem.path.0.box is \[0.5, none\] here and \[1, none\] there",
        ),
        ({"dictionaries": {"control": {"name": "haar", "pieces": 10}}}, "dictionaries.control.name is haar here"),
    ],
)
def test_runs_of_different_problems_are_refused_with_the_difference(
    runs: Runs, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(sr.InputError, match=f"expected a run of the same problem as .*; {said}"):
        compare([runs.rounds("a"), runs.rounds("b", **changes)])


def test_a_key_that_an_older_run_does_not_have_is_null(runs: Runs) -> None:
    older = {"control": BASE["dictionaries"]["control"]}
    assert len(compare([runs.rounds("a"), runs.rounds("b", dictionaries=older)]).curves) == 2


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("result.json", "{"),
        ("result.json", "[]"),
        ("config.yaml", "a: ["),
        ("config.yaml", "title: x"),
        ("trace.npz", "no archive"),
        ("trace.npz", None),
        ("result.json", None),
        ("config.yaml", None),
    ],
)
def test_a_file_that_is_broken_or_missing_is_named(runs: Runs, file: str, content: str | None) -> None:
    run = runs.rounds("a")
    (run / file).unlink()
    if content is not None:
        (run / file).write_text(content)
    with pytest.raises(sr.InputError, match=file):
        compare([run])


@pytest.mark.parametrize(
    "columns", [{"bound": [1.0]}, {"bound": [1.0], "seconds": [1.0, 2.0]}, {"bound": [np.nan], "seconds": [1.0]}]
)
def test_columns_that_do_not_fit_are_refused(runs: Runs, columns: dict[str, Any]) -> None:
    run = runs.search("a")
    RunDirectory(run).write_arrays("evaluations.npz", columns)
    with pytest.raises(sr.InputError, match=r"evaluations\.npz"):
        compare([run])


@pytest.mark.parametrize("given", [[], "runs/a"])
def test_a_list_of_runs_is_expected(given: Any) -> None:
    with pytest.raises(sr.InputError, match="runs: expected a list"):
        compare(given)


@pytest.mark.first(1)
@pytest.mark.parametrize("count", [1, 2, 10])
def test_the_figure_has_both_panels_for_any_number_of_runs(runs: Runs, count: int) -> None:
    comparison = compare([runs.rounds("exact"), *(runs.search(f"run{k}", seed=k) for k in range(count - 1))])
    left, right = draw_comparison(comparison).axes
    assert [len(axes.get_lines()) for axes in (left, right)] == [count + 1] * 2
    looks = [(line.get_color(), str(line.get_linestyle()), line.get_marker()) for line in left.get_lines()]
    assert len(set(looks)) >= min(count, 7) + 1
    low, high = left.get_ylim()
    assert low < 1.0 < EXACT < high


def test_an_axis_within_a_decade_is_linear(runs: Runs) -> None:
    left, right = draw_comparison(compare([runs.rounds("a")])).axes
    assert (left.get_xscale(), right.get_xscale()) == ("linear", "log")


@pytest.mark.slow
@pytest.mark.parametrize("last", [2, 9, 12, 60, 900, 100_000])
def test_the_numbers_of_an_axis_do_not_touch(runs: Runs, last: int) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    values = tuple(np.linspace(1.0, 1.9, last))
    figure = draw_comparison(compare([runs.search("a", values), runs.search("b", values, seed=1)]))
    FigureCanvasAgg(figure).draw()  # type: ignore[no-untyped-call]
    for axes in figure.axes:
        low, high = axes.get_xlim()
        ticks = [
            tick
            for tick in axes.xaxis.get_major_ticks() + axes.xaxis.get_minor_ticks()
            if low <= tick.get_loc() <= high
        ]
        boxes = sorted(
            (tick.label1.get_window_extent() for tick in ticks if tick.label1.get_text()), key=lambda box: box.x0
        )
        assert len(boxes) >= 2
        assert all(one.x1 < two.x0 for one, two in pairwise(boxes))


def test_a_first_bound_far_below_does_not_flatten_the_others(runs: Runs) -> None:
    comparison = compare([runs.rounds("a"), runs.search("b", values=(-1e6, 1.0, 1.9))])
    assert draw_comparison(comparison).axes[0].get_ylim()[0] > -2 * EXACT


@pytest.mark.first(1)
@pytest.mark.parametrize("ending", ["png", "pdf", "svg"])
def test_the_ending_decides_the_kind_of_the_picture(runs: Runs, tmp_path: Path, ending: str) -> None:
    file = tmp_path / "new" / f"picture.{ending}"
    compare([runs.rounds("a")], file)
    assert file.read_bytes()[:4] in (b"%PDF", b"\x89PNG", b"<?xm")


def test_a_picture_that_cannot_be_written_or_drawn_is_an_error_of_the_input(runs: Runs, tmp_path: Path) -> None:
    run = runs.rounds("a")
    (tmp_path / "file").touch()
    (tmp_path / "folder.png").mkdir()
    for out in ("picture.jpg", "picture", "file/picture.png", "folder.png"):
        with pytest.raises(sr.InputError, match=out.split("/")[-1]):
            compare([run], tmp_path / out)
    with pytest.raises(sr.InputError, match="nothing to draw"):
        compare([runs.rounds("b", status="failed")], tmp_path / "picture.png")


def test_a_missing_matplotlib_is_named_with_the_line_that_brings_it(
    runs: Runs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    comparison = compare([runs.rounds("a")])
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(sr.InputError, match=r"pip install .matplotlib"):
        save_figure(tmp_path / "picture.png", draw_comparison, comparison)


def test_the_command_prints_a_table_and_writes_the_picture(runs: Runs, command: Command, tmp_path: Path) -> None:
    runs.rounds("a")
    runs.search("b")
    done = command("compare", "a", "b")
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert lines[0] == "A plant"
    assert lines[2].split()[:2] == ["exchange", "certified"]
    assert lines[-2:] == [
        "exact optimum 2: certified by exchange to a relative gap of 2.0e-08",
        "written to compare.png",
    ]
    assert (tmp_path / "compare.png").read_bytes()[:4] == b"\x89PNG"


def test_a_finished_and_a_failed_run_of_the_program_itself_can_be_compared(
    config: Path, command: Command, tmp_path: Path
) -> None:
    command("run", config, "--out", "a", "--no-figures")
    command("run", config, "--out", "b", "--no-figures", "method.fail=true")
    assert not (tmp_path / "b" / "solution.npz").exists()
    done = command("compare", "a", "b", "--out", "both.pdf")
    assert (done.returncode, done.stderr) == (0, "")
    assert re.search(
        r"no curve of stub, fail on: failed: PluginError: method 'stub' .*: solve raised RuntimeError: the stub fell",
        done.stdout,
    )
    assert json.loads((tmp_path / "a" / "result.json").read_text())["status"] == "certified"


@pytest.mark.parametrize(
    "arguments", [[], ["nothing"], ["."], ["small.yaml"], ["a", "."], ["a", "--out", "x.jpg"], ["a", "--out", "a"]]
)
def test_a_command_at_fault_is_status_2_and_one_message(
    config: Path, runs: Runs, command: Command, arguments: list[str]
) -> None:
    runs.rounds("a")
    done = command("compare", *arguments)
    assert done.returncode == 2
    assert "rror" in done.stderr
    assert "Traceback" not in done.stderr


def test_help_needs_neither_numpy_nor_matplotlib() -> None:
    program = (
        "import sys\nfrom sparserob_core.experiment.cli.main import _run_command_line\n"
        "_run_command_line(['compare', '--help'])\n"
        "print('heavy:', *sorted(name for name in sys.modules if '.' not in name))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert not {"numpy", "scipy", "matplotlib", "pydantic", "ruamel"} & set(done.stdout.split("heavy:")[-1].split())
