"""The reader and writer of configs; the only module that knows YAML (version 1.2). Nothing in a config is executed."""

from __future__ import annotations

import io
import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path as File
from typing import TYPE_CHECKING, Any, final

import numpy as np

from sparserob_core.errors import ConfigError, Path
from sparserob_core.experiment.config.matrices.packed import pack

if TYPE_CHECKING:
    from ruamel.yaml import YAML

# Bytes of a config, which may hold matrices as one text each. Large data belongs in a file of arrays, or in a plugin
# that makes it. Ten times more takes half a minute to read; a tenth is a dense matrix of 200 states.
MAX_CONFIG_BYTES = 4_000_000
MAX_CONFIG_VALUES = 200_000  # values of a config; an alias counts as all values that it stands for

__all__ = ["ConfigSource", "read_source", "read_value", "require_readable", "write_yaml"]


@final
@dataclass(frozen=True, eq=False)
class ConfigSource:
    """A config as it was given.

    Parameters
    ----------
    name : str
        The file, as the user wrote it.
    folder : Path
        Its folder.
    data : dict
        The keys and values. Those of a config that extends another one include those of its ``base``.
    text : str, default ""
        The text of the file, which has the place of each key.
    base : ConfigSource, optional
        The config that it extends.
    own : mapping
        The keys and values that it has without its ``base``.
    """

    name: str
    folder: File
    data: dict[str, Any]
    text: str = ""
    base: ConfigSource | None = None
    own: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def marks(self) -> object:
        """The data with the line and the column of every key; ``None`` where these are unknown."""
        from ruamel.yaml.error import YAMLError

        try:
            return _make_yaml("rt").load(self.text) if self.text else None
        except (YAMLError, ValueError):
            return None

    def writer(self, path: Path) -> ConfigSource:
        """Return the config of the chain that gives the value at ``path``; this config, where none does."""
        if self.base is None or _is_decided(self.own, path) or not _is_decided(self.base.data, path):
            return self
        return self.base.writer(path)

    def where(self, path: Path) -> str:
        """Return ``file:line:column`` of a key, or of the nearest key above it that was written."""
        writer, (line, column) = self.writer(path), self.position(path)
        return writer.name if not writer.text else f"{writer.name}:{line + 1}:{column + 1}"

    def position(self, path: Path) -> tuple[int, int]:
        """Return line and column of a key, counted from 0; ``(0, 0)`` where positions are unknown."""
        node, position = self.writer(path).marks, (0, 0)
        for step in path:
            entry = _find_position(node, step)
            if entry is None:
                break
            position, node = entry
        return position


def read_source(config: str | File | Mapping[str, Any] | ConfigSource) -> ConfigSource:
    """Read a config from a ``.yaml``, ``.json`` or ``.toml`` file, or take it from a mapping or a `ConfigSource`.

    Raises `ConfigError` where there is no such file, where it cannot be read, and where it does not hold a mapping.
    """
    if isinstance(config, ConfigSource):
        return config
    if isinstance(config, Mapping):
        return ConfigSource("config", File.cwd(), _to_plain(config))
    file = File(config)
    text = _read_text(file)
    data = _parse_text(file, text)
    if data is None:
        raise ConfigError(f"{file}: the file is empty; expected at least the key 'problem'")
    if not isinstance(data, dict):
        raise ConfigError(
            f"{file}: expected a mapping of keys to values, got"
            f" {'a list' if isinstance(data, list) else repr(data)[:60]}"
        )
    if _count_values(data, {}) > MAX_CONFIG_VALUES:
        raise ConfigError(
            f"{file}: expected at most {MAX_CONFIG_VALUES} values, aliases counted as what they stand for, got more"
        )
    return ConfigSource(str(file), file.resolve().parent, data, "" if file.suffix == ".toml" else text)


def require_readable(data: Mapping[str, Any], text: str) -> None:
    """Raise `ConfigError` where a config that was written as ``text`` is larger than `read_source` accepts."""
    size, values = len(text.encode()), _count_values(data, {})
    if size > MAX_CONFIG_BYTES or values > MAX_CONFIG_VALUES:
        raise ConfigError(
            f"the problem cannot be written: expected at most {MAX_CONFIG_BYTES} bytes and {MAX_CONFIG_VALUES} values, "
            f"got {size} and {values}"
        )


