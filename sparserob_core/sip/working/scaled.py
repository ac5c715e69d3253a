"""Uncertain rows that are relaxed, or deviations that are scaled, as far as they must or can be."""

from __future__ import annotations

import numpy as np

from sparserob_core.sip.inner.simplex.counterpart import Counterpart
from sparserob_core.sip.method import Tools
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.working.robust import left

ROOM = 1e3  # units of the rows that they may have to spare
SLACKENED = 200  # rounds at most


def least_slack(program: SemiInfiniteProgram, tools: Tools, accuracy: float = 1e-9) -> float:
    """By how much all rows must be relaxed alike, in their own units, until some decision meets them; negative where
    they have that much to spare. Infinite where that was not found."""
    assert program.spread is not None
    relaxing = Counterpart(program.finite, program.spread, elastic=True, lowest=-ROOM)
    families = [family for family in program.families if not family.defines and family.uncertain is not None]
    new = [(family, index) for family in families if family.start is not None for index in family.start]
    known: set[tuple[str, bytes]] = set()
    for _ in range(SLACKENED):
        tools.deadline.check()
        fresh = [(family, index) for family, index in new if (family.name, index.tobytes()) not in known]
        for family, index in fresh:
            assert family.uncertain is not None
            known.add((family.name, index.tobytes()))
            relaxing.add(family.uncertain(index))
        answer = relaxing.solve(seconds=left(tools))
        if not answer.solved:
            return np.inf
        beyond = answer.slack + accuracy
        found = [(family, family.worst(answer.x)) for family in families if family.worst is not None]
        new = [(family, index) for family, one in found for index in one.indices[one.violations > beyond]]
        unknown = any((family.name, index.tobytes()) not in known for family, index in new)
        if not new or not (relaxing.sharpen(answer.x) or unknown):
            return answer.slack
    return np.inf


def largest_factor(program: SemiInfiniteProgram, tools: Tools, highest: float, accuracy: float = 1e-9) -> float | None:
    """The largest factor up to ``highest`` by which all deviations can be multiplied so that some decision meets every
    row, to ``accuracy`` in their own units; ``None`` where the rows do not tell, or nothing was found.

    Where the deviations are ``f`` times as large, a row is ``g x + w'(C (f x) + f d) <= h``: linear in ``f``, in
    ``f x`` of the variables that answer deviations, and in the others.
    """
    families = [family for family in program.families if not family.defines]
    if program.spread is None or any(family.scaled is None or family.start is None for family in families):
        return None
    growing = Counterpart(program.finite, program.spread, scales=True, highest=highest)
    answers = np.zeros(program.n, dtype=bool)
    known: set[tuple[str, bytes]] = set()
    new = [(family, index) for family in families if family.start is not None for index in family.start]
    for _ in range(SLACKENED):
        tools.deadline.check()
        for family, index in new:
            key = (family.name, index.tobytes())
            if key in known or family.uncertain is None:
                continue
            rows = family.uncertain(index)
            known.add(key)
            answers[rows.stacked.indices] = True
            growing.add(rows)
        answer = growing.solve(seconds=left(tools))
        factor = answer.slack
        if not answer.solved or not factor > 0.0:
            return None
        x = np.where(answers, answer.x / factor, answer.x)
        sharper = growing.sharpen(x)
        found = [(one, one.scaled(factor).worst) for one in families if one.scaled is not None]
        worst = [(one, separation(x)) for one, separation in found if separation is not None]
        new = [(one, index) for one, each in worst for index in each.indices[each.violations > accuracy]]
        if not sharper and all((one.name, index.tobytes()) in known for one, index in new):
            return factor
    return None
