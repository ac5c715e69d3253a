"""Recordings of the viewer of Rerun, read back as numbers and text."""

from __future__ import annotations

import time
import warnings
from collections import defaultdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import sparserob_core as sr


def viewer() -> Path:
    import rerun_cli

    return Path(rerun_cli.__file__).parent / "rerun"


def read(file: Path) -> dict[str, list[Any]]:
    """The chunks of a recording by entity, without the static ones."""
    from rerun.chunk import RrdReader

    found: dict[str, list[Any]] = defaultdict(list)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a file that nobody closed
        for chunk in RrdReader(str(file)).stream():
            if not chunk.is_static:
                found[chunk.entity_path].append(chunk)
    return found


def properties(file: Path) -> dict[str, Any]:
    """What a recording says of itself: the values of its properties by name."""
    from rerun.chunk import RrdReader

    found = dict[str, Any]()
    for chunk in RrdReader(str(file)).stream():
        if chunk.entity_path.startswith("/__properties"):
            batch = chunk.to_record_batch()
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                entries = [entry for entry in column.to_pylist() if isinstance(entry, list) and entry]
                found |= {name.rpartition(":")[2]: entry[0] for entry in entries[-1:]}
    return found


def scalars(chunks: list[Any], timeline: str) -> tuple[np.ndarray, np.ndarray]:
    """Times ``(k,)`` and values ``(k, series)`` of an entity, in the order of a timeline."""
    times, values = [], []
    for chunk in chunks:
        batch = chunk.to_record_batch()
        times += np.asarray(batch.column(timeline)).astype(np.int64).tolist()
        values += [np.array(row, dtype=float) for row in batch.column("Scalars:scalars").to_pylist()]
    order = np.argsort(times, kind="stable")
    return np.array(times)[order], np.array(values)[order]


def line_of(chunks: list[Any], trace: sr.SearchTrace) -> np.ndarray:
    """What a line over the evaluations shows at each of them, whose corners are recorded; NaN where there is none. No
    line goes across a NaN, nor from one search to the next, nor beyond what is recorded."""
    at, values = scalars(chunks, "evaluation")
    known, numbers = np.isfinite(values[:, 0]), np.arange(trace.value.size) + 1
    corners, ends = at[known], at[~known]
    broken = np.array([((ends >= a) & (ends < b)).any() for a, b in pairwise(corners)] + [True])
    leg = np.searchsorted(corners, numbers, side="right") - 1
    shown = np.interp(numbers, corners, values[known, 0], left=np.nan)
    shown[(leg < 0) | (broken[leg] & (corners[leg] != numbers))] = np.nan
    for base in np.flatnonzero(np.diff(trace.outer)) + 1:
        assert (ends == base).any()
    return shown


def texts(chunks: list[Any], component: str) -> list[str]:
    return [row[0] for chunk in chunks for row in chunk.to_record_batch().column(component).to_pylist()]


def rows(chunks: list[Any], *columns: str) -> list[dict[str, np.ndarray]]:
    """The rows of an entity, each column as an array, in the order in which they were logged."""
    found = []
    for chunk in chunks:
        batch = chunk.to_record_batch()
        for place in range(batch.num_rows):
            entries = {name: batch.column(name)[place].as_py() for name in columns if name in batch.schema.names}
            found.append({name: np.asarray(entry) for name, entry in entries.items()})
    return found


def walk_of(trace: sr.SearchTrace) -> np.ndarray:
    """The value where the walk stands after each evaluation, by what is noted of it; NaN where nothing is."""
    first = np.searchsorted(trace.outer, trace.outer)
    stands = trace.notes["stands"]
    known = stands >= 1
    walk = np.full(trace.value.size, np.nan)
    walk[known] = trace.value[first[known] + stands[known].astype(int) - 1]
    return walk


def pace(turns: int = 1_000_000, usual: float = 0.06) -> float:
    """How many times as long as usual the processor itself takes, in seconds of its own for so many turns."""
    own, total = time.process_time(), 0
    for turn in range(turns):
        total += turn
    return max(1.0, (time.process_time() - own) / usual)


def slowness(seconds: float = 0.1) -> float:
    """How many times as long as it takes by itself a computation takes here now."""
    wall, own = time.perf_counter(), time.process_time()
    while time.process_time() - own < seconds:
        pass
    return max(1.0, (time.perf_counter() - wall) / seconds)
