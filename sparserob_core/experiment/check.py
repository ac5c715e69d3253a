"""``sparserob check``: a finished run verified anew, from its config and its certificate alone."""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, final
from zipfile import BadZipFile

import numpy as np

from sparserob_core.checker.outcome import Claim
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.errors import InputError

STATUS = {"holds": 0, "not checked": 1, "fails": 2}


@final
@dataclass(frozen=True)
class Check:
    """The verdicts on a run, one per claim. ``status`` is ``verified`` when all hold, ``refuted`` when one fails, else
    ``undecided``."""

    title: str
    claims: tuple[Claim, ...]
    seconds: float

    @property
    def status(self) -> str:
        worst = max((STATUS[claim.verdict] for claim in self.claims), default=1)
        return ("verified", "undecided", "refuted")[worst]


def check(directory: str | Path) -> Check:
    """Verify the run in ``directory``: its certificate against its config in ball arithmetic, ``result.json`` and
    ``solution.npz`` against both.

    Nothing is solved, and nothing of what solved it is used. Raises `InputError` when the directory is not that of a
    finished run with a certificate.
    """
    from sparserob_core.checker.claims.case import Case
    from sparserob_core.checker.claims.claims import check as derive
    from sparserob_core.experiment.assemble import described, gap_tolerance
    from sparserob_core.experiment.config.load import load_config

    path, started = Path(directory), time.perf_counter()
    data, summary = _read(path, "certificate.json"), _read(path, "result.json")
    experiment = described(load_config(path / "config.yaml"))
    if experiment.problem is None or experiment.control is None or experiment.disturbance is None:
        raise InputError(
            f"{path}: expected the run of a control problem; certificates of other programs cannot be checked"
        )
    case = Case(experiment.problem, experiment.control, experiment.disturbance, data)
    claims = [
        _config(experiment.loaded.config.digest(), data, summary),
        *derive(case, gap_tolerance(experiment.loaded)),
        _result(data, summary),
        _solution(path, data, experiment.control),
    ]
    return Check(experiment.loaded.config.title or path.name, tuple(claims), time.perf_counter() - started)


def _read(path: Path, name: str) -> dict[str, Any]:
    try:
        data = json.loads((path / name).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"{path}: expected the directory of a finished run, got one whose {name} cannot be read: {error.strerror}"
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path / name}: expected JSON: {error}") from error
    if not isinstance(data, dict):
        raise InputError(f"{path / name}: expected a JSON object, got {type(data).__name__}")
    return data


def _config(digest: str, data: Mapping[str, Any], summary: Mapping[str, Any]) -> Claim:
    if data.get("config") != digest or summary.get("config") != digest:
        return Claim(
            "config",
            "fails",
            f"config.yaml is {digest}, the certificate is about {data.get('config')!r}, "
            f"result.json about {summary.get('config')!r}",
        )
    return Claim("config", "holds", f"the certificate is about this config ({digest})")


def _result(data: Mapping[str, Any], summary: Mapping[str, Any]) -> Claim:
    """``result.json`` must say what the certificate says."""
    status = data.get("status")
    wanted: dict[str, object] = {"status": status, "lower_bound": data.get("lower_bound")}
    if status == "infeasible":
        wanted |= {"cost": None, "upper_bound": None}
    else:
        wanted |= {"cost": data.get("cost"), "upper_bound": None if status == "refuted" else data.get("cost")}
    different = [
        f"{name} is {summary.get(name)!r}, not {value!r}"
        for name, value in wanted.items()
        if summary.get(name) != value
    ]
    different += _gap(summary) if status in ("certified", "verified") else []
    return Claim(
        "result.json", "fails" if different else "holds", "; ".join(different) or "it says what the certificate says"
    )


def _gap(summary: Mapping[str, Any]) -> list[str]:
    cost, lower, gap = (summary.get(name) for name in ("cost", "lower_bound", "gap"))
    if not (isinstance(cost, float) and isinstance(lower, float) and isinstance(gap, float)):
        return ["cost, lower_bound and gap are no numbers"]
    derived = (cost - lower) / max(1.0, abs(cost))
    return [] if abs(gap - derived) <= 1e-12 else [f"gap is {gap!r}, not {derived!r}"]


def _solution(path: Path, data: Mapping[str, Any], dictionary: Dictionary) -> Claim:
    """``solution.npz`` must hold the certificate's decision."""
    if data.get("decision") is None:
        return Claim("solution.npz", "holds", "there is no decision")
    try:
        with np.load(BytesIO((path / "solution.npz").read_bytes()), allow_pickle=False) as stored:
            theta, control, breakpoints = stored["theta"], stored["control"], stored["breakpoints"]
        decision = np.array(data["decision"], dtype=float)
        same = (
            np.array_equal(theta, decision)
            and np.array_equal(breakpoints, dictionary.breakpoints)
            and np.allclose(control, decision @ dictionary.values, rtol=0.0, atol=1e-12)
        )
    except (OSError, EOFError, ValueError, KeyError, TypeError, OverflowError, BadZipFile, zlib.error) as error:
        return Claim("solution.npz", "fails", f"it cannot be read: {error}")
    if not same:
        return Claim("solution.npz", "fails", "its control is not the certificate's")
    return Claim("solution.npz", "holds", "it holds the certificate's control")
