"""What the control may know and answer, what that is chosen for, and the policy that answers nothing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal, TypeAlias, final

import numpy as np

from sparserob_core.control.policies.measurements import Measurements
from sparserob_core.errors import InputError
from sparserob_core.options import Options
from sparserob_core.sip.convex_set import Array

Quantity: TypeAlias = Literal["state", "disturbance", "parameters"]
Cost: TypeAlias = Literal["nominal", "peak", "worst"]

MOST_ANSWERING = 2**13
"""Pieces of a control that answers what is measured: what each of them may answer are so many squared, 67 million, of
which a program has a variable each for every state."""


@final
@dataclass(frozen=True)
class Charge:
    """The cost by which a policy is chosen, and how long a bound against every causal policy is sought beside it; the
    fields are the options of `AffinePolicy`."""

    cost: Cost = "nominal"
    among: Literal["peak"] | None = "peak"
    causal_signals: int = 40
    causal_seconds: float = 60.0


class Policy(ABC):
    """How the control is decided while the system runs: which measurements every piece of it ``answers``, and which
    cost it is chosen by, its ``charge``.

    The state is measured at every breakpoint ``tau_j`` of the control's dictionary, and the control on piece ``k`` is
    ``u_k = v_k + sum_j M_kj e_j`` over the innovations ``e_j`` that it answers (`AffinePolicy`). The policy that
    answers nothing is `OpenLoop`, where the control is a function of time alone.
    """

    @property
    @abstractmethod
    def knows(self) -> frozenset[Quantity]:
        """Of which quantities the past values are known when the control is chosen at a time ``t``; a policy that
        answers anything knows the ``state``."""

    def answers(self, breakpoints: Array) -> np.ndarray:
        """Truth values ``(K, K)``: whether the control on piece ``k`` answers what is measured at breakpoint ``j``,
        never for ``j > k``; of the ``breakpoints (K + 1,)`` of the control's dictionary. Nothing unless it is said; a
        policy that knows something has to say it."""
        if self.knows:
            raise InputError(
                path="policy.name",
                expected="a policy with a method answers, which says what it answers",
                got=f"one without, that knows the {', '.join(sorted(self.knows))}",
            )
        return np.zeros((len(breakpoints) - 1,) * 2, dtype=bool)

    @property
    def charge(self) -> Charge:
        """The cost by which the policy is chosen: that of the nominal control unless it is said."""
        return Charge()


@final
class OpenLoop(Policy, Options):
    """The control is fixed before the run, for every disturbance and every parameter alike (the paper's setting)."""

    @property
    def knows(self) -> frozenset[Quantity]:
        """Nothing."""
        return frozenset()


@final
class WrittenPolicy(Policy):
    """A policy as a run has written it down: the truth values ``mask (K, K)`` and the cost that it is charged, without
    the component that said them."""

    def __init__(self, mask: np.ndarray, charge: Charge) -> None:
        self.mask, self._charge = mask, charge

    @property
    def knows(self) -> frozenset[Quantity]:
        """The state."""
        return frozenset({"state"})

    def answers(self, breakpoints: Array) -> np.ndarray:
        """The mask."""
        return self.mask

    @property
    def charge(self) -> Charge:
        """The cost that is written."""
        return self._charge


def answers_of(policy: Policy | None, breakpoints: Array, measured: Measurements | None = None) -> np.ndarray:
    """The truth values ``(K, K)`` of a policy, none of them of no policy, and of what is ``measured`` those of what is
    known by then; of more than `MOST_ANSWERING` pieces an empty array where nothing is answered. Raises `InputError`
    where they are no such array, of so many pieces, or where something is answered before it is measured, or without
    being known."""
    K = len(breakpoints) - 1
    if K > MOST_ANSWERING:
        if policy is None or isinstance(policy, OpenLoop):
            return np.zeros((0, 0), dtype=bool)
        raise InputError(
            path="policy.name", expected=f"at most {MOST_ANSWERING} pieces of a control that answers", got=f"{K}"
        )
    if policy is None:
        return np.zeros((K, K), dtype=bool)
    mask: object = policy.answers(np.array(breakpoints, dtype=float))
    if not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.shape != (K, K):
        got = f"{mask.dtype} of shape {mask.shape}" if isinstance(mask, np.ndarray) else f"a {type(mask).__name__}"
        raise InputError(path="policy.name", expected=f"answers that are truth values of shape {(K, K)}", got=got)
    early = np.argwhere(np.triu(mask, 1))
    if early.size:
        k, j = early[0].tolist()
        raise InputError(
            path="policy.name",
            expected="answers to what is measured by then",
            got=f"piece {k + 1} that answers breakpoint {j + 1}, which comes later",
        )
    if mask.any() and "state" not in policy.knows:
        raise InputError(
            path="policy.name", expected="a policy that knows the state, which it answers", got="one that does not"
        )
    return mask.copy() if measured is None else mask & measured.known(breakpoints)
