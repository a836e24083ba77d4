from __future__ import annotations

import math

import numpy as np
import pytest

from analysis.choice import Filter
from analysis.input_spectra import measure_spectra, tabulate_spectra, unit_of
from analysis.selection import select
from orchestrate.store import Reader


def test_frequencies_inputs_and_counts(reader: Reader) -> None:
    spectra = measure_spectra(reader, select(reader, Filter()), "cartpole")
    by_name = {one.policy: one for one in spectra.policies}
    assert (by_name["random"].spectrum.n, by_name["random"].n_diverged) == (4, 1)
    assert spectra.unit == "N"
    # cart and pole about hanging: below this, the pole alone on a fixed cart swings slower
    assert spectra.eigenfrequency is not None
    assert spectra.eigenfrequency > math.sqrt(10) / (2 * math.pi)


def test_the_power_of_a_bang_bang_input_is_its_bound_squared(reader: Reader) -> None:
    spectra = measure_spectra(reader, select(reader, Filter()), "cartpole")
    table = tabulate_spectra(spectra)
    rows = table[table.policy == "d_optimal"]
    spacing = rows.frequency_hz.iloc[1]
    assert rows["mean"].sum() * spacing == pytest.approx(spectra.gamma**2)
    assert np.all(rows["quantile_10"] <= rows["quantile_90"])


def test_unit_of() -> None:
    assert unit_of("u [N m]") == "N m"
    assert unit_of("u") == ""
