"""Guards that what `solve` returns for a problem is a run: saved, drawn, checked, and taken wherever one is."""

from __future__ import annotations

import gc
import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr

PIECES = {"name": "piecewise_constant", "pieces": 4}


def cart(**changes: Any) -> sr.OptimalControlProblem:
    plain: dict[str, Any] = {
        "system": sr.LinearSystem([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]),
        "horizon": 2.0,
        "initial_state": [0.5, 0.0],
        "control": sr.Box([-1.0], [1.0]),
        "disturbance": sr.Box([-0.02, -0.02], [0.02, 0.02]),
        "path": [sr.PathConstraint(sr.Box([-1.0, -1.0], [1.0, 1.0]), name="walls")],
        "terminal": [sr.Box([-0.15, -0.15], [0.15, 0.15])],
        "title": "Cart",
    }
    return sr.OptimalControlProblem(**{**plain, **changes})


@pytest.fixture(scope="module")
def solved() -> sr.SolvedProblem:
    result = sr.solve(cart(), control=PIECES, seed=3)
    assert isinstance(result, sr.SolvedProblem)
    return result


@pytest.fixture(scope="module")
def saved(solved: sr.SolvedProblem, tmp_path_factory: pytest.TempPathFactory) -> sr.Outcome:
    return solved.save(tmp_path_factory.mktemp("cart") / "run", figures=False)


def test_a_saved_result_is_a_run_directory_like_that_of_its_config(saved: sr.Outcome, tmp_path: Path) -> None:
    again = sr.run(saved.directory / "config.yaml", out=tmp_path / "again", quiet=True, figures=False)
    assert {file.name for file in again.directory.iterdir()} <= {file.name for file in saved.directory.iterdir()}
    with np.load(saved.directory / "solution.npz") as mine, np.load(again.directory / "solution.npz") as other:
        assert set(mine) == set(other)
        for name in ("breakpoints", "control", "theta", "decision"):
            assert np.allclose(mine[name], other[name], rtol=0.0, atol=1e-6)
    for key in ("config", "seed", "title", "status"):
        assert saved.summary[key] == again.summary[key]
    kept = json.loads((saved.directory / "result.json").read_text("utf-8"))
    assert kept["lower_bound"] == saved.result.lower_bound


def test_a_saved_result_is_verified_anew_and_a_changed_one_refuted(saved: sr.Outcome, tmp_path: Path) -> None:
    assert sr.check(saved.directory).status == "verified"
    config = saved.directory / "config.yaml"
    text = config.read_text("utf-8")
    assert "[0.15, 0.15]" in text
    for file in saved.directory.iterdir():
        if file.is_file():
            (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "config.yaml").write_text(text.replace("[0.15, 0.15]", "[0.10, 0.15]"), "utf-8")
    assert sr.check(tmp_path).status == "refuted"


def test_a_result_is_taken_wherever_a_run_is(solved: sr.SolvedProblem, saved: sr.Outcome) -> None:
    nominal = sr.solve(cart(), "nominal", control=PIECES)
    assert sr.check(solved).status == "verified"
    for law in ("vertices", "adversary"):
        mine, other = (sr.simulate(run, None if law == "adversary" else 50, law) for run in (solved, saved))
        assert [one.largest for one in mine.constraints] == [one.largest for one in other.constraints]
        assert not any(one.violated for one in mine.constraints)
    assert sr.loop(solved, trajectories=1).violated == ()
    u = sr.controller(solved).step(0.0, np.array([0.5, 0.0]))
    assert np.array_equal(u, solved.control(0.0))
    comparison = sr.compare([solved, nominal, saved.directory])
    assert isinstance(comparison, sr.Comparison)
    assert [curve.status for curve in comparison.curves] == [solved.status, nominal.status, solved.status]


@pytest.mark.slow
def test_a_problem_and_a_run_are_taken_wherever_a_config_is(
    solved: sr.SolvedProblem, saved: sr.Outcome, tmp_path: Path
) -> None:
    margins = [sr.margin(given, tolerance=1e-2) for given in (solved, saved, saved.directory)]
    margins.append(sr.margin(cart(), overrides={"dictionaries.control": PIECES}, tolerance=1e-2))
    assert all(found.lower == margins[0].lower > 1.0 for found in margins)
    outcome = sr.run(cart(), {"dictionaries.control": PIECES}, out=tmp_path / "run", figures=False, quiet=True)
    assert outcome.result.cost == pytest.approx(solved.cost, rel=1e-6)
    study = sr.sweep(cart(), {"problem.horizon": [2.0]}, {"dictionaries.control": PIECES}, out=tmp_path / "study")
    assert study.table[0]["status"] == solved.status


def test_every_figure_of_a_run_is_a_figure_of_matplotlib(solved: sr.SolvedProblem, saved: sr.Outcome) -> None:
    from matplotlib.figure import Figure

    for name in ("control", "convergence", "adversary"):
        assert isinstance(solved.plot(name), Figure)
    states = solved.plot()
    assert [ax.get_ylabel() for ax in states.axes] == ["$x_{1}(t)$", "$x_{2}(t)$"]
    assert isinstance(saved.plot("adversary"), Figure)
    with pytest.raises(sr.InputError, match="control, switching, states, convergence, adversary"):
        solved.plot("gains")


