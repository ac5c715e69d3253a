"""How many of its random instances the second stage takes, so that it ends in the time that it has: a quarter, or the
share that ``SPARSEROB_SHARE`` gives. The daily run takes all (1), a search for faults several times as many."""

from __future__ import annotations

import math
import os

SHARE = float(os.environ.get("SPARSEROB_SHARE", "0.25"))


def taken(count: int) -> int:
    """How many of ``count`` random instances are taken, at least one; the first ones, so that they are the same ones in
    every run."""
    return max(1, math.ceil(count * SHARE))
