"""The contracts of the plugin kinds, for plugin authors to subclass in their tests; nothing else imports this
module."""

from __future__ import annotations

from sparserob_core.testing.commands import CommandContract
from sparserob_core.testing.contract import Contract, ContractBroken
from sparserob_core.testing.dictionaries import DictionaryContract, RegulariserContract
from sparserob_core.testing.executors import ExecutorContract
from sparserob_core.testing.maximisers import MaximiserContract
from sparserob_core.testing.methods import MethodContract
from sparserob_core.testing.observers import ObserverContract
from sparserob_core.testing.policies import PolicyContract
from sparserob_core.testing.problems import ProblemContract
from sparserob_core.testing.rules import InnerStopContract, OuterStopContract, ScheduleContract, SelectionContract
from sparserob_core.testing.sets import SetContract
from sparserob_core.testing.solvers import SolverContract

__all__ = [
    "CommandContract",
    "Contract",
    "ContractBroken",
    "DictionaryContract",
    "ExecutorContract",
    "InnerStopContract",
    "MaximiserContract",
    "MethodContract",
    "ObserverContract",
    "OuterStopContract",
    "PolicyContract",
    "ProblemContract",
    "RegulariserContract",
    "ScheduleContract",
    "SelectionContract",
    "SetContract",
    "SolverContract",
]
