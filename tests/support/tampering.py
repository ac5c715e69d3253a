"""Forged run directories, copies of honest ones with something changed: every kind, and how to make it."""

from __future__ import annotations

import copy
import json
import math
import pickle
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.config.reading.reader import read_source, write_yaml
from sparserob_core.sip.result import relative_gap


@dataclass
class Forgery:
    """The files of a copied run, as plain data; every change is written back by `forged`."""

    directory: Path
    config: dict[str, Any]
    certificate: dict[str, Any]
    result: dict[str, Any]

    @property
    def problem(self) -> dict[str, Any]:
        return self.config["problem"]

    @property
    def system(self) -> dict[str, Any]:
        return self.problem["system"]

    @property
    def multipliers(self) -> dict[str, Any]:
        return self.certificate["multipliers"]

    @property
    def constraints(self) -> list[dict[str, Any]]:
        return self.multipliers["constraints"]

    @property
    def heaviest(self) -> dict[str, Any]:
        """The constraint with the largest multiplier: certainly one that the bound needs."""
        return max(self.constraints, key=lambda entry: entry["multiplier"])

    @property
    def decision(self) -> list[list[float]]:
        return self.certificate["decision"]

    def proof(self, name: str) -> dict[str, Any]:
        return self.certificate["proof"][name]


Change = Callable[[Forgery], None]


_CONFIGS: dict[str, dict[str, Any]] = {}


def _config(text: str, file: Path) -> dict[str, Any]:
    """What a config says; that of one run is read for many forgeries of it."""
    if text not in _CONFIGS:
        _CONFIGS[text] = read_source(file).data
    return _CONFIGS[text]


def copied(source: Path, target: Path | None = None) -> Forgery:
    """A copy of a run directory; only of what its files say, without a target."""
    if target is None:
        target = source
    else:
        shutil.copytree(source, target)
    return Forgery(
        target,
        copy.deepcopy(_config((target / "config.yaml").read_text(), target / "config.yaml")),
        json.loads((target / "certificate.json").read_text()),
        json.loads((target / "result.json").read_text()),
    )


def forged(source: Path, target: Path, change: Change, consistent: bool) -> Path:
    """A copy with one change. ``consistent``: the digests, ``result.json`` and ``solution.npz`` are made to agree with
    it."""
    files = copied(source, target)
    solution = (target / "solution.npz").read_bytes()
    change(files)
    (target / "config.yaml").write_text(write_yaml(files.config))
    if consistent:
        _agree(files, untouched=(target / "solution.npz").read_bytes() == solution)
    (target / "certificate.json").write_text(json.dumps(files.certificate))
    (target / "result.json").write_text(json.dumps(files.result))
    return target


def _agree(files: Forgery, untouched: bool) -> None:
    certificate, result = files.certificate, files.result
    certificate["config"] = result["config"] = load_config(files.directory / "config.yaml").config.digest()
    for name in ("status", "cost", "lower_bound"):
        result[name] = certificate.get(name)
    cost, lower = certificate.get("cost"), certificate.get("lower_bound")
    result["upper_bound"] = None if certificate.get("status") in ("infeasible", "refuted") else cost
    if isinstance(cost, float) and isinstance(lower, float):
        result["gap"] = relative_gap(lower, cost, result["cost_scale"])
    if untouched and certificate.get("decision") is not None:
        _solved(files)


def _solved(files: Forgery) -> None:
    """Write the certificate's decision to ``solution.npz``, where it is one."""
    from sparserob_core.experiment.assemble import dictionaries_of

    dictionary, _ = dictionaries_of(load_config(files.directory / "config.yaml"), float(files.problem["horizon"]))
    try:
        theta = np.array(files.decision, dtype=float)
        control = theta @ dictionary.values
    except (TypeError, ValueError, OverflowError):
        return
    with np.load(files.directory / "solution.npz") as stored:
        arrays = {**stored, "theta": theta, "control": control}
    np.savez_compressed(files.directory / "solution.npz", **arrays)


def entry(**changes: Any) -> Change:
    """The certificate's own keys."""
    return lambda files: files.certificate.update(changes)


def heaviest(**changes: Any) -> Change:
    """The constraint that the bound needs most."""
    return lambda files: files.heaviest.update(changes)


