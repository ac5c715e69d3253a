"""Checks that refuse problems whose numbers or states are too large for computations in doubles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass

import numpy as np

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.errors import InputError, Path

LARGEST_NUMBER = 1e75
"""The largest size of a number in a problem, and the largest growth of a state until the horizon.

Up to four such numbers are multiplied where a problem is scaled. Their product is a finite double; the product of ten
times larger numbers is not. A bound that is ten times smaller would admit less and gain nothing: a double has 16
digits, and proofs fail at far smaller numbers.
"""
KEYS = {"initial_set": "initial_state", "stop": "to", "start": "from"}
"""The fields that have another name in a config."""


def require_representable(problem: OptimalControlProblem) -> None:
    """Raise `InputError` for a problem with a number larger than `LARGEST_NUMBER`, or a state that grows by more.

    The growth is ``e^(a T)`` for a phase of duration ``T``, where ``a`` is the largest real part of an eigenvalue of
    the phase at its `probes`. The growth of a system whose entries depend on the time is not checked.

    Parameters
    ----------
    problem : OptimalControlProblem
        The problem.

    Raises
    ------
    InputError
        The error begins with the key of a config.
    """
    for path, value in _list_keyed_numbers(problem):
        _require_small(path, value)
    if problem.system.varies:
        for mode in problem.system.modes:
            for name, values in zip("ABE", mode.forced.matrices(mode.probes), strict=True):
                _require_small(("system", name), values)
        return
    last = 0.0
    for i, mode in enumerate(problem.system.modes):
        until = (*problem.system.switches, problem.horizon)[i]
        prefix: Path = ("system", "pieces", i) if problem.system.switches else ("system",)
        for name, values in zip("ABE", mode.forced.matrices(mode.probes), strict=True):
            _require_small((*prefix, name), values)
        A = mode.matrices(mode.probes)[0]
        rate = float(np.linalg.eigvals(A).real.max())
        if rate * (until - last) > np.log(LARGEST_NUMBER):
            raise InputError(
                path=(*prefix, "A"),
                expected=f"a state that grows by at most {LARGEST_NUMBER:g} until the horizon",
                got=f"e^({rate:.4g} * {until - last:.4g}), of an eigenvalue with the real part {rate:.4g}",
            )
        last = until


def _list_keyed_numbers(problem: OptimalControlProblem) -> Iterator[tuple[Path, np.ndarray]]:
    """Yield every array and number of a problem, with the keys of a config that lead to it."""
    is_switched = len(problem.system.phases) > 1
    for path, value in _list_numbers(problem, ()):
        if path[:2] != ("system", "phases"):
            yield path, value
        elif path[3] == "domain":  # parameters and times, which are fields of the system and of the phase too
            continue
        elif is_switched:
            yield ("system", "pieces", *path[2:]), value
        else:
            yield ("horizon",) if path[3] == "until" else ("system", *path[3:]), value


def _require_small(path: Path, value: np.ndarray) -> None:
    """Raise `InputError` where a finite number of an array is larger than `LARGEST_NUMBER`."""
    size = np.abs(value[np.isfinite(value)])
    if size.max(initial=0.0) > LARGEST_NUMBER:
        raise InputError(
            path=path, expected=f"numbers of at most {LARGEST_NUMBER:g} in size", got=f"{float(size.max()):g}"
        )


def _list_numbers(record: object, path: Path) -> Iterator[tuple[Path, np.ndarray]]:
    """Yield every array and number of a record, with the keys that lead to it."""
    if isinstance(record, np.ndarray) and record.dtype.kind == "f":
        yield path, record
    elif isinstance(record, float):
        yield path, np.array([record])
    elif isinstance(record, tuple | list):
        for i, entry in enumerate(record):
            yield from _list_numbers(entry, (*path, i))
    elif is_dataclass(record):
        for field in fields(record):
            yield from _list_numbers(getattr(record, field.name, None), (*path, KEYS.get(field.name, field.name)))
