"""The tests of which one set of parameters takes long, by measurement: the second stage begins with them.

::

    python -m pytest -n 2 -m "(long or not slow) and not benchmark" --durations=0 --durations-min=0 > table
    python -m tests.stages < table

writes their names anew into ``tests/long.txt``, from the table of durations that pytest prints.
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

NAMES = Path(__file__).parent / "long.txt"
LIMIT = 0.15
"""Seconds of a set of parameters, in the mean. With ten times as many the first stage takes four times as long; with a
tenth it is left with half of the tests."""
DURATION = re.compile(r"\s*([\d.]+)s call\s+(tests/\S+?::[\w:]+)")


def read_names() -> frozenset[str]:
    """Return the names of the tests that take long, such as ``tests/test_file.py::test_name``."""
    return frozenset(NAMES.read_text(encoding="utf-8").split())


def choose(lines: Iterable[str]) -> list[str]:
    """Return the names of the tests that take long, from the lines of a table of durations."""
    seconds = defaultdict[str, list[float]](list)
    for line in lines:
        if found := DURATION.match(line):
            seconds[found[2]].append(float(found[1]))
    return sorted(name for name, values in seconds.items() if sum(values) >= LIMIT * len(values))


if __name__ == "__main__":
    names = choose(sys.stdin)
    if not names:
        sys.exit("no durations were read; pytest prints them with --durations=0")
    NAMES.write_text("\n".join(names) + "\n", encoding="utf-8")
    print(f"{len(names)} tests take long")
