"""The tests of which one set of parameters takes long, by measurement: the second stage begins with those that the
first one leaves out, and ends with the longest. Where its time is over few tests are left out then.

::

    python -m pytest -n 2 -m "(long or not slow) and not benchmark" --durations=0 --durations-min=0 > table
    python -m tests.stages long < table
    python -m pytest -n 2 -m "slow and not long" --durations=0 --durations-min=0 > table
    python -m tests.stages longest < table

writes their names anew into ``tests/long.txt`` and ``tests/longest.txt``, from the tables of durations that pytest
prints.
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

LIMITS = {"long": 0.15, "longest": 10.0}
"""Seconds of a set of parameters, in the mean. With ten times as many for ``long`` the first stage takes four times as
long; with a tenth it is left with half of the tests. The ``longest`` tests are one in thirty of the second stage, and
take most of its time."""
DURATION = re.compile(r"\s*([\d.]+)s call\s+(tests/\S+?::[\w:]+)")


def find_file(kind: str) -> Path:
    """Return the file of the names of one of the kinds of `LIMITS`."""
    return Path(__file__).parent / f"{kind}.txt"


def read_names(kind: str) -> frozenset[str]:
    """Return the names of the tests of a kind, such as ``tests/test_file.py::test_name``."""
    return frozenset(find_file(kind).read_text(encoding="utf-8").split())


def choose(kind: str, lines: Iterable[str]) -> list[str]:
    """Return the names of the tests of a kind, from the lines of a table of durations."""
    seconds = defaultdict[str, list[float]](list)
    for line in lines:
        if found := DURATION.match(line):
            seconds[found[2]].append(float(found[1]))
    return sorted(name for name, values in seconds.items() if sum(values) >= LIMITS[kind] * len(values))


if __name__ == "__main__":
    (chosen,) = sys.argv[1:]
    names = choose(chosen, sys.stdin)
    if not names:
        sys.exit("no durations were read; pytest prints them with --durations=0")
    find_file(chosen).write_text("\n".join(names) + "\n", encoding="utf-8")
    print(f"{len(names)} tests take {LIMITS[chosen]:g} s and more")
