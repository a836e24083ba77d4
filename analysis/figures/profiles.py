"""Figure 7: performance profiles, one line for each variant over all environments.

The factor is by the geometric mean of the final losses of the reference in the same environment.
Its share of runs, as a function of the factor, is the performance profile (run-score distribution:
Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", 2021).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.data.matching import APART
from analysis.data.selection import Selection
from analysis.figures.panels import (
    GUIDE,
    TEXT_WIDTH,
    Plot,
    legend_below,
    log_scale,
    look,
    shade,
    sheet,
)
from analysis.stats.curves import line_styles
from analysis.stats.intervals import Band, geometric_mean, stratified_mean
from analysis.style import LineStyle, but_diverged, count_text, environment_title

Array = npt.NDArray[np.float64]

FACTORS = 301
"""Points of a profile."""

HEIGHT = 3.4


@dataclass(frozen=True)
class Profile:
    """One variant over its environments.

    Attributes
    ----------
    factors : (T,)
        Factors τ, ascending.
    share : Band
        Of the runs with a loss of at most τ times the reference's: mean over environments.
    environments : tuple of str
        Those in which both it and the reference have a final loss.
    n, n_diverged : int
        Trials that ended in all of them; a diverged one is within no factor.
    """

    label: str
    style: LineStyle
    reference: str
    factors: Array
    share: Band
    environments: tuple[str, ...]
    n: int
    n_diverged: int


def profiles_part(selection: Selection) -> Selection:
    """Return the environments in which the reference has a final loss, if there are others too.

    The oracle is left out: the loss of the others is thousands of times its own.
    """
    policies = set(selection.policies) - ({APART} - {selection.reference})
    simulated = selection.simulated()
    compared = simulated.only(simulated.environments, policies).compared()
    return compared if len(compared.labels) > 1 else Selection(())


def measure_profiles(selection: Selection) -> tuple[Profile, ...]:
    """Return the profile of every variant of the selection, in its order."""
    ratios = {label: _ratios(selection, label) for label in selection.labels}
    every = np.concatenate([part for own in ratios.values() for part in own.values()])
    known = every[np.isfinite(every) & (every > 0)]
    factors = np.geomspace(known.min() / 1.05, known.max() * 1.05, FACTORS)
    styles = line_styles(selection)
    first = selection.reference_of(selection.environments[0])
    reference = first.label if first else selection.reference
    return tuple(
        Profile(
            label=label,
            style=styles[label],
            reference=reference,
            factors=factors,
            share=stratified_mean([(p[:, None] <= factors).astype(float) for p in own.values()]),
            environments=tuple(own),
            n=sum(map(len, own.values())),
            n_diverged=sum(int(np.isinf(part).sum()) for part in own.values()),
        )
        for label, own in ratios.items()
        if own
    )


def _ratios(selection: Selection, label: str) -> dict[str, Array]:
    """Return final loss / the reference's by environment, inf for a trial that diverged."""
    found = {}
    for entry in selection.entries:
        reference = selection.reference_of(entry.config.env)
        if entry.label == label and reference is not None and entry.finished:
            scale = geometric_mean(np.array(list(reference.final_losses().values()))).value
            finals = entry.final_losses()
            own = [finals.get(trial.seed, np.inf) for trial in entry.finished]
            found[entry.config.env] = np.array(own) / scale
    return found


def tabulate_profiles(profiles: tuple[Profile, ...]) -> pd.DataFrame:
    """Return what is drawn, one row for each variant and factor."""
    return pd.concat([_rows(profile) for profile in profiles], ignore_index=True)


def _rows(profile: Profile) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "label": profile.label,
            "reference": profile.reference,
            "factor": profile.factors,
            "share": profile.share.centre,
            "low": profile.share.low,
            "high": profile.share.high,
            "n_environments": len(profile.environments),
            "n": profile.n,
            "n_diverged": profile.n_diverged,
        }
    )


Profiles = tuple[Profile, ...]


def draw(profiles: Profiles) -> Figure:
    """Draw one panel; the higher a line, the more runs are as good."""
    figure, [[axes]] = sheet(1, 1, HEIGHT, width=TEXT_WIDTH * 0.75)
    for one in reversed(profiles):
        axes.plot(one.factors, one.share.centre, **look(one.style))
        shade(axes, one.factors, one.share, one.style.colour)
    axes.axvline(1.0, **GUIDE)
    log_scale(axes, float(profiles[0].factors[0]), float(profiles[0].factors[-1]), "x")
    axes.set_ylim(0, 1.01)
    axes.set_xlabel(f"final loss / geometric mean of {profiles[0].reference}: factor τ")
    axes.set_ylabel("share of runs within the factor")
    every = max(len(one.environments) for one in profiles)
    handles = [Line2D([], [], label=_name(one, every), **look(one.style)) for one in profiles]
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


PROFILES: Plot[Profiles] = Plot(
    title="Performance profiles",
    statistic="mean over environments of the share of trials whose final loss is within a "
    "factor of the reference's geometric mean",
    band="95 % percentile bootstrap, stratified by environment, pointwise",
    part=lambda selection, _: profiles_part(selection),
    measure=lambda _, selection, __: measure_profiles(selection),
    tabulate=tabulate_profiles,
    draw=draw,
    caption=caption,
)
"""Share of runs within a factor of the reference, against that factor."""
