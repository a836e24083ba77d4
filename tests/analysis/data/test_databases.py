"""SQLite and PostgreSQL give the same numbers, to the last bit."""

from __future__ import annotations

import pandas as pd
import pytest

from analysis.data.matching import Filter
from analysis.data.samples import DivergenceRule
from analysis.data.selection import select
from analysis.figures.input_spectrum import measure_spectra, tabulate_spectra
from analysis.figures.phase_portraits import measure_portraits, tabulate_portraits
from analysis.stats.curves import PlotOptions, measure_curves, tabulate_curves
from analysis.stats.intervals import Statistic
from analysis.tables.rendering import TABLES
from orchestrate.store import Reader
from tests.analysis.conftest import SHORT, controlled
from tests.analysis.synthetic import fill, make_grid


@pytest.fixture
def twins(sqlite_url: str, postgresql_url: str) -> tuple[Reader, Reader]:
    """Return one grid in both databases, with a diverged trial, filled in different orders."""
    specs = make_grid(("pendulum", "cartpole"), seeds=range(6), **SHORT) + controlled(range(6))
    lost = next(s for s in specs if (s.system.name, s.policy.name) == ("cartpole", "random"))
    for url, order in ((sqlite_url, specs), (postgresql_url, specs[::-1])):
        fill(url, order, diverged={lost.trial_key: 20})
    return Reader.open(sqlite_url), Reader.open(postgresql_url)


def test_every_number_is_the_same(twins: tuple[Reader, Reader]) -> None:
    for one, other in zip(_numbers(twins[0]), _numbers(twins[1]), strict=True):
        pd.testing.assert_frame_equal(one, other, check_exact=True)
    for reader in twins:
        reader.close()


def _numbers(reader: Reader) -> list[pd.DataFrame]:
    selection, rule = select(reader, Filter()), DivergenceRule.EXCLUDE
    asked = PlotOptions()
    tables = [kind.measure(reader, kind.part(selection, asked), asked) for kind in TABLES.values()]
    curves = [
        tabulate_curves(measure_curves(reader, selection, "loss", rule, statistic=statistic))
        for statistic in Statistic
    ]
    cartpole = selection.only(["cartpole"])
    spectra = tabulate_spectra(measure_spectra(reader, cartpole, "cartpole"))
    portraits = tabulate_portraits(measure_portraits(reader, cartpole, "cartpole"))
    return [*tables, *curves, spectra, portraits]
