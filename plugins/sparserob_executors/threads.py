"""One thread of linear algebra: many threads add up in another order, and workers side by side would hold each other
up."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

LIBRARIES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "RAYON_NUM_THREADS",
)


@contextmanager
def environment() -> Iterator[None]:
    """Libraries that are loaded meanwhile, and processes that are started meanwhile, take one thread."""
    before = {name: os.environ.get(name) for name in LIBRARIES}
    os.environ.update(dict.fromkeys(LIBRARIES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def one_thread() -> Iterator[None]:
    """Linear algebra in this process has one thread: what is loaded by now, and what will be loaded."""
    from threadpoolctl import threadpool_limits

    with environment(), threadpool_limits(limits=1):
        yield
