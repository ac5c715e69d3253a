"""Guards that nothing is lost between a solver and us: the smaller problems of Maros and Meszaros (1999), which bare
PIQP and our adapter are asked for, side by side, in one run.

The problems are other people's files, which are not kept here: SPARSEROB_MAROS_MESZAROS names the folder of .mat files
of github.com/qpsolvers/maros_meszaros_qpbenchmark (its data/).
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import piqp
import pytest
from scipy import sparse
from scipy.io import loadmat

import sparserob_core as sr
from sparserob_core.sip.solver import QuadraticProgram

pytestmark = pytest.mark.benchmark

FOLDER = os.environ.get("SPARSEROB_MAROS_MESZAROS", "")
SMALLER = 400  # variables
ENDLESS = 9e19  # what the files call infinite is 1e20
ACCURACY = 1e-10


def problems(folder: Path) -> Iterator[tuple[str, QuadraticProgram]]:
    """The problems of at most ``SMALLER`` variables: ``l <= A x <= u``, whose last rows are the bounds of ``x``."""
    for file in sorted(folder.glob("*.mat")):
        read = loadmat(file)
        P, q, A = read["P"].astype(float).tocsc(), np.ravel(read["q"]).astype(float), read["A"].astype(float).tocsr()
        n = q.size
        if n > SMALLER:
            continue
        least, most = (np.ravel(read[key]).astype(float) for key in "lu")
        least, most = np.where(least < -ENDLESS, -np.inf, least), np.where(most > ENDLESS, np.inf, most)
        rows, lower, upper = A[:-n], least[-n:], most[-n:]
        assert abs(A[-n:] - sparse.eye_array(n)).nnz == 0
        equal = least[:-n] == most[:-n]
        above, below = np.isfinite(most[:-n]) & ~equal, np.isfinite(least[:-n]) & ~equal
        G = sparse.csc_array(sparse.vstack([rows[above], -rows[below]]))
        h = np.concatenate([most[:-n][above], -least[:-n][below]])
        yield (
            file.stem,
            QuadraticProgram(
                sparse.csc_array(P), q, G, h, sparse.csc_array(rows[equal]), least[:-n][equal], lower, upper
            ),
        )


def bare(program: QuadraticProgram) -> bool:
    """Whether PIQP alone, with its own settings but for the accuracy, says that it has solved the program."""
    solver = piqp.SparseSolver()
    solver.settings.eps_abs = solver.settings.eps_duality_gap_abs = ACCURACY
    solver.settings.eps_rel = solver.settings.eps_duality_gap_rel = ACCURACY
    solver.setup(program.P, program.q, program.A, program.b, program.G, None, program.h, program.lower, program.upper)
    return bool(solver.solve() == piqp.PIQP_SOLVED)


def test_our_piqp_solves_whatever_bare_piqp_solves(capsys: pytest.CaptureFixture[str]) -> None:
    if not FOLDER:
        pytest.skip("SKIPPED LOUDLY: SPARSEROB_MAROS_MESZAROS names no folder of problems")
    adapter, seconds = sr.load_registry().build("solver", "piqp"), [0.0, 0.0]
    alone, ours, seen = set(), set(), 0
    for name, program in problems(Path(FOLDER)):
        seen, clock = seen + 1, time.process_time()
        alone |= {name} if bare(program) else set()
        seconds[0], clock = seconds[0] + time.process_time() - clock, time.process_time()
        claim = adapter.solve(program, ACCURACY)
        seconds[1] += time.process_time() - clock
        if claim.status == "solved":
            assert claim.met(program, ACCURACY), f"{name}: {claim.message}"
            ours.add(name)
    with capsys.disabled():
        print(
            f"\n{seen} problems of at most {SMALLER} variables: bare PIQP {len(alone)} in {seconds[0]:.1f} s, ours "
            f"{len(ours)} in {seconds[1]:.1f} s"
        )
    assert seen >= 50
    assert alone <= ours, alone - ours
