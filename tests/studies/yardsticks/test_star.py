"""The table of the moving star: against its definition, files, refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from dopt.spec.trial import TrialSpec
from studies.yardsticks.__main__ import main
from studies.yardsticks.star import CENTRE
from tests.analysis.synthetic import fill, simulated
from tests.dopt.trials import trial

BOX = {"name": "grey_box", "unknown": list(CENTRE), "initial": [0.1, 0.1]}


def star(policy: str, seed: int, rate: float = 0.02, **env: Any) -> TrialSpec:
    learner = {"name": "adam", "learning_rate": rate}
    fields = {"horizon": 12, **env}
    return trial("moving_star", policy, seed, env=fields, model=BOX, learner=learner)


SPECS = [star(*each) for each in (("random", 0), ("random", 1), ("exact", 0), ("exact", 1))]
SPECS += [star("random", seed, 0.01) for seed in (0, 1)]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> str:
    address = f"sqlite:///{tmp_path_factory.mktemp('star')}/results.db"
    fill(address, SPECS, edit=simulated)
    return address


def test_errors_are_half_the_squared_distances_to_the_star_at_the_last_step(
    small: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--db", small, "--out", str(tmp_path)]) == 0
    table = pd.read_csv(tmp_path / "flex_star_trials.csv").set_index(["learner", "policy", "seed"])
    assert len(table) == len(SPECS)
    for spec in SPECS:
        rate = spec.learner.learning_rate
        angle = 2 * np.pi * 11 / 1000
        theta = simulated(spec, None).parameters  # type: ignore[arg-type]
        assert 0.0 < table.apart[(f"adam, rate {rate:g}", spec.policy.name, spec.seed)] < 0.3
        distance = np.hypot(*(theta - 0.9 * np.array([np.cos(angle), np.sin(angle)])))
        row = table.loc[(f"adam, rate {rate:g}", spec.policy.name, spec.seed)]
        assert row.error == pytest.approx(0.5 * distance**2, rel=1e-9)
    shown = capsys.readouterr().out
    assert "published: FLEX" in shown
    assert "adam, rate 0.01" in shown


def test_medians_counts_and_ratios_are_those_of_the_trials(small: str, tmp_path: Path) -> None:
    main(["--db", small, "--out", str(tmp_path)])
    trials = pd.read_csv(tmp_path / "flex_star_trials.csv")
    table = pd.read_csv(tmp_path / "flex_star.csv").set_index(["learner", "policy"])
    by_seed = trials.pivot_table(index="seed", columns=["learner", "policy"], values="error")
    assert (table["median"] == by_seed.median().reindex(table.index)).all()
    assert (table.lost == (by_seed > 0.5).sum().reindex(table.index)).all()
    learner = "adam, rate 0.02"
    logs = np.log(by_seed[learner, "exact"] / by_seed[learner, "random"])
    assert table.ratio[learner, "exact"] == pytest.approx(np.exp(logs.mean()))


def test_two_kinds_of_one_policy_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    address = f"sqlite:///{tmp_path}/two.db"
    fill(address, [star("random", 0), star("random", 0, gamma=20.0)], edit=simulated)
    assert main(["--db", address, "--out", str(tmp_path)]) == 2
    assert "choose by --where" in capsys.readouterr().err
