"""The typed options of a component: one declaration serves the constructor, the config and the printed table."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
import warnings
from collections.abc import Iterator, Mapping
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from sparserob_core.errors import InputError

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)


class Checked(ModelMetaclass):
    """Says what is wrong with the keywords of a constructor, as an `InputError` with one line for each.

    A class with an option whose name its bases use, or a method of its own, is refused when it is made: the option
    would take the place of what is called by that name.
    """

    def __new__(mcs, name: str, bases: tuple[type, ...], namespace: dict[str, Any], **keywords: Any) -> type:
        if not isinstance(namespace.get("model_config", {}), Mapping):
            raise InputError(f"{name}: the option 'model_config' bears a name that pydantic uses; rename it")
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Field name .* shadows")  # what is hidden is an error below
                model: type = super().__new__(mcs, name, bases, namespace, **keywords)
        except (ValueError, NameError) as error:  # by pydantic, whose classes differ
            hidden = re.search(r"Field ['\"](\w+)['\"] conflicts with member", str(error))
            if hidden is None:
                raise
            raise InputError(f"{name}: the option {hidden[1]!r} bears a name that pydantic uses; rename it") from None
        for key, owner in _find_hidden_names(model):
            raise InputError(f"{name}: the option {key!r} bears a name that {owner} uses; rename it")
        return model

    def __call__(cls, *arguments: object, **keywords: object) -> Any:
        if arguments:
            raise InputError(f"{cls.__name__}: expected keywords only, got {len(arguments)} without a name")
        try:
            return super().__call__(**keywords)
        except ValidationError as error:
            raise InputError("\n".join(_describe_errors(cls.__name__, error))) from None


def _find_hidden_names(model: type) -> Iterator[tuple[str, str]]:
    """The options of a class that hide an attribute of one of its bases, or that a method of its own hides, with the
    class that has the attribute."""
    fields: Mapping[str, Any] = getattr(model, "model_fields", {})
    for key, field in fields.items():
        hidden = (base for base in model.__mro__[1:] if key in vars(base))
        owner = next(hidden, model if inspect.isroutine(field.default) or isinstance(field.default, property) else None)
        if owner is not None:
            yield key, owner.__name__


class Exact(BaseModel):
    """A model that takes no truth value and no text for a number: ``true`` is not 1, and ``"5"`` is not 5."""

    @field_validator("*", mode="before")
    @classmethod
    def _reject_disguised_numbers(cls, value: object, info: ValidationInfo) -> object:
        allowed = set(_list_types(cls.model_fields[str(info.field_name)].annotation))
        is_sequence = isinstance(value, list | tuple)
        if {int, float} & allowed and not {Any, object} & allowed and (is_sequence or not {list, tuple} & allowed):
            for scalar in _list_scalars(value):
                true_or_false = isinstance(scalar, bool) and bool not in allowed
                if true_or_false or (isinstance(scalar, str) and str not in allowed and _is_number_text(scalar)):
                    raise InputError("must be a number" if not is_sequence else "every entry must be a number")
        return value


def _is_number_text(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False  # what it is instead, the field itself says
    return True


def _list_types(annotation: object) -> Iterator[object]:
    """Every type inside an annotation such as ``list[float | None]``; a literal counts as the types of its values."""
    arguments = get_args(annotation)
    if arguments:
        yield get_origin(annotation)
    else:
        yield type(annotation) if isinstance(annotation, str | bool | int | float) else annotation
    for argument in arguments:
        yield from _list_types(argument)


def _list_scalars(value: object) -> Iterator[object]:
    """Yield every value inside nested lists and tuples. Mappings are skipped: their fields have checks of their own."""
    if isinstance(value, list | tuple):
        for item in value:
            yield from _list_scalars(item)
    elif not isinstance(value, Mapping):
        yield value


class Options(Exact, metaclass=Checked):
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
        defer_build=True,
    )


@cache
def meanings(model: type[BaseModel]) -> Mapping[str, str]:
    """Return the meaning of each field of a model: its description, or else the docstring below it.

    The source is read at the first call and not when the class is made, which took a third of the start of the program.
    """
    descriptions = {}
    for name, field in model.model_fields.items():
        owner = next((base for base in model.__mro__ if name in inspect.get_annotations(base)), model)
        descriptions[name] = field.description or _read_docstrings(owner).get(name, "")
    return descriptions


@cache
def _read_docstrings(owner: type) -> Mapping[str, str]:
    """The docstrings below the attributes of a class; none where its source is not to be had."""
    try:
        body = ast.parse(textwrap.dedent(inspect.getsource(owner))).body[0]
    except (OSError, TypeError, SyntaxError):
        return {}
    docstrings = {}
    for node, below in pairwise(getattr(body, "body", [])):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and isinstance(below, ast.Expr):
            text = below.value.value if isinstance(below.value, ast.Constant) else None
            if isinstance(text, str):
                docstrings[node.target.id] = inspect.cleandoc(text)
    return docstrings


def part(kind: str, of: type | None = None) -> Any:
    """The default of an option that is itself a component of that kind: none. ``of``: the class of those that will do,
    where not all of the kind do.

    A config names the component; the registry builds it before the component that has the option. In Python the option
    takes the component itself.
    """
    restriction = {} if of is None else {"of": f"{of.__module__}:{of.__qualname__}"}
    return Field(default=None, json_schema_extra={"component": kind, **restriction})


def _describe_errors(name: str, error: ValidationError) -> list[str]:
    sentences = []
    for item in error.errors(include_url=False):
        cause = item.get("ctx", {}).get("error")  # what a validator has raised
        text = item["msg"] if cause is None else str(cause)
        got = "" if isinstance(cause, InputError) and cause.got else f", got {item['input']!r}"
        sentences.append(f"{'.'.join([name, *map(str, item['loc'])])}: {text}{got}")
    return sentences