def times(key: str, factor: float) -> Change:
    return lambda files: files.certificate.update({key: files.certificate[key] * factor})


def problem(**changes: Any) -> Change:
    return lambda files: files.problem.update(changes)


def system(**changes: Any) -> Change:
    return lambda files: files.system.update(changes)


def control(change: Callable[[np.ndarray], object]) -> Change:
    """The decision ``(N,)`` in place; the cost follows, so that it is no lie."""

    def apply(files: Forgery) -> None:
        theta = np.array(files.decision[0])
        change(theta)
        files.certificate["decision"] = [theta.tolist()]
        horizon, pieces = float(files.problem["horizon"]), theta.size
        files.certificate["cost"] = math.fsum(np.abs(theta)) * horizon / pieces

    return apply


def at_bound(theta: np.ndarray) -> int:
    return int(np.abs(theta).argmax())


def between(theta: np.ndarray) -> int:
    return int(np.abs(np.abs(theta) - 0.5).argmin())


def idle(theta: np.ndarray) -> int:
    return int(np.abs(theta).argmin())


def moved(place: Callable[[np.ndarray], int], step: float) -> Change:
    def apply(theta: np.ndarray) -> None:
        theta[place(theta)] += step

    return control(apply)


def swapped(theta: np.ndarray) -> None:
    i, j = at_bound(theta), idle(theta)
    theta[[i, j]] = theta[[j, i]]


def scaled(factor: float) -> Change:
    def apply(theta: np.ndarray) -> None:
        theta *= factor

    return control(apply)


