from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from analysis.data.matching import Filter
from analysis.data.selection import select
from analysis.figures.input_spectrum import caption, measure_spectra, tabulate_spectra, unit_of
from orchestrate.store import Reader
from tests.analysis.conftest import SHORT
from tests.analysis.synthetic import fill, make_grid


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


def test_a_policy_of_which_every_trial_diverged_is_named(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/results.db"
    specs = make_grid(("cartpole",), ("d_optimal", "random"), range(3), **SHORT)
    lost = {spec.trial_key: 9 for spec in specs if spec.policy.name == "random"}
    fill(url, specs, diverged=lost)
    with Reader.open(url) as reader:
        spectra = measure_spectra(reader, select(reader, Filter()), "cartpole")
    assert [one.policy for one in spectra.policies] == ["d_optimal"]
    assert spectra.diverged == ("random",)
    assert "Not drawn, because every trial diverged: random." in caption(spectra)


def test_unit_of() -> None:
    assert unit_of("u [N m]") == "N m"
    assert unit_of("u") == ""
