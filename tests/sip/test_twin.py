"""Guards sip/program: the twin of a program is that of all that the program is, what is replaced is solved as it
stands, and no array of a record can be written to."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from functools import cache

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.sip.finite import Spread
from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram

POLICIES = {"open loop": None, "affine": sr.AffinePolicy(cost="worst")}
FIELDS = [each.name for each in fields(SemiInfiniteProgram) if each.init and each.name not in ("twin", "n")]
# another number of variables is another program altogether, which cannot be stated by a `replace` of that field alone


@cache
def program(policy: str = "open loop") -> SemiInfiniteProgram:
    on = sr.Dictionary.indicators(np.linspace(0.0, 5.0, 4))
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0, 1], [0, 0]], [[0], [1]], [[0], [1]]),
        horizon=5.0,
        initial_state=[4, 0],
        control=sr.Box([-1], [1]),
        disturbance=sr.Box([-0.02], [0.02]),
        path=[sr.PathConstraint(sr.Box([-4.2, -1.6], [4.2, 1.6]))],
        terminal=[sr.Box([-0.5, -0.4], [0.5, 0.4])],
    )
    return prepare(problem, on, on, policy=POLICIES[policy]).program


def other(value: object, program: SemiInfiniteProgram) -> object:
    """A value of a field that says something else."""
    if value is None:
        return 0.5
    if isinstance(value, np.ndarray):
        return 2.0 * value
    if hasattr(value, "indptr"):
        return 2.0 * value
    if isinstance(value, int | float):
        return value + 1
    if callable(value):
        return lambda *arguments: value(*arguments) if arguments else None
    if isinstance(value, Spread):
        return replace(value, still=np.ones(value.size, dtype=bool))
    return value[:-1]


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("name", FIELDS)
def test_whatever_is_replaced_the_twin_is_gone(name, policy):
    given = program(policy)
    shaped = {"lengths", "activity", "image_units", "q", "weights"}
    images = given.finite.weights.size
    special = {
        "P": np.eye(given.n),
        "S": 2.0 * (np.eye(given.n) if given.S is None else given.S),
        "blocks": np.where(np.arange(images) < 2, 0, -1),
        "G": None if given.G is None else 2.0 * given.G,
        "guide": (given, 1),
        "settle": lambda x: x,
        "spread": None if given.spread is None else other(given.spread, given),
    }
    value = special.get(name, other(getattr(given, name), given))
    sizes = {"q": given.n, "lengths": given.n, "activity": given.n}
    if name in shaped and np.ndim(value) == 0:
        value = np.full(sizes.get(name, images), value)
    more = {}
    if name in ("G", "h"):
        more = {"G": np.ones((1, given.n)), "h": np.ones(1)}
    elif name in ("A", "b"):
        more = {"A": np.ones((1, given.n)), "b": np.ones(1)}
    elif name == "blocks":
        more = {"weights": np.ones(images)}
    elif name == "spread" and value is None:
        value = Spread(((1, sr.Box([-1.0], [1.0])),))
    changed = replace(given, **{name: value, **more})
    assert given.own_units is not None
    assert changed.own_units is None


@pytest.mark.parametrize("each", [one.name for one in fields(ConstraintFamily)])
def test_a_family_with_another_field_is_another_program(each):
    given = program()
    first, *rest = given.families
    value = getattr(first, each)
    changed = replace(first, **{each: value})  # even the same value: what it was made of is not looked at
    assert replace(given, families=[changed, *rest]).own_units is None
    assert replace(given, families=given.families).own_units is not None


def test_a_program_replaced_by_equal_parts_keeps_its_twin():
    given = program()
    assert replace(given).own_units is given.own_units is not None


def arrays(record: object, seen: set[int], path: str = "program"):
    """Every array that a record holds, by its path, through tuples and further records."""
    if id(record) in seen or callable(record):
        return
    seen.add(id(record))
    if isinstance(record, np.ndarray):
        yield path, record
    elif hasattr(record, "indptr"):
        yield from ((f"{path}.{part}", getattr(record, part)) for part in ("data", "indices", "indptr"))
    elif isinstance(record, tuple):
        for i, part in enumerate(record):
            yield from arrays(part, seen, f"{path}[{i}]")
    elif is_dataclass(record):
        for each in fields(record):
            if each.name != "source":  # never looked at by a program
                yield from arrays(getattr(record, each.name, None), seen, f"{path}.{each.name}")


@pytest.mark.parametrize("policy", POLICIES)
def test_no_array_of_a_program_or_of_its_records_can_be_written_to(policy):
    found = dict(arrays(program(policy), set()))
    assert {"program.weights", "program.lower", "program.finite.q"} <= set(found)
    assert [path for path, array in found.items() if array.flags.writeable] == []


def test_weights_in_place_are_refused():
    given = program()
    with pytest.raises(ValueError, match="read-only"):
        given.weights[:] *= 100


def test_what_a_user_hands_over_stays_the_users():
    weights, lower = np.ones(2), [-1.0, -1.0]
    stated = SemiInfiniteProgram(n=2, weights=weights, lower=lower, upper=1.0, q=[-3.0, 0.0])
    weights[:] = 9.0
    lower[0] = 0.0
    assert stated.weights.tolist() == [1.0, 1.0]
    assert stated.cost(np.array([1.0, 1.0])) == pytest.approx(-1.0)
    assert sr.solve(stated).value == pytest.approx(-2.0, abs=1e-6)


def test_lengths_that_are_replaced_change_a_weighted_regularisers_answer():
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0]], [[1]]),
        horizon=5.0,
        initial_state=[2.0],
        control=sr.Box([-1], [1]),
        terminal=[sr.Box([-0.5], [0.5])],
    )  # all that matters is the integral of the control, so that the regulariser chooses
    first = sr.transcribe(problem, control=sr.Dictionary.indicators(np.linspace(0.0, 5.0, 4)))
    chosen = {"name": "exchange", "exact": False}

    def answer(program: SemiInfiniteProgram) -> np.ndarray:
        return sr.solve(program, method=chosen, regulariser="weighted_ridge").decision

    heavier = np.array([1.0, 4.0, 0.25])
    stated = replace(first, lengths=heavier, twin=None)
    changed = answer(replace(first, lengths=heavier))
    assert changed == pytest.approx(answer(stated), abs=1e-12)
    assert np.abs(changed - answer(first)).max() > 1e-3
