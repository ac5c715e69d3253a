"""Draw mutants of what is proven and checked, and count those that the tests notice.

``python -m tests.mutants [COUNT=300] [SEED=1] [FOLDERS=checker,sip/proof] [STAGE=folder|first] [JOBS=1] [SKIP=0]``

Each mutant stands in a copy of the tree, never in the tree itself. The tests of its own folder that call its function
are put to it, the shortest first; what survives these meets the whole first stage. Time is that of the
processor, so that a busy machine kills nothing.
"""

from __future__ import annotations

import os
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from queue import SimpleQueue

from tests.mutants.processes import Verdict, baseline, tested
from tests.mutants.sites import KINDS, Mutant, mutants

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (
    "checker", "sip/proof", "control/feedback", "control/constraints", "control/reach", "control/response",
    "control/enclosures", "control/sets", "sip/inner",
)  # fmt: skip
COPIED = (
    "sparserob_core",
    "plugins",
    "tests",
    "configs",
    "docs",
    "pyproject.toml",
    "Makefile",
    "README.md",
    "CHANGELOG.md",
)
# the text of the tree, and this tool: they say nothing of the mathematics
NOT_ASKED = ("--ignore=tests/rules", "--ignore=tests/mutants")


KEPT = ROOT / ".mutants"  # what unchanged tests said, for as long as the tree does not change


@dataclass
class Tally:
    """What became of the mutants of one folder, or of one kind."""

    drawn: int = 0
    beside: int = 0
    later: int = 0
    survivors: list[Mutant] = field(default_factory=list)

    def add(self, mutant: Mutant, beside: Verdict, later: Verdict | None) -> None:
        """Count one."""
        self.drawn += 1
        self.beside += beside.killed
        self.later += later is not None and later.killed
        if not (beside if later is None else later).killed:
            self.survivors.append(mutant)


def drawn(folders: tuple[str, ...], count: int, seed: int) -> list[Mutant]:
    """So many mutants, folder by folder in proportion to their sites, every kind in turn, the same for one seed."""
    rng, sites = random.Random(seed), {folder: _sites(folder) for folder in folders}
    chosen = list[Mutant]()
    for place, folder in enumerate(folders):
        left = sum(len(sites[name]) for name in folders[place:])
        share = round((count - len(chosen)) * len(sites[folder]) / left) if left else 0
        piles = []
        for kind in KINDS:
            pile = [mutant for mutant in sites[folder] if mutant.kind == kind]
            rng.shuffle(pile)
            piles.append(pile)
        order = list[Mutant]()
        while any(piles) and len(order) < share:
            order += [pile.pop() for pile in piles if pile]
        rng.shuffle(order)
        chosen += order[:share]
    return chosen


@cache
def _sites(folder: str) -> list[Mutant]:
    files = sorted((ROOT / "sparserob_core" / folder).rglob("*.py"))
    return [mutant for file in files for mutant in mutants(str(file.relative_to(ROOT)), file.read_bytes())]


def folder_of(mutant: Mutant, folders: tuple[str, ...]) -> str:
    """The folder that a mutant was drawn from."""
    return next(name for name in folders if mutant.path.startswith(f"sparserob_core/{name}/"))


def copied(place: Path) -> Path:
    """A copy of the tree that may be changed."""
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, place / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif (ROOT / name).exists():
            shutil.copy2(ROOT / name, place / name)
    return place


def main(arguments: list[str]) -> int:
    """Draw, run, print; 0 whatever survives: the judgement is that of who reads it."""
    options = {"COUNT": "300", "SEED": "1", "FOLDERS": ",".join(FOLDERS), "STAGE": "first", "JOBS": "1", "SKIP": "0"}
    for argument in arguments:
        name, _, value = argument.partition("=")
        if name not in options:
            print(f"{name} is no option; there are {', '.join(options)}", file=sys.stderr)
            return 2
        options[name] = value or options[name]
    folders = tuple(options["FOLDERS"].split(","))
    chosen = drawn(folders, int(options["COUNT"]), int(options["SEED"]))[int(options["SKIP"]) :]
    tallies = {name: Tally() for name in (*folders, *KINDS)}
    with tempfile.TemporaryDirectory(prefix="mutants-") as scratch:
        copies: SimpleQueue[Path] = SimpleQueue()
        for number in range(int(options["JOBS"])):
            copies.put(copied(Path(scratch) / str(number)))
        first = copies.get()
        costs = {name: baseline(first, [f"tests/{name}"], KEPT) for name in {folder_of(one, folders) for one in chosen}}
        copies.put(first)

        def judged(mutant: Mutant) -> tuple[Mutant, Verdict, Verdict | None]:
            copy, folder = copies.get(), folder_of(mutant, folders)
            try:
                beside = tested(copy, mutant, [f"tests/{folder}"], costs[folder])
                later = None
                if not beside.killed and options["STAGE"] == "first":
                    later = tested(copy, mutant, ["tests", *NOT_ASKED, f"--ignore=tests/{folder}"], None)
                return mutant, beside, later
            finally:
                copies.put(copy)

        started = time.perf_counter()
        with ThreadPoolExecutor(int(options["JOBS"])) as pool:
            for mutant, beside, later in pool.map(judged, chosen):
                for name in (folder_of(mutant, folders), mutant.kind):
                    tallies[name].add(mutant, beside, later)
                verdict = beside if later is None else later
                stage = "beside" if beside.killed else "first stage" if verdict.killed else "SURVIVED"
                print(f"{stage:11} {beside.seconds:5.1f} s  {mutant}  [{verdict.by}]", flush=True)
        print(f"{time.perf_counter() - started:.0f} s")
    _print(folders, tallies, options["STAGE"] == "first")
    return 0


def _print(folders: tuple[str, ...], tallies: dict[str, Tally], whole: bool) -> None:
    """Both rates of every folder, of all, and of every kind: what no test can be asked to notice is of few kinds."""
    print(f"\n{'folder':26} drawn  killed beside" + ("  killed by the first stage" if whole else ""))
    counts = Counter[str]()
    for folder in folders:
        tally = tallies[folder]
        counts.update(drawn=tally.drawn, beside=tally.beside, later=tally.later)
        _line(folder, tally.drawn, tally.beside, tally.later, whole)
    _line("all", counts["drawn"], counts["beside"], counts["later"], whole)
    print()
    for kind in KINDS:
        _line(kind, tallies[kind].drawn, tallies[kind].beside, tallies[kind].later, whole)
    print("\nsurvivors:")
    for folder in folders:
        for mutant in tallies[folder].survivors:
            print(f"  {mutant}")


def _line(name: str, count: int, beside: int, later: int, whole: bool) -> None:
    share = f"{beside:5} {beside / max(count, 1):7.0%}"
    print(
        f"{name:26} {count:5}  {share}"
        + (f"  {beside + later:10} {(beside + later) / max(count, 1):7.0%}" if whole else "")
    )


if __name__ == "__main__":
    os.chdir(ROOT)
    sys.exit(main(sys.argv[1:]))
