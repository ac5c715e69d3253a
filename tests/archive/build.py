"""Make the run directories of the archive with one version of the package, and ask its checker for every verdict.

``cd CHECKOUT; PYTHONPATH=.:plugins python THIS_TREE/tests/archive/build.py DIRECTORY [NAME ...]``

``CHECKOUT`` is a checkout of 8092d250, whose code, configs and lists of known answers are used. What takes more than
`LONGEST` seconds of the processor, to run or to check, is left out, and said. What lies in ``DIRECTORY`` already is
kept, so that the command can be repeated. At the end ``runs.tar.xz`` and ``verdicts.json`` stand beside the
directories; `tests/archive` holds both. Without names every one is made, and the seconds are measured of all.
"""

from __future__ import annotations

import copy
import importlib.util
import io
import json
import resource
import shutil
import subprocess
import sys
import tarfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

Config = dict[str, Any]
LONGEST = {"run": 110, "check": 25}  # seconds of the processor
KEPT = ("config.yaml", "certificate.json", "result.json", "solution.npz", "bound.json")
"""What `check` reads of a run directory; the history of the run and its figures are left out."""
WARM = ("plain-drift", "in_time-drift", "pair-parameters", "pair-affine", "bound-double_integrator")
"""Checked first, unmeasured, where seconds are measured: what is imported lazily takes time, once."""
HELD = (  # shipped configs whose worst cases are bounded, too
    "atv_box", "coupled_masses", "double_integrator", "experiment1_repaired", "experiment2_repaired",
    "experiment3_repaired", "heated_house", "initial_set", "motor_voltage", "narrowing_corridor", "rate_limits",
    "two_modes", "uncertain_thruster",
)  # fmt: skip
AMPLIFIED = 18  # random plants that amplify
FAR: Config = {"initial_state": [4.0, 0.0]}  # nothing reaches the terminal set of test_dressed from there
CLOSE: Config = {"initial_state": [0.9, 0.9]}  # nothing keeps the path set of test_pairs from there


def listed() -> dict[str, tuple[str, Config | str]]:
    """By name: ``run`` or ``bound``, and a config or the name of a shipped one."""
    return {**_dressed(), **_pairs(), **_without_an_answer(), **_amplified(), **_shipped()}


def _line(name: str, **more: Any) -> Config:
    """A line of test_dressed, as this test makes it."""
    from tests.known_answers.test_dressed import BASE, LINES

    line = {**copy.deepcopy(LINES[name]), **more} if name else dict(more)
    charge, top = line.pop("policy", None), line.pop("top", {})
    return {
        "problem": {key: value for key, value in {**copy.deepcopy(BASE), **line}.items() if value is not None},
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 6}},
        "observers": [],
        **top,
        **({} if charge is None else {"policy": {"name": "affine", "cost": charge, "causal_signals": 0}}),
    }


def _pair(*names: str) -> Config:
    """A problem with features of test_pairs."""
    from tests.known_answers.test_pairs import BASE, FEATURES

    config = copy.deepcopy(BASE)
    for name, put in FEATURES.items():
        if name in names:
            put(config)
    return config


def _named(*words: str) -> str:
    return "-".join(words).replace(",", "").replace(" ", "_")


def _dressed() -> dict[str, tuple[str, Config | str]]:
    from tests.known_answers.test_dressed import LINES, dressed

    plain = {_named("plain", name): _line(name) for name in LINES}
    in_time = {_named("in_time", name): dressed(_line(name)) for name in LINES}
    return {name: ("run", config) for name, config in {**plain, **in_time}.items()}


def _pairs() -> dict[str, tuple[str, Config | str]]:
    from tests.known_answers.test_pairs import FEATURES

    alone = [(name,) for name in FEATURES]
    of_parameters = ("entries in t", "delay", "initial set", "measurable", "execution", "pieces of the system")
    of_time = ("delay", "initial set", "measurable", "execution", "affine", "curved path", "integral")
    of_feedback = ("delay", "initial set", "pieces of the system")
    together = [
        *(("parameters", other) for other in of_parameters),
        *(("entries in t", other) for other in of_time),
        *(("affine", other) for other in of_feedback),
        ("parameters", "entries in t", "execution"),
        ("parameters", "entries in t", "measurable"),
        ("delay", "measurable", "execution"),
    ]
    return {_named("pair", *names): ("run", _pair(*names)) for names in [*alone, *together]}


def _without_an_answer() -> dict[str, tuple[str, Config | str]]:
    """Infeasible problems, and controls that are refuted by a witness: those of the nominal problem."""
    from tests.known_answers.test_dressed import dressed

    lines = {
        "": {}, "delay": {}, "initial box": {"initial_state": {"centre": [4.0, 0.0], "box": [0.05, 0.05]}},
        "polytope, measurable": {}, "execution": {}, "step": {}, "pieces": {}, "integral": {}, "sparsest": {},
        "affine": {}, "curved control": {}, "quadratic": {}, "haar": {}, "fixed": {},
    }  # fmt: skip
    made: dict[str, tuple[str, Config | str]] = {}
    for name, more in lines.items():
        config = _line(name, **{**FAR, **more})
        made[_named("infeasible", name or "box")] = ("run", config)
        if name in ("", "polytope, measurable", "execution", "initial box"):
            made[_named("infeasible_in_time", name or "box")] = ("run", dressed(config))
    for feature in ("parameters", "entries in t", "moving set", "mixed"):
        config = _pair(feature)
        config["problem"].update(CLOSE, path=[{"box": [0.6, None], "from": 0.0}])
        made[_named("infeasible-pair", feature)] = ("run", config)
    for name in ("", "delay", "initial box", "polytope, measurable", "execution", "pieces", "integral", "curved path"):
        config = {**_line(name), "method": {"name": "nominal"}}
        made[_named("nominal", name or "box")] = ("run", config)
        if name != "pieces":
            made[_named("nominal_in_time", name or "box")] = ("run", dressed(config))
    for features in (("parameters",), ("parameters", "entries in t"), ("measurable",), ("parameters", "measurable")):
        made[_named("nominal-pair", *features)] = ("run", {**_pair(*features), "method": {"name": "nominal"}})
    return made


