"""Guards that numbers, and states, too large to be computed with are one error at their key, without warnings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.problem.representable import LARGEST_NUMBER, require_representable

CONFIG = """problem:
  name: linear
  system:
    A: {A}
    B: [[0], [1]]
  horizon: {horizon}
  initial_state: {begin}
  control: {{box: {control}}}
  terminal: [{{box: [0.1, 0.1]}}]
"""
PLAIN = {"A": "[[0, 1], [0, 0]]", "horizon": "5.0", "begin": "[1, 1]", "control": "1"}


@pytest.mark.parametrize(
    ("change", "line", "key"),
    [
        ({"A": "[[500, 1], [0, 900]]"}, 4, "problem.system.A"),
        ({"A": "[[0, 1e308], [0, 0]]"}, 4, "problem.system.A"),
        ({"A": '[["1e308 / 3", 1], [0, 0]]'}, 4, "problem.system.A"),
        ({"horizon": "1e200"}, 6, "problem.horizon"),
        ({"begin": "[1e308, 1]"}, 7, "problem.initial_state"),
        ({"control": "1e308"}, 8, "problem.control"),
    ],
)
def test_a_number_that_overflows_is_one_error_with_its_line(
    change: dict[str, str], line: int, key: str, tmp_path: Path
) -> None:
    file = tmp_path / "large.yaml"
    file.write_text(CONFIG.format(**{**PLAIN, **change}))
    with pytest.raises(sr.ConfigError) as refused:
        sr.run(file, out=tmp_path / "run", quiet=True)
    assert str(refused.value).startswith(f"{file}:{line}:")
    assert key in str(refused.value) and len(str(refused.value).splitlines()) == 1
    assert not (tmp_path / "run").exists()


def problem(A: Any = ((0.0, 1.0), (0.0, 0.0)), horizon: float = 1.0, **rest: Any) -> sr.OptimalControlProblem:
    system = sr.LinearSystem(A, [[0.0], [1.0]], parameters=rest.pop("parameters", None))
    stated: dict[str, Any] = {"initial_state": [0.0, 0.0], "control": sr.Box([-1.0], [1.0]), **rest}
    return sr.OptimalControlProblem(system=system, horizon=horizon, **stated)


@pytest.mark.parametrize("growth", [0.999, 1.001])
def test_growth_is_refused_from_the_largest_number_on(growth: float) -> None:
    rate = growth * np.log(LARGEST_NUMBER) / 2.0
    grows = problem(np.diag([rate, -rate]), 2.0)
    if growth < 1.0:
        require_representable(grows)
        return
    with pytest.raises(sr.InputError, match="real part"):
        require_representable(grows)


@pytest.mark.parametrize("size", [0.999, 1.001])
def test_numbers_of_every_kind_are_refused_from_the_largest_on(size: float) -> None:
    large = size * LARGEST_NUMBER
    scaled = sr.Polytope([[large, 0.0]], [1.0])
    given = {
        ("system", "parameters"): lambda: problem(
            lambda p: np.array([[0.0, 0.0], [0.0, 0.0]]), parameters=sr.Box([0.0], [large])
        ),
        ("path", 0): lambda: problem(path=[sr.PathConstraint(scaled)]),
        ("terminal", 0): lambda: problem(terminal=[sr.NormBall(2.0, large, dimension=2)]),
        ("cost", "state"): lambda: problem(cost=sr.Cost(state={"Q": large * np.eye(2)})),
        ("weights",): lambda: problem(weights=[large]),
    }
    for key, made in given.items():
        if size < 1.0:
            require_representable(made())
            continue
        with pytest.raises(sr.InputError) as refused:
            require_representable(made())
        assert refused.value.path[0] == key[0]


def test_what_is_free_is_no_large_number() -> None:
    require_representable(problem(path=[sr.Box([-np.inf, -1.0], [np.inf, 1.0])]))


def test_the_values_of_functions_count() -> None:
    large = problem(
        lambda p: np.array([[0.0, 10.0 * LARGEST_NUMBER * p[0]], [0.0, 0.0]]), parameters=sr.Box([0.0], [1.0])
    )
    with pytest.raises(sr.InputError, match=r"system\.A"):
        require_representable(large)


@pytest.mark.parametrize(
    ("build", "path"),
    [
        (lambda large: sr.LinearSystem([[large]], [[1.0]]), "system.A"),
        (lambda large: sr.LinearSystem([[1.0]], [[1.0]], parameters=sr.Box([0.0], [large])), "system.parameters.upper"),
        (
            lambda large: sr.SwitchedSystem([
                (0.5, sr.LinearSystem([[1.0]], [[1.0]])), (1.0, sr.LinearSystem([[1.0]], [[large]])),
            ]),
            "system.pieces.1.B",
        ),
        (
            lambda large: sr.VaryingSystem.of([["t"]], [["k"]], 1.0, parameters=sr.Box([0.0], [large]), names=("k",)),
            "system.parameters.upper",
        ),
        (lambda large: sr.VaryingSystem.of([["t"]], [[1.0]], large), "horizon"),
        (
            lambda large: sr.VaryingSystem.taking_turns([
                (0.5 * large, ([["t"]], [[1.0]], None, None)), (large, ([["t"]], [[1.0]], None, None)),
            ]),
            "system.pieces.0.until",
        ),
    ],
)  # fmt: skip
def test_a_large_number_of_a_plant_has_the_key_of_a_config(build: Any, path: str) -> None:
    large = 10.0 * LARGEST_NUMBER
    system = build(large)
    made = sr.OptimalControlProblem(
        system=system,
        horizon=system.horizon if system.horizon < np.inf else 1.0,
        initial_state=[0.0],
        control=sr.Box([-1.0], [1.0]),
    )
    with pytest.raises(sr.InputError, match=f"^{path}: expected numbers of at most 1e\\+75"):
        require_representable(made)
