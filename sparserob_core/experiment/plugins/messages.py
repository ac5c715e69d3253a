"""Errors of an input, one sentence per key: the errors of pydantic in the words of this project."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, get_args

from pydantic import BaseModel

from sparserob_core.encodings import as_utf8
from sparserob_core.errors import InputError, Path, dotted

if TYPE_CHECKING:
    from pydantic import ValidationError

MAX_INPUT_LETTERS = 60  # of a value of a config in a message
COMPLAINT = "complaint"  # the type of an error whose message is already the sentence to be shown
MUST_BE = {
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
    "dict_type": "a mapping",
    "list_type": "a list",
    "tuple_type": "a list",
    "string_type": "text",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "finite_number": "a finite number",
}
NOT_TEXT = f"must be {MUST_BE['string_type']}"
NOT_PLAIN = "must be a number, a text, a list or a mapping"  # for example where a date is given


@dataclass(frozen=True)
class Complaint:
    """An error in an input: the ``path`` of the key at fault, and the sentence about it."""

    path: Path
    message: str

    def under(self, prefix: Path) -> Complaint:
        """Return the same error for a value that lies below ``prefix``."""
        return replace(self, path=(*prefix, *self.path))

    def __str__(self) -> str:
        return f"{dotted(self.path)}: {self.message}" if self.path else self.message


def shown(value: object) -> str:
    """Return a short text of a value, in the words of a config."""
    value = as_utf8(value) if isinstance(value, str) else value
    text = {"None": "null", "True": "true", "False": "false"}.get(repr(value), repr(value))
    return text if len(text) <= MAX_INPUT_LETTERS else text[: MAX_INPUT_LETTERS - 3] + "..."


def nearest(name: str, known: Iterable[str], below: Iterable[str] = ()) -> str:
    """Return a hint such as ``; did you mean 'x'? (known: ...)``, with the known names that are similar to ``name``.

    ``below`` are keys of a lower level, such as ``problem.horizon``. One whose last step is the name comes first;
    otherwise they are used where no known name is similar.
    """
    names = sorted(known)
    if not names:
        return "; there are none"
    target = str(name).lower()
    lower_keys = {key.rpartition(".")[2]: key for key in reversed(list(below))}  # of equal names the first key
    close = [lower_keys[target]] if target in lower_keys else []
    close += difflib.get_close_matches(target, names, n=2 - len(close), cutoff=0.6)
    if not close:
        close = [lower_keys[last] for last in difflib.get_close_matches(target, lower_keys, n=1, cutoff=0.6)]
    suggestion = "; did you mean " + " or ".join(repr(match) for match in close) + "?" if close else ";"
    return f"{suggestion} (known: {', '.join(names)})" if close else f"; known: {', '.join(names)}"


def complaints(
    error: ValidationError, model: type[BaseModel], data: object, below: Sequence[str] = ()
) -> list[Complaint]:
    """Return the errors of pydantic, one per key.

    Parameters
    ----------
    error : ValidationError
        The errors.
    model : type of BaseModel
        The model that was validated.
    data : object
        The input.
    below : sequence of str, default ()
        Keys of a lower level, one of which an unknown key at the top may mean.

    Returns
    -------
    list of Complaint
        The errors. Those of several members of a union about one key are joined by *or*.
    """
    faults_by_path: dict[Path, list[tuple[str, str]]] = {}
    items = error.errors(include_url=False)
    misspelt = [item["loc"] for item in items if item["type"] == "extra_forbidden"]
    for item in items:
        if item["type"] == "missing" and any(_is_misspelling(loc, item["loc"]) for loc in misspelt):
            continue  # the error of the unknown key with a similar name shows this one
        path = visible(item["loc"], data, missing=item["type"] == "missing")
        path += tuple(item.get("ctx", {}).get("below", ())) if item["type"] == COMPLAINT else ()
        faults = faults_by_path.setdefault(path, [])
        fault = _describe_fault(dict(item), model, below)
        if fault not in faults:
            faults.append(fault)
    return [Complaint(path, _join_faults(faults)) for path, faults in faults_by_path.items()]


def _join_faults(faults: list[tuple[str, str]]) -> str:
    """Return the errors of one key as one sentence; a value that several of them name stands once, at the end."""
    last = faults[-1][1]
    return " or ".join(
        f"{sentence} (got {got})" if got and (position == len(faults) - 1 or got != last) else sentence
        for position, (sentence, got) in enumerate(faults)
    )


def _is_misspelling(written: Path, missing: Path) -> bool:
    """Return whether an unknown key is similar to a missing one at the same level."""
    near = difflib.get_close_matches(str(written[-1]).lower(), [str(missing[-1])], n=1, cutoff=0.6)
    return written[:-1] == missing[:-1] and bool(near)


def visible(loc: Path, data: object, missing: bool = False) -> Path:
    """Return the steps of ``loc`` that exist in the data: pydantic adds the names of union members."""
    path: list[str | int] = []
    for position, step in enumerate(loc):
        last = position == len(loc) - 1
        if isinstance(data, Mapping) and (step in data or (last and missing)):
            data = data.get(step)
        elif isinstance(data, list | tuple) and isinstance(step, int) and step < len(data):
            data = data[step]
        elif data is not None:
            continue
        path.append(step)
    return tuple(path)


def _describe_fault(item: dict[str, Any], model: type[BaseModel], below: Sequence[str]) -> tuple[str, str]:
    """Return the error in words, and the value that was given.

    The value is empty where the sentence names it, or there is none.
    """
    got = shown(item["input"])
    match item["type"]:
        case "missing":
            return "missing, and it has no default", ""
        case "extra_forbidden":
            keys = _list_known_keys(model, item["loc"][:-1])
            lower_keys = below if len(item["loc"]) == 1 else ()
            sentence = nearest(str(item["loc"][-1]), keys, lower_keys) if keys else "; it has no options"
            return f"unknown key{sentence}", ""
        case "value_error":
            cause = item.get("ctx", {}).get("error")
            return str(cause), "" if isinstance(cause, InputError) and cause.got else got
        case "too_short":
            least = item["ctx"]["min_length"]
            return f"must have at least {least} {'entry' if least == 1 else 'entries'}", got
        case kind if kind == COMPLAINT:
            return str(item["msg"]), ""
        case kind if kind in MUST_BE:
            return f"must be {MUST_BE[kind]}", got
        case _:
            sentence = str(item["msg"]).replace("Input should", "should", 1).replace("should be", "must be", 1)
            return sentence, got


def _list_known_keys(model: type[BaseModel], loc: Path) -> set[str]:
    models = {model}
    for step in loc:
        named = {inner for inner in models if inner.__name__ == step}
        inner = {
            member
            for outer in models
            for name, field in outer.model_fields.items()
            if step in {name, field.alias}
            for member in models_in(field.annotation)
        }
        models = named or inner or models
    return {field.alias or name for member in models for name, field in member.model_fields.items()}


def models_in(annotation: object) -> Iterator[type[BaseModel]]:
    """Yield every pydantic model inside a type such as ``list[Window | None]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from models_in(argument)


def malformed(data: object, path: Path = (), above: tuple[int, ...] = ()) -> Iterator[Complaint]:
    """Yield errors for numbers that are not finite, keys that are not text, other values, and lists that contain
    themselves."""
    if id(data) in above:
        yield Complaint(path, "contains itself; a config is a finite tree")
    elif isinstance(data, float) and not math.isfinite(data):
        hint = "; write null for a side that is free" if {"box", "equals", "lower", "upper"} & set(path) else ""
        yield Complaint(path, f"must be a finite number (got {data}){hint}")
    elif isinstance(data, Mapping):
        for key, value in data.items():
            if not isinstance(key, str):
                yield Complaint((*path, str(key)), f"a key must be text (got {shown(key)})")
            else:
                yield from malformed(value, (*path, key), (*above, id(data)))
    elif isinstance(data, list | tuple):
        for position, value in enumerate(data):
            yield from malformed(value, (*path, position), (*above, id(data)))
    elif not isinstance(data, str | int | float | None):
        yield Complaint(path, f"{NOT_PLAIN} (got {shown(data)})")
