"""Rows of a constraint family that are stated by expressions: their values, and proven bounds over cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import final

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.shapes import Array, Float, shaped
from sparserob_core.sip.expressions.cell_models import CellModels, bound_polynomials
from sparserob_core.sip.expressions.forms import Numbers, Value
from sparserob_core.sip.expressions.index_sets import Piece, Region
from sparserob_core.sip.expressions.statements import Decisions, StatedRow, Tables, Words, parse_rows
from sparserob_core.sip.expressions.taylor import TaylorSpace, taylor_space

DEGREES = {1: 10, 2: 6, 3: 4, 4: 3}
"""Degree of the polynomials on a cell for so many coordinates of an index; 2 for more. With half of it ten times as
many cells are needed; with twice as much a cell takes four times as long, and rounds more."""
MAX_NUMBERS = 4_000_000  # in an array of products: 32 MB; of ten times as many nothing is faster


@final
@dataclass(frozen=True, eq=False)
class ExpressionRows:
    """Rows of a family as expressions in the coordinates of its index.

    Parameters
    ----------
    words : Words
        The names.
    rows : tuple of StatedRow
        The rows, each ``form(index) <= 0``.
    piece : Piece
        The index set, or a part of it. An index is given by its coordinates in the box of the piece.
    """

    words: Words
    rows: tuple[StatedRow, ...]
    piece: Piece

    @staticmethod
    def parse(
        index: Mapping[str, Sequence[float]],
        rows: Sequence[str] | str,
        decision: Decisions,
        tables: Tables,
    ) -> ExpressionRows:
        """Return the rows that texts state for every index of a box; raise `InputError`, with its key, for a text that
        is no such statement."""
        return ExpressionRows.parse_all([Region.of_intervals(index)], rows, decision, tables)[0]

    @staticmethod
    def parse_all(
        regions: Sequence[Region], rows: Sequence[str] | str, decision: Decisions, tables: Tables
    ) -> list[ExpressionRows]:
        """Return the rows that texts state, for every piece of index sets with the same coordinates; raise
        `InputError`, with its key, for a text that is no such statement."""
        words = Words(decision, regions[0].names, tables)
        texts: object = [rows] if isinstance(rows, str) else rows
        if not isinstance(texts, Sequence) or not texts or not all(isinstance(text, str) for text in texts):
            raise InputError(path="rows", expected="at least one row, as text", got=repr(rows))
        parsed = tuple(row for text in texts for row in parse_rows(text, words))
        parts = [ExpressionRows(words, parsed, piece) for region in regions for piece in region.pieces]
        for part in parts:
            part.evaluate(
                (part.lower + (part.upper - part.lower) / 2)[None]
            )  # what cannot be evaluated is told at once
        return parts

    @property
    def lower(self) -> Array:
        """Lower corner of the box of the piece."""
        return self.piece.lower

    @property
    def upper(self) -> Array:
        """Upper corner of the box of the piece."""
        return self.piece.upper

    @property
    def dimension(self) -> int:
        """Number of coordinates of an index."""
        return int(self.lower.size)

    @shaped
    def evaluate(self, indices: Float[Array, "k d"]) -> tuple[Float[Array, "k r n"], Float[Array, "k r"]]:
        """Return rows ``G`` and right-hand sides ``h`` of ``G x <= h`` at indices."""
        values = self.piece.place_columns(indices)
        G = np.zeros((len(indices), len(self.rows), self.words.decisions.n))
        h = np.zeros((len(indices), len(self.rows)))
        parts: dict[str, Value] = {}
        for i, row in enumerate(self.rows):
            form = row.form(values, parts=parts)
            h[:, i] = -form.constant[:, 0]
            np.add.at(G[:, i].T, form.position, np.broadcast_to(form.coefficient, (len(indices), form.position.size)).T)
            self._require_values(row, indices, np.isfinite(G[:, i]).all(axis=1) & np.isfinite(h[:, i]))
        return G, h

    def _require_values(self, row: StatedRow, indices: Array, has_value: np.ndarray) -> None:
        """Raise `InputError` where a row has no finite value at an index."""
        if not has_value.all():
            at = self.piece.describe(indices[int(np.argmin(has_value))])
            raise InputError(f"row {row.text!r}: it has no finite value at {at}")

    @shaped
    def enclose(
        self, x: Float[Array, " n"], lower: Float[Array, "k d"], upper: Float[Array, "k d"]
    ) -> tuple[Float[Array, " k"], Numbers]:
        """Return proven upper bounds ``(k,)`` of the violation over cells, and the coordinates ``(k,)`` to halve.

        A bound of 0 or less is as sharp as it needs to be.
        """
        space = taylor_space(self.dimension, DEGREES.get(self.dimension, 2))
        bounds, split = np.full(len(lower), -np.inf), (upper - lower).argmax(axis=1)
        size = max(1, MAX_NUMBERS // (space.products[0].size * (x.size + 1)))
        for start in range(0, len(lower), size):
            part = slice(start, start + size)
            low, high = lower[part], upper[part]
            coefficients, errors = self._build_models(space, x, low, high)
            polynomials, remainders = coefficients.reshape(-1, space.size), errors.ravel()
            over, steepest = bound_polynomials(space, polynomials, remainders, 0.0)
            over, steepest = over.reshape(-1, len(low)), steepest.reshape(-1, len(low))
            worst, cells = over.argmax(axis=0), np.arange(len(low))
            axis = steepest[worst, cells]
            bounds[part] = over[worst, cells]
            split[part] = np.where((high - low)[cells, axis] > 0.0, axis, split[part])
        return bounds, split

    @shaped
    def violations(self, x: Float[Array, " n"], indices: Float[Array, "k d"]) -> Float[Array, "k r"]:
        """Return the violations of the rows at a decision and at indices."""
        values = self.piece.place_columns(indices)
        parts: dict[str, Value] = {}
        columns = [np.broadcast_to(row.value(values, x[None], parts), (len(indices), 1)) for row in self.rows]
        for row, column in zip(self.rows, columns, strict=True):
            self._require_values(row, indices, np.isfinite(column[:, 0]))
        return np.concatenate(columns, axis=1)

    @shaped
    def roundings(self, reach: Float[Array, " n"], indices: Float[Array, "k d"]) -> Float[Array, "k r"]:
        """Return bounds of the rounding errors of the rows ``G x <= h`` that `evaluate` gives at indices, for every
        decision with ``|x| <= reach``.

        Where the terms of a coefficient cancel, its error is no share of what is left of them.
        """
        G, h = self.evaluate(indices)
        space = taylor_space(self.dimension, 1)
        variables, parts = self._variables(space, indices, indices), dict[str, Value]()
        bounds = np.empty(h.shape)
        for i, row in enumerate(self.rows):
            form = row.form(variables, parts=parts)
            constant, coefficient = (self._as_models(part, space) for part in (form.constant, form.coefficient))
            exact, errors = np.zeros((2, *G[:, i].shape))
            np.add.at(exact.T, form.position, coefficient.coefficients[..., 0].T)
            np.add.at(errors.T, form.position, coefficient.remainder.T)
            bounds[:, i] = np.abs(constant.coefficients[:, 0, 0] + h[:, i]) + constant.remainder[:, 0]
            bounds[:, i] += (np.abs(exact - G[:, i]) + errors) @ reach
        return np.where(np.isfinite(bounds), bounds, np.inf)  # a model may have no value where the row has one

    def _build_models(self, space: TaylorSpace, x: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Return the polynomials ``(r, k, M)`` of the violations of the rows on cells, and their remainders
        ``(r, k)``."""
        variables, decision = self._variables(space, lower, upper), CellModels.constant(space, x[None])
        parts: dict[str, Value] = {}
        models = [self._as_models(row.value(variables, decision, parts), space) for row in self.rows]
        coefficients = [np.broadcast_to(model.coefficients[:, 0], (len(lower), space.size)) for model in models]
        remainders = [np.broadcast_to(model.remainder[:, 0], len(lower)) for model in models]
        return np.stack(coefficients), np.stack(remainders)

    def _as_models(self, value: object, space: TaylorSpace) -> CellModels:
        return value if isinstance(value, CellModels) else CellModels.constant(space, np.asarray(value, dtype=float))

    def _variables(self, space: TaylorSpace, lower: Array, upper: Array) -> Mapping[str, CellModels]:
        return self.piece.place(CellModels.variables(space, lower, upper), partial(CellModels.of_fraction, space))
