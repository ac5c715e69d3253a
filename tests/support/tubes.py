"""The checker's tubes over boxes of parameters, as its claims make them."""

from __future__ import annotations

import numpy as np

from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.flow.law import Box
from sparserob_core.checker.reach.tube import Rows, Tube
from sparserob_core.checker.sets.parameters import Corners


def tube_of(case: Case, corners: Corners) -> Tube:
    """The tube of a case over a box of its parameters, along its states."""
    box = Box.between(*corners)
    return Tube(Rows(case.states(box), np.eye(case.problem.system.states)), box)
