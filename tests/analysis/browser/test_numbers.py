"""The pages show the numbers of the figures and tables, on both databases."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from starlette.testclient import TestClient

from analysis.data.matching import Filter
from analysis.data.samples import DivergenceRule
from analysis.data.selection import select
from analysis.stats.curves import Axis, measure_curves, tabulate_curves
from analysis.tables.comparisons import summarise
from orchestrate.store import Reader


def test_the_grid_has_the_means_of_the_summary(client: TestClient, reader: Reader) -> None:
    found = client.get("/api/grid").json()
    assert [group["env"] for group in found["environments"]] == ["pendulum", "cartpole"]
    rows = summarise(reader, select(reader, Filter())).to_dict("records")
    cells = {
        (group["env"], one["configurations"][0]["policy"]): one["configurations"]
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
        for key, name in (("values", "centre"), ("low", "low"), ("high", "high")):
            shown = np.array(curve[key], dtype=float)
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
    (wide,) = (row for row in rows if "γ=3" in row["label"])
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
