"""Figure 4 as numbers: cost of a step by part, and final loss, against the width of the network.

All entries of a line differ in the width alone. Beside the line of the usual form of the
information matrix there may be lines of other forms (primal, dual), of which planning counts.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.data.config_matching import REFERENCE, nearness
from analysis.data.curves import read_sample
from analysis.data.divergence import DivergenceRule
from analysis.data.trial_selection import Entry, Selection
from analysis.stats.intervals import mean, standard_error
from analysis.stats.trial_scores import final_losses
from analysis.units import loss_unit
from dopt.spec.label import flatten
from dopt.spec.prequential import system_of
from orchestrate.store import Reader

PARTS = ("plan", "learn", "evaluate")
FORMS = ("primal", "dual", "sketch")
LEAST_WIDTHS = 3
QUANTILES = (0.1, 0.5, 0.9)

Line = tuple[Entry, ...]


@dataclass(frozen=True)
class Cost:
    """Microseconds of one part of a step against the width.

    Attributes
    ----------
    form : str
        Representation of the information matrix.
    part : str
        One of :data:`PARTS`.
    widths, n : (W,)
        Units in each hidden layer, and trials, ascending by width.
    low, median, high : (W,)
        The 10 %, 50 % and 90 % quantiles over steps and trials.
    exponent : float
        Of the power law fitted to the medians of the upper half of the widths.
    """

    form: str
    part: str
    widths: npt.NDArray[np.int64]
    n: npt.NDArray[np.int64]
    low: npt.NDArray[np.float64]
    median: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]
    exponent: float


@dataclass(frozen=True)
class WidthCosts:
    """Costs of a step in one environment; ``limit_us`` is the time between two steps, dt."""

    env: str
    policy: str
    costs: tuple[Cost, ...]
    limit_us: float


@dataclass(frozen=True)
class WidthLosses:
    """Final losses in one environment: mean and standard error over trials, each (W,)."""

    env: str
    policy: str
    widths: npt.NDArray[np.int64]
    mean: npt.NDArray[np.float64]
    error: npt.NDArray[np.float64]
    counts: tuple[str, ...]
    unit: str
    n: tuple[int, ...]


def width_part(selection: Selection) -> Selection:
    """Return the entries of the environment with most widths, line by line; none if there are few.

    The first line is the longest, of equals the one nearest to the defaults; others differ from it
    in the form of the information matrix alone.
    """
    lines = [line for line in _lines(selection.stored) if len(line) >= LEAST_WIDTHS]
    if not lines:
        return Selection(())
    first = max(lines, key=_rank)
    others = [line for line in lines if line is not first and _differ_in_form(line[0], first[0])]
    entries = tuple(entry for line in (first, *others) for entry in line)
    return Selection(entries, notes=tuple(_unfinished(entries)))


def _lines(entries: Iterable[Entry]) -> list[Line]:
    """Group entries of the reference policy that have a done trial and differ in width alone."""
    groups: dict[str, list[Entry]] = {}
    for entry in entries:
        if entry.config.policy == REFERENCE and entry.config.width and entry.final_losses():
            rest = {k: v for k, v in flatten(entry.config.config).items() if k != "model.width"}
            groups.setdefault(json.dumps(rest, sort_keys=True), []).append(entry)
    return [tuple(sorted(group, key=lambda e: e.config.width or 0)) for group in groups.values()]


def _rank(line: Line) -> tuple[int, ...]:
    trials = sum(len(entry.finished) for entry in line)
    return len(line), *max(nearness(entry.config) for entry in line), trials


def _differ_in_form(one: Entry, other: Entry) -> bool:
    a, b = flatten(one.config.config), flatten(other.config.config)
    paths = {path for path in a.keys() | b.keys() if a.get(path) != b.get(path)}
    return paths <= {"policy.form", "model.width"}


def _unfinished(entries: Iterable[Entry]) -> Iterable[str]:
    for entry in entries:
        missing = len(entry.trials) - len(entry.finished)
        if missing:
            config = entry.config
            yield f"{config.env}, width {config.width}: {missing} trials are not finished"


def form_of(entry: Entry) -> str:
    """Return how the information matrix of an entry is held; M⁻¹ itself where nothing is said."""
    policy: Mapping[str, object] = entry.config.config["policy"]
    return str(policy.get("form", "primal"))


def form_rank(form: str) -> tuple[int, str]:
    """Return the sorting key of a form."""
    return (FORMS.index(form) if form in FORMS else len(FORMS), form)


def measure_costs(reader: Reader, selection: Selection) -> WidthCosts:
    """Return all parts of the first line, and planning of the others."""
    config = selection.entries[0].config
    lines = _by_form(selection)
    costs = []
    for index, line in enumerate(lines):
        costs += [_cost(reader, line, part) for part in (PARTS if index == 0 else PARTS[:1])]
    return WidthCosts(config.env, config.policy, tuple(costs), 1e6 * config.dt)


def _by_form(selection: Selection) -> list[Line]:
    first, *others = dict.fromkeys(form_of(entry) for entry in selection.entries)
    forms = [first, *sorted(others, key=form_rank)]
    return [tuple(e for e in selection.entries if form_of(e) == form) for form in forms]


def _cost(reader: Reader, line: Line, part: str) -> Cost:
    samples = [
        read_sample(reader, entry, f"{part}_us", DivergenceRule.EXCLUDE).values for entry in line
    ]
    low, median, high = np.array([np.quantile(values, QUANTILES) for values in samples]).T
    widths = np.array([entry.config.width for entry in line], dtype=np.int64)
    n = np.array([len(values) for values in samples], dtype=np.int64)
    return Cost(form_of(line[0]), part, widths, n, low, median, high, exponent(widths, median))


def exponent(widths: npt.ArrayLike, values: npt.ArrayLike) -> float:
    """Return p of values ∝ widths^p over the upper half of the widths, at least three of them."""
    x, y = np.log(np.asarray(widths, dtype=float)), np.log(np.asarray(values, dtype=float))
    upper = slice(-max(LEAST_WIDTHS, -(-len(x) // 2)), None)
    return float(np.polyfit(x[upper], y[upper], 1)[0])


def measure_losses(reader: Reader, selection: Selection, rule: DivergenceRule) -> WidthLosses:
    """Return the final losses of the first line."""
    line = _by_form(selection)[0]
    finals = [final_losses(reader, entry, "loss", rule) for entry in line]
    losses = [final.values for final in finals]
    return WidthLosses(
        env=line[0].config.env,
        policy=line[0].config.policy,
        widths=np.array([entry.config.width for entry in line], dtype=np.int64),
        mean=np.array([mean(values) for values in losses]),
        error=np.array([standard_error(values) for values in losses]),
        counts=tuple(final.describe() for final in finals),
        unit=loss_unit(system_of(line[0].config.config)),
        n=tuple(len(values) for values in losses),
    )


def tabulate_costs(numbers: WidthCosts) -> pd.DataFrame:
    """Return what is drawn, one row for each form, part and width."""
    rows = []
    for cost in numbers.costs:
        columns = dataclasses.asdict(cost)
        table = pd.DataFrame({"env": numbers.env, "policy": numbers.policy, **columns})
        rows.append(table.rename(columns={"widths": "width", "median": "median_us"}))
    return pd.concat(rows, ignore_index=True).rename(columns={"low": "low_us", "high": "high_us"})


def tabulate_losses(numbers: WidthLosses) -> pd.DataFrame:
    """Return what is drawn, one row for each width."""
    return pd.DataFrame(
        {
            "env": numbers.env,
            "policy": numbers.policy,
            "width": numbers.widths,
            "mean": numbers.mean,
            "two_standard_errors": 2 * numbers.error,
            "n": numbers.n,
        }
    )
