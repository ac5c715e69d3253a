"""Compare what it costs to check the archived runs with what it cost the version that made them.

``python -m tests.archive [MEMORY=1]``

Prints seconds of the processor then and now, the largest ratios first, their sums and ratio; the peak of the memory
too, with a process for each run (``MEMORY=1``). The checker is to need 1.5 times as long in sum at most, and 4 times
for any single run. Seconds of two machines do not compare: measure the old version here as well where it matters
(`build.py` with the directories unpacked).
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.archive.build import timed
from tests.archive.store import HERE, VERDICTS, unpack

SUM, EACH = 1.5, 4.0  # of the seconds then: limits of the sum, and of each run
SHORT = 0.1  # seconds: what took less counts as long; beside other work a check of 0.04 s takes 0.2 s now and then


def main(memory: bool) -> int:
    """Print the table; 1 where a limit is exceeded."""
    with tempfile.TemporaryDirectory() as place:
        directories = {name: unpack(name, Path(place)) for name in VERDICTS}
        now = timed(directories)
        peaks = {name: _peak(path) for name, path in directories.items()} if memory else {}
    then = {name: float(one["seconds"]) for name, one in VERDICTS.items()}
    ratios = {name: now[name] / max(then[name], SHORT) for name in VERDICTS}
    for name in sorted(ratios, key=lambda one: -ratios[one]):
        grown = f"{VERDICTS[name]['peak']:6d} {peaks[name]:6d} MB" if memory else ""
        print(f"{name:55s} {then[name]:8.2f} {now[name]:8.2f} s {ratios[name]:6.2f} {grown}")
    sums, worst = (sum(then.values()), sum(now.values())), max(ratios.values())
    share = sums[1] / sums[0]
    print(f"{len(now)} runs: {sums[0]:.1f} s then, {sums[1]:.1f} s now: {share:.2f} times, the worst {worst:.2f} times")
    return int(sums[1] > SUM * sums[0] or worst > EACH)


def _peak(directory: Path) -> int:
    """The most memory that a process takes which checks one run, in MB."""
    command = [sys.executable, str(HERE / "build.py"), "--check", str(directory)]
    return int(json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)["peak"])


if __name__ == "__main__":
    sys.exit(main("MEMORY=1" in sys.argv))
