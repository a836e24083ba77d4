"""Configurations are grouped, compared and coloured by any setting."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from analysis.__main__ import main
from analysis.data.config_matching import Filter
from analysis.data.trial_selection import select
from analysis.errors import AnalysisError
from analysis.tables.comparisons import compare_policies
from orchestrate.store import Reader
from tests.analysis.synthetic import fill, make_grid


@pytest.fixture(scope="module")
def bounds_url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a database of two policies under three bounds of the input."""
    url = f"sqlite:///{tmp_path_factory.mktemp('bounds')}/results.db"
    specs = []
    for gamma in (2, 3, 10):
        env = {"horizon": 40, "gamma": gamma}
        specs += make_grid(("pendulum",), ("d_optimal", "random"), range(4), env=env)
    fill(url, specs)
    return url


@pytest.fixture
def bounds(bounds_url: str) -> Iterator[Reader]:
    with Reader.open(bounds_url) as opened:
        yield opened


def test_each_value_is_shown_once_in_the_order_of_the_numbers(bounds: Reader) -> None:
    selection = select(bounds, Filter(group_by=("env.gamma",)))
    assert selection.labels == ("γ=2", "γ=3", "γ=10")
    assert {entry.config.policy for entry in selection.entries} == {"d_optimal"}
    one = select(bounds, Filter(policies=("random",), group_by=("gamma",)))
    assert {entry.config.policy for entry in one.entries} == {"random"}


def test_settings_can_be_combined(bounds: Reader) -> None:
    selection = select(bounds, Filter(group_by=("policy", "gamma")))
    assert selection.labels == (
        *("D-optimal, γ=2", "D-optimal, γ=3", "D-optimal, γ=10"),
        *("random, γ=2", "random, γ=3", "random, γ=10"),
    )


@pytest.mark.parametrize(
    ("given", "name"), [("d_optimal", "γ=2"), ("10.0", "γ=10"), ("γ=3", "γ=3")]
)
def test_values_are_compared_with_the_default_or_the_one_that_is_named(
    bounds: Reader, given: str, name: str
) -> None:
    table = compare_policies(
        bounds, select(bounds, Filter(reference=given, group_by=("env.gamma",)))
    )
    assert set(table.reference) == {name}
    assert len(table) == 2


def test_a_setting_that_nothing_has_is_a_sentence(bounds: Reader) -> None:
    with pytest.raises(AnalysisError, match=r"'env.gama' is no setting .* env.gamma"):
        select(bounds, Filter(group_by=("env.gama",)))


def test_figure_1_is_coloured_by_the_setting(bounds_url: str, tmp_path: Path) -> None:
    grouped = ["--group-by", "policy", "env.gamma", "--color-by", "env.gamma"]
    only = ["--only", "figure1", "--only", "summary", "--out", str(tmp_path)]
    assert main(["figures", "--db", bounds_url, *only, *grouped]) == 0
    table = (tmp_path / "figure1.csv").read_text().splitlines()
    assert {line.split(",")[2] for line in table[1:]} == {'"D-optimal', '"random'}
    assert "| random, γ=10 |" in " ".join((tmp_path / "summary.md").read_text().split())
