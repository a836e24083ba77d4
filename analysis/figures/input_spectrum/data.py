"""Figure 2, right, as numbers: spectra of the inputs of an environment's policies."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd

from analysis.data.trial_selection import Entry, Selection
from analysis.errors import AnalysisError
from analysis.stats.spectrum import Spectrum, average_spectrum
from dopt.spec.prequential import system_of
from dopt.systems.equilibrium import eigenmode
from orchestrate.store import Reader


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
    spectra = [_spectrum(reader, entry, system.dt) for entry in entries]
    found = tuple(spectrum for spectrum in spectra if spectrum is not None)
    if not found:
        raise AnalysisError(
            f"A spectrum of the inputs needs a finished trial, but {env} has none: run the grid."
        )
    return InputSpectra(
        env=env,
        policies=found,
        eigenfrequency=mode.frequency / (2 * math.pi) if mode else None,
        gamma=system.gamma,
        unit=unit_of(system.input_labels[0]),
        diverged=tuple(
            entry.config.policy
            for entry, spectrum in zip(entries, spectra, strict=True)
            if spectrum is None and entry.finished
        ),
    )


def unit_of(label: str) -> str:
    """Return the unit in a label such as ``u [N]``; empty when it has none."""
    return label[label.index("[") + 1 : label.index("]")] if "[" in label else ""


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
