"""The tables of docs/maximisers.md: every maximiser with its own defaults, side by side in one run, with the seeds 0,
1, ...; what is not asked for stays as it is.

``python docs/build_maximisers.py functions g1`` writes two of them; all of them take about an hour on one processor.
What needs a package that is missing is left out.
"""

from __future__ import annotations

import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path

import click
import numpy as np

import sparserob_core as sr
from sparserob_core.errors import InputError, not_installed
from sparserob_core.experiment.benchmark.landscapes import (
    BenchmarkFunction,
    Formulation,
    bbob,
    classic,
    landscape_of,
    standard,
)
from sparserob_core.experiment.solve import component
from sparserob_core.sip.maximiser import Maximiser
from sparserob_core.sip.search.search import Rules, maximise

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "maximisers.md"
SEEDS = 5
ACCURACY = 1e-3
"""A landscape is solved at this share of the way from the median of uniform points to the maximum. With a tenth of it a
table tells who polishes, with ten times as much who finds the right hill."""
NAMES = (
    "portfolio",
    "sequool",
    "direct",
    "simulated_annealing",
    "cma",
    "dual_annealing",
    "gradient_ascent",
    "adalipo",
    "maxlipo",
    "nevergrad",
    "sobol",
    "random_search",
)
SLOW = {"maxlipo", "nevergrad"}  # which have two seeds where others have five
CASES: dict[str, tuple[tuple[int, Formulation, int], ...]] = {
    "g1": ((1, "reduced", 50), (1, "literal", 50), (1, "reduced", 250), (1, "literal", 250)),
    "g23": ((2, "reduced", 50), (3, "reduced", 50), (3, "literal", 50)),
    "g250": ((2, "reduced", 250), (3, "reduced", 250), (3, "literal", 250)),
}
"""Landscapes of g: the experiment of the paper, how an index is written, and how many pieces and indices there are. The
second experiment has no disturbance, and so no literal form of its own."""
DIMENSIONS = (2, 5, 10, 20)
"""Of the functions of BBOB."""
EACH = 50
"""Evaluations of a function of BBOB, for each coordinate."""
INSTANCES = 3
"""Of every function of BBOB, with the seeds 1, 2, ...; slow searches have the first."""
MANY = 50_000  # coordinates in which a search has two seeds, as the slow ones have
Search = Callable[[BenchmarkFunction, int, int], float]


@dataclass
class Measured:
    """What one competitor has reached: the best values by (landscape, budget), and its own seconds for an
    evaluation."""

    name: str
    seeds: int
    values: dict[tuple[str, int], list[float]] = field(default_factory=dict)
    own: list[float] = field(default_factory=list)


def ours(name: str) -> Search:
    """A maximiser of this package with its defaults, as `sparserob_core.maximise` has them."""
    maximiser: Maximiser = component(sr.load_registry(), "maximiser", name, Maximiser)

    def search(landscape: BenchmarkFunction, budget: int, seed: int) -> float:
        target = (landscape if landscape.fresh is None else landscape.fresh()).target
        as_in_runs = target.gradient is not None or target.linear is not None
        rules = Rules(polish=None if as_in_runs else maximiser.polished)
        try:
            return maximise(target, maximiser, budget, np.random.default_rng(seed), rules).best_value
        except InputError:  # it has a limit, as sobol has of coordinates
            return np.nan

    return search


def theirs(peer: str) -> Search:
    """A search of other people, ended by the budget."""
    from tests.benchmarks.peers import PEERS, quietly

    run = next(one.run for one in PEERS if one.name == peer)

    def search(landscape: BenchmarkFunction, budget: int, seed: int) -> float:
        values: list[float] = []

        def value(point: object) -> float:
            if len(values) >= budget:
                raise SpentError
            values.append(float(landscape.target.function(np.array(point, dtype=float)[np.newaxis])[0]))
            return values[-1]

        try:
            quietly(run, value, landscape.target.domain, budget, seed)
        except Exception as error:  # some of them fail, and then the best value until there counts
            if not isinstance(error, SpentError) and not values:
                raise
        return max(values)

    return search


