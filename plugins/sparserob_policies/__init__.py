"""Registration of the policies, whose mathematics is the core's: the checker needs it too."""

from __future__ import annotations

from collections.abc import Iterator

import sparserob_core as sr


@sr.hookimpl
def sparserob_policies() -> Iterator[sr.PolicyPlugin]:
    """Offer ``open_loop`` and ``affine``."""
    yield sr.PolicyPlugin(
        name="open_loop",
        factory="sparserob_core.control.policies.policy:OpenLoop",
        summary="the control is fixed before the run",
    )
    yield sr.PolicyPlugin(
        name="affine",
        factory="sparserob_core.control.policies.affine:AffinePolicy",
        summary="the control answers affinely what the state at the breakpoints tells of the disturbance",
    )
