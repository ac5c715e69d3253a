"""One of nevergrad's optimisers, kept from warning, from failing unnoticed, and from touching the global random
numbers."""

from __future__ import annotations

import random
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.random import mtrand


class Failed(Exception):
    """The optimiser raised; the text says what."""


class Guarded:
    """An optimiser of the unit box ``[0, 1]^d``, seeded by the generator, one point at a time.

    Its failures come out as `Failed`, its warnings not at all. It works with global random numbers of its own: some of
    its parts use them.
    """

    def __init__(self, create: Any, dimension: int, budget: int, rng: np.random.Generator) -> None:
        seeds = [int(seed) for seed in rng.integers(2**31, size=3)]
        self._python, self._numpy = random.Random(seeds[0]).getstate(), np.random.MT19937(seeds[1])
        self._create, self._shape, self._budget, self._seed = create, (dimension,), budget, seeds[2]
        self._optimiser: Any = None
        self._asked: Any = None

    def learn(self, told: Sequence[tuple[np.ndarray, float]]) -> None:
        """Create the optimiser, and tell it of points and losses from before; it is shown the best where it takes none
        that it has not asked."""
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
        """The next point ``(d,)`` after the loss at the one before; ``None`` at first.

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
            return np.asarray(np.clip(unit, 0.0, 1.0))

    def population(self) -> np.ndarray:
        """The individuals ``(k, d)`` of an optimiser that keeps them by name, as differential evolution and particle
        swarms do; none of another."""
        kept = getattr(self._optimiser, "population", None)
        if not isinstance(kept, dict):
            return np.zeros((0, *self._shape))
        values = [np.array(individual.value, dtype=float) for individual in kept.values()]
        fitting = [np.clip(value, 0.0, 1.0) for value in values if value.shape == self._shape]
        return np.array(fitting).reshape(-1, *self._shape)

    def close(self) -> None:
        """Let go of the optimiser: some of them run in a thread, which ends with them."""
        self._optimiser = self._asked = None

    @contextmanager
    def _guard(self) -> Iterator[None]:
        outside = random.getstate(), mtrand.get_bit_generator(), np.random.get_state(legacy=False)  # noqa: NPY002
        random.setstate(self._python)
        mtrand.set_bit_generator(self._numpy)  # a tenth of the time that it takes to write its state
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                yield
        except Exception as error:
            raise Failed(f"{type(error).__name__}: {str(error).partition(chr(10))[0]}") from error
        finally:
            self._python = random.getstate()
            random.setstate(outside[0])
            mtrand.set_bit_generator(outside[1])
            if outside[2]["has_gauss"]:  # the second number of a normal pair, which is not the generator's
                np.random.set_state(outside[2])  # noqa: NPY002
