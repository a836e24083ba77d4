"""Fits in a results database: what is stored, pages, commands, merges, and what leaves them out."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

import analysis
import dopt
from analysis import cli
from analysis.data.matching import Filter
from analysis.data.selection import select
from analysis.serve.app import create_app
from dopt.fitting.fitted import Fitted
from dopt.systems.plant import Plant
from orchestrate.__main__ import main
from orchestrate.store import Reader, StoreError
from orchestrate.store.maintenance import examine
from orchestrate.store.merge import merge
from tests.analysis.synthetic import fill, make_grid
from tests.dopt.fitting.test_fit import declared, run

pytestmark = pytest.mark.xdist_group("stored fits")  # the fits are made once for all of them
ROWS = 420


def fit(seed: int = 0, **options: Any) -> Fitted:
    options = {"width": 0, "window": 0.3} | options
    return dopt.fit(declared(), run(seed, ROWS), **options)


@pytest.fixture(scope="module")
def found() -> Fitted:
    return fit()


def rows(url: str, sql: str) -> list[tuple[Any, ...]]:
    with Reader.open(url) as reader:
        return [tuple(row) for row in reader.rows(sql)]


def stored(url: str) -> list[list[tuple[Any, ...]]]:
    """Return what a database holds, except attempts and times."""
    return [
        rows(url, "SELECT trial_key, label, status, n_steps, final_loss FROM v_trial ORDER BY 1"),
        rows(url, "SELECT config_key, t, loss FROM v_curve ORDER BY 1, 2"),
        rows(url, "SELECT trial_key, t, measure, value FROM v_assessment ORDER BY 1, 2, 3"),
    ]


def test_numbers_states_and_declaration_are_stored(url: str, found: Fitted) -> None:
    key = found.store(url)
    assessed = rows(url, "SELECT t, measure, value FROM v_assessment")
    values = {(t, name): value for t, name, value in assessed}
    with Reader.open(url) as reader:
        [trial] = reader.rows("SELECT * FROM v_trial")
        [config] = reader.configs()
        path = reader.trajectory(trial.config_key, 0)
        losses = [row.loss for row in reader.rows("SELECT loss FROM v_curve ORDER BY t")]
    n = trial.n_steps
    assert (trial.trial_key, trial.status, trial.policy) == (key, "done", "recorded")
    assert (trial.model, trial.learner, trial.width) == ("constants", "simulation_error", None)
    assert trial.dt == pytest.approx(0.02)
    assert trial.wall_seconds == found.selection.seconds > 0.0
    for name, (value, error) in found.constants.items():
        assert values[n, f"constant.{name}"] == pytest.approx(value, rel=1e-12)
        assert values[n, f"error.{name}"] == pytest.approx(error, rel=1e-12)
    for row in found.errors():
        t = round(row["horizon"] / 0.02)
        kind = {"model": "rms", "physics alone": "physics", "linear": "linear"}[row["model"]]
        assert values[t, f"{kind}.angle"] == pytest.approx(row["rms"], rel=1e-12)
        assert values[t, "unchanged.angle"] == pytest.approx(row["nothing_changes"], rel=1e-12)
    assert values[n, "useful"] == found.useful() > 0.0
    assert values[n, "window"] == found.selection.window
    assert config.config["env"]["constants"]["gain"] == {"value": 20.0, "factor": 2.0}
    assert set(config.config["logs"]) == {"fitted", "validation"}
    assert path.states.shape == (n + 1, 2)
    assert path.inputs.shape == (n, 1)
    assert np.array_equal(path.parameters, found.chosen.solution.p)
    assert np.sqrt(np.mean(np.square(losses))) == pytest.approx(1.0, abs=0.5)


@pytest.fixture(scope="module")
def others() -> list[Fitted]:
    """Return fits that differ from the usual one in their log, options, or validation."""
    validate = {"validate": run(1, ROWS)}
    options: list[dict[str, Any]] = [{"seed": 1}, {"window": 0.4}, {"hold": "linear"}, validate]
    return [fit(**one) for one in [*options, {"width": 2, "weights": (10.0,)}]]


def test_a_fit_has_one_row_and_another_its_own(
    url: str, found: Fitted, others: list[Fitted]
) -> None:
    key = found.store(url)
    before = stored(url)
    assert found.store(url) == key
    assert stored(url) == before
    assert rows(url, "SELECT count(*), max(attempt) FROM attempt") == [(2, 2)]
    assert len({key, fit().store(url), *(other.store(url) for other in others)}) == 6
    assert rows(url, "SELECT count(*) FROM trial") == [(6,)]
    assert not examine(url)
    with pytest.raises(StoreError, match=r"write it as sqlite:///results\.db"):
        found.store("results.db")


def test_a_fit_with_a_network_has_its_seed_and_one_without_has_none(url: str) -> None:
    dragged, how = run(0, ROWS, drag=0.4), {"window": 0.3, "weights": (10.0,)}
    for seed, width in ((5, 4), (6, 4), (7, 0)):
        found = dopt.fit(declared(), dragged, width=width, seed=seed, **how)  # type: ignore[arg-type]  # of several types
        assert found.has_network == bool(width)
        found.store(url)
    assert sorted(rows(url, "SELECT seed FROM trial")) == [(0,), (5,), (6,)]


def test_measurements_that_were_left_out_are_stored_and_saved(url: str, tmp_path: Any) -> None:
    table = run(0, ROWS)
    table.loc[[60, 61, 200], "angle"] += 9.0
    found = dopt.fit(declared(), [table, run(1, ROWS)], width=0, window=0.3)
    found.store(url)
    [(value,)] = rows(url, "SELECT value FROM v_assessment WHERE measure = 'outliers.angle'")
    assert value == 3.0
    found.save(tmp_path / "model.npz")
    assert "3 outliers of angle left out" in str(np.load(tmp_path / "model.npz")["report"])


def test_pages_commands_and_merges_know_it(
    url: str, found: Fitted, tmp_path: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    key = found.store(url)
    with TestClient(create_app(url), base_url="http://127.0.0.1:8000") as client:
        for page in ("/", "/trials", "/curves"):
            assert client.get(page).status_code == 200, page
        assert f'href="/trials/{key}"' in client.get("/").text
        page = client.get(f"/trials/{key}").text
        arrays = client.get(f"/api/trials/{key}/arrays").json()
    for said in ("Errors against the time ahead", "<dt>gain</dt>", "nothing changes", "useful"):
        assert said in page, said
    value, error = found.constants["gain"]
    assert arrays["fit"]["constants"]["gain"] == pytest.approx([value, error])
    assert [row["seconds"] for row in arrays["fit"]["errors"]] == pytest.approx(
        sorted({row["horizon"] for row in found.errors()}), abs=0.011
    )
    assert arrays["phase"]["labels"] == ["angle [rad]", "rate [rad/s]"]
    for words in (["status"], ["show"], ["export", "trials", "--out", f"{tmp_path}/trials.csv"]):
        assert main([*words, "--db", url]) == 0
    assert "recorded" in capsys.readouterr().out
    target = f"sqlite:///{tmp_path}/target.db"
    assert merge(target, url).added == {"done": 1}
    assert stored(target) == stored(url)
    assert merge(target, url).identical == 1
    assert main(["prune", "--policy", "recorded", "--yes", "--db", url]) == 0
    assert rows(url, "SELECT count(*) FROM assessment") == [(0,)]


def test_figures_and_tables_leave_it_out(
    sqlite_url: str, found: Fitted, tmp_path: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    fill(sqlite_url, make_grid(("pendulum",), ("d_optimal", "random"), seeds=range(2)))

    def said(*words: str) -> str:
        assert cli.main([*words, "--db", sqlite_url]) == 0
        return capsys.readouterr().out

    before = [said("summary"), said("compare")]
    found.store(sqlite_url)
    assert [said("summary"), said("compare")] == before
    said("figures", "--only", "figure1", "--out", str(tmp_path / "figures"))
    with Reader.open(sqlite_url) as reader:
        selection = select(reader, Filter())
    assert {entry.config.env for entry in selection.entries} == {"pendulum"}
    with analysis.load(sqlite_url) as results:
        assert set(results.curves().env) == {"pendulum"}


def test_a_declaration_with_a_guess_of_zero_is_read_back() -> None:
    plant = declared()
    section = plant.system(5).to_section()
    assert Plant.from_section(json.loads(json.dumps(section))).plant.constants == plant.constants
