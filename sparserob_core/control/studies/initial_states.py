"""The initial state as a part of the decision: which ones can be met by a control, in a plane of two coordinates.

The state is affine in ``(theta, x(0))``, so the set of initial states from which one control satisfies every
constraint, whatever the disturbance and the parameter, is convex: the projection of a convex semi-infinite program. Its
support functions are programs again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final

import numpy as np
from scipy.sparse import block_diag, csc_array, csr_array, hstack

from sparserob_core.control.constraints.explanation import TimedExplanation
from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.transcription.own_units import fixed
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.control.transcription.rounding import ROW_ROUNDING, added_up, reduce_bound
from sparserob_core.control.transcription.transcribe import from_state
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.finite import UncertainRows
from sparserob_core.sip.program import (
    TOLERANCE,
    ConstraintFamily,
    Enclosure,
    Explanation,
    SemiInfiniteProgram,
    Separation,
)
from sparserob_core.sip.result import Result

START_PROGRAMS_KEPT = 4  # ordinary programs, each at one initial state, that are remembered


@final
@dataclass(frozen=True, eq=False)
class InitialPlane:
    """Initial states ``x(0)`` with the coordinates ``states (2,)`` at ``centre + radius z``, ``|z_i| <= 1``, the others
    as the problem has them.

    ``centre (2,)`` and ``radius (2,)`` are in the units of the states of the ``model``, which may be in its own.
    """

    model: Transcription
    states: tuple[int, int]
    centre: Array
    radius: Array
    _programs: dict[bytes, SemiInfiniteProgram] = field(default_factory=dict, repr=False)

    @cached_property
    def free(self) -> InitialPlane:
        """Plane of the same problem without prices that need variables of their own."""
        model = self.model.acting.free(self.model)
        return self if model is self.model else InitialPlane(model, self.states, self.centre, self.radius)

    def point(self, z: Array) -> Array:
        """The two coordinates ``(..., 2)`` of the initial state."""
        return np.asarray(self.centre + self.radius * z)

    def scaled(self, points: Array) -> Array:
        """The ``z (..., 2)`` of coordinates ``(..., 2)``."""
        return np.asarray((points - self.centre) / self.radius)

    def resized(self, lower: Array, upper: Array) -> InitialPlane:
        """Return the plane with the box of coordinates from ``lower (2,)`` to ``upper (2,)``."""
        return InitialPlane(self.model, self.states, (lower + upper) / 2, (upper - lower) / 2)

    def at(self, z: Array) -> SemiInfiniteProgram:
        """The ordinary program from one initial state; what does not depend on the initial state is shared by all of
        them."""
        key = z.tobytes()
        if key not in self._programs:
            program = from_state(self.centred, self._build_initial_state(z)).program
            A, b = self._build_equalities(z)
            remember(self._programs, key, replace(program, A=A, b=b), START_PROGRAMS_KEPT)
        return self._programs[key]

    def controls(self, decision: Array) -> Array:
        """Return the nominal control ``(m, K)`` of a decision of a `support`, from the initial state that ends it."""
        start = self._build_initial_state(decision[-2:])
        return from_state(self.free.centred, start).pieces(decision[:-2])

    def rounded(self, z: Array, result: Result) -> Result:
        """The result of the program at ``z`` with a lower bound that steps of a system which changes with time do not
        raise."""
        if self.model.response.propagator.expansion is None:
            return result
        mu = np.zeros(self._equality_units.size)
        mu[np.flatnonzero(self._find_needed_equalities(z))[: result.dual.mu.size]] = result.dual.mu
        ends = replace(result, dual=replace(result.dual, mu=mu / self._equality_units))  # of the states that are fixed
        bound = reduce_bound(from_state(self.centred, self._build_initial_state(z)), ends, None).lower_bound
        return replace(result, lower_bound=bound)

    def weakened(self, result: Result) -> Result:
        """Return the result of a `support` with a lower bound, or a proof of infeasibility, that holds for the true
        steps of a system that changes with time.

        Rows already contain the error of the steps. An equality of the true steps is an equality of the computed ones
        up to an error bound, from any initial state of the plane. It is thus two inequalities that are wider by this
        bound, with the same multipliers. A program whose infeasibility exceeds the error bounds, relative to the norms
        of its rows, is infeasible for the true steps too.
        """
        if self.model.response.propagator.expansion is None:
            return result
        error = sum(cut.multiplier * self._bound_row_error(cut) for cut in result.dual.cuts)
        if result.status != "infeasible":
            error += float(np.abs(result.dual.mu) @ self._equality_error_bounds[: result.dual.mu.size])
            return replace(result, lower_bound=result.lower_bound - error)
        if result.dual.bound > max(error, self._largest_error_share):
            return result
        message = "nothing seems feasible, by no more than what steps of the system may be off by"
        return replace(result, status="undecided", message=message, lower_bound=-np.inf)

    def off(self, times: Array, directions: Array, parameters: Array) -> Array:
        """Bound the error of rows ``c'x(t)``, ``directions (k, d)``, from any initial state of the plane: ``(k,)``.

        It consists of rounding errors, errors of the steps of a system that changes with time, and the remainder of its
        law's series in the parameters. It is 0 for a system that does not change with time.
        """
        response = self.centred.response
        if not response.system.varies or not times.size:
            return np.zeros(times.size)
        columns = response.weights(times, directions, parameters).free[:, list(self.states)] * self.radius
        sizes = added_up(self.centred, times, directions, parameters) + np.abs(columns).sum(axis=1)
        return np.asarray((ROW_ROUNDING + response.propagator.slack) * sizes + np.abs(directions) @ self.beyond)

    def _bound_row_error(self, cut: Cut) -> float:
        """Return the error bound of a row that holds with equality, under feedback; 0 for other rows, which are wider
        by their bound."""
        constraint = self.centred.constraint(self._centre_program.family(cut.family))
        if constraint is None or any(constraint is entry for entry in self.centred.constraints):
            return 0.0
        times, directions, parameters, _ = constraint.functionals_at(cut.index[None, :1])
        return float(self.off(times, directions, parameters)[cut.row])

    @cached_property
    def _equality_error_bounds(self) -> Array:
        """Error bounds of the equalities, in their units, ``(e,)``."""
        axes, middle = fixed(self.model.held)[0], self.model.parameters.middle
        times = np.full(axes.shape[0], self.model.problem.horizon)
        return self.off(times, axes, np.tile(middle, (times.size, 1))) / self._equality_units

    @cached_property
    def _largest_error_share(self) -> float:
        """Largest error bound of an equality as a share of the norm of its row.

        An equality without entries counts 0 where its residual exceeds the bound, and ``inf`` elsewhere.
        """
        base, errors = self._centre_program.finite, self._equality_error_bounds
        if not base.b.size:
            return 0.0
        norms = np.linalg.norm(np.hstack([base.A, self._equality_columns]), axis=1)
        empty_row_share = np.where(np.abs(base.b) > errors, 0.0, np.inf)
        return float(np.where(norms > 0.0, errors / np.where(norms > 0.0, norms, 1.0), empty_row_share).max())

    @cached_property
    def strip(self) -> float:
        """The area, in coordinates ``z``, of what is left of the plane by an equality that no control enters, up to
        what it may be off by; 0 where there is none."""
        lengths = np.linalg.norm(self._equality_columns, axis=1)
        is_pinned = ~self._centre_program.finite.A.any(axis=1) & (lengths > 0.0)
        widths = 2.0 * self._equality_error_bounds[is_pinned] / lengths[is_pinned]
        return float(2.0 * np.sqrt(2.0) * widths.max(initial=0.0))

    @cached_property
    def _equality_units(self) -> Array:
        """Divisors of the equalities, ``(e,)``."""
        count = fixed(self.model.held)[1].size
        return np.ones(count) if self.model.rows is None else self.model.rows.fixed[:count]

    def _find_needed_equalities(self, z: Array) -> np.ndarray:
        """Return which equalities ``(e,)`` the program at ``z`` has: all but those that no control enters and that hold
        there but for rounding."""
        base = self._centre_program.finite
        return np.asarray(base.A.any(axis=1) | (np.abs(base.b - self._equality_columns @ z) > TOLERANCE))

    def _build_equalities(self, z: Array) -> tuple[Array | None, Array | None]:
        """Return the matrix and the right-hand sides of the equalities of the program at ``z``, ``None`` each where
        there are none."""
        base, needed = self._centre_program.finite, self._find_needed_equalities(z)
        return (base.A[needed], (base.b - self._equality_columns @ z)[needed]) if needed.any() else (None, None)

    def support(self, direction: Array, known: Sequence[Cut] = ()) -> SemiInfiniteProgram:
        """Minimise ``-direction'z`` over all ``(theta, z)``: its value is minus the support function of the feasible
        initial states.

        ``known`` are constraints that are likely to matter: they are among the program's fixed rows, which changes
        nothing but its work; under feedback, what a method begins with.
        """
        if self.free is not self:
            return self.free.support(direction, known)
        if self.model.feedback is not None:
            return self._build_feedback_support(direction, known)
        base, finite, n = self._centre_program, self._centre_program.finite, self._centre_program.n
        G, h = self._build_rows(known)
        A = None if base.A is None else np.hstack([base.A, self._equality_columns])
        return SemiInfiniteProgram(
            n=n + 2,
            q=np.concatenate([np.zeros(n), -direction]),
            S=_append_identity(finite.S),
            lower=np.append(finite.lower, [-1.0, -1.0]),
            upper=np.append(finite.upper, [1.0, 1.0]),
            G=G,
            h=h,
            A=A,
            b=base.b,
            families=self._families,
            channels=base.channels,
        )

    def _build_feedback_support(self, direction: Array, known: Sequence[Cut]) -> SemiInfiniteProgram:
        base, finite, n = self._centre_program, self._centre_program.finite, self._centre_program.n

        def settle(x: Array) -> Array:
            settled = self.at(x[-2:]).settle
            return x if settled is None else np.append(settled(x[:-2]), x[-2:])

        return SemiInfiniteProgram(
            n=n + 2,
            q=np.concatenate([np.zeros(n), -direction]),
            lower=np.append(finite.lower, [-1.0, -1.0]),
            upper=np.append(finite.upper, [1.0, 1.0]),
            families=[_UncertainJointFamily(self, family).family(known) for family in base.families],
            channels=base.channels,
            spread=base.spread,
            settle=None if base.settle is None else settle,
        )

    @cached_property
    def ends(self) -> list[SemiInfiniteProgram]:
        """The ordinary programs where one of ``z`` is 1 and the other 0."""
        return [from_state(self.centred, self._build_initial_state(z)).program for z in np.eye(2)]

    def _build_rows(self, cuts: Sequence[Cut]) -> tuple[Array | None, Array | None]:
        if not cuts:
            return None, None
        rows = [next(f for f in self._families if f.name == cut.family).rows(cut.index[None]) for cut in cuts]
        return (
            np.stack([G[0, cut.row] for (G, _), cut in zip(rows, cuts, strict=True)]),
            np.array([h[0, cut.row] for (_, h), cut in zip(rows, cuts, strict=True)]),
        )

    @cached_property
    def _families(self) -> list[ConstraintFamily]:
        return [_JointFamily(self, family).family() for family in self._centre_program.families]

    @cached_property
    def _centre_program(self) -> SemiInfiniteProgram:
        """The ordinary program at the centre."""
        return self.centred.program

    @cached_property
    def _equality_columns(self) -> Array:
        """The columns ``(e, 2)`` of ``z`` in the equalities."""
        at_centre = self._centre_program.b
        if at_centre is None:
            return np.zeros((0, 2))
        right_hand_sides = [from_state(self.model, self._build_initial_state(z)).program.b for z in np.eye(2)]
        return np.stack([at_centre - np.asarray(b) for b in right_hand_sides], axis=1)

    @cached_property
    def centred(self) -> Transcription:
        """The problem from the centre of the plane."""
        around = np.zeros(self.model.problem.system.states)
        around[list(self.states)] = self.radius
        return from_state(self.model, self._build_initial_state(np.zeros(2)), around)

    @cached_property
    def beyond(self) -> Array:
        """Bounds ``(d,)`` of the remainder of a law's series in the parameters, for every state, from any initial state
        of the plane."""
        magnitudes = np.abs(self._build_initial_state(np.zeros(2)))
        magnitudes[list(self.states)] += np.abs(self.radius)
        control = self.model.problem.control
        reach = control.reach(np.eye(control.dimension))
        return self.centred.functionals.from_state(magnitudes).over_cells.truncation(reach)

    def _build_initial_state(self, z: Array) -> Array:
        state = np.array(self.model.problem.initial_state, dtype=float)
        state[list(self.states)] = self.point(z)
        return state


def check_states(states: object, count: int) -> tuple[int, int]:
    """Return the two different states in ``states``, counted from 0; raise `InputError` for anything else."""
    pair = tuple(states) if isinstance(states, Sequence | np.ndarray) else ()
    if len(pair) != 2 or any(isinstance(entry, bool) or not isinstance(entry, int | np.integer) for entry in pair):
        raise InputError(path="states", expected="two different states, counted from 0", got=repr(states))
    a, b = (int(entry) for entry in pair)
    if a == b or not (0 <= a < count and 0 <= b < count):
        raise InputError(
            path="states", expected=f"two different states of the {count}, counted from 0", got=f"{a} and {b}"
        )
    return a, b


@dataclass(frozen=True, eq=False)
class _PlaneFamily:
    """Family of the ordinary program with the initial state at the coordinates ``z (2,)``, which end the decision."""

    plane: InitialPlane
    base: ConstraintFamily

    def worst(self, x: Array) -> Separation:
        """The exact separation of the family at that initial state."""
        worst = self._select_family(x).worst
        assert worst is not None  # every family of a control problem has its own separation
        return worst(x[:-2])

    def enclosure(self, x: Array, lower: Array, upper: Array) -> Enclosure:
        """The enclosure of the family at that initial state."""
        enclosure = self._select_family(x).enclosure
        assert enclosure is not None
        return enclosure(x[:-2], lower, upper)

    def scale(self, x: Array) -> float:
        """The scale of the family at that initial state."""
        return self._select_family(x).allowed(x[:-2]) / TOLERANCE

    def explain(self, index: Array, row: int) -> Explanation:
        """Return the description of the constraint for a reader, without the value from the initial state, which is
        free."""
        explanation = self.plane.model.program.family(self.base.name).explanation(
            index[: self.base.index_set.dimension], row
        )
        return explanation.from_any_state() if isinstance(explanation, TimedExplanation) else explanation

    def _select_family(self, x: Array) -> ConstraintFamily:
        return self.plane.at(x[-2:]).family(self.base.name)


@final
@dataclass(frozen=True, eq=False)
class _JointFamily(_PlaneFamily):
    """Family of the ordinary program, as a family in ``(theta, z)``."""

    def family(self) -> ConstraintFamily:
        offers = self.base.enclosure is not None
        return ConstraintFamily(
            name=self.base.name,
            index_set=self.base.index_set,
            rows=self.rows,
            scale=self.scale,
            worst=self.worst,
            cells=self.base.cells,
            enclosure=self.enclosure if offers else None,
            explain=self.explain,
            row_units=self.base.row_units,
            measured=self.base.measured,
            along=self.base.along,
            index_units=self.base.index_units,
            source=self.base.source,
        )

    def rows(self, indices: Array) -> tuple[Array, Array]:
        """Return the rows at the centre with two more columns, ``c'e^{A(p)t}`` at the two coordinates.

        For a system that changes with time the rows are wider by the error bound `InitialPlane.off`, so that every
        decision that meets the true rows meets them.
        """
        G, h = self.base.rows(indices)
        constraint = self.plane.centred.constraint(self.base)
        if constraint is None:
            return np.concatenate([G, np.zeros((*G.shape[:2], 2))], axis=2), h
        times, directions, parameters, _ = constraint.functionals_at(indices)
        free = constraint.functionals.response.weights(times, directions, parameters).free
        columns = free[:, list(self.plane.states)] * self.plane.radius
        h = h + self.plane.off(times, directions, parameters).reshape(h.shape)
        return np.concatenate([G, columns.reshape(*G.shape[:2], 2)], axis=2), h


@final
@dataclass(frozen=True, eq=False)
class _UncertainJointFamily(_PlaneFamily):
    """Family of the ordinary program under feedback, as a family in ``(v, M, z)``.

    At every deviation its rows are affine in the initial state, which enters only their right-hand sides.
    """

    def family(self, known: Sequence[Cut]) -> ConstraintFamily:
        base = self.base
        assert base.start is not None
        d = base.index_set.dimension
        start_indices = [cut.index[:d] for cut in known if cut.family == base.name]
        family = ConstraintFamily(
            name=base.name,
            index_set=base.index_set,
            rows=base.rows,
            scale=self.scale,
            uncertain=self.uncertain,
            excess=self.excess,
            start=np.unique(np.vstack([base.start, *start_indices]), axis=0),
            worst=self.worst,
            cells=base.cells,
            enclosure=self.enclosure,
            explain=self.explain,
            row_units=base.row_units,
            measured=base.measured,
            along=base.along,
            index_units=base.index_units,
            source=base.source,
        )
        literal = base.literal
        return family if literal is None else replace(family, literal=replace(literal, explain=self.explain))

    def uncertain(self, index: Array) -> UncertainRows:
        """The rows at the centre, and two columns more. Of a system that changes with time they are wider by what steps
        may be off by, as without feedback, but for those that hold with equality (`InitialPlane.weakened`)."""
        at_centre, *at_ends = (
            family.uncertain for family in (self.base, *(end.family(self.base.name) for end in self.plane.ends))
        )
        assert at_centre is not None
        rows = at_centre(index)
        columns = np.stack([rows.h - at_end(index).h for at_end in at_ends if at_end is not None], axis=1)
        n = rows.g.shape[1] + 2
        padded = tuple(csr_array((C.data, C.indices, C.indptr), shape=(C.shape[0], n)) for C in rows.C)
        constraint, h = self.plane.centred.constraint(self.base), rows.h
        if constraint is not None and not rows.exact:
            h = h + self.plane.off(*constraint.functionals_at(index[None, : self.base.index_set.dimension])[:3])
        return replace(rows, g=csr_array(hstack([rows.g, csr_array(columns)])), h=h, C=padded)

    def excess(self, x: Array, indices: Array) -> Array:
        """The violations from that initial state."""
        return self._select_family(x).violations(x[:-2], indices)


def _append_identity(S: csc_array | None) -> csc_array | None:
    if S is None:
        return None
    return csc_array(block_diag([S, np.eye(2)]))
