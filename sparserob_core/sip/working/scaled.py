"""Least relaxation of uncertain rows, and largest scaling of deviations."""

from __future__ import annotations

import numpy as np

from sparserob_core.sip.inner.simplex.counterpart import Counterpart
from sparserob_core.sip.method import Tools
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.working.robust import left

LARGEST_ROW_MARGIN = 1e3  # largest margin of the rows, in their own units
SLACKENED = 200  # largest number of rounds


def least_slack(program: SemiInfiniteProgram, tools: Tools, accuracy: float = 1e-9) -> float:
    """Return the least amount by which all rows must be relaxed alike until some decision meets them, unproven.

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
    relaxing = Counterpart(program.finite, program.spread, elastic=True, lowest=-LARGEST_ROW_MARGIN)
    families = [family for family in program.families if not family.defines and family.uncertain is not None]
    pairs = [(family, index) for family in families if family.start is not None for index in family.start]
    imposed_keys: set[tuple[str, bytes]] = set()
    for _ in range(SLACKENED):
        tools.deadline.check()
        fresh = [(family, index) for family, index in pairs if (family.name, index.tobytes()) not in imposed_keys]
        for family, index in fresh:
            assert family.uncertain is not None
            imposed_keys.add((family.name, index.tobytes()))
            relaxing.add(family.uncertain(index))
        answer = relaxing.solve(seconds=left(tools))
        if not answer.solved:
            return np.inf
        limit = answer.slack + accuracy
        separations = [(family, family.worst(answer.x)) for family in families if family.worst is not None]
        pairs = [
            (family, index)
            for family, separation in separations
            for index in separation.indices[separation.violations > limit]
        ]
        unknown = any((family.name, index.tobytes()) not in imposed_keys for family, index in pairs)
        if not pairs or not (relaxing.sharpen(answer.x) or unknown):
            return answer.slack
    return np.inf


def largest_factor(program: SemiInfiniteProgram, tools: Tools, highest: float, accuracy: float = 1e-9) -> float | None:
    """Return the largest factor by which all deviations can be multiplied so that some decision meets every row,
    unproven.

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
    imposed_keys: set[tuple[str, bytes]] = set()
    pairs = [(family, index) for family in families if family.start is not None for index in family.start]
    for _ in range(SLACKENED):
        tools.deadline.check()
        for family, index in pairs:
            key = (family.name, index.tobytes())
            if key in imposed_keys or family.uncertain is None:
                continue
            rows = family.uncertain(index)
            imposed_keys.add(key)
            answers[rows.stacked.indices] = True
            growing.add(rows)
        answer = growing.solve(seconds=left(tools))
        factor = answer.slack
        if not answer.solved or not factor > 0.0:
            return None
        x = np.where(answers, answer.x / factor, answer.x)
        sharper = growing.sharpen(x)
        oracles = [(family, family.scaled(factor).worst) for family in families if family.scaled is not None]
        separations = [(family, oracle(x)) for family, oracle in oracles if oracle is not None]
        pairs = [
            (family, index)
            for family, separation in separations
            for index in separation.indices[separation.violations > accuracy]
        ]
        if not sharper and all((family.name, index.tobytes()) in imposed_keys for family, index in pairs):
            return factor
    return None
