"""Guards the choice of `auto`: on the programs of whole runs, each from the solution of the one before, it takes no
longer than PIQP alone where the dual Newton method answers. Both are timed side by side, in processor time."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
import sparserob_core.sip.relaxed.relaxed as relaxed
from sparserob_core.sip.inner.solve import solve_finite
from sparserob_core.sip.solver import Named

CONFIGS = Path(__file__).parents[2] / "configs"
REGISTRY = sr.load_registry()
AUTO = REGISTRY.build("solver", "auto")
PIQP = Named(REGISTRY.build("solver", "piqp"), "piqp", AUTO)
REPEATS = 3
FAMILIES = {
    "experiment1_repaired": {},
    "experiment2_repaired": {},
    "experiment3_repaired": {},
    "coupled_masses": {},
    "parameters_and_disturbance": {},
    "double_integrator": {},
    "experiment1_reduced": {"maximiser.budget": 60},
}


def spent(call):
    """The least processor seconds of a few calls, and the last answer."""
    seconds = []
    for _ in range(REPEATS):
        start = time.process_time()
        answer = call()
        seconds.append(time.process_time() - start)
    return min(seconds), answer


@pytest.mark.benchmark
@pytest.mark.parametrize("name", FAMILIES)
def test_where_auto_chooses_the_dual_newton_method_it_is_no_slower_than_piqp(name, monkeypatch, capsys, tmp_path):
    asked = []

    def recorded(program, solver, **options):
        asked.append((program, options))
        return solve_finite(program, solver, **options)

    with monkeypatch.context() as patch:
        patch.setattr(relaxed, "solve_finite", recorded)
        sr.run(CONFIGS / f"{name}.yaml", {"observers": [], **FAMILIES[name]}, tmp_path / "run", figures=False)
    some = np.unique(np.linspace(0, len(asked) - 1, 40).astype(int))
    pairs = []
    for program, options in (asked[k] for k in some):
        ours, answer = spent(lambda p=program, o=options: solve_finite(p, AUTO, **o))
        if answer.by == "dual_newton":
            pairs.append((ours, spent(lambda p=program, o=options: solve_finite(p, PIQP, **o))[0]))
    auto, piqp = np.array(pairs).T
    ratio = auto / piqp
    with capsys.disabled():
        print(
            f"\n  {name:28} {len(pairs):3} programs: dual Newton {1e3 * np.median(auto):6.2f} ms, piqp"
            f" {1e3 * np.median(piqp):6.2f} ms (medians); ratio {np.median(ratio):.2f}, of the sums"
            f" {auto.sum() / piqp.sum():.2f}, at most {ratio.max():.2f}"
        )
    assert np.median(auto) <= np.median(piqp)
    assert auto.sum() <= piqp.sum()
