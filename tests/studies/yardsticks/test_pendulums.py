"""The table of coupled pendulums: against its definition, files, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dopt.assessment import parameter_error
from dopt.run import rerun
from studies.yardsticks import pendulums as table_3
from studies.yardsticks.__main__ import main
from tests.analysis.synthetic import fill, simulated
from tests.dopt.trials import trial
from tests.studies.yardsticks.small_grid import SPECS, fill_small_grid, pendulums


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> str:
    address = f"sqlite:///{tmp_path_factory.mktemp('pendulums')}/results.db"
    fill_small_grid(address)
    return address


def test_samples_are_those_after_which_the_error_stays_small(small: str, tmp_path: Path) -> None:
    assert main(["--db", small, "--out", str(tmp_path)]) == 0
    table = pd.read_csv(tmp_path / "flex_table3_trials.csv")
    assert len(table) == len(SPECS)
    for spec in SPECS:
        mask = (table.policy == spec.policy.name) & (table.seed == spec.seed)
        (row,) = table[mask & (table.n_pendulums == spec.system.n_learned)].to_dict("records")
        steps = list(range(1, spec.system.horizon + 1))
        errors = [parameter_error(spec.system, one) for one in rerun(spec, steps).parameters]
        above = [t for t, error in zip(steps, errors, strict=True) if error > table_3.ERROR]
        assert row["samples"] == (max(above, default=0) + 1 if errors[-1] <= 0.01 else np.inf)
        assert row["final_error"] == pytest.approx(errors[-1], rel=1e-6)


def test_medians_and_ratios_are_those_of_the_trials(small: str, tmp_path: Path) -> None:
    main(["--db", small, "--out", str(tmp_path)])
    trials = pd.read_csv(tmp_path / "flex_table3_trials.csv")
    for row in pd.read_csv(tmp_path / "flex_table3.csv").to_dict("records"):
        of_size = trials[trials.n_pendulums == row["n_pendulums"]].pivot_table(
            index="seed", columns="policy", values="samples"
        )
        assert row["median"] == of_size[row["policy"]].median()
        if row["policy"] != "random":
            logs = np.log(of_size[row["policy"]] / of_size["random"])
            assert row["ratio"] == pytest.approx(np.exp(logs.mean()))


def test_the_table_shows_the_published_rows(
    small: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["--db", small, "--out", str(tmp_path)])
    shown = capsys.readouterr().out
    assert "published: FLEX" in shown
    assert "published: random" in shown
    assert table_3.published_exponent("FLEX") == pytest.approx(1.18, abs=0.005)


def test_databases_without_such_trials_and_with_two_kinds_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    address = f"sqlite:///{tmp_path}/other.db"
    fill(address, [trial("pendulum", "random")], edit=simulated)
    assert main(["--db", address, "--out", str(tmp_path)]) == 2
    assert (
        "experiment=flex_table1 or flex_table3 or flex_star or active_sysid"
        in capsys.readouterr().err
    )
    fill(address, [pendulums("random", 2, 0), pendulums("random", 2, 0, gamma=2.0)], edit=simulated)
    assert main(["--db", address, "--out", str(tmp_path)]) == 2
    assert "choose by --where" in capsys.readouterr().err
    asked = ["--where", "env.gamma=2.0", "--out", str(tmp_path)]
    assert main(["--db", address, *asked]) == 0
