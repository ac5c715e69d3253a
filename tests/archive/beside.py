"""Run the archived configs anew with two versions of the package, one beside the other.

``python -m tests.archive.beside TREE [NAME ...]``

``TREE`` is a checkout of the other version. Every config of the archive is run by both, one after the other, each in a
process of its own that stays, with one thread. A name stands for all runs whose names contain it. Printed is each run
whose status, cost or bounds differ, with both; then those that take longest, and the sums of the seconds of the
processor and their ratio. Ends with 1 where a status differs, or a bound by more than the gap that the run was to
close.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, TextIO

HERE = Path(__file__).parent
SHOWN = ("status", "cost", "lower_bound", "upper_bound")
TOLERANCE = 2e-7  # of the cost: two bounds of one value are apart by the gap that closes, 1e-7 unless a config says so
SHORT = 0.1  # seconds: what takes less counts as long
LONGEST = 12  # runs that are listed with their seconds


def main(tree: Path, parts: list[str]) -> int:
    """Print the table; 1 where the two versions tell different things."""
    from tests.archive.store import archived, unpack

    names = [name for name in archived() if not parts or any(part in name for part in parts)]
    versions = [_Version(tree.resolve()), _Version(HERE.parents[1])]
    table: dict[str, list[dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as place:
        for name in names:
            config = unpack(name, Path(place)) / "config.yaml"
            command = "bound" if name.startswith("bound-") else "run"
            table[name] = [version.run(command, config, Path(place) / f"{i}") for i, version in enumerate(versions)]
            then, now = table[name]
            if [then[key] for key in SHOWN] != [now[key] for key in SHOWN]:
                print(f"{name:52s} {_difference(then, now)}", flush=True)
    for version in versions:
        version.close()
    ratios = {name: _ratio(*both) for name, both in table.items()}
    for name in sorted(ratios, key=lambda one: -ratios[one])[:LONGEST]:
        then, now = table[name]
        print(f"{name:52s} {then['seconds']:8.2f} s then {now['seconds']:8.2f} s now {ratios[name]:6.2f} times")
    sums = [sum(both[i]["seconds"] for both in table.values()) for i in range(2)]
    print(f"{len(table)} runs: {sums[0]:.1f} s then, {sums[1]:.1f} s now, {sums[1] / sums[0]:.3f} times")
    print("memory: " + " then, ".join(f"{version.peak} MB" for version in versions) + " now")
    return int(any(_apart(*both) for both in table.values()))


def _difference(then: dict[str, Any], now: dict[str, Any]) -> str:
    keys = [key for key in SHOWN if then[key] != now[key]]
    return "; ".join(f"{key} {then[key]!r} then, {now[key]!r} now" for key in keys)


def _apart(then: dict[str, Any], now: dict[str, Any]) -> bool:
    if then["status"] != now["status"]:
        return True
    both = [(then[key], now[key]) for key in SHOWN[2:]]
    numbers = [(float(a), float(b)) for a, b in both if a is not None and b is not None]
    return any((a is None) != (b is None) for a, b in both) or any(
        abs(a - b) > TOLERANCE * max(abs(a), abs(b)) for a, b in numbers
    )


def _ratio(then: dict[str, Any], now: dict[str, Any]) -> float:
    return float(now["seconds"]) / max(float(then["seconds"]), SHORT)


class _Version:
    """A process that runs configs with the package of one checkout."""

    def __init__(self, tree: Path) -> None:
        path = os.pathsep.join([str(tree), str(tree / "plugins")])
        threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
        self.peak = 0
        self._process = subprocess.Popen(
            [sys.executable, str(HERE / "beside.py"), "--work"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=tree,
            env={**os.environ, **threads, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"},
        )  # fmt: skip

    def run(self, command: str, config: Path, out: Path) -> dict[str, Any]:
        """What a run tells, and the seconds that it takes."""
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        stdin.write(json.dumps([command, str(config), str(out)]) + "\n")
        stdin.flush()
        told: dict[str, Any] = json.loads(stdout.readline())
        self.peak = max(self.peak, told["peak"])
        return told

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def work(answers: TextIO) -> None:
    """Run the configs that are named on the standard input, one a line, each into a directory."""
    import shutil

    import sparserob_core as sr

    for line in sys.stdin:
        command, config, out = json.loads(line)
        shutil.rmtree(out, ignore_errors=True)
        started = time.process_time()
        try:
            if command == "bound":
                sr.bound(config, out=out)
            else:
                sr.run(config, out=out, quiet=True, figures=False)
            result = Path(out) / ("bound.json" if command == "bound" else "result.json")
            found = json.loads(result.read_text("utf-8"))
        except sr.SparseRobError as error:
            found = {"status": f"refused: {error}"}
        seconds = time.process_time() - started
        told = {key: found.get(key) for key in SHOWN}
        told |= {"seconds": round(seconds, 3), "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024}
        print(json.dumps(told), file=answers, flush=True)


if __name__ == "__main__":
    if sys.argv[1:] == ["--work"]:
        answers, sys.stdout = sys.stdout, sys.stderr  # what a run prints is no answer
        work(answers)
    else:
        sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
