"""Figure 6: final loss against the time of a step, one panel per environment."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from analysis.data.divergence import DivergenceRule
from analysis.figures.axes import log_limits, log_scale, log_ticks, rows_and_columns
from analysis.figures.control.plot import MARKERS
from analysis.figures.legend import legend_below
from analysis.figures.loss_curves.plot import loss_label
from analysis.figures.pareto.data import (
    Point,
    Points,
    learners_of,
    measure_points,
    pareto_part,
    policies_of,
    tabulate_points,
)
from analysis.figures.plot import Plot
from analysis.figures.style import GUIDE, TEXT_WIDTH
from analysis.formatting import count_text
from analysis.line_styles import (
    BLACK,
    GREY,
    SEQUENCE,
    environment_title,
    policy_style,
    text_by_environment,
)
from analysis.stats.intervals import STUDENT_RANGE

PANEL_HEIGHT = 3.2
INNER = (TEXT_WIDTH / 2 - 0.6, PANEL_HEIGHT - 0.6)
"""Least width and height between the axes of a panel, without titles and labels [inches]."""

LEGEND_ROW = 0.16
LEGEND_COLUMNS = 3

LIST_SIZE = 5.2
"""Size of the letters in the list of the front [points]."""

LIST_LINE = 1.35 * LIST_SIZE / 72
"""Height of one of its lines [inches]."""

_HALO = [withStroke(linewidth=1.2, foreground="white")]

LETTER = 0.53 * LIST_SIZE / 72
"""Usual width of one of its letters [inches]."""

Numbers = tuple[DivergenceRule, Points]


def pareto_plot(name: str) -> Plot[Numbers]:
    """Return final loss against the time of a step, with the Pareto front."""
    return Plot(
        name=name,
        title="Final loss against the time of a step",
        statistic="geometric mean over trials of the final loss; median over trials of the mean "
        "microseconds of planning and learning in a step",
        band=f"95 % interval of the mean logarithm (BCa bootstrap, {STUDENT_RANGE} trials)",
        part=pareto_part,
        measure=lambda reader, selection, options: (
            options.rule,
            measure_points(reader, selection, options.rule),
        ),
        tabulate=lambda numbers: tabulate_points(numbers[1]),
        draw=lambda numbers: draw(numbers[1]),
        caption=caption,
    )


def draw(points: Points) -> Figure:
    """Draw a panel for each environment, with a legend of policies and learners below all."""
    environments = list(dict.fromkeys(point.env for point in points))
    colours = policy_colours(policies_of(points))
    markers = dict(zip(learners_of(points), itertools.cycle(MARKERS), strict=False))
    handles = _handles(points, colours, markers)
    rows, columns = rows_and_columns(len(environments), 2)
    legend = LEGEND_ROW * math.ceil(len(handles) / LEGEND_COLUMNS)
    size = (TEXT_WIDTH if columns > 1 else TEXT_WIDTH * 0.62, PANEL_HEIGHT * rows + legend)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, env in zip(panels, environments, strict=False):
        _panel(axes, [point for point in points if point.env == env], colours, markers)
    for axes in panels[len(environments) :]:
        axes.remove()
    legend_below(figure, LEGEND_COLUMNS, handles=handles, fontsize=6.5, handlelength=1.2)
    return figure


def policy_colours(policies: Mapping[str, str]) -> dict[str, str]:
    """Return a colour for the words of each policy: its own, or a free one where that is taken.

    Colours of lines repeat, since dashes tell lines apart; those of points must not. Grey is left
    where there are more policies than colours.
    """
    found: dict[str, str] = {}
    for words, policy in policies.items():
        own = policy_style(policy).colour
        if own not in found.values():
            found[words] = own
    free = (colour for colour in SEQUENCE if colour not in found.values())
    return {words: found.get(words) or next(free, GREY) for words in policies}


def _panel(
    axes: Axes, points: Sequence[Point], colours: Mapping[str, str], markers: Mapping[str, str]
) -> None:
    known = [point for point in points if point.known]
    front = [point for point in known if point.on_front]
    for point in known:
        _dot(axes, point, colours[point.policy_words], markers[point.learner_words])
    _limits(axes, known, front)
    _front(axes, front)
    usual = _counts(points).partition(";")[0]
    axes.set_title(f"{environment_title(points[0].env)} ({usual}, {len(points)} configurations)")
    axes.set_xlabel("planning and learning in a step [µs]")
    axes.set_ylabel(f"final {loss_label('loss', points[0].unit)}")


def _dot(axes: Axes, point: Point, colour: str, marker: str) -> None:
    loss = point.loss
    ends = np.nan_to_num([[loss.value - loss.low], [loss.high - loss.value]])
    face = "white" if point.n_diverged else colour
    axes.errorbar(
        point.us, loss.value, yerr=ends, fmt=marker, ms=4.2 if point.on_front else 3.4,
        color=colour, mfc=face, mec=BLACK if point.on_front else colour, mew=0.6, elinewidth=0.6,
        alpha=1.0 if point.on_front else 0.6, zorder=4 if point.on_front else 3,
    )  # fmt: skip


def _limits(axes: Axes, known: Sequence[Point], front: Sequence[Point]) -> None:
    """Set logarithmic axes around all points, with room for the list of the front below it."""
    times = np.array([point.us for point in known])
    ends = [(one.loss.value, one.loss.low, one.loss.high) for one in known]
    left, right = log_limits(times, margin=1.6)
    low, high = log_limits(np.array(ends).ravel(), margin=1.3)
    low /= 1.2  # for the number of the lowest point
    axes.set_xscale("log")
    axes.set_xlim(left, right)
    log_ticks(axes.xaxis, left, right)
    width, height = _list_share(front)
    above = [
        math.log(min(one.loss.value, one.loss.low))
        for one in known
        if math.log(one.us / left) < width * math.log(right / left)
    ]  # fmt: skip
    room = [(y - height * math.log(high)) / (1 - height) for y in above]
    log_scale(axes, math.exp(min([math.log(low), *room])), high)
    limit = known[0].limit_us if known else math.nan
    if left < limit < right:
        axes.axvline(limit, **GUIDE)
        axes.annotate(
            f"dt = {limit / 1e3:g} ms", (limit, 1), xycoords=("data", "axes fraction"),
            xytext=(-2, -2), textcoords="offset points", rotation=90, ha="right", va="top",
            fontsize=6,
        )  # fmt: skip


def _list_share(front: Sequence[Point]) -> tuple[float, float]:
    """Return the parts of the panel's width and height that the list of the front takes."""
    longest = max((len(_line(place, one)) for place, one in enumerate(front, 1)), default=0)
    return min(1.0, LETTER * longest / INNER[0]), LIST_LINE * (len(front) + 1) / INNER[1]


