"""The trials that a figure or a table is about, those that are missing, and what was left out."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from analysis.data.matching import (
    REFERENCE,
    Filter,
    accepted,
    check_keys,
    choose,
    choose_by,
    latest_sources,
    nearness,
    setting_value,
    source_notes,
)
from dopt.errors import IncompatibleError, SpecificationError, counted
from dopt.policies import POLICIES, TITLES
from dopt.spec.config import SECTIONS, labels, limits_label, value_label
from dopt.spec.trial import is_prequential, stored_trial
from dopt.systems import NAMED_SYSTEMS
from orchestrate.store import FINISHED, ConfigRow, Reader, TrialRow

ENVIRONMENTS = (
    *("pendulum", "cartpole", "arm", "quadrotor"),
    *("drifting_pendulum", "chain", "mass_spring"),
    *("pendulum_unknown_gain", "cartpole_unknown_gain"),
    *("unbalanced_disk", "coupled_pendulums", "moving_star"),
    *("van_der_pol", "car", "drone"),
)
"""The paper's order; other environments follow by name."""

_POLICIES = tuple(TITLES)
_IDENTITY = ("policy", "model", "learner", "limits", "path")


@dataclass(frozen=True)
class Gap:
    """Seeds of one environment and policy that are not finished, and in which state they are."""

    env: str
    policy: str
    seeds: tuple[int, ...]
    states: str


def ranges(seeds: Iterable[int]) -> str:
    """Return whole numbers as a short text of ranges, such as ``0-4, 7``."""
    runs: list[list[int]] = []
    for seed in sorted(seeds):
        if runs and seed == runs[-1][1] + 1:
            runs[-1][1] = seed
        else:
            runs.append([seed, seed])
    return ", ".join(str(low) if low == high else f"{low}-{high}" for low, high in runs)


def is_possible(policy: ConfigRow, environment: ConfigRow) -> bool:
    """Return True if a policy's configuration makes sense with another environment's section."""
    config = {key: value for key, value in policy.config.items() if key in SECTIONS}
    try:
        stored_trial({**config, "env": environment.config["env"]})
    except SpecificationError as error:
        return not isinstance(error, IncompatibleError)
    return True


def why_impossible(env: str, policy: str) -> str | None:
    """Return why an environment cannot have a policy, or None where it can for all we know."""
    if env not in NAMED_SYSTEMS or policy not in POLICIES:
        return None
    try:
        POLICIES[policy]().check(NAMED_SYSTEMS[env]())
    except IncompatibleError as error:
        return str(error).partition(": ")[0]
    return None


def absent_pairs(configs: Sequence[ConfigRow]) -> list[tuple[str, str]]:
    """Return the (environment, policy) pairs of which nothing is stored though they make sense.

    Nothing is expected of explorations.
    """
    stored = {(config.env, config.policy) for config in configs}
    simulated = [config for config in configs if not is_prequential(config.config)]
    environments = {config.env: config for config in simulated}
    policies = {config.policy: config for config in simulated}
    return [
        (env, policy)
        for env in environments
        for policy in policies
        if (env, policy) not in stored and is_possible(policies[policy], environments[env])
    ]


def omissions(accepted: list[ConfigRow], chosen: list[ConfigRow]) -> Iterable[str]:
    """Yield sentences on configurations that were left out, on limits and on explorations."""
    kept = {config.config_key for config in chosen}
    left = Counter(config.env for config in accepted if config.config_key not in kept)
    for env, count in sorted(left.items()):
        yield f"{env}: {counted(count, 'other stored configuration')} left out (see --where)"
    for env, limits in sorted({(one.env, limits_label(one.config)) for one in chosen}):
        if limits:
            yield f"{env}: these trials have {limits}"
    for env in sorted({config.env for config in chosen if is_prequential(config.config)}):
        yield (
            f"{env}: the loss is prequential, the error of each predicted acceleration before it "
            f"is learned; explorations take paths of their own, so that it is not compared"
        )


@dataclass(frozen=True)
class Entry:
    """One configuration with its registered trials, ordered by seed.

    ``label`` says what differs among the entries shown, and ``group`` the values of the settings by
    which they are told apart.
    """

    config: ConfigRow
    trials: tuple[TrialRow, ...]
    label: str = ""
    group: tuple[object, ...] = ()

    @property
    def finished(self) -> tuple[TrialRow, ...]:
        return tuple(trial for trial in self.trials if trial.status in FINISHED)

    @property
    def n_diverged(self) -> int:
        return sum(trial.status == "diverged" for trial in self.trials)

    def describe(self, used: int) -> str:
        """Return how many finished trials are in a statistic, such as ``98/100, 2 diverged``."""
        lost = self.n_diverged
        return f"{used}/{len(self.finished)}, {lost} diverged" if lost else str(used)

    def final_losses(self) -> dict[int, float]:
        """Return the final loss by seed of the trials that did not diverge."""
        return {
            trial.seed: trial.final_loss
            for trial in self.trials
            if trial.status == "done" and trial.final_loss is not None
        }


