"""What a run directory holds, read back as data: the one reader of its files.

Nothing that a directory names is executed: its config is checked against the components of this distribution and of
the plugin files that the user names himself (`read_config`), arrays are plain numbers and text (`read_arrays`).
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.experiment.config.matrices.arrays import read_arrays
from sparserob_core.experiment.directory.rounds import BOUND, CUTS, FORMULATIONS, cuts_of, with_decisions
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import RoundFinished
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.program import Formulation
from sparserob_core.sip.result import COLUMNS, MEANING, SearchTrace

if TYPE_CHECKING:
    from sparserob_core.experiment.assemble import ControlExperiment, Experiment
    from sparserob_core.experiment.config.load import Loaded

UNFINISHED = "the run has not finished"
NUMBERS = ("cost", "value", "epsilon", "lower_bound", "upper_bound", "gap", "seconds")
ANSWERS = ("gains", "observer")  # how a decision answers what is measured, where it does: states, or outputs
SAME = 1e-9  # of the largest number of an array, how far it may be from what follows from another
LARGEST_TEXT = 2**27
"""Bytes of one JSON file, at most. The largest that runs write have some 10 million; with ten times as many a file
could take all of a machine."""
MOST_ENTRIES, MOST_LISTS = 2**23, 2**21
"""Commas and brackets in one JSON file, at most, which are told before it is read: a number takes some 50 bytes, a list
or an object 200. The largest that runs write have a million of either; a file of nothing but empty lists would take 25
times its size, and the time to make them is not a check's own, which ends when it is told to."""
LARGE = re.compile(r"[eE]\+?[0-9]{3}|[0-9]{99}")
"""Without one of these, a number with a point or an exponent is finite."""
IMPOSED = {"multipliers": "f", "times": "f", "indices": "f", "rows": "i", "families": "U"}
"""What ``solution.npz`` says of every imposed constraint, and the kinds of numpy that say it."""
SIMPLE = {"int": "iu", "float": "fiu", "str": "U", "bool": "b"}
"""Types of the fields of a round that a column of ``trace.npz`` can hold, and the kinds of numpy that serve."""


