"""Guards speed: one annealing move of ``g`` at the paper's size beside one cold solve of the same relaxed program, in
one run.

D = 250 indices (t, Beta), 125 250 numbers; a move draws one index anew. The cold solves are given all rows of the
tuple, ready made, in the sparse epigraph form that one would write by hand. Seconds are those of the processor.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

import sparserob_core as sr
from sparserob_core.experiment.assemble import assemble
from sparserob_core.experiment.config.load import load_config
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram
from sparserob_core.sip.relaxed.tuples import TupleValue
from tests.support.places import CONFIGS

CONFIG = CONFIGS / "experiment1_repaired.yaml"
MOVES = 400


def cold(program, G, h, weight, solver):
    """minimise sum of weights |u| + weight/2 |u|^2, rows ``G u <= h``: ``(u, s)`` with ``|u| <= s``."""
    from qpsolvers import solve_qp

    n, base = program.n, program.finite
    P = sparse.block_diag([weight * sparse.identity(n), sparse.csc_matrix((n, n))], format="csc")
    one = sparse.identity(n)
    rows = sparse.csc_matrix(sparse.bmat([[sparse.csc_matrix(G), None], [one, -one], [-one, -one]]))
    start = time.process_time()
    found = solve_qp(
        P,
        np.concatenate([base.q, base.weights]),
        rows,
        np.concatenate([h, np.zeros(2 * n)]),
        lb=np.concatenate([base.lower, np.zeros(n)]),
        ub=np.concatenate([base.upper, base.upper]),
        solver=solver,
    )
    assert found is not None
    return time.process_time() - start, found[:n]


@pytest.mark.benchmark
@pytest.mark.parametrize("formulation", ["literal", "reduced"])
def test_a_move_costs_a_fiftieth_of_a_cold_solve(formulation, capsys):
    registry, program = sr.load_registry(), assemble(load_config(CONFIG)).program
    if formulation == "literal":
        program = replace(program, families=[family.literal for family in program.families])
    relaxed = RelaxedProgram(program, registry.build("solver", "piqp"), registry.build("regulariser", "ridge"))
    g, rng = TupleValue(program, relaxed, 250), np.random.default_rng(0)
    g.epsilon, slot = 0.01, g.layout.slot
    point = rng.uniform(g.domain.lower, g.domain.upper)
    current, seconds = g.at(point), []
    for _ in range(MOVES):
        trial = point.copy()
        i = int(rng.integers(250)) * g.block
        trial[i : i + g.block] = rng.uniform(slot.lower, slot.upper)
        start = time.process_time()
        value = g.at(trial)
        seconds.append(time.process_time() - start)
        if value >= current or rng.random() < 0.2:
            point, current = trial, value
    value = g.at(point)
    rows = [family.rows(g.layout.indices(family, point.reshape(250, -1))) for family in program.families]
    G, h = (np.concatenate([part[k].reshape(-1, *part[k].shape[2:]) for part in rows]) for k in (0, 1))
    curvature = relaxed._terms[0].diagonal()
    assert np.ptp(curvature) <= 1e-12
    lines = [
        f"\n{formulation}: a move {1e3 * np.mean(seconds):.2f} ms on average, median {1e3 * np.median(seconds):.2f} ms"
    ]
    ratios = {}
    for solver in ("piqp", "clarabel", "highs"):
        took, u = cold(program, G, h, 0.01 * curvature[0], solver)
        ratios[solver] = took / np.mean(seconds)
        lines.append(f"  cold {solver:9} {1e3 * took:8.1f} ms, {ratios[solver]:6.0f} moves")
        cost = float(program.finite.weights @ np.abs(u)) + 0.005 * float(curvature @ u**2)
        assert cost == pytest.approx(value, abs=1e-4)
    with capsys.disabled():
        print("\n".join(lines))
    assert ratios["piqp"] >= 50