class SpentError(Exception):
    """The budget of a peer is spent."""


def contenders(peers: Sequence[str], names: Sequence[str] = NAMES) -> Iterator[tuple[str, Search]]:
    """Every search that is installed."""
    needs = {"cma": "cma", "nevergrad": "nevergrad"}
    for name in names:
        if find_spec(needs.get(name, "numpy")):
            yield f"`{name}`", ours(name)
    if peers:
        from tests.benchmarks.peers import PEERS

        yield from ((one.name, theirs(one.name)) for one in PEERS if one.name in peers and one.installed)


def measured(name: str, search: Search, landscapes: Sequence[BenchmarkFunction], budgets: Sequence[int]) -> Measured:
    """All searches of one competitor."""
    found = Measured(name, 2 if name.strip("`") in SLOW else SEEDS)
    search(landscapes[0], 10, 0)  # everything is imported
    started = time.process_time()
    for landscape in landscapes:
        seeds = min(found.seeds, 2 if landscape.target.domain.dimension > MANY else SEEDS)
        for budget in budgets:
            began = time.process_time()
            found.values[landscape.name, budget] = [search(landscape, budget, seed) for seed in range(seeds)]
            found.own.append((time.process_time() - began) / (seeds * budget))
    click.echo(f"{name}: {time.process_time() - started:.0f} s", err=True)
    return found


def share(row: Measured, landscape: BenchmarkFunction, budget: int) -> float:
    """The share of the searches that solve a landscape: come within `ACCURACY`."""
    least = landscape.maximum - ACCURACY * (landscape.maximum - landscape.begin(0))
    return float(np.mean(np.array(row.values[landscape.name, budget]) >= least))


def of_functions(landscapes: Sequence[BenchmarkFunction], budgets: Sequence[int], peers: Sequence[str] = ()) -> str:
    """One row for each search: how many functions are solved at each budget, which are not at the largest, and the time
    that it takes."""
    rows = [measured(name, search, landscapes, budgets) for name, search in contenders(peers)]
    unit = next(float(np.median(row.own)) for row in rows if row.name == "`sequool`")
    heads = [f"{budget} evaluations" for budget in budgets]
    lines = [["", *heads, f"not solved with {budgets[-1]}", "time"]]

    for row in rows:
        solved = [sum(share(row, one, budget) for one in landscapes) for budget in budgets]
        missed = [one.name for one in landscapes if share(row, one, budgets[-1]) < 0.5]
        said = ", ".join(missed) if len(missed) <= 6 else f"{len(missed)} of them"
        lines.append([row.name, *(f"{one:.1f}" for one in solved), said, f"{np.median(row.own) / unit:.2g}"])
    return table(lines)


def of_bbob(dimensions: Sequence[int]) -> str:
    """One row for each search: how many of the 24 functions of BBOB are solved in each dimension, in the mean of the
    instances."""
    lines = [["", *(f"{dimension} coordinates" for dimension in dimensions)]]
    for name, search in contenders(PEERS):
        started, instances = time.process_time(), 1 if name.strip("`") in SLOW else INSTANCES
        cells = []
        for dimension in dimensions:
            solved = 0
            for instance in range(1, 1 + instances):
                for one in bbob(instance, [dimension]):
                    least = one.maximum - ACCURACY * (one.maximum - one.begin(0))
                    solved += search(one, EACH * dimension, instance) >= least
            cells.append(f"{solved / instances:.1f}")
        lines.append([name, *cells])
        click.echo(f"{lines[-1]}, {time.process_time() - started:.0f} s", err=True)
    return table(lines)


def of_g(cases: Sequence[tuple[int, Formulation, int]], budgets: Sequence[int], names: Sequence[str] = NAMES) -> str:
    """One row for each search: the least share of the certified maximum of g over all seeds."""
    landscapes = [_of_experiment(*case) for case in cases]
    titles = [f"{experiment}, {formulation}, {size}" for experiment, formulation, size in cases]
    lines = [["", *(f"{title}: {' / '.join(map(str, budgets))}" for title in titles)]]
    for name, search in contenders((), names):
        row = measured(name, search, landscapes, budgets)
        least = [[min(row.values[one.name, budget]) / one.maximum for budget in budgets] for one in landscapes]
        lines.append([name, *(" / ".join(map(shown, cell)) for cell in least)])
        click.echo(lines[-1], err=True)
    return table(lines)


