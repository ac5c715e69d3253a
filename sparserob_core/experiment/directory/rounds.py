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
BOUND = "bound_"  # prefix of the arrays in solution.npz for the constraints that prove the bound
MAX_DECISION_NUMBERS = 500_000  # largest total size of the decisions that a run keeps


def round_arrays(history: Sequence[RoundFinished]) -> dict[str, Array]:
    """Return the arrays of ``rounds.npz``.

    They are the ``decisions (r, n)`` of all rounds and their ``costs (r,)``. For every imposed constraint ``rounds
    (c,)`` has its round, counted from 0; ``families``, ``formulations``, ``indices`` (padded with NaN), ``rows`` and
    ``multipliers`` describe it. The mapping is empty where a decision is unknown, or the total size of all exceeds
    `MAX_DECISION_NUMBERS`.
    """
    decisions = [entry.decision for entry in history if entry.decision is not None]
    if (
        not decisions
        or len(decisions) < len(history)
        or sum(decision.size for decision in decisions) > MAX_DECISION_NUMBERS
    ):
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
    """Return the rounds with the decisions and cuts that `round_arrays` kept, and with the cuts that were added and
    dropped.

    The rounds are returned as they are where nothing was kept. ``before`` is that of `cuts_of`. Raises `KeyError` or
    `ValueError` for arrays that do not belong to the rounds.
    """
    if not arrays:
        return tuple(history)
    if len(arrays["decisions"]) != len(history):
        raise ValueError(f"decisions: expected {len(history)} rounds, got {len(arrays['decisions'])}")
    complete, last = [], dict[tuple[str, bytes, int], Cut]()
    for number, entry in enumerate(history):
        mask = arrays["rounds"] == number
        cuts = tuple(
            replace(cut, multiplier=0.0)
            for cut in cuts_of({name: arrays[name][mask] for name in (*CUTS, FORMULATIONS) if name in arrays}, before)
        )
        now = {(cut.family, cut.index.tobytes(), cut.row): cut for cut in cuts}
        complete.append(
            replace(
                entry,
                decision=arrays["decisions"][number],
                cost=float(arrays["costs"][number]),
                imposed=cuts,
                multipliers=arrays["multipliers"][mask],
                added=tuple(cut for key, cut in now.items() if key not in last),
                dropped=tuple(cut for key, cut in last.items() if key not in now),
            )
        )
        last = now
    return tuple(complete)


def cuts_of(arrays: Mapping[str, Array], before: Formulation = "reduced") -> tuple[Cut, ...]:
    """Return the imposed constraints in the arrays of ``solution.npz`` or ``rounds.npz``.

    ``before`` is the formulation of their indices where an earlier version did not write it.
    """
    forms = arrays[FORMULATIONS] if FORMULATIONS in arrays else np.full(len(arrays["rows"]), before)
    columns = (arrays[name] for name in CUTS)
    return tuple(
        Cut(str(family), index[~np.isnan(index)], int(row), float(multiplier), _parse_formulation(str(form)))
        for family, index, row, multiplier, form in zip(*columns, forms, strict=True)
    )


def _parse_formulation(name: str) -> Formulation:
    formulations: dict[str, Formulation] = {form: form for form in get_args(Formulation)}
    if name not in formulations:
        raise ValueError(f"{FORMULATIONS}: expected one of {', '.join(formulations)}, got {name!r}")
    return formulations[name]
