"""Policies: the quantities that a control knows, the measurements that it answers, the cost by which a policy is
chosen, and the open loop."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal, TypeAlias, final

import numpy as np
import numpy.typing as npt

from sparserob_core.control.policies.measurements import Measurements
from sparserob_core.errors import InputError
from sparserob_core.options import Options
from sparserob_core.sip.convex_set import Array

Quantity: TypeAlias = Literal["state", "disturbance", "parameters"]
Cost: TypeAlias = Literal["nominal", "peak", "worst"]
InnerGain: TypeAlias = Literal["auto"] | npt.ArrayLike | None

MAX_ANSWERING = 2**13
"""Pieces of a control that answers what is measured: what each of them may answer are so many squared, 67 million, of
which a program has a variable each for every state."""


@final
@dataclass(frozen=True)
class Charge:
    """The cost by which a policy is chosen, and the limits of the search for a bound against every causal policy; the
    fields are the options of `AffinePolicy`."""

    cost: Cost = "nominal"
    among: Literal["peak"] | None = "peak"
    causal_signals: int = 40
    causal_seconds: float = 60.0


class Policy(ABC):
    """A rule by which the control is decided while the system runs: the measurements that every piece ``answers``, and
    the cost by which the policy is chosen, its ``charge``.

    The state is measured at every breakpoint ``tau_j`` of the control's dictionary. The control on piece ``k`` is
    ``u_k = v_k + sum_j M_kj e_j`` over the innovations ``e_j`` that the piece answers (`AffinePolicy`). The policy that
    answers nothing is `OpenLoop`, where the control is a function of time alone.
    """

    @property
    @abstractmethod
    def knows(self) -> frozenset[Quantity]:
        """The quantities whose past values are known when the control is chosen at a time ``t``.

        A policy that answers anything knows the ``state``.
        """

    def answers(self, breakpoints: Array) -> np.ndarray:
        """Return the truth values ``(K, K)`` of whether the control on piece ``k`` answers the measurement at
        breakpoint ``j``.

        No entry with ``j > k`` is true. The ``breakpoints (K + 1,)`` are those of the control's dictionary. By default
        all entries are false; a policy that knows a quantity has to override this method, else `InputError` is raised.
        """
        if self.knows:
            raise InputError(
                path="policy.name",
                expected="a policy with a method answers, which says what it answers",
                got=f"one without, that knows the {', '.join(sorted(self.knows))}",
            )
        return np.zeros((len(breakpoints) - 1,) * 2, dtype=bool)

    @property
    def charge(self) -> Charge:
        """The cost by which the policy is chosen: the cost of the nominal control unless a policy overrides it."""
        return Charge()

    @property
    def inner_gain(self) -> InnerGain:
        """The gain ``(m, d)``, or ``(K, m, d)`` for every piece, of a feedback of the state that acts beside the
        answers; ``auto`` for one that stabilises the plant, ``None`` for none."""
        return None


@final
class OpenLoop(Policy, Options):
    """The control is fixed before the run, for every disturbance and every parameter alike (the paper's setting)."""

    @property
    def knows(self) -> frozenset[Quantity]:
        """The empty set: an open-loop control knows no quantity."""
        return frozenset()


@final
class WrittenPolicy(Policy):
    """A policy that is read from the files of a run: the truth values ``mask (K, K)`` and the cost, without the
    component that gave them; and the gains ``(K, m, d)`` of its inner loop, if there is one."""

    def __init__(self, mask: np.ndarray, charge: Charge, inner_gain: Array | None = None) -> None:
        self.mask, self._charge, self._inner_gain = mask, charge, inner_gain

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

    @property
    def inner_gain(self) -> InnerGain:
        """The gains that are written."""
        return self._inner_gain


def answers_of(policy: Policy | None, breakpoints: Array, measured: Measurements | None = None) -> np.ndarray:
    """Return the truth values ``(K, K)`` of what the control on each piece answers.

    Parameters
    ----------
    policy : Policy or None
        The policy; ``None`` answers nothing.
    breakpoints : Array
        Breakpoints ``(K + 1,)`` of the control's dictionary.
    measured : Measurements, optional
        The measurements; only those that are known by then are answered.

    Returns
    -------
    ndarray
        Truth values ``(K, K)``; an empty array for more than `MAX_ANSWERING` pieces where nothing is answered.

    Raises
    ------
    InputError
        Where the answers of the policy are no such array, of so many pieces, or where a state is answered before it is
        measured or without being known.
    """
    K = len(breakpoints) - 1
    if K > MAX_ANSWERING:
        if policy is None or isinstance(policy, OpenLoop):
            return np.zeros((0, 0), dtype=bool)
        raise InputError(
            path="policy.name", expected=f"at most {MAX_ANSWERING} pieces of a control that answers", got=f"{K}"
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
