"""Choice of the stored configuration that stands for a policy in an environment.

A database may hold the paper's grid beside other widths, bounds and learners. A picture compares
policies under one setting of an environment: its env, model, learner and limits. A setting with the
reference policy and a baseline goes before one with the reference alone, such as another width;
then the one with most trials wins, then the one nearest to the defaults, which are the paper's
setting. A policy that exists only with its own model (the oracle) is taken with that model, in
the same env section and under the same limits. What was left out is said; a tie is an error.

Configurations of older code are left out. Of several that differ in the state of a user's file
alone, the one whose trials were registered last is taken.
"""

from __future__ import annotations

import difflib
import json
import math
import reprlib
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from dopt.errors import DoptError
from dopt.registry import SOURCE, TARGET
from dopt.spec.config import difference, flatten, unusual
from dopt.spec.trial import is_fit
from orchestrate.store import CONFIG_COLUMNS, ConfigRow, Reader


class AnalysisError(DoptError):
    """The request cannot be answered: unknown name, nothing stored, ambiguous choice."""


class IncompleteError(AnalysisError):
    """Trials that the request needs are missing from the database."""


REFERENCE = "d_optimal"
"""The policy that all others are compared with, unless another one is asked for."""

APART = "oracle"
"""The policy that knows the form of the physics: on an axis of ratios others would have no room."""

USUAL = {"model": "mlp", "learner": "adam_window"}
"""Names of what a launch takes by itself."""

COLUMNS = tuple(name for name in CONFIG_COLUMNS if name not in ("env", "label"))
"""Settings that have their own column."""

Setting = tuple[str, ...]
"""JSON of the sections env, limits, model and learner; null for none."""

_WORLD = 2
"""Number of sections, from the first, that all policies of a picture share."""

_LAST = (
    "SELECT max(r.trial_id) AS last FROM trial r JOIN config c ON c.config_id = r.config_id "
    "WHERE c.config_key = :config_key"
)


@dataclass(frozen=True)
class Filter:
    """Selection by a user; an empty one is everything.

    ``where`` maps a dotted path of the configuration, such as ``model.width``, to a value; it says
    nothing of a configuration that has no such path, such as the linear model of the oracle.
    ``group_by`` are the settings of which each combination of values is shown once; ``reference``
    is the policy, or the value of the setting, that all others are compared with.
    """

    environments: tuple[str, ...] = ()
    policies: tuple[str, ...] = ()
    where: Mapping[str, object] = field(default_factory=dict)
    reference: str = REFERENCE
    group_by: tuple[str, ...] = ("policy",)

    def accepts(self, config: ConfigRow) -> bool:
        return (
            (not self.environments or config.env in self.environments)
            and (not self.policies or config.policy in self.policies)
            and all(
                flatten(config.config).get(path, value) == value
                for path, value in self.where.items()
            )
        )

    def check_where(self, configs: Sequence[ConfigRow]) -> None:
        """Raise AnalysisError for a condition that no stored configuration meets."""
        flat = [flatten(config.config) for config in configs]
        for path, value in self.where.items():
            found = {json.dumps(entry[path]): entry[path] for entry in flat if path in entry}
            stored = sorted(found, key=lambda text: (_size(found[text]), text))
            if not stored:
                raise _no_setting(f"--where {path} names no value", path, flat)
            if not any(entry.get(path) == value for entry in flat if path in entry):
                text = json.dumps(value, default=str)
                raise AnalysisError(
                    f"--where {path}={text} fits no stored configuration, "
                    f"stored are {', '.join(stored)}: choose one of these."
                )


def _size(value: object) -> float:
    return value if isinstance(value, int | float) else math.inf


def read_condition(text: str) -> tuple[str, object]:
    """Return path and value, as JSON or text, of ``PATH=VALUE``; raise AnalysisError for others."""
    path, equals, value = text.partition("=")
    if not equals or not path:
        raise AnalysisError(
            f"--where {reprlib.repr(text)} is no condition, PATH=VALUE is expected, such as "
            f"model.width=32: correct it."
        )
    try:
        return path, json.loads(value)
    except (ValueError, RecursionError):
        return path, value


def choose(configs: Iterable[ConfigRow], reference: str = REFERENCE) -> list[ConfigRow]:
    """Return one configuration for each (environment, policy); raise AnalysisError on a tie."""
    groups: dict[str, list[ConfigRow]] = {}
    for config in configs:
        groups.setdefault(config.env, []).append(config)
    return [config for group in groups.values() for config in _choose_policies(group, reference)]


def choose_by(
    configs: Iterable[ConfigRow], keys: Sequence[str], reference: str = REFERENCE
) -> list[ConfigRow]:
    """Return one configuration for each environment and combination of values of some settings.

    Where a combination has several policies it is the reference's, if there is one, else the first
    by name. Configurations without one of the settings are left out.
    """
    groups: dict[tuple[object, ...], list[ConfigRow]] = {}
    for config in configs:
        values = [setting_value(config, key) for key in keys]
        if None not in values:
            groups.setdefault((config.env, *map(repr, values)), []).append(config)
    chosen = [_choose_policies(group, reference) for group in groups.values()]
    return [min(own, key=lambda one: (one.policy != reference, one.policy)) for own in chosen]


