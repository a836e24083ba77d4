"""Figure 8: which configurations are a line, what their numbers are, and what is drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from analysis.data.matching import Filter
from analysis.data.samples import DivergenceRule
from analysis.data.selection import select
from analysis.figures.sensitivity import (
    Line,
    caption,
    draw,
    measure_lines,
    sensitivity_part,
    sensitivity_plot,
)
from analysis.stats.curves import PlotOptions
from orchestrate.store import Reader
from tests.analysis.conftest import SHORT
from tests.analysis.synthetic import fill, make_grid

RATES = (1e-3, 1e-2, 1e-1)
RIDGES = (1e-4, 1e-3, 1e-2)


@pytest.fixture(scope="module")
def varied(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return two policies in two systems under three learning rates and three λ, one diverged."""
    address = f"sqlite:///{tmp_path_factory.mktemp('sensitivity')}/results.db"
    envs, both, seeds = ("pendulum", "arm"), ("d_optimal", "random"), range(3)
    specs = [
        spec
        for rate in RATES
        for spec in make_grid(envs, both, seeds, learner={"learning_rate": rate}, **SHORT)
    ]
    for ridge in RIDGES:
        specs += make_grid(envs, both[:1], seeds, policy={"regularization": ridge}, **SHORT)
    two = {"learning_rate": 0.1}, {"regularization": 0.01}  # differ in both: part of no line
    specs += make_grid(envs, both[:1], seeds, learner=two[0], policy=two[1], **SHORT)
    specs += make_grid(envs, ("uniform",), seeds, **SHORT)  # has no line of its own
    specs = list({spec.trial_key: spec for spec in specs}.values())
    lost = [s for s in specs if s.policy.name == "random" and s.system.name == "arm"]
    slow = [s for s in lost if s.to_mapping()["learner"]["learning_rate"] == 1e-3 and s.seed == 0]
    fill(address, specs, diverged={slow[0].trial_key: 20})
    return address


def measured(url: str) -> tuple[Line, ...]:
    with Reader.open(url) as reader:
        part = sensitivity_part(select(reader, Filter()))
        return measure_lines(reader, part, DivergenceRule.EXCLUDE)


def test_a_line_varies_one_setting_and_others_have_a_level(varied: str) -> None:
    lines = {(one.env, one.policy, one.setting): one for one in measured(varied)}
    assert len(lines) == 2 * 2 * 2
    rates = lines["arm", "random", "learner.learning_rate"]
    assert (rates.values, rates.usual) == (RATES, 1e-2)
    ridges = lines["pendulum", "d_optimal", "policy.regularization"]
    assert (ridges.values, ridges.usual) == (RIDGES, 1e-3)
    level = lines["pendulum", "random", "policy.regularization"]
    assert level.values == ()
    assert level.losses == (lines["pendulum", "random", "learner.learning_rate"].losses[1],)


def test_losses_are_geometric_means_and_diverged_trials_are_counted(varied: str) -> None:
    [line] = [
        one
        for one in measured(varied)
        if (one.env, one.policy, one.setting) == ("arm", "random", "learner.learning_rate")
    ]
    assert [one.describe() for one in line.scores] == ["2/3, 1 diverged", "3", "3"]
    for loss, scores in zip(line.losses, line.scores, strict=True):
        assert loss.value == pytest.approx(np.exp(np.log(scores.values).mean()))
    assert "random, learning_rate=0.001: 2/3, 1 diverged" in caption((line,))


def test_it_has_a_row_for_each_system_and_a_column_for_each_setting(varied: str) -> None:
    lines = measured(varied)
    figure = draw(lines)
    assert len(figure.axes) == 2 * 2
    labels = [axes.get_xlabel() for axes in figure.axes[2:]]
    assert labels == ["λ of the information matrix", "learning rate"]
    assert "Level: random" in caption(lines)


def test_two_values_are_too_few(reader: Reader, tmp_path: Path) -> None:
    address = f"sqlite:///{tmp_path}/few.db"
    for rate in RATES[:2]:
        learner = {"learning_rate": rate}
        fill(address, make_grid(("arm",), ("random",), range(2), learner=learner, **SHORT))
    with Reader.open(address) as few:
        assert sensitivity_part(select(few, Filter())).entries == ()
    plot = sensitivity_plot("name")
    part = plot.part(select(reader, Filter()))
    assert {entry.config.policy for entry in part.entries} == {"random"}
    table = plot.make(reader, part, PlotOptions()).table
    assert table["value"].tolist() == [10.0, 20.0, 40.0, 60.0, 100.0]
