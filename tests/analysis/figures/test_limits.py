"""Figure 9: which configurations are a row, what their numbers are, and what is drawn."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.cli import main
from analysis.data.matching import Filter
from analysis.data.selection import select
from analysis.figures.limits import (
    MOST_SEEDS,
    Panel,
    Panels,
    caption,
    draw,
    limits_part,
    measure_panels,
    rows_of,
    share_text,
    tabulate_panels,
    view,
)
from orchestrate.store import Reader
from tests.analysis.conftest import SHORT, limited
from tests.analysis.synthetic import fill, make_grid

GAUSS_NEWTON = {"learner": {"name": "gauss_newton"}}
OF_INPUT = {"bounds": {"u": [-1.0, 1.0]}}
ONE_SIDED = {"bounds": {"φ₁": [None, 0.2], "φ₂": [-3.0, 3.0]}}
SEEDS = range(MOST_SEEDS + 2)


@pytest.fixture(scope="module")
def railed(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a cartpole on a rail, two learners, one diverged trial; an arm with one bound."""
    address = f"sqlite:///{tmp_path_factory.mktemp('limits')}/results.db"
    specs = limited(("d_optimal", "random"), SEEDS)
    specs += limited(("d_optimal",), range(3), **GAUSS_NEWTON)
    specs += make_grid(("cartpole", "arm"), ("d_optimal",), range(2), **SHORT)
    specs += make_grid(("pendulum",), ("d_optimal",), range(2), limits=OF_INPUT, **SHORT)
    specs += make_grid(("arm",), ("d_optimal",), range(2), limits=ONE_SIDED, **SHORT)
    fill(address, specs, diverged={specs[1].trial_key: 20})
    return address


def measured(url: str) -> Panels:
    with Reader.open(url) as reader:
        return measure_panels(reader, limits_part(select(reader, Filter())))


def test_rows_are_bounded_states_of_configurations_that_differ_in_enforced(railed: str) -> None:
    rows = rows_of(measured(railed))
    assert [(row[0].env, row[0].label, row[0].state) for row in rows] == [
        ("cartpole", "D-optimal, limits", "y [m]"),
        ("cartpole", "gauss_newton, limits", "y [m]"),
        ("arm", "D-optimal, limits", "φ₁ [rad]"),
        ("arm", "D-optimal, limits", "φ₂ [rad]"),
    ]
    assert [[panel.enforced for panel in row] for row in rows] == [
        *[[False, True]] * 2,
        [True],
        [True],
    ]
    assert {panel.policy for row in rows for panel in row} == {"d_optimal"}


def test_lines_are_the_states_of_the_first_seeds(railed: str) -> None:
    counted, enforced, *_ = measured(railed)
    assert counted.seeds == enforced.seeds == tuple(range(MOST_SEEDS))
    assert counted.lines.shape == (MOST_SEEDS, 61)
    assert counted.time[[0, -1]].tolist() == pytest.approx([0.0, 60 * 0.02])
    with Reader.open(railed) as reader:
        [entry] = [
            one
            for one in limits_part(select(reader, Filter(("cartpole",)))).entries
            if one.config.learner == "adam_window" and one.config.config["limits"]["enforced"]
        ]
        states = reader.trajectory(entry.config.config_key, 3).states
    assert enforced.lines[3].tolist() == states[:, 0].tolist()
    assert np.isnan(counted.lines[1, 21:]).all()  # it diverged


def test_shares_are_those_of_all_trials(railed: str) -> None:
    counted, enforced, *_ = measured(railed)
    assert (counted.n, counted.n_diverged) == (len(SEEDS), 1)
    assert (enforced.n, enforced.n_diverged) == (len(SEEDS), 0)
    with Reader.open(railed) as reader:
        [entry] = [
            one
            for one in limits_part(select(reader, Filter(("cartpole",)))).entries
            if one.config.learner == "adam_window" and not one.config.config["limits"]["enforced"]
        ]
        own = [reader.trajectory(entry.config.config_key, seed).states[1:, 0] for seed in SEEDS]
    own[1] = own[1][:20]
    shares = [np.mean(np.abs(states) > 0.5) for states in own]
    assert counted.share == pytest.approx(np.mean(shares))
    assert counted.share_error == pytest.approx(np.std(shares, ddof=1) / np.sqrt(len(shares)))
    assert f"(n = {len(SEEDS)}, 1 diverged)" in share_text(counted)
    assert share_text(replace(counted, n=0)).startswith("share unknown")


