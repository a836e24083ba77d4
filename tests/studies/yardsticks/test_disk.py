"""The table of the unbalanced disk: against its definition, files, refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import UnbalancedDisk
from studies.yardsticks.__main__ import main
from studies.yardsticks.disk import TEST_SAMPLES, rate_error
from tests.analysis.synthetic import fill, simulated
from tests.dopt.trials import trial

MEASURED = {"measured_states": [1], "measurement_noise": [0.045], "initial_state": [0.0, 0.0]}
LIMITS = {"name": "box", "bounds": {"ω": [-4.5, 4.5]}, "steps": 1, "margin": 1.0}


def disk(
    policy: str, seed: int, *, enforced: bool = True, horizon: int = 60, **planned: Any
) -> TrialSpec:
    env = {"dt": 0.025, "integrator": "rk4", "horizon": horizon, **MEASURED}
    parts = {"learner": {"name": "joint_ekf"}, "policy": planned}
    free = trial("unbalanced_disk", policy, seed, env=env, **parts)
    return TrialSpec.from_mapping(free.to_mapping() | {"limits": LIMITS | {"enforced": enforced}})


SPECS = [
    disk(policy, seed, enforced=enforced, **planned)
    for enforced in (False, True)
    for policy, planned in (("random", {}), ("space_filling", {"criterion": "gsx"}))
    for seed in range(2)
]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> str:
    address = f"sqlite:///{tmp_path_factory.mktemp('disk')}/results.db"
    fill(address, SPECS, edit=simulated)
    return address


def named(spec: TrialSpec) -> tuple[bool, str, int]:
    policy = getattr(spec.policy, "criterion", spec.policy.name)
    return spec.limits.enforced, policy, spec.seed  # type: ignore[union-attr]


def test_rows_are_those_of_the_trials(small: str, tmp_path: Path) -> None:
    assert main(["--db", small, "--out", str(tmp_path)]) == 0
    rows = pd.read_csv(tmp_path / "active_sysid_trials.csv")
    table = rows.set_index(["enforced", "policy", "seed"]).sort_index()
    assert len(table) == len(SPECS)
    for spec in SPECS:
        result, row = run_trial(spec), table.loc[named(spec)]
        assert row.error == pytest.approx(rate_error(spec, result.parameters), rel=1e-12)
        assert row.turned == pytest.approx(np.abs(result.states[:, 0]).max())
        counted = [one.value for one in result.assessments if one.measure == "violations"]
        assert row.violations == pytest.approx(sum(counted) / 60)
        if not spec.limits.enforced:  # type: ignore[union-attr]
            assert row.violations > 0.0


def test_the_true_model_is_left_with_the_noise_and_none_with_the_motion() -> None:
    """The noise of 2,000 samples is known to 1.6 % (one standard deviation)."""
    env = {"dt": 0.025, "integrator": "rk4", **MEASURED}
    parts = {"model": {"name": "linear"}, "learner": {"name": "joint_ekf"}}
    spec = trial("unbalanced_disk", "random", 0, env=env, **parts)
    truth = np.array([getattr(spec.system, name) for name in UnbalancedDisk.linear_parameters])
    assert rate_error(spec, truth) == pytest.approx(0.045, rel=4 * 0.016)
    other = rate_error(spec, 0.5 * truth)
    assert 1.0 < other < 10.0
    assert rate_error(spec, np.full(3, -1e6)) == np.inf
    assert TEST_SAMPLES == 2000


def test_medians_counts_and_ratios_are_those_of_the_trials(
    small: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["--db", small, "--out", str(tmp_path)])
    shown = capsys.readouterr().out
    assert "published: idw" in shown
    assert "| rate within 4.5 rad/s" in shown
    trials = pd.read_csv(tmp_path / "active_sysid_trials.csv")
    table = pd.read_csv(tmp_path / "active_sysid.csv").set_index(["enforced", "policy"])
    by_seed = trials.pivot_table(index="seed", columns=["enforced", "policy"], values="error")
    assert table["median"].to_numpy() == pytest.approx(by_seed.median()[table.index].to_numpy())
    assert (table.reached == (by_seed <= 0.83).sum()[table.index]).all()
    logs = np.log(by_seed[True, "gsx"] / by_seed[True, "random"])
    assert table.ratio[True, "gsx"] == pytest.approx(np.exp(logs.mean()))


def test_a_trial_that_diverged_counts_with_an_infinite_error(tmp_path: Path) -> None:
    address = f"sqlite:///{tmp_path}/diverged.db"
    whole = disk("random", 0, enforced=False).to_mapping()
    env = whole["env"] | {"state_limit": 5.0}  # type: ignore[operator]
    spec = TrialSpec.from_mapping(whole | {"env": env})
    assert run_trial(spec).diverged
    fill(address, [spec], edit=simulated)
    assert main(["--db", address, "--out", str(tmp_path)]) == 0
    row = pd.read_csv(tmp_path / "active_sysid_trials.csv").iloc[0]
    assert row.error == np.inf
    assert np.isnan(row.turned)
    assert 0.0 <= row.violations < 1.0


def test_other_bounds_are_another_question(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    address = f"sqlite:///{tmp_path}/other.db"
    narrow = disk("random", 0).to_mapping() | {"limits": LIMITS | {"bounds": {"ω": [-2.0, 2.0]}}}
    fill(address, [TrialSpec.from_mapping(narrow)], edit=simulated)
    assert main(["--db", address, "--out", str(tmp_path)]) == 2
    assert "holds no trials of a published table" in capsys.readouterr().err


def test_two_kinds_of_one_policy_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    address = f"sqlite:///{tmp_path}/two.db"
    fill(address, [disk("random", 0), disk("random", 0, horizon=10)], edit=simulated)
    assert main(["--db", address, "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "rate within 4.5 rad/s with the policy 'random'" in said
    assert "choose by --where" in said