@dataclass(frozen=True)
class Selection:
    """Entries in the order in which they are drawn, gaps, and sentences on what was left out.

    ``stored`` are all entries that the request allows, other widths and variants included;
    ``reference`` is the policy, or the value of a setting, that the others are compared with.
    """

    entries: tuple[Entry, ...]
    gaps: tuple[Gap, ...] = ()
    notes: tuple[str, ...] = ()
    stored: tuple[Entry, ...] = ()
    reference: str = REFERENCE
    group_by: tuple[str, ...] = ("policy",)

    @property
    def environments(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(entry.config.env for entry in self.entries))

    def of(self, environment: str) -> tuple[Entry, ...]:
        """Return the entries of one environment."""
        return tuple(entry for entry in self.entries if entry.config.env == environment)

    def only(self, environments: Iterable[str], policies: Iterable[str] = ()) -> Selection:
        """Return the part about some environments and policies; no policies means all."""
        envs, names = set(environments), set(policies)

        def kept(one: ConfigRow | Gap) -> bool:
            return one.env in envs and (not names or one.policy in names)

        gaps = tuple(gap for gap in self.gaps if kept(gap))
        return replace(self._where(lambda one: kept(one.config)), gaps=gaps)

    def _where(self, kept: Callable[[Entry], bool]) -> Selection:
        entries, stored = tuple(filter(kept, self.entries)), tuple(filter(kept, self.stored))
        return replace(self, entries=entries, stored=stored)

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(entry.label for entry in self.entries))

    def reference_of(self, environment: str) -> Entry | None:
        """Return the entry that the others of an environment are compared with, None without one.

        Where entries differ in something else than the policy, it is the one with the value that
        was asked for, else the one nearest to the defaults.
        """
        entries = self.of(environment)
        if self.group_by == ("policy",):
            return next((one for one in entries if one.config.policy == self.reference), None)
        texts = [{one.label, one.config.policy, *map(str, one.group)} for one in entries]
        named = [one for one, text in zip(entries, texts, strict=True) if self.reference in text]
        pool = named or (list(entries) if self.reference == REFERENCE else [])
        return max(pool, key=lambda one: nearness(one.config)) if pool else None

    def compared(self) -> Selection:
        """Return the environments in which the reference has a final loss."""
        references = [self.reference_of(env) for env in self.environments]
        return self.only(one.config.env for one in references if one and one.final_losses())

    def simulated(self) -> Selection:
        """Return the part without explorations, whose losses are errors along their own paths."""
        return self._where(lambda one: not is_prequential(one.config.config))

    def fingerprint(self) -> str:
        """Return the SHA-256 of the selected trials, their outcome and what is missing."""
        content = [
            [
                entry.config.config_key,
                *([t.trial_key, t.status, t.n_steps, t.final_loss] for t in entry.trials),
            ]
            for entry in self.entries
        ]
        gaps = [[gap.env, gap.policy, list(gap.seeds)] for gap in self.gaps]
        return hashlib.sha256(json.dumps([content, gaps]).encode()).hexdigest()


def policy_rank(policy: str) -> tuple[int, str]:
    """Return the sorting key of a policy: the order of the titles, other policies by name."""
    return (_POLICIES.index(policy) if policy in TITLES else len(_POLICIES), policy)


def environment_rank(environment: str) -> tuple[int, str]:
    """Return the sorting key of an environment."""
    known = environment in ENVIRONMENTS
    return (ENVIRONMENTS.index(environment) if known else len(ENVIRONMENTS), environment)


def select(reader: Reader, wanted: Filter) -> Selection:
    """Return the trials that stand for each environment and policy.

    Raises
    ------
    AnalysisError
        When nothing fits, a name is unknown, or several configurations fit equally well.
    """
    current = accepted(reader, wanted)
    stored = latest_sources(reader, current, wanted.group_by)
    check_keys(wanted.group_by, stored)
    trials = {config.config_key: tuple(reader.trials(config.config_key)) for config in stored}
    by_policy = wanted.group_by == ("policy",)
    chosen = (
        choose(stored, wanted.reference)
        if by_policy
        else choose_by(stored, wanted.group_by, wanted.reference)
    )
    entries = tuple(
        labelled((Entry(config, trials[config.config_key]) for config in chosen), wanted.group_by)
    )
    return Selection(
        entries,
        tuple(_gaps(entries, by_policy=by_policy)),
        (*omissions(stored, chosen), *source_notes(current, chosen)),
        tuple(labelled(Entry(config, trials[config.config_key]) for config in stored)),
        wanted.reference,
        wanted.group_by,
    )


