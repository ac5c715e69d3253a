"""Solvers of qpsolvers behind this package's `Solver`; for each of them, a class whose options are its own settings.

`__getattr__` makes the class of a solver when it is first asked for, here by name: ``through:osqp``.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from difflib import get_close_matches
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias

import numpy as np
from pydantic import ConfigDict, Field, PrivateAttr, create_model, field_validator, model_serializer, model_validator

import sparserob_core as sr
from sparserob_qpsolvers.catalogue import SOLVERS, Known

if TYPE_CHECKING:
    from scipy.sparse import csc_array

MEASURES = re.compile("eps|tol|iter")  # in the name of a tolerance or of a number of iterations
UNKNOWN = Known("", "a solver that came to qpsolvers later", {}, {})
Duals: TypeAlias = tuple[sr.Array, sr.Array, sr.Array]


class Through(sr.Solver, sr.Options):
    """Solver of qpsolvers. Settings that are not given keep the solver's own defaults, but for its tolerances, which
    follow the accuracy that is asked of it."""

    model_config = ConfigDict(use_attribute_docstrings=False)  # there is no source of a class that is made here

    sparse: ClassVar[bool] = True
    called: ClassVar[str]

    @model_serializer(mode="wrap")
    def _only_what_was_given(self, plain: Callable[[Any], Mapping[str, Any]]) -> dict[str, Any]:
        return {key: value for key, value in plain(self).items() if key in self.model_fields_set and value is not None}

    def solve(self, program: sr.QuadraticProgram, accuracy: float) -> sr.Claim:
        settings = {key: getattr(self, key) for key in self.model_fields_set}
        return claimed(
            self.called, program, accuracy, {key: value for key, value in settings.items() if value is not None}
        )


class Unchecked(Through):
    """Solver that does not say what its settings are: all that is given is passed on."""

    model_config = ConfigDict(extra="allow")


class Qpsolvers(sr.Solver, sr.Options):
    """Solver of qpsolvers by name, any that it finds, native adapter or not. Importing qpsolvers imports every solver
    that is installed."""

    model_config = ConfigDict(extra="allow")

    solver: str = Field(min_length=1)
    """Name of the solver in qpsolvers, such as ``piqp``; further keys are its own settings."""

    _chosen: Through = PrivateAttr()

    @property
    def delegate(self) -> str:
        """Name of the solver that was chosen."""
        return self.solver

    @property
    def aborts(self) -> bool:  # type: ignore[override]
        """True where the solver that was chosen ends the process on some programs."""
        return self._chosen.aborts

    @field_validator("solver")
    @classmethod
    def _is_there(cls, name: str) -> str:
        _require(name)
        return name

    @model_validator(mode="after")
    def _choose(self) -> Qpsolvers:
        settings = dict(self.model_extra or {})
        kind = _class_of(self.solver)
        unknown = () if issubclass(kind, Unchecked) else settings.keys() - kind.model_fields.keys()
        for key in sorted(unknown):
            nearest = get_close_matches(key, kind.model_fields, 1, 0.0)
            hint = f"; the nearest is {nearest[0]!r}" if nearest else ", which has no settings"
            raise sr.InputError(f"there is no setting {key!r} of {self.solver}{hint}")
        self._chosen = kind(**settings)
        return self

    def solve(self, program: sr.QuadraticProgram, accuracy: float) -> sr.Claim:
        return self._chosen.solve(program, accuracy)


def claimed(name: str, program: sr.QuadraticProgram, accuracy: float, given: Mapping[str, Any]) -> sr.Claim:
    """Return the claim of qpsolvers' solver of that name about a program."""
    import qpsolvers

    _require(name)
    solver = SOLVERS.get(name, UNKNOWN)
    settings = {
        **solver.fixed,
        **{key: factor * accuracy for key, factor in solver.asked.items()},
        **_own(solver, given),
    }
    problem, recover = _posed(program, dense=name not in qpsolvers.sparse_solvers)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            solution = _apart(partial(qpsolvers.solve_problem, problem, name, **settings), solver)
        except (
            qpsolvers.exceptions.QPError,
            ValueError,
            ArithmeticError,
            RuntimeError,
            np.linalg.LinAlgError,
        ) as error:
            no_values = np.full(program.q.size, np.nan)
            return sr.Claim("failed", no_values, 0 * program.h, 0 * program.b, no_values, f"{name}: {error}")
    outcome = _status(solution.extras)
    # Whether a program is infeasible qpsolvers does not say; where it is, the elastic program will prove it.
    status: Literal["solved", "failed"] = "solved" if solution.found else "failed"
    z, y, z_box = recover(solution)
    claim = sr.Claim(status, _vector(solution.x, program.q.size), z, y, z_box, f"{name}: {outcome or status}")
    return claim.judged(program, accuracy)


def _apart(solve: Callable[[], Any], known: Known) -> Any:
    """Return the answer of the solver; one with a scheduler of threads (HiGHS) is asked in a new thread. Each thread
    has a scheduler of its own, which refuses every number of threads but the one with which it was begun."""
    if not known.scheduler:
        return solve()
    with ThreadPoolExecutor(1) as thread, sr.silent():
        return thread.submit(solve).result()


def _require(name: str) -> None:
    """Raise `UnknownPluginError` for a solver that qpsolvers does not find."""
    import qpsolvers

    if name not in qpsolvers.available_solvers:
        raise sr.UnknownPluginError(
            f"qpsolvers {qpsolvers.__version__} finds no solver {name!r}; it finds "
            + ", ".join(qpsolvers.available_solvers)
        )


