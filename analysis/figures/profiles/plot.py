"""Figure 7: performance profiles, one line for each variant over all environments."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.figures.axes import log_ticks
from analysis.figures.legend import legend_below
from analysis.figures.plot import Plot
from analysis.figures.profiles.data import (
    Profile,
    measure_profiles,
    profiles_part,
    tabulate_profiles,
)
from analysis.figures.style import GUIDE, TEXT_WIDTH
from analysis.formatting import but_diverged, count_text
from analysis.line_styles import environment_title

HEIGHT = 3.4
Profiles = tuple[Profile, ...]


def profiles_plot(name: str) -> Plot[Profiles]:
    """Return the share of runs within a factor of the reference, against that factor."""
    return Plot(
        name=name,
        title="Performance profiles",
        statistic="mean over environments of the share of trials whose final loss is within a "
        "factor of the reference's geometric mean",
        band="95 % percentile bootstrap, stratified by environment, pointwise",
        part=profiles_part,
        measure=lambda _, selection, __: measure_profiles(selection),
        tabulate=tabulate_profiles,
        draw=draw,
        caption=caption,
    )


def draw(profiles: Profiles) -> Figure:
    """Draw one panel; the higher a line, the more runs are as good."""
    figure = Figure(figsize=(TEXT_WIDTH * 0.75, HEIGHT), layout="constrained")
    axes = figure.subplots()
    for one in reversed(profiles):
        axes.plot(
            one.factors, one.share.centre, color=one.style.colour, ls=one.style.line,
            lw=one.style.width,
        )  # fmt: skip
        axes.fill_between(
            one.factors, one.share.low, one.share.high, color=one.style.colour, alpha=0.18, lw=0
        )
    axes.axvline(1.0, **GUIDE)
    axes.set_xscale("log")
    limits = float(profiles[0].factors[0]), float(profiles[0].factors[-1])
    axes.set_xlim(*limits)
    log_ticks(axes.xaxis, *limits)
    axes.set_ylim(0, 1.01)
    axes.set_xlabel(f"final loss / geometric mean of {profiles[0].reference}: factor τ")
    axes.set_ylabel("share of runs within the factor")
    every = max(len(one.environments) for one in profiles)
    handles = [
        Line2D([], [], color=one.style.colour, ls=one.style.line, lw=one.style.width,
               label=_name(one, every))
        for one in profiles
    ]  # fmt: skip
    legend_below(figure, 3, handles=handles)
    return figure


def _name(profile: Profile, every: int) -> str:
    own = len(profile.environments)
    return profile.label if own == every else f"{profile.label} ({own} of {every} systems)"


def caption(profiles: Profiles) -> str:
    """Return the caption, with what a profile is, its environments and n."""
    environments = dict.fromkeys(env for one in profiles for env in one.environments)
    counts = {one.label: but_diverged(one.n, one.n_diverged) for one in profiles}
    partial = "; ".join(
        f"{one.label}: {', '.join(map(environment_title, one.environments))}"
        for one in profiles
        if len(one.environments) < len(environments)
    )
    return (
        "Performance profiles: share of the runs whose final loss is at most τ times the geometric "
        f"mean of the final losses of {profiles[0].reference} in the same environment; mean over "
        f"the environments ({', '.join(map(environment_title, environments))}), higher is better. "
        "Bands: 95 % bootstrap interval at each τ, percentiles over draws of runs within each "
        "environment; the geometric mean of the reference is held fixed. A diverged trial is "
        "within no factor. The oracle, which is orders of magnitude below, is in the tables alone."
        f"{f' In fewer environments: {partial}.' if partial else ''} "
        f"Runs: {count_text(counts)}."
    )