def labelled(entries: Iterable[Entry], group_by: Sequence[str] = ("policy",)) -> list[Entry]:
    """Return entries in the order in which they are drawn, with their labels.

    Labels come from :func:`dopt.spec.config.labels`; grouped by other settings than the policy,
    from the values.
    """
    found = list(entries)
    words = labels_of([entry.config for entry in found])
    rows = []
    for entry, label in zip(found, words, strict=True):
        group = tuple(setting_value(entry.config, key) for key in group_by)
        texts = [value_label(key, value) for key, value in zip(group_by, group, strict=True)]
        own = label if tuple(group_by) == ("policy",) else ", ".join(texts)
        rows.append(replace(entry, label=own, group=group))
    return sorted(
        rows, key=lambda one: (environment_rank(one.config.env), _group_rank(one, group_by))
    )


def labels_of(configs: Iterable[ConfigRow]) -> list[str]:
    """Return what differs among configurations but the assessments, which change no loss."""
    hidden = ("task", "assessment_version", "assess")
    return labels(
        [{k: v for k, v in config.config.items() if k not in hidden} for config in configs]
    )


def _group_rank(entry: Entry, group_by: Sequence[str]) -> list[tuple[float, int, str]]:
    """Return the sorting key of the values: policies in their order, numbers, then texts."""
    ranks = []
    for key, value in zip(group_by, entry.group, strict=True):
        if key == "policy":
            place, name = policy_rank(str(value))
            ranks.append((0.0, place, name))
        elif isinstance(value, int | float):
            ranks.append((float(value), 0, ""))
        else:
            ranks.append((0.0, 0, str(value)))
    return ranks


def _gaps(entries: tuple[Entry, ...], *, by_policy: bool) -> Iterable[Gap]:
    """Yield what entries lack, with ``by_policy`` also possible policies without any trial."""
    seeds: dict[str, set[int]] = {}
    for entry in entries:
        seeds.setdefault(entry.config.env, set()).update(trial.seed for trial in entry.trials)
    for entry in entries:
        if is_prequential(entry.config.config):
            continue
        expected = seeds[entry.config.env]
        missing = expected - {trial.seed for trial in entry.finished}
        if missing:
            state = {trial.seed: trial.status for trial in entry.trials}
            states = Counter(state.get(seed, "not registered") for seed in missing)
            text = ", ".join(f"{count} {name}" for name, count in sorted(states.items()))
            yield Gap(entry.config.env, entry.config.policy, tuple(sorted(missing)), text)
    for env, policy in absent_pairs([entry.config for entry in entries]) if by_policy else ():
        expected = seeds[env]
        yield Gap(env, policy, tuple(sorted(expected)), f"{len(expected)} not registered")


def one_world(entries: Sequence[Entry], name: str = "env") -> list[Entry]:
    """Return the entries of the env section with most trials; entries are of one environment.

    ``name`` is the section that is compared. With equal numbers of trials, entries without that
    section come first.
    """
    totals: Counter[str] = Counter()
    for entry in entries:
        totals[section_text(entry, name)] += len(entry.trials)
    world = max(totals, key=lambda section: (totals[section], section == "null", section))
    return [entry for entry in entries if section_text(entry, name) == world]


def one_each(
    entries: Sequence[Entry],
    weight: Callable[[Entry], tuple[int, ...]] = lambda one: (len(one.trials),),
) -> list[Entry]:
    """Return the entry of the largest weight for each policy, model, learner, limits and path.

    The weight is by default the number of trials. Several differ in their task alone: the losses of
    a trial are the same with any and without one.
    """
    groups: dict[tuple[str, ...], list[Entry]] = {}
    for entry in entries:
        key = tuple(section_text(entry, name) for name in _IDENTITY)
        groups.setdefault(key, []).append(entry)
    return [max(group, key=weight) for group in groups.values()]


def unfinished(entries: Iterable[Entry]) -> Iterator[str]:
    """Yield a sentence for each entry that has trials which are not finished."""
    for entry in entries:
        missing = len(entry.trials) - len(entry.finished)
        if missing:
            yield f"{entry.config.env}, {entry.label}: {counted(missing, 'trial')} not finished"


def section_text(entry: Entry, name: str) -> str:
    """Return a section of a configuration as JSON, by which sections are compared."""
    return json.dumps(entry.config.config.get(name), sort_keys=True)