def test_a_result_under_feedback_is_saved_with_its_gains(tmp_path: Path) -> None:
    result = sr.solve(cart(), control=PIECES, policy=sr.AffinePolicy(cost="peak"))
    outcome = result.save(tmp_path / "run", figures=False)
    assert outcome.summary["causal_lower_bound"] is not None
    assert sr.check(result).status == "verified"
    assert result.directory == tmp_path / "run"
    assert len(result.plot("gains").axes) > 1


@pytest.mark.slow
def test_an_infeasible_result_is_saved_with_its_reason(tmp_path: Path) -> None:
    result = sr.solve(cart(initial_state=[5.0, 0.0], path=[]), control=PIECES)
    assert result.status == "infeasible"
    assert sr.check(result.save(tmp_path / "run")).status == "verified"
    assert (tmp_path / "run" / "figures" / "clash.png").is_file()
    assert "<img" in result._repr_html_()
    assert len(result.plot().axes) == len(result.plot("clash").axes)


def test_a_notebook_shows_a_figure_without_pyplot(solved: sr.SolvedProblem) -> None:
    pytest.importorskip("matplotlib")
    shown: Any = solved.plot("control")
    assert shown._repr_png_().startswith(b"\x89PNG")


def test_a_notebook_shows_the_table_and_the_control(solved: sr.SolvedProblem) -> None:
    page = solved._repr_html_()
    assert "<strong>Cart</strong>" in page and "lower bound" in page
    assert "data:image/png;base64," in page
    assert len(repr(solved).splitlines()) <= 10


def test_what_no_config_can_say_is_one_error_at_its_key_and_the_result_is_shown_all_the_same(tmp_path: Path) -> None:
    system = sr.LinearSystem(
        lambda p: np.array([[0.0, 1.0], [abs(p[0]), 0.0]]), [[0.0], [1.0]], parameters=sr.Box([0.0], [0.01])
    )
    result = sr.solve(cart(system=system, path=[]), "nominal", control=PIECES, seconds=20)
    assert "<table>" in result._repr_html_()
    with pytest.raises(sr.InputError) as refused:
        result.save(tmp_path / "run")
    assert refused.value.path == ("problem", "system", "A")
    assert not (tmp_path / "run").exists()


def test_a_result_that_is_not_saved_leaves_nothing_behind() -> None:
    result = sr.solve(cart(path=[]), control=PIECES)
    directory = result.directory
    assert (directory / "certificate.json").is_file()
    assert result.directory == directory
    del result
    gc.collect()
    assert not directory.parent.exists()


@pytest.mark.first(1)
@pytest.mark.parametrize("given", [{}, {"formulation": "literal"}, {"policy": sr.AffinePolicy(cost="peak")}])
def test_the_result_of_a_program_that_was_transcribed_is_a_run_too(given: dict[str, Any], tmp_path: Path) -> None:
    pieces = sr.Dictionary.indicators(np.linspace(0.0, 2.0, 5))
    program = sr.transcribe(cart(), control=pieces, **given)
    result = sr.solve(program, method={"name": "exchange", "tolerance": 1e-6})
    assert isinstance(result, sr.SolvedProblem)
    assert result.tube([1.0]).lower.shape == (2, 1)
    outcome = result.save(tmp_path / "run", figures=False)
    assert sr.check(outcome).status == "verified"
    assert ("policy" in given) == (outcome.experiment.loaded.config.policy.name == "affine")


def test_a_program_with_something_replaced_is_no_problem_any_more() -> None:
    program = sr.transcribe(cart(), control=sr.Dictionary.indicators(np.linspace(0.0, 2.0, 5)))
    other = replace(program, families=program.families[:1])
    assert not isinstance(sr.solve(other), sr.SolvedProblem)
    assert other.origin is None


def test_a_dictionary_without_a_name_can_be_solved_and_looked_at_and_says_why_it_cannot_be_written(
    tmp_path: Path,
) -> None:
    sums = np.vstack([np.kron(np.eye(2), [1.0, 1.0]), np.kron(np.eye(2), [1.0, -1.0])])
    result = sr.solve(sr.transcribe(cart(), control=sr.Dictionary(np.linspace(0.0, 2.0, 5), sums)))
    assert isinstance(result, sr.SolvedProblem)
    assert result.status == "certified" and result.control.values.shape == (1, 4)
    with pytest.raises(sr.InputError, match=r"dictionaries.control: expected .* by name, so that a config can say"):
        result.save(tmp_path / "run")
    assert not list(tmp_path.iterdir())


def test_a_result_can_be_pickled_and_then_saved(solved: sr.SolvedProblem, tmp_path: Path) -> None:
    again = pickle.loads(pickle.dumps(solved))
    assert isinstance(again, sr.SolvedProblem)
    assert sr.check(again.save(tmp_path / "run", figures=False)).status == "verified"


def test_the_result_of_a_run_is_saved_elsewhere(saved: sr.Outcome, tmp_path: Path) -> None:
    assert isinstance(saved.result, sr.SolvedProblem)
    other = saved.result.save(tmp_path / "copy", figures=False)
    assert other.summary["config"] == saved.summary["config"]
    assert sr.check(other).status == "verified"


@pytest.mark.parametrize("call", [sr.check, sr.simulate, sr.loop, sr.margin, sr.controller, sr.run])
def test_anything_else_is_refused_with_what_is_expected(call: Any) -> None:
    with pytest.raises(sr.InputError, match="got int"):
        call(3)
