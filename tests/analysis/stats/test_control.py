from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import analysis
from analysis.data.matching import Filter
from analysis.data.selection import Selection, select
from analysis.figures.control import caption_control, draw_control
from analysis.outputs import build
from analysis.stats.control import (
    ControlCurve,
    control_part,
    measure_control,
    relative_costs,
    scores_at,
    tabulate_control,
    true_model,
)
from analysis.stats.curves import PlotOptions
from analysis.tables.comparisons import compare_control
from analysis.tables.rendering import control_table
from dopt.result import Assessment, TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.store import Assessments, Reader
from tests.analysis.conftest import SHORT
from tests.analysis.synthetic import fake_result, fill, make_grid

Edit = Callable[[TrialSpec, TrialResult], TrialResult]


@pytest.fixture
def part(reader: Reader) -> Selection:
    return control_part(select(reader, Filter()))


def curve_of(curves: tuple[ControlCurve, ...], env: str, policy: str) -> ControlCurve:
    return next(one for one in curves if (one.env, one.policy) == (env, policy))


def test_only_trials_with_a_task_are_taken(reader: Reader, part: Selection) -> None:
    assert part.environments == ("pendulum", "quadrotor")
    assert part.policies == ("d_optimal", "uniform", "random")
    assert all(entry.config.config["task"] for entry in part.entries)
    whole = select(reader, Filter())
    assert not any("task" in entry.config.config for entry in whole.entries)


def test_the_numbers_are_those_of_the_trials(reader: Reader, part: Selection) -> None:
    curves = measure_control(reader, part)
    curve = curve_of(curves, "pendulum", "uniform")
    entry = next(e for e in part.of("pendulum") if e.config.policy == "uniform")
    task = entry.config.config["task"]
    specs = make_grid(("pendulum",), ("uniform",), range(5), **SHORT, task=task)
    rows = [fake_result(spec).assessments for spec in specs]
    assert curve.t.tolist() == [0, 20, 40, 60]
    assert curve.n.tolist() == [5] * 4
    for j, t in enumerate(curve.t):
        costs = [_value(of, t, "control_cost") / 100.0 for of in rows]
        assert curve.cost[j] == pytest.approx(np.exp(np.mean(np.log(costs))))
        assert curve.cost_low[j] < curve.cost[j] < curve.cost_high[j]
        assert curve.success[j] == np.mean([_value(of, t, "control_success") for of in rows])


@pytest.mark.parametrize(
    "measure",
    [
        lambda reader, part: measure_control(reader, part)[0].cost,
        lambda reader, part: relative_costs(reader, part.entries[0]).values,
        lambda reader, part: list(scores_at(reader, part.entries[0], 20).by_seed.items()),
        lambda reader, part: dataclasses.astuple(true_model(reader, part.entries)),
    ],
)
def test_what_is_finished_during_a_read_is_not_in_a_part_of_it(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    measure: Callable[[Reader, Selection], object],
) -> None:
    address, task = f"sqlite:///{tmp_path}/live.db", {"name": "control", "checkpoints": [20]}
    specs = make_grid(("pendulum",), ("random",), range(6), **SHORT, task=task)
    fill(address, specs, skipped=specs[2:])
    read, left = Reader.assessments, [spec for spec in specs[2:] if spec.seed % 2]

    def assessments(self: Reader, config_key: str, measure: str) -> Assessments:
        found = read(self, config_key, measure)
        if left:
            fill(address, [left.pop()])
        return found

    with Reader.open(address) as reader:
        part = control_part(select(reader, Filter()))
        expected = measure(reader, part)
        fill(address, specs[2::2])  # between the selection and the read
        monkeypatch.setattr(Reader, "assessments", assessments)
        np.testing.assert_array_equal(measure(reader, part), expected)
    assert len(left) < 2


def _value(rows: tuple[Assessment, ...], t: int, measure: str) -> float:
    return next(row.value for row in rows if (row.t, row.measure) == (t, measure))


def test_wilson_intervals_are_those_of_the_textbook(reader: Reader, part: Selection) -> None:
    curve = curve_of(measure_control(reader, part), "pendulum", "d_optimal")
    first, last = 0, -1
    assert (curve.success[first], curve.success[last]) == (0.0, 1.0)
    z = 1.959963985
    edge = z**2 / (5 + z**2)  # no success in five
    assert (curve.success_low[first], curve.success_high[first]) == pytest.approx((0, edge))
    assert (curve.success_low[last], curve.success_high[last]) == pytest.approx((1 - edge, 1))


