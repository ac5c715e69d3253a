"""Convex quadratic forms: a check of each form from outside, before a bound rests on it, and regularisers.

The check does not depend on the units of the variables. A matrix counts as positive semidefinite if a change of its
diagonal by ``ENTRY_ROUNDING`` of itself, for every entry of the longest row, makes it so. Such a change exceeds the
rounding error of ``L L'`` in any scaling (Higham 2002, section 10.1; Demmel 1989): an entry ``(i, j)`` of such a
product is rounded by its share of ``sqrt(P_ii P_jj)``. A factorisation without pivoting that meets only positive pivots
is the proof, except for its own rounding, which is of the same kind (Rump 2006).
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

# Rounding allowed in every entry, relative to sqrt(P_ii P_jj): 13 digits. With a tenth of it, products of long matrices
# are refused; with ten times as much, the error of a lower bound may reach a certified gap of 1e-9, for rows of a
# thousand entries.
ENTRY_ROUNDING = 1e-13
# Rows up to which a matrix is factored as a dense one, whatever its pattern; ten times more costs 1 s
MAX_DENSE_ROWS = 400
FULL = 0.1  # share of non-zero entries from which larger matrices are dense too: sparse factors would fill up
MAX_EIGENVALUE_ROWS = 1000  # rows up to which a refusal computes all eigenvalues; ten times as many take minutes
LANCZOS_STEPS = 60  # steps of the Lanczos method by which a refusal estimates the least eigenvalue of larger matrices

_convex_matrices: WeakValueDictionary[int, csc_array] = WeakValueDictionary()


@dataclass(frozen=True, eq=False)
class ControlImage:
    """Map from a decision ``x (n,)`` to the values ``S x (k,)`` that the cost is about.

    Parameters
    ----------
    S : csc_array, shape (k, n)
        Matrix with channel-major rows: ``channels`` blocks of ``k / channels`` consecutive pieces each.
    channels : int
        Number of channels.
    lengths : ndarray, shape (k,)
        Factor of each entry, the length of its piece in units of time; positive.

    Raises
    ------
    InputError
        Where lengths are not ``k`` positive numbers, or ``k`` is no multiple of ``channels``.
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
    """A strictly convex quadratic ``rho(x) = 1/2 x'P x + q'x``, added to the cost with a weight that decreases to
    zero."""

    @abstractmethod
    def quadratic(self, image: ControlImage) -> tuple[csc_array, Array]:
        """Return the matrix and the vector of ``rho``.

        Parameters
        ----------
        image : ControlImage
            Map from the decision to the values that the cost is about.

        Returns
        -------
        P : csc_array, shape (n, n)
            Symmetric positive definite matrix.
        q : ndarray, shape (n,)
            Linear term.
        """


def require_convex(path: str, matrix: object, size: int) -> csc_array:
    """Return the matrix of the convex quadratic form ``1/2 x'P x`` in ``size`` variables, made read-only.

    A matrix that this function has returned before, or that is convex by construction (`convex_by_construction`), is
    returned at once.

    Parameters
    ----------
    path : str
        Name of the matrix in messages.
    matrix : array_like or sparse, shape (size, size)
        Any matrix of numbers.
    size : int
        Number of variables.

    Returns
    -------
    csc_array, shape (size, size)
        The matrix, exactly symmetric. Where the given matrix is symmetric except for rounding, it is the mean of that
        matrix and its transpose.

    Raises
    ------
    InputError
        For an entry that is not finite, an asymmetric pair of entries, or a negative eigenvalue.
    """
    from scipy.sparse import csc_array

    if isinstance(matrix, csc_array) and _convex_matrices.get(id(matrix)) is matrix:
        return matrix
    P = sparse_matrix(path, matrix)
    if P.shape != (size, size):
        raise InputError(path=path, expected=f"shape ({size}, {size})", got=f"{P.shape}")
    P = P if P.dtype == float else csc_array(P.astype(float))
    P = _symmetrise(path, P)
    if (direction := _find_negative_direction(P)) is not None:
        raise InputError(path=path, expected="a positive semidefinite matrix", got=_describe_eigenvalue(P, direction))
    return convex_by_construction(P)


def convex_by_construction(P: csc_array) -> csc_array:
    """Return a matrix that `require_convex` accepts without a check, made read-only.

    The caller guarantees that the matrix is a sum of squares, and exactly symmetric, whatever its rounding errors.
    """
    kept: csc_array = read_only(P)
    _convex_matrices[id(kept)] = kept
    return kept