DECISION: dict[str, tuple[str, Change]] = {
    "the control is 1e-6 higher on a piece at the bound": ("known", moved(at_bound, 1e-6)),
    "the control is 1e-6 lower on a piece at the bound": ("known", moved(at_bound, -1e-6)),
    "the control is 1e-6 higher on a piece between": ("known", moved(between, 1e-6)),
    "the control is 1e-6 lower on a piece between": ("known", moved(between, -1e-6)),
    "the control is 1e-6 higher on an idle piece": ("known", moved(idle, 1e-6)),
    "the control is 1e-6 lower on an idle piece": ("known", moved(idle, -1e-6)),
    "the control is out of its bounds": ("known", moved(at_bound, -0.5)),
    "two pieces of the control are swapped": ("known", control(swapped)),
    "the control is a thousandth larger": ("known", scaled(1.001)),
    "the control is a thousandth smaller": ("known", scaled(0.999)),
    "the control is a millionth smaller": ("one parameter", scaled(1 - 1e-6)),
    "there is no control at all": ("known", scaled(0.0)),
    "the control is played backwards": (
        "known",
        control(lambda theta: theta.__setitem__(slice(None), theta[::-1].copy())),
    ),
    "a coefficient of a Walsh function is 1e-5 higher": (
        "walsh",
        lambda files: files.certificate.update(decision=[[files.decision[0][0] + 1e-5, *files.decision[0][1:]]]),
    ),
    "the control is outside a round set, by numbers that cancel": (
        "rounded",
        lambda files: (
            files.certificate.update(decision=[[5.0, 0, 0, 0], [0.1, 1e-40, 0, 0]], cost=5.1, status="verified"),
            files.problem.update(control={"norm": {"p": 1.5, "radius": 1.0, "centre": [0, 0.1]}}),
        ),
    ),
    "a tiny control falls short of a tiny set": (
        "tiny",
        lambda files: (scaled(1 - 6e-4)(files), files.proof("terminal").update(tolerance=1e-9)),
    ),
}
FIGURES: dict[str, tuple[str, Change]] = {
    "the cost is lower": ("known", times("cost", 1 - 1e-9)),
    "the cost is higher": ("known", times("cost", 1 + 1e-9)),
    "a tiny cost is lower": ("tiny", times("cost", 1 - 5e-6)),
    "the lower bound is higher": ("tiny", times("lower_bound", 1 + 1e-9)),
    "the lower bound is as high as the cost": (
        "known",
        lambda files: files.certificate.update(lower_bound=files.certificate["cost"]),
    ),
    "the lower bound is missing": ("known", entry(lower_bound=None)),
    "the lower bound is infinite": ("known", entry(lower_bound=math.inf)),
    "what is certified has a wide gap": ("known", times("lower_bound", 0.999)),
    "what is refuted is called verified": ("refuted", entry(status="verified")),
    "what is refuted is called certified, with proofs": (
        "refuted",
        lambda files: files.certificate.update(
            status="certified",
            proof={
                "path": {"tolerance": 1e-9, "lower": [[0.3]], "upper": [[5.0]]},
                "terminal": {"tolerance": 1e-9, "lower": [[5.0]], "upper": [[5.0]]},
            },
        ),
    ),
    "what is refuted is called certified, parameters and all": (
        "refuted parameter",
        entry(
            status="certified", proof={"terminal": {"tolerance": 1e-9, "lower": [[1.0, 0.5]], "upper": [[1.0, 1.0]]}}
        ),
    ),
    "what is infeasible is called certified": ("infeasible", entry(status="certified")),
    "what is infeasible is called certified, with a control": (
        "infeasible",
        entry(
            status="certified",
            decision=[[0.0] * 20],
            cost=0.0,
            lower_bound=0.0,
            proof={"terminal": {"tolerance": 1e-9, "lower": [[2.0]], "upper": [[2.0]]}},
        ),
    ),
    "what is certified is called infeasible": (
        "known",
        entry(status="infeasible", cost=None, decision=None, lower_bound=None),
    ),
    "what is certified is called refuted": ("known", entry(status="refuted")),
    "what is certified is called refuted, by a witness that is none": (
        "one parameter",
        entry(
            status="refuted",
            witness={
                "constraint": "terminal",
                "time": 1.0,
                "parameter": [0.5],
                "direction": [1.0],
                "disturbance": None,
                "violation": 1e-8,
            },
        ),
    ),
    "a rounding is called a violation, by a long direction": (
        "integrator",
        lambda files: (
            scaled(1 - 2.5e-10 / 1.5)(files),
            files.certificate.update(
                status="refuted",
                lower_bound=1.4,
                witness={
                    "constraint": "terminal",
                    "time": 1.0,
                    "parameter": [],
                    "direction": [1e6],
                    "disturbance": None,
                    "violation": 2.5e-4,
                },
            ),
        ),
    ),
    "the status is a word of its own": ("known", entry(status="proven")),
    "the format is another one": ("known", entry(format=2)),
    "the format is missing": ("known", lambda files: files.certificate.pop("format")),
}
MULTIPLIERS: dict[str, tuple[str, Change]] = {
    "a multiplier has the other sign": (
        "known",
        lambda files: files.heaviest.update(multiplier=-files.heaviest["multiplier"]),
    ),
    "a multiplier is a tenth larger": (
        "known",
        lambda files: files.heaviest.update(multiplier=1.1 * files.heaviest["multiplier"]),
    ),
    "a multiplier is a tenth smaller": (
        "known",
        lambda files: files.heaviest.update(multiplier=0.9 * files.heaviest["multiplier"]),
    ),
    "a multiplier is zero": ("known", heaviest(multiplier=0.0)),
    "a multiplier is huge": ("known", heaviest(multiplier=1e300)),
    "a multiplier is infinite": ("known", heaviest(multiplier=math.inf)),
    "a multiplier is not a number": ("known", heaviest(multiplier=math.nan)),
    "a multiplier is moved to an earlier time": (
        "known",
        lambda files: files.constraints[-1].update(time=files.constraints[-1]["time"] - 0.02),
    ),
    "a multiplier is moved out of its window": ("known", lambda files: files.constraints[-1].update(time=0.3 - 1e-9)),
    "a multiplier is moved past the horizon": ("known", heaviest(time=math.nextafter(5.0, 6.0))),
    "a direction is turned round": (
        "known",
        lambda files: files.heaviest.update(direction=[-c for c in files.heaviest["direction"]]),
    ),
    "a direction is tilted": ("known", heaviest(direction=[0.01, 1.0])),
    "a direction is longer": ("known", heaviest(direction=[0.0, 1.1])),
    "a direction points where the set is unbounded": (
        "known",
        lambda files: files.constraints[-1].update(direction=[1.0, 1e-9]),
    ),
    "a direction is zero": ("known", heaviest(direction=[0.0, 0.0])),
    "a direction of a curved set is tilted": (
        "ellipsoidal",
        lambda files: files.heaviest.update(direction=files.heaviest["direction"][::-1]),
    ),
    "a parameter is outside its set": ("one parameter", heaviest(parameter=[math.nextafter(0.5, 0.0)])),
    "a parameter is another one": ("one parameter", heaviest(parameter=[0.6])),
    "a constraint is given another name": ("known", lambda files: files.constraints[-1].update(constraint="terminal")),
    "a constraint is given the control's name": ("known", heaviest(constraint="control")),
    "a constraint is unknown": ("known", heaviest(constraint="terminal[7]")),
    "a multiplier is dropped": ("known", lambda files: files.constraints.remove(files.heaviest)),
    "a multiplier is written twice": ("known", lambda files: files.constraints.append(files.heaviest)),
    "a multiplier of an infeasible problem is dropped": ("infeasible", lambda files: files.constraints.pop()),
    "a multiplier of an infeasible problem has the other sign": ("infeasible", heaviest(multiplier=-1.0)),
    "a multiplier of an infeasible problem is a third of what it was": ("infeasible", heaviest(multiplier=1 / 3)),
    "the disturbance that made a problem infeasible is small": (
        "infeasible",
        problem(disturbance={"box": [0.0, 0.01]}),
    ),
    "the multiplier of an equality is larger": (
        "minimum attention",
        lambda files: files.multipliers.update(equalities=[1.1 * nu for nu in files.multipliers["equalities"]]),
    ),
    "the multiplier of an equality is missing": (
        "minimum attention",
        lambda files: files.multipliers.update(equalities=[]),
    ),
    "a multiplier of the control's pieces is larger": (
        "walsh",
        lambda files: files.multipliers["pieces"][0].__setitem__(0, files.multipliers["pieces"][0][0] + 0.1),
    ),
    "the multipliers of the control's pieces are in another order": (
        "walsh",
        lambda files: files.multipliers.update(pieces=[row[::-1] for row in files.multipliers["pieces"]]),
    ),
    "there are no multipliers": ("known", entry(multipliers=None)),
}