def test_the_comparison_pairs_seeds(reader: Reader, part: Selection) -> None:
    table = compare_control(reader, part)
    assert sorted(set(table.t)) == [20, 40, 60]
    row = table[(table.env == "quadrotor") & (table.t == 40) & (table.policy == "random")]
    entries = {entry.config.policy: entry for entry in part.of("quadrotor")}
    ours, theirs = (
        scores_at(reader, entries[name], 40).by_seed for name in ("d_optimal", "random")
    )
    ratios = [np.log(theirs[seed] / ours[seed]) for seed in range(5)]
    assert row.ratio.item() == pytest.approx(np.exp(np.mean(ratios)))
    assert row.n_pairs.item() == 5
    assert row.improvement.item() == 0.0
    sheet = control_table(table)
    assert len(sheet.rows) == len(table) == 2 * 3 * 2
    assert "| quadrotor |" in sheet.markdown()


def test_a_number_that_is_missing_is_left_out(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/results.db"
    task = {"task": {"name": "control", "checkpoints": [20]}}
    specs = make_grid(("pendulum",), ("random",), range(3), **SHORT, **task)
    fill(url, specs)
    with Reader.open(url) as reader:
        part = control_part(select(reader, Filter()))
        (entry,) = part.entries
        costs = relative_costs(reader, entry)
        assert costs.values.shape == (3, 3)
        assert scores_at(reader, entry, 19).by_seed == {}
        assert sorted(scores_at(reader, entry, 20).by_seed) == [0, 1, 2]
        assert tabulate_control(measure_control(reader, part)).n.tolist() == [3, 3, 3]


def valued(
    measure: str, policies: tuple[str, ...], seeds: tuple[int, ...], t: int, value: float
) -> Edit:
    """Return an edit that gives a measure of some trials a value."""

    def edit(spec: TrialSpec, result: TrialResult) -> TrialResult:
        if spec.policy.name not in policies or spec.seed not in seeds:
            return result
        rows = (
            row._replace(value=value) if (row.t, row.measure) == (t, measure) else row
            for row in result.assessments
        )
        return dataclasses.replace(result, assessments=tuple(rows))

    return edit


def overflown(measure: str, policies: tuple[str, ...], seeds: tuple[int, ...], t: int) -> Edit:
    """Return an edit that makes a number infinite, as the episode of a crashed plant has it."""
    return valued(measure, policies, seeds, t, np.inf)


def test_episodes_without_a_finite_cost_are_counted(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/lost.db"
    task = {"task": {"name": "control", "checkpoints": [20]}}
    specs = make_grid(("pendulum",), ("d_optimal", "random"), range(5), **SHORT, **task)
    fill(url, specs, edit=overflown("control_cost", ("random",), (1, 3), 20))
    with Reader.open(url) as reader:
        part = control_part(select(reader, Filter()))
        curves = measure_control(reader, part)
        entry = next(entry for entry in part.entries if entry.config.policy == "random")
        scores = scores_at(reader, entry, 20).by_seed
        table = compare_control(reader, part)
    curve = curve_of(curves, "pendulum", "random")
    assert curve.n.tolist() == [5, 5, 5]
    assert curve.lost.tolist() == [0, 2, 0]
    assert {seed for seed, score in scores.items() if np.isinf(score)} == {1, 3}
    finite = [score for score in scores.values() if np.isfinite(score)]
    assert curve.cost[1] == pytest.approx(np.exp(np.mean(np.log(finite))))
    assert tabulate_control(curves).lost.tolist() == [0, 0, 0, 0, 2, 0]
    assert "random: 5, 2 lost" in caption_control(curves)
    assert "Lost: episodes" in caption_control(curves)
    assert "2 lost" in draw_control(curves).axes[0].get_title()
    row = table[table.t == 20].iloc[0]
    assert (row.n_pairs, row.n_lost, row.improvement) == (5, 2, 0.0)
    assert row.p_value == pytest.approx(2 / 2**5)  # all five, the lost ones too
    lines = control_table(table).markdown().splitlines()
    assert "], 2 lost |" in lines[2]
    assert "lost" not in lines[3]


def test_costs_without_a_true_model_to_divide_by_are_counted(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/truth.db"
    task = {"task": {"name": "control", "checkpoints": [20]}}
    specs = make_grid(("pendulum",), ("d_optimal", "random"), range(5), **SHORT, **task)
    fill(url, specs, edit=overflown("true_model_cost", ("d_optimal", "random"), tuple(range(5)), 0))
    with Reader.open(url) as reader:
        part = control_part(select(reader, Filter()))
        curves = measure_control(reader, part)
        table = compare_control(reader, part)
    assert [curve.lost.tolist() for curve in curves] == [[5, 5, 5]] * 2
    assert np.isnan(curves[0].cost).all()
    assert curves[0].success[-1] == 1.0
    assert "| –, 5 lost |" in " ".join(control_table(table).markdown().split())


def test_the_picture_has_a_column_for_each_task(reader: Reader, part: Selection) -> None:
    curves = measure_control(reader, part)
    figure = draw_control(curves)
    titles = [axes.get_title() for axes in figure.axes]
    assert [title.split("\n")[0] for title in titles[:2]] == ["pendulum", "quadrotor"]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["D-optimal", "uniform", "random", "true model"]
    caption = caption_control(curves)
    assert "Wilson" in caption
    assert "pendulum: n = 5" in caption
    odd = dataclasses.replace(curves[0], cost=np.full(4, np.nan), cost_low=np.full(4, np.nan))
    draw_control((odd,))


def test_the_true_model_is_the_ceiling_of_success(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/ceiling.db"
    task = {"task": {"name": "control", "checkpoints": [20]}}
    specs = make_grid(("pendulum",), ("d_optimal",), range(3), **SHORT, **task)
    specs += make_grid(("pendulum",), ("random",), range(5), **SHORT, **task)
    policies = ("d_optimal", "random")
    missed = valued("true_model_success", policies, (0, 4), 0, 0.0)
    crashed = overflown("true_model_cost", policies, (4,), 0)
    fill(url, specs, edit=lambda spec, result: crashed(spec, missed(spec, result)))
    with Reader.open(url) as reader:
        curves = measure_control(reader, control_part(select(reader, Filter())))
    truth = curves[0].truth
    assert truth == curves[1].truth
    assert (truth.n, truth.lost) == (5, 1)  # each seed once
    assert truth.success == pytest.approx(3 / 5)
    assert truth.success_low < 3 / 5 < truth.success_high
    assert set(tabulate_control(curves).true_model_success) == {truth.success}
    rates, costs = draw_control(curves).axes
    for axes, height in ((rates, truth.success), (costs, 1.0)):
        flat = [line for line in axes.get_lines() if list(line.get_ydata()) == [height] * 2]
        assert [line.get_linestyle() != "-" for line in flat] == [True]
    assert "dashed: of the same planner with the true model" in caption_control(curves)
    assert "(pendulum 0.60)" in caption_control(curves)


def test_a_grid_without_a_task_has_no_such_figure(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/results.db"
    fill(url, make_grid(("pendulum",), ("d_optimal", "random"), range(2), **SHORT))
    names = ("figure5_control", "comparison_control")
    with Reader.open(url) as reader:
        outcomes = build(
            reader, select(reader, Filter()), PlotOptions(), tmp_path / "figures", names
        )
        states = {outcome.name: outcome.state for outcome in outcomes}
    assert all(states[name] == "not drawn, nothing is stored for it" for name in names)


def test_assessments_as_a_frame(url: str) -> None:
    with analysis.load(url, env="pendulum") as results:
        frame = results.assessments("control_cost", "coverage")
        assert set(frame.measure) == {"control_cost", "coverage"}
        assert len(frame) == 3 * 5 * 4 * 2
        assert frame[frame.measure == "coverage"].groupby("t").value.first().tolist() == [
            0.0,
            pytest.approx(1 / 3),
            pytest.approx(2 / 3),
            1.0,
        ]
        assert set(results.assessments().measure) > set(frame.measure)
    with analysis.load(url, env="cartpole") as results:
        assert results.assessments().empty