def read_value(text: str) -> object:
    """Return the value of an override, read as YAML; raises `ConfigError` where it cannot be read."""
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    if len(text) > MAX_CONFIG_BYTES:
        raise ConfigError(
            f"override value {text[:40]!r}...: expected at most {MAX_CONFIG_BYTES} characters, got {len(text)}"
        )
    try:
        value = _make_yaml("safe").load(text)
    except MarkedYAMLError as error:
        raise ConfigError(f"override value {text!r}: {_describe_problem(error)}") from error
    except (YAMLError, RecursionError) as error:
        raise ConfigError(f"override value {text[:60]!r}: not valid YAML: {type(error).__name__}") from None
    if _count_values(value, {}) > MAX_CONFIG_VALUES:
        raise ConfigError(f"override value {text[:40]!r}...: expected at most {MAX_CONFIG_VALUES} values, got more")
    return value


def write_yaml(data: Mapping[str, Any], heading: str = "") -> str:
    """Return a mapping as YAML with the ``heading`` as a comment; lists of plain values are written on one line."""
    yaml = _make_yaml("safe")
    yaml.version = None  # still version 1.2, but without the directive
    yaml.default_flow_style = None
    yaml.width = 140
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    stream = io.StringIO()
    yaml.dump(dict(data), stream)
    return "".join(f"# {line}\n" for line in heading.splitlines()) + stream.getvalue()


def _make_yaml(kind: str) -> YAML:
    from ruamel.yaml import YAML

    yaml = YAML(typ=kind, pure=True)
    yaml.version = (1, 2)
    return yaml


def _read_text(file: File) -> str:
    try:
        size = file.stat().st_size
        if size > MAX_CONFIG_BYTES:
            raise ConfigError(
                f"{file}: expected at most {MAX_CONFIG_BYTES} bytes, got {size}; a plugin can make large data"
            )
        return file.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise ConfigError(f"{file}: there is no such file") from None
    except IsADirectoryError:
        raise ConfigError(f"{file}: is a directory, expected a file such as {file / 'config.yaml'}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{file}: expected text in UTF-8, got the byte 0x{error.object[error.start]:02x} at {error.start}"
        ) from None
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from None


def _parse_text(file: File, text: str) -> Any:
    from ruamel.yaml.error import MarkedYAMLError, YAMLError
    from ruamel.yaml.reader import ReaderError

    try:
        if file.suffix == ".toml":
            return tomllib.loads(text)
        if file.suffix == ".json":
            return json.loads(text)
        return _make_yaml("safe").load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        at = f":{mark.line + 1}:{mark.column + 1}" if mark else ""
        raise ConfigError(f"{file}{at}: {_describe_problem(error)}") from None
    except json.JSONDecodeError as error:
        raise ConfigError(f"{file}:{error.lineno}:{error.colno}: not valid JSON: {error.msg}") from None
    except ReaderError as error:
        before = text[: error.position]
        line, column = before.count("\n") + 1, len(before) - before.rfind("\n")
        message = f"the character U+{ord(text[error.position]):04X} is not allowed in a config"
        raise ConfigError(f"{file}:{line}:{column}: {message}") from None
    except (YAMLError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{file}: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise ConfigError(f"{file}: nested too deeply") from None
    except ValueError as error:
        raise ConfigError(f"{file}: {error}") from None


def _count_values(data: object, known: dict[int, int]) -> int:
    """Return the number of values, where an alias counts whenever it is used; a value that contains itself
    counts once."""
    if not isinstance(data, Mapping | list):
        return 1
    if id(data) not in known:
        known[id(data)] = 1
        below = data.values() if isinstance(data, Mapping) else data
        known[id(data)] = 1 + sum(_count_values(value, known) for value in below)
    return known[id(data)]


def _describe_problem(error: Any) -> str:
    message = " ".join(str(text) for text in (error.context, error.problem) if text)
    hint = "; indent with spaces" if "'\\t'" in message else ""
    return f"not valid YAML: {' '.join(message.split())}{hint}"


def _find_position(node: Any, step: str | int) -> tuple[tuple[int, int], object] | None:
    try:
        if isinstance(node, Mapping):
            return node.lc.key(step), node[step]  # type: ignore[attr-defined]
        if isinstance(node, list) and isinstance(step, int):
            return node.lc.item(step), node[step]  # type: ignore[attr-defined]
    except (KeyError, IndexError, AttributeError, TypeError):
        pass
    return None


def _is_decided(data: Any, path: Path) -> bool:
    """Return whether there is a value at ``path``, or one above it that excludes keys below it."""
    for step in path:
        if not isinstance(data, Mapping):
            return True
        if step not in data:
            return False
        data = data[step]
    return True


def _to_plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _to_plain(item) for key, item in value.items()}
    if hasattr(value, "toarray"):  # a sparse matrix
        return pack(np.asarray(value.toarray(), dtype=float))
    if hasattr(value, "tolist"):
        return value.tolist()
    return [_to_plain(item) for item in value] if isinstance(value, list | tuple) else value
