"""The only reader of a run directory: its files as data.

Nothing that a directory names is executed. Its config is checked against the components of this distribution and of
plugin files that the user names (`read_config`). Its arrays are plain numbers and text (`read_arrays`).
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
from sparserob_core.quantities import statistics
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import RoundFinished
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.program import Formulation
from sparserob_core.sip.result import COLUMNS, MEANING, Result, SearchTrace

if TYPE_CHECKING:
    from sparserob_core.experiment.assemble import ControlExperiment, Experiment
    from sparserob_core.experiment.config.load import Loaded

UNFINISHED = "the run has not finished"
# arrays of a feedback decision: gains, the observer where outputs are measured, and the gains of an inner loop
ANSWERS = ("gains", "observer", "prestabilise")
# Difference that is allowed between dependent arrays, as a share of the largest number of the array
ARRAY_TOLERANCE = 1e-9
MAX_JSON_BYTES = 2**27
"""Largest number of bytes of a JSON file. The largest that runs write have some 10 million; with ten times the limit a
file could take all memory of a machine."""
MAX_ENTRIES, MAX_LISTS = 2**23, 2**21
"""Largest numbers of commas and of brackets in a JSON file; they are counted before it is read. A number takes some 50
bytes, a list or an object 200. The largest files that runs write have a million of either. A file of empty lists alone
would take 25 times its size, and the time limit of a check could not end the reading."""
LARGE = re.compile(r"[eE]\+?[0-9]{3}|[0-9]{99}")
"""A pattern of large numbers: a text without it has only finite numbers with a point or an exponent."""
IMPOSED = {"multipliers": "f", "times": "f", "indices": "f", "rows": "i", "families": "U"}
"""The columns of ``solution.npz`` for the imposed constraints, with their kinds of numpy."""
SIMPLE = {"int": "iu", "float": "fiu", "str": "U", "bool": "b"}
"""Types of the fields of a round that a column of ``trace.npz`` can hold, with their kinds of numpy."""


@final
@dataclass(frozen=True, eq=False)
class StoredRun:
    """The files of a run directory, each read when it is first needed.

    Every property raises `InputError` that names its file, where this is missing, cannot be read or does not fit. It
    does so too where its arrays take more than ``largest`` bytes (`MAX_ARRAY_BYTES` unless given).
    """

    directory: Path
    largest: int | None = None

    @cached_property
    def summary(self) -> dict[str, Any]:
        """The contents of ``result.json``."""
        return read_summary(self.directory / "result.json")

    @cached_property
    def solution(self) -> dict[str, Array]:
        """The arrays of ``solution.npz``; none where there is no such file."""
        file, arrays = self.directory / "solution.npz", self.arrays("solution.npz")
        for prefix in ("", BOUND):
            columns = {prefix + name: arrays[prefix + name] for name in IMPOSED if prefix + name in arrays}
            counts = {column.shape[:1] for column in columns.values()}
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
        """The rounds: ``trace.npz``, with the decisions and the cuts in ``rounds.npz``.

        Columns that are no field of `RoundFinished` are ignored: a later version may write more of them.
        """
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
            return with_decisions(rounds, arrays, self._infer_formulation(arrays))
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(f"{self.directory}: trace.npz and rounds.npz do not fit together: {error}") from None

    @cached_property
    def cuts(self) -> tuple[Cut, ...]:
        """The imposed constraints in ``solution.npz``."""
        return cuts_of(self.solution, self._infer_formulation(self.solution)) if "families" in self.solution else ()

    @cached_property
    def proving(self) -> tuple[tuple[Cut, ...], Array]:
        """The constraints that prove the lower bound, and the multipliers of the equalities.

        The index of a policy's constraint is followed by its deviation. There are none where ``solution.npz`` does not
        hold them.
        """
        columns = {name.removeprefix(BOUND): column for name, column in self.solution.items() if name.startswith(BOUND)}
        cuts = cuts_of(columns, "literal") if {*CUTS} <= {*columns} else ()
        return cuts, np.ravel(columns.get("equalities", np.zeros(0)))

    def _infer_formulation(self, arrays: Mapping[str, Array]) -> Formulation:
        """Return the formulation of indices in arrays of a version that did not write it; it follows from the
        method."""
        if not arrays or FORMULATIONS in arrays:
            return "reduced"
        from sparserob_core.experiment.config.reading.reader import read_source

        method = read_source(self.directory / "config.yaml").data.get("method")
        entry = {"name": method} if isinstance(method, str) else method if isinstance(method, Mapping) else {}
        if entry.get("name") == "sparserob":
            return "literal" if entry.get("formulation") == "literal" else "reduced"
        formulations: dict[object, Formulation] = {"nominal": "nominal", "scenario": "sampled"}
        return formulations.get(entry.get("name"), "reduced")

    @cached_property
    def evaluations(self) -> SearchTrace | None:
        """The search in ``evaluations.npz``; ``None`` where there is no such file."""
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
        """Return the arrays of one of its ``.npz`` files; none where there is no such file."""
        return read_arrays(self.directory / name, self.largest)

    def config(self, plugins: Iterable[str | Path] = ()) -> Loaded:
        """Return the checked config of the run, as `read_config` does."""
        return read_config(self.directory, plugins)


@final
@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A run directory with a control, and its experiment.

    Parameters
    ----------
    stored : StoredRun
        Its files.
    experiment : ControlExperiment
        Its experiment.
    theta : array (m, N)
        The coefficients of the control; under feedback of the nominal one.
    """

    stored: StoredRun
    experiment: ControlExperiment
    theta: Array

    @cached_property
    def decision(self) -> Array:
        """The whole decision ``(n,)``: ``theta`` and, under feedback, the variables of the gains.

        Raises `InputError` where ``solution.npz`` does not hold it, or where its arrays do not belong to one decision.
        """
        if self.experiment.transcription.feedback is None:
            decision = self.theta.ravel()
        else:
            decision, shape = self.solution.get("decision", np.zeros(0)), (self.experiment.program.n,)
            if decision.shape != shape or decision.dtype.kind != "f" or not np.isfinite(decision).all():
                raise InputError(
                    f"{self.directory / 'solution.npz'}: decision: expected finite numbers of shape {shape}, as"
                    f" config.yaml says, got {decision.dtype} of shape {decision.shape}"
                )
        self._require_agreement(decision)
        return decision

    def require_certified(self) -> None:
        """Raise `InputError` where ``certificate.json``, if there is one, is about another control.

        The truth of its claims about this control is left to `check`.
        """
        file = self.directory / "certificate.json"
        certificate = read_json(file) if file.is_file() else {}
        stored = {"decision": self.theta} | {name: self.solution.get(name, np.zeros(0)) for name in ANSWERS}
        for name in (name for name in stored if certificate.get(name) is not None):
            try:
                same = np.array_equal(np.array(certificate[name], dtype=float), stored[name])
            except (TypeError, ValueError, OverflowError):
                same = False
            if not same:
                raise InputError(
                    f"{self.directory}: {name}: solution.npz and certificate.json hold two different controls;"
                    " sparserob check says what holds of the run"
                )

    def _require_agreement(self, decision: Array) -> None:
        """Raise `InputError` where the other arrays of ``solution.npz`` do not follow from the decision."""
        model = self.experiment.transcription
        derived = {"theta": model.nominal(decision), "control": model.pieces(decision)}
        if model.feedback is not None:
            derived |= model.feedback.loop.written(decision)
        elif self.solution.get("decision", np.zeros(0)).shape == decision.shape:
            derived["decision"] = decision
        for name, value in derived.items():
            stored = self.solution.get(name)
            if stored is None and name not in ANSWERS:
                continue
            size = float(np.abs(value).max(initial=0.0))
            if (
                stored is None
                or stored.size != value.size
                or stored.dtype.kind != "f"
                or not (np.abs(stored.ravel() - value.ravel()) <= ARRAY_TOLERANCE * size).all()
            ):
                raise InputError(
                    f"{self.directory / 'solution.npz'}: {name}: expected what follows from the decision beside it, got"
                    " another control; sparserob check says what holds of the run"
                )

    @property
    def directory(self) -> Path:
        """The run directory."""
        return self.stored.directory

    @property
    def summary(self) -> Mapping[str, Any]:
        """The contents of ``result.json``."""
        return self.stored.summary

    @property
    def solution(self) -> Mapping[str, Array]:
        """The arrays of ``solution.npz``."""
        return self.stored.solution


