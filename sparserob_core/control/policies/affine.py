"""A control that answers affinely what it has measured."""

from __future__ import annotations

from typing import Literal, final

import numpy as np
from pydantic import Field

from sparserob_core.control.policies.policy import Charge, InnerGain, Policy, Quantity
from sparserob_core.options import Options
from sparserob_core.sip.convex_set import Array

# Of the horizon: what is older than `memory` by less is not; ten times less and breakpoints that are sums
MEMORY_ALLOWANCE = 1e-12
# of steps fall out by rounding, ten times more and nobody would see it before pieces are as short as that


@final
class AffinePolicy(Policy, Options):
    """A policy whose control is an affine function of the innovations of the measured state.

    The state is measured at every breakpoint ``tau_j`` of the control's dictionary. The control on piece ``k`` is
    ``u_k = v_k + sum_{j <= k} M_kj e_j`` with the innovations ``e_j``. An innovation is the difference of the state at
    ``tau_j`` from its prediction by the state one breakpoint before, the drift, every control in between and the middle
    of the disturbance's set. ``e_0`` is the difference of ``x(0)`` from the middle of the set of initial states, 0 for
    a single initial state.

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

    prestabilise: Literal["auto"] | list[list[float]] | None = None
    """A gain ``K (m, n)`` of the state, measured or estimated from outputs, for plants that amplify: ``u_k = K x(tau_k)
    + v_k + sum_j M_kj e_j``. The policies are the same (with ``memory`` other ones), and all numbers are those of the
    plant under this feedback.
    ``auto``: the gains of a regulator, one for every piece. null: none."""

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

    def answers(self, breakpoints: Array) -> np.ndarray:
        """Return the truth values ``(K, K)`` of the answered innovations: all that are measured by then, or those no
        older than ``memory``."""
        starts = breakpoints[:-1]
        oldest = np.inf if self.memory is None else self.memory + MEMORY_ALLOWANCE * breakpoints[-1]
        answered: np.ndarray = np.tril(starts[:, None] - starts <= oldest)
        return answered

    @property
    def inner_gain(self) -> InnerGain:
        """The gain of the state, as the option ``prestabilise`` gives it."""
        return self.prestabilise

    @property
    def charge(self) -> Charge:
        """The cost, the choice ``among`` policies, and the limits of the causal search, as the options give them."""
        return Charge(self.cost, self.among, self.causal_signals, self.causal_seconds)
