"""What an inner convex solver is asked, and what it claims; nothing of it is believed before `check`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from scipy.sparse import csc_array


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """minimise ``1/2 x'P x + q'x`` subject to ``G x <= h``, ``A x = b``, ``lower <= x <= upper``; bounds may be
    infinite."""

    P: csc_array
    q: Array
    G: csc_array
    h: Array
    A: csc_array
    b: Array
    lower: Array
    upper: Array


@dataclass(frozen=True, eq=False)
class Claim:
    """What a solver says. Multipliers follow ``P x + q + G'z + A'y + z_box = 0``, ``z >= 0``, ``z_box <= 0`` at lower
    bounds."""

    status: Literal["solved", "infeasible", "failed"]
    x: Array
    z: Array
    y: Array
    z_box: Array
    message: str = ""


class Solver(ABC):
    """An inner convex solver: one quadratic program in, one claim out.

    Capabilities, declared by the adapter: ``warm_start`` (starts from its last solution), ``sparse`` (exploits sparse
    rows), ``conic`` (accepts more than linear rows).
    """

    warm_start: ClassVar[bool] = False
    sparse: ClassVar[bool] = False
    conic: ClassVar[bool] = False

    @abstractmethod
    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """Solve to the absolute residuals ``accuracy``; never raise for a program that is merely hard.

        Rows arrive with unit norm and the cost with its largest linear coefficient near 1. A claim that is not
        ``solved`` may still carry the last iterate: it is checked all the same. With ``infeasible``, ``z, y`` may carry
        the Farkas ray.
        """