def sparse_matrix(path: str, matrix: object) -> csc_array:
    """Return a matrix of finite real numbers in compressed columns, made read-only; raise `InputError` for anything
    else."""
    from scipy.sparse import csc_array

    try:
        array = matrix if isinstance(matrix, csc_array) else csc_array(matrix)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: expected a matrix of numbers, got {matrix!r}") from error
    if array.ndim != 2 or array.dtype.kind not in "fiub":
        raise InputError(path=path, expected="a matrix of numbers", got=f"shape {array.shape} of {array.dtype}")
    indices = np.flatnonzero(~np.isfinite(array.data))
    if indices.size:
        row, column = int(array.indices[indices[0]]), int(np.searchsorted(array.indptr, indices[0], "right")) - 1
        raise InputError(
            path=path,
            expected="a matrix of finite numbers",
            got=f"{array.data[indices[0]]} {_locate_entry(row, column)}",
        )
    kept: csc_array = read_only(array)
    return kept


def is_semidefinite(P: csc_array) -> bool:
    """Return whether a symmetric matrix is positive semidefinite except for rounding.

    The answer is sound, except for the rounding of the factorisation. Each eigenvalue of the matrix with its diagonal
    scaled to 1 is at least ``-(ROUNDED + (k + 1) 2^-53) k``, with ``k`` the number of entries of the longest row of its
    factor.
    """
    return _find_negative_direction(P) is None


def is_definite(P: csc_array, factor: float = 1.0) -> bool:
    """Return whether a symmetric matrix is positive definite once its positive diagonal is multiplied by ``factor``.

    The test is whether elimination without pivoting meets only positive pivots.
    """
    return _find_nonpositive_direction(P, factor) is None


def _find_negative_direction(P: csc_array) -> Array | None:
    """Return a direction ``(n,)`` along which the form is negative; ``None`` where it is semidefinite except for
    rounding."""
    diagonal = np.asarray(P.diagonal(), dtype=float)
    bare = np.flatnonzero(~(diagonal > 0.0))
    if bare.size and (direction := _check_diagonal(P, diagonal, bare)) is not None:
        return direction
    kept = np.flatnonzero(diagonal > 0.0)
    P = P if kept.size == diagonal.size else P[kept][:, kept]
    size = 1.0 / np.sqrt(diagonal[kept])
    shift = 1.0 + ENTRY_ROUNDING * int(np.diff(P.indptr).max(initial=1))
    if (size * (abs(P) @ size) <= 1.0 + shift).all():  # every row is dominated by its diagonal (Gershgorin)
        return None
    kept_direction = _find_nonpositive_direction(P, shift)
    if kept_direction is None:
        return None
    direction = np.zeros(diagonal.size)
    direction[kept] = kept_direction
    return direction


def _check_diagonal(P: csc_array, diagonal: Array, bare: np.ndarray) -> Array | None:
    """Return a direction along which the form is negative, for a matrix whose diagonal is not positive.

    The direction is the unit vector of a negative diagonal entry, or combines a diagonal entry of 0 with a variable
    that is coupled to it. ``None`` where there is neither.
    """
    direction = np.zeros(diagonal.size)
    if diagonal.min() < 0.0:
        direction[int(np.argmin(diagonal))] = 1.0
        return direction
    columns = P[:, bare]
    if not columns.data.any():
        return None
    position = int(np.argmax(np.abs(columns.data)))
    row, column = int(columns.indices[position]), int(bare[np.searchsorted(columns.indptr, position, "right") - 1])
    direction[row], direction[column] = 1.0, -(diagonal[row] + 1.0) / columns.data[position]
    return direction


