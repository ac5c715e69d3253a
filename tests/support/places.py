"""Where things stand: in the source tree, and the plants that others wrote."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"
PLANTS = Path(os.environ.get("SPARSEROB_PLANTS", "plants"))  # of other collections, which may be absent
needs_plants = pytest.mark.skipif(not PLANTS.is_dir(), reason="SPARSEROB_PLANTS names no folder of plants")


def matrices(plant: str) -> dict[str, np.ndarray]:
    """``A``, ``B`` and ``C`` of a plant in `PLANTS`, dense."""
    data = np.load(PLANTS / f"{plant}.npz")
    parts = ("data", "indices", "indptr")
    return {
        key: csr_array(tuple(data[f"{key}_{part}"] for part in parts), shape=tuple(data[f"{key}_shape"])).toarray()
        for key in "ABC"
    }
