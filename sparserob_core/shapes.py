"""Arrays of records: their shapes in annotations, and that nobody writes to them.

``Float[Array, "k d"]`` has ``k`` rows of ``d`` numbers.

One letter means one size throughout a signature. A function that is marked `shaped` has its arguments and its result
checked by the tests, and by nobody else: jaxtyping costs as much to import as numpy, so that outside of the tests
(``SPARSEROB_SHAPES`` unset) an annotation stands for a plain array, and `shaped` hands the function back.
"""

from __future__ import annotations

import os
from dataclasses import fields
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]
CHECKED = bool(os.environ.get("SPARSEROB_SHAPES"))
F = TypeVar("F")

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    def shaped(function: F) -> F:
        """Mark a function whose annotations state shapes."""
        return function

elif CHECKED:
    import random
    from functools import wraps

    import jaxtyping
    from beartype import beartype

    class _CheckedArray:
        """An array of one kind of numbers; a number of numpy is one without axes, since numpy makes it one."""

        def __init__(self, kind: Any) -> None:
            self.kind = kind

        def __getitem__(self, item: tuple[object, str]) -> Any:
            return self.kind[np.ndarray | np.generic, item[1]]

    # whole numbers may stand where numbers are asked for: numpy computes with them, and shapes are what matters here
    Bool, Float, Int = _CheckedArray(jaxtyping.Bool), _CheckedArray(jaxtyping.Real), _CheckedArray(jaxtyping.Integer)

    def _restore_random_state(function: Any) -> Any:
        """Give back what a check has drawn: beartype looks at one item of a list, and takes the random numbers of the
        whole process to choose it, which components are tested not to touch."""

        @wraps(function)
        def undrawn(*arguments: Any, **keywords: Any) -> Any:
            before = random.getstate()
            try:
                return function(*arguments, **keywords)
            finally:
                random.setstate(before)

        return undrawn

    FIRST, MORE = 20, 5  # calls that are checked one by one; then each that is a fifth later, as a check is slow

    def shaped(function: Any) -> Any:
        """Check the shapes in the annotations of a function at its first calls, and ever more rarely afterwards; at
        every call of what it has as ``checked``."""
        checked = _restore_random_state(jaxtyping.jaxtyped(function, typechecker=beartype))
        calls, skipped = 0, 0

        @wraps(function)
        def sampled(*arguments: Any, **keywords: Any) -> Any:
            nonlocal calls, skipped
            if skipped > 0:  # threads may count together
                skipped -= 1
                return function(*arguments, **keywords)
            if calls >= FIRST:
                skipped = calls // MORE
            calls += 1 + skipped
            return checked(*arguments, **keywords)

        sampled.checked = checked
        return sampled

else:

    class _AnyShape:
        """Stands for an array of any shape."""

        def __class_getitem__(cls, item: object) -> type:
            return np.ndarray

    Bool = Float = Int = _AnyShape

    def shaped(function: Any) -> Any:
        """Mark a function whose annotations state shapes; nothing is checked."""
        return function


__all__ = ["Bool", "Float", "Int", "dense", "shaped"]


def dense(value: Any) -> Any:
    """A sparse matrix of scipy as an array; everything else as it is."""
    return value.toarray() if hasattr(value, "toarray") else value


def read_only(value: Any) -> Any:
    """Return a value as a copy that cannot be written to, where it is an array, a sparse matrix, or a tuple of such
    values.

    The entries of a sparse matrix are sorted and its duplicates summed first. A value that already cannot be written to
    is returned itself, so that its identity determines its content; every other value is returned unchanged.
    """
    if isinstance(value, np.ndarray):
        if value.base is None and not value.flags.writeable:
            return value
        value = value.copy()
        value.flags.writeable = False
        return value
    if type(value) is tuple:
        copies = tuple(read_only(item) for item in value)
        return value if all(copied is original for copied, original in zip(copies, value, strict=True)) else copies
    if hasattr(value, "indptr") and value.data.flags.writeable:
        value = value.copy()
        value.sum_duplicates()
        for array in (value.data, value.indices, value.indptr):
            array.flags.writeable = False
    return value


def sealed(record: Any) -> None:
    """Make every array that a frozen record holds one that cannot be written to: what is derived from the record, and
    remembered, then stays right."""
    for field in fields(record):
        value = getattr(record, field.name, None)
        kept = read_only(value)
        if kept is not value:
            object.__setattr__(record, field.name, kept)
