"""What the checker says: one verdict per claim."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias, final

VIOLATION = 1e-9  # a constraint that is exceeded by at most this counts as kept

Verdict: TypeAlias = Literal["holds", "fails", "not checked"]


class Unchecked(Exception):
    """A claim that the checker has no means to judge; the sentence says why. Never leaves the checker."""


class Broken(Exception):
    """A claim that is wrong, or a certificate that does not say what it must; the sentence says why. Never leaves the
    checker."""


@final
@dataclass(frozen=True)
class Claim:
    """One claim of a run: its ``name``, the ``verdict`` and a sentence with the figures."""

    name: str
    verdict: Verdict
    text: str
