"""Figure 6: which configurations have a point, what their numbers are, and what is drawn."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.cli import main
from analysis.data.matching import Filter
from analysis.data.samples import DivergenceRule
from analysis.data.selection import select
from analysis.figures.pareto import (
    Point,
    draw,
    measure_points,
    pareto_part,
    pareto_plot,
    policies_of,
    policy_colours,
)
from analysis.stats.curves import PlotOptions
from analysis.stats.intervals import Estimate
from analysis.stats.scores import on_front
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.store import Reader
from tests.analysis.conftest import SHORT
from tests.analysis.synthetic import fill, make_grid

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


def measured(url: str, rule: DivergenceRule = DivergenceRule.EXCLUDE) -> tuple[Point, ...]:
    with Reader.open(url) as reader:
        return measure_points(reader, pareto_part(select(reader, Filter())), rule)


def test_a_point_is_a_configuration_of_an_environment_that_has_several(learners: str) -> None:
    points = measured(learners)
    labels = [point.label for point in points if point.env == "pendulum"]
    assert len(labels) == len(set(labels)) == 10  # the task and the other bound are none
    assert {point.env for point in points} == set(ENVS)
    assert "random, gauss_newton, refit_every=10" in labels
    words = {(one.policy_words, one.learner_words) for one in points if one.env == "pendulum"}
    assert len(words) == 10
    assert {("random", "gauss_newton"), ("random", "gauss_newton, ensemble")} <= words
    assert list(policies_of(points)) == ["D-optimal", "D-optimal, information=fresh", "random"]


def test_time_counts_the_fits_of_some_steps_and_loss_is_a_geometric_mean(learners: str) -> None:
    found = {(one.env, one.label): one for one in measured(learners)}
    assert found["pendulum", "random, gauss_newton"].us == pytest.approx(105.0)
    every_tenth = found["pendulum", "random, gauss_newton, refit_every=10"]
    assert every_tenth.us == pytest.approx(5.0 + (100.0 + 9 * 1.0) / 10)
    with Reader.open(learners) as reader:
        [config] = [
            one
            for one in reader.configs()
            if (one.env, one.policy) == ("pendulum", "random")
            and one.config["learner"].get("refit_every") == 10
        ]
        finals = [trial.final_loss for trial in reader.trials(config.config_key)]
    assert every_tenth.loss.value == pytest.approx(np.exp(np.mean(np.log(finals))))
    assert every_tenth.loss.low < every_tenth.loss.value < every_tenth.loss.high


def test_the_front_is_that_of_each_environment(learners: str) -> None:
    points = [one for one in measured(learners) if one.env == "pendulum"]
    front = on_front(np.array([(one.us, one.loss.value) for one in points]))
    assert [one.on_front for one in points] == front.tolist()
    assert 0 < front.sum() < len(points)


def test_diverged_trials_are_counted_and_said(learners: str) -> None:
    points = measured(learners)
    [some] = [one for one in points if (one.env, one.label) == ("pendulum", "random, adam")]
    assert (some.n, some.n_diverged, some.counts) == (2, 1, "2/3, 1 diverged")
    [none] = [one for one in points if (one.env, one.label) == ("quadrotor", "random, adam")]
    assert not none.known
    assert not none.on_front
    words = pareto_plot("name").caption((DivergenceRule.EXCLUDE, points))
    assert "No point, as no trial has a positive final loss: quadrotor, random, adam (0/3" in words
    assert "random, adam: 2/3, 1 diverged" in words
    lent = measured(learners, DivergenceRule.WORST)
    assert [one.n for one in lent if (one.env, one.label) == ("pendulum", "random, adam")] == [3]


def test_it_is_drawn_from_the_command_line(learners: str, tmp_path: Path) -> None:
    given = ("--db", learners, "--out", str(tmp_path), "--allow-partial")
    assert main(["figures", *given, "--only", "figure6_pareto"]) == 0
    assert (tmp_path / "figure6_pareto.png").read_bytes().startswith(b"\x89PNG")
    with (tmp_path / "figure6_pareto.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 20
    assert {row["on_front"] for row in rows} == {"True", "False"}


def point(place: int, us: float, loss: float, label: str) -> Point:
    estimate = Estimate(loss, 0.8 * loss, 1.2 * loss)
    names = {"policy": "random", "policy_words": f"random {place}", "learner_words": "adam"}
    counts = {"n": 20, "n_finished": 20, "n_diverged": 0, "counts": "20"}
    return Point("arm", label, us=us, loss=estimate, unit="rad/s²", limit_us=2e4, on_front=True,
                 **names, **counts)  # type: ignore[arg-type] # fmt: skip


def test_the_list_of_the_front_covers_no_point() -> None:
    label = "look-ahead, gauss_newton, refit_every=10"
    points = [point(i, 10.0 * 2**i, 1.0 / 1.1**i, label) for i in range(14)]
    figure = draw(tuple(points))
    figure.draw_without_rendering()
    [axes] = figure.axes
    [listed] = [text for text in axes.texts if label in text.get_text()]
    corner = listed.get_window_extent()
    places = axes.transData.transform([(one.us, one.loss.low) for one in points])
    assert not any(corner.contains(*place) for place in places)
    assert any("dt = 20 ms" in text.get_text() for text in axes.texts)


def test_numbers_of_points_in_one_place_are_drawn_together() -> None:
    places = [(10.0, 2.0), (100.0, 0.5), (100.1, 0.499), (1000.0, 0.1)]
    points = [point(i, us, loss, f"random {i}") for i, (us, loss) in enumerate(places)]
    [axes] = draw(tuple(points)).axes
    assert {"1", "2, 3", "4"} <= {text.get_text() for text in axes.texts}


def test_policies_of_one_colour_are_told_apart() -> None:
    words = {"random": "random", "iCEM": "icem", "D-optimal": "d_optimal", "fresh": "d_optimal"}
    colours = policy_colours(words)
    assert len(set(colours.values())) == 4
    assert list(colours) == list(words)


def test_the_paper_s_grid_has_one_too(reader: Reader) -> None:
    plot = pareto_plot("figure6_pareto")
    drawing = plot.make(reader, plot.part(select(reader, Filter())), PlotOptions())
    assert len(drawing.figure.axes) == 3
    assert "D-optimal, width 64" in set(drawing.table["label"])
    assert "oracle" not in set(drawing.table["policy"])
