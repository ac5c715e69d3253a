"""Dictionaries: indicators of pieces, Haar wavelets, Walsh functions."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, final

import numpy as np
from pydantic import Field

import sparserob_core as sr

MAX_PIECES = 1_000_000
MAX_OF_HAAR = 2**17  # pieces, on each of which log2 of them and one functions are not 0


@final
class PiecewiseConstant(sr.DictionaryFactory, sr.Options):
    """Indicator functions, one per piece; the pieces are equal, or as the breakpoints say."""

    pieces: int | None = Field(default=None, ge=1, le=MAX_PIECES)
    """Number of equal pieces; 100 unless ``pieces``, ``step`` or ``breakpoints`` is given."""

    step: float | None = Field(default=None, gt=0.0)
    """Length of a piece; the number of equal pieces is the horizon divided by it, rounded up."""

    breakpoints: Annotated[list[float], Field(min_length=2)] | None = None
    """Ends of all pieces, increasing from 0 to the horizon."""

    functions: int | None = Field(default=None, ge=1, le=MAX_PIECES)
    """Number of functions, at most the number of pieces; fewer join neighbouring pieces as evenly as possible."""

    def build(self, horizon: float) -> sr.Dictionary:
        """Build the dictionary on ``[0, horizon]``; raises `InputError` when the options do not fit it."""
        times = self._times(horizon)
        pieces = times.size - 1
        functions = _functions(self.functions, pieces)
        return sr.Dictionary.indicators(times, np.arange(pieces) * functions // pieces)

    def _times(self, horizon: float) -> sr.Array:
        options = [name for name in ("pieces", "step", "breakpoints") if getattr(self, name) is not None]
        if len(options) > 1:
            raise sr.InputError(f"expected one of pieces, step and breakpoints, got {' and '.join(options)}")
        if self.breakpoints is not None:
            return _checked(self.breakpoints, horizon)
        pieces = self.pieces or 100
        if self.step is not None:
            pieces = max(1, math.ceil(horizon / self.step * (1.0 - 1e-12)))
            if pieces > MAX_PIECES:
                raise sr.InputError(
                    f"step: expected at most {MAX_PIECES} pieces, got {pieces} on the horizon {horizon:g}"
                )
        return np.linspace(0.0, horizon, pieces + 1)


@final
class Haar(sr.DictionaryFactory, sr.Options):
    """The first Haar functions (Haar 1910) with values in -1, 0, 1: a constant, then ever shorter steps."""

    pieces: int = Field(default=128, ge=1, le=MAX_OF_HAAR)
    """Number of equal pieces, a power of two."""

    functions: int | None = Field(default=None, ge=1, le=MAX_OF_HAAR)
    """Number of functions, at most the number of pieces; all unless given."""

    def build(self, horizon: float) -> sr.Dictionary:
        """Build the dictionary on ``[0, horizon]``; raises `InputError` when the options do not fit together."""
        from scipy.sparse import csr_array

        K = _power_of_two(self.pieces)
        N = _functions(self.functions, K)
        pieces = np.arange(K)
        rows, columns, data = [np.zeros(K, dtype=int)], [pieces], [np.ones(K)]
        scale = 1
        while scale < N:  # functions scale, scale + 1, ... are 1 on half of K / scale pieces, and -1 on the other half
            length = K // scale
            rows.append(scale + pieces // length)
            columns.append(pieces)
            data.append(np.where(pieces % length < length // 2, 1.0, -1.0))
            scale *= 2
        entries = np.concatenate(data), (np.concatenate(rows), np.concatenate(columns))
        values = csr_array(entries, shape=(max(scale, 1), K))[:N]
        return sr.Dictionary(np.linspace(0.0, horizon, K + 1), values)


@final
class Walsh(sr.DictionaryFactory, sr.Options):
    """The first Walsh functions (Walsh 1923) with values -1 and 1, ordered by their number of sign changes
    (sequency)."""

    pieces: int = Field(default=128, ge=1, le=4096)
    """Number of equal pieces, a power of two."""

    functions: int | None = Field(default=None, ge=1, le=4096)
    """Number of functions, at most the number of pieces; all unless given."""

    def build(self, horizon: float) -> sr.Dictionary:
        """Build the dictionary on ``[0, horizon]``; raises `InputError` when the options do not fit together."""
        K = _power_of_two(self.pieces)
        functions = _functions(self.functions, K)
        values = np.ones((1, 1))
        while values.shape[0] < K:
            values = np.block([[values, values], [values, -values]])
        sign_changes = np.count_nonzero(np.diff(values, axis=1), axis=1)
        return sr.Dictionary(np.linspace(0.0, horizon, K + 1), values[np.argsort(sign_changes)][:functions])


def _functions(functions: int | None, pieces: int) -> int:
    if functions is not None and functions > pieces:
        raise sr.InputError(
            f"functions: expected at most {pieces}, as many as pieces, or they are linearly dependent; got {functions}"
        )
    return functions or pieces


def _power_of_two(pieces: int) -> int:
    if pieces & (pieces - 1):
        below = 2 ** (pieces.bit_length() - 1)
        raise sr.InputError(f"pieces: expected a power of two, such as {below} or {2 * below}, got {pieces}")
    return pieces


def _checked(breakpoints: list[float], horizon: float) -> sr.Array:
    times = np.array(breakpoints)
    if times[0] != 0.0 or (np.diff(times) <= 0.0).any() or abs(times[-1] - horizon) > 1e-12 * horizon:
        raise sr.InputError(
            f"breakpoints: expected increasing times from 0 to the horizon {horizon:g}, "
            f"got {times[0]:g} ... {times[-1]:g}" + (", not increasing" if (np.diff(times) <= 0.0).any() else "")
        )
    times[-1] = horizon
    return times


@sr.hookimpl
def sparserob_dictionaries() -> Iterator[sr.DictionaryPlugin]:
    """Offer the shipped dictionaries."""
    yield sr.DictionaryPlugin(
        name="piecewise_constant", factory=PiecewiseConstant, summary="One indicator function per piece of time."
    )
    yield sr.DictionaryPlugin(
        name="haar", factory=Haar, summary="The first Haar functions: steps at ever finer scales."
    )
    yield sr.DictionaryPlugin(
        name="walsh", factory=Walsh, summary="The first Walsh functions: values -1 and 1, by sign changes."
    )
