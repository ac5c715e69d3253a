"""Weights of the controls in the cost, constant or piecewise constant in time, and their exact integrals."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sparserob_core.control.term import timed
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, as_bound


def checked_weights(given: npt.ArrayLike | None, controls: int, horizon: float) -> Array:
    """Weights ``(m,)``, all positive, or rows ``(r, 1 + m)`` of a time and the weights from then on, none negative. A
    number serves every control, ``None`` is 1; a single row of positive weights is ``(m,)``.

    The rows begin at 0, their times increase, and the last one is before the ``horizon``. Raises `InputError`.
    """
    given = 1.0 if given is None else given
    if isinstance(given, str | bytes) or not _is_nested(given):
        weights = as_bound("weights", given, controls)
        if not ((weights > 0.0) & np.isfinite(weights)).all():
            raise InputError(
                path="weights", expected=f"{controls} positive numbers, one per control", got=f"{weights.tolist()}"
            )
        return weights
    rows = _rows(given, controls, horizon)
    return rows[0, 1:] if len(rows) == 1 and (rows[0, 1:] > 0.0).all() else rows


def _is_nested(given: npt.ArrayLike) -> bool:
    if isinstance(given, np.ndarray):
        return given.ndim > 1
    return isinstance(given, list | tuple) and any(isinstance(row, list | tuple | np.ndarray) for row in given)


def _rows(given: npt.ArrayLike, controls: int, horizon: float) -> Array:
    expected = f"rows of {1 + controls} numbers, a time and a weight for every control"
    try:
        rows = np.array(given, dtype=float)
    except (TypeError, ValueError):
        raise InputError(path="weights", expected=expected, got=f"{given!r}") from None
    if rows.ndim != 2 or rows.shape[1] != 1 + controls or not np.isfinite(rows).all():
        raise InputError(path="weights", expected=expected, got=f"{rows.tolist()}")
    times, weights = rows[:, 0], rows[:, 1:]
    if times[0] != 0.0 or (np.diff(times) <= 0.0).any() or times[-1] >= horizon:
        raise InputError(
            path="weights",
            expected=f"times that begin at 0, increase, and end before {horizon:g} (the horizon)",
            got=f"{times.tolist()}",
        )
    if (weights < 0.0).any():
        raise InputError(path="weights", expected="weights that are not negative", got=f"{weights.tolist()}")
    return np.asarray(rows + 0.0)


def by_time(weights: object) -> tuple[Array, Array]:
    """The times ``(r,)`` from which `checked_weights` count, the first of them 0, and these, ``(r, m)``."""
    rows = np.asarray(weights, dtype=float)
    return (np.zeros(1), rows[None]) if rows.ndim == 1 else (rows[:, 0], rows[:, 1:])


def integrals(weights: object, breakpoints: Array) -> Array:
    """The integrals ``(m, K)`` of the weights over the pieces between ``breakpoints (K + 1,)``, also where they change
    within a piece: exact but for the rounding of the sums."""
    times, values = by_time(weights)
    begins, ends = breakpoints[:-1], breakpoints[1:]
    if times.size == 1:
        return np.outer(values[0], ends - begins)
    overlap = np.minimum(ends, np.append(times[1:], np.inf)[:, None]) - np.maximum(begins, times[:, None])
    return np.asarray(values.T @ np.maximum(overlap, 0.0))


def counted(weights: object) -> Array:
    """What a control counts per time that it acts ``(m,)``: its weight, and 1 where weights change with time, since
    activity counts time and not what it costs."""
    rows = np.asarray(weights, dtype=float)
    return rows if rows.ndim == 1 else np.ones(rows.shape[1] - 1)


def weights_between(weights: object, begin: float, horizon: float) -> Array:
    """The weights of the times from ``begin`` on for as long as ``horizon``, with times that are counted from
    ``begin``."""
    rows = np.asarray(weights, dtype=float)
    if rows.ndim == 1:
        return rows
    kept = rows[int(np.searchsorted(rows[:, 0], begin, side="right")) - 1 :].copy()
    kept[:, 0] = np.maximum(kept[:, 0] - begin, 0.0)
    return kept[kept[:, 0] < horizon]


WEIGHTS = timed(lambda of: of.cost / (of.controls * of.time), weights_between)
