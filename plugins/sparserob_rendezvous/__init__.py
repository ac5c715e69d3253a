"""Rendezvous: the motion of a chaser relative to a target on a Kepler ellipse (Tschauner and Hempel 1965)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, final

import numpy as np
from pydantic import Field

import sparserob_core as sr

AXES = {"planar": ("x", "z"), "full": ("x", "y", "z")}


@final
class Orbit(sr.Options):
    """The Kepler ellipse of the target, and where on it the target is at time 0."""

    semi_major_axis: float = Field(gt=0.0, allow_inf_nan=False)
    """Half of the long axis, in m; the radius of a circle."""

    eccentricity: float = Field(default=0.0, ge=0.0, lt=1.0)
    """0 for a circle, below 1."""

    true_anomaly: float = Field(default=0.0, allow_inf_nan=False)
    """Angle from the pericentre to the target at time 0, in rad."""

    mu: float = Field(default=3.986004418e14, gt=0.0, allow_inf_nan=False)
    """Gravitational parameter of the body in the centre, in m^3/s^2; that of the Earth unless given."""

    @property
    def mean_motion(self) -> float:
        """Mean motion in radians per second."""
        return float(np.sqrt(self.mu / self.semi_major_axis**3))

    @property
    def mean_anomaly(self) -> float:
        """Mean anomaly at time 0, in rad, by way of the eccentric anomaly; of the same revolution as the true one."""
        e, half = self.eccentricity, 0.5 * np.remainder(self.true_anomaly, 2.0 * np.pi)
        E = 2.0 * np.arctan2(np.sqrt(1.0 - e) * np.sin(half), np.sqrt(1.0 + e) * np.cos(half))
        return float(E - e * np.sin(E))

    def laws(self) -> dict[str, str | float]:
        """Return expressions in ``t`` by name: ``k = mu / r^3`` and ``w``, ``dw``, the angular velocity and its
        derivative."""
        e = self.eccentricity
        return {
            "n": self.mean_motion,
            "ecc": e,
            "E": f"kepler(n * t + {self.mean_anomaly!r}, {e!r})",
            "q": "1 - ecc * cos(E)",
            "k": "n^2 / q^3",
            "w": "n * sqrt(1 - ecc^2) / q^2",
            "dw": "-2 * ecc * n * w * sin(E) / q^2",
        }


@final
class Rendezvous(sr.ControlKeys):
    """Rendezvous with a target on a Kepler ellipse, in SI units: ``x`` along its track, ``z`` to the centre, ``y``
    across the plane, ``x'' = (w^2 - k) x + w' z + 2 w z' + ux``, ``z'' = (w^2 + 2 k) z - w' x - 2 w x' + uz``,
    ``y'' = -k y + uy`` with the target's angular velocity ``w`` and ``k = mu / r^3``; on a circle Hill's equations."""

    orbit: Orbit
    """That of the target."""

    motion: Literal["planar", "full"] = "planar"
    """``planar``: states ``x, z, x', z'``, controls along ``x, z``; ``full``: ``x, y, z, x', y', z'`` and ``x, y,
    z``. A disturbance is an acceleration along the same axes, unless a list says how it enters."""

    def build(self) -> sr.OptimalControlProblem:
        """Build the problem; raises `InputError` that begins with the key at fault."""
        return self.problem(self._system(), self._names())

    def _system(self) -> sr.System:
        m = len(AXES[self.motion])
        B = np.eye(2 * m, m, -m).tolist()
        if self.orbit.eccentricity == 0.0:
            n = self.orbit.mean_motion
            return sr.LinearSystem(self._matrix(0.0, 3.0 * n * n, -n * n, 0.0, 0.0, 2.0 * n, -2.0 * n), B, B)
        A = self._matrix("w^2 - k", "w^2 + 2*k", "-k", "dw", "-dw", "2*w", "-2*w")
        return sr.VaryingSystem.of(A, B, self.horizon, B, define=self.orbit.laws())

    def _matrix(
        self,
        along: str | float,
        inward: str | float,
        across: str | float,
        raised: str | float,
        lowered: str | float,
        ahead: str | float,
        back: str | float,
    ) -> list[list[str | float]]:
        """Return ``A`` of these entries: what pulls along each axis, how ``x`` and ``z`` turn into each other, and
        Coriolis' terms."""
        if self.motion == "planar":
            return [[0, 0, 1, 0], [0, 0, 0, 1], [along, raised, 0, ahead], [lowered, inward, back, 0]]
        return [
            [0, 0, 0, 1, 0, 0],
            [0, 0, 0, 0, 1, 0],
            [0, 0, 0, 0, 0, 1],
            [along, 0, raised, 0, 0, ahead],
            [0, across, 0, 0, 0, 0],
            [lowered, 0, inward, back, 0, 0],
        ]

    def _names(self) -> sr.Names:
        """Return the names that are given, and the usual ones and SI units where none are."""
        axes, names = AXES[self.motion], self.names.build()
        states = names.states or [*axes, *(f"v{axis}" for axis in axes)]
        return sr.Names(
            states=states,
            controls=names.controls or [f"a{axis}" for axis in axes],
            disturbances=names.disturbances,
            state_units=names.state_units or [unit for unit in ("m", "m/s") for _ in axes],
            control_units=names.control_units or ["m/s^2" for _ in axes],
            disturbance_units=names.disturbance_units,
            time=names.time or "s",
            plane=names.plane or (states[0], states[len(axes) - 1]),
        )


@sr.hookimpl
def sparserob_problems() -> Iterator[sr.ProblemPlugin]:
    """Offer ``rendezvous``."""
    yield sr.ProblemPlugin(
        name="rendezvous",
        factory=Rendezvous,
        summary="Rendezvous with a target on a Kepler ellipse or circle, in SI units.",
        interface=1,
    )
