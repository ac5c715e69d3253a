"""Guards experiment/sweep/figure: which picture a study gets, and that it shows every bound and every status."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.figures.style import save_figure
from sparserob_core.experiment.sweep.axes import parse_axes
from sparserob_core.experiment.sweep.figure import MARKS, draw_study
from sparserob_core.experiment.sweep.study import Study, shown
from sparserob_core.experiment.sweep.table import axis_unit, columns_text
from sparserob_core.sip.result import MEANING

pytest.importorskip("matplotlib")


def study(axes: dict[str, object], rows: list[dict[str, Any]], arrangement: Any = "grid", out: Path = Path()) -> Study:
    known = [{"status": "certified", "cost": 1.0, "lower_bound": 0.9, "seconds": 0.1, **row} for row in rows]
    return Study(out, "A title", parse_axes(axes), known, len(rows), arrangement)


def lines(figure: Any, panel: int = 0) -> list[Any]:
    return [line for line in figure.axes[panel].get_lines() if len(line.get_xdata())]


def legend(figure: Any) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_every_status_has_a_mark() -> None:
    assert set(MARKS) == set(MEANING)
    assert len(set(MARKS.values())) == len(MARKS)


def test_one_numeric_axis_is_a_curve_of_both_bounds_with_the_statuses() -> None:
    rows = [{"x": 1.0, "cost": 3.0, "lower_bound": 2.0}, {"x": 2.0, "cost": 5.0, "lower_bound": 4.0}]
    rows += [{"x": 3.0, "cost": None, "lower_bound": None, "status": "infeasible"}]
    figure = draw_study(study({"x": [1.0, 2.0, 3.0]}, rows))
    cost, lower, *marks = lines(figure)
    assert np.array_equal(cost.get_ydata(), [3.0, 5.0, np.nan], equal_nan=True)
    assert np.array_equal(lower.get_ydata(), [2.0, 4.0, np.nan], equal_nan=True)
    assert [list(mark.get_xdata()) for mark in marks] == [[1.0, 2.0], [3.0]]
    assert [mark.get_marker() for mark in marks] == [MARKS["certified"], MARKS["infeasible"]]
    assert {"certified", "infeasible"} <= set(legend(figure))
    assert figure.axes[0].get_xlabel() == "x"


def test_rows_in_any_order_give_one_line_from_left_to_right() -> None:
    figure = draw_study(study({"x": [3, 1, 2]}, [{"x": x, "cost": float(x)} for x in (3, 1, 2)]))
    assert list(lines(figure)[0].get_xdata()) == [1.0, 2.0, 3.0]
    assert list(lines(figure)[0].get_ydata()) == [1.0, 2.0, 3.0]


def test_a_logarithmic_axis_is_drawn_as_one() -> None:
    rows = [{"x": 10.0**-k, "cost": float(k + 1)} for k in range(4)]
    assert draw_study(study({"x": "log:1e-3:1:4"}, rows)).axes[0].get_xscale() == "log"
    assert draw_study(study({"x": [0.0, 1.0]}, [{"x": 0.0}, {"x": 1.0}])).axes[0].get_xscale() == "linear"


def test_other_values_are_further_curves_and_seeds_are_a_median() -> None:
    rows = [
        {"x": x, "method": method, "seed": seed, "cost": x + (method == "b") + [0.0, 0.25, 9.0][seed]}
        for x in (1.0, 2.0)
        for method in ("a", "b")
        for seed in range(3)
    ]
    figure = draw_study(study({"x": [1.0, 2.0], "method": ["a", "b"], "seed": "0:2:3"}, rows))
    thick = [line for line in lines(figure) if line.get_linewidth() > 1.0 and line.get_linestyle() != "None"]
    assert [list(line.get_ydata()) for line in thick] == [[1.25, 2.25], [2.25, 3.25]]
    assert {"a", "b"} <= set(legend(figure))


def test_of_several_seeds_the_status_that_proves_least_is_marked() -> None:
    rows = [{"x": 1.0, "seed": 0}, {"x": 1.0, "seed": 1, "status": "refuted"}, {"x": 2.0, "seed": 0}]
    figure = draw_study(study({"x": [1.0, 2.0], "seed": [0, 1]}, rows))
    marked = {line.get_marker(): list(line.get_xdata()) for line in lines(figure) if line.get_linestyle() == "None"}
    assert marked == {MARKS["refuted"]: [1.0], MARKS["certified"]: [2.0]}


def test_two_numeric_axes_are_a_map_whose_cells_hold_the_costs() -> None:
    values = [1.0, 2.0, 3.0, 4.0, 5.0]
    rows = [{"x": x, "y": y, "cost": 10.0 * x + y} for x in values for y in values]
    rows[7] = {"x": 2.0, "y": 3.0, "cost": None, "status": "infeasible"}
    figure = draw_study(study({"x": values, "y": values}, rows))
    mesh = figure.axes[0].collections[0]
    cells = np.ma.filled(mesh.get_array().reshape(5, 5), np.nan)
    assert cells[0, 3] == 41.0 and cells[3, 0] == 14.0 and np.isnan(cells[2, 1])
    assert figure.axes[1].get_ylabel() == "cost $J$"
    assert legend(figure) == ["infeasible"]


def test_drawn_points_stand_where_they_were_drawn() -> None:
    rows = [{"x": 0.3, "y": 0.7, "cost": 2.0}, {"x": 0.6, "y": 0.1, "cost": 5.0}]
    drawn = draw_study(study({"x": "0.0:1.0", "y": "0.0:1.0"}, rows, "sobol")).axes[0].collections[0]
    assert np.array_equal(drawn.get_offsets(), [[0.3, 0.7], [0.6, 0.1]])
    assert np.array_equal(drawn.get_array(), [2.0, 5.0])


def test_zipped_axes_are_one_line_along_the_first() -> None:
    rows = [{"x": 1.0, "y": 5.0, "cost": 1.0}, {"x": 2.0, "y": 7.0, "cost": 4.0}]
    figure = draw_study(study({"x": [1.0, 2.0], "y": [5.0, 7.0]}, rows, "zip"))
    assert list(lines(figure)[0].get_ydata()) == [1.0, 4.0]


def test_categories_show_costs_down_to_their_bounds_and_seconds() -> None:
    rows = [{"solver": name, "cost": cost} for name, cost in (("piqp", 1.0), ("clarabel", 2.0))]
    figure = draw_study(study({"solver": ["piqp", "clarabel"]}, rows))
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["piqp", "clarabel"]
    assert [list(line.get_xdata()) for line in lines(figure)][:2] == [[0.9, 1.0], [1.0]]
    assert figure.axes[1].get_xlabel() == "seconds of the method (s)"


def test_costs_have_the_unit_that_all_runs_share_and_names_are_no_formulas() -> None:
    for units, told in (["N s", "N s"], " [N s]"), (["N s", "s"], ""), (["N s", None], ""):
        rows = [
            {"solver": name, "units.cost": unit} for name, unit in zip((r"$\frac{", "clarabel"), units, strict=True)
        ]
        known = study({"solver": [r"$\frac{", "clarabel"]}, rows)
        figure = draw_study(known)
        assert figure.axes[0].get_xlabel() == f"cost $J${told}, down to its proven lower bound"
        assert f"cost{told}" in shown(known)[0]
    figure.draw_without_rendering()


def test_an_axis_that_is_a_time_has_its_unit() -> None:
    for key, told in ("problem.horizon", " [s]"), ("problem.path.0.from", " [s]"), ("problem.control.box", ""):
        rows = [{key: value, "cost": 1.0, "units.time": "s"} for value in (1.0, 2.0)]
        figure = draw_study(study({key: [1.0, 2.0]}, rows))
        assert figure.axes[0].get_xlabel() == f"{key}{told}"
        assert f"{key},{told.strip(' []')},an axis" in columns_text([key], rows)
    others = [{key: 1.0, "cost": 1.0, "units.time": unit} for unit in "sh"]
    assert axis_unit("problem.horizon", others) == axis_unit("horizon", rows) == ""


def test_many_seeds_of_a_category_are_a_box() -> None:
    rows = [{"solver": "piqp", "seed": seed, "seconds": 0.1 * (seed + 1)} for seed in range(6)]
    figure = draw_study(study({"solver": ["piqp", "clarabel"], "seed": "0:5:6"}, rows))
    assert any(list(line.get_xdata()) == pytest.approx([0.35, 0.35]) for line in lines(figure, 1))  # the median


def test_without_a_cost_there_is_nothing_to_draw() -> None:
    with pytest.raises(sr.InputError, match="no figure of the study: no point has a cost"):
        draw_study(study({"x": [1.0, 2.0]}, [{"x": 1.0, "cost": None, "status": "infeasible"}]))


@pytest.mark.first(1)
@pytest.mark.parametrize("count", [1, 30])
def test_one_point_and_very_many_curves_can_be_drawn(tmp_path: Path, count: int) -> None:
    rows = [{"x": 1.0, "method": f"m{k}", "cost": float(k)} for k in range(count)]
    methods = [f"m{k}" for k in range(count)]
    written = save_figure(
        tmp_path / "sweep", draw_study, study({"x": [1.0, 2.0], "method": methods}, rows, out=tmp_path)
    )
    assert [path.name for path in written] == ["sweep.pdf", "sweep.png"]


def test_a_study_without_matplotlib_has_a_remark_and_everything_else(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "matplotlib", None)
    found = sr.sweep(config, {"seed": [0, 1]}, out=tmp_path / "out")
    assert found.remarks == ("no figure: matplotlib is not installed; `pip install 'matplotlib>=3.9'` brings it",)
    assert (tmp_path / "out" / "table.csv").is_file()
