"""Figure 9 as numbers: bounded states against time, with limits counted only and enforced.

Configurations of the reference policy that differ in ``limits.enforced`` alone are a row, one for
each of their bounded states.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.data.bounded_states import bounded_states, violation_shares
from analysis.data.config_matching import nearness
from analysis.data.trial_selection import Entry, Selection, environment_rank, labelled, labels_of
from analysis.data.variants import unfinished
from analysis.stats.intervals import mean, standard_error
from dopt.spec.label import flatten
from dopt.spec.prequential import system_of
from dopt.systems import System
from orchestrate.store import Reader

Array = npt.NDArray[np.float64]
Pair = dict[bool, Entry]
"""Configurations that are alike but for ``limits.enforced``, by its value."""

MOST_SEEDS = 20
"""Trials that are drawn of a configuration."""

_APART = ("task", "assessment_version", "limits.enforced")
"""Beginnings of paths in which the configurations of a row may differ."""


@dataclass(frozen=True)
class Panel:
    """A bounded state of the trials of one configuration.

    Attributes
    ----------
    env, policy, label, state : str
        The environment, the policy, what sets the configuration apart from others of these, and the
        label of the state with its unit.
    enforced : bool
        Whether inputs heed the limits.
    time : (T + 1,)
        Seconds.
    lines : (k, T + 1)
        The state in trials of ``seeds``, in its unit; NaN after a trial diverged.
    seeds : tuple of int
        Drawn trials: the first :data:`MOST_SEEDS` of those that all configurations of the row have.
    bounds : (2,)
        The lower and the upper bound, infinite where there is none.
    share, share_error : float
        Mean over n trials of the share of their steps after which any state is beyond a bound, and
        its standard error; NaN where there is none.
    n, n_diverged : int
        Trials in the share, and those of them that diverged: their steps before that count.
    """

    env: str
    policy: str
    label: str
    state: str
    enforced: bool
    time: Array
    lines: Array
    seeds: tuple[int, ...]
    bounds: Array
    share: float
    share_error: float
    n: int
    n_diverged: int


Panels = tuple[Panel, ...]


def limits_part(selection: Selection) -> Selection:
    """Return the entries of the reference policy whose limits bound a state."""
    kept = [one for pair in pairs(selection.stored, selection.reference) for one in pair.values()]
    entries = tuple(labelled(kept))
    return replace(
        selection, entries=entries, gaps=(), notes=tuple(unfinished(entries)), stored=entries
    )


def pairs(entries: Sequence[Entry], policy: str) -> list[Pair]:
    """Return the configurations of a policy that bound a state, in the order of the rows.

    Environments have their usual order; in one of them the row nearest to the defaults comes first.
    Of configurations that differ in their task alone the one with most trials is taken.
    """
    found: dict[str, Pair] = {}
    for entry in entries:
        if entry.config.policy == policy and entry.finished and _bounds(entry):
            pair = found.setdefault(_common(entry), {})
            enforced = bool(entry.config.config["limits"]["enforced"])
            if enforced not in pair or len(entry.trials) > len(pair[enforced].trials):
                pair[enforced] = entry
    return [dict(sorted(pair.items())) for _, pair in sorted(found.items(), key=_rank)]


def _rank(item: tuple[str, Pair]) -> tuple[object, ...]:
    common, pair = item
    configs = [entry.config for entry in pair.values()]
    nearest = max(nearness(config) for config in configs)
    return environment_rank(configs[0].env), [-value for value in nearest], common


def _common(entry: Entry) -> str:
    flat = flatten(entry.config.config)
    kept = {path: value for path, value in flat.items() if not path.startswith(_APART)}
    return json.dumps(kept, sort_keys=True)


def _bounds(entry: Entry) -> dict[int, Array]:
    config = entry.config.config
    return bounded_states(config, system_of(config)) if config.get("limits") else {}


def measure_panels(reader: Reader, selection: Selection) -> Panels:
    """Return the panels row by row: those counted only before those enforced."""
    found = pairs(selection.entries, selection.reference)
    labels = _labels(found)
    return tuple(
        panel
        for pair, label in zip(found, labels, strict=True)
        for panel in _row_panels(reader, pair, label)
    )


def _labels(found: Sequence[Pair]) -> list[str]:
    """Return what tells the rows of an environment apart, and their limits."""
    configs = [next(iter(pair.values())).config for pair in found]
    plain = []
    for config in configs:
        limits = {k: v for k, v in config.config["limits"].items() if k != "enforced"}
        plain.append(replace(config, config={**config.config, "limits": limits}))
    return labels_of(plain)


def _row_panels(reader: Reader, pair: Pair, label: str) -> Iterator[Panel]:
    first = next(iter(pair.values()))
    system = system_of(first.config.config)
    seeds = _drawn_seeds(pair)
    states = {key: _states(reader, entry, seeds, system) for key, entry in pair.items()}
    time: Array = system.dt * np.arange(system.horizon + 1, dtype=np.float64)
    shares = {key: np.array([*violation_shares(reader, one).values()]) for key, one in pair.items()}
    for place, bounds in _bounds(first).items():
        for enforced, entry in pair.items():
            yield Panel(
                env=entry.config.env,
                policy=entry.config.policy,
                label=label,
                state=system.state_labels[place],
                enforced=enforced,
                time=time,
                lines=states[enforced][:, :, place],
                seeds=seeds,
                bounds=bounds,
                share=float(mean(shares[enforced])),
                share_error=float(standard_error(shares[enforced])),
                n=len(shares[enforced]),
                n_diverged=sum(trial.status == "diverged" for trial in entry.finished),
            )


def _drawn_seeds(pair: Pair) -> tuple[int, ...]:
    """Return the first seeds that all entries have finished; without any, those of the first."""
    own = [{trial.seed for trial in entry.finished} for entry in pair.values()]
    return tuple(sorted(set.intersection(*own) or own[0])[:MOST_SEEDS])


def _states(reader: Reader, entry: Entry, seeds: Sequence[int], system: System) -> Array:
    """Return the states (k, T + 1, d) of trials, NaN where one has not come so far."""
    states = np.full((len(seeds), system.horizon + 1, system.n_states), np.nan)
    finished = {trial.seed for trial in entry.finished}
    for place, seed in enumerate(seeds):
        if seed in finished:
            own = reader.trajectory(entry.config.config_key, seed).states
            states[place, : len(own)] = own
    return states


def tabulate_panels(panels: Panels) -> pd.DataFrame:
    """Return what is drawn, one row for each panel and step, a column for each seed."""
    return pd.concat([_table(panel) for panel in panels], ignore_index=True)


def _table(panel: Panel) -> pd.DataFrame:
    columns = {
        "env": panel.env,
        "policy": panel.policy,
        "label": panel.label,
        "state": panel.state,
        "enforced": panel.enforced,
        "lower": panel.bounds[0],
        "upper": panel.bounds[1],
        "share_beyond": panel.share,
        "two_standard_errors": 2 * panel.share_error,
        "n": panel.n,
        "n_diverged": panel.n_diverged,
        "time_s": panel.time,
    }
    lines = {f"seed_{seed}": line for seed, line in zip(panel.seeds, panel.lines, strict=True)}
    return pd.DataFrame(columns | lines)
