"""Minimum attention control (Brockett 1997; Nagahara and Nesic 2020): the control changes as seldom as possible.

The rate ``v = u'`` becomes the control of the augmented state ``(x, u)``, and its integral of ``|v|`` is the cost.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import final

import numpy as np
from pydantic import Field

import sparserob_core as sr


@final
class MinimumAttention(sr.LinearKeys):
    """Steer ``x' = A(p) x + B(p) u + E w + c`` with ``u(0)`` given and ``u(T) = 0``, at the least weighted integral of
    ``|u'|``."""

    rate: sr.SetOptions
    """Set that the rate ``u'`` takes its values in, bounded."""

    control: sr.SetOptions | None = None
    """Set that the control itself stays in along the whole path; no bound unless given."""

    initial_control: list[float] | float = Field(default=0.0)
    """Control at time 0, one number per control; a number serves every control."""

    def build(self) -> sr.OptimalControlProblem:
        """Build the problem of the augmented system; raises `InputError` that begins with the key at fault."""
        if self.system.delay:
            raise sr.InputError(
                path="system.delay",
                expected="none: minimum_attention makes the control a state, which acts without delay",
                got=f"{self.system.delay:g}",
            )
        original = self.system.build(self.horizon)
        d, m = original.states, original.controls
        path = [_extended_window(window, m) for window in self.windows(d)]
        ends = [sr.cylinder(end, d + m) for end in self.ends(d)]
        disturbances = self.disturbances(original, below=m)
        width = (
            sum(disturbance.set.dimension for disturbance in disturbances) if disturbances else original.disturbances
        )
        problem = sr.OptimalControlProblem(
            system=self._augmented(d, m),
            horizon=self.horizon,
            initial_state=self.initial(d) + self._initial_control(m),
            initial_set=self._deviations(d, m),
            control=self.rate.build("rate", m),
            weights=self.weights,
            disturbance=self.noise(original),
            disturbance_class=self.disturbance_class,
            disturbances=disturbances,
            path=[*path, *self._bounds(d, m)],
            integral=[_integral(f"integral.{i}", entry.build(), d, m) for i, entry in enumerate(self.integral)],
            terminal=[*ends, sr.Equality(np.append(np.full(d, np.nan), np.zeros(m)))],
            names=_names(self.names.build().fitting(d, m, width), d, m),
        )
        return replace(problem, cost=self._cost(d, m, np.asarray(problem.weights)))

    def _cost(self, d: int, m: int, weights: sr.Array) -> sr.Cost:
        """Build the cost of the augmented problem. Absolute values and norms are those of the rate; quadratic terms are
        those of the state and of the control, which is a part of it."""
        try:
            original = self.cost.build(d).checked(d, m, weights)
        except sr.InputError as error:
            raise error if error.path[:1] == ("cost",) else error.under("cost") from None
        (state, control, final), joint = original.terms, None
        if state is not None or control is not None:
            Q, r = np.zeros((d + m, d + m)), np.zeros(d + m)
            if state is not None:
                Q[:d, :d], r[:d] = state.Q, state.reference
            if control is not None:
                Q[d:, d:] = control.Q
            joint = {"Q": Q, "reference": r}
        terminal = None
        if final is not None:
            Q = np.zeros((d + m, d + m))
            Q[:d, :d] = final.Q
            terminal = {"Q": Q, "reference": np.append(final.reference, np.zeros(m))}
        return sr.Cost(l1=original.l1, group=original.group, state=joint, final=terminal)

    def _augmented(self, d: int, m: int) -> sr.System:
        """Build ``A = [[A, B], [0, 0]]``, ``B = [0; I]``, ``E = [E; 0]``, ``c = [c; 0]``, still in expressions of the
        parameters, piece by piece."""
        system = self.system
        augmented_pieces = []
        for _, until, (A, B, E, c) in system.matrices():
            drive, rows = np.eye(d).tolist() if E is None else E, [[*a, *b] for a, b in zip(A, B, strict=True)]
            augmented = {
                "A": rows + np.zeros((m, d + m)).tolist(),
                "B": np.eye(d + m, m, -d).tolist(),
                "E": drive + np.zeros((m, len(drive[0]))).tolist(),
                "c": None if c is None else [*c, *np.zeros(m).tolist()],
            }
            augmented_pieces.append(augmented if until is None else {"until": until, **augmented})
        if system.pieces is None:
            return system.model_copy(update=augmented_pieces[0]).build(self.horizon)
        pieces = [
            piece.model_copy(update=update) for piece, update in zip(system.pieces, augmented_pieces, strict=True)
        ]
        return system.model_copy(update={"pieces": pieces}).build(self.horizon)

    def _initial_control(self, m: int) -> list[float]:
        values = self.initial_control if isinstance(self.initial_control, list) else [self.initial_control] * m
        if len(values) != m:
            raise sr.InputError(f"initial_control: expected {m} numbers, one per control, got {len(values)}")
        return values

    def _deviations(self, d: int, m: int) -> sr.Box | None:
        """Build the deviations of the augmented initial state; the control at time 0 is known, so it has none."""
        deviations = self.deviations(d)
        if deviations is None:
            return None
        if not deviations.is_box:
            raise sr.InputError("initial_state: minimum_attention takes a box of initial states, got another set")
        box, fixed = deviations.bounding_box(), np.zeros(m)
        return sr.Box(np.append(box.lower, fixed), np.append(box.upper, fixed))

    def _bounds(self, d: int, m: int) -> list[sr.PathConstraint]:
        """Write the bounds of ``u`` as path constraints. They must be flat, since they act on the last coordinates of
        the state."""
        if self.control is None:
            return []
        control_set = self.control.build("control", m)
        halfspaces = control_set.halfspaces()
        if halfspaces is None:
            raise sr.InputError("control: expected a set with flat sides (box, polytope, norm with p = 1 or inf)")
        return [
            sr.PathConstraint(
                sr.Polytope(np.hstack([np.zeros((len(halfspaces[0]), d)), halfspaces[0]]), halfspaces[1]),
                name="control",
            )
        ]


