"""Configuration of a launch: overrides, sweeps and the grid of trials that they ask for.

This module holds the grid, built from the combinations of a command line, and the settings of the
launch as checked values, none of which is part of a trial. A refusal names the key, the value and
the range.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, zip_longest
from typing import Any

from dopt.custom_planner import check_custom_parts
from dopt.errors import IncompatibleError, SpecificationError, stripped, unknown_name
from dopt.registry import name_of
from dopt.spec.config import TrialConfig
from dopt.spec.trial import TrialSpec
from orchestrate.errors import LaunchError
from orchestrate.program import LARGEST

TRIAL_SECTIONS = (
    *("env", "plant", "policy", "model", "learner"),
    *("task", "limits", "assess", "seed"),
)
"""Sections of a configuration that define a trial."""


@dataclasses.dataclass(frozen=True)
class Combination:
    """Settings of one configuration of a grid, in plain types.

    Attributes
    ----------
    settings
        Sections of the resolved configuration.
    seeds
        Seeds of the configuration, or None for the one in ``settings``.
    overrides
        Swept overrides of this combination, as they would be typed.
    used, unused
        Keys set by the grid that exist in this choice of groups, and keys that do not.
    """

    settings: Mapping[str, Any]
    seeds: Sequence[Any] | None = None
    overrides: tuple[str, ...] = ()
    used: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Grid:
    """Distinct trials of a launch, with the trials that were left out.

    Attributes
    ----------
    trials
        In the order of execution: all configurations with their first seed, then the second, ...
    n_jobs
        Number of jobs of the command line, including repeats and left-out ones.
    left_out
        Number of left-out trials by reason.
    notes
        Message for each override that applies to a part of the grid only.
    """

    trials: list[TrialSpec]
    n_jobs: int
    left_out: dict[str, int]
    notes: tuple[str, ...] = ()

    @property
    def repeats(self) -> int:
        """Number of jobs that repeat a trial."""
        return self.n_jobs - sum(self.left_out.values()) - len(self.trials)

    def on_path(self, path: str) -> Grid:
        """Return the grid with its trials on an execution path."""
        configs: dict[str, TrialConfig] = {}
        trials = []
        for trial in self.trials:
            key = trial.config_key
            if key not in configs:
                configs[key] = dataclasses.replace(trial.config, path=path)
            trials.append(TrialSpec(configs[key], trial.seed))
        return dataclasses.replace(self, trials=trials)


def build_grid(combinations: Iterable[Combination], *, single: bool = False) -> Grid:
    """Return the grid of typed trials; incompatible choices are left out.

    For a ``single`` trial an incompatible choice is an error.

    Raises
    ------
    SpecificationError
        If a value is unknown, of the wrong type or out of bounds, if nothing is left, or if what
        runs of a user's class lacks a method.
    """
    combinations = list(combinations)
    by_config: list[list[TrialSpec]] = []
    left_out: dict[str, int] = {}
    n_jobs = 0
    for combination in combinations:
        size = 1 if combination.seeds is None else len(combination.seeds)
        n_jobs += size
        try:
            trial = TrialSpec.from_mapping(combination.settings)
            seeds = combination.seeds
            by_config.append([trial] if seeds is None else [trial.with_seed(s) for s in seeds])
        except IncompatibleError as error:
            if single:
                raise
            env, policy = (name_of(combination.settings[key]) for key in ("env", "policy"))
            reason = f"env={env} policy={policy}: {error}"
            left_out[reason] = left_out.get(reason, 0) + size
    seed_by_seed = filter(None, chain.from_iterable(zip_longest(*by_config)))
    trials = list({trial.trial_key: trial for trial in seed_by_seed}.values())
    if not trials:
        raise SpecificationError(
            f"the grid is empty: {' '.join(left_out) or 'no trial was requested'}"
        )
    check_custom_parts(one[0] for one in by_config if one)
    return Grid(trials, n_jobs, left_out, tuple(_notes(combinations)))


def _notes(combinations: Sequence[Combination]) -> Iterator[str]:
    """Yield a message for each key that only some of the choices have."""
    for key in dict.fromkeys(key for one in combinations for key in one.unused):
        group = key.split(".")[0]
        having = (one.settings.get(group) for one in combinations if key in one.used)
        names = dict.fromkeys(name_of(part) for part in having if isinstance(part, Mapping))
        yield f"{key} applies to {group}={','.join(names)} only"


_PRECISION = re.compile(r"ci\s*<\s*(\d+(?:\.\d+)?)\s*%")


def setting(
    key: str,
    value: object,
    kind: type,
    expected: str,
    holds: Callable[[Any], object] = lambda _: True,
    *,
    null: bool = False,
) -> Any:
    """Return a value as ``kind``, or None where ``null`` allows it.

    Raises ``LaunchError`` if it has another type, or is not as ``holds`` says.
    """
    if value is None and null:
        return None
    numbers = (int, float) if kind is float else kind
    of_kind = isinstance(value, numbers) and (kind is bool or not isinstance(value, bool))
    if of_kind and holds(value):
        return kind(value)
    raise wrong(key, value, f"null or {expected}" if null else expected)


def wrong(key: str, value: object, expected: str) -> LaunchError:
    """Return the error for a setting with an invalid value."""
    typed = json.dumps(value) if isinstance(value, bool | None) else repr(value)
    return LaunchError(f"{key} is {typed}, but {expected} is expected: change {key}.")


def _amount(unit: str) -> str:
    return f"a number of {unit} above 0 and below {LARGEST:,}"


flag = partial(setting, kind=bool, expected="true or false")
text = partial(setting, kind=str, expected="a text", holds=bool)
count = partial(
    setting, kind=int, expected="a whole number above 0", holds=lambda value: value > 0, null=True
)
_bounded = partial(setting, kind=float, holds=lambda value: 0 < value < LARGEST)
_mapping = partial(setting, kind=dict, expected="a section with settings of its own")


def section(key: str, value: object, names: Collection[str]) -> dict[str, Any]:
    """Return a section of settings, of which none is missing or unknown."""
    found: dict[str, Any] = _mapping(key, value)
    _require(found, names)
    for name in found:
        if name not in names:
            raise unknown_name(f"setting of {key}", name, names)
    return found


def _require(found: Mapping[str, Any], names: Iterable[str]) -> None:
    for name in names:
        if name not in found:
            raise LaunchError(
                f"an override deletes '{name}', which a launch needs: leave that override out."
            )


def factor(key: str, value: object, limit_key: str, limited: object) -> float | None:
    """Return a factor by which a limit is raised, which has to be set; or None."""
    found: float | None = setting(
        key, value, float, "a factor above 1, at most 100,", lambda one: 1 < one <= 100, null=True
    )
    if found is not None and limited is None:
        raise LaunchError(
            f"{key} is {found:g}, but there is no limit that it could raise: set {limit_key}, or "
            f"leave {key} out."
        )
    return found


def precision(key: str, value: object) -> float | None:
    """Return the share of a mean to within which it shall be known: 0.05 for ``ci<5%``, or None."""
    match = _PRECISION.fullmatch(value.strip()) if isinstance(value, str) else None
    if match and 0 < float(match[1]) < 100:
        return float(match[1]) / 100
    if value is None:
        return None
    raise wrong(
        key,
        value,
        "null or ci<P% with P above 0 and below 100 (the geometric mean of the final loss is known "
        "to within P percent), such as 'ci<5%',",
    )


RETRY = ("failed", "diverged", "cancelled", "all")


def retried(key: str, value: object) -> str | None:
    """Return the status of trials that run again, or None."""
    if value is None or value in RETRY:
        return value
    raise unknown_name(key, value, RETRY)


_CHECKS: Mapping[str, Callable[[str, object], Any]] = {
    **dict.fromkeys(("dry_run", "detach", "fail_fast"), flag),
    **dict.fromkeys(
        ("chunk_seconds", "lease", "patience"), partial(_bounded, expected=_amount("seconds"))
    ),
    **{"retry": retried, "until": precision, "workers": count},
    "timeout": partial(_bounded, expected=_amount("seconds"), null=True),
    "memory_gib": partial(_bounded, expected=_amount("GiB"), null=True),
}
"""Checks of the settings of a launch that stand alone."""


@dataclasses.dataclass(frozen=True)
class LaunchSettings:
    """Settings of one launch.

    Attributes
    ----------
    executor
        Name in :data:`orchestrate.executors.base.EXECUTORS`.
    store_url
        SQLAlchemy URL of the results database.
    detach
        Register the grid and leave; workers run it.
    retry
        Finished trials of the grid that are run again.
    until
        Precision of the geometric mean of the final loss, as a share of it, at which a
        configuration gets no more of its seeds; None to run all.
    workers
        Processes, or None for one on each core.
    chunk_seconds
        Work that a worker gets at once.
    timeout
        Seconds of wall time that one trial may take, or None for no limit.
    memory_gib
        Memory that one worker process may take, or None for no limit.
    retry_memory
        Factor on ``memory_gib`` with which a trial that runs out of memory runs once more, or None.
    lease
        Seconds after its last heartbeat for which a launch on PostgreSQL keeps its trials.
    patience
        Seconds that a launch waits for a database that cannot be reached.
    ray_address
        "local" for a Ray of its own, or HOST:PORT of the head of a cluster.
    executor_options
        Section ``executor`` without its name; the executor checks it.
    """

    executor: str
    store_url: str
    dry_run: bool = False
    detach: bool = False
    fail_fast: bool = False
    retry: str | None = None
    until: float | None = None
    workers: int | None = None
    chunk_seconds: float = 1.0
    timeout: float | None = 3600.0
    memory_gib: float | None = None
    retry_memory: float | None = None
    lease: float = 60.0
    patience: float = 30.0
    ray_address: str = "local"
    executor_options: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @classmethod
    def from_mapping(cls, given: Mapping[str, Any]) -> LaunchSettings:
        """Check the sections ``launch``, ``store`` and ``executor`` of a configuration.

        Raises
        ------
        LaunchError
            If a value has the wrong type or is out of bounds.
        """
        launch = section("launch", given["launch"], (*_CHECKS, "retry_memory", "ray"))
        ray = section("launch.ray", launch["ray"], ("address",))
        store = section("store", given["store"], ("url",))
        executor = _mapping("executor", given["executor"])
        _require(executor, ["name"])
        checked = {name: check(f"launch.{name}", launch[name]) for name, check in _CHECKS.items()}
        if checked["patience"] >= checked["lease"]:  # a launch gives up before its lease ends
            raise wrong(
                "launch.patience", launch["patience"], f"less than launch.lease={launch['lease']}"
            )
        return cls(
            **checked,
            executor=text("executor.name", executor.pop("name")),
            store_url=stripped(text("store.url", store["url"]), "store.url", LaunchError),
            retry_memory=factor(
                *("launch.retry_memory", launch["retry_memory"]),
                *("launch.memory_gib", launch["memory_gib"]),
            ),
            ray_address=text("launch.ray.address", ray["address"]),
            executor_options=executor,
        )
