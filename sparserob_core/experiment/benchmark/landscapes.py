"""Landscapes on which maximisers are compared: standard functions, the BBOB suite, and the function ``g`` of
configs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, TypeAlias, final

import numpy as np

from sparserob_core.errors import InputError, not_installed
from sparserob_core.experiment.benchmark import functions
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.search.search import Target

Formulation: TypeAlias = Literal["reduced", "literal"]

SUITES = ("standard", "classic", "bbob", "g")
BBOB_DIMENSIONS = (2, 5)
INDICES = 8  # of a tuple of a landscape of g
EPSILON = 1e-3  # the weight of the regulariser in a landscape of g
SAMPLE = 1000  # uniform points whose median is where a search is said to begin


@final
@dataclass(frozen=True, eq=False)
class BenchmarkFunction:
    """Function to be maximised, with its ``maximum``, and its number and instance in IOHprofiler.

    ``fresh`` makes the landscape anew, where the function remembers earlier evaluations.
    """

    name: str
    target: Target
    maximum: float
    number: int
    suite: str
    instance: int = 1
    fresh: Callable[[], BenchmarkFunction] | None = None

    def begin(self, seed: int) -> float:
        """The median of the function at uniform points: what a search begins with."""
        box = self.target.domain
        points = np.random.default_rng([seed, self.number]).uniform(
            box.lower, box.upper, (SAMPLE if self.fresh is None else 50, box.dimension)
        )
        values = np.asarray(self.target.function(points), dtype=float)
        return float(np.median(values[np.isfinite(values)], axis=0)) if np.isfinite(values).any() else -np.inf


def landscapes(suites: Sequence[str], configs: Sequence[Path], instance: int = 1) -> Iterator[BenchmarkFunction]:
    """The landscapes of the suites; ``configs`` for the suite ``g``. Raises `InputError` for an unknown suite, one that
    needs a package that is missing, and a config without a certified value."""
    for suite in suites:
        if suite not in SUITES:
            raise InputError(f"suite: expected one of {', '.join(SUITES)}, got {suite!r}")
    if "standard" in suites:
        yield from standard()
    if "classic" in suites:
        yield from classic()
    if "bbob" in suites:
        yield from bbob(instance)
    if "g" in suites:
        for number, config in enumerate(configs):
            yield landscape_of(config, 301 + number)


def standard() -> Iterator[BenchmarkFunction]:
    """Six functions with their maxima off the centre of the box, where a method that begins there would meet them by
    luck."""
    shift = np.array([0.7123, -1.3391, 1.0417])
    yield _make_landscape("garland", functions.garland, Box(np.zeros(1), np.ones(1)), 101, functions.GARLAND_MAXIMUM)
    yield _make_landscape("holder table", functions.holder, _make_cube(10.0, 2), 102, functions.HOLDER_MAXIMUM)
    yield _make_landscape("himmelblau", functions.himmelblau, _make_cube(5.0, 2), 103)
    yield _make_landscape("ackley", lambda x: functions.ackley(x, shift[:2]), _make_cube(32.0, 2), 104)
    yield _make_landscape("rastrigin", lambda x: functions.rastrigin(x, shift), _make_cube(5.12, 3), 105)
    yield _make_landscape("rosenbrock", functions.rosenbrock, _make_cube(2.048, 5), 106)


def classic() -> Iterator[BenchmarkFunction]:
    """Twelve functions more, in two to twenty coordinates: each of them defeats some searches that are good
    elsewhere."""
    shift = np.random.default_rng(0).uniform(-0.6, 0.6, 20)
    unit = Box(np.zeros(6), np.ones(6))
    rows: Sequence[tuple[str, Callable[[Array], Array], Box, float]] = (
        ("branin", functions.branin, Box(np.array([-5.0, 0.0]), np.array([10.0, 15.0])), -0.39788735772973816),
        ("camel", functions.camel, Box(np.array([-3.0, -2.0]), np.array([3.0, 2.0])), 1.0316284534898774),
        ("goldstein price", functions.goldstein, Box(np.full(2, -1.9), np.full(2, 2.1)), -3.0),
        ("needle", functions.needle, Box(unit.lower[:2], unit.upper[:2]), 1.0220692642822948),
        ("hartmann 3", functions.hartmann, Box(unit.lower[:3], unit.upper[:3]), 3.8627797873326634),
        ("shekel", functions.shekel, Box(np.zeros(4), np.full(4, 10.0)), 10.536409816692046),
        ("griewank", lambda x: functions.griewank(x, 60.0 * shift[:5]), _make_cube(60.0, 5), 0.0),
        ("levy", functions.levy, _make_cube(10.0, 5), 0.0),
        ("michalewicz", functions.michalewicz, Box(np.zeros(5), np.full(5, np.pi)), 4.687658179088149),
        ("schwefel", functions.schwefel, _make_cube(500.0, 5), 5 * 418.98288727243373),
        ("hartmann 6", functions.hartmann, unit, 3.3223680114155156),
        ("ellipsoid", lambda x: functions.ellipsoid(x, shift), _make_cube(1.0, 20), 0.0),
    )
    for number, (name, function, box, maximum) in enumerate(rows, 107):
        yield _make_landscape(name, function, box, number, maximum, "classic")


def _make_landscape(
    name: str,
    function: Callable[[Array], Array],
    box: Box,
    number: int,
    maximum: float = 0.0,
    suite: str = "standard",
) -> BenchmarkFunction:
    return BenchmarkFunction(name, Target(function, box), maximum, number, suite)


def bbob(instance: int = 1, dimensions: Sequence[int] = BBOB_DIMENSIONS) -> Iterator[BenchmarkFunction]:
    """The 24 functions of BBOB (Hansen, Finck, Ros and Auger 2009), negated, in so many dimensions, by ioh."""
    if find_spec("ioh") is None:
        raise InputError(f"suite: bbob needs a package: {not_installed('ioh')}")
    import ioh

    for number in range(1, 25):
        for dimension in dimensions:
            problem: Any = ioh.get_problem(
                number, instance=instance, dimension=dimension, problem_class=ioh.ProblemClass.BBOB
            )

            def negated(x: Array, problem: Any = problem) -> Array:
                return -np.array([problem(point) for point in x], dtype=float)

            name = f"{problem.meta_data.name} {dimension}D"
            target = Target(negated, _make_cube(5.0, dimension))
            yield BenchmarkFunction(name, target, -float(problem.optimum.y), number, "bbob", instance)


def landscape_of(
    config: Path,
    number: int,
    formulation: Formulation = "reduced",
    indices: int = INDICES,
    overrides: Mapping[str, Any] | None = None,
) -> BenchmarkFunction:
    """``g`` at tuples of so many indices of a config, at a small weight of the regulariser, in the units in which the
    methods search; its maximum is the value that the exchange certifies at that weight. ``overrides``: what is another
    in the config.

    Raises `InputError` where the exchange certifies none, for then the maximum is not known, and for literal indices
    without a disturbance.
    """
    from sparserob_core.experiment.assemble import assemble, build, tools_of
    from sparserob_core.experiment.config.load import load_config
    from sparserob_core.sip.relaxed.relaxed import RelaxedProgram
    from sparserob_core.sip.relaxed.tuples import TupleValue, imposed_program

    fixed = {"start": EPSILON, "stop": EPSILON}
    method = {"name": "exchange", "exact": False}
    loaded = load_config(str(config), {**(overrides or {}), "method": method, "continuation": fixed})
    experiment, tools = assemble(loaded), tools_of(loaded)
    own_units = experiment.program.own_units
    sought = experiment.program if own_units is None else own_units.program  # in whose units the regulariser weighs
    result = build(loaded, "method", loaded.config.method).solve(sought, tools)
    if result.status not in ("certified", "verified") or not sought.families:
        raise InputError(f"{config}: expected a config whose value is certified, got {result.status}: {result.message}")
    program = imposed_program(sought, formulation)

    def made() -> BenchmarkFunction:
        g = TupleValue(program, RelaxedProgram(program, tools.solver, tools.regulariser), indices)
        g.epsilon = EPSILON
        target = Target(g, g.domain, g.gradient, g.block, g.linear, g.acting)
        return BenchmarkFunction(f"g of {config.stem}", target, float(result.value), number, "g", fresh=made)

    return made()


def _make_cube(half: float, dimension: int) -> Box:
    return Box(np.full(dimension, -half), np.full(dimension, half))
