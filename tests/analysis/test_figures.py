"""Numbers and drawings of figure 6, ratios over all systems, and trials of other widths."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from analysis.cli import main
from analysis.data.matching import Filter
from analysis.data.selection import select
from analysis.figures.losses import (
    PARETO,
    draw,
    measure_points,
    pareto_part,
    policies_of,
    policy_colours,
)
from analysis.stats.curves import PlotOptions
from analysis.stats.scores import on_front
from analysis.tables.comparisons import compare_policies
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.store import Reader
from tests.analysis.conftest import SHORT, wide
from tests.analysis.synthetic import fill, filled, make_grid


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


@pytest.mark.parametrize("seeds", [3, 5, 9])
def test_however_many_trials_another_width_has(tmp_path: Path, seeds: int) -> None:
    grid = make_grid(("cartpole",), ("d_optimal", "random", "oracle"), range(5), **SHORT)
    extra = wide(64, range(seeds)) + wide(16, range(seeds), learner={"name": "adam"})
    extra += wide(16, range(seeds), policy={"regularization": 0.5})[: min(seeds, 5)]
    with filled(tmp_path, grid + extra) as reader:
        selection = select(reader, Filter())
    assert selection.gaps == ()
    assert {entry.config.config_key for entry in selection.entries} == {s.config_key for s in grid}


def test_a_database_of_widths_alone_takes_the_width_of_the_paper(tmp_path: Path) -> None:
    specs = [spec for width in (8, 16, 32) for spec in wide(width, range(3))]
    with filled(tmp_path, specs) as reader:
        assert [one.config.width for one in select(reader, Filter()).entries] == [16]


LEARNERS: tuple[dict[str, object], ...] = (
    {"name": "adam"},
    {"name": "adam_window"},
    {"name": "gauss_newton"},
    {"name": "gauss_newton", "refit_every": 10},
)
NETWORKS = {"model": {"name": "ensemble"}, "learner": {"name": "gauss_newton"}}
TASK = {"name": "control", "checkpoints": [20]}
ENVS = ("pendulum", "quadrotor")


def refits(spec: TrialSpec, result: TrialResult) -> TrialResult:
    """Return a result whose learner takes 1 µs, and 100 µs in each step that fits."""
    every = getattr(spec.learner, "refit_every", 1)
    learn = np.where(np.arange(len(result.loss)) % every == 0, 100.0, 1.0)
    return replace(result, plan_us=np.full_like(result.plan_us, 5.0), learn_us=learn)


@pytest.fixture(scope="module")
def learners(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a database of policies and learners; some trials diverged, of one pair all."""
    address = f"sqlite:///{tmp_path_factory.mktemp('pareto')}/results.db"
    specs = [
        spec
        for learner in LEARNERS
        for spec in make_grid(ENVS, ("d_optimal", "random"), range(3), learner=learner, **SHORT)
    ]
    fresh = {"information": "fresh"}
    specs += make_grid(ENVS, ("d_optimal",), range(3), policy=fresh, **SHORT)
    specs += make_grid(ENVS, ("random",), range(3), **NETWORKS, **SHORT)
    specs += make_grid(ENVS[:1], ("d_optimal",), range(3), task=TASK, **SHORT)
    specs += make_grid(ENVS[:1], ("random",), range(2), env={"horizon": 60, "gamma": 3.0})
    specs += make_grid(("arm",), ("random",), range(3), **SHORT)
    lost = [s for s in specs if s.learner.name == "adam" and s.policy.name == "random"]
    gone = {s.trial_key: 20 for s in lost if s.system.name == "quadrotor" or s.seed == 1}
    fill(address, specs, diverged=gone, edit=refits)
    return address


def points_of(url: str) -> pd.DataFrame:
    with Reader.open(url) as reader:
        points = measure_points(reader, pareto_part(select(reader, Filter())))
    return points.set_index(["env", "label"], drop=False)


def test_a_point_is_a_configuration_of_an_environment_that_has_several(learners: str) -> None:
    points = points_of(learners)
    assert set(points.env) == set(ENVS)
    own = points.loc["pendulum"]
    assert own.label.is_unique
    assert len(own) == 10  # neither the task nor the other bound
    assert "random, gauss_newton, refit_every=10" in own.index
    words = set(zip(own.policy_label, own.learner_label, strict=True))
    assert len(words) == 10
    assert {("random", "gauss_newton"), ("random", "gauss_newton, ensemble")} <= words
    assert list(policies_of(points)) == ["D-optimal", "D-optimal, information=fresh", "random"]


def test_time_counts_the_fits_of_some_steps_and_loss_is_a_geometric_mean(learners: str) -> None:
    found = points_of(learners).loc["pendulum"]
    assert found.us_per_step["random, gauss_newton"] == pytest.approx(105.0)
    every_tenth = found.loc["random, gauss_newton, refit_every=10"]
    assert every_tenth.us_per_step == pytest.approx(5.0 + (100.0 + 9 * 1.0) / 10)
    with Reader.open(learners) as reader:
        [config] = [
            one
            for one in reader.configs()
            if (one.env, one.policy) == ("pendulum", "random")
            and one.config["learner"].get("refit_every") == 10
        ]
        finals = [trial.final_loss for trial in reader.trials(config.config_key)]
    assert every_tenth.loss == pytest.approx(np.exp(np.mean(np.log(finals))))
    assert every_tenth.low < every_tenth.loss < every_tenth.high


def test_each_environment_has_its_front(learners: str) -> None:
    points = points_of(learners).loc["pendulum"]
    assert points.us_per_step.is_monotonic_increasing
    front = on_front(points[["us_per_step", "loss"]].to_numpy())
    assert points.on_front.tolist() == front.tolist()
    assert 0 < front.sum() < len(points)


def test_diverged_trials_are_counted_and_said(learners: str) -> None:
    points = points_of(learners)
    some, none = (points.loc[(env, "random, adam")] for env in ENVS)
    assert (some.n, some.n_diverged, some.counts) == (2, 1, "2/3, 1 diverged")
    assert not none.known
    assert not none.on_front
    words = PARETO.caption(points.reset_index(drop=True))
    assert "No point, as no trial has a positive final loss: quadrotor, random, adam (0/3" in words
    assert "random, adam: 2/3, 1 diverged" in words


def test_the_time_between_two_steps_is_marked(learners: str) -> None:
    first, *_ = draw(points_of(learners).reset_index(drop=True).assign(limit_us=10.0)).axes
    assert [text.get_text() for text in first.texts] == ["dt = 0.01 ms"]


def test_policies_of_one_colour_are_told_apart() -> None:
    words = {"random": "random", "iCEM": "icem", "D-optimal": "d_optimal", "fresh": "d_optimal"}
    colours = policy_colours(words)
    assert len(set(colours.values())) == 4
    assert list(colours) == list(words)


def test_the_paper_s_grid_has_one_too(reader: Reader) -> None:
    plot = PARETO
    drawing = plot.make(reader, plot.part(select(reader, Filter()), PlotOptions()), PlotOptions())
    assert len(drawing.figure.axes) == 3
    points = drawing.table
    assert "D-optimal, width 64" in set(points["label"])
    assert not points.duplicated(["env", "policy_label", "learner_label"]).any()
    assert {"adam_window", "adam_window, width 64"} <= set(points["learner_label"])
    assert "oracle" not in set(drawing.table["policy"])
