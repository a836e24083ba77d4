"""Configurations that are shown together although they differ in more than the policy."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence

from analysis.data.trial_selection import Entry

Weight = Callable[[Entry], tuple[int, ...]]

_IDENTITY = ("policy", "model", "learner", "limits", "path")


def one_world(entries: Sequence[Entry], name: str = "env") -> list[Entry]:
    """Return the entries of the env section with most trials; entries are of one environment.

    ``name`` is that of another section by which they are told apart; of as many trials those
    without such a section come first.
    """
    totals: Counter[str] = Counter()
    for entry in entries:
        totals[section_text(entry, name)] += len(entry.trials)
    world = max(totals, key=lambda section: (totals[section], section == "null", section))
    return [entry for entry in entries if section_text(entry, name) == world]


def number_of_trials(entry: Entry) -> tuple[int, ...]:
    """Return the weight of an entry by which the one with most trials is the largest."""
    return (len(entry.trials),)


def one_each(entries: Sequence[Entry], weight: Weight = number_of_trials) -> list[Entry]:
    """Return the entry of the largest weight for each policy, model, learner, limits and path.

    Several differ in their task alone: the losses of a trial are the same with any and without one.
    """
    best: dict[tuple[str, ...], Entry] = {}
    for entry in entries:
        key = tuple(section_text(entry, name) for name in _IDENTITY)
        if key not in best or weight(entry) > weight(best[key]):
            best[key] = entry
    return list(best.values())


def unfinished(entries: Iterable[Entry]) -> Iterator[str]:
    """Yield a sentence for each entry that has trials which are not finished."""
    for entry in entries:
        missing = len(entry.trials) - len(entry.finished)
        if missing:
            yield f"{entry.config.env}, {entry.label}: {missing} trials are not finished"


def section_text(entry: Entry, name: str) -> str:
    """Return a section of a configuration as JSON, by which sections are compared."""
    return json.dumps(entry.config.config.get(name), sort_keys=True)
