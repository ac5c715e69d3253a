"""Tamperings of one finished run at every place of every file, each with the place that it touches: what `check` does
not find it must name as not compared."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from tests.support.tampering import Change, Forgery, stored

CONFIG: dict[str, Any] = {
    "title": "small",
    "problem": {
        "name": "linear",
        "system": {"A": [[-1.0]], "B": [[1.0]]},
        "horizon": 1.0,
        "initial_state": [2.0],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.05]},
        "path": [{"box": [1.5], "from": 0.5}],
        "terminal": [{"box": [0.5]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}},
    "observers": [],
}
"""One state, four pieces: a run of a tenth of a second."""

Place = tuple[str | int, ...]
Tamperings = dict[str, tuple[str, Place, Change]]
"""By what was done: the file, the place in it, and the change."""
FILES: dict[str, Callable[[Forgery], dict[str, Any]]] = {
    "certificate.json": lambda files: files.certificate,
    "result.json": lambda files: files.result,
    "config.yaml": lambda files: files.config,
}


def named(file: str, place: Place, said: tuple[str, ...]) -> bool:
    """Whether a file is named as not compared, or in it the place, or what that is a part of."""
    keys = [key for key in place if isinstance(key, str)]
    parts = {".".join(keys[:length]) for length in range(1, len(keys) + 1)}
    names = dict(entry.partition(": ")[::2] for entry in said)
    return file in names and (not names[file] or bool(parts & set(names[file].split(", "))))


def changed(file: str, *place: str | int, to: Callable[[Any], Any]) -> tuple[str, Place, Change]:
    """One entry of a file of keys is another, or is new (``to`` of ``None``)."""

    def apply(files: Forgery) -> None:
        holder: Any = FILES[file](files)
        for key in place[:-1]:
            holder = holder[key]
        old = holder.get(place[-1]) if isinstance(holder, dict) else holder[place[-1]]
        holder[place[-1]] = to(old)

    return file, place, apply


def times(factor: float) -> Callable[[float], float]:
    return lambda value: value * factor


def plus(step: float) -> Callable[[float], float]:
    return lambda value: value + step


def later(value: float) -> float:
    return math.nextafter(value, math.inf)


def earlier(value: float) -> float:
    return math.nextafter(value, -math.inf)


def put(value: Any) -> Callable[[Any], Any]:
    return lambda _: value


def listed(file: str, kind: str, to: Callable[[Any], Any], *places: Place) -> Tamperings:
    return {f"{file}: {'.'.join(map(str, place))} is {kind}": changed(file, *place, to=to) for place in places}


HEAVIEST: Place = ("multipliers", "constraints", 0)
CERTIFICATE: Tamperings = {
    **listed("certificate.json", "1e-9 higher", times(1 + 1e-9), ("cost",), ("lower_bound",), ("gap_tolerance",)),
    **listed("certificate.json", "1e-9 lower", times(1 - 1e-9), ("cost",), ("lower_bound",), ("gap_tolerance",)),
    **listed("certificate.json", "1e-6 higher", plus(1e-6), *(("decision", 0, k) for k in range(4))),
    **listed("certificate.json", "1e-6 lower", plus(-1e-6), *(("decision", 0, k) for k in range(4))),
    **listed("certificate.json", "flat", lambda rows: rows[0], ("decision",)),
    **listed("certificate.json", "another word", lambda text: text + "x", ("status",), ("config",)),
    **listed("certificate.json", "the weaker word", put("verified"), ("status",)),
    **listed("certificate.json", "true", put(True), ("format",), ("cost",), ("lower_bound",)),
    **listed(
        "certificate.json",
        "1e-5 larger",
        times(1 + 1e-5),
        *((*HEAVIEST, key) for key in ("multiplier", "time")),
        (*HEAVIEST, "direction", 0),
    ),
    **listed(
        "certificate.json",
        "1e-5 smaller",
        times(1 - 1e-5),
        *((*HEAVIEST, key) for key in ("multiplier", "time")),
        (*HEAVIEST, "direction", 0),
    ),
    **listed(
        "certificate.json", "of the other sign", times(-1), (*HEAVIEST, "multiplier"), (*HEAVIEST, "direction", 0)
    ),
    **listed("certificate.json", "the path's", put("path"), (*HEAVIEST, "constraint")),
    **listed("certificate.json", "the middle", put([0.0]), (*HEAVIEST, "parameter")),
    **listed("certificate.json", "one more", lambda entries: [*entries, 0.0], ("multipliers", "equalities")),
    **listed("certificate.json", "twice", lambda entries: entries * 2, ("multipliers", "constraints")),
    **listed("certificate.json", "a number", put(1.0), ("multipliers", "pieces"), ("witness",), ("proof", "path")),
    **listed("certificate.json", "a row", put([[0.25] * 4]), ("multipliers", "pieces")),
    **listed("certificate.json", "a witness", put({"constraint": "path", "time": 1.0}), ("witness",)),
    **listed(
        "certificate.json",
        "new",
        put("proven"),
        ("verdict",),
        ("multipliers", "verdict"),
        (*HEAVIEST, "verdict"),
        ("proof", "verdict"),
        ("proof", "path", "verdict"),
    ),
    **listed("certificate.json", "given", put([[1.0]]), ("proof", "path", "normals"), ("proof", "terminal", "normals")),
    **listed("certificate.json", "later by rounding", later, ("proof", "path", "lower", 0, 0)),
    **listed("certificate.json", "later by rounding", later, ("proof", "path", "upper", -1, 0)),
    **listed("certificate.json", "earlier by rounding", earlier, ("proof", "path", "upper", -1, 0)),
    **listed("certificate.json", "earlier by rounding", earlier, ("proof", "path", "lower", 0, 0)),
    **listed("certificate.json", "earlier by rounding", earlier, ("proof", "terminal", "lower", 0, 0)),
    **listed(
        "certificate.json",
        "a thousandth larger",
        times(1.001),
        ("proof", "path", "tolerance"),
        ("proof", "terminal", "tolerance"),
    ),
    **listed("certificate.json", "without its last cell", lambda rows: rows[:-1], ("proof", "path", "upper")),
    **listed("certificate.json", "none", put({}), ("proof",), ("proof", "terminal"), ("multipliers",)),
}
RESULT: Tamperings = {
    **listed(
        "result.json",
        "1e-9 higher",
        lambda value: value + 1e-9 * max(1.0, abs(value)),
        *((key,) for key in ("cost", "value", "epsilon", "lower_bound", "upper_bound", "gap", "seconds", "seed")),
    ),
    **listed(
        "result.json",
        "1e-9 lower",
        lambda value: value - 1e-9 * max(1.0, abs(value)),
        *((key,) for key in ("cost", "value", "epsilon", "lower_bound", "upper_bound", "gap", "seconds", "seed")),
    ),
    **listed("result.json", "1e-8 larger", times(1 + 1e-8), ("cost_scale",)),
    **listed("result.json", "1e-8 smaller", times(1 - 1e-8), ("cost_scale",)),
    **listed(
        "result.json", "not given", put(None), *((key,) for key in ("cost", "gap", "cost_scale", "seed", "worst"))
    ),
    **listed("result.json", "false", put(False), ("seed",), ("gap",), ("sparsity", "switches")),
    **listed("result.json", "text", str, ("cost",), ("gap",), ("cost_scale",), ("worst", "violation")),
    **listed(
        "result.json",
        "another word",
        lambda text: text + "x",
        *((key,) for key in ("title", "status", "message", "stopped", "config")),
        ("worst", "constraint"),
        ("versions", "numpy"),
        ("provenance", "hash"),
    ),
    **listed("result.json", "1e-6 more", plus(1e-6), ("worst", "violation"), ("worst", "time")),
    **listed("result.json", "1e-6 less", plus(-1e-6), ("worst", "violation"), ("worst", "time")),
    **listed("result.json", "the middle", put([0.0]), ("worst", "parameter")),
    **listed("result.json", "1e-9 more", plus(1e-9), ("sparsity", "active_fraction")),
    **listed("result.json", "one less", plus(-1), ("sparsity", "switches"), ("counts", "rounds")),
    **listed(
        "result.json", "ten times that", times(10), ("tolerances", "path", "own"), ("tolerances", "path", "proven")
    ),
    **listed("result.json", "new", put("proven"), ("verdict",), ("worst", "verdict"), ("sparsity", "verdict")),
}
CONFIGURED: Tamperings = {
    **listed(
        "config.yaml",
        "larger by rounding",
        lambda value: later(float(value)),
        ("problem", "horizon"),
        ("problem", "initial_state", 0),
        ("problem", "system", "A", 0, 0),
        ("problem", "system", "B", 0, 0),
        ("problem", "control", "box"),
        ("problem", "disturbance", "box", 0),
        ("problem", "path", 0, "from"),
        ("problem", "path", 0, "box", 0),
        ("problem", "terminal", 0, "box", 0),
        ("method", "tolerance"),
        ("continuation", "stop"),
    ),
    **listed("config.yaml", "one more", plus(1), ("seed",), ("dictionaries", "control", "pieces")),
    **listed("config.yaml", "another word", lambda text: text + "x", ("title",)),
}


def array(name: str, kind: str, change: Callable[[np.ndarray], np.ndarray]) -> Tamperings:
    def apply(arrays: dict[str, np.ndarray]) -> None:
        arrays[name] = change(arrays.get(name, np.zeros(1)).copy())

    return {f"solution.npz: {name} is {kind}": ("solution.npz", (name,), stored(apply))}


def entry(place: int, change: Callable[[float], float]) -> Callable[[np.ndarray], np.ndarray]:
    def apply(values: np.ndarray) -> np.ndarray:
        values.flat[place] = change(values.flat[place])
        return values

    return apply


CONTROL = ("theta", "control", "breakpoints", "decision")
SOLUTION: Tamperings = {}
for name in CONTROL:
    SOLUTION |= array(name, "1e-9 more at first", entry(0, plus(1e-9)))
    SOLUTION |= array(name, "1e-9 less at last", entry(-1, plus(-1e-9)))
    SOLUTION |= array(name, "not a number at last", entry(-1, put(math.nan)))
    SOLUTION |= array(name, "in one more dimension", lambda values: values[None])
    SOLUTION |= array(name, "on end", lambda values: values.reshape(-1, 1))
    SOLUTION |= array(name, "without its last entry", lambda values: values[..., :-1])
    SOLUTION |= array(name, "text", lambda values: values.astype(str))
    SOLUTION[f"solution.npz: {name} is gone"] = (
        "solution.npz",
        (name,),
        stored(lambda arrays, name=name: arrays.pop(name)),  # type: ignore[misc]
    )
for name in ("multipliers", "times", "indices"):
    SOLUTION |= array(name, "1e-9 more at first", entry(0, plus(1e-9)))
SOLUTION |= array("rows", "another", entry(0, plus(1)))
SOLUTION |= array("families", "another", lambda values: np.full(values.shape, "gate"))
SOLUTION |= array("verdict", "new", lambda values: values)


def beside(file: str) -> Tamperings:
    def apply(files: Forgery) -> None:
        with (files.directory / file).open("ab") as stream:
            stream.write(b"proven")

    return {f"{file}: more is written": (file, (), apply)}


EVERYWHERE: Tamperings = {
    **CERTIFICATE,
    **RESULT,
    **CONFIGURED,
    **SOLUTION,
    **{
        key: one
        for file in ("notes.txt", "rounds.npz", "trace.npz", "adversary.npz")
        for key, one in beside(file).items()
    },
}
