"""Dictionaries of piecewise constant functions, whose combinations are the controls and the disturbances."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.errors import InputError
from sparserob_core.shapes import Float, Int, shaped
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array

MAX_TABLE_VALUES = 100_000_000  # entries of the largest table of values that is made (0.8 GB)


@dataclass(frozen=True, eq=False, init=False)
class Dictionary:
    """A list of ``N`` linearly independent functions of time, which are constant on ``K >= N`` intervals.

    Parameters
    ----------
    breakpoints : array (K + 1,)
        Increasing times, the first of which is 0 and the last the horizon, in the time unit of the system.
    values : array (N, K) or sparse array of scipy
        The values of the functions: ``values[i, k]`` is function ``i`` on ``[breakpoints[k], breakpoints[k + 1])``.

    Raises
    ------
    InputError
        If the times do not increase from 0, a shape is wrong, an entry is not finite, or the functions are linearly
        dependent.

    Notes
    -----
    A dictionary of indicators keeps the function of each interval only, and a sparse dictionary its nonzero entries.
    The methods `control` and `gathered` multiply by ``values`` and by its transpose without a full table.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> sr.Dictionary([0.0, 1.0, 3.0], [[1.0, 1.0]]).lengths
    array([1., 2.])
    """

    breakpoints: Array
    _owner: ClassVar[np.ndarray | None] = None  # for indicators, the function (K,) that is 1 on each interval
    _entries: ClassVar[csr_array | None] = None  # for a sparse array, its entries

    __repr__ = noun

    def __init__(self, breakpoints: npt.ArrayLike, values: npt.ArrayLike | csr_array) -> None:
        times = _check_times(breakpoints)
        entries = _check_sparse(values) if hasattr(values, "tocsr") else None
        matrix = _check_numbers("values", values) if entries is None else entries
        shape: tuple[int, ...] = matrix.shape
        if len(shape) != 2 or shape[0] == 0 or shape[1] != times.size - 1:
            raise InputError(
                f"values must have shape (functions, {times.size - 1}), got {matrix.shape}", path="dictionary"
            )
        _check_function_count(shape[0], shape[1])
        owner = _owner(matrix) if entries is None else None
        if owner is not None:
            self._set_fields(breakpoints=times, _owner=owner)
        elif entries is not None:
            self._set_fields(breakpoints=times, _entries=entries)
            if not _has_orthogonal_rows(entries) and not _has_full_row_rank(self.values):
                raise _build_dependence_error(self.values)
        elif not _has_full_row_rank(matrix):
            raise _build_dependence_error(matrix)
        else:
            self._set_fields(breakpoints=times, values=matrix)

    @classmethod
    def indicators(cls, breakpoints: npt.ArrayLike, owner: npt.ArrayLike | None = None) -> Dictionary:
        """Return a dictionary of functions that are 0 or 1, with one function that is 1 on each interval.

        Parameters
        ----------
        breakpoints : array (K + 1,)
            Increasing times, the first of which is 0.
        owner : array (K,) of int, optional
            The function that is 1 on each interval: whole numbers from 0 on, each of which occurs. Function ``k``
            belongs to interval ``k`` unless given.

        Returns
        -------
        Dictionary
            The dictionary, which takes memory for ``K`` numbers.

        Raises
        ------
        InputError
            If the times do not increase from 0, or ``owner`` is not of this form.
        """
        times = _check_times(breakpoints)
        if owner is None:
            return cls._build_from_fields(times, _owner=np.arange(times.size - 1))
        owner = np.array(owner)
        if (
            owner.shape != (times.size - 1,)
            or owner.dtype.kind not in "iu"
            or not 0 <= owner.min() <= owner.max() < owner.size
            or not np.bincount(owner).all()
        ):
            raise InputError(
                f"owner must be {times.size - 1} whole numbers, all from 0 to the largest, got {_abbreviate(owner)}",
                path="dictionary",
            )
        return cls._build_from_fields(times, _owner=owner)

    @classmethod
    def _build_from_fields(cls, breakpoints: Array, **kept: object) -> Dictionary:
        """Return a dictionary with checked fields."""
        dictionary = cls.__new__(cls)
        dictionary._set_fields(breakpoints=breakpoints, **kept)
        return dictionary

    def _set_fields(self, **kept: object) -> None:
        """Keep fields of the frozen dictionary."""
        self.__dict__.update(kept)

    def by_values(self) -> Dictionary:
        """Return the indicators of the intervals where the functions span all values; the dictionary itself elsewhere.

        The controls remain the same; their coefficients become their values on the intervals.
        """
        full = self.functions == self.pieces and not self.is_indicators
        return Dictionary._build_from_fields(self.breakpoints, _owner=np.arange(self.pieces)) if full else self

    def on(self, breakpoints: npt.ArrayLike) -> Dictionary:
        """Return the same functions on as many intervals between other ``breakpoints (K + 1,)``; raise `InputError`."""
        times = _check_times(breakpoints)
        if times.size != self.breakpoints.size:
            raise InputError(f"expected {self.breakpoints.size} breakpoints, got {times.size}", path="dictionary")
        return Dictionary._build_from_fields(times, **self._value_field)

    @property
    def _value_field(self) -> dict[str, object]:
        """The field that holds the values."""
        if self._owner is not None:
            return {"_owner": self._owner}
        return {"values": self.values} if self._entries is None else {"_entries": self._entries}

    @cached_property
    def values(self) -> Array:
        """The table ``(N, K)`` of the values of all functions on all intervals, made at the first use.

        Raises `InputError` where the table would take more than 0.8 GB.
        """
        N, K = self.functions, self.pieces
        if N * K > MAX_TABLE_VALUES:
            raise InputError(
                f"the values of {N} functions on {K} pieces would take {8e-9 * N * K:.1f} GB;"
                " expected less than 0.8 GB: ask for control(theta), gathered(weights), at(pieces) or sparse",
                path="dictionary",
            )
        if self._entries is not None:
            return np.asarray(self._entries.toarray())
        return self.at(np.arange(K))

    @property
    def horizon(self) -> float:
        """The time at which the last interval ends."""
        return float(self.breakpoints[-1])

    @property
    def pieces(self) -> int:
        """The number ``K`` of intervals."""
        return int(self.breakpoints.size - 1)

    @cached_property
    def functions(self) -> int:
        """The number ``N`` of functions."""
        if self._owner is not None:
            return int(self._owner.max()) + 1
        return int((self.values if self._entries is None else self._entries).shape[0])

    @property
    def lengths(self) -> Array:
        """The length ``(K,)`` of each interval."""
        return np.diff(self.breakpoints)

    @cached_property
    def is_indicators(self) -> bool:
        """True where function ``k`` is the indicator of interval ``k``."""
        return self._owner is not None and np.array_equal(self._owner, np.arange(self.pieces))

    @cached_property
    def sparse(self) -> csr_array:
        """The table ``values (N, K)`` as a sparse array."""
        from scipy.sparse import csr_array

        if self._entries is not None:
            return self._entries
        if self._owner is None:
            return csr_array(self.values)
        coordinates = (self._owner, np.arange(self.pieces))
        return csr_array((np.ones(self.pieces), coordinates), shape=(self.functions, self.pieces))

    @shaped
    def control(self, theta: Float[Array, "*n"]) -> Float[Array, "m K"]:
        """Return the control on the intervals.

        Parameters
        ----------
        theta : array (m N,)
            The coefficients, channel by channel.

        Returns
        -------
        array (m, K)
            The value of each channel on each interval.
        """
        coefficients = theta.reshape(-1, self.functions)
        if self.is_indicators:
            return coefficients
        return coefficients[:, self._owner] if self._owner is not None else np.asarray(coefficients @ self._table)

    @shaped
    def summands(self, theta: Float[Array, "*n"]) -> Float[Array, "m K"]:
        """Return the sums ``(m, K)`` of the absolute values of the terms that are added up in `control`."""
        size = np.abs(theta).reshape(-1, self.functions)
        return self.control(size) if self._owner is not None else np.asarray(size @ np.abs(self._table))

    @shaped
    def gathered(self, weights: Float[Array, "*k K m"]) -> Float[Array, "*k N m"]:
        """Return the weights on coefficients that are equivalent to weights on the values of a control.

        Parameters
        ----------
        weights : array (..., K, m)
            The weights on the values of the control on the intervals.

        Returns
        -------
        array (..., N, m)
            The weights on the coefficients: the product with ``values``.
        """
        if self.is_indicators:
            return weights
        if self._owner is None and self._entries is None:
            return np.asarray(self.values @ weights)
        by_piece = np.moveaxis(weights, -2, 0)
        if self._owner is not None:
            sums = np.zeros((self.functions, *by_piece.shape[1:]))
            np.add.at(sums, self._owner, by_piece)
        else:
            assert self._entries is not None
            sums = (self._entries @ by_piece.reshape(self.pieces, -1)).reshape(self.functions, *by_piece.shape[1:])
        return np.moveaxis(sums, 0, -2)

    @shaped
    def at(self, pieces: Int[np.ndarray, "*k"]) -> Float[Array, "*nk"]:
        """Return the values ``(N, ...)`` of the functions on the intervals with given indices ``(...,)``."""
        if self._owner is not None:
            answer = np.zeros((self.functions, pieces.size))
            answer[self._owner[pieces.ravel()], np.arange(pieces.size)] = 1.0
            return answer.reshape(-1, *pieces.shape)
        if self._entries is not None:
            return np.asarray(self._entries[:, pieces.ravel()].toarray()).reshape(-1, *pieces.shape)
        return np.asarray(self.values[:, pieces])

    def merged(self) -> Dictionary:
        """Return the same functions on the fewest intervals: those between which no function changes are joined."""
        if self.is_indicators:
            return self
        keep = np.concatenate([[True], self.changes])
        breakpoints = self.breakpoints[np.concatenate([keep, [True]])]
        if self._owner is not None:
            return Dictionary._build_from_fields(breakpoints, _owner=self._owner[keep])
        if self._entries is not None:
            return Dictionary._build_from_fields(breakpoints, _entries=self._entries[:, np.flatnonzero(keep)])
        return Dictionary._build_from_fields(breakpoints, values=self.values[:, keep])

    @property
    def is_complete(self) -> bool:
        """True where the functions span every piecewise constant function on the merged intervals."""
        return self.is_indicators or self.functions == 1 + int(self.changes.sum())

    @cached_property
    def changes(self) -> np.ndarray:
        """The mask ``(K - 1,)`` that is true where a function changes from one interval to the next."""
        if self._owner is not None:
            return np.asarray(np.diff(self._owner) != 0)
        if self._entries is None:
            return np.asarray((np.diff(self.values, axis=1) != 0).any(axis=0))
        difference = (self._entries[:, 1:] - self._entries[:, :-1]).tocsc()
        difference.eliminate_zeros()
        return np.asarray(np.diff(difference.indptr) > 0)

    @property
    def _table(self) -> Array | csr_array:
        """The table ``values (N, K)`` as it is kept, full or sparse."""
        return self.values if self._entries is None else self._entries


class DictionaryFactory(ABC):
    """A dictionary that a config can name; its options are the fields of the class.

    The dictionary is built when the horizon is known.
    """

    @abstractmethod
    def build(self, horizon: float) -> Dictionary:
        """Return the dictionary on ``[0, horizon]``; raise `InputError` where the options do not fit the horizon."""


def _check_times(value: object) -> Array:
    """Return breakpoints as an array; raise `InputError` where they do not increase from 0."""
    breakpoints = _check_numbers("breakpoints", value)
    if breakpoints.ndim != 1 or breakpoints.size < 2 or breakpoints[0] != 0.0 or (np.diff(breakpoints) <= 0).any():
        raise InputError(
            f"breakpoints must increase from 0, at least two of them, got {_abbreviate(breakpoints)}",
            path="dictionary",
        )
    return breakpoints


def _check_numbers(name: str, value: object) -> Array:
    """Return an array of finite numbers; raise `InputError`."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be an array of numbers", path="dictionary") from error
    if not np.isfinite(array).all():
        raise InputError(f"{name} must be finite numbers", path="dictionary")
    return array


