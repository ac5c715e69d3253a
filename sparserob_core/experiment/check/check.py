"""``sparserob check``: a finished run verified anew, from its config and its certificate alone."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from sparserob_core.checker.outcome import Claim
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.errors import InputError
from sparserob_core.experiment.config.run_config import digest
from sparserob_core.experiment.directory.finished import StoredRun, read_json, stored_run
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.result import UNKNOWN_SCALE, relative_gap

if TYPE_CHECKING:
    from sparserob_core.experiment.config.load import Loaded

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


def check(directory: str | Path, plugins: Iterable[str | Path] = ()) -> Check:
    """Verify the run in ``directory``: its certificate against its config in ball arithmetic, ``result.json`` and
    ``solution.npz`` against both.

    Nothing is solved, and nothing of what solved it is used. ``plugins``: files that offer the problem or a dictionary
    where these are no part of this distribution; the directory itself is data, and no plugin that it names is loaded.
    Raises `InputError` when the directory is not that of a
    finished run with a certificate.
    """
    from sparserob_core.checker.claims.case import Case
    from sparserob_core.checker.claims.claims import check as derive
    from sparserob_core.experiment.assemble import dictionaries_of, gap_tolerance, problem_of

    started, stored = time.perf_counter(), stored_run(directory)
    path = stored.directory
    if not (path / "certificate.json").is_file():
        raise InputError(f"{path}: expected the directory of a finished run, got one without certificate.json")
    data, summary = read_json(path / "certificate.json"), read_json(path / "result.json")
    loaded = stored.config(plugins)
    problem = problem_of(loaded)
    if isinstance(problem, SemiInfiniteProgram):
        raise InputError(
            f"{path}: expected the run of a control problem; certificates of other programs cannot be checked"
        )
    control, disturbance = dictionaries_of(loaded, problem.horizon)
    case = Case(problem, control, disturbance, data)
    claims = [
        _config(loaded, data, summary),
        *derive(case, gap_tolerance(loaded)),
        _result(data, summary),
        _solution(stored, data, control),
    ]
    return Check(loaded.config.title or path.name, tuple(claims), time.perf_counter() - started)


def _config(loaded: Loaded, data: Mapping[str, Any], summary: Mapping[str, Any]) -> Claim:
    """An earlier version had fewer keys: the digest is of the config as it is read today, or as it is written."""
    found, written = loaded.config.digest(), digest(loaded.source.data)
    if data.get("config") not in (found, written) or summary.get("config") != data.get("config"):
        return Claim(
            "config",
            "fails",
            f"config.yaml is {found}, the certificate is about {data.get('config')!r}, "
            f"result.json about {summary.get('config')!r}",
        )
    return Claim("config", "holds", f"the certificate is about this config ({data['config']})")


def _result(data: Mapping[str, Any], summary: Mapping[str, Any]) -> Claim:
    """``result.json`` must say what the certificate says."""
    status = data.get("status")
    wanted: dict[str, object] = {"status": status, "lower_bound": data.get("lower_bound")}
    if status == "infeasible":
        wanted |= {"cost": None, "upper_bound": None}
    else:
        wanted |= {"cost": data.get("cost"), "upper_bound": data.get("cost")}
    if status == "refuted" or (status == "undecided" and summary.get("upper_bound") is None):
        wanted["upper_bound"] = None  # earlier versions wrote the cost of an undecided run
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
    scale = summary.get("cost_scale", UNKNOWN_SCALE)
    derived = relative_gap(lower, cost, scale) if isinstance(scale, float) else np.nan
    return [] if abs(gap - derived) <= 1e-12 else [f"gap is {gap!r}, not {derived!r}"]


def _solution(stored: StoredRun, data: Mapping[str, Any], dictionary: Dictionary) -> Claim:
    """``solution.npz`` must hold the certificate's decision."""
    if data.get("decision") is None:
        return Claim("solution.npz", "holds", "there is no decision")
    try:
        theta, control, breakpoints = (stored.solution[name] for name in ("theta", "control", "breakpoints"))
        decision = np.array(data["decision"], dtype=float)
        same = (
            np.array_equal(theta, decision)
            and np.array_equal(breakpoints, dictionary.breakpoints)
            and np.allclose(control, decision @ dictionary.values, rtol=0.0, atol=1e-12)
        )
    except InputError as error:
        return Claim("solution.npz", "fails", f"it cannot be read: {error}")
    except KeyError as error:
        return Claim("solution.npz", "fails", f"it holds no array {error}")
    except (ValueError, TypeError, OverflowError):
        return Claim("solution.npz", "fails", "its control and the certificate's are no arrays of one shape")
    if not same:
        return Claim("solution.npz", "fails", "its control is not the certificate's")
    return Claim("solution.npz", "holds", "it holds the certificate's control")
