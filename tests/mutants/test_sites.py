"""Guards the tool that draws mutants: each kind changes what it names and nothing else, and a draw can be repeated."""

from __future__ import annotations

import ast

from tests.mutants.__main__ import FOLDERS, drawn
from tests.mutants.processes import Baseline
from tests.mutants.sites import KINDS, mutants

SOURCE = b'''"""Text with 2 + 2."""
LIMIT: int = 4  # twice \xc3\xa9
@cache(maxsize=8)
def bound(x: Shape[2], lost, tolerance):
    if x <= LIMIT and not lost:
        raise Broken(f"{x:.3g} is larger than {1 + 1}")
    h = max(x.max(axis=1), (lost
                            + 0.5 * OUTWARD))
    return abs(h) / 8 if all(c > tolerance for c in product((-1, 1), repeat=2)) else x[1]
'''


def changed():
    return {(mutant.kind, mutant.after): mutant.applied(SOURCE).decode() for mutant in mutants("a.py", SOURCE)}


def test_every_kind_makes_its_own_change_and_what_it_makes_can_be_parsed():
    texts = changed()
    assert {kind for kind, _ in texts} == set(KINDS)
    for text in texts.values():
        ast.parse(text)
    for kind, after, line in (
        ("comparison flipped", ">", "    if x > LIMIT and not lost:"),
        ("connective changed", "or", "    if x <= LIMIT or not lost:"),
        ("connective changed", "bool(lost)", "    if x <= LIMIT and bool(lost):"),
        ("refusal passed over", "pass", "        pass"),
        ("plus for minus", "-", "                            - 0.5 * OUTWARD))"),
        ("outward rounding removed", "1.0", "                            + 0.5 * 1.0))"),
        ("remainder halved", "(8 * 2)", "    return abs(h) / (8 * 2) if all("),
        ("remainder halved", "(lost / 2)", "    h = max(x.max(axis=1), ((lost / 2)"),
        ("absolute value removed", "(h)", "    return (h) / 8 if all("),
        ("constant halved", "2", "LIMIT: int = 2  # twice é"),
        ("fewer corners", "x.take(0, axis=1)", "    h = max(x.take(0, axis=1), (lost"),
        ("tolerance loosened", "(10 * tolerance)", "if all(c > (10 * tolerance) for c"),
    ):
        assert line in texts[kind, after]


def test_sentences_annotations_decorators_and_indices_are_left_alone():
    for text in changed().values():
        for kept in ('"""Text with 2 + 2."""', "@cache(maxsize=8)", "x: Shape[2]", "else x[1]"):
            assert kept in text


def test_a_mutant_knows_where_the_function_around_it_begins():
    lines = {mutant.before: (mutant.line, mutant.function) for mutant in mutants("a.py", SOURCE)}
    assert lines["4"] == (2, 0)
    assert lines["<="] == (5, 3)


def test_a_draw_can_be_repeated_and_goes_through_every_folder_in_order():
    folders = ("sip/proof", "control/sets")
    first, again, other = (drawn(folders, 20, seed) for seed in (1, 1, 2))
    assert FOLDERS[0] == "checker"
    assert first == again != other
    assert len(set(first)) == 20
    places = [next(i for i, name in enumerate(folders) if f"/{name}/" in mutant.path) for mutant in first]
    assert places == sorted(places)
    assert set(places) == {0, 1}


def test_a_mutant_is_put_to_the_tests_that_call_its_function_the_cheapest_file_first():
    inside, outside = (
        next(mutant for mutant in mutants("a.py", SOURCE) if mutant.before == text) for text in ("<=", "4")
    )
    each = {"t/a.py::slow": 9.0, "t/a.py::quick": 1.0, "t/b.py::one": 5.0, "t/c.py::no": 0.1}
    callers = {
        "a.py:3": ["t/a.py::slow", "t/a.py::quick", "t/b.py::one"],
        "a.py:9": ["t/c.py::no"],
        "b.py:3": ["t/d.py"],
    }
    baseline = Baseline(15.1, each, callers)
    assert baseline.asked(inside) == ["t/b.py::one", "t/a.py::quick", "t/a.py::slow"]
    assert baseline.asked(outside) == ["t/c.py::no", *baseline.asked(inside)]
