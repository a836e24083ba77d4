"""Everything that was run in one environment, each configuration under a label of its own.

Figures and tables compare policies under one setting of model and learner. A report compares the
settings too: a variant is a policy together with what sets it apart from the others of its name.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from analysis.choice import REFERENCE, Filter, defaults, difference, flatten, nearness
from analysis.control import common_task, task_of
from analysis.errors import AnalysisError
from analysis.figures.style import policy_style
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
    """The variants of one environment, the reference first, and what was left out.

    ``task`` is the one by which control is compared, as JSON, None where no trial was assessed.
    """

    env: str
    variants: tuple[Variant, ...]
    notes: tuple[str, ...] = ()
    task: str | None = None

    @property
    def reference(self) -> Variant:
        return self.variants[0]

    @property
    def others(self) -> tuple[Variant, ...]:
        return self.variants[1:]

    @property
    def assessed(self) -> tuple[Variant, ...]:
        """The variants whose control is compared: those that were assessed by the common task."""
        if self.task is None:
            return ()
        return tuple(one for one in self.variants if task_of(one.entry) == self.task)


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
    world = _one_world(entries)
    task = common_task(world)
    kept = _one_each(world, task)
    references = [entry for entry in kept if entry.cell.policy == REFERENCE]
    if not references or len(kept) < 2:
        return None
    reference = max(references, key=lambda entry: (_company(entry, kept), *nearness(entry.cell)))
    labels = _labels(kept, reference)
    variants = [Variant(labels[entry.cell.config_key], entry) for entry in kept]
    first = replace(next(one for one in variants if one.entry is reference))
    rest = [one for one in variants if one.entry is not reference]
    rest.sort(key=lambda one: (policy_rank(one.entry.cell.policy), one.label))
    left = len(entries) - len(kept)
    notes = [f"{left} configurations of another env section, task or fewer trials"] if left else []
    return Field(env, (first, *rest), (*notes, *_of_other_tasks([first, *rest], task)), task)


def _of_other_tasks(variants: Sequence[Variant], task: str | None) -> Iterator[str]:
    """Say which variants are not in the section on control, and in what their task differs."""
    others: dict[str, list[str]] = {}
    for one in variants:
        own = task_of(one.entry)
        if own is not None and own != task:
            others.setdefault(own, []).append(one.label)
    for other, labels in others.items():
        path, (value, usual) = difference([json.loads(other), json.loads(task or "{}")])
        yield (
            f"control with {'; '.join(labels)}: assessed by another task than most trials "
            f"({path} = {value} instead of {usual}), so these costs and successes are not compared"
        )


def _company(entry: Entry, entries: Sequence[Entry]) -> int:
    """Return how many entries share the model and the learner of this one."""
    own = [_section(entry, name) for name in _SETTING]
    return sum([_section(one, name) for name in _SETTING] == own for one in entries)


def _one_world(entries: Sequence[Entry]) -> list[Entry]:
    """Return the entries of the env section with most trials."""
    totals: Counter[str] = Counter()
    for entry in entries:
        totals[_section(entry, "env")] += len(entry.trials)
    world = max(totals, key=lambda section: (totals[section], section))
    return [entry for entry in entries if _section(entry, "env") == world]


def _one_each(entries: Sequence[Entry], task: str | None) -> list[Entry]:
    """Return one entry for each policy and setting: of the task if there is one, with most trials.

    The losses of a trial are the same with any task and without one.
    """

    def weight(entry: Entry) -> tuple[bool, int]:
        return task is not None and task_of(entry) == task, len(entry.trials)

    best: dict[tuple[str, ...], Entry] = {}
    for entry in entries:
        key = tuple(_section(entry, name) for name in ("policy", *_SETTING, "path"))
        if key not in best or weight(entry) > weight(best[key]):
            best[key] = entry
    return list(best.values())


def _section(entry: Entry, name: str) -> str:
    return json.dumps(entry.cell.config.get(name), sort_keys=True)


def _labels(entries: Sequence[Entry], reference: Entry) -> dict[str, str]:
    """Return a label for each configuration: its policy, and what sets it apart from the others.

    Names of the model and of the learner are said where it takes them and they are not those of the
    reference; then, of the values in which configurations so called differ, all but defaults.
    """
    flat = {one.cell.config_key: flatten(one.cell.config) for one in entries}
    own = flatten(reference.cell.config)
    words = {one.cell.config_key: [policy_style(one.cell.policy).label] for one in entries}
    for path in (f"{section}.name" for section in _SETTING):
        for group in _alike(words):
            for key in group if _differ(flat, group, path) else ():
                words[key] += _word(path, flat[key], own)
    usual = {one.cell.config_key: own | defaults(one.cell) for one in entries}
    for group in _alike(words):
        for path in sorted(set().union(*(flat[key] for key in group))):
            for key in group if _differ(flat, group, path) else ():
                words[key] += _word(path, flat[key], usual[key])
    return {key: ", ".join(parts) for key, parts in words.items()}


def _differ(flat: Mapping[str, Mapping[str, object]], keys: Sequence[str], path: str) -> bool:
    """Whether some configurations have different values at a path."""
    return len({repr(flat[key].get(path)) for key in keys}) > 1


def _alike(words: Mapping[str, Sequence[str]]) -> list[list[str]]:
    """Return the groups of keys that have the same label so far."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for key, parts in words.items():
        groups.setdefault(tuple(parts), []).append(key)
    return [group for group in groups.values() if len(group) > 1]


def _word(path: str, config: Mapping[str, object], usual: Mapping[str, object]) -> list[str]:
    """Return what one value adds to a label: nothing where it is the usual one, or is not set."""
    if path not in config or (path in usual and config[path] == usual[path]):
        return []
    name, value = path.rpartition(".")[2], config[path]
    text = _text(value)
    return [text.replace("_", " ") if name == "name" else f"{name}={text}"]


def _text(value: object) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_text, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
