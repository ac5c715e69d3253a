"""Least relaxation of uncertain rows, and largest scaling of deviations."""

from __future__ import annotations

import numpy as np

from sparserob_core.sip.inner.simplex.counterpart import Counterpart
from sparserob_core.sip.method import Tools
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.working.robust import left

ROOM = 1e3  # largest margin of the rows, in their own units
SLACKENED = 200  # largest number of rounds


def least_slack(program: SemiInfiniteProgram, tools: Tools, accuracy: float = 1e-9) -> float:
    """Return the least amount by which all rows must be relaxed alike until some decision meets them.

    Parameters
    ----------
    program : SemiInfiniteProgram
        Program with deviations.
    tools : Tools
        Components of the run; their deadline is checked.
    accuracy : float, default 1e-9
        Accuracy in the rows' own units.

    Returns
    -------
    float
        The amount in the rows' own units. The amount is negative where the rows have a margin, and infinite where it
        was not found.
    """
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
    """Return the largest factor by which all deviations can be multiplied so that some decision meets every row.

    With deviations ``f`` times as large, a row is ``g x + w'(C (f x) + f d) <= h``. The row is linear in ``f``, in the
    product ``f x`` for variables that answer deviations, and in the other variables.

    Parameters
    ----------
    program : SemiInfiniteProgram
        Program with deviations.
    tools : Tools
        Components of the run; their deadline is checked.
    highest : float
        Upper bound of the factor.
    accuracy : float, default 1e-9
        Accuracy in the rows' own units.

    Returns
    -------
    float or None
        The factor; ``None`` where the families do not offer scaled rows, or where nothing was found.
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
