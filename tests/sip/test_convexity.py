"""Guards sip/convexity: no quadratic form from outside is taken that is not symmetric and positive semidefinite but for
rounding, in whatever units, however large, and wherever it enters."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import block_diag, csc_array, csr_array, diags_array, eye_array, kron

import sparserob_core as sr
from sparserob_core.experiment.cli.main import _run_command_line
from sparserob_core.sip import convexity
from sparserob_core.sip.convexity import (
    ENTRY_ROUNDING,
    convex_by_construction,
    is_definite,
    is_semidefinite,
    require_convex,
)

FAMILY = sr.ConstraintFamily(
    name="f", index_set=sr.Box([0.0], [1.0]),
    rows=lambda t: (np.stack([np.ones(len(t)), t[:, 0]], 1)[:, None], 3 + 0 * t),
)  # fmt: skip
HOLLOW = {
    "saddle": (np.diag([1.0, -1.0]), "P: .*the eigenvalue -1$"),
    "product of two": ([[0.0, 1.0], [1.0, 0.0]], "P: .*the eigenvalue -1$"),
    "hill": (-np.eye(2), "P: .*the eigenvalue -1$"),
    "a little hollow": (np.diag([1.0, -1e-6]), "P: .*the eigenvalue -1e-06$"),
    "hollow beside 0": ([[1.0, 1e-9], [1e-9, 0.0]], "P: .*the eigenvalue -1e-18$"),
    "upper triangle": ([[1.0, 1.0], [0.0, 1.0]], "P: expected a symmetric matrix, got .*1 in row 1, column 2"),
    "lower triangle": ([[1.0, 0.0], [1.0, 1.0]], "P: expected a symmetric matrix, got 1 in row 2, column 1"),
    "skew part": ([[1.0, 2.0], [-2.0, 1.0]], "P: expected a symmetric matrix, got -2 in row 2, column 1 and 2 in"),
    "not a number": (np.diag([1.0, np.nan]), "P: expected a matrix of finite numbers, got nan in row 2, column 2"),
    "infinite": ([[1.0, np.inf], [np.inf, 1.0]], "P: expected a matrix of finite numbers, got inf in row 2, column 1"),
    "complex": (1j * np.eye(2), "P: expected a matrix of numbers"),
    "words": ([["a", "b"], ["c", "d"]], "P: expected a matrix of numbers"),
    "other size": (np.eye(3), r"P: expected shape \(2, 2\), got \(3, 3\)"),
    "other units": (np.diag([1e12, -1e-12]), "P: .*the eigenvalue -1e-12$"),
    "other units, coupled": (
        [[1e12, 1.0 + 1e-6], [1.0 + 1e-6, 1e-12]],
        "P: .*-1e-06 where its diagonal is scaled to 1",
    ),
}


@pytest.mark.parametrize("name", HOLLOW)
@pytest.mark.parametrize("families", [(), (FAMILY,)])
@pytest.mark.parametrize("form", [np.array, csc_array, csr_array])
def test_a_program_with_a_form_that_is_not_convex_cannot_be_made(name, families, form):
    P, words = HOLLOW[name]
    form = np.array if name == "words" else form  # there is no sparse matrix of words
    with pytest.raises(sr.InputError, match=words) as caught:
        sr.SemiInfiniteProgram(n=2, P=form(np.array(P)), lower=-1.0, upper=1.0, families=families)
    assert caught.value.exit_status == 2


@pytest.mark.parametrize("name", HOLLOW)
def test_a_program_with_another_form_is_looked_at_again(name):
    program = sr.SemiInfiniteProgram(n=2, P=np.eye(2), lower=-1.0, upper=1.0)
    with pytest.raises(sr.InputError, match=HOLLOW[name][1]):
        replace(program, P=np.array(HOLLOW[name][0]))


@pytest.mark.parametrize("name", HOLLOW)
def test_so_is_the_second_objective(name):
    with pytest.raises(sr.InputError, match=HOLLOW[name][1]):
        sr.SemiInfiniteProgram(n=2, among=(sr.SemiInfiniteProgram(n=2, P=np.array(HOLLOW[name][0])), 2))


def product(rng, n, rank, sparse=1.0):
    """``L L'`` of some rank, in units that are up to 1e12 apart; symmetric to the last digit on every processor."""
    L = rng.normal(size=(n, rank)) * (rng.random((n, rank)) < sparse)
    units = 10.0 ** rng.uniform(-6.0, 6.0, (n, 1))
    P = (units * L) @ (units * L).T
    return (P + P.T) / 2, units[:, 0]


