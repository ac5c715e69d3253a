"""Catalogue of the solvers that qpsolvers knows: the package of each, how it is asked for an accuracy, and where it
says what its settings are."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TypeAlias, final

Settings: TypeAlias = Mapping[str, Any]

NATIVE = frozenset({"piqp", "proxqp", "clarabel"})
"""Solvers with adapters of their own; through qpsolvers they are ``{name: qpsolvers, solver: piqp}``."""


@final
@dataclass(frozen=True)
class Known:
    """A solver of qpsolvers.

    ``package`` is what is imported and ``pip`` what brings it, if pip does. ``asked``: the settings
    that an absolute accuracy stands for, as ``{setting: factor}``; ``fixed``: settings that are always given, unless a
    user gives others. ``settings``: all that it has, with their defaults; ``None`` where it does not say: whatever is
    given then is passed on as it is. ``flags``: it writes 0 and 1 for false and true. ``aborts``: on some programs it
    ends the process. ``scheduler``: its threads are begun once in each thread that calls it, and it writes to the
    standard output.
    """

    package: str
    summary: str
    asked: Mapping[str, float]
    fixed: Settings
    settings: Callable[[], Settings] | None = None
    pip: str | None = None
    flags: bool = False
    scheduler: bool = False
    aborts: bool = False


def _attributes(place: str) -> Callable[[], Settings]:
    """Return a function that reads the settings as the attributes of what a constructor, ``package.module:Name``,
    makes."""

    def read() -> Settings:
        module, _, name = place.partition(":")
        settings = getattr(import_module(module), name)()
        return {key: getattr(settings, key) for key in _public(settings)}

    return read


def _signature(place: str, *program: str) -> Callable[[], Settings]:
    """Return a function that reads the settings as the keywords of a function, but for those that are the
    ``program``."""

    def read() -> Settings:
        import inspect

        module, _, name = place.partition(":")
        target: Any = import_module(module)
        for attribute in name.split("."):
            target = getattr(target, attribute)
        parameters = inspect.signature(target).parameters.values()
        return {
            parameter.name: parameter.default
            for parameter in parameters
            if parameter.name not in {"self", "verbose", *program}
        }

    return read


def _public(made: object) -> Iterator[str]:
    for key in dir(made):
        if not key.startswith("_") and key != "verbose" and not callable(getattr(made, key, None)):
            yield key


def _of_osqp() -> Settings:
    extension = import_module("osqp.ext_builtin")
    settings = extension.OSQPSettings()
    extension.osqp_set_default_settings(settings)
    return {key: getattr(settings, key) for key in _public(settings)}


def _of_piqp() -> Settings:
    settings = import_module("piqp").SparseSolver().settings
    return {"backend": None, **{key: getattr(settings, key) for key in _public(settings)}}


def _of_proxqp() -> Settings:
    """Read the settings of ProxQP, whose signature is text: ``name: type = default``."""
    text = str(import_module("proxsuite").proxqp.dense.solve.__doc__).partition("\n")[0]
    settings = import_module("proxsuite").proxqp.Settings()
    names = re.findall(r"(\w+): [^,=]*= ", text)
    return {"backend": None, **{key: getattr(settings, key, 0.0) for key in names if key not in {*"xyz", "verbose"}}}


_OF_THE_PROGRAM = ("H", "f", "A", "bupper", "blower", "sense", "break_points", "is_avi", "primal_start", "dual_start")
_INTERIOR = {"abstol": 1.0, "feastol": 1.0}
_OF_CVXOPT = {"maxiters": 100, "abstol": 1e-7, "reltol": 1e-6, "feastol": 1e-7, "refinement": 0, "kktreg": 0.0}
_OF_ECOS = {"max_iters": 100, "abstol_inacc": 5e-5, "reltol_inacc": 5e-5, "feastol_inacc": 1e-4}
_OF_ECOS |= dict.fromkeys(("abstol", "reltol", "feastol"), 1e-8)
_OF_SCS = {"max_iters": 100_000, "time_limit_secs": 0.0, "eps_abs": 1e-4, "eps_rel": 1e-4, "eps_infeas": 1e-7}
_OF_SCS |= dict(normalize=True, scale=0.1, adaptive_scale=True, rho_x=1e-6, alpha=1.5)  # noqa: C408  its spelling
_OF_SCS |= {"acceleration_lookback": 10, "acceleration_interval": 10}
_OF_HIGHS = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
_RELATIVE = {"eps_rel": 0.0}

SOLVERS: Mapping[str, Known] = {
    "clarabel": Known(
        "clarabel",
        "interior point on the homogeneous embedding",
        dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas", "tol_infeas_abs", "tol_infeas_rel"), 1.0),
        {"max_threads": 1},
        _attributes("clarabel:DefaultSettings"),
    ),
    "copt": Known("coptpy", "COPT, interior point and simplex; commercial", {}, {}),
    "cvxopt": Known("cvxopt", "interior point, self-scaled cones", _INTERIOR, {"reltol": 1e-12}, lambda: _OF_CVXOPT),
    "daqp": Known(
        "daqp",
        "dual active set, for small dense programs",
        {"primal_tol": 1.0, "dual_tol": 1e-3},
        {},
        _signature("daqp:solve", *_OF_THE_PROGRAM),
    ),
    "ecos": Known("ecos", "interior point for second-order cones", _INTERIOR, {"reltol": 1e-12}, lambda: _OF_ECOS),
    "gurobi": Known(
        "gurobipy",
        "Gurobi, interior point and simplex; commercial",
        {},
        {"FeasibilityTol": 1e-9, "OptimalityTol": 1e-9, "BarConvTol": 1e-12, "Threads": 1},
    ),
    "highs": Known(
        "highspy",
        "simplex, and a null-space active set where there is curvature",
        {},
        {**_OF_HIGHS, "threads": 1, "qp_iteration_limit": 5_000},
        _attributes("highspy:HighsOptions"),
        scheduler=True,
        aborts=True,
    ),
    "hpipm": Known("hpipm_python", "interior point for optimal control, dense", {}, {}, pip=""),
    "jaxopt_osqp": Known("jaxopt", "operator splitting in JAX", {"tol": 1.0}, {}),
    "kvxopt": Known("kvxopt", "interior point, a fork of CVXOPT", _INTERIOR, {"reltol": 1e-12}, lambda: _OF_CVXOPT),
    "mosek": Known("mosek", "interior point; commercial", {}, {}),
    "nppro": Known("nppro", "active set; commercial", {}, {}, pip=""),
    "osqp": Known(
        "osqp",
        "operator splitting, with a polish; a first-order method",
        {"eps_abs": 1.0},
        {**_RELATIVE, "polishing": 1, "max_iter": 20_000},
        _of_osqp,
        flags=True,
    ),
    "pdhcg": Known("pdhcg", "primal-dual hybrid conjugate gradients", {}, {}, pip=""),
    "piqp": Known(
        "piqp",
        "proximal interior point",
        {"eps_abs": 1.0, "eps_duality_gap_abs": 1.0},
        {**_RELATIVE, "eps_duality_gap_rel": 0.0},
        _of_piqp,
    ),
    "proxqp": Known(
        "proxsuite",
        "primal-dual augmented Lagrangian",
        {"eps_abs": 1.0, "eps_duality_gap_abs": 1.0},
        {**_RELATIVE, "max_iter": 200, "check_duality_gap": True, "eps_duality_gap_rel": 0.0},
        _of_proxqp,
    ),
    "pyqpmad": Known(
        "pyqpmad", "dual active set, dense", {"tolerance": 1e-2}, {}, _attributes("pyqpmad:SolverParameters")
    ),
    "qpalm": Known(
        "qpalm",
        "proximal augmented Lagrangian",
        {"eps_abs": 1.0, "eps_prim_inf": 1.0, "eps_dual_inf": 1.0},
        {**_RELATIVE, "eps_abs_in": 1e-4, "eps_rel_in": 0.0},
        _attributes("qpalm:Settings"),
        flags=True,
    ),
    "qpax": Known("qpax", "interior point in JAX", {"solver_tol": 1.0}, {}),
    "qpoases": Known("qpoases", "parametric active set, dense", {}, {}, pip=""),
    "qpswift": Known("qpSWIFT", "interior point, embedded", {}, {}, pip=""),
    "qtqp": Known(
        "qtqp",
        "interior point in Python",
        dict.fromkeys(("tol_feas", "tol_gap_abs", "tol_infeas_abs", "tol_infeas_rel"), 1.0),
        {"tol_gap_rel": 0.0},
        _signature("qtqp:QTQP.solve", "warm_start", "collect_stats"),
    ),
    "quadprog": Known("quadprog", "dual active set (Goldfarb and Idnani), dense", {}, {}, dict),
    "scs": Known(
        "scs",
        "operator splitting; a first-order method",
        {"eps_abs": 1.0},
        {**_RELATIVE, "max_iters": 20_000},
        lambda: _OF_SCS,
    ),
    "sip": Known(
        "sip_qp_python", "interior point with barriers, sparse", {"eps_abs": 1.0}, _RELATIVE, pip="sip-qp-python"
    ),
}