def setting_value(config: ConfigRow, key: str) -> object:
    """Return a value by column (``width``) or by dotted path (``env.gamma``), None without one."""
    if key in COLUMNS:
        return getattr(config, key)
    return flatten(config.config).get(key)


def check_keys(keys: Sequence[str], configs: Sequence[ConfigRow]) -> None:
    """Raise AnalysisError for a setting that no configuration has."""
    for key in keys:
        if all(setting_value(config, key) is None for config in configs):
            flat = [flatten(config.config) for config in configs]
            raise _no_setting(f"'{key}' is no setting", key, [*flat, dict.fromkeys(COLUMNS)])


def _no_setting(said: str, path: str, flat: Sequence[Mapping[str, object]]) -> AnalysisError:
    """Return the error for a path that no flat configuration has, with the nearest that some do."""
    near = difflib.get_close_matches(path, sorted(set().union(*flat)), n=3, cutoff=0.3)
    return AnalysisError(
        f"{said} of a stored configuration: choose for instance one of "
        f"{', '.join(near) or 'model.width, env.gamma'}."
    )


def _choose_policies(group: Sequence[ConfigRow], reference: str) -> list[ConfigRow]:
    setting = _setting(_reference(group, reference))
    chosen = []
    for policy in sorted({config.policy for config in group}):
        own = [config for config in group if config.policy == policy]
        same = [config for config in own if _setting(config) == setting]
        world = [config for config in own if _setting(config)[:_WORLD] == setting[:_WORLD]]
        if same or world:
            chosen.append(_most(same or world))
    return chosen


def _reference(group: Sequence[ConfigRow], reference: str) -> ConfigRow:
    """Return the configuration that fixes the setting; see the top of this file for the order."""
    pool = [config for config in group if config.policy == reference] or group
    totals: Counter[Setting] = Counter()
    policies: dict[Setting, set[str]] = {}
    for config in group:
        totals[_setting(config)] += config.n
        policies.setdefault(_setting(config), set()).add(config.policy)

    def rank(config: ConfigRow) -> tuple[int, ...]:
        setting = _setting(config)
        return -(len(policies[setting]) < 2), totals[setting], config.n, *nearness(config)

    return _first(pool, rank, _setting)


def _most(configs: Sequence[ConfigRow]) -> ConfigRow:
    return _first(configs, lambda one: (one.n, *nearness(one)), lambda one: one.config_key)


def _first(
    configs: Sequence[ConfigRow],
    rank: Callable[[ConfigRow], tuple[int, ...]],
    what: Callable[[ConfigRow], Hashable],
) -> ConfigRow:
    """Return the configuration of the highest rank; raise AnalysisError if several differ."""
    top = max(map(rank, configs))
    best = [config for config in configs if rank(config) == top]
    if len(set(map(what, best))) > 1:
        raise _tie(best)
    return best[0]


def nearness(config: ConfigRow) -> tuple[int, int, int, bool]:
    """Return a key by which the configuration that is nearest to the defaults is the largest.

    The model and the learner that a launch takes by itself come first, then fewer values that are
    not defaults of what is named, then no task: it changes nothing of the trial. Last come stored
    sample losses.
    """
    parts = {key: one for key, one in config.config.items() if isinstance(one, Mapping)}
    task, sampled = parts.pop("task", None), parts.pop("assess", None)
    names = [parts.get(section, {}).get("name") != name for section, name in USUAL.items()]
    settings = unusual(parts) - {f"{section}.name" for section in USUAL}
    plant = "plant" in parts.get("env", {})  # which is unusual whatever its settings
    return -sum(names), -len(settings) - plant, -(task is not None), sampled is not None


def _tie(pool: Sequence[ConfigRow]) -> AnalysisError:
    first = pool[0]
    path, values = difference([config.config for config in pool])
    listed = ", ".join(json.dumps(value, ensure_ascii=False) for value in values)
    return AnalysisError(
        f"{len(pool)} configurations of {first.env} × {first.policy} have "
        f"{first.n} trials each and differ in {path} ({listed}): "
        f"choose one with --where {path}={json.dumps(values[0], ensure_ascii=False)}."
    )


def _setting(config: ConfigRow) -> Setting:
    sections = (config.config.get(name) for name in ("env", "limits", "model", "learner"))
    return tuple(json.dumps(section, sort_keys=True) for section in sections)


def accepted(reader: Reader, wanted: Filter) -> list[ConfigRow]:
    """Return the stored configurations of the newest code that fit a request, at least one.

    Raises AnalysisError for a name or a condition that is not stored, and where nothing fits.
    """
    configs = list(reader.configs())
    for kind, given, column in (
        ("environment", wanted.environments, "env"),
        ("policy", wanted.policies, "policy"),
    ):
        stored = sorted({getattr(config, column) for config in configs})
        for name in (one for one in given if one not in stored):
            raise AnalysisError(
                f"The database has no trial of {kind} '{name}', "
                f"choose one of {', '.join(stored) or 'none: it is empty'}."
            )
    wanted.check_where(configs)
    found = newest([config for config in configs if wanted.accepts(config)])
    if not found:
        raise AnalysisError(
            f"No configuration in {reader.safe_url} fits the request, "
            f"it holds {len(configs)} in all: run the grid first, or ask for less."
        )
    return found


