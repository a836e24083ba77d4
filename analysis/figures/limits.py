"""Figure 9: bounded states against time, limits counted only on the left, enforced on the right.

Configurations of the reference policy that differ in ``limits.enforced`` alone are a row, one for
each of their bounded states.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.data.matching import nearness
from analysis.data.samples import bounded_states, violation_shares
from analysis.data.selection import (
    Entry,
    Selection,
    environment_rank,
    labelled,
    labels_of,
    ranges,
    unfinished,
)
from analysis.figures.panels import GUIDE, Plot, legend_below, mathematical, sheet
from analysis.stats.intervals import mean, standard_error
from analysis.style import BLUE, GREY, but_diverged, environment_title, percent_text
from dopt.policies import policy_title
from dopt.spec.label import flatten
from dopt.spec.trial import system_of
from dopt.systems import System
from orchestrate.store import Reader

Array = npt.NDArray[np.float64]

Pair = dict[bool, Entry]
"""Configurations that differ in ``limits.enforced`` alone, by its value."""

MOST_SEEDS = 20
"""Trials that are drawn of a configuration."""

_APART = ("task", "assess", "limits.enforced")
"""Beginnings of paths in which the configurations of a row may differ."""

ROW_HEIGHT = 1.75
LEGEND_HEIGHT = 0.4

WIDTHS = 3.0
"""Height of a panel at most, in widths of the bounds."""

MARGIN = 0.04
COLOURS = {False: GREY, True: BLUE}
WORDS = {False: "counted only", True: "enforced"}


@dataclass(frozen=True)
class Panel:
    """A bounded state of the trials of one configuration.

    Attributes
    ----------
    env, policy, label, state : str
        The environment, the policy, what sets the configuration apart from others of these, and the
        label of the state with its unit.
    enforced : bool
        True if inputs heed the limits.
    time : (T + 1,)
        Seconds.
    lines : (k, T + 1)
        The state in trials of ``seeds``, in its unit; NaN after a trial diverged.
    seeds : tuple of int
        Drawn trials: the first :data:`MOST_SEEDS` of those that all configurations of the row have.
    bounds : (2,)
        The lower and the upper bound, infinite where a side is unbounded.
    share, share_error : float
        Mean over n trials of the share of their steps after which any state is beyond a bound, and
        its standard error; NaN without trials.
    n, n_diverged : int
        Trials in the share, and how many of them diverged: their steps before that count.
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
    """Return the first seeds that all entries have finished; without any, the first entry's."""
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


def draw(panels: Panels) -> Figure:
    """Draw a row for each configuration and bounded state, a column for limits of either kind."""
    rows = rows_of(panels)
    kinds = sorted({panel.enforced for panel in panels})
    figure, grid = sheet(len(rows), len(kinds), ROW_HEIGHT, LEGEND_HEIGHT)
    for line, row in zip(grid, rows, strict=True):
        for axes, kind in zip(line, kinds, strict=True):
            own = [panel for panel in row if panel.enforced == kind]
            if not own:
                axes.set_axis_off()
                continue
            _panel(axes, own[0])
            axes.set_ylim(*view(row))
            axes.set_ylabel(mathematical(own[0].state) if own[0] is row[0] else "")
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    names = {kind: f"one trial, limits {WORDS[kind]}" for kind in kinds}
    handles = [Line2D([], [], color=COLOURS[kind], lw=0.8, label=names[kind]) for kind in kinds]
    handles.append(Line2D([], [], **GUIDE, label="bound"))
    legend_below(figure, 3, handles=handles)
    return figure


def rows_of(panels: Panels) -> list[list[Panel]]:
    """Return the panels of each configuration and state, in their order."""
    rows: dict[tuple[str, str, str], list[Panel]] = {}
    for panel in panels:
        rows.setdefault((panel.env, panel.label, panel.state), []).append(panel)
    return list(rows.values())


def view(row: Sequence[Panel]) -> tuple[float, float]:
    """Return the limits of the axis of a row: all that is drawn, near the bounds.

    That is within :data:`WIDTHS` widths of the bounds around their middle. Of a single bound, the
    width is twice its distance from the first state, which is the middle.
    """
    drawn = np.concatenate([panel.lines.ravel() for panel in row])
    drawn = drawn[np.isfinite(drawn)]
    low, high = (float(bound) for bound in row[0].bounds)
    edges = [bound for bound in (low, high) if math.isfinite(bound)]
    middle, width = 0.5 * (low + high), high - low
    if len(edges) < 2:
        middle = float(drawn[0]) if len(drawn) else edges[0]
        width = 2.0 * abs(edges[0] - middle) or math.inf
    values = np.concatenate([drawn, edges])
    half = 0.5 * WIDTHS * width
    low, high = max(values.min(), middle - half), min(values.max(), middle + half)
    margin = MARGIN * (high - low)
    return low - margin, high + margin


def _panel(axes: Axes, panel: Panel) -> None:
    axes.plot(panel.time, panel.lines.T, color=COLOURS[panel.enforced], lw=0.5, alpha=0.7)
    for bound in panel.bounds[np.isfinite(panel.bounds)]:
        axes.axhline(bound, **GUIDE)
    axes.set_xlim(panel.time[0], panel.time[-1])
    axes.set_title(
        f"{environment_title(panel.env)}: {panel.label}\n"
        f"{WORDS[panel.enforced]}: {share_text(panel)}",
        fontsize=7.5,
    )


def share_text(panel: Panel) -> str:
    """Return the share of steps beyond a bound in per cent ± 2 standard errors, and n."""
    text = percent_text(panel.share, panel.share_error, panel.n)
    beyond = f"{text} of steps beyond" if text else "share unknown"
    return f"{beyond} (n = {but_diverged(panel.n, panel.n_diverged)})"


def caption(panels: Panels) -> str:
    """Return the caption, with the drawn trials and what the share is."""
    drawn = {f"{environment_title(one.env)}, {one.label}": ranges(one.seeds) for one in panels}
    words = [f"{name}: {own}" for name, own in drawn.items()]
    seeds = "; ".join(words) if len(set(drawn.values())) > 1 else next(iter(drawn.values()))
    kinds = {panel.enforced for panel in panels}
    sides = "limits are counted only on the left and enforced on the right"
    only = f"limits are {WORDS[panels[0].enforced]}"
    return (
        f"States with bounds against time, {policy_title(panels[0].policy)}, a line for each "
        f"trial; {sides if len(kinds) > 1 else only}. Dashed: bounds. At most "
        f"{MOST_SEEDS} trials are drawn, of the first seeds; drawn seeds: {seeds}. The axis "
        f"shows at most {WIDTHS:g} widths of the bounds, lines beyond it are cut off; angles are "
        f"not wrapped. Percentage: steps after which any state is beyond a bound, mean over n "
        f"trials ± 2 standard errors; of a trial that diverged, the steps before."
    )


LIMITS: Plot[Panels] = Plot(
    title="States with limits, counted only and enforced",
    statistic="states of single trials; mean over trials of the share of steps beyond a bound",
    band="± 2 standard errors of the mean share (printed)",
    part=lambda selection, _: limits_part(selection),
    measure=lambda reader, selection, _: measure_panels(reader, selection),
    tabulate=tabulate_panels,
    draw=draw,
    caption=caption,
)
"""Bounded states of trials with limits."""