@final
@dataclass(frozen=True, eq=False)
class StoredRun:
    """The files of a run directory, each read when it is first asked for.

    Every property raises `InputError` that names the file when it is missing, cannot be read, or does not fit, among
    these where its arrays take more than ``largest`` bytes (`LARGEST` unless given).
    """

    directory: Path
    largest: int | None = None

    @cached_property
    def summary(self) -> dict[str, Any]:
        """``result.json``."""
        return read_summary(self.directory / "result.json")

    @cached_property
    def solution(self) -> dict[str, Array]:
        """``solution.npz``; empty where there is none."""
        file, arrays = self.directory / "solution.npz", self.arrays("solution.npz")
        for prefix in ("", BOUND):
            columns = {prefix + name: arrays[prefix + name] for name in IMPOSED if prefix + name in arrays}
            counts = {other.shape[:1] for other in columns.values()}
            for name, column in columns.items():
                plain = name.removeprefix(prefix)
                dimensions = 2 if plain == "indices" else 1
                if column.ndim != dimensions or column.dtype.kind not in IMPOSED[plain] or len(counts) > 1:
                    raise InputError(
                        f"{file}: {name}: expected one entry for each imposed constraint, as in "
                        f"{', '.join(columns)}, got {column.dtype} of shape {column.shape}"
                    )
        return arrays

    @cached_property
    def history(self) -> tuple[RoundFinished, ...]:
        """The rounds: ``trace.npz``, with the decisions and the cuts that ``rounds.npz`` keeps of them. Columns that
        are no field of `RoundFinished` are passed over: a later version may write more of them."""
        file, trace = self.directory / "trace.npz", self.arrays("trace.npz")
        plain = {name: kind for name, kind in RoundFinished.__annotations__.items() if kind in SIMPLE}
        columns = {name: trace[name] for name in plain if name in trace}
        count = len(columns["round"]) if columns.get("round", np.zeros(())).ndim else 0
        for name, column in columns.items():
            if column.shape != (count,) or (count and column.dtype.kind not in SIMPLE[plain[name]]):
                raise InputError(
                    f"{file}: {name}: expected one entry of type {plain[name]} for each of {count} rounds, "
                    f"got {column.dtype} of shape {column.shape}"
                )
        try:
            rounds = [
                RoundFinished(**{name: column[row].item() for name, column in columns.items()}) for row in range(count)
            ]
            arrays = self.arrays("rounds.npz")
            return with_decisions(rounds, arrays, self._formulation(arrays))
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(f"{self.directory}: trace.npz and rounds.npz do not fit together: {error}") from None

    @cached_property
    def cuts(self) -> tuple[Cut, ...]:
        """The imposed constraints that ``solution.npz`` holds."""
        return cuts_of(self.solution, self._formulation(self.solution)) if "families" in self.solution else ()

    @cached_property
    def proving(self) -> tuple[tuple[Cut, ...], Array]:
        """The constraints that prove the lower bound, of a policy each at the deviation behind its index, and the
        multipliers of the equalities; none where ``solution.npz`` does not hold them."""
        columns = {name.removeprefix(BOUND): one for name, one in self.solution.items() if name.startswith(BOUND)}
        cuts = cuts_of(columns, "literal") if {*CUTS} <= {*columns} else ()
        return cuts, np.ravel(columns.get("equalities", np.zeros(0)))

    def _formulation(self, arrays: Mapping[str, Array]) -> Formulation:
        """What the indices of arrays say whose version did not write it down: it follows from the method."""
        if not arrays or FORMULATIONS in arrays:
            return "reduced"
        from sparserob_core.experiment.config.reading.reader import read_source

        method = read_source(self.directory / "config.yaml").data.get("method")
        entry = {"name": method} if isinstance(method, str) else method if isinstance(method, Mapping) else {}
        if entry.get("name") == "sparserob":
            return "literal" if entry.get("formulation") == "literal" else "reduced"
        known: dict[object, Formulation] = {"nominal": "nominal", "scenario": "sampled"}
        return known.get(entry.get("name"), "reduced")

    @cached_property
    def evaluations(self) -> SearchTrace | None:
        """``evaluations.npz``; ``None`` where there is none."""
        file, arrays = self.directory / "evaluations.npz", self.arrays("evaluations.npz")
        if not arrays:
            return None
        count = arrays["value"].shape if "value" in arrays else ()
        columns = {name: arrays.get(name, np.zeros(())) for name in (*COLUMNS, *arrays) if name != "points"}
        for name, column in columns.items():
            if column.dtype.kind not in "fi" or column.ndim != 1 or column.shape != count:
                raise InputError(f"{file}: {name}: expected one number for each of the evaluations in value")
        points = arrays.get("points", np.zeros((*count, 0)))
        if points.ndim != 2 or points.shape[:1] != count or points.dtype.kind != "f":
            raise InputError(f"{file}: points: expected one row for each of the evaluations in value")
        if not np.isfinite(arrays["outer"]).all():
            raise InputError(f"{file}: outer: expected the number of an outer iteration for each evaluation")
        return SearchTrace.stored(arrays)

    def arrays(self, name: str) -> dict[str, Array]:
        """The arrays of one of its ``.npz`` files; none when there is no such file."""
        return read_arrays(self.directory / name, self.largest)

    def config(self, plugins: Iterable[str | Path] = ()) -> Loaded:
        """``config.yaml``, see `read_config`."""
        return read_config(self.directory, plugins)


