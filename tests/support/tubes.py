"""The checker's tubes over boxes of parameters, as its claims make them."""

from __future__ import annotations

import numpy as np

from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.flow.law import ParameterBox
from sparserob_core.checker.reach.tube import ProjectedStates, VerifiedTube
from sparserob_core.checker.sets.parameters import Corners


def tube_of(case: Case, corners: Corners) -> VerifiedTube:
    """The tube of a case over a box of its parameters, along its states."""
    box = ParameterBox.between(*corners)
    return VerifiedTube(ProjectedStates(case.states.over(box), np.eye(case.problem.system.states)), box)
