"""The keys of the problem ``program``, a convex semi-infinite program as text, as a config writes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, TypeAlias, final

from pydantic import Field

from sparserob_core.control.problem.problem import ProblemFactory
from sparserob_core.errors import InputError
from sparserob_core.experiment.config.matrices.packed import OrPacked
from sparserob_core.experiment.config.option_kinds import OneOrMore
from sparserob_core.experiment.config.problems import Parameters, ParameterSetOptions
from sparserob_core.options import Options
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.stated.statement import StatedDecision, StatedFamily, StatedProgram

Bound: TypeAlias = OneOrMore | None
Table: TypeAlias = Annotated[list[float] | list[list[float]], OrPacked(line=True)]


@final
class DecisionOptions(Options):
    """Entries of the decision with one name."""

    size: int | None = Field(default=None, ge=1)
    """Number of entries, which texts name ``a[0]``, ``a[1]``, ...; null: a single number without brackets."""

    lower: Bound = None
    """Lower bound of every entry, or one number for each; none unless given."""

    upper: Bound = None
    """Upper bound of every entry, or one number for each; none unless given."""

    def stated(self) -> StatedDecision:
        """Return the entries as the core states them."""
        bounds = {name: value for name in ("lower", "upper") if (value := getattr(self, name)) is not None}
        return StatedDecision(self.size, **bounds)


@final
class FamilyOptions(Options):
    """Rows that hold for every index."""

    name: str = Field(min_length=1)
    """Name of the family, in tables and messages."""

    index: Parameters | Annotated[list[Parameters], Field(min_length=1)]
    """Interval ``[lower, upper]`` of every coordinate of the index, by name; or names and a polytope, as ``{names:
    [x, y], polytope: {H: ..., h: ...}}``; or a list of such sets, in each of which the rows hold."""

    rows: Annotated[list[str], Field(min_length=1)]
    """Rows such as ``sum(a[k]*cos(k*w) for k in range(9)) <= d``: affine in the decision, arithmetic in the index."""

    def stated(self) -> StatedFamily:
        """Return the family as the core states it."""
        is_union = isinstance(self.index, list)
        parts = self.index if isinstance(self.index, list) else [self.index]
        keys = [f"index.{i}" if is_union else "index" for i in range(len(parts))]
        sets = [_state_index_set(part, key) for part, key in zip(parts, keys, strict=True)]
        return StatedFamily(self.name, sets if is_union else sets[0], self.rows)


def _state_index_set(index: Parameters, key: str) -> Mapping[str, Any]:
    """Return an index set as the core states it; raise `InputError` that begins with the key at fault."""
    if isinstance(index, ParameterSetOptions):
        return {"names": index.names, "polytope": index.build(key, len(index.names))}
    return index


@final
class ProgramProblem(ProblemFactory, Options):
    """The least value of a convex objective under rows that hold for every index of a set, all of it stated as text."""

    decision: Annotated[dict[str, DecisionOptions], Field(min_length=1)]
    """Entries that are chosen, by name, in order."""

    minimise: str | float
    """Objective: a sum of affine terms, of squares and products of affine terms, and of absolute values; convex. It
    knows the names of the decision and the tables, and sums: ``sum(abs(a[k]) for k in range(9))``."""

    rows: list[str] = Field(default_factory=list)
    """Rows without an index, with ``<=``, ``>=`` or ``==``."""

    families: list[FamilyOptions] = Field(default_factory=list)
    """Rows that hold for every index."""

    tables: dict[str, Table] = Field(default_factory=dict)
    """Lists of numbers, or matrices, whose entries the texts may name: ``c[k]``, ``F[i, k]``; or a file relative to the
    config, ``{file: prices.csv}``, in which one row or one column is a list."""

    def build(self) -> SemiInfiniteProgram:
        """Return the program; raises `InputError` that begins with the key at fault."""
        return self.stated().build()

    def stated(self) -> StatedProgram:
        """Return the program as text."""
        return StatedProgram(
            {name: entry.stated() for name, entry in self.decision.items()},
            str(self.minimise),
            self._state_families(),
            self.rows,
            self.tables,
        )

    def _state_families(self) -> list[StatedFamily]:
        families = []
        for i, entry in enumerate(self.families):
            try:
                families.append(entry.stated())
            except InputError as error:
                raise error.under("families", i) from None
        return families
