"""The pages show the numbers of the figures and tables, on both databases."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from starlette.testclient import TestClient

from analysis.data.config_matching import Filter
from analysis.data.divergence import DivergenceRule
from analysis.data.trial_selection import select
from analysis.figures.loss_curves.data import Axis, measure_curves, tabulate_curves
from analysis.plot_options import PlotOptions
from analysis.stats.control import control_part, measure_control, tabulate_control
from analysis.stats.trial_scores import Measure
from analysis.tables.registry import comparison
from analysis.tables.summary import summarise
from orchestrate.store import Reader


def test_the_grid_has_the_means_of_the_summary(client: TestClient, reader: Reader) -> None:
    found = client.get("/api/grid").json()
    assert [group["env"] for group in found["environments"]] == ["pendulum", "cartpole"]
    rows = summarise(reader, select(reader, Filter())).to_dict("records")
    cells = {
        (group["env"], one["policy"]): one["configurations"]
        for group in found["environments"]
        for row in group["rows"]
        if row["width"] in (16, None)
        for one in row["cells"]
        if one["configurations"]
    }
    assert len(cells) == len(rows) == 10
    for row in rows:
        (shown,) = cells[row["env"], row["policy"]]
        assert shown["loss"] == row["loss"]
        assert shown["loss_2se"] == row["loss_2se"]
        assert shown["n_used"] == row["n"]
    (diverged,) = cells["cartpole", "random"]
    assert diverged["counts"] == {"done": 3, "diverged": 1}
    (failed,) = cells["pendulum", "periodic"]
    assert failed["counts"] == {"done": 2, "failed": 1, "pending": 1}
    assert (failed["ended"], failed["n"]) == (3, 4)


@pytest.mark.parametrize(("column", "rule"), [("loss", "exclude"), ("reachable_loss", "worst")])
def test_curves_are_those_of_figure_1(
    client: TestClient, reader: Reader, column: str, rule: str
) -> None:
    asked = f"env=cartpole&column={column}&diverged={rule}&x=seconds"
    found = client.get(f"/api/curves?{asked}").json()
    expected = measure_curves(
        reader,
        select(reader, Filter(("cartpole",))),
        column,
        DivergenceRule(rule),
        Axis.SECONDS,
    )
    assert [curve["policy"] for curve in found["curves"]] == [one.policy for one in expected]
    for curve, one in zip(found["curves"], expected, strict=True):
        for name in ("centre", "low", "high"):
            shown = np.array(curve[name], dtype=float)
            np.testing.assert_array_equal(shown, getattr(one.band, name))
        assert curve["count"] == one.sample.describe()
    np.testing.assert_array_equal(found["x"], expected[0].x)
    assert found["missing"][0]["policy"] == "periodic"
    table = pd.read_csv(io.StringIO(client.get(f"/api/curves.csv?{asked}").text))
    pd.testing.assert_frame_equal(table, tabulate_curves(expected), check_dtype=False, rtol=1e-15)


def test_a_width_and_a_condition_choose_other_configurations(client: TestClient) -> None:
    for asked in ("width=4", "where=model.width=4"):
        curves = client.get(f"/api/curves?env=pendulum&{asked}").json()["curves"]
        assert [curve["policy"] for curve in curves] == ["d_optimal", "oracle", "random"]
    refused = client.get("/api/curves?env=pendulum&width=5")
    assert refused.status_code == 400
    assert "fits no stored configuration" in refused.json()["error"]


@pytest.mark.parametrize("measure", list(Measure))
def test_comparisons_are_those_of_the_command(
    client: TestClient, reader: Reader, measure: Measure
) -> None:
    kind, request = comparison("loss", measure), PlotOptions()
    expected = kind.measure(reader, kind.part(select(reader, Filter())), request)
    sheet = kind.render(expected, request)
    found = client.get(f"/api/compare?measure={measure}").json()
    assert found["headers"] == list(sheet.headers)
    assert found["rows"] == [list(row) for row in sheet.rows]
    assert len(found["numbers"]) == len(expected)
    table = pd.read_csv(io.StringIO(client.get(f"/api/compare.csv?measure={measure}").text))
    assert list(table.columns) == list(expected.columns)
    page = client.get(f"/compare?measure={measure}").text
    assert all(str(header) in page for header in sheet.headers)


def test_the_reference_can_be_chosen(client: TestClient, reader: Reader) -> None:
    kind, options = comparison("loss", Measure.FINAL), PlotOptions()
    selection = select(reader, Filter(reference="random"))
    expected = kind.measure(reader, kind.part(selection), options)
    found = client.get("/api/compare?reference=random").json()
    assert [row["ratio"] for row in found["numbers"]] == expected["ratio"].tolist()
    assert {row["reference"] for row in found["numbers"]} == {"random"}
    assert [one["label"] for one in found["variants"]] == expected["variant"].tolist()
    refused = client.get("/api/compare?reference=randon")
    assert refused.status_code == 400
    assert "did you mean 'random'?" in refused.json()["error"]


def test_control_results_are_those_of_figure_5(
    visit: Callable[..., TestClient], variants_grid: str
) -> None:
    client = visit(variants_grid)
    found = client.get("/api/control").json()
    with Reader.open(variants_grid) as reader:
        expected = measure_control(reader, control_part(select(reader, Filter())))
    shown = {
        (one["env"], curve["policy"]): curve
        for one in found["environments"]
        for curve in one["curves"]
    }
    assert list(shown) == [(curve.env, curve.policy) for curve in expected]
    for curve in expected:
        for name in ("t", "n", "success", "success_low", "success_high", "cost", "cost_high"):
            values = np.array(shown[curve.env, curve.policy][name], dtype=float)
            np.testing.assert_array_equal(values, getattr(curve, name))
    table = pd.read_csv(io.StringIO(client.get("/api/control.csv").text))
    pd.testing.assert_frame_equal(table, tabulate_control(expected), check_dtype=False, rtol=1e-15)
    curve = expected[0]
    low, high = curve.success_low[-1], curve.success_high[-1]
    assert f"{curve.success[-1]:.2f} [{low:.2f}, {high:.2f}]" in client.get("/control").text


def test_a_database_without_a_task_says_how_to_get_control_results(client: TestClient) -> None:
    assert "task=control" in client.get("/control").text
    assert client.get("/api/control").json()["environments"] == []
    refused = client.get("/api/control.csv")
    assert refused.status_code == 400
    assert "task=control" in refused.json()["error"]


def test_a_trial_shows_what_is_stored(client: TestClient, reader: Reader) -> None:
    (config,) = [c for c in reader.configs() if (c.env, c.policy) == ("cartpole", "d_optimal")]
    row = reader.trials(config.config_key)[1]
    found = client.get(f"/api/trials/{row.trial_key}").json()
    assert found["trial"]["final_loss"] == row.final_loss
    assert found["config"]["model.width"] == 16
    assert [one["outcome"] for one in found["attempts"]] == ["done"]
    assert found["launches"][0]["host"] == "h"
    arrays = client.get(f"/api/trials/{row.trial_key}/arrays").json()
    losses = reader.curves(config.config_key).values
    assert arrays["loss"] == losses[1].tolist()
    trajectory = reader.trajectory(config.config_key, row.seed)
    assert arrays["inputs"][0]["values"] == trajectory.inputs[:, 0].tolist()
    frequency, density = (np.array(arrays["spectrum"][key]) for key in ("frequency", "density"))
    assert len(frequency) == len(density) == 19
    assert 0.4 < arrays["spectrum"]["eigenfrequency"] < 0.7
    assert len(arrays["phase"]["x"]) >= 41


def test_a_trial_names_its_unusual_settings(
    visit: Callable[..., TestClient], variants_grid: str
) -> None:
    client = visit(variants_grid)
    rows = client.get("/api/trials?policy=random&env=pendulum&seed=0").json()["rows"]
    (wide,) = (row for row in rows if row["gamma"] == 3.0)
    assert "random, γ=3, horizon 40" in client.get(f"/trials/{wide['trial_key']}").text


def test_a_failed_trial_shows_its_traceback_as_text(client: TestClient) -> None:
    (row,) = client.get("/api/trials?status=failed").json()["rows"]
    page = client.get(f"/trials/{row['trial_key']}").text
    assert "&lt;script&gt;alert" in page
    assert "<script>alert" not in page
    assert "the &lt;b&gt;input&lt;/b&gt; is wrong" in page
    assert client.get(f"/api/trials/{row['trial_key']}/arrays").status_code == 404


def test_the_token_changes_with_the_grid_alone(client: TestClient) -> None:
    first, second = (client.get("/api/grid").json()["progress"] for _ in range(2))
    assert first == second
    assert first["counts"] == {"diverged": 1, "done": 43, "failed": 1, "pending": 3}
    assert (first["ended"], first["total"]) == (45, 48)
