"""A control that answers affinely what it has measured."""

from __future__ import annotations

from typing import Literal, final

from pydantic import Field

from sparserob_core.control.policies.policy import Policy, Quantity
from sparserob_core.options import Options


@final
class AffinePolicy(Policy, Options):
    """The state is measured at every breakpoint ``tau_j`` of the control's dictionary; the control on piece ``k`` is
    ``u_k = v_k + sum_{j <= k} M_kj e_j`` with the innovation ``e_j``: what the state at ``tau_j`` has beyond what the
    state one breakpoint before, the drift, every control in between and the middle of the disturbance's set predict;
    ``e_0`` is what ``x(0)`` has beyond the middle of the set of initial states, 0 from a single one.

    The nominal control ``v (m, K)`` and the gains ``M (K, K, m, n)`` are the decision. Every set of the problem holds
    for all disturbances with the control that they cause. For a fixed disturbance everything is linear in the decision
    (Goulart, Kerrigan and Maciejowski 2006).
    """

    cost: Literal["nominal", "peak", "worst"] = "nominal"
    """``nominal``: the L1 norm of the nominal control; ``peak``: the weighted integral of the largest ``|u_i(t)|`` that
    any disturbance causes, which is 0 exactly where the control is off whatever happens; ``worst``: the largest
    weighted integral of ``|u_i(t)|`` that any disturbance causes, enclosed from both sides."""

    among: Literal["peak"] | None = "peak"
    """Of the policies that cost no more than the proven least by half of the method's tolerance: ``peak``, one with the
    least weighted integral of the largest ``|u_i(t)|``, where gains and peaks are no more than 4000 numbers; null: any.
    Without effect on other costs, which leave no such choice."""

    memory: float | None = Field(default=None, ge=0.0)
    """An innovation is answered for so long at most, in the time unit of the problem; everything by default."""

    causal_signals: int = Field(default=40, ge=0, le=1000)
    """A bound against every causal policy is sought with a tree of the signals of the disturbance that the policy's own
    bound rests on, and so many more at most; 0: none is sought."""

    causal_seconds: float = Field(default=60.0, ge=0.0)
    """And for so long at most. The search ends much earlier, in proportion to what the policy itself took, by a count
    that is the same on every machine; where this time did end it, ``result.json`` says so."""

    @property
    def knows(self) -> frozenset[Quantity]:
        """The state, at the breakpoints."""
        return frozenset({"state"})
