"""Guards sip/proof/verdict: no status claims more than the proofs under it, and the worst constraint is the worst."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.evidence import Proof
from sparserob_core.sip.program import TOLERANCE, ConstraintFamily, Separation, WorstConstraint
from sparserob_core.sip.proof.verdict import include_found_violation, verdict, witness, worst_of


def proof(said, family="a", violation=-1.0, **more):
    return Proof(family, said, 0.0, violation, np.array([0.5]), 0, **more)


def family(name="a", units=None):
    def rows(t):
        return np.ones((len(t), 2, 1)), np.zeros((len(t), 2))

    return ConstraintFamily(name=name, index_set=sr.Box([0.0], [1.0]), rows=rows, row_units=units)


def test_a_status_is_what_the_worst_of_its_proofs_allows():
    for said in product(("proven", "undecided", "refuted"), repeat=3):
        proofs = [proof(one, name, 2.0 if one == "refuted" else -1.0) for one, name in zip(said, "abc", strict=True)]
        for gap, tolerance in ((1e-8, 1e-7), (1e-7, 1e-7), (1.1e-7, 1e-7), (np.inf, 1e-7)):
            status, _ = verdict(proofs, gap, tolerance)
            if "refuted" in said:
                assert status == "refuted"
            elif "undecided" in said:
                assert status == "undecided"
            else:
                assert status == ("certified" if gap <= tolerance else "verified")


def separated(violation, row=0):
    return Separation(np.array([[0.25], [0.75]]), np.array([row, 0]), np.array([violation, violation / 2]), np.inf)


def test_a_refutation_tells_the_worst_that_was_met():
    for said in ("undecided", "refuted"):
        (worse,) = include_found_violation([proof(said, violation=1e-3)], [(family(), separated(0.5, 1))])
        assert (worse.verdict, worse.violation, worse.index, worse.row) == ("refuted", 0.5, 0.25, 1)
        (same,) = include_found_violation([proof(said, violation=1e-3)], [(family(), separated(1e-3))])
        assert (same.verdict, same.violation, same.index) == (said, 1e-3, 0.5)
    (still,) = include_found_violation([proof("proven", violation=-1.0)], [(family(), separated(0.5))])
    assert still.verdict == "proven"
    for violation, said in ((5e-9, "refuted"), (1.01 * TOLERANCE, "refuted"), (TOLERANCE, "undecided")):
        (found,) = include_found_violation([proof("undecided")], [(family(), separated(violation))])
        assert found.verdict == said
    (other,) = include_found_violation([proof("undecided")], [(family("b"), separated(0.5))])
    assert other.verdict == "undecided"


def test_a_violation_is_told_in_the_unit_of_its_row():
    units = np.array([1.0, 100.0])
    (worse,) = include_found_violation([proof("undecided")], [(family(units=units), separated(0.5, 1))])
    assert worse.unit == 100.0
    assert "50" in verdict([worse], 0.0, 1.0)[1]


def test_the_worst_of_all_families_is_the_most_violated():
    found = worst_of([(family("a"), separated(0.1)), (family("b"), separated(0.4, 1)), (family("c"), separated(-2.0))])
    assert (found.constraint, found.violation, found.row) == ("b", 0.4, 1)
    none = worst_of([(family(), Separation(np.zeros((0, 1)), np.zeros(0, dtype=int), np.zeros(0), 0.0))])
    assert none.violation == -np.inf and none.constraint == ""


def test_a_witness_is_the_worst_of_search_and_proofs_that_is_about_a_constraint():
    program = sr.SemiInfiniteProgram(
        n=1, q=[1.0], lower=-1.0, upper=1.0, families=[family("a"), replace(family("b"), defines=True)]
    )
    searched = WorstConstraint(0.2, "a", np.array([0.1]), 1)
    for other, violation, index in ((0.1, 0.2, 0.1), (0.3, 0.3, 0.5)):
        told = witness(program, searched, [proof("refuted", violation=other)])
        assert (told.constraint, told.violation) == ("a", violation)
        assert told.index[0] == pytest.approx(index)
    defined = witness(program, searched, [proof("refuted", "b", 9.0), Proof("a", "undecided", np.inf)])
    assert defined.violation == 0.2