def latest(reader: Reader, configs: list[ConfigRow]) -> list[ConfigRow]:
    """Return the configurations of the newest code, and of the last state of users' files."""
    return latest_sources(reader, newest(configs))


def newest(configs: list[ConfigRow]) -> list[ConfigRow]:
    """Return the configurations of the newest code version: other versions' numbers do not mix.

    Configurations with a task: only the newest version of the assessments. Of configurations that
    differ in the version of the plans' criterion alone, only the newest. Fits to recorded runs are
    left out: they explored nothing.
    """
    configs = [config for config in configs if not is_fit(config.config)]
    code = max((config.config.get("code_version", 0) for config in configs), default=0)
    assessment = max((_assessment_version(config) or 0 for config in configs), default=0)
    found = [
        config
        for config in configs
        if config.config.get("code_version", 0) == code
        and _assessment_version(config) in (None, assessment)
    ]
    criteria: dict[str, int] = {}
    for content, version in map(_criterion, found):
        criteria[content] = max(version, criteria.get(content, version))
    return [one for one in found if criteria[_criterion(one)[0]] == _criterion(one)[1]]


def _criterion(config: ConfigRow) -> tuple[str, int]:
    """Return the configuration without the version of the plans' criterion, and this version."""
    content = dict(config.config)
    version = int(content.pop("criterion_version", 1))
    return json.dumps(content, sort_keys=True), version


def _assessment_version(config: ConfigRow) -> int | None:
    return int(config.config.get("assessment_version", 1)) if config.config.get("task") else None


def latest_sources(
    reader: Reader, configs: Sequence[ConfigRow], apart: Collection[str] = ()
) -> list[ConfigRow]:
    """Return the configurations without those that another one of a later file replaces.

    Digests at the dotted paths ``apart``, such as ``env.source``, are told apart as settings are.
    """
    groups: dict[str, list[ConfigRow]] = {}
    for config in configs:
        groups.setdefault(_without_sources(config, apart), []).append(config)
    replaced: set[str] = set()
    for group in groups.values():
        if len(group) > 1:
            latest = max(group, key=lambda config: _last_trial(reader, config))
            replaced |= {config.config_key for config in group if config is not latest}
    return [config for config in configs if config.config_key not in replaced]


def source_notes(configs: Iterable[ConfigRow], chosen: Sequence[ConfigRow]) -> Iterable[str]:
    """Yield sentences on configurations of other files than those that are shown."""
    shown, stored = _digests(chosen), _digests(configs)
    for (env, path, target), digests in sorted(shown.items(), key=lambda item: str(item[0])):
        others = sorted(stored.get((env, path, target), digests) - digests)
        if not others:
            continue
        here = ", ".join(sorted(digests))
        ways = " or ".join(f"--where {path}={_argument(digest)}" for digest in others)
        yield (
            f"{env}: {path} differs, as the file of {target} was edited: these trials have {here}, "
            f"trials of other states of the file are left out (see {ways})"
        )


def _digests(configs: Iterable[ConfigRow]) -> dict[tuple[str, str, object], set[str]]:
    """Return the digests of each user's class in an environment, by the path of the digest."""
    found: dict[tuple[str, str, object], set[str]] = {}
    for config in configs:
        for path, (target, digest) in _sources(config).items():
            found.setdefault((config.env, path, target), set()).add(digest)
    return found


def _sources(config: ConfigRow) -> dict[str, tuple[object, str]]:
    """Return class and digest of each section of a user's class, by the path of the digest."""
    return {
        f"{key}.{SOURCE}": (section[TARGET], str(section[SOURCE]))
        for key, section in config.config.items()
        if isinstance(section, Mapping) and TARGET in section and SOURCE in section
    }


def _without_sources(config: ConfigRow, apart: Collection[str]) -> str:
    """Return the text of a configuration without the digests that are not told apart."""
    content = dict(config.config)
    for path in _sources(config):
        key = path.partition(".")[0]
        if path not in apart:
            content[key] = {k: v for k, v in content[key].items() if k != SOURCE}
    return json.dumps(content, sort_keys=True)


def _last_trial(reader: Reader, config: ConfigRow) -> int:
    """Return the identifier of the last registered trial, -1 without one."""
    (row,) = reader.rows(_LAST, config_key=config.config_key)
    return -1 if row.last is None else int(row.last)


def _argument(digest: str) -> str:
    """Return a digest as a condition takes it; one that reads as a number is quoted."""
    is_text = read_condition(f"{SOURCE}={digest}") == (SOURCE, digest)
    return digest if is_text else f"'{json.dumps(digest)}'"