@pytest.mark.parametrize("seed", range(200))
def test_products_pass_in_all_units_and_fail_with_a_hollow_of_a_millionth(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 40))
    P, _ = product(rng, n, int(rng.integers(1, n + 1)), sparse=float(rng.choice([0.3, 1.0])))
    kept = require_convex("P", P, n)
    assert np.array_equal(kept.toarray(), P)
    size = np.sqrt(P.diagonal())
    if (size > 0.0).all():
        values, vectors = np.linalg.eigh(P / np.outer(size, size))
        along = vectors[:, 0] * size
        hollow = P - (max(values[0], 0.0) + 1e-6) * np.outer(along, along)
        with pytest.raises(sr.InputError, match="eigenvalue"):
            require_convex("P", (hollow + hollow.T) / 2, n)


@pytest.mark.parametrize("seed", range(20))
def test_eigenvalues_that_are_rounding_pass(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 30))
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    values = np.append(rng.random(n - 1), -1e-14)
    P = turn @ np.diag(values) @ turn.T  # not symmetric in its last digits
    assert not np.array_equal(P, P.T)
    kept = require_convex("P", P, n)
    assert np.array_equal(kept.toarray(), kept.toarray().T)
    assert np.allclose(kept.toarray(), P, rtol=0.0, atol=1e-15)
    values[-1] = -1e-6
    with pytest.raises(sr.InputError, match="eigenvalue -1e-06"):
        require_convex("P", turn @ np.diag(values) @ turn.T, n)


def test_asymmetry_is_rounding_up_to_thirteen_digits():
    P = np.array([[4e12, 1.0], [1.0, 1e-12]])
    P[0, 1] += 1.5e-13
    assert require_convex("P", P, 2)[0, 1] == require_convex("P", P, 2)[1, 0]
    P[0, 1] += 1e-11
    with pytest.raises(sr.InputError, match="symmetric"):
        require_convex("P", P, 2)


def test_a_form_of_whole_numbers_with_duplicates_and_zeros_is_taken_as_it_is():
    P = csc_array((np.array([1, 1, 2, 0]), (np.array([0, 0, 1, 0]), np.array([0, 0, 1, 1]))), shape=(2, 2))
    kept = require_convex("P", P, 2)
    assert kept.dtype == float and kept.toarray().tolist() == [[2.0, 0.0], [0.0, 2.0]]
    assert require_convex("P", np.zeros((3, 3)), 3).nnz == 0
    assert require_convex("P", np.eye(1, dtype=bool), 1).toarray().tolist() == [[1.0]]


def biharmonic(side):
    """The square of a grid's Laplacian without boundary: singular, and not dominated by its diagonal."""
    one = diags_array(
        [-np.ones(side - 1), np.r_[1.0, np.full(side - 2, 2.0), 1.0], -np.ones(side - 1)], offsets=[-1, 0, 1]
    )
    grid = kron(one, eye_array(side)) + kron(eye_array(side), one)
    return csc_array(grid @ grid)


