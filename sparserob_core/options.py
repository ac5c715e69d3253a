"""The typed options of a component: one declaration serves the constructor, the config and the printed table."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Options(BaseModel):
    """Base class of every component's options.

    A component may *be* its options (``class Ridge(Regulariser, Options)``): its fields are then the
    keyword arguments of its constructor, the keys of its config entry and the rows of
    ``sparserob plugins ridge``. Unknown keys, wrong types and values out of range are errors.
    """

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        validate_default=True,
        arbitrary_types_allowed=True,
        use_attribute_docstrings=True,
    )
