"""Guards sip/program: what a family says of itself is looked at before a bound rests on it, and what cannot be looked
at is said to be believed."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.program import TOLERANCE, WorstConstraint, find_uncovered_point
from sparserob_core.sip.working.ledger import contradiction


def rows(t):
    """``x1 + t x2 <= 1``."""
    return np.stack([np.ones(len(t)), t[:, 0]], 1)[:, None], 1.0 + 0.0 * t


def enclosure(x, lower, upper):
    heights = np.maximum(x[0] + lower[:, 0] * x[1], x[0] + upper[:, 0] * x[1]) - 1.0
    return sr.Enclosure(heights, np.zeros(len(lower), dtype=int))


def at(x, t, bound=None):
    violations = np.array([x[0] + t * x[1] - 1.0])
    return sr.Separation(np.array([[t]]), np.array([0]), violations, violations[0] if bound is None else bound)


def solved(**parts):
    """With the optimum -1 where the family is honest."""
    family = sr.ConstraintFamily(**{"name": "f", "index_set": sr.Box([0.0], [1.0]), "rows": rows, **parts})
    return sr.solve(sr.SemiInfiniteProgram(n=2, q=[-1.0, -1.0], lower=-1.0, upper=1.0, families=[family]), seconds=20)


def test_what_is_believed_is_said():
    for parts in ({"enclosure": enclosure}, {"worst": lambda x: at(x, 1.0 if x[1] > 0 else 0.0)}):
        result = solved(**parts)
        assert result.status == "certified" and result.cost == pytest.approx(-1.0)
        assert "what f encloses or separates is believed" in result.message
    assert "believed" not in solved().message  # nothing is claimed


WRONG = {
    "a gap": ({"enclosure": enclosure, "cells": ([[0.0], [0.6]], [[0.3], [1.0]])}, r"cells: .*none around \[0.4"),
    "a part": ({"enclosure": enclosure, "cells": ([[0.0]], [[0.3]])}, r"cells: .*none around \[0.65\]"),
    "a point": ({"enclosure": enclosure, "cells": ([[0.3]], [[0.3]])}, "cells: expected cells that cover"),
    "another shape": ({"enclosure": enclosure, "cells": ([0.0], [1.0])}, "cells: expected cells that cover"),
    "an index outside": ({"worst": lambda x: at(x, 3.0)}, r"worst: expected indices of the index set, got \[3.0\]"),
    "no number": ({"worst": lambda x: sr.Separation(np.zeros((1, 1)), np.zeros(1, int), np.array([np.nan]), -5.0)},
                  r"worst: expected violations that are numbers, got \[nan\]"),
    "a bound below": ({"worst": lambda x: at(x, 1.0, -9.0)}, "worst: expected a bound of at least .*, got -9"),
    "counts": ({"worst": lambda x: sr.Separation(np.zeros((2, 1)), np.zeros(1, int), np.zeros(1), 0.0)},
               "worst: expected indices"),
    "two coordinates": ({"worst": lambda x: sr.Separation(np.zeros((1, 2)), np.zeros(1, int), np.zeros(1), 0.0)},
                        r"worst: expected indices \(k, 1\)"),
    "one bound for all": (
        {"enclosure": lambda x, a, b: sr.Enclosure(np.array([-1.0]), np.zeros(1, dtype=int)),
         "cells": (np.array([[0.0], [0.5]]), np.array([[0.5], [1.0]]))}, r"enclosure: expected bounds .* \(2,\), got"),
    "half a row": ({"worst": lambda x: sr.Separation(np.zeros((1, 1)), np.array([0.5]), np.zeros(1), 0.0)},
                   r"worst: expected numbers of rows, from 0, got \[0.5\]"),
    "a row before the first": ({"worst": lambda x: sr.Separation(np.zeros((1, 1)), np.array([-1]), np.ones(1))},
                               r"worst: expected numbers of rows, from 0, got \[-1\]"),
    "a row after the last": ({"worst": lambda x: sr.Separation(np.zeros((1, 1)), np.array([7]), np.ones(1))},
                             "worst: expected a row below 1, got 7"),
    "rows that are none": ({"rows": lambda t: (np.full((len(t), 1, 2), np.nan), 1.0 + 0.0 * t)}, "rows are not num"),
    "rows that nothing meets": ({"rows": lambda t: (rows(t)[0], np.full((len(t), 1), -np.inf))}, "above -inf"),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("name", WRONG)
def test_a_family_that_contradicts_itself_is_refused(name):
    parts, words = WRONG[name]
    with pytest.raises(sr.InputError, match=words) as caught:
        solved(**{key: tuple(map(np.array, part)) if key == "cells" else part for key, part in parts.items()})
    assert caught.value.exit_status == 2


def test_a_bound_that_is_no_number_says_nothing():
    assert solved(worst=lambda x: at(x, 1.0 if x[1] > 0 else 0.0, np.nan)).status == "undecided"
    assert solved(enclosure=lambda x, a, b: sr.Enclosure(np.full(len(a), np.nan), np.zeros(len(a), int)),
                  ).status == "undecided"  # fmt: skip


def test_a_separation_that_finds_nothing_is_not_believed_against_the_rows():
    """Without the rows at both ends of the index set -2 would be certified."""
    result = solved(worst=lambda x: sr.Separation(np.zeros((0, 1)), np.zeros(0, dtype=int), np.zeros(0), -5.0))
    assert result.cost == pytest.approx(-1.0)


def test_rows_that_change_from_call_to_call_are_not_certified():
    calls = []

    def noisy(t):
        calls.append(len(t))
        G, h = rows(t)
        return G, h - 0.01 * (len(calls) % 2)

    result = solved(rows=noisy, enclosure=enclosure)
    assert result.status == "failed" and "one of the two is wrong" in result.message


def test_a_witness_that_meets_its_row_refutes_nothing():
    def worst(x):
        return sr.Separation(np.array([[0.5]]), np.array([0]), np.array([x[0] + 0.5 * x[1] + 4.0]))

    result = solved(worst=worst)
    assert result.status == "failed" and "one of the two is wrong" in result.message
    assert result.lower_bound == -np.inf and result.upper_bound == np.inf


@pytest.mark.parametrize("lie", [1e-7, 0.5, -0.5])
def test_no_bound_rests_on_chosen_rows_that_are_others(lie):
    def chosen(t, which):
        G, h = rows(t)
        return G[:, 0], h[:, 0] + lie

    def honest(t, which):
        return rows(t)[0][:, 0], rows(t)[1][:, 0]

    assert solved(enclosure=enclosure, chosen=honest).status == "certified"
    result = solved(enclosure=enclosure, chosen=chosen)
    assert result.status in ("failed", "refuted")  # where more is allowed, the decision is refuted by its rows
    assert result.lower_bound <= -1.0 + 1e-9


def test_a_violation_beside_a_proof_is_a_contradiction_from_two_tolerances_on():
    def worst(violation):
        return contradiction(WorstConstraint(violation, "f", np.zeros(1)))

    assert worst(2.01 * TOLERANCE) and not worst(1.99 * TOLERANCE) and not worst(-np.inf)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("d", [1, 2, 3])
def test_cells_that_were_halved_cover_and_without_one_of_them_do_not(seed, d):
    rng = np.random.default_rng(seed)
    box = sr.Box(-rng.random(d), rng.random(d) + 1.0)
    lower, upper = box.lower[None], box.upper[None]
    for _ in range(12):
        i, axis, share = int(rng.integers(len(lower))), int(rng.integers(d)), rng.uniform(0.2, 0.8)
        cut = lower[i, axis] + share * (upper[i, axis] - lower[i, axis])
        low, high = lower[i].copy(), upper[i].copy()
        low[axis] = high[axis] = cut
        lower = np.vstack([lower[:i], lower[i : i + 1], low, lower[i + 1 :]])
        upper = np.vstack([upper[:i], high, upper[i : i + 1], upper[i + 1 :]])
    assert find_uncovered_point(lower, upper, box) is None
    gone = int(rng.integers(len(lower)))
    kept = np.arange(len(lower)) != gone
    missing = find_uncovered_point(lower[kept], upper[kept], box)
    assert missing is not None and (missing > lower[gone]).all() and (missing < upper[gone]).all()
    doubled = np.append(np.flatnonzero(kept), np.flatnonzero(kept)[:3])  # as much volume or more, and a gap
    assert find_uncovered_point(lower[doubled], upper[doubled], box) is not None


def test_cells_may_overlap_stand_still_along_a_side_and_miss_by_rounding():
    box = sr.Box([0.0, 2.0], [1.0, 2.0])
    assert find_uncovered_point(np.array([[0.0, 2.0], [0.4, 2.0]]), np.array([[0.5, 2.0], [1.0, 2.0]]), box) is None
    third = np.array([[0.0], [1.0 / 3.0 + 1e-16]])
    assert find_uncovered_point(third, np.array([[1.0 / 3.0], [1.0]]), sr.Box([0.0], [1.0])) is None
    assert (
        find_uncovered_point(np.array([[0.0], [0.5 + 1e-9]]), np.array([[0.5], [1.0]]), sr.Box([0.0], [1.0]))
        is not None
    )


def test_a_grid_that_is_too_large_is_compared_by_volume(monkeypatch):
    monkeypatch.setattr("sparserob_core.sip.program.MAX_GRID_PARTS", 1)
    box = sr.Box([0.0, 0.0], [1.0, 1.0])
    assert find_uncovered_point(np.zeros((1, 2)), np.ones((1, 2)), box) is None
    assert find_uncovered_point(np.zeros((1, 2)), np.array([[1.0, 0.999]]), box) is not None


@pytest.mark.parametrize("method", ["exchange", "sparserob"])
def test_rows_of_another_shape_are_refused_by_every_method(method: str) -> None:
    """Right-hand sides ``(k,)`` ended in a traceback of an index."""
    family = sr.ConstraintFamily(
        name="flat", index_set=sr.Box([0.0], [1.0]), rows=lambda t: (np.ones((len(t), 1, 2)), t[:, 0])
    )
    program = sr.SemiInfiniteProgram(n=2, q=[1.0, 1.0], lower=-5.0, upper=5.0, families=[family])
    with pytest.raises(sr.InputError, match=r"family 'flat': expected rows of shape \(\d+, r, 2\)"):
        sr.solve(program, method=method, regulariser="ridge", budget=20)
