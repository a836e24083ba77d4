"""Configurations are grouped, compared and coloured by any setting."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.cli import main
from analysis.data.config_matching import Filter
from analysis.data.trial_selection import Entry, Selection, select
from analysis.errors import AnalysisError
from analysis.tables.comparisons import compare_policies, references
from orchestrate.store import ConfigRow, Reader, TrialRow
from tests.analysis.synthetic import fill, make_grid, make_spec


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


def test_policies_are_compared_under_the_same_setting(
    bounds_url: str, bounds: Reader, capsys: pytest.CaptureFixture[str]
) -> None:
    table = compare_policies(bounds, select(bounds, Filter(group_by=("policy", "env.gamma"))))
    assert dict(zip(table.variant, table.reference, strict=True)) == {
        f"random, γ={gamma}": f"D-optimal, γ={gamma}" for gamma in (2, 3, 10)
    }
    assert main(["compare", "--db", bounds_url, "--group-by", "policy", "env.gamma"]) == 0
    assert "| reference (same env.gamma) " in capsys.readouterr().out
    named = Filter(reference="D-optimal, γ=3", group_by=("policy", "env.gamma"))
    table = compare_policies(bounds, select(bounds, named))
    assert set(table.reference) == {"D-optimal, γ=3"}
    assert len(table) == 5


GROUPS = [
    (policy, gamma, width)
    for policy in ("d_optimal", "random", "uniform")
    for gamma in (2.0, 3.0)
    for width in (4, 8)
]


@given(
    chosen=st.lists(st.sampled_from(GROUPS), min_size=1, unique=True),
    reference=st.sampled_from(["d_optimal", "random"]),
    diverged=st.sets(st.sampled_from(GROUPS)),
)
def test_a_reference_differs_in_the_policy_alone_wherever_it_is_stored(
    chosen: list[tuple[str, float, int]], reference: str, diverged: set[tuple[str, float, int]]
) -> None:
    entries = tuple(entry(*one, diverged=one in diverged) for one in chosen)
    keys = ("policy", "env.gamma", "width")
    selection = Selection(entries, reference=reference, group_by=keys)
    overall = selection.reference_of("pendulum")
    rows = list(references(selection, "pendulum"))
    assert len({id(one) for one, _, _ in rows}) == len(rows)
    for one, other, same in rows:
        stored = (reference, *one.group[1:])
        assert one is not other
        assert same == (stored in chosen and stored not in diverged and one.group != stored)
        assert other.group == stored if same else other is overall
    left_out = [one for one in entries if all(one is not row[0] for row in rows)]
    if overall is not None:
        assert {one.config.policy for one in left_out} <= {overall.config.policy}
        assert all(one is overall or one.config.policy == reference for one in left_out)


def entry(policy: str, gamma: float, width: int, *, diverged: bool) -> Entry:
    """Return a configuration with one trial."""
    specification = make_spec("pendulum", policy, 0, env={"gamma": gamma}, model={"width": width})
    config = {k: v for k, v in specification.to_mapping().items() if k != "seed"}
    row = ConfigRow(
        *(f"{policy}{gamma}{width}", "pendulum", policy, "mlp", "adam_window", width, 2, 40, 0.02),
        *(gamma, "", 1, 0, 0, 0, 0, 0, config),
    )
    values = dict.fromkeys(one.name for one in dataclasses.fields(TrialRow))
    status, loss = ("diverged", None) if diverged else ("done", 1.0)
    trial = TrialRow(**values | {"seed": 0, "status": status, "final_loss": loss})  # type: ignore[arg-type]
    return Entry(row, (trial,), f"{policy}, {gamma}, {width}", (policy, gamma, width))


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
