"""The table of the swing-up: against its definition, published rows, refusals."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from dopt.result import Assessment, TrialResult
from dopt.spec.trial import TrialSpec
from studies.yardsticks.__main__ import main
from studies.yardsticks.common import FLEX_SWING_UP
from tests.analysis.synthetic import fill, make_spec

SOLVED = {
    ("random", 0): (0, 1, 0, 1),
    ("random", 1): (0, 0, 0, 0),
    ("random", 2): (0, 1, 1, 0),
    ("d_optimal", 0): (0, 0, 1, 1),
    ("d_optimal", 1): (0, 1, 1, 1),
    ("d_optimal", 2): (1, 1, 1, 1),
}
"""Success of the episodes after 0, 10, 20 and 30 steps, by policy and seed."""

SAMPLES = {
    ("random", 0): (30, 10),
    ("random", 1): (np.inf, np.inf),
    ("random", 2): (np.inf, 10),
    ("d_optimal", 0): (20, 20),
    ("d_optimal", 1): (10, 10),
    ("d_optimal", 2): (0, 0),
}
"""Samples until they succeed from then on, and for the first time."""


def swing_up(policy: str, seed: int, **sections: Any) -> TrialSpec:
    env = {"horizon": 30, "grid_points": (4, 4)}
    task = {"name": "control", "checkpoints": [10, 20]}
    return make_spec("pendulum", policy, seed, env=env, task=task, **sections)


def solved_as_listed(spec: TrialSpec, result: TrialResult) -> TrialResult:
    """Return the result with the successes of the list, up to where it diverged."""
    values = zip((0, 10, 20, 30), SOLVED[spec.policy.name, spec.seed], strict=True)
    last = spec.system.horizon if result.diverged_at is None else result.diverged_at
    rows = tuple(Assessment(t, "control_success", float(one)) for t, one in values if t <= last)
    return dataclasses.replace(result, assessments=rows)


SPECS = [swing_up(*one) for one in SOLVED]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> str:
    address = f"sqlite:///{tmp_path_factory.mktemp('swing_up')}/results.db"
    fill(address, SPECS, edit=solved_as_listed)
    return address


def test_samples_are_those_after_which_every_episode_succeeds(small: str, tmp_path: Path) -> None:
    assert main(["--db", small, "--out", str(tmp_path)]) == 0
    table = pd.read_csv(tmp_path / "flex_table1_trials.csv").set_index(["policy", "seed"])
    assert len(table) == len(SAMPLES)
    for key, expected in SAMPLES.items():
        assert tuple(table.loc[key, ["samples", "first"]]) == expected
    assert set(table.horizon) == {30}


def test_medians_and_improvements_are_those_of_the_trials(small: str, tmp_path: Path) -> None:
    main(["--db", small, "--out", str(tmp_path)])
    table = pd.read_csv(tmp_path / "flex_table1.csv").set_index("policy")
    assert tuple(table.samples[["d_optimal", "random"]]) == (10, np.inf)
    assert tuple(table["first"][["d_optimal", "random"]]) == (10, 10)
    assert tuple(table.samples_unsolved[["d_optimal", "random"]]) == (0, 2)
    assert tuple(table.first_unsolved[["d_optimal", "random"]]) == (0, 1)
    assert table.improvement["d_optimal"] == 1.0
    assert table.p_adjusted["d_optimal"] == pytest.approx(2 * 0.5**3)
    assert np.isnan(table.improvement["random"])


def test_a_trial_that_diverged_is_not_solved(tmp_path: Path) -> None:
    address = f"sqlite:///{tmp_path}/diverged.db"
    lost = swing_up("d_optimal", 1)
    fill(address, SPECS, diverged={lost.trial_key: 15}, edit=solved_as_listed)
    main(["--db", address, "--out", str(tmp_path)])
    table = pd.read_csv(tmp_path / "flex_table1_trials.csv").set_index(["policy", "seed"])
    assert tuple(table.loc[("d_optimal", 1), ["samples", "first"]]) == (np.inf, 10)


def test_the_tables_show_the_published_rows_and_what_is_censored(
    small: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["--db", small, "--out", str(tmp_path)])
    lines = capsys.readouterr().out.splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    assert ["policy", "pendulum, mlp"] in rows
    assert ["published: RHC", "500"] in rows
    assert ["published: random", "> 2000"] in rows
    assert ["published: FLEX", "–"] in rows  # its model of the pendulum is linear
    assert FLEX_SWING_UP["FLEX"]["pendulum", "linear"] == 50
    assert ["random", "> 30 [30, > 30]; 2"] in rows
    assert ["d_optimal", "1.00; 0.25"] in rows


def test_two_learners_of_one_policy_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    address = f"sqlite:///{tmp_path}/two.db"
    specs = [swing_up("random", 0), swing_up("random", 0, learner={"name": "gauss_newton"})]
    fill(address, specs, edit=solved_as_listed)
    assert main(["--db", address, "--out", str(tmp_path)]) == 2
    assert "choose by --where" in capsys.readouterr().err
    asked = ["--where", "learner.name=gauss_newton", "--out", str(tmp_path)]
    assert main(["--db", address, *asked]) == 0


def test_a_policy_that_learns_the_task_has_a_row_for_its_own_feedback(tmp_path: Path) -> None:
    def edit(spec: TrialSpec, result: TrialResult) -> TrialResult:
        result = solved_as_listed(spec, result)
        if spec.policy.name == "random":
            return result
        own = (Assessment(t, "feedback_success", float(t == 30)) for t in (0, 10, 20, 30))
        return dataclasses.replace(result, assessments=(*result.assessments, *own))

    address = f"sqlite:///{tmp_path}/agent.db"
    fill(address, SPECS, edit=edit)
    main(["--db", address, "--out", str(tmp_path)])
    trials = pd.read_csv(tmp_path / "flex_table1_trials.csv").set_index(["policy", "seed"])
    for seed in range(3):
        assert trials.samples["d_optimal, its own feedback", seed] == 30
    for key, expected in SAMPLES.items():
        assert tuple(trials.loc[key, ["samples", "first"]]) == expected
    table = pd.read_csv(tmp_path / "flex_table1.csv").set_index("policy")
    assert set(table.index) == {"random", "d_optimal", "d_optimal, its own feedback"}
    assert table.samples_unsolved["d_optimal, its own feedback"] == 0
