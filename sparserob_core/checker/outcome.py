"""What the checker says: one verdict per claim."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from time import perf_counter
from typing import Literal, TypeAlias, TypeVar, final

TOLERANCE = 1e-9  # of a constraint's own unit: a violation of at most this counts as none
EQUALITY = 1e-12  # of the numbers that are added up: what double precision leaves of an equality, at most
FIGURES = 1e-11  # relative to the larger of it and 1: how closely a written figure must agree with the one derived
# Of what is added up to a cost: so much must agree to `FIGURES` where terms cancel, that is, to 1e-14 of the terms,
# some forty roundings. Ten times smaller, and honest costs of 0 are refused, whose terms were rounded. Whether a gap is
# closed is judged by the cost that is derived, where that is the larger one.
CANCELLED = 1e-3
RESOLVED = 2.0**-18  # of the numbers that are added up, the least unit: TOLERANCE of it is 17 units of rounding
# Of the numbers that are added up: a set that is thinner is a point to any solver that computes in doubles, and is
# judged as one, by what is excused of a point. A run's own number is an eighth of it, since sums differ a little.
THIN = 2.0**-34

LOOKED = 1024  # items between two looks at the time: some ms; ten times as many may be late, a tenth costs time itself

Item = TypeVar("Item")
Verdict: TypeAlias = Literal["holds", "fails", "not checked"]


class Unchecked(Exception):
    """A claim that the checker has no means to judge; the sentence says why. Never leaves the checker."""


class Broken(Exception):
    """A claim that is wrong, or a certificate that does not say what it must; the sentence says why. Never leaves the
    checker."""


@final
@dataclass(frozen=True)
class Finding:
    """What was found about one claim of a run: its ``name``, the ``verdict`` and a sentence with the figures."""

    name: str
    verdict: Verdict
    text: str


@final
@dataclass(frozen=True)
class Clock:
    """When to stop: ``seconds`` after it was made. What is not decided by then is `Unchecked`."""

    seconds: float = math.inf
    started: float = field(default_factory=perf_counter)

    def check(self) -> None:
        """Raise `Unchecked` when the time is up."""
        if perf_counter() - self.started > self.seconds:
            raise Unchecked(f"the time limit of {self.seconds:g} s was reached")

    def each(self, items: Iterable[Item]) -> Iterator[Item]:
        """The items one by one, with a look at the time after every `LOOKED` of them: fewer take no time."""
        for number, item in enumerate(items):
            if number and number % LOOKED == 0:
                self.check()
            yield item


NO_LIMIT = Clock()
