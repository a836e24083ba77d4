"""Performance profiles and the comparison over all systems."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest

from analysis.cli import main
from analysis.data.matching import Filter
from analysis.data.selection import select
from analysis.figures.profiles import (
    caption,
    draw,
    measure_profiles,
    profiles_part,
    tabulate_profiles,
)
from analysis.tables.comparisons import compare_policies
from orchestrate.store import Reader


def test_a_profile_counts_runs_and_rises_to_those_that_did_not_diverge(reader: Reader) -> None:
    selection = select(reader, Filter())
    profiles = {one.label: one for one in measure_profiles(profiles_part(selection))}
    random = profiles["random"]
    assert random.environments == ("pendulum", "cartpole", "quadrotor")
    assert (random.n, random.n_diverged) == (15, 1)
    assert (np.diff(random.share.centre) >= 0).all()
    assert random.share.centre[-1] == pytest.approx((1 + 0.8 + 1) / 3)
    assert profiles["D-optimal"].share.centre[-1] == 1.0
    assert profiles["periodic"].environments == ("pendulum", "cartpole")


def test_a_point_of_a_profile_by_hand(reader: Reader) -> None:
    selection = select(reader, Filter(("pendulum",), ("d_optimal", "random")))
    own, reference = (
        np.array(list(entry.final_losses().values()))
        for entry in sorted(selection.entries, key=lambda one: one.config.policy != "random")
    )
    [profile] = [one for one in measure_profiles(selection) if one.label == "random"]
    place = 150
    limit = profile.factors[place] * np.exp(np.mean(np.log(reference)))
    assert profile.share.centre[place] == np.mean(own <= limit)


def test_the_caption_says_what_is_in_fewer_environments(reader: Reader) -> None:
    profiles = measure_profiles(profiles_part(select(reader, Filter())))
    words = caption(profiles)
    assert "In fewer environments: periodic: pendulum, cartpole" in words
    assert "random: 15, 1 diverged" in words
    [legend] = draw(profiles).legends
    assert "periodic (2 of 3 systems)" in [text.get_text() for text in legend.get_texts()]
    assert len(tabulate_profiles(profiles)) == 301 * 4  # all but the oracle


def test_one_policy_has_no_profile(reader: Reader) -> None:
    alone = select(reader, Filter(policies=("d_optimal",)))
    assert profiles_part(alone).entries == ()


def test_the_ratio_over_systems_is_the_geometric_mean_of_theirs(
    reader: Reader, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["aggregate", "--db", url, "--format", "csv"]) == 0
    rows = {row["variant"]: row for row in csv.DictReader(io.StringIO(capsys.readouterr().out))}
    table = compare_policies(reader, select(reader, Filter()))
    for variant, part in table.groupby("variant"):
        row = rows.pop(str(variant))
        assert float(row["ratio"]) == pytest.approx(np.exp(np.log(part["ratio"]).mean()))
        assert float(row["low"]) < float(row["ratio"]) < float(row["high"])
        assert int(row["n_pairs"]) == part["n_pairs"].sum()
    assert not rows


def test_the_table_says_which_systems_a_row_is_of(
    url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["aggregate", "--db", url]) == 0
    printed = capsys.readouterr().out
    assert "| pendulum, cartpole            | 10" in printed
    assert "14, 1 diverged" in printed
    assert main(["aggregate", "--db", url, "--policy", "random"]) == 2
    assert "needs trials of the reference d_optimal" in capsys.readouterr().err
