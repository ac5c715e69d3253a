"""Families of the program that a config makes, for tests that look at one."""

from __future__ import annotations

from typing import Any

from sparserob_core.experiment.assemble import assemble
from sparserob_core.experiment.config.load import load_config
from sparserob_core.sip.program import ConstraintFamily


def family_of(config: dict[str, Any], name: str) -> ConstraintFamily:
    """A family of a config's program, in the user's units."""
    return assemble(load_config(config)).program.family(name)