def _amplified() -> dict[str, tuple[str, Config | str]]:
    """Random plants that amplify by up to `e^40`, of this tree: claims about them may be false."""
    place = Path(__file__).parents[1] / "support" / "amplified.py"
    spec = importlib.util.spec_from_file_location("amplified", place)
    assert spec is not None and spec.loader is not None
    module = sys.modules["amplified"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return {f"amplified-{number:02d}": ("run", module.drawn(number).options) for number in range(AMPLIFIED)}


def _shipped() -> dict[str, tuple[str, Config | str]]:
    names = sorted(path.stem for path in Path("configs").glob("*.yaml"))
    runs: dict[str, tuple[str, Config | str]] = {f"config-{name}": ("run", name) for name in names}
    return runs | {f"bound-{name}": ("bound", name) for name in HELD}


def make(command: str, config: Config | str, directory: Path) -> None:
    """Run one of them, in this process."""
    import sparserob_core as sr

    given = f"configs/{config}.yaml" if isinstance(config, str) else config
    if command == "bound":
        print(sr.bound(given, out=directory).status)
    else:
        print(sr.run(given, out=directory, quiet=True, figures=False).status)


def told(directory: Path) -> dict[str, Any]:
    """What the checker that is imported says of a run: its status, each claim's verdict, seconds of the processor."""
    from sparserob_core.experiment.check.check import check

    started = time.process_time()
    found = check(directory)
    seconds = time.process_time() - started
    return {
        "status": found.status,
        "claims": [[claim.name, claim.verdict] for claim in found.claims],
        "doubts": [f"{claim.name}: {claim.text}" for claim in found.claims if claim.verdict != "holds"],
        "seconds": round(seconds, 4),
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }


def timed(directories: Mapping[str, Path]) -> dict[str, float]:
    """The seconds of the processor of each check, one after the other in this process."""
    for name in WARM:
        told(directories[name])
    return {name: told(directory)["seconds"] for name, directory in directories.items()}


def _limited(kind: str) -> Any:
    return lambda: resource.setrlimit(resource.RLIMIT_CPU, (LONGEST[kind], LONGEST[kind] + 5))


def _child(kind: str, *arguments: str) -> tuple[int, str, str]:
    """The status, the output and the last line of the errors of this file as a process with a limit."""
    command = [sys.executable, __file__, f"--{kind}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=_limited(kind))
    return done.returncode, done.stdout, (done.stderr.strip().splitlines() or [""])[-1]


def build(place: Path, names: list[str]) -> None:
    """Make and check each that is not there yet, and write the archive."""
    place.mkdir(parents=True, exist_ok=True)
    every = listed()
    for name in names or every:
        command, config = every[name]
        directory, verdict = place / "runs" / name, place / "verdicts" / f"{name}.json"
        if verdict.exists():
            continue
        shutil.rmtree(directory, ignore_errors=True)
        directory.parent.mkdir(parents=True, exist_ok=True)
        verdict.parent.mkdir(parents=True, exist_ok=True)
        started = time.perf_counter()
        status, said, error = _child("run", command, json.dumps(config), str(directory))
        if status == 0:
            for path in directory.iterdir():
                if path.name not in KEPT:
                    path.unlink()
            ran = time.perf_counter() - started
            status, found, error = _child("check", str(directory))
        if status:
            reason = f"takes more than {LONGEST}" if status < 0 else error
            verdict.write_text(json.dumps({"left out": reason}))
            print(f"{name}: left out after {time.perf_counter() - started:.0f} s: {reason}", flush=True)
            continue
        verdict.write_text(found)
        one = json.loads(found)
        print(f"{name}: {said.strip()} ({ran:.1f} s), {one['status']} ({one['seconds']:.2f} s)", flush=True)
    pack(place, [name for name in every if (place / "verdicts" / f"{name}.json").exists()])


def pack(place: Path, names: list[str]) -> None:
    """Write ``runs.tar.xz`` and ``verdicts.json``: the same bytes from the same directories."""
    table = {name: json.loads((place / "verdicts" / f"{name}.json").read_text()) for name in sorted(names)}
    table = {name: one for name, one in table.items() if "left out" not in one}
    for name, seconds in timed({name: place / "runs" / name for name in table}).items():
        table[name]["seconds"] = seconds
    with tarfile.open(place / "runs.tar.xz", "w:xz", preset=9) as archive:
        for name in table:
            for file in KEPT:
                path = place / "runs" / name / file
                if path.exists():
                    entry, content = tarfile.TarInfo(f"{name}/{file}"), path.read_bytes()
                    entry.size = len(content)
                    archive.addfile(entry, io.BytesIO(content))
    lines = [f"{json.dumps(name)}: {json.dumps(one)}" for name, one in table.items()]
    (place / "verdicts.json").write_text("{\n" + ",\n".join(lines) + "\n}\n")
    print(f"{len(table)} run directories, {(place / 'runs.tar.xz').stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    kind, *arguments = sys.argv[1:]
    if kind == "--run":
        make(arguments[0], json.loads(arguments[1]), Path(arguments[2]))
    elif kind == "--check":
        import sparserob_core.checker.claims.claims
        import sparserob_core.experiment.assemble  # noqa: F401  (what is imported lazily takes time, once)

        print(json.dumps(told(Path(arguments[0]))))
    else:
        build(Path(kind), arguments)