def test_the_figure_has_a_panel_for_each_and_dashed_bounds(railed: str) -> None:
    panels = measured(railed)
    axes = draw(panels).axes
    assert len(axes) == 4 * 2
    assert [len(one.lines) for one in axes] == [22, 22, 5, 5, 0, 3, 0, 4]
    assert axes[0].get_ylim() == axes[1].get_ylim()
    assert axes[0].get_title().startswith("cartpole: D-optimal, limits\ncounted only: ")
    words = caption(panels)
    assert "cartpole, D-optimal, limits: 0-19" in words
    assert words.count("arm, D-optimal, limits: 0-1") == 1
    table = tabulate_panels(panels)
    assert len(table) == 6 * 61
    assert table[~table["enforced"]]["seed_3"].iloc[:61].tolist() == panels[0].lines[3].tolist()
    alone = tuple(panel for panel in panels if panel.enforced)
    assert len(draw(alone).axes) == 4
    assert "on the left" in words
    assert "; limits are enforced." in caption(alone)


def panel(bounds: tuple[float, float], *states: float) -> Panel:
    lines, time = np.array([states]), np.arange(len(states)) * 0.1
    return Panel(
        "cartpole", "d_optimal", "D-optimal", "y [m]", False, time, lines, (0,), np.array(bounds),
        0.0, 0.0, 1, 0,
    )  # fmt: skip


def test_the_axis_shows_what_is_near_the_bounds() -> None:
    margin = 1.04
    for row, low, high in (
        ([panel((-2.0, 2.0), 0.0, 1.0)], -2.0, 2.0),
        ([panel((-2.0, 2.0), 0.0, 3.0, math.nan)], -2.0, 3.0),
        ([panel((-2.0, 2.0), 0.0, 1e6), panel((-2.0, 2.0), 0.0, -1e6)], -6.0, 6.0),
        ([panel((-math.inf, 2.0), 1.0, -1e6)], -2.0, 2.0),
        ([panel((0.0, math.inf), 0.0, 5.0)], 0.0, 5.0),
        ([panel((-2.0, 2.0), math.nan)], -2.0, 2.0),
    ):
        bottom, top = view(row)
        assert bottom == pytest.approx(low - (margin - 1) * (high - low))
        assert top == pytest.approx(high + (margin - 1) * (high - low))


def test_without_limits_of_states_nothing_is_drawn(reader: Reader, tmp_path: Path) -> None:
    assert limits_part(select(reader, Filter())).entries == ()
    address = f"sqlite:///{tmp_path}/inputs.db"
    fill(address, make_grid(("pendulum",), ("d_optimal",), range(2), limits=OF_INPUT, **SHORT))
    with Reader.open(address) as opened:
        assert limits_part(select(opened, Filter())).entries == ()


def test_trials_with_limits_alone_are_shown_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    address = f"sqlite:///{tmp_path}/limits.db"
    fill(address, limited(("d_optimal", "random"), range(3)))
    assert main(["summary", "--db", address, "--format", "csv"]) == 0
    shown = capsys.readouterr()
    assert "D-optimal, limits" in shown.out
    assert "enforced" not in shown.out
    assert "cartpole: these trials have limits, y=[-0.5, 0.5]\n" in shown.err
    assert main(["summary", "--db", address, "--where", "limits.enforced=false"]) == 0
    assert "random, limits, enforced=False" in capsys.readouterr().out
    fill(address, make_grid(("cartpole",), ("d_optimal", "random", "oracle"), range(3), **SHORT))
    assert main(["summary", "--db", address]) == 0
    shown = capsys.readouterr()
    assert "limits" not in shown.out
    assert "| oracle" in shown.out
    assert "4 other stored configurations" in shown.err
