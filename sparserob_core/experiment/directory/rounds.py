"""The decisions and the cuts of every round, as the arrays of ``rounds.npz``, and back again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import RoundFinished
from sparserob_core.sip.evidence import Cut

NUMBERS = 500_000  # of all decisions, that a run keeps


def round_arrays(history: Sequence[RoundFinished]) -> dict[str, Array]:
    """``rounds.npz``: the ``decisions (r, n)`` of all rounds and their ``costs (r,)``; of every imposed constraint its
    round, from 0, in ``rounds (c,)``, and ``families``, ``indices`` (padded with NaN), ``rows``, ``multipliers``.
    Nothing, ``{}``, where that is not known or too much.
    """
    decisions = [entry.decision for entry in history if entry.decision is not None]
    if not decisions or len(decisions) < len(history) or sum(decision.size for decision in decisions) > NUMBERS:
        return {}
    cuts = [(number, cut) for number, entry in enumerate(history) for cut in entry.imposed]
    width = max((cut.index.size for _, cut in cuts), default=0)
    indices = np.full((len(cuts), width), np.nan)
    for position, (_, cut) in enumerate(cuts):
        indices[position, : cut.index.size] = cut.index
    return {
        "decisions": np.array(decisions),
        "costs": np.array([entry.cost for entry in history]),
        "rounds": np.array([number for number, _ in cuts], dtype=int),
        "families": np.array([cut.family for _, cut in cuts], dtype=str),
        "indices": indices,
        "rows": np.array([cut.row for _, cut in cuts], dtype=int),
        "multipliers": np.concatenate([np.zeros(0), *(entry.multipliers for entry in history)]),
    }


def with_decisions(history: Sequence[RoundFinished], arrays: Mapping[str, Array]) -> tuple[RoundFinished, ...]:
    """The rounds with what `round_arrays` kept of them, and the cuts that came and went; as they are where nothing was
    kept.

    Raises `KeyError` or `ValueError` for arrays that do not belong to them.
    """
    if not arrays:
        return tuple(history)
    if len(arrays["decisions"]) != len(history):
        raise ValueError(f"decisions: expected {len(history)} rounds, got {len(arrays['decisions'])}")
    complete, before = [], dict[tuple[str, bytes, int], Cut]()
    for number, entry in enumerate(history):
        mine = arrays["rounds"] == number
        cuts = tuple(
            Cut(str(family), index[~np.isnan(index)], int(row))
            for family, index, row in zip(
                arrays["families"][mine], arrays["indices"][mine], arrays["rows"][mine], strict=True
            )
        )
        now = {(cut.family, cut.index.tobytes(), cut.row): cut for cut in cuts}
        complete.append(
            replace(
                entry,
                decision=arrays["decisions"][number],
                cost=float(arrays["costs"][number]),
                imposed=cuts,
                multipliers=arrays["multipliers"][mine],
                added=tuple(cut for key, cut in now.items() if key not in before),
                dropped=tuple(cut for key, cut in before.items() if key not in now),
            )
        )
        before = now
    return tuple(complete)
