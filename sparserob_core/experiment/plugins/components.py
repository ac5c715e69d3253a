"""The registered components, by kind and name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

from sparserob_core.errors import InputError, SparseRobError, UnknownPluginError
from sparserob_core.experiment.plugins.attribution import attributed
from sparserob_core.experiment.plugins.guards import guarded
from sparserob_core.experiment.plugins.hookspecs import record_type
from sparserob_core.experiment.plugins.messages import Complaint, complaints, nearest, shown
from sparserob_core.experiment.plugins.records import RECORDS, Plugin
from sparserob_core.options import Options

DISABLE = "SPARSEROB_DISABLE_PLUGINS"


@dataclass(frozen=True)
class Failure:
    """A plugin that could not be used, and why."""

    plugin: str
    reason: str

    def __str__(self) -> str:
        return f"plugin '{self.plugin}' failed to load: {self.reason}"


def parts(model: type[Options]) -> dict[str, str]:
    """The options that are components themselves: name of the option to kind, as
    ``json_schema_extra={"component": kind}`` says."""
    extras = {key: field.json_schema_extra for key, field in model.model_fields.items()}
    return {
        key: str(extra["component"])
        for key, extra in extras.items()
        if isinstance(extra, dict) and "component" in extra
    }


@final
class Registry:
    """Every registered component. ``failures``: the plugins that could not be used; ``hint``: what to add where a name
    is unknown.

    Raises `UnknownPluginError` when two records of one kind share a name.
    """

    def __init__(
        self, records: Iterable[Plugin], failures: Sequence[Failure] = (), disabled: Sequence[str] = (), hint: str = ""
    ) -> None:
        self._hint = hint
        self.failures = tuple(failures)
        self._disabled = tuple(disabled)
        self._records: dict[str, dict[str, Plugin]] = {kind: {} for kind in RECORDS}
        for record in records:
            self._add(record)

    def _add(self, record: Plugin) -> None:
        known = self._records[record.kind]
        if record.name in known:
            first, second = known[record.name].plugin, record.plugin
            raise UnknownPluginError(
                f"{record} is registered twice, by plugin '{first}' and by plugin '{second}'; "
                f"disable one of them, for example {DISABLE}={second}"
            )
        known[record.name] = record

    def names(self, kind: str) -> list[str]:
        """The registered names of a kind, sorted."""
        return sorted(self._records[record_type(kind).kind])

    def records(self) -> Iterator[Plugin]:
        """Every record, by kind and name."""
        for kind in RECORDS:
            for name in self.names(kind):
                yield self._records[kind][name]

    def get(self, kind: str, name: str) -> Plugin:
        """The record of that name; raises `UnknownPluginError` with the nearest known names and every plugin that
        failed."""
        known = self._records[record_type(kind).kind]
        if name in known:
            return known[name]
        raise UnknownPluginError(f"no {kind} is named '{name}'{nearest(name, known)}{self.notes()}")

    def check(self, kind: str, name: str, options: Mapping[str, object]) -> tuple[Options | None, list[Complaint]]:
        """The typed options, or what is wrong with them. An option that is itself a component is spelt out with its own
        options."""
        from pydantic import ValidationError

        record = self.get(kind, name)
        model = record.options_type()
        given, wrong = dict(options), list[Complaint]()
        for key, part in parts(model).items():
            entry = given.get(key, model.model_fields[key].default)
            if isinstance(entry, str | Mapping):
                given[key], faults = self._spelt_out(part, entry)
                wrong += [fault.under((key,)) for fault in faults]
        try:
            with attributed(record.origin, "checking its options", but=(SparseRobError, ValidationError)):
                checked = model.model_validate(given, context={"registry": self})
        except ValidationError as error:
            return None, [*complaints(error, model, options), *wrong]
        return (None if wrong else checked), wrong

    def _spelt_out(self, kind: str, entry: str | Mapping[str, Any]) -> tuple[object, list[Complaint]]:
        """A component within another one's options as a mapping with its name and all its options, and what is wrong
        with it."""
        name, options = (
            (entry, {})
            if isinstance(entry, str)
            else (entry.get("name"), {key: entry[key] for key in entry if key != "name"})
        )
        if not isinstance(name, str):
            return entry, [
                Complaint(("name",), f"expected the name of one of {', '.join(self.names(kind))} (got {shown(name)})")
            ]
        try:
            checked, wrong = self.check(kind, name, options)
        except UnknownPluginError as error:
            return entry, [Complaint(("name",) if isinstance(entry, Mapping) else (), str(error))]
        return (entry if checked is None else {"name": name, **checked.model_dump(mode="json", by_alias=True)}), wrong

    def build(self, kind: str, name: str, options: Mapping[str, object] | None = None) -> Any:
        """The component, built from its options; raises `InputError` that names every option at fault."""
        checked, wrong = self.check(kind, name, options or {})
        if checked is None:
            raise InputError("\n".join(f"{kind} {name}: {complaint}" for complaint in wrong))
        inner = {
            key: guarded(
                self.build(part, value["name"], {option: value[option] for option in value if option != "name"}),
                self.get(part, value["name"]).origin,
            )
            for key, part in parts(type(checked)).items()
            if isinstance(value := getattr(checked, key), Mapping)
        }
        return self.get(kind, name).create(checked.model_copy(update=inner))

    def find(self, name: str) -> list[Plugin]:
        """The records called ``name``, or ``kind.name``; raises `UnknownPluginError` with the nearest names when there
        are none."""
        found = [record for record in self.records() if name in {record.name, f"{record.kind}.{record.name}"}]
        if not found:
            known = {record.name for record in self.records()}
            raise UnknownPluginError(
                f"no component is named '{name}'{nearest(name.rpartition('.')[2], known)}{self.notes()}"
            )
        return found

    def notes(self) -> str:
        """Why a name may be missing, a line each: plugins that failed, that are disabled, or that are not loaded."""
        notes = [f"\n  note: {failure}" for failure in self.failures]
        notes += [f"\n  note: plugin '{plugin}' is disabled by {DISABLE}" for plugin in self._disabled]
        return "".join([*notes, f"\n  note: {self._hint}" if self._hint else ""])
