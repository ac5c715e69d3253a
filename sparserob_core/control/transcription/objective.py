"""Cost of a problem in its program: the cost of the control, or under feedback of the nominal control."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from scipy.sparse import block_diag, csc_array

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.transcription.quadratic import quadratic_cost
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.convexity import convex_by_construction


class Quadratics(TypedDict, total=False):
    """Fields of a program that hold the quadratic terms of a cost."""

    P: csc_array
    q: Array
    constant: float
    largest: float


class CostFields(Quadratics):
    """Fields of a program that hold the whole cost."""

    weights: Array
    blocks: Array | None


def objective(problem: OptimalControlProblem, dictionary: Dictionary, images: int, variables: int) -> CostFields:
    """Return the cost of a program with so many ``images`` and ``variables``. The images begin with the values of the
    control on its pieces, ``(m K,)``, and the variables with its coefficients, ``(m N,)``; all other entries cost
    nothing."""
    weights = problem.prices(dictionary.breakpoints).ravel()
    weights = np.append(weights, np.zeros(images - weights.size))
    return {
        "weights": weights,
        "blocks": _number_groups(problem, dictionary, images),
        **quadratics(problem, dictionary, variables),
    }


def _number_groups(problem: OptimalControlProblem, dictionary: Dictionary, images: int) -> Array | None:
    """Return the number of the group and piece of every image; ``None`` where every channel counts alone."""
    if not problem.cost.blocks:
        return None
    number = np.full((problem.system.controls, dictionary.pieces), -1)
    for group, block in enumerate(problem.cost.blocks):
        number[list(block)] = group * dictionary.pieces + np.arange(dictionary.pieces)
    answer: Array = np.append(number.ravel(), np.full(images - number.size, -1))
    return answer


def quadratics(problem: OptimalControlProblem, dictionary: Dictionary, variables: int) -> Quadratics:
    """Return the quadratic terms of the cost, and the size to which a gap is relative. This size is the largest cost of
    the absolute values, plus the largest value of the quadratic terms at a control that stays 0, or at one end of one
    channel."""
    if not problem.cost.is_quadratic:
        return {}
    on_pieces = quadratic_cost(problem, dictionary.breakpoints)
    terms, axes = on_pieces.on(dictionary), np.eye(problem.system.controls)
    reach = problem.control.reach(axes)
    prices = problem.prices(np.array([0.0, problem.horizon]))[:, 0]
    largest = float(prices @ reach) + on_pieces.largest(reach)
    extra = variables - terms.q.size
    P = csc_array(block_diag([terms.P, csc_array((extra, extra))])) if extra else terms.P
    P = convex_by_construction(P)
    return {"P": P, "q": np.append(terms.q, np.zeros(extra)), "constant": terms.constant, "largest": largest}
