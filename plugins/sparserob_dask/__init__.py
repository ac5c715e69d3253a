"""Independent work on a cluster, through dask."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from pydantic import Field, model_validator

import sparserob_core as sr


class Dask(sr.ExecutorFactory, sr.Options):
    """The workers of a dask cluster (Rocklin 2015): of one that runs already, on this machine or on many, or of one
    that is started here for as long as it is needed.

    An optional extra: ``pip install distributed``. The address of dask's dashboard is written to the standard
    error stream. A cluster that is started here listens on the loopback interface only unless ``host`` says otherwise:
    whoever can reach it can run anything on it. Its workers have one thread of linear algebra each and leave Ctrl-C to
    this process; one that dies breaks the executor. Workers of a cluster that was there before need the same version of
    SparseRob and its plugins, and ``OMP_NUM_THREADS=1`` if results are to be the same to the last digit; a call whose
    worker dies is made again there as dask's own ``allowed-failures`` says.

    At most one call for each thread of the workers is under way: others wait here, where they can be cancelled. Calls
    take milliseconds of dask's own, so they should take a tenth of a second at least. Leaving the context by an
    exception ends the workers that were started here; on a cluster that was there before, a call that has begun goes on
    unseen.
    """

    address: str | None = Field(default=None, min_length=1)
    """Where the scheduler of a running cluster listens, such as ``tcp://10.0.0.1:8786``; none: a cluster is started
    here."""

    workers: int | None = Field(default=None, ge=1)
    """How many processes are started here; none: one for each processor that this process may use."""

    host: str | None = Field(default=None, min_length=1)
    """The interface on which a cluster that is started here listens; none: 127.0.0.1, which other machines cannot
    reach."""

    timeout: float = Field(default=60.0, gt=0.0)
    """Seconds to wait until dask has begun, and as many until a worker is there. What is waited for is said after two
    seconds."""

    @model_validator(mode="after")
    def _one_cluster(self) -> Dask:
        for name in ("workers", "host"):
            if self.address is not None and getattr(self, name) is not None:
                raise sr.InputError(
                    path=name, expected="nothing beside address: a running cluster has its own workers",
                    got=repr(getattr(self, name)),
                )  # fmt: skip
        return self

    @contextmanager
    def open(self) -> Iterator[Executor]:
        """Return a context that yields the workers of the cluster; see `sparserob_core.ExecutorFactory`."""
        from sparserob_dask.cluster import connected, started

        with sr.one_thread():  # here, too: what this process adds up, it adds up as the workers do
            if self.address is not None:
                with connected(self.address, self.timeout) as executor:
                    yield executor
            else:
                with started(self.workers, self.host or "127.0.0.1", self.timeout) as executor:
                    yield executor


@sr.hookimpl
def sparserob_executors() -> Iterator[sr.ExecutorPlugin]:
    """Offer ``dask``."""
    yield sr.ExecutorPlugin(
        name="dask",
        factory=Dask,
        summary="a dask cluster, of this machine or of many (extra)",
        needs=("distributed", "distributed"),
    )