def cells(
    run: str, change: Callable[[list[list[float]], list[list[float]]], object], name: str = "path"
) -> tuple[str, Change]:
    return run, lambda files: change(files.proof(name)["lower"], files.proof(name)["upper"])


def replaced(rows: list[list[float]], place: int, value: float, axis: int = 0) -> None:
    rows[place][axis] = value


PROOF: dict[str, tuple[str, Change]] = {
    "a cell is dropped": cells("known", lambda a, b: (a.pop(7), b.pop(7))),
    "the first cell is dropped": cells("known", lambda a, b: (a.pop(0), b.pop(0))),
    "the last cell is dropped": cells("known", lambda a, b: (a.pop(), b.pop())),
    "a cell is wider": cells("known", lambda a, b: replaced(b, 7, b[7][0] + 1e-9)),
    "a cell is narrower": cells("known", lambda a, b: replaced(b, 7, math.nextafter(b[7][0], 0.0))),
    "a cell reaches past the horizon": cells("known", lambda a, b: replaced(b, -1, 6.0)),
    "a cell is written twice": cells("known", lambda a, b: (a.append(a[7]), b.append(b[7]))),
    "a cell is moved": cells("known", lambda a, b: (replaced(a, 7, a[7][0] + 0.01), replaced(b, 7, b[7][0] + 0.01))),
    "a cell is turned round": cells("known", lambda a, b: (a.__setitem__(7, b[7]), b.__setitem__(7, a[7]))),
    "a cell is not a number": cells("known", lambda a, b: replaced(a, 7, math.nan)),
    "a cell is infinite": cells("known", lambda a, b: replaced(b, 7, math.inf)),
    "a cell has too many coordinates": cells(
        "known", lambda a, b: ([row.append(0.0) for row in a], [row.append(0.0) for row in b])
    ),
    "a cell leaves out parameters": cells("one parameter", lambda a, b: replaced(a, 0, 0.6, 1), "terminal"),
    "the cells of one direction are dropped": (
        "ellipsoidal",
        lambda files: files.certificate["proof"].update(
            terminal={
                "tolerance": 1e-9,
                "lower": [row for row in files.proof("terminal")["lower"] if row[1] > -1.0],
                "upper": [
                    row
                    for row, low in zip(files.proof("terminal")["upper"], files.proof("terminal")["lower"], strict=True)
                    if low[1] > -1.0
                ],
            }
        ),
    ),
    "the cells are those of another constraint": (
        "known",
        lambda files: files.certificate["proof"].update(path=files.proof("terminal")),
    ),
    "there are no cells": ("known", lambda files: files.proof("path").update(lower=[], upper=[])),
    "there is no proof of a constraint": ("known", lambda files: files.certificate["proof"].pop("path")),
    "there are no proofs": ("known", entry(proof={})),
    "a tolerance is a millionth": ("known", lambda files: files.proof("path").update(tolerance=1e-6)),
    "a tolerance is zero": ("known", lambda files: files.proof("path").update(tolerance=0.0)),
    "a tolerance is negative": ("known", lambda files: files.proof("path").update(tolerance=-1e-9)),
    "a tolerance is not a number": ("known", lambda files: files.proof("path").update(tolerance=math.nan)),
}