def _find_nonpositive_direction(P: csc_array, factor: float) -> Array | None:
    """Return a direction ``(n,)`` along which the form with its diagonal times ``factor`` is not positive.

    ``None`` where elimination without pivoting meets only positive pivots.
    """
    n = P.shape[0]
    if n <= MAX_DENSE_ROWS or P.nnz >= FULL * n * n:
        return _find_nonpositive_direction_dense(P, factor)
    from scipy.sparse import csc_array, diags_array
    from scipy.sparse.linalg import splu, spsolve_triangular

    shifted = csc_array(P + (factor - 1.0) * diags_array(P.diagonal()))
    options = {"SymmetricMode": True, "Equil": False}
    try:
        factorisation = splu(shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    except RuntimeError:  # a pivot that is exactly 0
        return np.ones(n)
    pivots = factorisation.U.diagonal()
    if np.array_equal(factorisation.perm_r, factorisation.perm_c) and (pivots > 0.0).all():
        return None
    unit = np.zeros(n)
    unit[int(np.argmax(~(pivots > 0.0)))] = 1.0  # L'v = e gives v'A v = pivot, of A = L D L' up to there
    direction: Array = np.asarray(spsolve_triangular(csc_array(factorisation.L.T), unit, lower=False))[
        factorisation.perm_c
    ]
    return direction


def _find_nonpositive_direction_dense(P: csc_array, factor: float) -> Array | None:
    """Return the direction of `_find_nonpositive_direction`, by a dense Cholesky factorisation."""
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
    k = max(int(order) - 1, 0)  # the leading block of k rows is positive definite, that of k + 1 rows is not
    direction = np.zeros(n)
    direction[k] = 1.0
    direction[:k] = -cho_solve((lower[:k, :k], True), entries[:k, k])
    return direction


def _symmetrise(path: str, P: csc_array) -> csc_array:
    """Return the matrix, made exactly symmetric; raise `InputError` where its asymmetry exceeds rounding."""
    from scipy.sparse import csc_array

    if not P.has_canonical_format:
        P = P.copy()
        P.sum_duplicates()
    transpose = csc_array(P.T)
    transpose.sort_indices()
    if all(np.array_equal(getattr(P, name), getattr(transpose, name)) for name in ("indptr", "indices", "data")):
        return P
    difference = abs(P - transpose).tocoo()
    size = np.sqrt(np.abs(P.diagonal()))
    allowed = ENTRY_ROUNDING * np.maximum(
        size[difference.row] * size[difference.col], np.abs(P[difference.row, difference.col])
    )
    excessive = np.flatnonzero(difference.data > allowed)
    if excessive.size:
        worst = excessive[int(np.argmax(difference.data[excessive]))]
        i, j = int(difference.row[worst]), int(difference.col[worst])
        raise InputError(
            path=path,
            expected="a symmetric matrix",
            got=f"{float(P[i, j]):.12g} {_locate_entry(i, j)} and {float(P[j, i]):.12g} {_locate_entry(j, i)}",
        )
    return csc_array((P + transpose) / 2)


def _locate_entry(row: int, column: int) -> str:
    """Return the position of an entry in words."""
    return f"in row {row + 1}, column {column + 1}"


def _describe_eigenvalue(P: csc_array, direction: Array) -> str:
    """Return in words the least eigenvalue of a matrix whose form is negative along ``direction``.

    Where rounding hides the eigenvalue, that of the matrix with its diagonal scaled to 1 is given.
    """
    from scipy.sparse import csc_array, diags_array

    diagonal = np.asarray(P.diagonal(), dtype=float)
    if P.nnz == np.count_nonzero(diagonal):
        return f"the eigenvalue {diagonal.min():.6g}"
    if not (diagonal > 0.0).all() or _find_least_eigenvalue(P, direction)[0] < -1e-12 * diagonal.max():
        least, exact = _find_least_eigenvalue(P, direction)
        return f"{'the eigenvalue' if exact else 'an eigenvalue of at most'} {min(least, diagonal.min()):.6g}"
    root = np.sqrt(diagonal)
    least, exact = _find_least_eigenvalue(
        csc_array(diags_array(1.0 / root) @ P @ diags_array(1.0 / root)), direction * root
    )
    return f"{'the eigenvalue' if exact else 'an eigenvalue of at most'} {least:.6g} where its diagonal is scaled to 1"


def _find_least_eigenvalue(P: csc_array, direction: Array) -> tuple[float, bool]:
    """Return the least eigenvalue, and whether it is exact.

    For a large matrix, it is the least value of the form on unit vectors of a Krylov space (Lanczos) that starts from
    ``direction``.
    """
    if P.shape[0] <= MAX_EIGENVALUE_ROWS:
        return float(np.linalg.eigvalsh(P.toarray())[0]), True
    basis = (direction / np.linalg.norm(direction))[:, None]
    for _ in range(LANCZOS_STEPS):
        fresh = P @ basis[:, -1]
        for _ in range(2):
            fresh = fresh - basis @ (basis.T @ fresh)
        length = float(np.linalg.norm(fresh))
        if not length > 0.0:
            break
        basis = np.column_stack([basis, fresh / length])
    return float(np.linalg.eigvalsh(basis.T @ (P @ basis))[0]), False