def _line(place: int, point: Point) -> str:
    return f"{place}  {point.label}"


def _front(axes: Axes, front: Sequence[Point]) -> None:
    """Draw the front as steps, number its members and list them in the corner below it."""
    if not front:
        return
    times = [point.us for point in front]
    losses = [point.loss.value for point in front]
    steps = ([times[0], *times, axes.get_xlim()[1]], [axes.get_ylim()[1], *losses, losses[-1]])
    axes.plot(*steps, drawstyle="steps-post", color=BLACK, lw=0.7, zorder=2)
    for group in _close(axes, front):
        last = front[group[-1] - 1]
        axes.annotate(
            ", ".join(map(str, group)), (last.us, last.loss.value), xytext=(-3, -3),
            textcoords="offset points", ha="right", va="top", fontsize=LIST_SIZE, weight="bold",
            zorder=5, path_effects=_HALO,
        )  # fmt: skip
    axes.annotate(
        "\n".join(_line(place, point) for place, point in enumerate(front, 1)), (0, 0),
        xycoords="axes fraction", xytext=(3, 3), textcoords="offset points", va="bottom",
        fontsize=LIST_SIZE, linespacing=1.25,
    )  # fmt: skip


def _close(axes: Axes, front: Sequence[Point]) -> list[list[int]]:
    """Return the numbers of the front, those in one list that would cover each other."""
    limits = np.log([axes.get_xlim(), axes.get_ylim()])
    places = np.log([(point.us, point.loss.value) for point in front])
    inches = (places - limits[:, 0]) / np.diff(limits)[:, 0] * INNER
    groups: list[list[int]] = []
    for number in range(1, len(front) + 1):
        if groups and np.all(np.abs(inches[number - 1] - inches[groups[-1][0] - 1]) < LIST_LINE):
            groups[-1].append(number)
        else:
            groups.append([number])
    return groups


def _handles(
    points: Points, colours: Mapping[str, str], markers: Mapping[str, str]
) -> list[Line2D]:
    handles = [
        Line2D([], [], ls="", marker="o", ms=4, color=colour, label=words)
        for words, colour in colours.items()
    ]
    handles += [
        Line2D([], [], ls="", marker=marker, ms=4, color=GREY, label=words)
        for words, marker in markers.items()
    ]
    if any(point.known and point.n_diverged for point in points):
        handles.append(Line2D([], [], ls="", marker="o", ms=4, color=GREY, mfc="white",
                              label="some trials diverged"))  # fmt: skip
    handles.append(Line2D([], [], color=BLACK, lw=0.7, label="Pareto front"))
    return handles


_RULES = {
    DivergenceRule.EXCLUDE: "in none of its numbers",
    DivergenceRule.WORST: "with the worst final loss of the others",
    DivergenceRule.MEDIAN: "with the median final loss of the others",
}


def caption(numbers: Numbers) -> str:
    """Return the caption, with what a point is, n and the configurations without a point."""
    rule, points = numbers
    counts = text_by_environment(points, _counts)
    return (
        "Root mean square error of the model over the evaluation grid after the last step, against "
        "the time that planning and learning take in a step, both on logarithmic axes. A point is "
        "a configuration; colours are policies, markers learners; the oracle is left out. Loss: "
        f"geometric mean over trials with its 95 % interval (BCa bootstrap, {STUDENT_RANGE} "
        "trials). Time: mean over the steps of a trial, median over trials. Line: Pareto front; "
        "no configuration is both as good and as fast as one on it, and better in one of the two. "
        "Its members are numbered by their time; a label leaves out what is usual, such as the "
        "learner adam_window with a network. Dashed, where it is in range: the time between two "
        "steps, dt. Open markers: some "
        f"trials diverged; a diverged trial counts {_RULES[rule]}. {_missing(points)}"
        f"Trials: {counts}."
    )


def _counts(points: Sequence[Point]) -> str:
    return count_text({one.label: one.counts for one in points if one.known})


def _missing(points: Points) -> str:
    """Return which configurations have no point, or nothing."""
    lost = [f"{environment_title(one.env)}, {one.label} ({one.counts})"
            for one in points if not one.known]  # fmt: skip
    return f"No point, as no trial has a positive final loss: {'; '.join(lost)}. " if lost else ""
