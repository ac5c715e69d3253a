"""Guards matrices that stand in files beside a config: the same numbers as written out, one digest whatever the file, a
run directory that needs no file, and one clear error for each way in which a file may be at fault."""

from __future__ import annotations

import base64
import copy
import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csr_array

import sparserob_core as sr
from sparserob_core.experiment.assemble import problem_of
from sparserob_core.experiment.check.check import check
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.config.matrices import files
from sparserob_core.experiment.config.matrices.packed import pack, unpack
from sparserob_core.experiment.config.reading.reader import write_yaml
from sparserob_core.experiment.sweep.plan import make_plan
from tests.support.places import PLANTS, needs_plants

A, B = np.array([[0.0, 1.0, 0.0], [-2.0, -0.5, 0.0], [0.0, 0.0, -1.0]]), np.array([[0.0], [1.0], [0.5]])
WRITTEN: dict[str, Any] = {
    "problem": {
        "name": "linear",
        "system": {"A": A.tolist(), "B": B.tolist(), "c": [0.0, 0.1, 0.0]},
        "horizon": 2.0,
        "initial_state": [-0.5, 0.2, 0.1],
        "control": {"box": 1.0},
        "terminal": [{"polytope": {"H": A[:2].tolist(), "h": 0.4}}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}},
    "observers": [],
}


def sparse(name: str, matrix: np.ndarray) -> dict[str, np.ndarray]:
    given = csr_array(matrix)
    parts = {"data": given.data, "indices": given.indices, "indptr": given.indptr, "shape": given.shape}
    return {f"{name}_{part}": np.asarray(value) for part, value in parts.items()}


def beside(folder: Path, **arrays: np.ndarray) -> Path:
    """A config whose matrices stand in a file beside it."""
    folder.mkdir(exist_ok=True)
    np.savez(folder / "plant.npz", **arrays)
    config = copy.deepcopy(WRITTEN)
    system = config["problem"]["system"]
    system |= {name: {"file": "plant.npz", "name": name} for name in ("A", "B", "c")}
    config["problem"]["terminal"][0]["polytope"]["H"] = {"file": "plant.npz", "name": "H"}
    (folder / "config.yaml").write_text(write_yaml(config))
    return folder / "config.yaml"


def good() -> dict[str, np.ndarray]:
    return {"A": A, "B": B, "c": np.array([0.0, 0.1, 0.0]), "H": A[:2]}


def test_a_matrix_from_a_file_is_the_matrix_that_it_is_dense_or_sparse(tmp_path: Path) -> None:
    parts = {**sparse("A", A), **sparse("B", B), **sparse("H", A[:2])}
    files_of = {"dense": good(), "sparse": {**parts, "c": np.array([[0.0], [0.1], [0.0]])}}
    loaded = [load_config(beside(tmp_path / name, **arrays)) for name, arrays in files_of.items()]
    for one in loaded:
        problem = problem_of(one)
        assert np.array_equal(problem.system.phases[0].A, A) and np.array_equal(problem.system.phases[0].B, B)
        assert np.array_equal(problem.system.phases[0].c, [[0.0], [0.1], [0.0]])
        assert np.array_equal(problem.terminal[0].H, A[:2])
    digests = {one.config.model_copy(update={"title": ""}).digest() for one in loaded}
    assert len(digests) == 1  # neither the path nor the form is part of what a run is


def test_other_numbers_are_another_run(tmp_path: Path) -> None:
    one, other = (
        load_config(beside(tmp_path / name, **{**good(), "A": A + off})) for name, off in (("x", 0), ("y", 1))
    )
    assert one.config.digest() != other.config.digest()


def test_a_run_needs_no_file_once_it_is_written(tmp_path: Path) -> None:
    config = beside(tmp_path / "given", **good())
    outcome = sr.run(config, out=tmp_path / "run", quiet=True, figures=False)
    (tmp_path / "given" / "plant.npz").unlink()
    assert outcome.status == "certified"
    assert check(tmp_path / "run").status == "verified"
    assert "plant.npz" not in (tmp_path / "run" / "config.yaml").read_text()


def test_a_study_needs_no_file_once_it_is_planned(tmp_path: Path) -> None:
    plan = make_plan(beside(tmp_path / "given", **good()), {"problem.control.box": [0.5, 1.0]})
    assert "plant.npz" not in plan.written()


def test_an_override_names_a_file_of_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = beside(tmp_path / "given", **good())
    np.savez(tmp_path / "other.npz", A=2 * A)
    monkeypatch.chdir(tmp_path)
    loaded = load_config(config, ["problem.system.A={file: other.npz, name: A}"])
    assert np.array_equal(problem_of(loaded).system.phases[0].A, 2 * A)


