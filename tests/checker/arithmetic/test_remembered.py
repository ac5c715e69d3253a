"""Guards checker/arithmetic/remembered: what is told apart, and how much is kept."""

from __future__ import annotations

from dataclasses import dataclass

from sparserob_core.checker.arithmetic.remembered import remembered

MOST = 2


@dataclass(frozen=True, eq=False)
class Counting:
    made: list[tuple[int, bool]]

    @remembered(lambda: MOST)
    def value(self, number: int, odd: bool = False) -> int:
        self.made.append((number, odd))
        return 2 * number + odd

    @remembered(key=lambda self, number: number % 3)
    def rest(self, number: int) -> int:
        self.made.append((number, False))
        return number % 3


def test_a_value_is_made_once_for_every_argument_and_object() -> None:
    one, other = Counting([]), Counting([])
    assert [one.value(1), one.value(1), one.value(1, odd=True), one.value(1, odd=False)] == [2, 2, 3, 2]
    assert one.made == [(1, False), (1, True), (1, False)]
    assert other.value(1) == 2 and other.made == [(1, False)]


def test_the_oldest_are_forgotten_beyond_as_many_as_are_kept() -> None:
    one = Counting([])
    assert [one.value(k) for k in (1, 2, 3, 2, 1)] == [2, 4, 6, 4, 2]
    assert [number for number, _ in one.made] == [1, 2, 3, 1]


def test_arguments_with_one_key_are_one() -> None:
    one = Counting([])
    assert [one.rest(k) for k in (1, 4, 7, 2)] == [1, 1, 1, 2]
    assert one.made == [(1, False), (2, False)]