CONFIG: dict[str, tuple[str, Change]] = {
    "the disturbance is larger": ("known", problem(disturbance={"box": [0.05 + 1e-5, 0.05]})),
    "the disturbance is smaller": ("known", problem(disturbance={"box": [0.05 - 1e-5, 0.05]})),
    "there is no disturbance": ("known", problem(disturbance=None)),
    "the disturbance is of another class": ("known", problem(disturbance_class="measurable")),
    "a parameter reaches further": ("one parameter", system(parameters={"p1": [0.5 - 1e-6, 1.0]})),
    "a parameter reaches less far": ("one parameter", system(parameters={"p1": [0.5 + 1e-6, 1.0]})),
    "the bounds of a parameter are another's": (
        "two parameters",
        system(parameters={"p1": [-0.02, 0.02], "p2": [-0.02, 0.03]}),
    ),
    "the path window starts earlier": ("known", problem(path=[{"box": [0.7, None], "from": 0.29}])),
    "the path window starts later": ("known", problem(path=[{"box": [0.7, None], "from": 0.31}])),
    "the path window starts earlier, and so do the cells": (
        "known",
        lambda files: (
            problem(path=[{"box": [0.7, None], "from": 0.0}])(files),
            replaced(files.proof("path")["lower"], 0, 0.0),
        ),
    ),
    "the path set is smaller": ("known", problem(path=[{"box": [0.7 - 1e-6, None], "from": 0.3}])),
    "the path set is larger": ("known", problem(path=[{"box": [0.7 + 1e-6, None], "from": 0.3}])),
    "the terminal set is smaller": ("known", problem(terminal=[{"box": [0.3, 0.3 - 1e-6]}])),
    "the terminal set is larger": ("known", problem(terminal=[{"box": [0.3, 0.3 + 1e-6]}])),
    "the horizon is longer": ("known", problem(horizon=5.001)),
    "the initial state is another one": ("known", problem(initial_state=[-1 - 1e-6, 1])),
    "the weights are smaller": ("known", problem(weights=[0.999])),
    "the control's bound is smaller": ("known", problem(control={"box": 1.0 - 1e-6})),
    "the control's bound is larger": ("known", problem(control={"box": 1.001})),
    "the rate's bound is smaller": ("minimum attention", problem(rate={"box": 1.5})),
    "an entry of A is 1e-6 larger": ("known", system(A=[[0, 1], [-2 + 1e-6, -0.5]])),
    "an entry of A is 1e-6 smaller": ("known", system(A=[[0, 1], [-2 - 1e-6, -0.5]])),
    "an entry of B is larger": ("known", system(B=[[0], [1 + 1e-6]])),
    "an entry of B is smaller": ("known", system(B=[[0], [1 - 1e-6]])),
    "the disturbance enters differently": ("known", system(E=[[1, 0.001], [0, 1]])),
    "an expression is another one": ("one parameter", system(A=[["-p1 - 0.01*sin(p1)"]])),
    "the dictionary is another one": (
        "walsh",
        lambda files: files.config["dictionaries"].update(control={"name": "haar", "pieces": 32, "functions": 16}),
    ),
    "the pieces of the dictionary are others": (
        "known",
        lambda files: files.config["dictionaries"].update(
            control={"name": "piecewise_constant", "breakpoints": [0.0, *(np.arange(1, 40) / 8 + 1e-4).tolist(), 5.0]}
        ),
    ),
    "the disturbance changes more often": (
        "known",
        lambda files: files.config["dictionaries"].update(disturbance={"name": "piecewise_constant", "pieces": 80}),
    ),
    "the gap is to be smaller": ("known", lambda files: files.config["method"].update(tolerance=1e-12)),
    "the gap is to be smaller, and the certificate says so": (
        "known",
        lambda files: (files.config["method"].update(tolerance=1e-12), files.certificate.update(gap_tolerance=1e-12)),
    ),
    "the gap may be larger, in the certificate": (
        "known",
        lambda files: (files.certificate.update(gap_tolerance=1e-2), times("lower_bound", 0.999)(files)),
    ),
    "the fixed state is reached by the disturbance": ("equality", system(E=[[1], [0], [0.5]])),
    "the fixed state depends on a parameter": ("equality", system(A=[[0, 1, 0], ["-2 + p1", -0.5, 0], [0, 0, "p1"]])),
    "the fixed state depends on the cube of a parameter": (
        "equality",
        system(A=[[0, 1, 0], ["-2 + p1", -0.5, 0], [0, 0, "p1**3"]]),
    ),
    "a state is fixed elsewhere": ("equality", problem(terminal=[{"equals": [None, None, 1e-6]}])),
    "numbers grow beyond what can be held": (
        "growth",
        lambda files: (
            system(A=[[705.0]])(files),
            problem(disturbance={"box": {"lower": [1e6, 1e6], "upper": [2e6, 2e6]}})(files),
        ),
    ),
    "the system is another one": ("ellipsoidal", system(A=[[0, 1], [-1, -0.101]])),
    "the terminal ellipsoid is smaller": (
        "ellipsoidal",
        problem(terminal=[{"ellipsoid": {"centre": [0, 0], "shape": [[0.3599, 0], [0, 0.25]]}}]),
    ),
}


