"""Problems that many tests write: the spring-mass-damper of the paper, repaired, and the double integrator."""

from __future__ import annotations

from typing import Any


def spring(w: float, since: float | None = 0.3, **more: Any) -> dict[str, Any]:
    """``|x1| <= 0.7`` from the time ``since`` on, ``|w_i| <= w``; without a path where that is ``None``."""
    return {
        "name": "linear",
        "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
        "horizon": 5.0,
        "initial_state": [-1, 1],
        "control": {"box": 1.0},
        "disturbance": {"box": [w, w]},
        **({} if since is None else {"path": [{"box": [0.7, None], "from": since}]}),
        "terminal": [{"box": [0.3, 0.3]}],
        **more,
    }


def double_integrator(w: float) -> dict[str, Any]:
    """``|x1| <= 4.2`` and ``|x2| <= 1.6`` always, ``|w| <= w``."""
    return {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "E": [[0], [1]]},
        "horizon": 5.0,
        "initial_state": [4, 0],
        "control": {"box": 1.0},
        "disturbance": {"box": w},
        "path": [{"box": [4.2, 1.6]}],
        "terminal": [{"box": [0.5, 0.4]}],
    }
