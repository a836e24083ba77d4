"""Figure 2, right: spectral density of D-optimal inputs with the eigenfrequency."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.data.config_matching import REFERENCE
from analysis.figures.axes import log_scale, log_ticks
from analysis.figures.input_spectrum.data import (
    InputSpectra,
    PolicySpectrum,
    measure_spectra,
    tabulate_spectra,
)
from analysis.figures.legend import legend_below
from analysis.figures.plot import Plot
from analysis.figures.style import COLUMN_WIDTH, GUIDE
from analysis.formatting import count_text
from analysis.line_styles import environment_title, policy_style

HEIGHT = 3.0
SHOWN = (REFERENCE, "random", "periodic")
GREYS = {"random": "#8a8a8a", "periodic": "#555555"}
DECADES = 4
INNER = slice(1, -1)
"""Neither the zero frequency nor the Nyquist frequency, whose one-sided density counts once."""


def spectrum_plot(env: str, name: str) -> Plot[InputSpectra]:
    """Return the spectra of one environment's inputs."""
    return Plot(
        name=name,
        title=f"Spectral density of the inputs, {environment_title(env)}",
        statistic="mean over trials of the one-sided periodogram (boxcar, no detrending)",
        band="10 % to 90 % quantiles over trials of the D-optimal density",
        part=lambda selection: selection.only([env], SHOWN).compared(),
        measure=lambda reader, selection, _: measure_spectra(reader, selection, env),
        tabulate=tabulate_spectra,
        draw=draw,
        caption=caption,
    )


def draw(spectra: InputSpectra) -> Figure:
    """Draw all spectra on logarithmic axes, between the zero and the Nyquist frequency."""
    figure = Figure(figsize=(COLUMN_WIDTH, HEIGHT), layout="constrained")
    axes = figure.subplots()
    axes.set_xscale("log")
    for one in reversed(spectra.policies):
        _line(axes, one)
    log_scale(axes, *_limits(spectra))
    frequency = spectra.policies[0].spectrum.frequency
    axes.set_xlim(frequency[1], frequency[-2])
    log_ticks(axes.xaxis, frequency[1], frequency[-2])
    axes.set_xlabel("frequency [Hz]")
    unit = f"({spectra.unit})" if " " in spectra.unit else spectra.unit
    axes.set_ylabel(f"power spectral density of u [{unit}²/Hz]")
    _mark(axes, spectra.eigenfrequency)
    handles, labels = axes.get_legend_handles_labels()
    legend_below(figure, 2, handles=handles[::-1], labels=labels[::-1], fontsize=6.5)
    return figure


def _line(axes: Axes, one: PolicySpectrum) -> None:
    style, spectrum = policy_style(one.policy), one.spectrum
    colour = GREYS.get(one.policy, style.colour)
    left_out = f", {one.n_diverged} diverged" if one.n_diverged else ""
    label = f"{style.label}, mean (n = {spectrum.n}{left_out})"
    f = spectrum.frequency[INNER]
    if one.policy == REFERENCE:
        axes.fill_between(
            f,
            spectrum.low[INNER],
            spectrum.high[INNER],
            color=colour,
            alpha=0.2,
            lw=0,
            label=f"{style.label}, 10–90 % of trials",
        )
    axes.plot(f, spectrum.mean[INNER], color=colour, ls=style.line, lw=style.width, label=label)


def _limits(spectra: InputSpectra) -> tuple[float, float]:
    """Return limits over everything but leakage more than DECADES below the peak."""
    values = np.concatenate(
        [np.r_[one.spectrum.mean[INNER], one.spectrum.high[INNER]] for one in spectra.policies]
    )
    top = float(values.max()) or 1.0
    usable = values[values > top * 10.0**-DECADES]
    return float(usable.min() if len(usable) else top / 10) / 2, top * 3


def _mark(axes: Axes, frequency: float | None) -> None:
    if frequency is None:
        return
    for factor, text in ((1, f"f₀ = {frequency:.3g} Hz"), (3, "3f₀")):
        axes.axvline(factor * frequency, **GUIDE, zorder=1.5)
        axes.annotate(
            text,
            (factor * frequency, 0.03),
            xycoords=("data", "axes fraction"),
            xytext=(2, 0),
            textcoords="offset points",
            rotation=90,
            fontsize=6.5,
            va="bottom",
            ha="left",
        )


def caption(spectra: InputSpectra) -> str:
    """Return the caption, with the definition of density and lines."""
    lines = ""
    if spectra.eigenfrequency is not None:
        lines = (
            f" Dashed lines: eigenfrequency f₀ = {spectra.eigenfrequency:.4g} Hz of the linearised "
            f"system at its stable equilibrium, damping included, and its third harmonic."
        )
    if spectra.diverged:
        lines += f" Not drawn, because every trial diverged: {', '.join(spectra.diverged)}."
    counts = count_text({one.policy: str(one.spectrum.n) for one in spectra.policies})
    return (
        f"Power spectral density of the inputs in the {environment_title(spectra.env)}: one-sided "
        f"periodogram of every trial (boxcar window, no detrending; its integral is the mean "
        f"square of the input; γ² = {spectra.gamma**2:g}), mean over trials; band: 10 % to "
        f"90 % quantiles over D-optimal trials; {_in_grey(spectra)}zero and Nyquist frequency not "
        f"drawn.{lines} Trials: {counts}."
    )


def _in_grey(spectra: InputSpectra) -> str:
    names = [one.policy for one in spectra.policies if one.policy in GREYS]
    return f"{' and '.join(names)} in grey; " if names else ""