def witness(**changes: Any) -> Change:
    return lambda files: files.certificate["witness"].update(changes)


def signal(files: Forgery) -> np.ndarray:
    return np.array(files.certificate["witness"]["disturbance"])


WITNESS: dict[str, tuple[str, Change]] = {
    "the disturbance is outside its set": (
        "refuted",
        lambda files: witness(disturbance=(signal(files) * (1 + 1e-12)).tolist())(files),
    ),
    "the disturbance is nothing": ("refuted", lambda files: witness(disturbance=(signal(files) * 0).tolist())(files)),
    "the disturbance is turned round": ("refuted", lambda files: witness(disturbance=(-signal(files)).tolist())(files)),
    "the disturbance is not given": ("refuted", witness(disturbance=None)),
    "the disturbance has pieces of its own": (
        "refuted",
        lambda files: witness(disturbance=np.repeat(signal(files), 2, axis=1).tolist())(files),
    ),
    "the violation is larger": (
        "refuted",
        lambda files: witness(violation=1.001 * files.certificate["witness"]["violation"])(files),
    ),
    "the violation is smaller": (
        "refuted",
        lambda files: witness(violation=0.999 * files.certificate["witness"]["violation"])(files),
    ),
    "the time is another one": ("refuted", witness(time=4.0)),
    "the time is past the horizon": ("refuted", witness(time=6.0)),
    "the direction is turned round": (
        "refuted",
        lambda files: witness(direction=[-c for c in files.certificate["witness"]["direction"]])(files),
    ),
    "the direction is zero": ("refuted", witness(direction=[0.0, 0.0], violation=0.0)),
    "the constraint is another one": ("refuted", witness(constraint="path")),
    "the constraint is unknown": ("refuted", witness(constraint="door")),
    "the parameter of a witness is outside": ("refuted parameter", witness(parameter=[0.4])),
    "the parameter of a witness is another one": (
        "refuted parameter",
        lambda files: witness(parameter=[1.5 - files.certificate["witness"]["parameter"][0]])(files),
    ),
    "there is no witness": ("refuted", entry(witness=None)),
}
NONSENSE: dict[str, Any] = {
    "null": None,
    "text": "1.0",
    "true": True,
    "a nested list": [[[1.0]]],
    "a mapping": {"a": 1},
    "a huge number": 10**400,
    "infinity": math.inf,
    "nothing": [],
}
PLACES: dict[str, tuple[str, Callable[[Forgery], Any], str]] = {
    **{
        key: ("integrator", lambda files: files.certificate, key)
        for key in ("format", "status", "cost", "lower_bound", "decision", "multipliers", "proof", "gap_tolerance")
    },
    **{
        key: ("integrator", lambda files: files.heaviest, key)
        for key in ("constraint", "time", "direction", "multiplier")
    },
    "multiplier's parameter": ("one parameter", lambda files: files.heaviest, "parameter"),
    "multipliers.constraints": ("integrator", lambda files: files.multipliers, "constraints"),
    "multipliers.equalities": ("minimum attention", lambda files: files.multipliers, "equalities"),
    "multipliers.pieces": ("walsh", lambda files: files.multipliers, "pieces"),
    "proof.terminal": ("integrator", lambda files: files.certificate["proof"], "terminal"),
    **{
        f"proof.{key}": ("integrator", lambda files: files.proof("terminal"), key)
        for key in ("tolerance", "lower", "upper")
    },
    "witness": ("refuted", lambda files: files.certificate, "witness"),
    **{
        f"witness.{key}": ("refuted parameter", lambda files: files.certificate["witness"], key)
        for key in ("constraint", "time", "parameter", "direction", "violation")
    },
    "witness.disturbance": ("refuted", lambda files: files.certificate["witness"], "disturbance"),
}


