"""The tests that a change can affect, by what imports what was changed.

``python -m tests.changed [REVISION]`` prints their paths, one a line: the folders of tests whose place in the package
holds a module that imports what was changed since ``REVISION`` (``main`` unless given), directly or through others, and
the tests that were changed themselves. Tests stand at the same place as what they test. Those that run whole commands,
by name or by config, know no imports: they count as importers of everything, and so do the plugins' tests.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = "sparserob_core"
# folders of tests that stand at no place of the package
WHOLE = {"archive", "known_answers", "contracts", "plugins", "rules"}


def importers() -> Callable[[str], set[str]]:
    """The modules that import a module of the package, it among them; lazily imported ones count too."""
    import grimp

    graph = grimp.build_graph(PACKAGE)
    return lambda module: {module} | (graph.find_downstream_modules(module) if module in graph.modules else set())


def affected(changed: Iterable[str], importers: Callable[[str], set[str]], folders: Iterable[str]) -> list[str]:
    """Of the ``folders`` of tests, as `control/response` or `known_answers`, and of the ``changed`` files, paths from
    the root, what is to run: all folders where a file is no test and no module; none twice."""
    modules, files, every, whole = set[str](), set[str](), False, False
    for name in changed:
        path = Path(name)
        if path.parts[0] == PACKAGE and path.suffix == ".py":
            modules |= importers(".".join(path.with_suffix("").parts).removesuffix(".__init__"))
        elif path.parts[0] in ("plugins", "configs", "docs", "CHANGELOG.md", "README.md"):
            whole = True
        elif path.parts[0] == "tests" and path.name.startswith("test_"):
            files.add(name)
        else:  # what every test may rest on: its set-up, or how the project is built
            every = True
    places = {"/".join(module.split(".")[1:]) for module in modules}
    found = [
        folder
        for folder in folders
        if every
        or ((whole or modules) and folder.split("/")[0] in WHOLE)
        or any(place == folder or place.startswith(folder + "/") for place in places)
    ]
    kept = [name for name in files if not any(name.startswith(f"tests/{folder}/") for folder in found)]
    return sorted([f"tests/{folder}" for folder in found] + kept)


def main(revision: str) -> None:
    """Print what is to run, as far as it is there."""
    base = _git("merge-base", revision, "HEAD")[0]
    changed = {*_git("diff", "--name-only", base), *_git("ls-files", "--others", "--exclude-standard")}
    folders = {path.parent.relative_to(ROOT / "tests").as_posix() for path in (ROOT / "tests").rglob("test_*.py")}
    for name in affected(sorted(changed), importers(), sorted(folders - {"benchmarks"})):
        outer = any(folder.startswith(name.removeprefix("tests/") + "/") for folder in folders)
        own = sorted((ROOT / name).glob("test_*.py")) if outer else [ROOT / name]  # what lies deeper is chosen itself
        print("\n".join(path.relative_to(ROOT).as_posix() for path in own if path.exists()))


def _git(*arguments: str) -> list[str]:
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()


if __name__ == "__main__":
    main(*(sys.argv[1:] or ["main"]))
