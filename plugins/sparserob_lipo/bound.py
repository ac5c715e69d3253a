"""A proven upper bound of a Lipschitz function from its values at some points, by a partition of the box."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from sparserob_lipo.evaluated import Evaluated

CELLS_AT_ONCE: Final = 64
WORK: Final = 2**28  # differences of coordinates that may be computed
MAX_ROUNDS: Final = 100
ROUNDING: Final = 1e-12


def lipschitz_bound(evaluated: Evaluated, constant: float, sides: np.ndarray) -> float:
    """Return an upper bound, over the box ``0 <= z <= sides (d,)``, of every function with this Lipschitz constant and
    the evaluated values.

    ``U(z) = min_i value_i + constant |z - z_i|`` bounds the function and has the constant itself, so on a cell with
    centre ``c`` and half sides ``h`` nothing exceeds ``U(c) + constant |h|``. The cells with the highest bounds are
    halved across their longest side, again and again (Piyavskii 1972, Shubert 1972, in boxes); the bound that is
    returned holds whenever one stops, and is raised by what rounding may cost. ``inf`` when the values themselves
    refute the constant.
    """
    allowance = ROUNDING * (float(np.abs(evaluated.values).max()) + constant * float(np.linalg.norm(sides)))
    if evaluated.refutes(constant, allowance):
        return math.inf
    best = float(evaluated.values[-1])
    centres, halves = 0.5 * sides[np.newaxis], 0.5 * sides[np.newaxis]
    bounds = _cell_bounds(evaluated, constant, centres, halves)
    rounds = min(MAX_ROUNDS, WORK // (2 * CELLS_AT_ONCE * evaluated.count * max(4, sides.size)))
    for _ in range(rounds):
        top = bounds.max(initial=best)
        if top - best <= ROUNDING * max(abs(top), abs(best)):
            break
        highest = np.argsort(bounds)[-CELLS_AT_ONCE:]
        unsplit = np.setdiff1d(np.arange(len(bounds)), highest)
        new_centres, new_halves = _halved(centres[highest], halves[highest])
        new_bounds = np.minimum(_cell_bounds(evaluated, constant, new_centres, new_halves), np.tile(bounds[highest], 2))
        centres, halves, bounds = (
            np.concatenate(pair)
            for pair in ((centres[unsplit], new_centres), (halves[unsplit], new_halves), (bounds[unsplit], new_bounds))
        )
        is_open = bounds > best
        centres, halves, bounds = centres[is_open], halves[is_open], bounds[is_open]
    return float(bounds.max(initial=best)) + allowance


def _cell_bounds(evaluated: Evaluated, constant: float, centres: np.ndarray, halves: np.ndarray) -> np.ndarray:
    bounds: np.ndarray = evaluated.bounds(centres, constant) + constant * np.linalg.norm(halves, axis=1)
    return bounds


def _halved(centres: np.ndarray, halves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut each cell in half; return the centres and half sides of all left halves, then of all right ones."""
    rows, longest = np.arange(len(centres)), np.argmax(halves, axis=1)
    new_halves = halves.copy()
    new_halves[rows, longest] *= 0.5
    shift = np.zeros_like(halves)
    shift[rows, longest] = new_halves[rows, longest]
    return np.concatenate([centres - shift, centres + shift]), np.concatenate([new_halves, new_halves])
