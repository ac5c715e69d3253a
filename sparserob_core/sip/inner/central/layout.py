"""Uncertain rows taken apart: absolute values of blocks of variables, which few rows join.

A variable that answers the deviations enters few of their entries. Variables and entries that hang together are one
*block*. An absolute value ``|a_j|`` is of one entry and hence of one block; rows add absolute values up, together with
variables that answer nothing (*joint* variables).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import final

import numpy as np
from scipy.sparse import coo_array, csr_array, vstack

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram, Spread, UncertainRows

ALIKE = 1.2  # times the parts of a block that its group may have
WORTH = 3500  # answering variables from which this method is used; the simplex method is as fast up to 10 000
LARGEST = 600  # variables of one block at most: beyond, a factorisation of it is no gain


@final
@dataclass(eq=False)
class Block:
    """The answering variables ``first`` to ``last``; the absolute values in which one of them is (``single``, by
    number) and those in which several are: numbers ``at (k,)`` and coefficients ``A (k, n)``. Of the single ones the
    variable ``of``, counted from ``first``, and its ``value``. Where the parts of both kinds are among those of the
    group: ``columns`` and ``mixed``; ``once``: no two of ``columns`` and no two of ``mixed`` are the same; ``alone
    (n,)``: the variables of one single absolute value at most."""

    first: int
    last: int
    single: np.ndarray
    at: np.ndarray
    A: Array
    of: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    value: Array = field(default_factory=lambda: np.zeros(0))
    columns: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    mixed: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    once: bool = True
    alone: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))


@final
@dataclass(frozen=True, eq=False)
class Group:
    """Blocks with about the same ``parts (p,)``."""

    blocks: tuple[Block, ...]
    parts: np.ndarray


@final
class Layout:
    """The rows that were added, taken apart.

    Absolute values ``j`` have ``entry``, ``part``, ``radius`` and ``offset (J,)``. They are those of
    ``a = C f + offset`` of the answering variables ``f``, whose numbers are ``answering``. ``single``: those in which a
    variable stands alone; ``squares (n, J)``: the squares of the entries of ``C`` there. Rows have coefficients
    ``g (r, z)`` of the joint variables, whose numbers are ``joint``; their part ``of (r,)``, its weight ``scale (r,)``,
    and limits ``h (r,)``. ``rest (r,)`` is the worst case of entries that no variable enters, and ``at_rest (p, Q)``
    are the deviations of these entries in it.
    """

    def __init__(self, program: FiniteProgram, spread: Spread) -> None:
        self.program, self.spread = program, spread
        self.parts = 0
        self.taken = 0  # absolute values that stand in `blocks`
        self._part_numbers: dict[bytes, int] = {}
        self._constants: list[float] = []
        self._constant_deviations: list[Array] = []
        self._values: list[tuple[np.ndarray, np.ndarray, np.ndarray, Array]] = []
        self._entries: list[tuple[np.ndarray, np.ndarray, Array]] = []
        self._rows: list[tuple[csr_array, np.ndarray, Array, Array]] = []
        self.count = 0
        self.label: np.ndarray | None = None
        self.blocks: list[Block] = []

    def add(self, block: UncertainRows) -> None:
        """Take rows apart."""
        names = np.array([self._add_part(C, d) for C, d in zip(block.C, block.d, strict=True)], dtype=int)
        self._rows.append((block.g, names[block.part], np.abs(block.factor), block.h))

    def _add_part(self, C: csr_array, d: Array) -> int:
        key = _hash_arrays(C.indptr, C.indices, C.data, d)
        if key in self._part_numbers:
            return self._part_numbers[key]
        radii, counts = self.spread.radii, np.diff(C.indptr)
        self._constants.append(float(radii[counts == 0] @ np.abs(d[counts == 0])))
        self._constant_deviations.append(np.where(counts == 0, np.sign(d) * radii, 0.0))
        entries = np.flatnonzero((counts > 0) & (radii > 0.0))
        number = np.full(self.spread.size, -1)
        number[entries] = self.count + np.arange(entries.size)
        row = np.repeat(number, counts)
        self._values.append((entries, np.full(entries.size, self.parts), d[entries], radii[entries]))
        self._entries.append((row[row >= 0], C.indices[row >= 0], C.data[row >= 0]))
        self.count += entries.size
        self._part_numbers[key] = self.parts
        self.parts += 1
        return self.parts - 1

    def arrange(self) -> bool:
        """Bring what was added to its place; whether all that was there has kept its own."""
        self.entry, self.part, self.offset, self.radius = (
            np.concatenate(arrays) for arrays in zip(*self._values, strict=True)
        )
        row, variable, value = (np.concatenate(arrays) for arrays in zip(*self._entries, strict=True))
        kept = self.label is not None and self._has_same_blocks(row, variable)
        if not kept:
            self._partition(row, variable)
        self.C = csr_array((value, (row, self._positions[variable])), shape=(self.count, self.answering.size))
        self._extend_blocks()
        self.single = np.flatnonzero(np.diff(self.C.indptr) == 1)
        alone = np.concatenate([block.single for block in self.blocks])
        at = self.C.indptr[alone]
        entries = (self.C.data[at] ** 2, (self.C.indices[at], alone))
        self.squares = csr_array(entries, shape=(self.answering.size, self.count))
        self.of, self.scale, self.h = (
            np.concatenate(arrays) for arrays in ([rows[i] for rows in self._rows] for i in (1, 2, 3))
        )
        self.g = csr_array(vstack([rows[0] for rows in self._rows]).tocsc()[:, self.joint])
        self.rest = self.scale * np.array(self._constants)[self.of]
        self.at_rest = np.array(self._constant_deviations)
        return kept

    def _has_same_blocks(self, row: np.ndarray, variable: np.ndarray) -> bool:
        assert self.label is not None
        is_new = row >= self.taken
        Q = self.spread.size
        return bool((self.label[Q + variable[is_new]] == self.label[self.entry[row[is_new]]]).all()) and bool(
            (self._positions[variable[is_new]] >= 0).all()
        )

    def _partition(self, row: np.ndarray, variable: np.ndarray) -> None:
        from scipy.sparse.csgraph import connected_components

        Q, n = self.spread.size, self.program.n
        graph = coo_array((np.ones(row.size), (self.entry[row], Q + variable)), shape=(Q + n, Q + n))
        _, self.label = connected_components(graph, directed=False)
        answers = np.zeros(n, dtype=bool)
        answers[variable] = True
        self.joint, answering = np.flatnonzero(~answers), np.flatnonzero(answers)
        self.answering = answering[np.argsort(self.label[Q + answering], kind="stable")]
        self._positions = np.full(n, -1)
        self._positions[self.answering] = np.arange(self.answering.size)
        _, starts, self._block_numbers = np.unique(
            self.label[Q + self.answering], return_index=True, return_inverse=True
        )
        self.starts = np.concatenate([starts, [self.answering.size]])
        self.taken, self.blocks = 0, []

    def _extend_blocks(self) -> None:
        """Append the new absolute values of every block to its earlier ones, and form the groups anew."""
        fresh = np.arange(self.taken, self.count)
        fresh = fresh[np.diff(self.C.indptr)[self.taken :] > 0]
        is_single = np.diff(self.C.indptr)[fresh] == 1
        number = self._block_numbers[self.C.indices[self.C.indptr[fresh]]]
        order = np.argsort(number, kind="stable")
        cuts = np.searchsorted(number[order], np.arange(self.starts.size))
        for b in range(self.starts.size - 1):
            first, last = int(self.starts[b]), int(self.starts[b + 1])
            positions = order[cuts[b] : cuts[b + 1]]
            single, at = fresh[positions[is_single[positions]]], fresh[positions[~is_single[positions]]]
            A = np.zeros((at.size, last - first))
            for i, j in enumerate(at.tolist()):
                entries = slice(self.C.indptr[j], self.C.indptr[j + 1])
                A[i, self.C.indices[entries] - first] = self.C.data[entries]
            if b == len(self.blocks):
                self.blocks.append(Block(first, last, single, at, A))
            else:
                block = self.blocks[b]
                block.single, block.at = np.concatenate([block.single, single]), np.concatenate([block.at, at])
                block.A = np.vstack([block.A, A])
        self.taken = self.count
        self._group_blocks()

    def _group_blocks(self) -> None:
        """Put blocks together, one after the other, as long as they have most parts in common."""
        self.groups: list[Group] = []
        open_, union = list[Block](), np.zeros(0, dtype=int)
        for block in self.blocks:
            parts = np.unique(self.part[np.concatenate([block.single, block.at])])
            merged = np.union1d(union, parts)
            if open_ and merged.size > ALIKE * min(union.size, parts.size) + 4:
                self._close_group(open_, union)
                open_, merged = [], parts
            open_, union = [*open_, block], merged
        self._close_group(open_, union)

    def _close_group(self, blocks: list[Block], parts: np.ndarray) -> None:
        for block in blocks:
            places = self.C.indptr[block.single]
            block.of, block.value = self.C.indices[places] - block.first, self.C.data[places]
            block.columns = np.searchsorted(parts, self.part[block.single])
            block.mixed = np.searchsorted(parts, self.part[block.at])
            block.once = all(np.unique(numbers).size == numbers.size for numbers in (block.columns, block.mixed))
            block.alone = np.bincount(block.of, minlength=block.last - block.first) <= 1
        self.groups.append(Group(tuple(blocks), parts))

    def fits(self) -> bool:
        """Return whether the interior point method suits the program: many answering variables, and small blocks of
        them.

        The program must have no equalities, matrix of the cost, image, plain rows or fixed variables, and no costs or
        plain coefficients of answering variables. The rows are arranged for the answer.
        """
        program = self.program
        if not self.count or program.n < WORTH or program.b.size or program.P is not None or program.S is not None:
            return False
        if program.G.shape[0] or not (program.lower < program.upper).all():
            return False
        self.arrange()
        answering = self.answering
        plain = not program.weights[answering].any() and not program.q[answering].any()
        plain = plain and not any(rows[0].tocsc()[:, answering].nnz for rows in self._rows)
        return plain and answering.size >= WORTH and int(np.diff(self.starts).max()) <= LARGEST


def _hash_arrays(*arrays: np.ndarray) -> bytes:
    """Return a short name of arrays, the same for equal ones."""
    hasher = hashlib.blake2b(digest_size=16)
    for array in arrays:
        hasher.update(array.size.to_bytes(8, "little"))
        hasher.update(np.ascontiguousarray(array).data)
    return hasher.digest()
