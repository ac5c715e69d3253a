"""Guards experiment/figures: the figures of a search show the values of its trace, and say where there are none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sparserob_core.errors import InputError
from sparserob_core.experiment.figures.climb_figure import draw_climb
from sparserob_core.experiment.figures.landscape_figure import LandscapeData, draw_landscape
from sparserob_core.experiment.figures.style import save_figure
from sparserob_core.sip.result import SearchTrace

pytest.importorskip("matplotlib")

VALUES = np.array([1.0, 1.5, 1.2, 2.0, 0.3, 0.7, 0.5, 0.9])
ACCEPTED = np.array([np.nan, 1.0, 0.0, 1.0, np.nan, 1.0, 1.0, 0.0])


@pytest.fixture
def trace() -> SearchTrace:
    """Two stages of four evaluations: of a walk, but for the first of each."""
    return SearchTrace(
        outer=np.repeat([0.0, 1.0], 4),
        epsilon=np.repeat([1.0, 0.1], 4),
        value=VALUES,
        bound=np.array([-np.inf, 0.1, 0.1, 0.2, 0.3, 0.3, 0.3, 0.4]),
        seconds=np.arange(8.0),
        notes={"temperature": np.array([np.nan, 1e-1, 1e-3, 1e-6, np.nan, 1e-2, 1e-4, 1e-3]), "accepted": ACCEPTED},
    )


def lines(axes: object, label: str) -> list[tuple[np.ndarray, np.ndarray]]:
    found = [line for line in axes.get_lines() if line.get_label() == label]  # type: ignore[attr-defined]
    return [(np.asarray(line.get_xdata()), np.asarray(line.get_ydata())) for line in found]


def test_the_walk_is_at_its_accepted_values_and_stays_at_the_last_one(trace: SearchTrace) -> None:
    first, second = lines(draw_climb(trace, "Search").axes[0], "accepted walk")
    assert first[0].tolist() == [2, 4, 4]
    assert first[1][0] == pytest.approx(2.0 - 1.5)
    assert second[0].tolist() == [6, 7, 8]
    assert second[1] == pytest.approx([0.9 - 0.7, 0.9 - 0.5, 0.9 - 0.5])


def test_refused_proposals_are_told_apart(trace: SearchTrace) -> None:
    ((place, below),) = lines(draw_climb(trace, "Search").axes[0], "proposal, refused")
    assert place.tolist() == [3, 8]
    assert below[0] == pytest.approx(2.0 - 1.2)


def test_the_highest_value_of_a_stage_is_above_every_other_one(trace: SearchTrace) -> None:
    best = lines(draw_climb(trace, "Search").axes[0], "best so far")
    assert [len(place) for place, _ in best] == [4, 4]
    for _, below in best:
        assert (np.diff(below) <= 0.0).all()
        assert 0.0 < below[-1] < 0.2


def test_the_bound_is_drawn_where_it_is_known_and_beside_the_exact_value(trace: SearchTrace) -> None:
    figure = draw_climb(trace, "Search", 0.5, exact=True, unit="N s")
    figure.draw_without_rendering()
    axes = figure.axes[1]
    assert axes.get_ylabel() == "cost $J$ [N s]"
    ((place, bound),) = lines(axes, "proven lower bound of $J$")
    assert place.tolist() == list(range(2, 9)) and bound[-1] == 0.4
    ((_, exact),) = lines(axes, "exact value of $J$: 0.5")
    assert set(exact) == {0.5}
    assert axes.get_ylim()[0] < 0.1 and axes.get_ylim()[1] > 0.5
    (share,) = axes.child_axes
    assert share.get_ylim() == pytest.approx([200 * limit for limit in axes.get_ylim()])


def test_an_upper_bound_that_the_lower_one_has_not_met_is_not_called_exact(trace: SearchTrace) -> None:
    labels = draw_climb(trace, "Search", 0.5).axes[1].get_legend_handles_labels()[1]
    assert "proven upper bound of $J$: 0.5" in labels
    assert not [label for label in labels if "exact" in label]


def test_a_walk_that_is_heated_again_within_a_stage_is_marked_there_only(trace: SearchTrace) -> None:
    assert lines(draw_climb(trace, "").axes[0], "walk heated again") == []
    notes = {**trace.notes, "temperature": np.array([np.nan, 1e-1, 1e-6, 1e-2, np.nan, 1e-2, 1e-4, 1e-5])}
    assert lines(draw_climb(replace(trace, notes=notes), "").axes[0], "walk heated again")[0][0][0] == 3.5


def test_a_search_without_a_finite_value_is_drawn_without_one(trace: SearchTrace, tmp_path: Path) -> None:
    lost = replace(trace, value=np.full(8, np.inf), bound=np.full(8, -np.inf), notes={})
    assert len(save_figure(tmp_path / "climb", draw_climb, lost, "Lost")) == 2


def landscape(**changes: object) -> LandscapeData:
    across, up = np.linspace(0.0, 1.0, 5), np.linspace(2.0, 4.0, 3)
    data = LandscapeData(
        title="Slice",
        epsilon=0.1,
        axes=[across, up],
        names=["t of index 1", "p of index 1"],
        values=np.add.outer(across, up),
        best=np.array([1.0, 4.0]),
        best_value=5.0,
        own_value=5.0,
        visited=np.array([[0.0, 2.0], [0.5, 3.0], [1.0, 4.0]]),
        visited_values=np.array([2.0, 3.5, 5.0]),
        accepted=np.array([np.nan, 0.0, 1.0]),
    )
    return replace(data, **changes)  # type: ignore[arg-type]


@pytest.mark.slow
def test_the_map_shows_the_values_where_they_belong(tmp_path: Path) -> None:
    data = landscape()
    (mesh,) = [part for part in draw_landscape(data).axes[0].collections if hasattr(part, "get_coordinates")]
    assert np.array_equal(np.asarray(mesh.get_array()).reshape(3, 5), data.values.T)
    assert {file.name for file in save_figure(tmp_path / "landscape", draw_landscape, data)} == {
        "landscape.pdf",
        "landscape.png",
    }


def test_a_flat_slice_says_so_with_its_value() -> None:
    words = [text.get_text() for text in draw_landscape(landscape(values=np.full((5, 3), 5.0))).axes[0].texts]
    assert any("does not depend on t of index 1 and p of index 1 here: it is 5" in text for text in words)
    assert not any("does not depend" in text.get_text() for text in draw_landscape(landscape()).axes[0].texts)


def test_a_tuple_below_the_map_is_told_with_both_values() -> None:
    words = [text.get_text() for text in draw_landscape(landscape(own_value=4.5)).axes[0].texts]
    assert any("4.5" in text and "5" in text.replace("4.5", "") for text in words)
    assert not any("own" in text.get_text() for text in draw_landscape(landscape()).axes[0].texts)


def test_what_no_control_meets_is_named(tmp_path: Path) -> None:
    values = landscape().values.copy()
    values[2:, :] = np.inf
    labels = draw_landscape(landscape(values=values)).axes[0].get_legend_handles_labels()[1]
    assert "no control meets these constraints" in labels
    assert len(save_figure(tmp_path / "landscape", draw_landscape, landscape(values=np.full((5, 3), np.inf)))) == 2


def test_a_single_coordinate_is_a_curve() -> None:
    data = landscape(
        axes=[np.linspace(0.0, 1.0, 5)],
        names=["t"],
        values=np.linspace(0.0, 1.0, 5),
        best=np.array([1.0]),
        visited=np.array([[0.0], [0.5], [1.0]]),
    )
    ((across, along),) = lines(draw_landscape(data).axes[0], "$g$ along it")
    assert np.array_equal(across, data.axes[0]) and np.array_equal(along, data.values)


def test_values_that_do_not_fit_their_axes_are_refused() -> None:
    with pytest.raises(InputError, match="one value for each point"):
        landscape(values=np.zeros((3, 5)))
