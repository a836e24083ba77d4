from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from analysis.data.matching import Filter
from analysis.data.samples import DivergenceRule
from analysis.data.selection import Selection, select
from analysis.figures.width import (
    exponent,
    measure_costs,
    measure_losses,
    tabulate_costs,
    tabulate_losses,
    width_part,
)
from analysis.outputs import build
from analysis.stats.curves import PlotOptions
from dopt.spec.trial import TrialSpec
from orchestrate.store import Reader
from tests.analysis.conftest import SHORT, wide
from tests.analysis.synthetic import fill, make_grid


def reader_of(folder: Path, *fillings: tuple[list[TrialSpec], list[TrialSpec]]) -> Reader:
    address = f"sqlite:///{folder}/results.db"
    for specs, skipped in fillings:
        fill(address, specs, skipped=skipped)
    return Reader.open(address)


def widths_of(selection: Selection) -> list[int | None]:
    return [entry.config.width for entry in selection.entries]


def test_other_widths_leave_the_selection_of_the_other_figures_alone(reader: Reader) -> None:
    selection = select(reader, Filter())
    assert selection.gaps == ()
    assert {entry.config.width for entry in selection.of("cartpole")} == {16, None}
    assert len(selection.of("cartpole")) == 5


@pytest.mark.parametrize("seeds", [3, 5, 9])
def test_however_many_trials_another_width_has(tmp_path: Path, seeds: int) -> None:
    grid = make_grid(("cartpole",), ("d_optimal", "random", "oracle"), range(5), **SHORT)
    extra = wide(64, range(seeds)) + wide(16, range(seeds), learner={"name": "adam"})
    extra += wide(16, range(seeds), policy={"regularization": 0.5})[: min(seeds, 5)]
    with reader_of(tmp_path, (grid + extra, [])) as reader:
        selection = select(reader, Filter())
    assert selection.gaps == ()
    assert {entry.config.config_key for entry in selection.entries} == {s.config_key for s in grid}


def test_a_database_of_widths_alone_takes_the_width_of_the_paper(tmp_path: Path) -> None:
    specs = [spec for width in (8, 16, 32) for spec in wide(width, range(3))]
    with reader_of(tmp_path, (specs, [])) as reader:
        selection = select(reader, Filter())
    assert widths_of(selection) == [16]
    assert widths_of(width_part(selection)) == [8, 16, 32]


def test_all_widths_are_taken_and_the_condition_of_the_user_holds(reader: Reader) -> None:
    assert widths_of(width_part(select(reader, Filter()))) == [4, 8, 16, 32, 64]
    narrowed = select(reader, Filter(where={"model.width": 16}))
    assert width_part(narrowed).entries == ()
    assert width_part(select(reader, Filter(("pendulum",)))).entries == ()


def test_two_widths_are_too_few_and_that_is_said(tmp_path: Path) -> None:
    with reader_of(tmp_path, (wide(8, range(2)) + wide(16, range(2)), [])) as reader:
        names = ("figure4_width", "figure4_width_loss")
        outcomes = list(build(reader, select(reader, Filter()), PlotOptions(), tmp_path, names))
    assert {one.state for one in outcomes} == {"not drawn, nothing is stored for it"}


def test_costs_are_medians_over_steps_and_trials(reader: Reader) -> None:
    part = width_part(select(reader, Filter()))
    numbers = measure_costs(reader, part)
    assert [cost.part for cost in numbers.costs] == ["plan", "learn", "evaluate"]
    assert numbers.limit_us == pytest.approx(20_000)
    plan = numbers.costs[0]
    values = reader.curves(part.entries[0].config.config_key, "plan_us").values
    assert plan.median[0] == np.median(values)
    assert (plan.low[0], plan.high[0]) == tuple(np.quantile(values, [0.1, 0.9]))
    assert plan.n.tolist() == [5] * 5
    assert plan.exponent == pytest.approx(2.0, abs=0.2)
    table = tabulate_costs(numbers)
    assert len(table) == 15
    assert table.query("part == 'plan'")["median_us"].tolist() == plan.median.tolist()


def test_a_diverged_trial_counts_in_neither(tmp_path: Path) -> None:
    specs = [spec for width in (8, 16, 32) for spec in wide(width, range(4))]
    address = f"sqlite:///{tmp_path}/results.db"
    fill(address, specs, diverged={specs[1].trial_key: 20})
    with Reader.open(address) as reader:
        part = width_part(select(reader, Filter()))
        costs = measure_costs(reader, part)
        losses = measure_losses(reader, part, DivergenceRule.EXCLUDE)
    assert costs.costs[0].n.tolist() == [3, 4, 4]
    assert losses.n == (3, 4, 4)
    assert losses.counts == ("3/4, 1 diverged", "4", "4")


def test_losses_have_two_standard_errors(reader: Reader) -> None:
    part = width_part(select(reader, Filter()))
    numbers = measure_losses(reader, part, DivergenceRule.EXCLUDE)
    finals = reader.curves(part.entries[2].config.config_key).values[:, -1]
    assert numbers.mean[2] == pytest.approx(finals.mean())
    table = tabulate_losses(numbers)
    assert table["width"].tolist() == [4, 8, 16, 32, 64]
    assert table["two_standard_errors"][2] == pytest.approx(2 * finals.std(ddof=1) / 5**0.5)


def test_unfinished_trials_are_noted(tmp_path: Path) -> None:
    specs = [spec for width in (8, 16, 32) for spec in wide(width, range(3))]
    with reader_of(tmp_path, (specs, specs[-1:])) as reader:
        part = width_part(select(reader, Filter()))
    assert part.notes == ("cartpole, width 32: 1 trials are not finished",)


def test_other_forms_of_the_information_matrix_are_lines_of_their_own(tmp_path: Path) -> None:
    widths = (8, 16, 32)
    usual = [spec for width in widths for spec in wide(width, range(3))]
    dual = [s for width in widths for s in wide(width, range(3), policy={"form": "dual"})]
    other = [s for width in widths for s in wide(width, range(3), policy={"regularization": 0.5})]
    with reader_of(tmp_path, (dual + other + usual, [])) as reader:
        part = width_part(select(reader, Filter()))
        costs = measure_costs(reader, part).costs
        losses = measure_losses(reader, part, DivergenceRule.EXCLUDE)
    assert [(cost.form, cost.part) for cost in costs] == [
        ("auto", "plan"),
        ("auto", "learn"),
        ("auto", "evaluate"),
        ("dual", "plan"),
    ]
    assert losses.widths.tolist() == list(widths)


def test_the_exponent_is_that_of_the_upper_half() -> None:
    widths = np.array([8, 16, 32, 64, 128, 256])
    assert exponent(widths, 3.0 * widths**1.5) == pytest.approx(1.5)
    costs = np.where(widths < 64, 7.0, widths.astype(float) ** 2)
    assert exponent(widths, costs) == pytest.approx(2.0)
    assert exponent(widths[:3], widths[:3]) == pytest.approx(1.0)
