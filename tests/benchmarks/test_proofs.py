"""Guards speed: how solve and proof grow with the number of uncertain parameters, for two and for four states."""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.proof.branch_and_bound import prove

SPREAD = 0.1
"""Half the width of every parameter."""
PIECES = 100


@dataclass(frozen=True)
class Measured:
    """One line of the table."""

    plant: str
    parameters: int
    solve: float
    prove: float
    cells: int
    status: str
    cost: float


def spring_mass_damper(count):
    """Stiffness, damping, gain, and how the damper couples back, as many of them uncertain as ``count``."""

    def A(p):
        return np.array(
            [[0 * p[0], 1 + (p[3] if count > 3 else 0 * p[0])], [-2 + p[0], -0.5 + (p[1] if count > 1 else 0)]],
            dtype=object,
        )

    def B(p):
        return np.array([[0 * p[0]], [1 + (p[2] if count > 2 else 0 * p[0])]], dtype=object)

    return A, B, [-1.0, -1.0], [0.5, np.inf], [0.1, 0.1]


def coupled_masses(count):
    """Two unit masses in a row, both pushed: two stiffnesses and two dampings."""

    def A(p):
        k, c = (
            [1 + p[0], 2 + (p[1] if count > 1 else 0)],
            [0.4 + (p[2] if count > 2 else 0), 0.4 + (p[3] if count > 3 else 0)],
        )
        return np.array(
            [[0, 0, 1, 0], [0, 0, 0, 1], [-k[0] - k[1], k[1], -c[0], 0], [k[1], -k[1], 0, -c[1]]], dtype=object
        )

    return (
        A,
        [[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [0.0, 1.0]],
        [0.5, -0.5, 0.0, 0.0],
        [0.5, 0.5, np.inf, np.inf],
        [0.2, 0.2, 0.2, 0.2],
    )


PLANTS = {"spring-mass-damper (2 states)": spring_mass_damper, "coupled masses (4 states)": coupled_masses}


def problem(plant, count):
    A, B, start, path, terminal = PLANTS[plant](count)
    box, limits = np.full(count, SPREAD), np.ones(len(start) // 2)
    return sr.OptimalControlProblem(
        system=sr.LinearSystem(A, B, parameters=sr.Box(-box, box)),
        horizon=5.0,
        initial_state=start,
        control=sr.Box(-limits, limits),
        path=[sr.PathConstraint(sr.Box(-np.array(path), path), 1.6, 5.0)],
        terminal=[sr.Box(-np.array(terminal), terminal)],
    )


def transcribed(plant, count):
    return sr.transcribe(
        problem(plant, count), control=sr.Dictionary(np.linspace(0.0, 5.0, PIECES + 1), np.eye(PIECES))
    )


def measured(plant, count):
    """A solve from scratch, proof included, and the proof alone, from scratch too."""
    start = time.perf_counter()
    result = sr.solve(transcribed(plant, count), method="exchange", solver="piqp", tolerance=1e-6)
    solved, program = time.perf_counter() - start, transcribed(plant, count)
    start = time.perf_counter()
    proofs = prove(program, result.decision)
    proven = time.perf_counter() - start
    assert all(proof.verdict == "proven" for proof in proofs)
    return Measured(plant, count, solved, proven, sum(proof.cells for proof in proofs), result.status, result.cost)


def table(lines):
    head = f"\n{'plant':32} {'parameters':>10} {'solve, s':>10} {'proof, s':>10} {'cells':>8} {'J':>10}"
    return "\n".join(
        [
            head,
            *(
                f"{line.plant:32} {line.parameters:10} {line.solve:10.2f} {line.prove:10.2f} {line.cells:8}"
                f" {line.cost:10.6f}"
                for line in lines
            ),
        ]
    )


@pytest.mark.benchmark
def test_the_proof_grows_politely_with_the_number_of_parameters(capsys):
    """Cells, and so the memory of the certificate, at most five times as many per parameter; every solve below a
    minute."""
    measured("coupled masses (4 states)", 1)  # warm
    lines = [measured(plant, count) for plant in PLANTS for count in (1, 2, 3, 4)]
    with capsys.disabled():
        print(table(lines))
    for line, more in itertools.pairwise(lines):
        assert line.status == "certified"
        assert line.solve < 60.0
        if more.plant == line.plant:
            assert more.cells <= 5 * line.cells
            assert more.cost >= line.cost - 1e-6, "more uncertainty cannot cost less"