def dense_blocks(rng, n, hollow=0.0):
    """Two dense blocks without full rank, one of them less ``hollow`` of the identity, and small ones."""
    blocks = [product(rng, 450, 200)[0], product(rng, 20, 20)[0]] + [product(rng, 4, 2)[0] for _ in range(n // 4)]
    if hollow:
        blocks[0] -= hollow * np.diag(blocks[0].diagonal())
    return csc_array(block_diag(blocks))


def banded(rng, n, width=6, hollow=0.0):
    """``B B'`` with a band ``B``, and two variables of their own, whose form is singular or hollow."""
    B = diags_array([rng.normal(size=n) for _ in range(width)], offsets=list(range(width)), shape=(n, n + width))
    units = diags_array(10.0 ** rng.uniform(-6.0, 6.0, n))
    pair = np.array([[1e6, 1.0 + hollow], [1.0 + hollow, 1e-6]])
    return csc_array(block_diag([units @ B @ B.T @ units, pair]))


@pytest.mark.parametrize(
    ("good", "bad"),
    [
        (biharmonic(30), biharmonic(30) - 1e-6 * eye_array(900)),
        (dense_blocks(np.random.default_rng(1), 2000), dense_blocks(np.random.default_rng(1), 2000, hollow=1e-6)),
        (banded(np.random.default_rng(2), 2000), banded(np.random.default_rng(2), 2000, hollow=1e-6)),
        (csc_array(product(np.random.default_rng(3), 1100, 10)[0]),
         csc_array(product(np.random.default_rng(3), 1100, 10)[0] - 1e-6 * eye_array(1100))),
    ],
    ids=["biharmonic", "dense blocks", "band", "dense"],
)  # fmt: skip
def test_large_forms_are_told_apart_from_hollow_ones(good, bad):
    n = good.shape[0]
    require_convex("P", good, n)
    with pytest.raises(sr.InputError, match=r"eigenvalue (of at most )?-"):
        require_convex("P", bad, n)


@pytest.mark.parametrize("n", [5, 401, 1300])
@pytest.mark.parametrize("seed", range(3))
def test_a_direction_that_refuses_a_form_shows_it(n, seed, monkeypatch):
    """What is found is negative along it: by a dense factorisation, and by a sparse one."""
    rng = np.random.default_rng(seed)
    P = csc_array(block_diag([product(rng, 5, 3)[0] for _ in range(n // 5)]))
    k = int(rng.integers(P.shape[0]))
    P[k, k] *= 1.0 - 1e-3
    for full in (0.0, 2.0):
        monkeypatch.setattr(convexity, "FULL", full)
        monkeypatch.setattr(convexity, "MAX_DENSE_ROWS", 0)
        direction = convexity._find_negative_direction(P)
        size = np.sqrt(P.diagonal())
        if direction is None:
            direction = np.zeros(P.shape[0])
        block = (P / np.outer(size, size))[k // 5 * 5 :, k // 5 * 5 :].toarray()[:5, :5]
        assert (np.linalg.eigvalsh(block)[0] < -1e-11) == bool(direction.any())
        assert not direction.any() or direction @ (P @ direction) < 0.0


def test_definite_is_more_than_semidefinite():
    singular = csc_array(np.ones((3, 3)))
    assert is_semidefinite(singular) and not is_definite(singular, 1.0 - 1e-12) and is_definite(singular, 1.0 + 1e-12)


def test_the_same_form_is_looked_at_once(monkeypatch):
    program = sr.SemiInfiniteProgram(n=2, P=np.array([[2.0, 1.0], [1.0, 2.0]]), lower=-1.0, upper=1.0)
    monkeypatch.setattr(convexity, "_find_negative_direction", lambda P: pytest.fail("looked at again"))
    assert replace(program, lower=-2.0).P is program.P
    made = convex_by_construction(csc_array(np.diag([1.0, 2.0])))
    assert sr.SemiInfiniteProgram(n=2, P=made).P is made
    with pytest.raises(ValueError, match="read-only"):
        made.data[0] = -1.0


def test_what_is_kept_cannot_be_made_hollow_afterwards():
    given = csc_array(np.eye(2))
    program = sr.SemiInfiniteProgram(n=2, P=given)
    given.data[0] = -1.0
    assert program.P.toarray().tolist() == np.eye(2).tolist()
    with pytest.raises(sr.InputError, match="eigenvalue -1"):
        replace(program, P=given)


class Odd(sr.Regulariser):
    """A regulariser with any matrix, however large the decision."""

    def __init__(self, block):
        self.block = np.array(block)

    def quadratic(self, image):
        n = image.S.shape[1]
        return csc_array(block_diag([self.block, eye_array(n - len(self.block))])), np.zeros(n)


@pytest.mark.parametrize("name", [name for name in HOLLOW if name not in ("other size", "words", "complex")])
def test_no_regulariser_that_is_not_convex_is_used(name):
    program = sr.SemiInfiniteProgram(n=2, q=[1.0, 0.0], lower=-1.0, upper=1.0, families=[FAMILY])
    with pytest.raises(sr.InputError, match="regulariser Odd .*: quadratic: " + HOLLOW[name][1]):
        sr.solve(program, regulariser=Odd(HOLLOW[name][0]))


def test_every_shipped_regulariser_passes():
    from sparserob_core.testing.dictionaries import images

    registry = sr.load_registry()
    for name in registry.names("regulariser"):
        for image in images():
            P, _ = registry.build("regulariser", name).quadratic(image)
            require_convex(name, csc_array(P), image.S.shape[1])


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ("problem: {name: odd}", "P: expected a positive semidefinite matrix, got the eigenvalue -1"),
        ("regulariser: odd", "quadratic: P: expected a symmetric matrix, got 0 in row 2, column 1 and 1 in row 1,"),
        ("problem.cost: {state: {Q: [[-1.0e-6]]}}", "cost.state.Q: expected a positive semidefinite matrix, got the"),
    ],
)  # fmt: skip
def test_the_command_ends_with_status_2(config, words, tmp_path: Path, capsys) -> None:
    (tmp_path / "odd.py").write_text(
        "import numpy as np\nimport sparserob_core as sr\n"
        "class Problem(sr.ProblemFactory, sr.Options):\n    def build(self):\n"
        "        return sr.SemiInfiniteProgram(n=2, P=-np.eye(2), lower=-1.0, upper=1.0)\n"
        "class Term(sr.Regulariser, sr.Options):\n    def quadratic(self, image):\n"
        "        P = np.eye(image.S.shape[1])\n        P[0, 1] = 1.0\n        return P, np.zeros(len(P))\n"
        "@sr.hookimpl\ndef sparserob_problems():\n    yield sr.ProblemPlugin(name='odd', factory=Problem)\n"
        "@sr.hookimpl\ndef sparserob_regularisers():\n    yield sr.RegulariserPlugin(name='odd', factory=Term)\n"
    )
    problem = {
        "name": "linear", "horizon": 1.0, "system": {"A": [[0.0]], "B": [[1.0]]}, "initial_state": [1.0],
        "control": {"box": 4.0}, "path": [{"box": 2.0}], "terminal": [{"box": 0.1}],
    }  # fmt: skip
    (tmp_path / "odd.yaml").write_text(f"plugins: [odd.py]\nobservers: []\nproblem: {problem}\n".replace("'", '"'))
    key, _, value = config.partition(": ")
    arguments = ["run", str(tmp_path / "odd.yaml"), f"{key}={value}", "--out", str(tmp_path / "run"), "--no-figures"]
    assert _run_command_line(arguments) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert words in said and "Traceback" not in said, said


@pytest.mark.parametrize("kind", ["band", "blocks", "dense"])
def test_a_look_costs_little_beside_the_solution(kind, monkeypatch):
    """The look takes less than a third of the processor time of a solution without families, which is the shortest."""
    rng, spent, look = np.random.default_rng(0), [0.0], convexity._find_negative_direction
    if kind == "band":
        B = diags_array([rng.normal(size=100_000) for _ in range(4)], offsets=list(range(4)), shape=(100_000, 100_003))
        P = csc_array(B @ B.T)
    elif kind == "blocks":
        roots = [rng.normal(size=(10, 6)) for _ in range(5_000)] + [rng.normal(size=(300, 100))]
        P = csc_array(block_diag([root @ root.T for root in roots]))
    else:
        root = rng.normal(size=(400, 100))
        P = csc_array(root @ root.T)

    def timed(P):
        clock = time.process_time()
        found = look(P)
        spent[0] += time.process_time() - clock
        return found

    require_convex("P", biharmonic(25), 625)  # imports
    monkeypatch.setattr(convexity, "_find_negative_direction", timed)
    clock = time.process_time()
    n = P.shape[0]
    result = sr.solve(sr.SemiInfiniteProgram(n=n, P=P, q=rng.normal(size=n), lower=-1.0, upper=1.0))
    assert result.status == "certified"
    assert 0.0 < spent[0] < (time.process_time() - clock) / 3.0


def test_the_share_that_is_rounding_is_that_of_thirteen_digits():
    """Ten times larger, and this hollow would pass; ten times smaller, and long products would not."""
    assert is_semidefinite(csc_array([[1.0, 1.0 + ENTRY_ROUNDING], [1.0 + ENTRY_ROUNDING, 1.0]]))
    assert not is_semidefinite(csc_array([[1.0, 1.0 + 10 * ENTRY_ROUNDING], [1.0 + 10 * ENTRY_ROUNDING, 1.0]]))
