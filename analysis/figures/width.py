"""Figure 4: cost of a step against the width of the network, and its final loss.

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
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.data.matching import REFERENCE, differing_paths, nearness
from analysis.data.samples import DivergenceRule, read_sample
from analysis.data.selection import Entry, Selection, unfinished
from analysis.figures.loss_curves import loss_label
from analysis.figures.panels import (
    COLUMN_WIDTH,
    GUIDE,
    Plot,
    legend_below,
    log_scale,
    sheet,
    value_ticks,
)
from analysis.stats.curves import log_limits
from analysis.stats.intervals import mean, standard_error
from analysis.stats.scores import final_losses
from analysis.style import (
    BLUE,
    GREEN,
    GREY,
    VERMILLION,
    count_text,
    environment_title,
    loss_unit,
    policy_style,
)
from dopt.spec.label import flatten
from dopt.spec.trial import system_of
from orchestrate.store import Reader

PARTS = ("plan", "learn", "evaluate")
FORMS = ("primal", "dual", "sketch")
LEAST_WIDTHS = 3
QUANTILES = (0.1, 0.5, 0.9)
Line = tuple[Entry, ...]
HEIGHT = 3.2
LOSS_HEIGHT = 2.6
COLOURS = {"plan": VERMILLION, "learn": BLUE, "evaluate": GREEN}
MARKERS = {"plan": "o", "learn": "s", "evaluate": "^"}
FORM_WORDS = {"auto": "the cheapest at each width"}
FORM_LINES = {"primal": (0, (5, 2)), "dual": (0, (1.5, 1.5)), "sketch": (0, (5, 1.5, 1, 1.5))}


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
    notes = unfinished(entries, lambda config: f"{config.env}, width {config.width}")
    return Selection(entries, notes=tuple(notes))


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
    paths = differing_paths([flatten(entry.config.config) for entry in (one, other)])
    return paths <= {"policy.form", "model.width"}


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


def draw_costs(numbers: WidthCosts) -> Figure:
    """Draw every part of a step on logarithmic axes, with the time that a step may take."""
    figure, axes = _axes(HEIGHT, numbers.costs[0].widths)
    axes.axhline(numbers.limit_us, **GUIDE)
    limit = f"real time: dt = {numbers.limit_us / 1e3:g} ms"
    axes.annotate(
        limit, (0, numbers.limit_us), xycoords=("axes fraction", "data"), xytext=(3, -3),
        textcoords="offset points", ha="left", va="top", fontsize=6.5,
    )  # fmt: skip
    for cost in numbers.costs:
        _line(axes, cost, other=cost.form != numbers.costs[0].form)
    drawn = np.concatenate([np.r_[cost.low, cost.high] for cost in numbers.costs])
    log_scale(axes, *log_limits(np.r_[drawn, numbers.limit_us], margin=1.5))
    axes.set_ylabel("time per step [µs]")
    axes.set_title(f"{policy_style(numbers.policy).label}, {environment_title(numbers.env)}")
    legend_below(figure, 2)
    return figure


def _axes(height: float, widths: np.ndarray[tuple[int], np.dtype[np.int64]]) -> tuple[Figure, Axes]:
    """Return a figure of one panel whose horizontal ticks are the widths."""
    figure, [[axes]] = sheet(1, 1, height, width=COLUMN_WIDTH)
    axes.set_xscale("log")
    axes.set_xlabel("width w [units in each hidden layer]")
    value_ticks(axes.xaxis, widths.tolist())
    return figure, axes


def _line(axes: Axes, cost: Cost, *, other: bool) -> None:
    colour = GREY if other else COLOURS[cost.part]
    style = FORM_LINES.get(cost.form, "-") if other else "-"
    name = f"{cost.part}, {cost.form} form" if other else cost.part
    if not other:
        axes.fill_between(cost.widths, cost.low, cost.high, color=colour, alpha=0.15, lw=0)
    label = f"{name}: $\\propto w^{{{cost.exponent:.1f}}}$"
    marker = MARKERS[cost.part]
    axes.plot(cost.widths, cost.median, color=colour, ls=style, marker=marker, ms=3, label=label)


def caption_costs(numbers: WidthCosts) -> str:
    """Return the caption, with what the parts are and how the slopes are fitted."""
    first = numbers.costs[0]
    counts = {str(w): str(n) for w, n in zip(first.widths, first.n, strict=True)}
    others = [cost.form for cost in numbers.costs[1:] if cost.form != first.form]
    beside = f" In grey: planning with the {' and the '.join(others)} form." if others else ""
    return (
        f"Time per step against the width of both hidden layers, "
        f"{policy_style(numbers.policy).label} in the {environment_title(numbers.env)}, one "
        f"trial on a core: planning with the update of the information matrix (form: "
        f"{FORM_WORDS.get(first.form, first.form)}), one step of learning, one evaluation of the "
        f"loss. Points: median over steps and trials; bands: 10 % to 90 % quantiles. Exponents: "
        f"least squares on logarithms over the upper half of the widths. Dashed: the time between "
        f"two steps.{beside} "
        f"Trials by width: {count_text(counts)}."
    )


def draw_losses(numbers: WidthLosses) -> Figure:
    """Draw the mean final loss with two standard errors, and n in the title."""
    figure, axes = _axes(LOSS_HEIGHT, numbers.widths)
    style, half = policy_style(numbers.policy), 2 * numbers.error
    axes.errorbar(
        numbers.widths, numbers.mean, np.nan_to_num(half), color=style.colour, marker="o", ms=3,
        capsize=2,
    )  # fmt: skip
    edges = np.r_[numbers.mean - half, numbers.mean + half, numbers.mean]
    log_scale(axes, *log_limits(edges, margin=1.35))
    axes.set_ylabel(f"final {loss_label('loss', numbers.unit)}")
    axes.set_title(f"{style.label}, {environment_title(numbers.env)} ({_counts(numbers)})")
    return figure


def _counts(numbers: WidthLosses) -> str:
    return count_text(dict(zip(map(str, numbers.widths), numbers.counts, strict=True)))


def caption_losses(numbers: WidthLosses) -> str:
    """Return the caption, with the statistic and n by width."""
    return (
        f"Root mean square error of the model over the evaluation grid after the last step, "
        f"against the width of both hidden layers, {policy_style(numbers.policy).label} in the "
        f"{environment_title(numbers.env)}: mean over trials ± 2 standard errors. "
        f"Trials by width: {_counts(numbers)}."
    )


COST: Plot[WidthCosts] = Plot(
    title="Planning cost against width",
    statistic="median over steps and trials of the microseconds of each part of a step",
    band="10 % to 90 % quantiles over steps and trials",
    part=lambda selection, _: width_part(selection),
    measure=lambda reader, selection, _: measure_costs(reader, selection),
    tabulate=tabulate_costs,
    draw=draw_costs,
    caption=caption_costs,
)
"""Cost of a step against width."""


LOSS_AGAINST_WIDTH: Plot[WidthLosses] = Plot(
    title="Final loss against width",
    statistic="mean over trials of the loss after the last step",
    band="± 2 standard errors of the mean",
    part=lambda selection, _: width_part(selection),
    measure=lambda reader, selection, options: measure_losses(reader, selection, options.rule),
    tabulate=tabulate_losses,
    draw=draw_losses,
    caption=caption_losses,
)
"""Final loss against width."""