class Danger:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return (Path.touch, (Path("pickled"),))  # type: ignore[return-value]


def changed(**arrays: np.ndarray) -> dict[str, np.ndarray]:
    return {**{key: value for key, value in good().items() if key != "A"}, **sparse("A", A), **arrays}


BAD: dict[str, tuple[dict[str, np.ndarray], str]] = {
    "a pickle": ({**good(), "A": np.array([[Danger()]], dtype=object)}, "plant.npz"),
    "complex": ({**good(), "A": A * 1j}, "plant.npz.A"),
    "truth values": ({**good(), "A": A > 0}, "plant.npz.A"),
    "text": ({**good(), "A": A.astype(str)}, "plant.npz.A"),
    "three axes": ({**good(), "A": A[None]}, "plant.npz.A"),
    "nothing in it": ({**good(), "A": A[:0]}, "plant.npz.A"),
    "NaN": ({**good(), "A": np.where(A == 1.0, np.nan, A)}, "plant.npz.A"),
    "infinite": (changed(A_data=np.array([1.0, np.inf, -0.5, -1.0])), "plant.npz.A_data"),
    "missing part": ({k: v for k, v in changed().items() if k != "A_indptr"}, "plant.npz.A"),
    "pointers that decrease": (changed(A_indptr=np.array([0, 3, 1, 4])), "plant.npz.A_indptr"),
    "pointers beyond": (changed(A_indptr=np.array([0, 1, 3, 9])), "plant.npz.A_indptr"),
    "too few pointers": (changed(A_indptr=np.array([0, 4])), "plant.npz.A_indptr"),
    "pointers that are no whole numbers": (changed(A_indptr=np.array([0.0, 1, 3, 4])), "plant.npz.A_indptr"),
    "a column that is not there": (changed(A_indices=np.array([1, 0, 1, 7])), "plant.npz.A_indptr"),
    "a column just beyond": (changed(A_indices=np.array([1, 0, 1, 3])), "plant.npz.A_indptr"),
    "a negative column": (changed(A_indices=np.array([-1, 0, 1, 2])), "plant.npz.A_indptr"),
    "ragged": (changed(A_indices=np.array([1, 0, 1])), "plant.npz.A_indptr"),
    "a huge shape": (changed(A_shape=np.array([10**9, 10**9])), "plant.npz.A_shape"),
    "a negative shape": (changed(A_shape=np.array([-3, -3])), "plant.npz.A_shape"),
    "three sizes": (changed(A_shape=np.array([3, 3, 1])), "plant.npz.A_shape"),
}


@pytest.mark.first(10)
@pytest.mark.parametrize("name", BAD)
def test_a_file_at_fault_is_refused_with_key_file_and_array(name: str, tmp_path: Path) -> None:
    arrays, array = BAD[name]
    with pytest.raises(sr.ConfigError) as refused:
        load_config(beside(tmp_path / "given", **arrays))
    said = str(refused.value)
    assert "problem.system.A: " in said and array in said and "expected" in said
    assert all("expected" in line for line in said.split("\n"))
    assert not Path("pickled").exists()


def test_what_names_no_file_or_no_matrix_of_it_is_refused(tmp_path: Path) -> None:
    config = beside(tmp_path / "given", **good())
    (tmp_path / "given" / "text.npz").write_text("no archive")
    for given in (
        {"file": "none.npz", "name": "A"},
        {"file": ".", "name": "A"},
        {"file": "config.yaml", "name": "A"},
        {"file": "text.npz", "name": "A"},
        {"file": "plant.npz", "name": "Q"},
        {"file": "plant.npz", "name": 3},
        {"file": 3, "name": "A"},
        {"file": "plant.npz"},
        {"file": "plant.npz", "name": "A", "more": 1},
    ):
        with pytest.raises(sr.ConfigError) as refused:
            load_config(config, {"problem.system.A": given})
        assert "problem.system.A" in str(refused.value) and "expected" in str(refused.value)


def test_a_file_that_pretends_to_hold_much_is_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = beside(tmp_path / "given", **good())
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**7, 10**6)})
    with zipfile.ZipFile(tmp_path / "given" / "plant.npz", "w") as archive:
        archive.writestr("A.npy", head.getvalue())
    with pytest.raises(sr.ConfigError):
        load_config(config)
    monkeypatch.setattr(files, "MAX_MATRIX_FILE_BYTES", 100)
    np.savez_compressed(tmp_path / "given" / "plant.npz", A=np.zeros((50, 50)))
    with pytest.raises(sr.ConfigError, match="at most 100 bytes"):
        load_config(config)


