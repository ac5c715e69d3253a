"""Optimiser of nevergrad, kept from warning, from failing unnoticed, and from touching the global random numbers."""

from __future__ import annotations

import ctypes
import random
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
from numpy.random import mtrand

WORDS = 4 * (624 + 1)
"""Bytes of a Mersenne Twister in memory, Python's and numpy's: its words and the place among them."""


class Failed(Exception):
    """Error of an optimiser; the text says what was raised."""


class Guarded:
    """An optimiser of the unit box ``[0, 1]^d``, seeded by the generator, one point at a time.

    Its failures come out as `Failed`, its warnings not at all. It works with global random numbers of its own: some of
    its parts use them.
    """

    def __init__(self, create: Any, dimension: int, budget: int, rng: np.random.Generator) -> None:
        seeds = [int(seed) for seed in rng.integers(2**31, size=3)]
        self._python, self._numpy = _PythonState(random.Random(seeds[0]).getstate()), np.random.MT19937(seeds[1])
        self._outside = _PythonState()
        self._create, self._shape, self._budget, self._seed = create, (dimension,), budget, seeds[2]
        self._optimiser: Any = None
        self._asked: Any = None
        self._whole: tuple[Any, bytes] | None = None  # the global generator, last seen with no number waiting

    def learn(self, told: Sequence[tuple[np.ndarray, float]]) -> None:
        """Create the optimiser and tell it points and losses from before. An optimiser that takes none that it has not
        asked is shown the best."""
        with self._guard():
            import nevergrad as ng

            box = ng.p.Array(shape=self._shape, lower=np.zeros(self._shape), upper=np.ones(self._shape))
            box.random_state = np.random.RandomState(self._seed)
            self._optimiser = self._create(parametrization=box, budget=self._budget, num_workers=1)
            if not told:
                return
            try:
                for unit, loss in told:
                    self._optimiser.tell(box.spawn_child(new_value=unit), loss)
            except ng.errors.TellNotAskedNotSupportedError:
                self._optimiser.suggest(min(told, key=lambda pair: pair[1])[0])

    def next(self, loss: float | None) -> np.ndarray:
        """Return the next point ``(d,)`` after the loss at the one before; ``None`` at first.

        Telling and asking are one step, so that an optimiser which thinks in a thread of its own rests while the
        function is evaluated.
        """
        with self._guard():
            if loss is not None:
                self._optimiser.tell(self._asked, loss)
            self._asked = self._optimiser.ask()
            unit = np.array(self._asked.value, dtype=float)
            if unit.shape != self._shape or not np.isfinite(unit).all():
                raise ValueError(f"it asked for {unit.tolist()}")
            return within(unit, 0.0, 1.0)

    def population(self) -> np.ndarray:
        """Return the individuals ``(k, d)`` of an optimiser that keeps them by name, as differential evolution and
        particle swarms do; none of another."""
        individuals = getattr(self._optimiser, "population", None)
        if not isinstance(individuals, dict):
            return np.zeros((0, *self._shape))
        values = [np.array(individual.value, dtype=float) for individual in individuals.values()]
        points = [np.clip(value, 0.0, 1.0) for value in values if value.shape == self._shape]
        return np.array(points).reshape(-1, *self._shape)

    def close(self) -> None:
        """Let go of the optimiser: some of them run in a thread, which ends with them."""
        self._optimiser = self._asked = None

    @contextmanager
    def _guard(self) -> Iterator[None]:
        generator, waiting_state = mtrand.get_bit_generator(), self._waiting()
        outside_state = self._outside.read()
        self._python.install()
        mtrand.set_bit_generator(self._numpy)  # a hundredth of the time that it takes to write its state
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                yield
        except Exception as error:
            raise Failed(f"{type(error).__name__}: {str(error).partition(chr(10))[0]}") from error
        finally:
            self._python.read()
            outside_state.install()
            mtrand.set_bit_generator(generator)
            if waiting_state is not None:
                np.random.set_state(waiting_state)  # noqa: NPY002

    def _waiting(self) -> dict[str, Any] | None:
        """Return the state of numpy's global random numbers where the second number of a normal pair waits in it. That
        number is not the generator's and is lost when the generator is exchanged. The state is not asked for while the
        generator stands where it was when no number waited, for drawing a pair moves it."""
        generator = mtrand.get_bit_generator()
        words = None
        if type(generator) is np.random.MT19937:
            words = ctypes.string_at(generator.ctypes.state_address, WORDS)
            if self._whole is not None and self._whole[0] is generator and self._whole[1] == words:
                return None
        state: dict[str, Any] = np.random.get_state(legacy=False)  # noqa: NPY002
        self._whole = None if state["has_gauss"] or words is None else (generator, words)
        return state if state["has_gauss"] else None


def within(points: np.ndarray, lower: Any, upper: Any) -> np.ndarray:
    """Return points moved into a box; a fifth of the time of `numpy.clip` for a few numbers."""
    return np.asarray(np.minimum(np.maximum(points, lower), upper))


class _PythonState:
    """State of Python's global random numbers, as it lies in memory where that is known (`_place`). To write it out as
    numbers, and to make it of them, takes as long as an optimiser takes for a tenth of a step."""

    def __init__(self, state: Any = None) -> None:
        self._state = state  # as `random.getstate` has it, until it was read for the first time
        self._words, self._pair = b"", None

    def read(self) -> _PythonState:
        """Take over the present state; return itself."""
        address, shared = _place(), _shared()
        if address:
            self._state, self._words, self._pair = None, ctypes.string_at(address, WORDS), shared.gauss_next
        else:
            self._state = random.getstate()
        return self

    def install(self) -> None:
        """Make this state the present one."""
        if self._state is not None:
            random.setstate(self._state)
        else:
            ctypes.memmove(_place(), self._words, WORDS)
            _shared().gauss_next = self._pair


def _shared() -> Any:
    """Return Python's global generator."""
    draw: Any = random.random
    return draw.__self__


@cache
def _place() -> int:
    """Return the address of the state of Python's global generator. It lies where another generator of the same class
    has it, at the same distance; 0 where a trial has found that not to be so."""
    shared = _shared()
    head = object.__basicsize__  # which counts references
    if sys.implementation.name != "cpython" or type(shared) is not random.Random:
        return 0
    if random.Random.__basicsize__ < head + WORDS:
        return 0
    first, second = random.Random(1), random.Random(2)
    second.random()  # not at its first number
    ctypes.memmove(id(first) + head, ctypes.string_at(id(second) + head, WORDS), WORDS)
    return id(shared) + head if first.getstate() == second.getstate() else 0
