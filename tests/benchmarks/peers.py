"""Other people's global optimisers, each as one function that spends a budget: ``run(value, box, budget, seed)``,
``value`` to be maximised.

They are called as their documentation says, with their defaults, and are ended by the budget. The package ``lipo`` is a
wrapper of dlib's `global_function_search` that has to be compiled; dlib stands for it.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from importlib.util import find_spec

import numpy as np

import sparserob_core as sr

Value = Callable[[object], float]
OFTEN = {100: 20, 1000: 20}


@dataclass(frozen=True)
class Peer:
    """An optimiser, the package that it needs, and how many seeds its overhead allows at each budget."""

    name: str
    package: str
    run: Callable[[Value, sr.Box, int, int], None]
    seeds: Mapping[int, int] = field(default_factory=lambda: OFTEN)

    @property
    def installed(self) -> bool:
        return find_spec(self.package) is not None


def quietly(run, *arguments):
    """Peers warn; in the tests warnings are errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run(*arguments)


def sequool(value, box, budget, seed, partition):
    """It splits a coordinate that is drawn from numpy's global random numbers."""
    from PyXAB.algos.SequOOL import SequOOL

    np.random.seed(seed)  # noqa: NPY002
    cells = getattr(import_module(f"PyXAB.partition.{partition}"), partition)
    tree = SequOOL(n=budget, domain=[list(side) for side in zip(box.lower, box.upper, strict=True)], partition=cells)
    for t in range(1, budget + 1):
        point = tree.pull(t)
        tree.receive_reward(t, value(point))


def dlib(value, box, budget, seed):
    """Not ``find_max_global``: that puts random points in the place of MaxLIPO's where the function is cheap, depending
    on the clock."""
    import dlib

    search = dlib.global_function_search(dlib.function_spec(box.lower.tolist(), box.upper.tolist()))
    search.set_seed(seed)
    for _ in range(budget):
        request = search.get_next_x()
        request.set(value(list(request.x)))


def nlopt(value, box, budget, seed, algorithm, local=None):
    import nlopt

    nlopt.srand(seed + 1)
    search = nlopt.opt(getattr(nlopt, algorithm), box.dimension)
    search.set_lower_bounds(box.lower)
    search.set_upper_bounds(box.upper)
    search.set_max_objective(lambda point, _: value(point))
    search.set_maxeval(budget)
    if local:
        ascent = nlopt.opt(getattr(nlopt, local), box.dimension)
        ascent.set_xtol_rel(1e-9)
        ascent.set_ftol_rel(1e-14)
        search.set_local_optimizer(ascent)
    search.optimize(np.random.default_rng(seed).uniform(box.lower, box.upper))


def _seeded(function, seed):
    """scipy renamed the argument in 1.15."""
    return {"rng" if "rng" in inspect.signature(function).parameters else "seed": seed}


def scipy_annealing(value, box, budget, seed):
    """It does not obey ``maxfun`` within a local search, and is cut there."""
    from scipy.optimize import dual_annealing

    dual_annealing(
        lambda x: -value(x),
        list(zip(box.lower, box.upper, strict=True)),
        maxiter=budget,
        maxfun=budget,
        **_seeded(dual_annealing, seed),
    )


def scipy_direct(value, box, budget, seed):
    from scipy.optimize import Bounds, direct

    direct(lambda x: -value(x), Bounds(box.lower, box.upper), maxfun=budget, maxiter=budget)


def scipy_evolution(value, box, budget, seed):
    """As many generations as leave a tenth of the budget to its polish."""
    from scipy.optimize import differential_evolution

    generations = max(1, int(0.9 * budget / (15 * box.dimension)) - 1)
    differential_evolution(
        lambda x: -value(x),
        list(zip(box.lower, box.upper, strict=True)),
        maxiter=generations,
        tol=0.0,
        **_seeded(differential_evolution, seed),
    )


def nevergrad(value, box, budget, seed, optimiser):
    import nevergrad as ng

    array = ng.p.Array(shape=(box.dimension,), lower=box.lower, upper=box.upper)
    array.random_state = np.random.RandomState(seed)
    search = ng.optimizers.registry[optimiser](parametrization=array, budget=budget, num_workers=1)
    for _ in range(budget):
        candidate = search.ask()
        search.tell(candidate, -value(candidate.value))


PYXAB = ("PyXAB SequOOL, K = 3", "PyXAB SequOOL, its default")
DLIB, ANNEALING = "dlib global_function_search", "scipy dual_annealing"
PEERS = (
    Peer(PYXAB[0], "PyXAB", partial(sequool, partition="KaryPartition")),
    Peer(PYXAB[1], "PyXAB", partial(sequool, partition="BinaryPartition")),
    Peer(DLIB, "dlib", dlib, {100: 20, 1000: 5}),
    Peer("nlopt DIRECT_L", "nlopt", partial(nlopt, algorithm="GN_DIRECT_L"), {100: 5, 1000: 5}),
    Peer("nlopt MLSL_LDS, BOBYQA", "nlopt", partial(nlopt, algorithm="G_MLSL_LDS", local="LN_BOBYQA")),
    Peer("nlopt CRS2", "nlopt", partial(nlopt, algorithm="GN_CRS2_LM")),
    Peer(ANNEALING, "scipy", scipy_annealing),
    Peer("scipy direct", "scipy", scipy_direct, {100: 5, 1000: 5}),
    Peer("scipy differential_evolution", "scipy", scipy_evolution),
    Peer("nevergrad OnePlusOne", "nevergrad", partial(nevergrad, optimiser="OnePlusOne"), {100: 20, 1000: 10}),
    Peer("nevergrad NGOpt", "nevergrad", partial(nevergrad, optimiser="NGOpt"), {100: 10, 1000: 5}),
)
