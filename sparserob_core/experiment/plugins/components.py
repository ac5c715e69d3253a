"""The registered components, by kind and name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any, final

from sparserob_core.errors import InputError, PluginError, SparseRobError, UnknownPluginError
from sparserob_core.experiment.plugins.attribution import attributed, short_repr
from sparserob_core.experiment.plugins.guards import guarded
from sparserob_core.experiment.plugins.hookspecs import record_type
from sparserob_core.experiment.plugins.messages import Complaint, complaints, nearest, shown
from sparserob_core.experiment.plugins.records import RECORDS, Plugin
from sparserob_core.options import Options

DISABLE = "SPARSEROB_DISABLE_PLUGINS"


@dataclass(frozen=True)
class Failure:
    """A plugin that could not be loaded, and the reason."""

    plugin: str
    reason: str

    def __str__(self) -> str:
        return f"plugin '{self.plugin}' failed to load: {self.reason}"


@dataclass(frozen=True)
class ComponentOption:
    """An option that is a component itself: its ``kind``, and the class ``of`` which it must be."""

    kind: str
    of: type | None = None


def _describe_duplicate(first: Plugin, second: Plugin) -> str:
    """Return the error of two records with one name: their plugins, and the setting that disables one of them."""
    who = [
        f"by plugin '{record.plugin}'" + (f" ({record.source})" if record.source else "") for record in (first, second)
    ]
    switches = [*sorted(second.switches - first.switches), *sorted(first.switches - second.switches)]
    remedy = f"disable one of them, for example {DISABLE}={switches[0]}" if switches else "rename one, or leave one out"
    return f"{first} is registered twice, {who[0]} and {who[1]}; {remedy}"


@cache
def parts(model: type[Options]) -> dict[str, ComponentOption]:
    """Return the options that are components themselves, by name, as `sparserob_core.options.part` marks them."""
    extras = {key: field.json_schema_extra for key, field in model.model_fields.items()}
    return {
        key: ComponentOption(str(extra["component"]), _import_class(str(extra["of"])) if "of" in extra else None)
        for key, extra in extras.items()
        if isinstance(extra, dict) and "component" in extra
    }


def _import_class(place: str) -> type:
    module, _, name = place.partition(":")
    component_class: type = getattr(import_module(module), name)
    return component_class


@final
class Registry:
    """All registered components.

    ``failures`` are the plugins that could not be loaded. ``hint`` is added to the error for an unknown name. Raises
    `UnknownPluginError` where two records of one kind share a name.
    """

    def __init__(
        self, records: Iterable[Plugin], failures: Sequence[Failure] = (), disabled: Sequence[str] = (), hint: str = ""
    ) -> None:
        self._hint = hint
        self.failures = tuple(failures)
        self._disabled_names = tuple(disabled)
        self._records: dict[str, dict[str, Plugin]] = {kind: {} for kind in RECORDS}
        for record in records:
            self._add_record(record)

    def _add_record(self, record: Plugin) -> None:
        records = self._records[record.kind]
        if record.name in records:
            raise UnknownPluginError(_describe_duplicate(records[record.name], record))
        records[record.name] = record

    def names(self, kind: str, of: type | None = None) -> list[str]:
        """Return the registered names of a kind, sorted.

        Parameters
        ----------
        kind : str
            The kind.
        of : type, optional
            A class. Only components that may be instances of it are named.

        Returns
        -------
        list of str
            The names.
        """
        records = self._records[record_type(kind).kind]
        return sorted(name for name, record in records.items() if of is None or record.may_be(of))

    def records(self) -> Iterator[Plugin]:
        """Yield every record, by kind and name."""
        for kind in RECORDS:
            for name in self.names(kind):
                yield self._records[kind][name]

    def get(self, kind: str, name: str, of: type | None = None) -> Plugin:
        """Return the record of a name.

        Parameters
        ----------
        kind, name : str
            The component.
        of : type, optional
            A class. The component must be one that may be an instance of it.

        Returns
        -------
        Plugin
            The record.

        Raises
        ------
        UnknownPluginError
            If there is none; the message has the most similar names and every plugin that failed.
        """
        record = self._records[record_type(kind).kind].get(name)
        if record is not None and (of is None or record.may_be(of)):
            return record
        description = kind if of is None else f"{kind} of the class {of.__name__}"
        raise UnknownPluginError(
            f"no {description} is named '{name}'{nearest(name, self.names(kind, of))}{self.notes()}"
        )

    def check(self, kind: str, name: str, options: Mapping[str, object]) -> tuple[Options | None, list[Complaint]]:
        """Return the typed options of a component, and the errors in them.

        An option that is a component itself is written out with its own options.

        Parameters
        ----------
        kind, name : str
            The component.
        options : mapping
            The options as they stand in a config.

        Returns
        -------
        typed : Options or None
            The options; ``None`` where there is an error.
        wrong : list of Complaint
            The errors.
        """
        from pydantic import ValidationError

        record = self.get(kind, name)
        model = record.options_type()
        values, wrong = dict(options), list[Complaint]()
        for key, component in parts(model).items():
            entry = values.get(key, model.model_fields[key].default)
            if isinstance(entry, str | Mapping):
                values[key], faults = self._spell_out(component, entry)
                wrong += [fault.under((key,)) for fault in faults]
                if faults:
                    del values[key]  # its errors are reported already
        try:
            with attributed(record.origin, "checking its options", but=(SparseRobError, ValidationError)):
                checked = model.model_validate(values, context={"registry": self})
        except ValidationError as error:
            return None, [*complaints(error, model, options), *wrong]
        return (None if wrong else checked), wrong

    def _spell_out(self, part: ComponentOption, entry: str | Mapping[str, Any]) -> tuple[object, list[Complaint]]:
        """Return a component within another one's options as a mapping with its name and all its options, and the
        errors."""
        name, options = (
            (entry, {})
            if isinstance(entry, str)
            else (entry.get("name"), {key: entry[key] for key in entry if key != "name"})
        )
        if not isinstance(name, str):
            choices = ", ".join(self.names(part.kind, part.of))
            return entry, [Complaint(("name",), f"expected the name of one of {choices} (got {shown(name)})")]
        try:
            self.get(part.kind, name, part.of)
            checked, wrong = self.check(part.kind, name, options)
        except UnknownPluginError as error:
            return entry, [Complaint(("name",) if isinstance(entry, Mapping) else (), str(error))]
        return (entry if checked is None else {"name": name, **checked.model_dump(mode="json", by_alias=True)}), wrong

    def build(self, kind: str, name: str, options: Mapping[str, object] | None = None) -> Any:
        """Return a component, built from its options.

        Parameters
        ----------
        kind, name : str
            The component.
        options : mapping, optional
            The options as they stand in a config.

        Returns
        -------
        object
            The component.

        Raises
        ------
        InputError
            If options are at fault; the message names each of them.
        """
        checked, wrong = self.check(kind, name, options or {})
        if checked is None:
            raise InputError("\n".join(f"{kind} {name}: {complaint}" for complaint in wrong))
        inner = {
            key: self._build_part(component, value)
            for key, component in parts(type(checked)).items()
            if isinstance(value := getattr(checked, key), Mapping)
        }
        return self.get(kind, name).create(checked.model_copy(update=inner))

    def _build_part(self, part: ComponentOption, entry: Mapping[str, Any]) -> object:
        """Return a component within another one's options, wrapped in the check of its kind."""
        record = self.get(part.kind, entry["name"], part.of)
        built = self.build(part.kind, entry["name"], {key: entry[key] for key in entry if key != "name"})
        if part.of is not None and not isinstance(built, part.of):
            raise PluginError(f"{record.origin}: building it gave {short_repr(built)}, expected a {part.of.__name__}")
        return guarded(built, record.origin)

    def find(self, name: str) -> list[Plugin]:
        """Return the records called ``name``, or ``kind.name``.

        Raises `UnknownPluginError` with the most similar names where there are none.
        """
        records = [record for record in self.records() if name in {record.name, f"{record.kind}.{record.name}"}]
        if not records:
            names = {record.name for record in self.records()}
            raise UnknownPluginError(
                f"no component is named '{name}'{nearest(name.rpartition('.')[2], names)}{self.notes()}"
            )
        return records

    def notes(self) -> str:
        """Return the reasons why a name may be missing, one line each: plugins that failed, are disabled, or are not
        loaded."""
        notes = [f"\n  note: {failure}" for failure in self.failures]
        notes += [f"\n  note: plugin '{plugin}' is disabled by {DISABLE}" for plugin in self._disabled_names]
        return "".join([*notes, f"\n  note: {self._hint}" if self._hint else ""])
