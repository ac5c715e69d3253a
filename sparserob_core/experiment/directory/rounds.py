"""The decisions and the cuts of every round, as the arrays of ``rounds.npz``, and back again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import get_args

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import RoundFinished
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.program import Formulation

CUTS = ("families", "indices", "rows", "multipliers")
FORMULATIONS = "formulations"
BOUND = "bound_"  # before the names of what solution.npz says of the constraints that prove the bound
NUMBERS = 500_000  # of all decisions, that a run keeps


def round_arrays(history: Sequence[RoundFinished]) -> dict[str, Array]:
    """``rounds.npz``: the ``decisions (r, n)`` of all rounds and their ``costs (r,)``; of every imposed constraint its
    round, from 0, in ``rounds (c,)``, and ``families``, ``formulations``, ``indices`` (padded with NaN), ``rows``,
    ``multipliers``. Nothing, ``{}``, where that is not known or too much.
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
        "formulations": np.array([cut.formulation for _, cut in cuts], dtype=str),
        "indices": indices,
        "rows": np.array([cut.row for _, cut in cuts], dtype=int),
        "multipliers": np.concatenate([np.zeros(0), *(entry.multipliers for entry in history)]),
    }


def with_decisions(
    history: Sequence[RoundFinished], arrays: Mapping[str, Array], before: Formulation = "reduced"
) -> tuple[RoundFinished, ...]:
    """The rounds with what `round_arrays` kept of them, and the cuts that came and went; as they are where nothing was
    kept. ``before`` as in `cuts_of`.

    Raises `KeyError` or `ValueError` for arrays that do not belong to them.
    """
    if not arrays:
        return tuple(history)
    if len(arrays["decisions"]) != len(history):
        raise ValueError(f"decisions: expected {len(history)} rounds, got {len(arrays['decisions'])}")
    complete, last = [], dict[tuple[str, bytes, int], Cut]()
    for number, entry in enumerate(history):
        mine = arrays["rounds"] == number
        cuts = tuple(
            replace(cut, multiplier=0.0)
            for cut in cuts_of({name: arrays[name][mine] for name in (*CUTS, FORMULATIONS) if name in arrays}, before)
        )
        now = {(cut.family, cut.index.tobytes(), cut.row): cut for cut in cuts}
        complete.append(
            replace(
                entry,
                decision=arrays["decisions"][number],
                cost=float(arrays["costs"][number]),
                imposed=cuts,
                multipliers=arrays["multipliers"][mine],
                added=tuple(cut for key, cut in now.items() if key not in last),
                dropped=tuple(cut for key, cut in last.items() if key not in now),
            )
        )
        last = now
    return tuple(complete)


def cuts_of(arrays: Mapping[str, Array], before: Formulation = "reduced") -> tuple[Cut, ...]:
    """The imposed constraints that ``solution.npz`` or ``rounds.npz`` holds. ``before``: the formulation of their
    indices in a run of a version that did not write it."""
    forms = arrays[FORMULATIONS] if FORMULATIONS in arrays else np.full(len(arrays["rows"]), before)
    columns = (arrays[name] for name in CUTS)
    return tuple(
        Cut(str(family), index[~np.isnan(index)], int(row), float(multiplier), _formulation(str(form)))
        for family, index, row, multiplier, form in zip(*columns, forms, strict=True)
    )


def _formulation(name: str) -> Formulation:
    known: dict[str, Formulation] = {form: form for form in get_args(Formulation)}
    if name not in known:
        raise ValueError(f"{FORMULATIONS}: expected one of {', '.join(known)}, got {name!r}")
    return known[name]