def _check_sparse(values: object) -> csr_array:
    """Return a sparse array of finite numbers without stored zeros; raise `InputError`."""
    from scipy.sparse import csr_array

    try:
        entries = csr_array(values, dtype=float, copy=True)
    except (TypeError, ValueError) as error:
        raise InputError("values must be an array of numbers", path="dictionary") from error
    if not np.isfinite(entries.data).all():
        raise InputError("values must be finite numbers", path="dictionary")
    entries.sum_duplicates()
    entries.eliminate_zeros()
    return entries


def _check_function_count(functions: int, pieces: int) -> None:
    """Raise `InputError` where there are more functions than intervals."""
    if functions > pieces:
        raise InputError(
            f"{functions} functions on {pieces} pieces; there can be at most as many functions as pieces, or they are"
            " linearly dependent",
            path="dictionary",
        )


def _build_dependence_error(values: Array) -> InputError:
    """Return the error for functions that are linearly dependent."""
    return InputError(
        f"the {values.shape[0]} functions must be linearly independent, their rank is {np.linalg.matrix_rank(values)}",
        path="dictionary",
    )


def _owner(values: Array) -> np.ndarray | None:
    """Return the function ``(K,)`` that is 1 on each interval; ``None`` where the functions are no indicators."""
    owner: np.ndarray = values.argmax(axis=0)
    ones = values[owner, np.arange(owner.size)] == 1.0
    if not ones.all() or np.count_nonzero(values) != owner.size or np.unique(owner).size != values.shape[0]:
        return None
    return owner


def _has_orthogonal_rows(entries: csr_array) -> bool:
    """Return True where the rows are orthogonal to one another, and none of them is 0."""
    gram = (entries @ entries.T).tocoo()
    return bool((np.diff(entries.indptr) > 0).all() and (gram.data[gram.row != gram.col] == 0.0).all())


def _has_full_row_rank(values: Array) -> bool:
    """Return True where a table has full row rank.

    Disjoint supports and orthogonal rows are recognised without a singular value decomposition.
    """
    occupied = values != 0
    if not occupied.any(axis=1).all():
        return False
    if occupied.sum(axis=0).max() <= 1:
        return True
    gram = values @ values.T
    if np.count_nonzero(gram - np.diag(np.diag(gram))) == 0:
        return True
    return bool(np.linalg.matrix_rank(values) == values.shape[0])


def _abbreviate(array: np.ndarray) -> str:
    return np.array2string(array, threshold=8, precision=6)
