"""The contracts of the plugin kinds, for plugin authors to subclass in their tests; nothing else imports this
module."""

from __future__ import annotations

from sparserob_core.testing.contract import Contract, ContractBroken
from sparserob_core.testing.executors import ExecutorContract
from sparserob_core.testing.maximisers import MaximiserContract
from sparserob_core.testing.observers import ObserverContract
from sparserob_core.testing.sets import SetContract
from sparserob_core.testing.solvers import SolverContract

__all__ = [
    "Contract",
    "ContractBroken",
    "ExecutorContract",
    "MaximiserContract",
    "ObserverContract",
    "SetContract",
    "SolverContract",
]
