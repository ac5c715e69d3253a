"""Guards problems that were made in Python, as configs: what is read back is what was given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.problem.cost import Quadratic
from sparserob_core.control.problem.phase import Phase
from sparserob_core.experiment.assemble import problem_of
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.config.reading.reader import ConfigSource, require_readable, write_yaml
from sparserob_core.experiment.config.writing.problem import WRITTEN, WRITTEN_OF_SYSTEM
from sparserob_core.experiment.config.writing.source import component_keys, dictionary_keys, source_of
from sparserob_core.experiment.plugins.registry import load_registry

SETS = [
    sr.Box([-1.0, -np.inf], [1.0, np.inf]),
    sr.Box([-0.1, -0.3], [0.2, np.inf]),
    sr.Polytope([[1.0, 1 / 3], [-1.0, 0.0], [0.0, -0.1]], [1.0, 2.0, 0.3]),
    sr.Ellipsoid([0.1, 1 / 3], [[2.0, 0.5], [0.5, 1.0]]),
    sr.NormBall(1.5, 0.7, [0.1, 0.0]),
    sr.NormBall(np.inf, 0.7, dimension=2),
]
BOX = sr.Box([-1.0], [1.0])


def problem(**changes: Any) -> sr.OptimalControlProblem:
    plain: dict[str, Any] = {
        "system": sr.LinearSystem([[0.0, 1.0], [-1 / 3, 0.0]], [[0.0], [1.0]]),
        "horizon": 2.0,
        "initial_state": [0.5, 0.0],
        "control": BOX,
        "terminal": [sr.Box([-0.1, -0.1], [0.1, 0.1])],
    }
    return sr.OptimalControlProblem(**{**plain, **changes})


UNCERTAIN = sr.Box([-0.1, 0.9], [0.1, 1.1])
FUNCTIONS = sr.LinearSystem(
    lambda p: np.array([[0, 1], [-2 + p[0], -0.5]]),
    lambda p: np.array([[0], [p[1]]]),
    parameters=UNCERTAIN,
    names=("stiffness", "gain"),
    c=lambda p: np.array([0.0, -9.81 * p[1]]),
    delay=0.25,
)
MODES = sr.SwitchedSystem(
    [(1.0, sr.LinearSystem([[0, 1], [0, 0]], [[0], [1]])), (2.0, sr.LinearSystem([[0, 1], [-1, 0]], [[0], [2]]))]
)
PROBLEMS: dict[str, Callable[[], sr.OptimalControlProblem]] = {
    "plain": problem,
    "functions": lambda: problem(system=FUNCTIONS, initial_control=[0.1]),
    "ellipsoid of parameters": lambda: problem(
        system=sr.LinearSystem(
            lambda p: np.array([[0, 1], [p[0], p[1]]]),
            [[0], [1]],
            parameters=sr.Ellipsoid([0.1, 0.2], [[0.01, 0], [0, 0.01]]),
        )
    ),
    "modes": lambda: problem(system=MODES),
    "disturbed": lambda: problem(
        system=sr.LinearSystem([[0, 1], [0, 0]], [[0], [1]], [[0.0], [1.0]]),
        disturbance=sr.Box([-0.1], [0.1]),
        disturbance_class="measurable",
    ),
    "zonotope": lambda: problem(disturbance=sr.Zonotope(np.array([0.01, 0.0]), np.array([[0.1, 0.0], [0.1, 0.1]]))),
    "initial set": lambda: problem(initial_set=sr.Ellipsoid([0.0, 0.0], [[0.01, 0.0], [0.0, 0.02]])),
    "terminal sets": lambda: problem(terminal=[*SETS, sr.Equality([0.1, np.nan])]),
    "windows": lambda: problem(
        path=[
            *(sr.PathConstraint(convex, 0.1 * k, 1.5, f"wall {k}") for k, convex in enumerate(SETS)),
            sr.PathConstraint(SETS[0], 0.5, 1.0, relative_to=[[0.5, 0.0, 0.0], [1.0, 0.2, 1 / 3]]),
            sr.MixedConstraint([[0.0, 1.0], [1.0, 0.0]], [[0.5], [0.1]], [1.2, np.inf], 0.5),
        ]
    ),
    "cost": lambda: problem(
        cost=sr.Cost(
            l1=0.5,
            state={"Q": [[0.2, 0], [0, 0.1]], "reference": [0.1, 0]},
            control={"R": [[0.05]]},
            final={"Q": [[1, 0], [0, 1]], "reference": [0, 0.3]},
        ),
        weights=[2.5],
    ),
    "prices": lambda: problem(weights=[[0.0, 1.0], [1 / 3, 0.0], [1.5, 2.5]]),
    "groups": lambda: problem(
        system=sr.LinearSystem(np.eye(2), np.eye(2)),
        control=sr.NormBall(2.0, 1.0, dimension=2),
        cost=sr.Cost(group="all"),
        initial_control=[0.0, 0.0],
        control_step=sr.Box([-0.5, -0.5], [0.5, 0.5]),
    ),
    "names": lambda: problem(
        names=sr.Names(states=["x", "v"], state_units=["m", "m/s"], controls=["force"], time="s"), title="a/b: é"
    ),
}


def same(one: object, other: object) -> bool:
    """Whether two records say the same: arrays bit for bit, functions of the parameters by their values."""
    if isinstance(one, sr.System) and isinstance(other, sr.System):
        told = [(system.delay, system.varies, tuple(system.names)) for system in (one, other)]
        return told[0] == told[1] and same(one.parameters, other.parameters) and same(one.phases, other.phases)
    if isinstance(one, Phase) and isinstance(other, Phase):
        # expressions are evaluated in the order of the function, up to how numpy squares
        pairs = zip(one.matrices(one.probes), other.matrices(one.probes), strict=True)
        drifts = (one.forced.matrices(one.probes)[1], other.forced.matrices(one.probes)[1])
        close = [np.allclose(a, b, rtol=1e-14, atol=0.0) for a, b in (*pairs, drifts)]
        return all(close) and (one.begin, one.until) == (other.begin, other.until)
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and np.array_equal(one, other, equal_nan=True)
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))  # type: ignore[arg-type]
    if hasattr(one, "__dataclass_fields__"):
        mine: Any = one
        return type(one) is type(other) and all(
            same(getattr(one, field.name), getattr(other, field.name)) for field in fields(mine)
        )
    return bool(one == other)


@pytest.mark.first(6)
@pytest.mark.parametrize("name", PROBLEMS)
def test_a_problem_is_read_back_from_its_config_as_it_was(name: str) -> None:
    given = PROBLEMS[name]()
    text = write_yaml(source_of(given).data)
    again = problem_of(load_config(ConfigSource("problem", source_of(given).folder, read(text))))
    assert isinstance(again, sr.OptimalControlProblem)
    told = replace(again, title=given.title)
    if given.initial_control is not None and given.control_step is None and not given.system.delay:
        told = replace(told, initial_control=given.initial_control)
    assert same(pruned(given), pruned(told))


def read(text: str) -> dict[str, Any]:
    from ruamel.yaml import YAML

    data: dict[str, Any] = YAML(typ="safe", pure=True).load(text)
    return data


def pruned(given: sr.OptimalControlProblem) -> sr.OptimalControlProblem:
    """Without the rows of a mixed constraint that bound nothing, which no config writes."""
    path = []
    for entry in given.path:
        if isinstance(entry, sr.MixedConstraint):
            kept = np.isfinite(np.asarray(entry.h))
            H, G, h = (np.asarray(part)[kept] for part in (entry.H, entry.G, entry.h))
            entry = replace(entry, H=H, G=G, h=h)
        path.append(entry)
    return replace(given, path=path)


def test_every_field_of_a_problem_and_of_a_system_is_written() -> None:
    assert {field.name for field in fields(sr.OptimalControlProblem)} == WRITTEN | {"path", "integral"}
    assert {field.name for field in fields(sr.LinearSystem)} == WRITTEN_OF_SYSTEM
    assert {field.name for field in fields(Quadratic)} == {"Q", "reference"}


def test_a_set_that_no_kind_builds_is_refused_by_its_key() -> None:
    curved = sr.cylinder(sr.NormBall(1.5, 1.0, dimension=2), 3)
    odd = problem(system=sr.LinearSystem(np.eye(3), np.eye(3)[:, :1]), initial_state=np.zeros(3), terminal=[curved])
    with pytest.raises(sr.InputError) as refused:
        source_of(odd)
    assert refused.value.path[:3] == ("problem", "terminal", 0)


def test_deviations_about_another_point_than_0_are_refused() -> None:
    with pytest.raises(sr.InputError) as refused:
        source_of(problem(initial_set=sr.Ellipsoid([0.01, 0.0], [[0.01, 0.0], [0.0, 0.02]])))
    assert refused.value.path == ("problem", "initial_state")


@pytest.mark.parametrize(
    "dictionary",
    [
        sr.Dictionary.indicators(np.linspace(0.0, 2.0, 11)),
        sr.Dictionary.indicators([0.0, 0.3, 1.0, 2.0]),
        sr.Dictionary.indicators(np.linspace(0.0, 2.0, 8), np.arange(7) * 3 // 7),
    ],
)
def test_indicators_are_written_with_their_pieces(dictionary: sr.Dictionary) -> None:
    keys = dictionary_keys(load_registry(), "control", dictionary)
    name = keys.pop("name")
    again = load_registry().build("dictionary", name, keys).build(2.0)
    assert np.array_equal(again.breakpoints, dictionary.breakpoints)
    assert np.array_equal(again.values, dictionary.values)


def test_functions_that_no_config_names_are_refused() -> None:
    with pytest.raises(sr.InputError, match="dictionaries"):
        dictionary_keys(load_registry(), "control", sr.Dictionary([0.0, 1.0, 2.0], [[1.0, 1.0], [1.0, -1.0]]))


def test_a_component_that_is_an_object_is_written_by_its_name() -> None:
    registry = load_registry()
    policy = sr.AffinePolicy(cost="peak", memory=1.0)
    keys = component_keys(registry, "policy", policy)
    assert keys.pop("name") == "affine"
    assert registry.build("policy", "affine", keys) == policy

    class Own(sr.Policy):
        @property
        def knows(self) -> frozenset[Any]:
            return frozenset()

    with pytest.raises(sr.InputError, match="Own"):
        component_keys(registry, "policy", Own())


def test_a_path_entry_of_a_config_has_a_name_and_one_set() -> None:
    stated = source_of(problem()).data
    entry = {"box": [1.0, 1.0], "norm": {"p": 1, "radius": 2.0}, "name": "wall"}
    with pytest.raises(sr.InputError, match="name"):
        problem_of(load_config({"problem": {**stated["problem"], "path": [entry]}}))
    found = problem_of(load_config({"problem": {**stated["problem"], "path": [{"box": [1.0, 1.0], "name": "wall"}]}}))
    assert isinstance(found, sr.OptimalControlProblem)
    assert [one.name for one in found.path if isinstance(one, sr.PathConstraint)] == ["wall"]


def test_what_is_larger_than_a_config_may_be_is_refused_before_it_is_written() -> None:
    with pytest.raises(sr.ConfigError, match="values"):
        require_readable({"A": [0.0] * 200_001}, "")
