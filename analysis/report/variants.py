"""Everything that was run in one environment, each configuration under a label of its own.

Figures and tables compare policies under one setting of model and learner. A report compares the
settings too: a variant is a policy together with what sets it apart from the others of its name.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from analysis.choice import REFERENCE, Filter, departures, flatten
from analysis.errors import AnalysisError
from analysis.selection import Entry, environment_rank, newest, policy_rank
from orchestrate.store import Reader

_SETTING = ("model", "learner")


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
    """Return a label for each configuration: its policy, and what it takes to tell it apart."""
    flat = {one.cell.config_key: flatten(one.cell.config) for one in entries}
    usual = flatten(reference.cell.config)
    words = {one.cell.config_key: [one.cell.policy.replace("_", " ")] for one in entries}
    for path in sorted(set().union(*flat.values()), key=_rank):
        for group in _alike(words):
            if len({repr(flat[key].get(path)) for key in group}) > 1:
                for key in group:
                    words[key] += _word(path, flat[key], usual)
    return {key: ", ".join(parts) for key, parts in words.items()}


def _rank(path: str) -> tuple[int, str]:
    """Let the names of the model and of the learner come before their values."""
    names = [f"{section}.name" for section in _SETTING]
    return names.index(path) if path in names else len(names), path


def _alike(words: Mapping[str, Sequence[str]]) -> list[list[str]]:
    """Return the groups of keys that have the same label so far."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for key, parts in words.items():
        groups.setdefault(tuple(parts), []).append(key)
    return [group for group in groups.values() if len(group) > 1]


def _word(path: str, config: Mapping[str, object], usual: Mapping[str, object]) -> list[str]:
    """Return what one value adds to a label: nothing where it is the reference's, or is not set."""
    if path not in config or config[path] == usual.get(path):
        return []
    name = path.rpartition(".")[2]
    return [str(config[path]).replace("_", " ") if name == "name" else f"{name}={config[path]}"]
