"""State-space models of other packages as systems of this package."""

from __future__ import annotations

from typing import Any

from sparserob_core.errors import InputError

SAMPLED = ("dt", "sampling_time", "SamplingPeriod")  # the step in python-control and scipy.signal, others, harold


def matrices_of(plant: object) -> tuple[Any, Any]:
    """Return the matrices of a state-space model.

    Parameters
    ----------
    plant : object
        A model in continuous time with the attributes ``A`` and ``B``, or ``a`` and ``b``.

    Returns
    -------
    A, B : arrays (d, d), (d, m)
        The matrices as the model has them.

    Raises
    ------
    InputError
        If the model has no such attributes, or is in discrete time.
    """
    matrices = {name: getattr(plant, name, getattr(plant, name.lower(), None)) for name in ("A", "B")}
    missing = [name for name, matrix in matrices.items() if matrix is None]
    if missing:
        raise InputError(
            path="plant",
            expected="a state-space model with matrices A and B (of a transfer function: its realisation, by ss or"
            " to_ss)",
            got=f"a {type(plant).__name__} without {' and '.join(missing)}",
        )
    step = _describe_step(plant)
    if step is not None:
        raise InputError(
            path="plant",
            expected="a system in continuous time: what is proven holds between the samples, which a discrete-time"
            " model knows nothing of",
            got=f"a sampled one, its step {step}",
        )
    return matrices["A"], matrices["B"]


def _describe_step(plant: object) -> str | None:
    """Return the sampling step of a model in words, or ``None`` where it is in continuous time.

    The package python-control writes continuous time as 0, and scipy.signal as ``None``.
    """
    for name in SAMPLED:
        step = getattr(plant, name, None)
        if step is True:
            return "not given"
        if isinstance(step, int | float) and step > 0:
            return f"{step:g}"
    return None
