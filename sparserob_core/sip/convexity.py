"""Convex quadratic forms: each from outside is shown to be convex before a bound rests on it; strictly convex ones
regularise a program.

What is asked does not depend on the units of the variables: a matrix counts as positive semidefinite if a change of its
diagonal by ``ROUNDED`` of itself, for every entry of the longest row, makes it so. That is more than rounding does to
``L L'`` in whatever scaling (Higham 2002, section 10.1; Demmel 1989): an entry ``(i, j)`` of such a product is rounded
by its share of ``sqrt(P_ii P_jj)``. A factorisation without pivoting that meets positive pivots alone is the proof,
but for its own rounding, which is of the same kind (Rump 2006).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.shapes import read_only
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from scipy.sparse import csc_array

# Of sqrt(P_ii P_jj), in every entry: numbers with 13 digits. Ten times less, and products of long matrices are refused;
# ten times more, and a lower bound is off by what a certified gap of 1e-9 promises, for rows of a thousand entries.
ROUNDED = 1e-13
DENSE = 400  # rows up to which a matrix is factored as a dense one, whatever its pattern; ten times more costs 1 s
FULL = 0.1  # share of entries from which that is so for more rows: sparse factors would fill up
SHOWN = 1000  # rows up to which a refusal computes all eigenvalues; ten times more, and it takes minutes
STEPS = 60  # of the Lanczos method that a refusal makes beyond that

_convex: WeakValueDictionary[int, csc_array] = WeakValueDictionary()


@dataclass(frozen=True, eq=False)
class ControlImage:
    """How a decision ``x (n,)`` becomes the values ``S x (k,)`` that the cost is about.

    ``S (k, n)`` sparse; its rows are channel-major: ``channels`` blocks of ``k / channels`` consecutive pieces each.
    ``lengths (k,)``: how much each entry counts (the length of its piece, in time), positive.
    """

    S: csc_array
    channels: int
    lengths: Array

    def __post_init__(self) -> None:
        rows = self.S.shape[0]
        lengths = np.asarray(self.lengths, dtype=float)
        if lengths.shape != (rows,) or not (lengths > 0).all() or not np.isfinite(lengths).all():
            raise InputError(f"control image: lengths must be {rows} positive numbers, one for each row of S")
        if self.channels < 1 or rows % self.channels:
            raise InputError(f"control image: {rows} rows of S do not divide into {self.channels} channels")
        object.__setattr__(self, "lengths", lengths)

    @property
    def pieces(self) -> int:
        """Number of entries of ``S x`` per channel."""
        return int(self.S.shape[0]) // self.channels


class Regulariser(ABC):
    """A strictly convex quadratic ``rho(x) = 1/2 x'P x + q'x`` that is added to the cost with a factor that goes to
    zero."""

    @abstractmethod
    def quadratic(self, image: ControlImage) -> tuple[csc_array, Array]:
        """``P (n, n)`` symmetric positive definite, sparse, and ``q (n,)``."""


def require_convex(path: str, matrix: object, size: int) -> csc_array:
    """Return the matrix of the convex quadratic form ``1/2 x'P x`` in ``size`` variables, to be read only.

    A matrix that this function has returned before, or that is convex by construction (`convex_by_construction`), is
    returned at once.

    Parameters
    ----------
    path : str
        What the matrix is called where it is refused.
    matrix : array_like or sparse, shape (size, size)
        Any matrix of numbers.
    size : int
        The number of variables.

    Returns
    -------
    csc_array, shape (size, size)
        The matrix, exactly symmetric: where it is symmetric but for rounding, the mean of it and its transpose.

    Raises
    ------
    InputError
        With an entry that is not finite, an asymmetric pair of entries, or a negative eigenvalue.
    """
    from scipy.sparse import csc_array

    if isinstance(matrix, csc_array) and _convex.get(id(matrix)) is matrix:
        return matrix
    P = sparse_matrix(path, matrix)
    if P.shape != (size, size):
        raise InputError(path=path, expected=f"shape ({size}, {size})", got=f"{P.shape}")
    P = P if P.dtype == float else csc_array(P.astype(float))
    P = _symmetric(path, P)
    if (direction := _descent(P)) is not None:
        raise InputError(path=path, expected="a positive semidefinite matrix", got=_negative(P, direction))
    return convex_by_construction(P)


def convex_by_construction(P: csc_array) -> csc_array:
    """Return a matrix to be read only that `require_convex` takes without a look: a sum of squares, exactly symmetric,
    whatever rounding has made of it."""
    kept: csc_array = read_only(P)
    _convex[id(kept)] = kept
    return kept


def sparse_matrix(path: str, matrix: object) -> csc_array:
    """Return a matrix of finite real numbers in compressed columns, to be read only; raise `InputError` else."""
    from scipy.sparse import csc_array

    try:
        array = matrix if isinstance(matrix, csc_array) else csc_array(matrix)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: expected a matrix of numbers, got {matrix!r}") from error
    if array.ndim != 2 or array.dtype.kind not in "fiub":
        raise InputError(path=path, expected="a matrix of numbers", got=f"shape {array.shape} of {array.dtype}")
    wrong = np.flatnonzero(~np.isfinite(array.data))
    if wrong.size:
        row, column = int(array.indices[wrong[0]]), int(np.searchsorted(array.indptr, wrong[0], "right")) - 1
        raise InputError(
            path=path, expected="a matrix of finite numbers", got=f"{array.data[wrong[0]]} {_place(row, column)}"
        )
    kept: csc_array = read_only(array)
    return kept


def is_semidefinite(P: csc_array) -> bool:
    """Whether a symmetric matrix is positive semidefinite but for rounding.

    Soundly, but for the rounding of the factorisation: each eigenvalue of the matrix with its diagonal scaled to 1 is
    at least ``-(ROUNDED + (k + 1) 2^-53) k``, with ``k`` the entries of the longest row of its factor.
    """
    return _descent(P) is None


def is_definite(P: csc_array, factor: float = 1.0) -> bool:
    """Whether a symmetric matrix with a positive diagonal is positive definite once its diagonal is multiplied by a
    ``factor``: whether elimination without pivoting meets positive pivots alone."""
    return _failing(P, factor) is None


def _descent(P: csc_array) -> Array | None:
    """A direction ``(n,)`` along which the form is negative; ``None`` where it is positive semidefinite but for
    rounding."""
    diagonal = np.asarray(P.diagonal(), dtype=float)
    bare = np.flatnonzero(~(diagonal > 0.0))
    if bare.size and (direction := _bare(P, diagonal, bare)) is not None:
        return direction
    kept = np.flatnonzero(diagonal > 0.0)
    P = P if kept.size == diagonal.size else P[kept][:, kept]
    size = 1.0 / np.sqrt(diagonal[kept])
    shift = 1.0 + ROUNDED * int(np.diff(P.indptr).max(initial=1))
    if (size * (abs(P) @ size) <= 1.0 + shift).all():  # every row is dominated by its diagonal (Gershgorin)
        return None
    found = _failing(P, shift)
    if found is None:
        return None
    direction = np.zeros(diagonal.size)
    direction[kept] = found
    return direction


def _bare(P: csc_array, diagonal: Array, bare: np.ndarray) -> Array | None:
    """A direction along which the form is negative, where its diagonal is not positive: that entry alone, or one of 0
    with another that it is coupled to."""
    direction = np.zeros(diagonal.size)
    if diagonal.min() < 0.0:
        direction[int(np.argmin(diagonal))] = 1.0
        return direction
    columns = P[:, bare]
    if not columns.data.any():
        return None
    place = int(np.argmax(np.abs(columns.data)))
    row, column = int(columns.indices[place]), int(bare[np.searchsorted(columns.indptr, place, "right") - 1])
    direction[row], direction[column] = 1.0, -(diagonal[row] + 1.0) / columns.data[place]
    return direction


def _failing(P: csc_array, factor: float) -> Array | None:
    """A direction ``(n,)`` along which the form with its diagonal times a ``factor`` is not positive; ``None`` where
    elimination without pivoting meets positive pivots alone."""
    n = P.shape[0]
    if n <= DENSE or P.nnz >= FULL * n * n:
        return _failing_dense(P, factor)
    from scipy.sparse import csc_array, diags_array
    from scipy.sparse.linalg import splu, spsolve_triangular

    shifted = csc_array(P + (factor - 1.0) * diags_array(P.diagonal()))
    options = {"SymmetricMode": True, "Equil": False}
    try:
        found = splu(shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    except RuntimeError:  # a pivot that is exactly 0
        return np.ones(n)
    pivots = found.U.diagonal()
    if np.array_equal(found.perm_r, found.perm_c) and (pivots > 0.0).all():
        return None
    unit = np.zeros(n)
    unit[int(np.argmax(~(pivots > 0.0)))] = 1.0  # L'v = e gives v'A v = pivot, of A = L D L' up to there
    direction: Array = np.asarray(spsolve_triangular(csc_array(found.L.T), unit, lower=False))[found.perm_c]
    return direction


def _failing_dense(P: csc_array, factor: float) -> Array | None:
    n = P.shape[0]
    entries = P.toarray()
    entries[np.diag_indices(n)] *= factor
    try:
        np.linalg.cholesky(entries)
    except np.linalg.LinAlgError:
        pass
    else:
        return None
    from scipy.linalg import cho_solve
    from scipy.linalg.lapack import dpotrf

    lower, order = dpotrf(entries, lower=True)
    k = max(int(order) - 1, 0)  # the first so many rows are positive definite, and one more are not
    direction = np.zeros(n)
    direction[k] = 1.0
    direction[:k] = -cho_solve((lower[:k, :k], True), entries[:k, k])
    return direction


def _symmetric(path: str, P: csc_array) -> csc_array:
    """The matrix, exactly symmetric; refused where it is not symmetric but for rounding."""
    from scipy.sparse import csc_array

    if not P.has_canonical_format:
        P = P.copy()
        P.sum_duplicates()
    turned = csc_array(P.T)
    turned.sort_indices()
    if all(np.array_equal(getattr(P, part), getattr(turned, part)) for part in ("indptr", "indices", "data")):
        return P
    apart = abs(P - turned).tocoo()
    size = np.sqrt(np.abs(P.diagonal()))
    allowed = ROUNDED * np.maximum(size[apart.row] * size[apart.col], np.abs(P[apart.row, apart.col]))
    over = np.flatnonzero(apart.data > allowed)
    if over.size:
        worst = over[int(np.argmax(apart.data[over]))]
        i, j = int(apart.row[worst]), int(apart.col[worst])
        raise InputError(
            path=path,
            expected="a symmetric matrix",
            got=f"{float(P[i, j]):.12g} {_place(i, j)} and {float(P[j, i]):.12g} {_place(j, i)}",
        )
    return csc_array((P + turned) / 2)


def _place(row: int, column: int) -> str:
    return f"in row {row + 1}, column {column + 1}"


def _negative(P: csc_array, direction: Array) -> str:
    """The least eigenvalue of a matrix whose form is negative along a ``direction``, in words: its own, or, where
    rounding hides that, the one of the matrix with its diagonal scaled to 1."""
    from scipy.sparse import csc_array, diags_array

    diagonal = np.asarray(P.diagonal(), dtype=float)
    if P.nnz == np.count_nonzero(diagonal):
        return f"the eigenvalue {diagonal.min():.6g}"
    if not (diagonal > 0.0).all() or _least(P, direction)[0] < -1e-12 * diagonal.max():
        least, exact = _least(P, direction)
        return f"{'the eigenvalue' if exact else 'an eigenvalue of at most'} {min(least, diagonal.min()):.6g}"
    root = np.sqrt(diagonal)
    least, exact = _least(csc_array(diags_array(1.0 / root) @ P @ diags_array(1.0 / root)), direction * root)
    return f"{'the eigenvalue' if exact else 'an eigenvalue of at most'} {least:.6g} where its diagonal is scaled to 1"


def _least(P: csc_array, direction: Array) -> tuple[float, bool]:
    """The least eigenvalue, and whether it is exact: of a large matrix the least of the form among the unit vectors
    that some steps of Lanczos span from a ``direction``."""
    if P.shape[0] <= SHOWN:
        return float(np.linalg.eigvalsh(P.toarray())[0]), True
    basis = (direction / np.linalg.norm(direction))[:, None]
    for _ in range(STEPS):
        fresh = P @ basis[:, -1]
        for _ in range(2):
            fresh = fresh - basis @ (basis.T @ fresh)
        length = float(np.linalg.norm(fresh))
        if not length > 0.0:
            break
        basis = np.column_stack([basis, fresh / length])
    return float(np.linalg.eigvalsh(basis.T @ (P @ basis))[0]), False
