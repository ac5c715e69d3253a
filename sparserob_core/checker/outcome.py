"""The outcome of a check: one verdict per claim, the tolerances of a comparison, and the time limit."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from time import perf_counter
from typing import Literal, TypeAlias, TypeVar, final

TOLERANCE = 1e-9  # relative to a constraint's own unit: a violation of at most this counts as none
EQUALITY = 1e-12  # relative to the terms of an equality: the largest residual that double precision may leave
# How closely a written figure must agree with the derived one. The difference is relative to the figure, or, where that
# is larger, to 1; for a cost, to a share of its terms in place of 1.
FIGURES = 1e-11
# A share of the terms of a cost. Where terms cancel, a cost must agree to `FIGURES` times this share of its terms: to
# 1e-14 of the terms, some forty rounding errors. A value ten times smaller would refuse honest costs of 0, because
# their terms were rounded. Whether a gap is closed is judged by the larger of the derived and the written cost.
CANCELLED = 1e-3
RESOLVED = 2.0**-18  # relative to the terms of a sum: the least unit; TOLERANCE of it is 17 units of rounding
# Relative to the terms of a sum: a thinner set is a point to any solver that computes in doubles. The checker judges
# it as a point, with the tolerance of a point. A run's own threshold is an eighth of this, since sums differ a little.
THIN = 2.0**-34

LOOKED = 1024  # items between two looks at the clock, some ms; ten times more may stop late, a tenth costs time itself

Item = TypeVar("Item")
Verdict: TypeAlias = Literal["holds", "fails", "not checked"]


class Unchecked(Exception):
    """The exception for a claim that the checker has no means to judge; its sentence says why. It never leaves the
    checker."""


class Broken(Exception):
    """The exception for a claim that is wrong, or for a certificate without the entries that it must have.

    Its sentence says why. It never leaves the checker.
    """


@final
@dataclass(frozen=True)
class Finding:
    """The result for one claim of a run: the ``name`` of the claim, the ``verdict``, and a sentence with the
    figures."""

    name: str
    verdict: Verdict
    text: str


@final
@dataclass(frozen=True)
class Clock:
    """The time limit of a check, ``seconds`` after the clock was made. A claim that is undecided by then is
    `Unchecked`."""

    seconds: float = math.inf
    started: float = field(default_factory=perf_counter)

    def check(self) -> None:
        """Raise `Unchecked` when the time is up."""
        if perf_counter() - self.started > self.seconds:
            raise Unchecked(f"the time limit of {self.seconds:g} s was reached")

    def each(self, items: Iterable[Item]) -> Iterator[Item]:
        """Yield the items one by one, and check the time after every `LOOKED` of them; fewer items cost no time."""
        for number, item in enumerate(items):
            if number and number % LOOKED == 0:
                self.check()
            yield item


NO_LIMIT = Clock()
