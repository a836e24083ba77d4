"""Figure 2, right: spectral density of D-optimal inputs with the eigenfrequency."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.data.matching import REFERENCE
from analysis.data.selection import Entry, Selection
from analysis.errors import AnalysisError
from analysis.figures.panels import (
    COLUMN_WIDTH,
    GUIDE,
    Plot,
    legend_below,
    log_scale,
    sheet,
)
from analysis.stats.curves import Spectrum, average_spectrum
from analysis.style import but_diverged, count_text, environment_title, policy_style, unit_of
from dopt.spec.trial import system_of
from dopt.systems.properties import eigenmode
from orchestrate.store import Reader

HEIGHT = 3.0
SHOWN = (REFERENCE, "random", "periodic")
GREYS = {"random": "#8a8a8a", "periodic": "#555555"}
DECADES = 4

INNER = slice(1, -1)
"""Neither the zero frequency nor the Nyquist frequency, whose one-sided density counts once."""


@dataclass(frozen=True)
class PolicySpectrum:
    """Spectrum over the trials of a policy that did not diverge."""

    policy: str
    spectrum: Spectrum
    n_diverged: int


@dataclass(frozen=True)
class InputSpectra:
    """Spectra of one environment.

    Attributes
    ----------
    eigenfrequency : float or None
        Of the linearised system at the stable equilibrium, damping included [Hz].
    gamma : float
        Bound of the inputs, in ``unit``.
    diverged : tuple of str
        Policies of which every trial diverged, and which have no spectrum.
    unit : str
        Unit of the inputs, such as "N".
    """

    env: str
    policies: tuple[PolicySpectrum, ...]
    eigenfrequency: float | None
    gamma: float
    unit: str
    diverged: tuple[str, ...] = ()


def measure_spectra(reader: Reader, selection: Selection, env: str) -> InputSpectra:
    """Return the spectra of every selected policy of an environment with a finished trial."""
    entries = selection.of(env)
    system = system_of(entries[0].config.config)
    mode = eigenmode(system)
    spectra = (_spectrum(reader, entry, system.dt) for entry in entries)
    found = tuple(spectrum for spectrum in spectra if spectrum is not None)
    if not found:
        raise AnalysisError(
            f"A spectrum of the inputs needs a finished trial, but {env} has none: run the grid."
        )
    drawn = {spectrum.policy for spectrum in found}
    return InputSpectra(
        env=env,
        policies=found,
        eigenfrequency=mode.frequency / (2 * math.pi) if mode else None,
        gamma=system.gamma,
        unit=unit_of(system.input_labels[0], ""),
        diverged=tuple(
            one.config.policy for one in entries if one.finished and one.config.policy not in drawn
        ),
    )


def _spectrum(reader: Reader, entry: Entry, dt: float) -> PolicySpectrum | None:
    done = [trial.seed for trial in entry.trials if trial.status == "done"]
    if not done:
        return None
    inputs = np.stack([reader.trajectory(entry.config.config_key, seed).inputs for seed in done])
    diverged = len(entry.finished) - len(done)
    return PolicySpectrum(entry.config.policy, average_spectrum(inputs, dt), diverged)


def tabulate_spectra(spectra: InputSpectra) -> pd.DataFrame:
    """Return what is drawn, one row for each policy and frequency."""
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "env": spectra.env,
                    "policy": one.policy,
                    "frequency_hz": one.spectrum.frequency,
                    "mean": one.spectrum.mean,
                    "quantile_10": one.spectrum.low,
                    "quantile_90": one.spectrum.high,
                    "n": one.spectrum.n,
                    "n_diverged": one.n_diverged,
                }
            )
            for one in spectra.policies
        ],
        ignore_index=True,
    )


def spectrum_plot(env: str) -> Plot[InputSpectra]:
    """Return the spectra of one environment's inputs."""
    return Plot(
        title=f"Spectral density of the inputs, {environment_title(env)}",
        statistic="mean over trials of the one-sided periodogram (boxcar, no detrending)",
        band="10 % to 90 % quantiles over trials of the D-optimal density",
        part=lambda selection, _: selection.only([env], SHOWN).compared(),
        measure=lambda reader, selection, _: measure_spectra(reader, selection, env),
        tabulate=tabulate_spectra,
        draw=draw,
        caption=caption,
    )


def draw(spectra: InputSpectra) -> Figure:
    """Draw all spectra on logarithmic axes, between the zero and the Nyquist frequency."""
    figure, [[axes]] = sheet(1, 1, HEIGHT, width=COLUMN_WIDTH)
    for one in reversed(spectra.policies):
        _line(axes, one)
    log_scale(axes, *_limits(spectra))
    frequency = spectra.policies[0].spectrum.frequency
    log_scale(axes, frequency[1], frequency[-2], "x")
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
    label = f"{style.label}, mean (n = {but_diverged(spectrum.n, one.n_diverged)})"
    f = spectrum.frequency[INNER]
    if one.policy == REFERENCE:
        ends = f, spectrum.low[INNER], spectrum.high[INNER]
        label_of_band = f"{style.label}, 10–90 % of trials"
        axes.fill_between(*ends, color=colour, alpha=0.2, lw=0, label=label_of_band)
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
            text, (factor * frequency, 0.03), xycoords=("data", "axes fraction"), xytext=(2, 0),
            textcoords="offset points", rotation=90, fontsize=6.5, va="bottom", ha="left",
        )  # fmt: skip


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
