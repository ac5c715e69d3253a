"""Guards speed where the worst case rides on its wall all day: a heated house, certified, beside the program on nodes
that one would write by hand, in one run on one machine.

The program on nodes imposes the comfort bands at the ends of the control's pieces and at the ends of the parameters
only, with the exact worst case of disturbance and initial state there; it proves nothing in between. Its rows are given
to it, and its seconds are those of HiGHS. Ours are for everything. All seconds are of the processor, one core.
"""

from __future__ import annotations

import time
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import sparse
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.experiment.assemble import assemble
from sparserob_core.experiment.config.load import load_config
from sparserob_core.sip.limits import deadline as limits
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.relaxed.relaxed import Rows, rows_at
from tests.known_answers.test_walls import heating

GOALS = {"heating": 10.0, "heating, loss known": 3.0}
"""Seconds in which each is to be certified, and in a third of which to be verified, on one core of a laptop."""


def known() -> dict[str, Any]:
    """The same day with a conductance that is known."""
    config = heating()
    system = config["problem"]["system"]
    ua = sum(system.pop("parameters")["ua"]) / 2
    for piece in system["pieces"]:
        for name in ("A", "c"):
            piece[name] = _at(piece[name], ua)
    return config


def _at(value: Any, ua: float) -> Any:
    if isinstance(value, list):
        return [_at(one, ua) for one in value]
    return value.replace("ua", f"{ua:g}") if isinstance(value, str) else value


def on_nodes(program: SemiInfiniteProgram) -> Rows:
    """The rows of every family at the ends of the control's pieces, and at the ends of the parameters."""
    rows = Rows.none(program.n)
    for family in program.families:
        box = family.index_set
        times = np.unique(np.clip(np.arange(0.0, 24.25, 0.5), box.lower[0], box.upper[0]))
        ends = np.unique(np.stack([box.lower[1:], box.upper[1:]]), axis=0)
        indices = np.hstack([np.repeat(times, len(ends))[:, None], np.tile(ends, (times.size, 1))])
        rows = rows.joined(rows_at(program, family.name, indices))
    return rows


def by_highs(program: SemiInfiniteProgram, rows: Rows) -> np.ndarray:
    """The cheapest heat that meets the rows, by a linear program; nothing is negative here, so that ``|u| = u``."""
    base = program.finite
    image = sparse.csr_array(base.S) if base.S is not None else sparse.eye_array(base.n, format="csr")
    finite = [np.isfinite(side) for side in (base.upper, base.lower)]
    found = linprog(
        image.T @ base.weights,
        A_ub=sparse.vstack([sparse.csr_array(rows.G), image[finite[0]], -image[finite[1]]]),
        b_ub=np.concatenate([rows.h, base.upper[finite[0]], -base.lower[finite[1]]]),
        bounds=(None, None),
        method="highs",
    )
    assert found.status == 0
    return np.asarray(found.x)


def timed(function: Any) -> tuple[Any, float]:
    start = time.process_time()
    answer = function()
    return answer, time.process_time() - start


@pytest.mark.benchmark
@pytest.mark.parametrize("name", GOALS)
def test_a_day_on_the_wall_beside_the_program_on_nodes(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config, goal = {**(heating() if name == "heating" else known()), "observers": []}, GOALS[name]
    program = assemble(load_config(config)).program
    rows = on_nodes(program)
    by_highs(program, rows)  # warm
    naive, seconds = timed(lambda: by_highs(program, rows))

    whole, ours = timed(lambda: sr.run(config, quiet=True, figures=False).result)
    monkeypatch.setattr(limits, "time", SimpleNamespace(monotonic=time.process_time, perf_counter=time.process_time))
    monkeypatch.setattr(Deadline, "enforced", lambda self: nullcontext())  # its alarm goes by the clock on the wall
    third, limited = timed(lambda: sr.run(config, {"limits.seconds": goal / 3}, quiet=True, figures=False).result)
    missed = max(one.violations[0] for one in (f.worst(naive) for f in program.families if f.worst is not None))
    with capsys.disabled():
        print(f"\n{name:22} {'seconds':>8} {'ratio':>6} {'J':>11} {'violation':>10}")
        for who, spent, cost, over, said in (
            ("ours", ours, whole.cost, 0.0, f"{whole.status}, gap {whole.gap:.0e}; goal {goal:g}"),
            (f"ours, limit {goal / 3:.1f}", limited, third.cost, 0.0, f"{third.status}, gap {third.gap:.0e}"),
            ("HiGHS on nodes", seconds, program.cost(naive), missed, "nothing proven"),
        ):
            print(f"  {who:20} {spent:8.2f} {spent / seconds:6.1f} {cost:11.6f} {over:10.1e}  {said}")
    assert whole.status == "certified"
    assert third.status in ("certified", "verified")
    assert whole.lower_bound <= third.upper_bound <= 1.05 * whole.lower_bound
    assert program.cost(naive) <= whole.cost * (1.0 + 1e-6), "nodes alone cannot cost more than all times"
