"""Floor and error budget: numbers recomputed from their definition, files, filters, refusals."""

from __future__ import annotations

import csv
import io
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from analysis.cli import main
from analysis.figures.error_budget import plot
from analysis.figures.error_budget.data import PARTS, budgets, tabulate
from analysis.stats.geometric_means import geometric_mean
from dopt.offline_fit import fit_offline
from dopt.samples import recorded_samples, uniform_samples
from dopt.spec.trial import TrialSpec
from orchestrate.store import Reader
from tests.analysis.synthetic import fill, make_grid
from tests.close import assert_close
from tests.paths import EXAMPLE

SMALL = {"env": {"horizon": 40}, "model": {"width": 3}}
PROCESS: dict[str, dict[str, object]] = {
    "model": {"name": "gaussian_process"},
    "learner": {"name": "conditioning"},
}


def process(system: str, seed: int) -> TrialSpec:
    """Return a trial whose model has no offline fit."""
    env = {"name": system, "horizon": 40}
    sections = {"env": env, "policy": {"name": "gaussian_process"}, **PROCESS}
    return TrialSpec.from_mapping({**sections, "seed": seed})


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a grid of two systems and policies, one trial of which diverged."""
    address = f"sqlite:///{tmp_path_factory.mktemp('floor')}/results.db"
    specs = make_grid(("pendulum", "arm"), ("d_optimal", "random"), range(3), **SMALL)
    specs += [process(env, seed) for env in ("pendulum", "arm") for seed in range(3)]
    lost = [s for s in specs if (s.system.name, s.policy.name, s.seed) == ("arm", "random", 1)]
    fill(address, specs, diverged={lost[0].trial_key: 20})
    return address


def table(capsys: pytest.CaptureFixture[str], *arguments: str) -> list[dict[str, str]]:
    assert main(["floor", "--format", "csv", "--workers", "1", *arguments]) == 0
    return list(csv.DictReader(io.StringIO(capsys.readouterr().out)))


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["floor", *arguments]) == 2
    return capsys.readouterr().err


@pytest.fixture(scope="module")
def folder(small: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("out")
    assert main(["floor", "--db", small, "--out", str(target), "--workers", "2"]) == 0
    return target


def test_the_numbers_are_those_of_their_definition(small: str, folder: Path) -> None:
    trials = pd.read_csv(folder / "error_budget_trials.csv")
    assert len(trials) == 11
    with Reader.open(small) as reader:
        keys = {
            (one.env, one.policy): (one.config_key, dict(one.config)) for one in reader.configs()
        }
        for row in trials.to_dict("records")[::4]:
            key, config = keys[row["env"], row["policy"]]
            config = {name: value for name, value in config.items() if "version" not in name}
            spec = TrialSpec.from_mapping({**config, "seed": row["seed"]})
            stored = reader.trajectory(key, row["seed"])
            uniform = uniform_samples(spec)
            recorded = recorded_samples(spec.system, stored.states, stored.inputs)
            for name, one in (("floor", uniform), ("offline", recorded)):
                fitted = fit_offline(spec, one.states, one.accelerations)
                assert_close(row[name], fitted.loss, rel=1e-12)
            online = {trial.seed: trial.final_loss for trial in reader.trials(key)}
            assert row["online"] == online[row["seed"]]


def test_policies_share_the_floor_and_the_factors_multiply(folder: Path) -> None:
    trials = pd.read_csv(folder / "error_budget_trials.csv")
    assert (trials.groupby(["env", "seed"])["floor"].nunique() == 1).all()
    drawn = pd.read_csv(folder / "error_budget.csv")
    for rows in (trials, drawn):
        product = rows["floor"] * rows["exploration_factor"]
        np.testing.assert_allclose(product, rows["offline"], rtol=1e-12)
        np.testing.assert_allclose(product * rows["learner_factor"], rows["online"], rtol=1e-12)
    for (env, policy), rows in trials.groupby(["env", "policy"]):
        [row] = drawn[(drawn["env"] == env) & (drawn["policy"] == policy)].to_dict("records")
        assert row["n"] == len(rows) == (2 if (env, policy) == ("arm", "random") else 3)
        for name in PARTS:
            assert_close(row[name], float(np.exp(np.log(rows[name]).mean())), rel=1e-12)
            assert row[f"{name}_low"] <= row[name] <= row[f"{name}_high"]


def test_it_leaves_a_picture_with_its_numbers_caption_and_origin(folder: Path) -> None:
    assert (folder / "error_budget.png").read_bytes().startswith(b"\x89PNG")
    assert b"/Type3" not in (folder / "error_budget.pdf").read_bytes()
    words = (folder / "error_budget.txt").read_text()
    assert "a ridge of 0.0001" in words
    assert "arm: n = 3; random, width 3: 2" in words
    facts = json.loads((folder / "error_budget.json").read_text())
    assert facts["request"] == {"ridge": 1e-4}
    assert facts["fingerprint"].encode() in (folder / "error_budget.svg").read_bytes()
    assert "no offline fit" in " ".join(facts["notes"])


def test_a_request_is_narrowed_as_elsewhere(
    small: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["--db", small, "--out", str(tmp_path), "--env", "pendulum"]
    rows = table(capsys, *given, "--policy", "random", "--where", "model.width=3", "--ridge", "0.1")
    assert [(row["env"], row["policy"]) for row in rows] == [("pendulum", "random")]
    grouped = table(capsys, *given, "--group-by", "policy", "width")
    assert [row["label"] for row in grouped] == ["D-optimal, width 3", "random, width 3"]
    assert main(["floor", *given, "--policy", "d_optimal"]) == 0
    assert "| pendulum | D-optimal |" in capsys.readouterr().out


def test_bad_requests_get_a_sentence(
    small: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["--db", small, "--out", str(tmp_path), "--env", "pendulum"]
    assert "--workers is 0, but at least 1" in refused(capsys, *given, "--workers", "0")
    assert "ridge is 0.0, but a number above 0" in refused(capsys, *given, "--ridge", "0")
    alone = refused(capsys, *given, "--policy", "gaussian_process")
    assert "model with an offline fit, they have gaussian_process" in alone
    assert not list(tmp_path.iterdir())


def test_trials_that_all_diverged_have_no_budget(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    address = f"sqlite:///{tmp_path}/results.db"
    specs = make_grid(("pendulum",), ("random",), range(2), **SMALL)
    fill(address, specs, diverged={spec.trial_key: 9 for spec in specs})
    assert "Every selected trial diverged" in refused(
        capsys, "--db", address, "--allow-partial", "--out", str(tmp_path)
    )


@pytest.fixture
def _own_classes(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    yield
    sys.modules.pop("vehicle", None)


@pytest.mark.usefixtures("_own_classes")
def test_a_system_of_ones_own_has_a_floor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    address = f"sqlite:///{tmp_path}/results.db"
    sections: dict[str, Any] = {
        "env": {"_target_": "vehicle.Boat", "horizon": 40},
        "policy": {"name": "random"},
        "model": {"name": "mlp", "width": 3},
        "learner": {"name": "adam_window"},
    }
    fill(address, [TrialSpec.from_mapping({**sections, "seed": seed}) for seed in range(2)])
    [row] = table(capsys, "--db", address, "--out", str(tmp_path / "out"))
    assert row["env"] == "boat"
    assert 0 < float(row["floor"]) < float(row["offline"])


def losses(**changes: float) -> pd.DataFrame:
    """Return made-up losses of three trials of one configuration."""
    rows = []
    for seed in range(3):
        parts = {"floor": 0.1 * (seed + 1), "offline": 0.5, "online": 0.4, **changes}
        parts["exploration_factor"] = parts["offline"] / parts["floor"]
        parts["learner_factor"] = parts["online"] / parts["offline"]
        known = {"env": "arm", "policy": "random", "label": "random", "seed": seed}
        rows.append({**known, **parts, "floor_converged": True, "offline_converged": seed > 0})
    return pd.DataFrame(rows)


def test_a_learner_that_is_better_than_the_offline_fit_is_drawn_to_the_left() -> None:
    found = budgets(losses())
    assert found[0].learner_factor.value == pytest.approx(0.8)
    assert found[0].n_unconverged == 1
    figure = plot.draw(found, {"arm": "rad/s²"})
    assert isinstance(figure, Figure)
    xs = [line.get_xdata() for line in figure.axes[0].lines]
    assert any(np.allclose(x, (0.5, 0.4)) for x in xs if len(x) == 2)
    assert "Trials of which a fit did not converge: 1." in plot.caption(found, 1e-4)


def test_a_loss_of_zero_has_no_geometric_mean() -> None:
    assert np.isnan(geometric_mean(np.array([1.0, 0.0])).value)
    assert np.isnan(geometric_mean(np.array([2.0])).low)
    assert geometric_mean(np.array([2.0, 8.0])).value == pytest.approx(4.0)
    assert len(tabulate(budgets(losses()))) == 1
