"""The numbers on a pendulum whose angle alone is measured are those of their table."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from benchmarks.sensor_noise import INPUTS, measured
from tests.findings.report_columns import FINDINGS
from tests.pages import DOCS

TABLE = pd.read_csv(DOCS / "noisy_angle.csv")
EXPECTED = pd.read_csv(DOCS / "noisy_angle_expected.csv")
ROWS = [
    ("state", "adam_window"),
    ("state", "ekf"),
    ("state", "gauss_newton"),
    ("angle", "adam_window"),
    ("angle", "gauss_newton"),
    ("angle", "joint_ekf without fits"),
    ("angle", "joint_ekf"),
    ("angle", "joint_ekf with ρ fitted"),
    ("angle", "joint_ekf with ρ fitted from 0.001"),
    ("angle", "joint_ekf with ρ fitted from 100"),
    ("angle", "joint_ekf with ρ of 0.001"),
    ("angle", "joint_ekf with ρ of 100"),
]


def losses(known: str, learner: str) -> pd.DataFrame:
    """Return the final losses by seed, one column for each policy."""
    rows = TABLE[(TABLE.known == known) & (TABLE.learner == learner)]
    return rows.pivot_table(index="seed", columns="policy", values="final_loss")


def geometric_mean(values: pd.Series[float]) -> float:
    return float(np.exp(np.log(values).mean()))


@pytest.mark.parametrize(("known", "learner"), ROWS)
def test_rows_are_those_of_the_table(known: str, learner: str) -> None:
    found = losses(known, learner)
    assert len(found) == 100
    means = geometric_mean(found.d_optimal), geometric_mean(found.random)
    cells = " | ".join(f"{value:.3g}" for value in (*means, means[0] / means[1]))
    name, _, how = learner.partition(" ")
    assert f"| {known} | `{name}`{' ' + how if how else ''} | {cells} |" in FINDINGS


def test_d_optimal_inputs_are_below_random_ones() -> None:
    for known, learner in ROWS:
        found = losses(known, learner)
        gaps = np.log(found.d_optimal / found.random)
        assert gaps.mean() < 0
        bound = 1e-34 if "ρ" in learner else 1e-40
        assert stats.ttest_1samp(gaps, 0.0).pvalue < bound


def test_it_is_beside_learners_that_know_the_state() -> None:
    """Below the paper's learner and the filter, and above a fit of all samples."""
    found = geometric_mean(losses("angle", "joint_ekf").d_optimal)
    for learner, known in (("adam_window", "state"), ("ekf", "state"), ("gauss_newton", "state")):
        ratio = found / geometric_mean(losses(known, learner).d_optimal)
        assert f"{ratio:.3g} times that of `{learner}`" in FINDINGS.replace("\n", " ")
    nearly = geometric_mean(losses("both", "joint_ekf").d_optimal)
    assert f"it ends at {nearly:.3g}" in FINDINGS.replace("\n", " ")


def test_filtered_differences_end_above_the_filter() -> None:
    found = geometric_mean(losses("angle", "joint_ekf").d_optimal)
    for learner in ("adam_window", "gauss_newton"):
        assert geometric_mean(losses("angle", learner).d_optimal) > 3 * found


def test_a_fitted_noise_need_not_be_known() -> None:
    chosen = geometric_mean(losses("angle", "joint_ekf").d_optimal)
    kinds = ("fitted", "fitted from 0.001", "fitted from 100", "of 0.001", "of 100")
    found = {
        kind: geometric_mean(losses("angle", f"joint_ekf with ρ {kind}").d_optimal) / chosen
        for kind in kinds
    }
    same, low, high, low_given, high_given = (f"{ratio:.3g}" for ratio in found.values())
    words = " ".join(FINDINGS.split())
    assert f"D-optimal inputs end at {same} times the loss from the same start" in words
    assert f"and at {low} and {high} times from ρ of 0.001 and 100" in words
    assert f"where these stay, at {low_given} and {high_given} times" in words
    for start in ("0.001", "100"):
        assert found[f"fitted from {start}"] < 0.8 * found[f"of {start}"]


def test_expected_errors_are_those_of_their_table() -> None:
    means = EXPECTED.groupby("inputs")[["final_loss", "expected"]].agg(geometric_mean)
    assert set(means.index) == set(INPUTS)
    assert EXPECTED.groupby("inputs").seed.nunique().eq(100).all()
    for name, row in means.iterrows():
        policy, learner, known = str(name).split(", ")
        inputs = f"{policy.replace('d_optimal', 'D-optimal')}, `{learner}`, {known}"
        assert f"| {inputs} | {row.final_loss:.3g} | {row.expected:.3g} |" in FINDINGS
    own = means.loc["d_optimal, joint_ekf, angle"]
    white = means.loc["random, joint_ekf, angle"]
    planned, drawn = (f"{row.final_loss / row.expected:.3g}" for row in (own, white))
    left = f"ends at {planned} times what the noise leaves at its D-optimal inputs"
    assert f"{left}, and at {drawn} times at random ones" in " ".join(FINDINGS.split())
    full = means.loc["d_optimal, gauss_newton, state"]
    assert full.expected / full.final_loss == pytest.approx(11, abs=0.5)
    assert full.expected / full.final_loss > 10.5


def test_an_expected_error_is_found_again() -> None:
    """Up to what the trial of another processor chose otherwise."""
    rows = EXPECTED[EXPECTED.seed == 0].set_index("inputs")
    name = "d_optimal, joint_ekf, angle"
    loss, expected = measured(name, 0)
    assert loss == pytest.approx(rows.final_loss[name], rel=0.02)
    assert expected == pytest.approx(rows.expected[name], rel=0.02)
