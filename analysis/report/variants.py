"""Everything that was run in one environment, each configuration under a label of its own.

Figures and tables compare policies under one setting of model and learner. A report compares the
settings too: a variant is a policy together with what sets it apart from the others of its name.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from analysis.choice import REFERENCE, Filter, departures, flatten
from analysis.errors import AnalysisError
from analysis.selection import Entry, environment_rank, newest, policy_rank
from orchestrate.store import Reader

_SETTING = ("model", "learner")

Flat = Mapping[str, object]
Word = tuple[str, str]
"""Key of a configuration, and what is added to its label."""

Tell = Callable[[Sequence[Flat], Flat, Sequence[Entry]], Iterator[Word]]


@dataclass(frozen=True)
class Variant:
    """One configuration of an environment, and how it is called."""

    label: str
    entry: Entry


@dataclass(frozen=True)
class Field:
    """The variants of one environment, the reference first, and what was left out."""

    env: str
    variants: tuple[Variant, ...]
    notes: tuple[str, ...] = ()

    @property
    def reference(self) -> Variant:
        return self.variants[0]

    @property
    def others(self) -> tuple[Variant, ...]:
        return self.variants[1:]


def fields(reader: Reader, wanted: Filter) -> list[Field]:
    """Return the variants of every environment that has the reference policy and another.

    Raises
    ------
    AnalysisError
        If no environment has both.
    """
    cells = [cell for cell in newest(list(reader.cells())) if wanted.accepts(cell)]
    entries = [Entry(cell, tuple(reader.trials(cell.config_key))) for cell in cells]
    names = sorted({cell.env for cell in cells}, key=environment_rank)
    found = [_field(env, [entry for entry in entries if entry.cell.env == env]) for env in names]
    whole = [field for field in found if field is not None]
    if not whole:
        raise AnalysisError(
            f"A report needs trials of {REFERENCE} and of another variant in one environment, but "
            f"{reader.safe_url} has none: run 'python orchestrate/launch.py -m experiment=beyond'."
        )
    return whole


def _field(env: str, entries: Sequence[Entry]) -> Field | None:
    kept = _one_world(entries)
    references = [entry for entry in kept if entry.cell.policy == REFERENCE]
    if not references or len(kept) < 2:
        return None
    reference = min(references, key=lambda entry: (-_company(entry, kept), departures(entry.cell)))
    labels = _labels(kept, reference)
    variants = [Variant(labels[entry.cell.config_key], entry) for entry in kept]
    first = replace(next(one for one in variants if one.entry is reference))
    rest = [one for one in variants if one.entry is not reference]
    rest.sort(key=lambda one: (policy_rank(one.entry.cell.policy), one.label))
    left = len(entries) - len(kept)
    notes = (f"{left} configurations of another env section, task or fewer trials",) if left else ()
    return Field(env, (first, *rest), notes)


def _company(entry: Entry, entries: Sequence[Entry]) -> int:
    """Return how many entries share the model and the learner of this one."""
    own = [_section(entry, name) for name in _SETTING]
    return sum([_section(one, name) for name in _SETTING] == own for one in entries)


def _one_world(entries: Sequence[Entry]) -> list[Entry]:
    """Return the entries of the env section with most trials, one for each policy and setting."""
    totals: Counter[str] = Counter()
    for entry in entries:
        totals[_section(entry, "env")] += len(entry.trials)
    world = max(totals, key=lambda section: (totals[section], section))
    best: dict[tuple[str, ...], Entry] = {}
    for entry in entries:
        if _section(entry, "env") != world:
            continue
        key = tuple(_section(entry, name) for name in ("policy", *_SETTING, "path"))
        if key not in best or _weight(entry) > _weight(best[key]):
            best[key] = entry
    return list(best.values())


def _section(entry: Entry, name: str) -> str:
    return json.dumps(entry.cell.config.get(name), sort_keys=True)


def _weight(entry: Entry) -> tuple[bool, int]:
    """Prefer a configuration whose trials also did a task, then the one with more trials."""
    return bool(entry.cell.config.get("task")), len(entry.trials)


def _labels(entries: Sequence[Entry], reference: Entry) -> dict[str, str]:
    """Return a label for each configuration: its policy, and what else it takes to tell it apart.

    Names come before values: the model, the learner, then the values in which those differ that are
    still called alike.
    """
    usual = flatten(reference.cell.config)
    words = {one.cell.config_key: [one.cell.policy.replace("_", " ")] for one in entries}
    for tell in (*map(_by_name, _SETTING), *map(_by_values, (*_SETTING, "policy")), _by_path):
        for group in _alike(entries, words):
            for key, word in tell([flatten(one.cell.config) for one in group], usual, group):
                words[key] += [word] if word else []
    return {key: ", ".join(parts) for key, parts in words.items()}


def _alike(entries: Sequence[Entry], words: Mapping[str, list[str]]) -> list[list[Entry]]:
    """Return the groups of entries that have the same label so far."""
    groups: dict[tuple[str, ...], list[Entry]] = {}
    for one in entries:
        groups.setdefault(tuple(words[one.cell.config_key]), []).append(one)
    return [group for group in groups.values() if len(group) > 1]


def _by_name(section: str) -> Tell:
    def tell(flat: Sequence[Flat], usual: Flat, group: Sequence[Entry]) -> Iterator[Word]:
        path = f"{section}.name"
        for one, config in zip(group, flat, strict=True):
            differs = config.get(path) != usual.get(path)
            yield one.cell.config_key, str(config.get(path)).replace("_", " ") if differs else ""

    return tell


def _by_values(section: str) -> Tell:
    def tell(flat: Sequence[Flat], usual: Flat, group: Sequence[Entry]) -> Iterator[Word]:
        paths = [
            path
            for path in sorted(set().union(*flat))
            if path.startswith(f"{section}.") and len({repr(one.get(path)) for one in flat}) > 1
        ]
        for one, config in zip(group, flat, strict=True):
            values = [
                f"{path.partition('.')[2]}={config[path]}"
                for path in paths
                if path in config and config[path] != usual.get(path)
            ]
            yield one.cell.config_key, " ".join(values)

    return tell


def _by_path(flat: Sequence[Flat], usual: Flat, group: Sequence[Entry]) -> Iterator[Word]:  # noqa: ARG001
    for one, config in zip(group, flat, strict=True):
        yield one.cell.config_key, f"path={config.get('path')}"
