"""The typed options of a component: one declaration serves the constructor, the config and the printed table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sparserob_core.errors import InputError

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)


class Checked(ModelMetaclass):
    """Says what is wrong with the keywords of a constructor, as an `InputError` with one line for each."""

    def __call__(cls, *arguments: object, **keywords: object) -> Any:
        if arguments:
            raise InputError(f"{cls.__name__}: expected keywords only, got {len(arguments)} without a name")
        try:
            return super().__call__(**keywords)
        except ValidationError as error:
            raise InputError("\n".join(_sentences(cls.__name__, error))) from None


class Options(BaseModel, metaclass=Checked):
    """Base class of every component's options.

    A component may *be* its options (``class Ridge(Regulariser, Options)``): its fields are then the
    keyword arguments of its constructor, the keys of its config entry and the rows of
    ``sparserob plugins ridge``. Unknown keys, wrong types and values out of range are errors: the constructor raises
    `InputError` with one line for each.
    """

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        validate_default=True,
        arbitrary_types_allowed=True,
        use_attribute_docstrings=True,
    )


def part(kind: str) -> Any:
    """The default of an option that is itself a component of that kind: none.

    A config names the component; the registry builds it before the component that has the option. In Python the option
    takes the component itself.
    """
    return Field(default=None, json_schema_extra={"component": kind})


def _sentences(name: str, error: ValidationError) -> list[str]:
    found = [
        (".".join([name, *map(str, item["loc"])]), item["msg"].removeprefix("Value error, "), item["input"])
        for item in error.errors(include_url=False)
    ]
    return [f"{where}: {said}" if "got" in said else f"{where}: {said}, got {given!r}" for where, said, given in found]