def test_matrices_that_no_directory_could_hold_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MAX_PACKED_LETTERS", 10)
    with pytest.raises(sr.ConfigError, match="at most 10 characters"):
        load_config(beside(tmp_path / "given", **good()))


@pytest.mark.parametrize("matrix", [A, B, A[:1], np.ones((3, 4)), np.zeros((2, 2)), np.array([[1e-300, -0.5]])])
def test_a_matrix_in_one_text_comes_back(matrix: np.ndarray) -> None:
    assert np.array_equal(unpack(pack(matrix)).array, matrix)


def test_a_text_that_is_no_matrix_is_refused() -> None:
    good_text = pack(A)
    kind = next(key for key in good_text if key != "shape")
    nan = base64.b64encode(np.full(9, np.nan).tobytes()).decode()
    for wrong in (
        {"shape": [3, 3]},
        {**good_text, "more": 1},
        {**good_text, "shape": [3, 4] if kind == "dense" else [4, 3]},
        {**good_text, "shape": [10**6, 10**6]},
        {**good_text, "shape": [3, -3]},
        {**good_text, "shape": "33"},
        {**good_text, "shape": [3, True]},
        {**good_text, kind: "?"},
        {**good_text, kind: 5},
        {**good_text, kind: good_text[kind][:-8]},
        {"shape": [3, 3], "dense": nan},
        {"shape": [1, 3], "csr": base64.b64encode(np.array([0, 9], "<i4").tobytes()).decode()},
        {"shape": [1, 3], "csr": base64.b64encode(np.array([0, 1, 7, 0, 0], "<i4").tobytes()).decode()},
    ):
        with pytest.raises(sr.InputError):
            unpack(wrong)


def test_a_directory_that_somebody_left_names_no_file(tmp_path: Path) -> None:
    from sparserob_core.experiment.plugins.registry import load_registry

    with pytest.raises(sr.ConfigError):
        load_config(beside(tmp_path / "given", **good()), known=load_registry())


def test_sparse_matrices_of_scipy_stand_where_arrays_do() -> None:
    system = sr.LinearSystem(csr_array(A), csr_array(B), csr_array(np.eye(3)), c=csr_array(B))
    assert (
        np.array_equal(system.phases[0].A, A)
        and np.array_equal(system.phases[0].B, B)
        and np.array_equal(system.phases[0].c, B)
    )
    assert np.array_equal(sr.Polytope(csr_array(A[:2]), [1, 1]).H, A[:2])
    assert np.array_equal(sr.Ellipsoid(np.zeros(3), csr_array(np.eye(3))).shape, np.eye(3))
    problem = sr.OptimalControlProblem(
        system=system,
        horizon=1.0,
        initial_state=np.zeros(3),
        control=sr.Box([-1], [1]),
        path=[sr.MixedConstraint(csr_array(A[:1]), csr_array(B[:1] + 1), 1.0)],
        integral=[sr.IntegralConstraint(H=csr_array(A[:1]), upper=1.0)],
        cost=sr.Cost(state={"Q": csr_array(np.eye(3))}),
        measurements=sr.Measurements(csr_array(A[:1])),
    )
    assert np.array_equal(problem.path[0].H, A[:1]) and np.array_equal(problem.integral[0].H, A[:1])
    assert np.array_equal(problem.measurements.C, A[:1])


def test_a_config_in_python_takes_sparse_matrices() -> None:
    config = copy.deepcopy(WRITTEN)
    config["problem"]["system"]["A"] = csr_array(A)
    assert np.array_equal(problem_of(load_config(config)).system.phases[0].A, A)


@needs_plants
@pytest.mark.parametrize(
    ("plant", "states"), [("iss", 270), ("building", 48), ("heat", 200), ("pde", 84), ("beam", 348)]
)
def test_plants_of_others_are_read(plant: str, states: int, tmp_path: Path) -> None:
    (tmp_path / f"{plant}.npz").write_bytes((PLANTS / f"{plant}.npz").read_bytes())
    config = {
        **WRITTEN,
        "problem": {
            **WRITTEN["problem"],
            "system": {name: {"file": f"{plant}.npz", "name": name} for name in "AB"},
            "initial_state": 0,
            "terminal": [{"polytope": {"H": {"file": f"{plant}.npz", "name": "C"}, "h": 1}}],
        },
    }
    (tmp_path / "config.yaml").write_text(write_yaml(config))
    problem = problem_of(load_config(tmp_path / "config.yaml"))
    assert problem.system.states == problem.terminal[0].dimension == states
