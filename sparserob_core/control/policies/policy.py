"""What the control may know, and the policy that knows nothing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Literal, TypeAlias, final

from sparserob_core.options import Options

Quantity: TypeAlias = Literal["state", "disturbance", "parameters"]


class Policy(ABC):
    """How the control is decided while the system runs; the transcription and the checker both ask it.

    Two can be transcribed: `OpenLoop`, where the control is a function of time alone, and `AffinePolicy`.
    """

    @property
    @abstractmethod
    def knows(self) -> frozenset[Quantity]:
        """Of which quantities the past values are known when the control is chosen at a time ``t``."""


@final
class OpenLoop(Policy, Options):
    """The control is fixed before the run, for every disturbance and every parameter alike (the paper's setting)."""

    @property
    def knows(self) -> frozenset[Quantity]:
        """Nothing."""
        return frozenset()
