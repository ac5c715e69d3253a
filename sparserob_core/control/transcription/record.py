"""The record that links a problem to its program."""

from __future__ import annotations

from dataclasses import dataclass

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.response.functional import WorstCase
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.response import Response
from sparserob_core.sip.convex_set import Array


@dataclass(frozen=True, eq=False)
class Transcription:
    """A problem on its dictionaries: what every family, simulation and figure is built from."""

    problem: OptimalControlProblem
    control: Dictionary
    functionals: WorstCase
    parameters: ParameterIndex

    @property
    def response(self) -> Response:
        return self.functionals.response

    def pieces(self, theta: Array) -> Array:
        """The control ``(m, K)`` on the pieces of its dictionary."""
        return self.control.control(theta)
