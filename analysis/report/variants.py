"""All variants of an environment: everything that was run in it, each with a label of its own.

Figures and tables compare policies under one setting of model and learner. A report compares the
settings too: a variant is a policy together with what sets it apart from the others of its name.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from analysis.data.config_matching import Filter, difference, nearness
from analysis.data.latest_configs import newest
from analysis.data.source_files import latest_sources
from analysis.data.trial_selection import Entry, environment_rank, labels_of, policy_rank
from analysis.data.variants import one_each, one_world, section_text
from analysis.errors import AnalysisError
from analysis.stats.control import common_task, task_of
from dopt.spec.prequential import is_prequential
from orchestrate.store import Reader

_SETTING = ("model", "learner", "limits")


@dataclass(frozen=True)
class VariantGroup:
    """The variants of one environment, the reference first, and what was left out.

    ``task`` is the one by which control is compared, as JSON, None where no trial was assessed.
    """

    env: str
    variants: tuple[Entry, ...]
    notes: tuple[str, ...] = ()
    task: str | None = None

    @property
    def reference(self) -> Entry:
        return self.variants[0]

    @property
    def assessed(self) -> tuple[Entry, ...]:
        """The variants whose control is compared: those that were assessed by the common task."""
        if self.task is None:
            return ()
        return tuple(one for one in self.variants if task_of(one) == self.task)

    def reference_with_setting_of(self, variant: Entry) -> Entry | None:
        """Return the reference policy with the model, learner and limits of a variant, if any.

        Among several it is the one nearest to the defaults.
        """
        setting = _setting(variant)
        same = [
            one
            for one in self.variants
            if one.config.policy == self.reference.config.policy and _setting(one) == setting
        ]
        return max(same, key=lambda one: nearness(one.config), default=None)


def variant_groups(reader: Reader, wanted: Filter) -> list[VariantGroup]:
    """Return the variants of every environment that has the reference policy and another.

    Explorations are left out: their losses are errors on paths of their own.

    Raises
    ------
    AnalysisError
        If no environment has both.
    """
    current = [
        config
        for config in newest(list(reader.configs()))
        if wanted.accepts(config) and not is_prequential(config.config)
    ]
    configs = latest_sources(reader, current)
    entries = [Entry(config, tuple(reader.trials(config.config_key))) for config in configs]
    names = sorted({config.env for config in configs}, key=environment_rank)
    found = [
        _group(env, [entry for entry in entries if entry.config.env == env], wanted.reference)
        for env in names
    ]
    whole = [group for group in found if group is not None]
    if not whole:
        raise AnalysisError(
            f"A report needs trials of {wanted.reference} and of another variant in one "
            f"environment, but {reader.safe_url} has none: run 'python orchestrate/launch.py -m "
            f"experiment=beyond', or choose another --reference."
        )
    return whole


def _group(env: str, entries: Sequence[Entry], policy: str) -> VariantGroup | None:
    world = one_world(entries)
    task = common_task(world)
    kept = _one_each(world, task)
    references = [entry for entry in kept if entry.config.policy == policy]
    if not references or len(kept) < 2:
        return None
    reference = max(references, key=lambda entry: (_company(entry, kept), *nearness(entry.config)))
    words = labels_of(entry.config for entry in kept)
    variants = [replace(entry, label=label) for entry, label in zip(kept, words, strict=True)]
    first = next(one for one in variants if one.config is reference.config)
    rest = [one for one in variants if one is not first]
    rest.sort(key=lambda one: (policy_rank(one.config.policy), one.label))
    left = len(entries) - len(kept)
    notes = [f"{left} configurations of another env section, task or fewer trials"] if left else []
    notes += [*_of_unequal_seeds([first, *rest]), *_of_other_tasks([first, *rest], task)]
    return VariantGroup(env, (first, *rest), tuple(notes), task)


def _of_unequal_seeds(variants: Sequence[Entry]) -> Iterator[str]:
    """Say how many seeds the variants have, where they differ."""
    numbers = Counter(len({trial.seed for trial in one.trials}) for one in variants)
    if len(numbers) > 1:
        counts = ", ".join(
            f"{n} seeds: {count} variant{'s' if count > 1 else ''}"
            for n, count in sorted(numbers.items())
        )
        yield f"{counts}; a ratio is over the seeds that both variants of it have"


def _of_other_tasks(variants: Sequence[Entry], task: str | None) -> Iterator[str]:
    """Say which variants are not in the section on control, and in what their task differs."""
    others: dict[str, list[str]] = {}
    for one in variants:
        own = task_of(one)
        if own is not None and own != task:
            others.setdefault(own, []).append(one.label)
    for other, names in others.items():
        path, (value, usual) = difference([json.loads(other), json.loads(task or "{}")])
        yield (
            f"control with {'; '.join(names)}: assessed by another task than most trials "
            f"({path} = {value} instead of {usual}), so these costs and successes are not compared"
        )


def _company(entry: Entry, entries: Sequence[Entry]) -> int:
    """Return how many entries share the model, the learner and the limits of this one."""
    own = _setting(entry)
    return sum(_setting(one) == own for one in entries)


def _setting(entry: Entry) -> list[str]:
    return [section_text(entry, name) for name in _SETTING]


def _one_each(entries: Sequence[Entry], task: str | None) -> list[Entry]:
    """Return one entry for each policy and setting: of the task, if any, and with most trials."""

    def weight(entry: Entry) -> tuple[int, ...]:
        return task is not None and task_of(entry) == task, len(entry.trials)

    return one_each(entries, weight)