def stored_run(directory: str | Path) -> StoredRun:
    """Return the run in a directory; raises `InputError` where there is none."""
    path = Path(directory)
    for name in ("config.yaml", "result.json"):
        if not (path / name).is_file():
            actual = f"one without {name}" if path.is_dir() else "a file" if path.exists() else "nothing"
            raise InputError(f"{path}: expected the directory of a run, got {actual}")
    return StoredRun(path)


def read_config(directory: Path, plugins: Iterable[str | Path] = ()) -> Loaded:
    """Return the checked config of a run directory, as data.

    Parameters
    ----------
    directory : Path
        The run directory.
    plugins : iterable of str or Path, default ()
        Files of plugins that the user names. Only their components and those of this distribution are used, whatever
        the config names. Another component is refused by its name when it is built.

    Returns
    -------
    Loaded
        The config.

    Raises
    ------
    InputError
        If the config cannot be understood.
    """
    from sparserob_core.experiment.config.load import load_config
    from sparserob_core.experiment.plugins.registry import load_own_registry

    if not (directory / "config.yaml").is_file():
        stored_run(directory)
    return load_config(directory / "config.yaml", known=load_own_registry(plugins))


def read_finished(
    directory: Path, plugins: Iterable[str | Path] = (), experiment: Experiment | None = None
) -> FinishedRun:
    """Read a run directory with a control, and build its experiment.

    Parameters
    ----------
    directory : Path
        The run directory.
    plugins : iterable of str or Path, default ()
        Files of plugins, as for `read_config`.
    experiment : Experiment, optional
        The experiment, where it is built already.

    Returns
    -------
    FinishedRun
        The run.

    Raises
    ------
    InputError
        If the directory is none of a run, holds no control, or has a file that cannot be understood.
    """
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
    """Return the contents of a JSON file.

    Raises `InputError` where it cannot be read, is too large, or is no object. It does so too for a number that is not
    finite, since a run writes null instead.
    """
    try:
        data, has_suspects = _read_json(file)
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
    for location, value in _list_numbers(data) if has_suspects else ():
        if not abs(value) <= sys.float_info.max:
            written = repr(value) if isinstance(value, float) else f"a whole number of {value.bit_length()} bits"
            raise InputError(f"{file}: {location}: expected a finite number or null, got {written}")
    return data