def _of_experiment(experiment: int, formulation: Formulation, size: int) -> BenchmarkFunction:
    pieces = {"name": "piecewise_constant", "pieces": size}
    overrides = {"dictionaries.control": pieces} | ({} if experiment == 2 else {"dictionaries.disturbance": pieces})
    config = ROOT / "configs" / f"experiment{experiment}_repaired.yaml"
    found = landscape_of(config, 301 + experiment, formulation, size, overrides)
    fresh = found.fresh
    assert fresh is not None
    return replace(found, name=f"{found.name} {formulation} {size}", fresh=fresh)


def shown(least: float) -> str:
    """A share of the maximum, rounded down, so that no 1 is told of what falls short by more than 1e-6; a dash for who
    does not search there."""
    if np.isnan(least):
        return "-"
    return "1" if least >= 1.0 - 1e-6 else f"{np.floor(least * 1e4) / 1e4:.4f}"


def table(lines: Sequence[Sequence[str]]) -> str:
    """Lines of cells as Markdown."""
    head, *rows = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([head, f"|{'---|' * len(lines[0])}", *rows])


def joined(name: str, text: str) -> str:
    """The table in the page with the rows of ``text``; the others stay where the columns are the same."""
    head, dashes, *rows = text.split("\n")
    page = PAGE.read_text(encoding="utf-8").partition(f"<!-- {name}: by docs/build_maximisers.py -->\n")[2]
    old = page.partition("\n<!-- end of")[0].split("\n")
    kept = old[2:] if old[0] == head else []
    place = {f"`{one}`": position for position, one in enumerate(NAMES)}
    found = {row.split(" | ")[0].removeprefix("| "): row for row in [*kept, *rows]}
    return "\n".join([head, dashes, *(found[one] for one in sorted(found, key=lambda one: place.get(one, len(place))))])


def put(name: str, text: str) -> None:
    """Write a table between its marks in the page."""
    page = PAGE.read_text(encoding="utf-8")
    begin, end = f"<!-- {name}: by docs/build_maximisers.py -->", f"<!-- end of {name} -->"
    pattern = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
    if not pattern.search(page):
        raise InputError(f"{PAGE}: expected the marks of the table {name}, got none")
    PAGE.write_text(pattern.sub(lambda _: f"{begin}\n{text}\n{end}", page), encoding="utf-8")


PEERS = (
    "nlopt DIRECT_L",
    "nlopt MLSL_LDS, BOBYQA",
    "nlopt CRS2",
    "scipy direct",
    "scipy differential_evolution",
)
TABLES: dict[str, Callable[[], str]] = {
    "functions": lambda: of_functions([*standard(), *classic()], (100, 300, 1000), PEERS),
    "bbob": lambda: of_bbob(DIMENSIONS),
    "g1": lambda: of_g(CASES["g1"], (100, 300)),
    "g23": lambda: of_g(CASES["g23"], (100, 300)),
    "g250": lambda: of_g(CASES["g250"], (100, 300)),
}


@click.command()
@click.argument("tables", nargs=-1, type=click.Choice(list(TABLES)))
@click.option("--only", multiple=True, type=click.Choice(NAMES), help="Of the tables of g, the rows of this search.")
def main(tables: tuple[str, ...], only: tuple[str, ...]) -> None:
    """Write the TABLES anew: all of them unless some are named."""
    sys.path.insert(0, str(ROOT))
    warnings.simplefilter("ignore")
    for name in tables or TABLES:
        if name == "bbob" and not find_spec("ioh"):
            click.echo(f"bbob: left as it is, since it needs a package: {not_installed('ioh')}", err=True)
            continue
        if only and name not in CASES:
            raise InputError(f"{name}: expected a table of g with --only, since this one compares times or peers")
        put(name, joined(name, of_g(CASES[name], (100, 300), only)) if only else TABLES[name]())


if __name__ == "__main__":
    main()