def put(holder: Callable[[Forgery], Any], key: str, value: Any) -> Change:
    return lambda files: holder(files).__setitem__(key, value)


NONSENSICAL: dict[str, tuple[str, Change]] = {
    f"{place} is {name}": (run, put(holder, key, value))
    for place, (run, holder, key) in PLACES.items()
    for name, value in NONSENSE.items()
}


def stored(change: Callable[[dict[str, np.ndarray]], object]) -> Change:
    def apply(files: Forgery) -> None:
        with np.load(files.directory / "solution.npz") as solution:
            arrays = {**solution}
        change(arrays)
        np.savez_compressed(files.directory / "solution.npz", **arrays)  # type: ignore[arg-type]

    return apply


def as_bytes(change: Callable[[bytes], bytes]) -> Change:
    def apply(files: Forgery) -> None:
        file = files.directory / "solution.npz"
        file.write_bytes(change(file.read_bytes()))

    return apply


FILES: dict[str, tuple[str, Change]] = {
    "the stored control is another one": (
        "known",
        stored(lambda arrays: arrays.update(control=arrays["control"] + 1e-6)),
    ),
    "the stored coefficients are others": (
        "known",
        stored(lambda arrays: arrays.update(theta=arrays["theta"] + 1e-15)),
    ),
    "the stored breakpoints are others": (
        "known",
        stored(lambda arrays: arrays.update(breakpoints=arrays["breakpoints"] * 1.001)),
    ),
    "the stored control is missing": ("known", stored(lambda arrays: arrays.pop("control"))),
    "the stored control is an object": (
        "known",
        stored(lambda arrays: arrays.update(control=np.array([{}], dtype=object))),
    ),
    "the stored control is text": (
        "known",
        stored(lambda arrays: arrays.update(control=arrays["control"].astype(str))),
    ),
    "the stored control is of another shape": (
        "known",
        stored(lambda arrays: arrays.update(control=arrays["control"][:, :7])),
    ),
    "the solution is truncated": ("known", as_bytes(lambda content: content[: len(content) // 2])),
    "the solution is empty": ("known", as_bytes(lambda _: b"")),
    "the solution is pickled": ("known", as_bytes(lambda _: pickle.dumps({"theta": 1}))),
    "the solution is text": ("known", as_bytes(lambda _: b"theta")),
    "the solution is missing": ("known", lambda files: (files.directory / "solution.npz").unlink()),
    "the upper bound of the result is lower": (
        "known",
        lambda files: files.result.update(upper_bound=files.result["upper_bound"] - 1e-9),
    ),
    "the lower bound of the result is higher": (
        "known",
        lambda files: files.result.update(lower_bound=files.result["lower_bound"] + 1e-10),
    ),
    "the cost of the result is lower": ("known", lambda files: files.result.update(cost=files.result["cost"] - 1e-9)),
    "the gap of the result is none": ("known", lambda files: files.result.update(gap=0.0)),
    "the gap of the result is not a number": ("known", lambda files: files.result.update(gap=math.nan)),
    "the status of the result is another one": ("refuted", lambda files: files.result.update(status="certified")),
    "the result claims a cost where nothing is feasible": (
        "infeasible",
        lambda files: files.result.update(cost=0.5, upper_bound=0.5),
    ),
    "the result is about another config": ("known", lambda files: files.result.update(config="00000000")),
    "the certificate is about another config": ("known", lambda files: files.certificate.update(config="00000000")),
    "the stored decision is another one": (
        "known",
        stored(lambda arrays: arrays.update(decision=arrays["decision"] + 1e-15)),
    ),
    "the stored worst disturbance is another one": (
        "refuted",
        stored(lambda arrays: arrays.update(worst_disturbance=-arrays["worst_disturbance"])),
    ),
    "the seed of the result is another one": ("known", lambda files: files.result.update(seed=7)),
    "the title of the result is another one": ("known", lambda files: files.result.update(title="Certified by nobody")),
    "the result acts less often": (
        "known",
        lambda files: files.result["sparsity"].update(
            active_fraction=files.result["sparsity"]["active_fraction"] - 0.01
        ),
    ),
    "the result says that more is needed": (
        "known",
        lambda files: files.result["sparsity"]["fewest_active"].update(
            lower=files.result["sparsity"]["fewest_active"]["lower"] + 0.02
        ),
    ),
    "result and certificate say that more is needed": (
        "known",
        lambda files: [
            said.update(lower=files.certificate["fewest_active"]["upper"])
            for said in (files.result["sparsity"]["fewest_active"], files.certificate["fewest_active"])
        ],
    ),
    "result and certificate say that less suffices": (
        "known",
        lambda files: [
            said.update(upper=said["upper"] - 0.02)
            for said in (files.result["sparsity"]["fewest_active"], files.certificate["fewest_active"])
        ],
    ),
    "a refuted control is said to suffice": (
        "refuted",
        lambda files: [
            said.update(upper=1.0)
            for said in (files.result["sparsity"]["fewest_active"], files.certificate["fewest_active"])
        ],
    ),
    "the result switches less often": (
        "known",
        lambda files: files.result["sparsity"].update(switches=files.result["sparsity"]["switches"] - 1),
    ),
    "the worst violation is smaller": ("known", lambda files: files.result["worst"].update(violation=-0.1)),
    "the worst violation is that of another constraint": (
        "known",
        lambda files: files.result["worst"].update(constraint="door"),
    ),
    "the worst violation is at a time outside": ("known", lambda files: files.result["worst"].update(time=6.0)),
    "the worst violation is another than the witness shows": (
        "refuted",
        lambda files: files.result["worst"].update(violation=1e-12),
    ),
    "the worst parameter is another than the witness shows": (
        "refuted parameter",
        lambda files: files.result["worst"].update(parameter=[1.5 - files.result["worst"]["parameter"][0]]),
    ),
    "the largest cost of the result is larger": (
        "known",
        lambda files: files.result.update(cost_scale=files.result["cost_scale"] * (1 + 1e-6)),
    ),
    "the seed of the result is a truth value": ("known", lambda files: files.result.update(seed=False)),
    "the stored decision is missing": ("known", stored(lambda arrays: arrays.pop("decision"))),
    "the stored decision is of another shape": (
        "known",
        stored(lambda arrays: arrays.update(decision=arrays["decision"].reshape(1, -1))),
    ),
    "the result is empty": ("known", lambda files: files.result.clear()),
}
KINDS = {**DECISION, **FIGURES, **MULTIPLIERS, **PROOF, **CONFIG, **WITNESS}