def _read_json(file: Path) -> tuple[object, bool]:
    """Return the data of a JSON file, and whether any of its numbers may be infinite or NaN."""
    size, suspects = file.stat().st_size, list[str]()
    if size > MAX_JSON_BYTES:
        raise InputError(f"{file}: cannot be read: expected at most {MAX_JSON_BYTES} bytes, got {size}")
    text = file.read_text(encoding="utf-8")
    for kind, count, limit in (
        ("entries", text.count(","), MAX_ENTRIES),
        ("lists and objects", text.count("[") + text.count("{"), MAX_LISTS),
    ):
        if count > limit:
            raise InputError(f"{file}: cannot be read: expected at most {limit} {kind}, got {count}")

    def whole(digits: str) -> int:
        suspects.extend([digits] if len(digits) > sys.float_info.max_10_exp else [])
        return int(digits)

    def constant(name: str) -> float:
        suspects.append(name)
        return float(name)

    data = json.loads(text, parse_int=whole, parse_constant=constant)
    return data, bool(suspects) or LARGE.search(text) is not None


def _list_numbers(data: dict[str, Any]) -> Iterator[tuple[str, int | float]]:
    """Yield every number of JSON data, each with its place."""
    stack: list[tuple[str, Any]] = [("", data)]
    while stack:
        location, value = stack.pop()
        if isinstance(value, dict):
            stack += [(f"{location}.{key}" if location else key, entry) for key, entry in reversed(value.items())]
        elif isinstance(value, list):
            stack += [(f"{location}[{number}]", value[number]) for number in reversed(range(len(value)))]
        elif isinstance(value, int | float):
            yield location, value


def read_summary(file: Path) -> dict[str, Any]:
    """Return the contents of ``result.json``; raises `InputError` where it is not the result of a run."""
    summary = read_json(file)
    status = summary.get("status")
    if not isinstance(status, str) or status not in MEANING:
        raise InputError(f"{file}: expected the result of a run, with a status ({', '.join(MEANING)}), got {status!r}")
    for name, described in statistics(Result).items():
        empty = None if described.unit else ""
        value = summary.get(name, empty) if described.recent else summary.setdefault(name, empty)
        if not described.unit:
            if not isinstance(value, str):
                raise InputError(f"{file}: {name}: expected text, got {value!r}")
        elif value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise InputError(f"{file}: {name}: expected a number or null, got {value!r}")
    if not isinstance(summary.setdefault("title", ""), str):
        raise InputError(f"{file}: title: expected text, got {summary['title']!r}")
    for name in ("worst", "sparsity", "counts"):
        if not isinstance(summary.setdefault(name, {}), dict):
            raise InputError(f"{file}: {name}: expected an object, got {summary[name]!r}")
    return summary