@final
@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A run directory: its ``experiment``, the decision ``theta (m, N)``, ``summary`` (``result.json``), ``solution``
    (``solution.npz``), and the files themselves (``stored``)."""

    stored: StoredRun
    experiment: ControlExperiment
    theta: Array

    @cached_property
    def decision(self) -> Array:
        """The whole decision ``(n,)``: ``theta``, and under feedback the variables of the gains. Raises `InputError`
        where ``solution.npz`` does not hold it, or where its arrays are not of one decision."""
        if self.experiment.transcription.feedback is None:
            found = self.theta.ravel()
        else:
            found, shape = self.solution.get("decision", np.zeros(0)), (self.experiment.program.n,)
            if found.shape != shape or found.dtype.kind != "f" or not np.isfinite(found).all():
                raise InputError(
                    f"{self.directory / 'solution.npz'}: decision: expected finite numbers of shape {shape}, as"
                    f" config.yaml says, got {found.dtype} of shape {found.shape}"
                )
        self._agrees(found)
        return found

    def require_certified(self) -> None:
        """Raise `InputError` where ``certificate.json``, if there is one, is about another control. Whether what it
        claims of that control is true is for `check` to say."""
        file = self.directory / "certificate.json"
        said = read_json(file) if file.is_file() else {}
        held = {"decision": self.theta} | {name: self.solution.get(name, np.zeros(0)) for name in ANSWERS}
        for name in (name for name in held if said.get(name) is not None):
            try:
                same = np.array_equal(np.array(said[name], dtype=float), held[name])
            except (TypeError, ValueError, OverflowError):
                same = False
            if not same:
                raise InputError(
                    f"{self.directory}: {name}: solution.npz and certificate.json hold two different controls;"
                    " sparserob check says what holds of the run"
                )

    def _agrees(self, decision: Array) -> None:
        """Raise `InputError` where what ``solution.npz`` holds beside a decision is not what follows from it."""
        model = self.experiment.transcription
        followed = {"theta": model.nominal(decision), "control": model.pieces(decision)}
        if model.feedback is not None:
            followed |= model.feedback.loop.written(decision)
        elif self.solution.get("decision", np.zeros(0)).shape == decision.shape:
            followed["decision"] = decision
        for name, value in followed.items():
            held = self.solution.get(name)
            if held is None and name not in ANSWERS:
                continue
            size = float(np.abs(value).max(initial=0.0))
            if (
                held is None
                or held.size != value.size
                or held.dtype.kind != "f"
                or not (np.abs(held.ravel() - value.ravel()) <= SAME * size).all()
            ):
                raise InputError(
                    f"{self.directory / 'solution.npz'}: {name}: expected what follows from the decision beside it, got"
                    " another control; sparserob check says what holds of the run"
                )

    @property
    def directory(self) -> Path:
        """Where it is."""
        return self.stored.directory

    @property
    def summary(self) -> Mapping[str, Any]:
        """``result.json``."""
        return self.stored.summary

    @property
    def solution(self) -> Mapping[str, Array]:
        """``solution.npz``."""
        return self.stored.solution


def stored_run(directory: str | Path) -> StoredRun:
    """The run in a directory; raises `InputError` when there is none."""
    path = Path(directory)
    for name in ("config.yaml", "result.json"):
        if not (path / name).is_file():
            instead = f"one without {name}" if path.is_dir() else "a file" if path.exists() else "nothing"
            raise InputError(f"{path}: expected the directory of a run, got {instead}")
    return StoredRun(path)


def read_config(directory: Path, plugins: Iterable[str | Path] = ()) -> Loaded:
    """The config of a run directory, checked, as data: the components are those of this distribution and of the files
    ``plugins``, which the user names, whatever the config says; another one is refused by its name when it is built.

    Raises `InputError` when it cannot be understood.
    """
    from sparserob_core.experiment.config.load import load_config
    from sparserob_core.experiment.plugins.registry import load_own_registry

    if not (directory / "config.yaml").is_file():
        stored_run(directory)
    return load_config(directory / "config.yaml", known=load_own_registry(plugins))


def read_finished(
    directory: Path, plugins: Iterable[str | Path] = (), experiment: Experiment | None = None
) -> FinishedRun:
    """Read a run directory and build its experiment again, unless ``experiment`` is at hand; raises `InputError` when
    it is none, holds no control, or a file of it cannot be understood. ``plugins`` as in `read_config`."""
    from sparserob_core.experiment.assemble import assemble

    stored = stored_run(directory)
    summary, solution = stored.summary, stored.solution
    if "theta" not in solution:
        raise InputError(
            f"{directory}: there is no control in it; the status is '{summary['status']}': {summary['message']}"
        )
    experiment = (experiment or assemble(stored.config(plugins))).of_control(
        f"{directory}: expected the run of a control problem"
    )
    theta, shape = solution["theta"], (experiment.problem.system.controls, experiment.control.functions)
    if theta.shape != shape or theta.dtype.kind != "f" or not np.isfinite(theta).all():
        raise InputError(
            f"{directory / 'solution.npz'}: theta: expected finite numbers of shape {shape}, as config.yaml says, "
            f"got {theta.dtype} of shape {theta.shape}" + ("" if theta.shape != shape else " that are not all finite")
        )
    return FinishedRun(stored, experiment, theta)


def read_json(file: Path) -> dict[str, Any]:
    """The contents of a JSON file; raises `InputError` when it cannot be read, is too large or no object, or holds a
    number that is not finite: a run writes null where there is none."""
    try:
        data, odd = _read(file)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror}") from None
    except MemoryError:
        raise InputError(f"{file}: cannot be read: it takes more memory than there is") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: cannot be read: expected JSON: {error}") from None
    if not isinstance(data, dict):
        raise InputError(f"{file}: expected a JSON object, got {type(data).__name__}")
    for place, value in _numbers(data) if odd else ():
        if not abs(value) <= sys.float_info.max:
            written = repr(value) if isinstance(value, float) else f"a whole number of {value.bit_length()} bits"
            raise InputError(f"{file}: {place}: expected a finite number or null, got {written}")
    return data


def _read(file: Path) -> tuple[object, bool]:
    """What a JSON file says, and whether any of its numbers may be too large or none."""
    size, odd = file.stat().st_size, list[str]()
    if size > LARGEST_TEXT:
        raise InputError(f"{file}: cannot be read: expected at most {LARGEST_TEXT} bytes, got {size}")
    text = file.read_text(encoding="utf-8")
    for what, count, most in (
        ("entries", text.count(","), MOST_ENTRIES),
        ("lists and objects", text.count("[") + text.count("{"), MOST_LISTS),
    ):
        if count > most:
            raise InputError(f"{file}: cannot be read: expected at most {most} {what}, got {count}")

    def whole(digits: str) -> int:
        odd.extend([digits] if len(digits) > sys.float_info.max_10_exp else [])
        return int(digits)

    def constant(name: str) -> float:
        odd.append(name)
        return float(name)

    data = json.loads(text, parse_int=whole, parse_constant=constant)
    return data, bool(odd) or LARGE.search(text) is not None


def _numbers(data: dict[str, Any]) -> Iterator[tuple[str, int | float]]:
    """Every number of JSON, with the keys that lead to it."""
    stack: list[tuple[str, Any]] = [("", data)]
    while stack:
        place, value = stack.pop()
        if isinstance(value, dict):
            stack += [(f"{place}.{key}" if place else key, entry) for key, entry in reversed(value.items())]
        elif isinstance(value, list):
            stack += [(f"{place}[{number}]", value[number]) for number in reversed(range(len(value)))]
        elif isinstance(value, int | float):
            yield place, value


def read_summary(file: Path) -> dict[str, Any]:
    """The contents of ``result.json``; raises `InputError` when it is not the result of a run."""
    summary = read_json(file)
    status = summary.get("status")
    if not isinstance(status, str) or status not in MEANING:
        raise InputError(f"{file}: expected the result of a run, with a status ({', '.join(MEANING)}), got {status!r}")
    for name in NUMBERS:
        value = summary.setdefault(name)
        if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise InputError(f"{file}: {name}: expected a number or null, got {value!r}")
    for name in ("title", "message"):
        if not isinstance(summary.setdefault(name, ""), str):
            raise InputError(f"{file}: {name}: expected text, got {summary[name]!r}")
    for name in ("worst", "sparsity", "counts"):
        if not isinstance(summary.setdefault(name, {}), dict):
            raise InputError(f"{file}: {name}: expected an object, got {summary[name]!r}")
    return summary
