"""Guards the figure of a program that is stated as text: slacks over the index, and what is active."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.figures.run_figures import draw_slacks
from sparserob_core.experiment.run.drawing import draw_run

PROGRAM: dict[str, Any] = {
    "name": "program",
    "decision": {"a": {"size": 2}, "d": {}},
    "minimise": "d",
    "families": [
        {"name": "error", "index": {"t": [0, 1]}, "rows": ["-d <= exp(t) - a[0] - a[1]*t <= d"]},
        {"name": "plane", "index": {"p": [0, 1], "q": [0, 1]}, "rows": ["p*q <= 9 + d"]},
    ],
}


def test_slacks_are_drawn_at_the_end_and_again(tmp_path: Path) -> None:
    sr.run({"problem": PROGRAM, "regulariser": None}, out=tmp_path / "run", quiet=True)
    picture = tmp_path / "run/figures/slacks.png"
    first = picture.read_bytes()
    picture.unlink()
    draw_run(tmp_path / "run")
    assert picture.read_bytes() == first


def test_curves_touch_the_axis_where_multipliers_are() -> None:
    pytest.importorskip("matplotlib")
    rows = PROGRAM["families"][0]["rows"]
    family = sr.ConstraintFamily.from_expressions("error", index={"t": (0, 1)}, rows=rows, decision={"a": 2, "d": None})
    program = sr.SemiInfiniteProgram(n=3, q=[0, 0, 1], families=[family])
    result = sr.solve(program)
    figure = draw_slacks(program, result, "title")
    assert figure is not None
    (ax,) = figure.axes
    upper, lower, marks, _ = ax.get_lines()
    for curve in (upper, lower):
        heights = np.asarray(curve.get_ydata(), dtype=float)
        assert heights.min() >= -1e-9 and heights.max() == pytest.approx(2.0 * result.cost, rel=1e-3)
    assert ax.get_xlabel() == "$t$"
    touched = np.sort(np.asarray(marks.get_xdata(), dtype=float))
    assert touched[[0, -1]] == pytest.approx([0.0, 1.0], abs=1e-6)
    assert np.log(np.e - 1.0) == pytest.approx(touched[1], abs=1e-3)  # where the slope is that of the chord


def test_a_family_over_a_plane_has_no_curve() -> None:
    rows = PROGRAM["families"][1]["rows"]
    family = sr.ConstraintFamily.from_expressions(
        "plane", index={"p": (0, 1), "q": (0, 1)}, rows=rows, decision={"d": None}
    )
    program = sr.SemiInfiniteProgram(n=1, q=[1], families=[family])
    assert draw_slacks(program, sr.solve(program), "title") is None
