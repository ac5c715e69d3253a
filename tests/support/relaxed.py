"""Relaxed programs that tests and benchmarks share."""

from __future__ import annotations

from functools import cache

import numpy as np

import sparserob_core as sr
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram, rows_at
from sparserob_piqp import Piqp


@cache
def experiment_one(dictionary: sr.DictionaryFactory, bound: float = 0.06) -> FiniteProgram:
    """The spring-mass-damper with ``|w| <= bound``, its constraints at eight times, tightened for the worst
    disturbance."""
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(np.array([[0, 1], [-2, -0.5]]), np.array([[0], [1]])),
        horizon=5.0,
        initial_state=[-1, 1],
        control=sr.Box([-1], [1]),
        disturbance=sr.Box([-bound, -bound], [bound, bound]),
        path=[sr.PathConstraint(sr.Box([-0.7, -np.inf], [0.7, np.inf]), start=0.3)],
        terminal=[sr.Box([-0.3, -0.3], [0.3, 0.3])],
    )
    built = dictionary.build(5.0)
    program = sr.transcribe(problem, control=built, disturbance=built)
    rows = None
    for family in program.families:
        times = np.linspace(family.index_set.lower, family.index_set.upper, 8)
        found = rows_at(program, family.name, np.unique(times, axis=0))
        rows = found if rows is None else rows.joined(found)
    return RelaxedProgram(program, Piqp()).finite(rows.G, rows.h, 0.0)
