"""Names for runs that stand side by side: what differs between their configs, and nothing else."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sparserob_core.experiment.config.plain import value_text

COMPONENTS = ("method", "maximiser", "regulariser", "solver")
UNLABELLED = frozenset({"problem", "dictionaries", "title", "observers", "plugins", "method", "maximiser", "seed"})


def labels(configs: Sequence[Mapping[str, Any]], searched: Sequence[bool]) -> list[str]:
    """Return one label per resolved config; equal labels get a number.

    A label begins with the method, or with the maximiser for a run that searches. Options are compared between runs of
    the same method only, and options of a component between runs with the same component. Other runs have no such
    option or do not use it. The seed is named where runs differ in nothing else.
    """
    names = {config["method"]["name"] for config in configs}
    texts = []
    for config, searches in zip(configs, searched, strict=True):
        peers = [peer for peer in configs if peer["method"]["name"] == config["method"]["name"]]
        texts.append(
            ", ".join([_make_head(config, peers, searches, len(names) > 1), *_list_differences(config, peers)])
        )
    return _append_numbers(_append_seeds(texts, [config.get("seed") for config in configs]))


def _make_head(config: Mapping[str, Any], peers: Sequence[Mapping[str, Any]], searches: bool, several: bool) -> str:
    method, maximiser = str(config["method"]["name"]), str(config["maximiser"]["name"])
    if not searches and len({peer["maximiser"]["name"] for peer in peers}) == 1:
        return method
    return f"{method} with {maximiser}" if several or not searches else maximiser


def _list_differences(config: Mapping[str, Any], peers: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    yield from _list_option_differences(config, peers, "method")
    yield from _list_option_differences(config, peers, "maximiser")
    for section in config:
        if section in UNLABELLED:
            continue
        if section in COMPONENTS and len({_get_full_name(peer, section) for peer in peers}) > 1:
            yield f"{section} {_get_full_name(config, section)}"
        matching_peers = [peer for peer in peers if _get_full_name(peer, section) == _get_full_name(config, section)]
        yield from (f"{section} {option}" for option in _list_option_differences(config, matching_peers, section))


def _list_option_differences(
    config: Mapping[str, Any], peers: Sequence[Mapping[str, Any]], section: str
) -> Iterator[str]:
    own_section = config.get(section)
    if not isinstance(own_section, Mapping):
        return
    peer_sections = [
        peer[section]
        for peer in peers
        if isinstance(peer.get(section), Mapping) and _get_name(peer, section) == _get_name(config, section)
    ]
    for key, value in own_section.items():
        if key != "name" and any(peer_section.get(key) != value for peer_section in peer_sections):
            yield value if isinstance(value, str) else f"{key} {value_text(value)}"


def _get_name(config: Mapping[str, Any], section: str) -> str:
    entry = config.get(section)
    return str(entry.get("name", "")) if isinstance(entry, Mapping) else "none"


def _get_full_name(config: Mapping[str, Any], section: str) -> str:
    """The name of a component, and in brackets that of the one that it hands the work to: an option of its own that is
    called like the section, such as the ``solver`` of qpsolvers."""
    entry = config.get(section)
    delegate = entry.get(section) if isinstance(entry, Mapping) else None
    return f"{_get_name(config, section)} ({delegate})" if isinstance(delegate, str) else _get_name(config, section)


def _append_seeds(found: list[str], seeds: list[object]) -> list[str]:
    seeds_of_label = {
        label: {str(seed) for other_label, seed in zip(found, seeds, strict=True) if other_label == label}
        for label in found
    }
    return [
        f"{label}, seed {seed}" if len(seeds_of_label[label]) > 1 else label
        for label, seed in zip(found, seeds, strict=True)
    ]


def _append_numbers(found: list[str]) -> list[str]:
    totals, counts = Counter(found), Counter[str]()
    numbered = []
    for label in found:
        counts[label] += 1
        numbered.append(f"{label} ({counts[label]})" if totals[label] > 1 else label)
    return numbered