def _names(given: sr.Names, d: int, m: int) -> sr.Names:
    """Name the states, which the control joins, and the controls, which are its rates."""
    control_names = [given.control(channel) for channel in range(m)]
    per = f"/{given.time}" if given.time else ""
    rates = [f"{unit}{per}" if unit and per else "" for unit in given.control_units]
    units = [*(given.state_units or [""] * d), *(given.control_units or [""] * m)]
    return sr.Names(
        states=[*(given.state(state) for state in range(d)), *control_names],
        controls=[f"{name}'" for name in control_names],
        disturbances=given.disturbances,
        state_units=units,
        control_units=rates,
        disturbance_units=given.disturbance_units,
        time=given.time,
        plane=given.plane,
    )


def _extended_window(item: sr.PathConstraint | sr.MixedConstraint, m: int) -> sr.PathConstraint:
    """Write a window of ``x``, or of ``x`` and ``u`` together, as one of the augmented state ``(x, u)``."""
    if isinstance(item, sr.MixedConstraint):
        H, G = (np.atleast_2d(np.asarray(rows, dtype=float)) for rows in (item.H, item.G))
        if len(H) != len(G) or G.shape[1] != m:
            raise sr.InputError(f"path: mixed: expected as many rows in G as in H, {m} numbers in each")
        return sr.PathConstraint(sr.Polytope(np.hstack([H, G]), np.asarray(item.h)), item.start, item.stop, item.name)
    relative_to = item.relative_to
    if relative_to is not None:
        rows = np.asarray(relative_to, dtype=float)
        relative_to = np.hstack([rows, np.zeros((len(rows), m))])
    return sr.PathConstraint(
        sr.cylinder(item.set, item.set.dimension + m), item.start, item.stop, item.name, relative_to
    )


def _integral(where: str, item: sr.IntegralConstraint, d: int, m: int) -> sr.IntegralConstraint:
    """Write an integral of ``x`` and ``u`` as one of the augmented state ``(x, u)``."""
    entries = {"H": (item.H, d, "state"), "G": (item.G, m, "control")}
    rows = {key: np.atleast_2d(np.asarray(value, dtype=float)) for key, (value, _, _) in entries.items() if value}
    for key, matrix in rows.items():
        _, width, variable = entries[key]
        if matrix.shape[1] != width:
            expected = f"rows of {width} numbers, one per {variable}"
            raise sr.InputError(path=f"{where}.{key}", expected=expected, got=f"{matrix.shape[1]} in each")
    if len({len(matrix) for matrix in rows.values()}) > 1:
        raise sr.InputError(f"{where}: expected as many rows in G as in H")
    count = max((len(matrix) for matrix in rows.values()), default=0)
    blocks = [rows.get(key, np.zeros((count, width))) for key, (_, width, _) in entries.items()]
    return replace(item, H=np.hstack(blocks) if count else None, G=None)


@sr.hookimpl
def sparserob_problems() -> Iterator[sr.ProblemPlugin]:
    """Offer ``minimum_attention``."""
    yield sr.ProblemPlugin(
        name="minimum_attention",
        factory=MinimumAttention,
        summary="Steers a linear system with a control that changes as seldom as possible.",
    )