def _posed(program: sr.QuadraticProgram, dense: bool) -> tuple[Any, Callable[[Any], Duals]]:
    """Return the program as qpsolvers takes it, and a function that recovers the multipliers ``z, y, z_box``.

    Where every bound is finite and leaves room, bounds stay bounds. Otherwise they become rows, those of a variable
    with a single value an equality: some solvers make rows of infinite bounds, or have no interior between equal ones.
    """
    from qpsolvers import Problem
    from scipy.sparse import csc_matrix, eye_array, vstack

    n, r, e = program.q.size, program.h.size, program.b.size
    lower, upper = program.lower, program.upper
    is_fixed = lower == upper
    keeps_bounds = bool(np.isfinite(lower).all() and np.isfinite(upper).all() and not is_fixed.any())
    G, h, A, b = program.G, program.h, program.A, program.b
    bounded_above, bounded_below = (np.flatnonzero(np.isfinite(bound) & ~is_fixed) for bound in (upper, lower))
    fixed_indices = np.flatnonzero(is_fixed)
    if not keeps_bounds:
        identity = eye_array(n, format="csr")
        G, h = (
            vstack([G, identity[bounded_above], -identity[bounded_below]]),
            np.concatenate([h, upper[bounded_above], -lower[bounded_below]]),
        )
        A, b = vstack([A, identity[fixed_indices]]), np.concatenate([b, lower[fixed_indices]])

    def matrix(rows: csc_array) -> Any:
        return rows.toarray(order="C") if dense else csc_matrix(rows)  # some factorise Fortran's order in place

    problem = Problem(
        matrix(program.P),
        program.q,
        matrix(G) if h.size else None,
        h if h.size else None,
        matrix(A) if b.size else None,
        b if b.size else None,
        lower if keeps_bounds else None,
        upper if keeps_bounds else None,
    )

    def recover(solution: Any) -> Duals:
        z, y = _vector(solution.z, h.size), _vector(solution.y, b.size)
        if keeps_bounds:
            return z, y, _vector(solution.z_box, n)
        z_box = np.zeros(n)
        z_box[bounded_above] = z[r : r + bounded_above.size]
        z_box[bounded_below] -= z[r + bounded_above.size :]
        z_box[fixed_indices] = y[e:]
        return z[:r], y[:e], z_box

    return problem, recover


def _vector(found: Any, size: int) -> sr.Array:
    """Return the vector that a solver has found, or NaN where it has found none of that size."""
    vector = np.asarray([] if found is None else found, dtype=float).ravel()
    return vector if vector.size == size else np.full(size, np.nan)


def _status(extras: Mapping[str, Any]) -> str:
    """Return the solver's own name of the outcome, where it gives one."""
    candidates = [extras.get("status"), getattr(extras.get("info"), "status", None), extras.get("infostring")]
    return next((str(getattr(status, "name", status)) for status in candidates if status is not None), "")


def _own(known: Known, given: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the settings as the solver takes them: names of an enumeration become its members."""
    if known.settings is None or not given:
        return given
    own = known.settings()
    return {key: _members(own[key])[value] if _members(own[key]) else value for key, value in given.items()}


def _members(default: object) -> Mapping[str, Any]:
    """Return the members of the enumeration that a default belongs to, by name; none where it is no enumeration."""
    return dict(getattr(type(default), "__members__", {}))


def _class_of(name: str) -> type[Through]:
    if name not in globals():
        globals()[name] = _made(name)
    solver_class: type[Through] = globals()[name]
    return solver_class


def _made(name: str) -> type[Through]:
    solver = SOLVERS.get(name, UNKNOWN)
    settings = None if solver.settings is None else solver.settings()
    fields: dict[str, Any] = {
        key: (_type(default, solver.flags) | None, _field(name, key, default))
        for key, default in (settings or {}).items()
        if not hasattr(Through, key)
    }
    parent: type[Through] = Unchecked if settings is None else Through
    model: Any = create_model(
        name, __base__=parent, __module__=__name__, __doc__=f"{name}, through qpsolvers.", **fields
    )
    model.called, model.aborts = name, solver.aborts
    solver_class: type[Through] = model
    return solver_class


def _type(default: object, flags: bool) -> Any:
    if _members(default):
        return Literal[tuple(_members(default))]
    if flags and isinstance(default, int) and default in {0, 1}:
        return bool | int
    return type(default) if isinstance(default, bool | int | float | str) else Any


def _field(name: str, key: str, default: object) -> Any:
    """Make the option of a setting; with ``None`` nothing is given to the solver. Its own default is shown where there
    is a way to write it. A tolerance or a number of iterations that is positive by default may not be negative: solvers
    answer that each in their own way, one with an error, one as if nothing were wrong."""
    value = getattr(default, "name", default)
    is_writable = isinstance(value, bool | int | str) or (isinstance(value, float) and np.isfinite(value))
    extra: Any = {"default": value} if is_writable else {}
    is_positive = isinstance(value, int | float) and not isinstance(value, bool) and value > 0 and MEASURES.search(key)
    lower_limit = (1 if isinstance(value, int) else 0) if is_positive else None
    return Field(default=None, ge=lower_limit, description=f"Setting of {name} itself.", json_schema_extra=extra)


def __getattr__(name: str) -> type[Through]:
    if name not in SOLVERS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _class_of(name)
