"""The numbers on systems with an unknown effect of the input are those of their table."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from tests.findings.report_columns import FINDINGS
from tests.pages import DOCS

TABLE = pd.read_csv(DOCS / "unknown_gain.csv")

BELOW_TWICE = "adam_replay ×100"
LEARNERS = ("adam_window", "adam_replay", BELOW_TWICE, "gauss_newton")


def losses(env: str, model: str, learner: str) -> pd.DataFrame:
    """Return the final losses of a system by seed, one column for each policy."""
    rows = TABLE[(TABLE.env == env) & (TABLE.model == model) & (TABLE.learner == learner)]
    return rows.pivot_table(index="seed", columns="policy", values="final_loss")


def geometric_mean(values: pd.Series[float]) -> float:
    return float(np.exp(np.log(values).mean()))


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("model", ["affine", "black_box"])
@pytest.mark.parametrize("env", ["pendulum", "cartpole"])
def test_rows_are_those_of_the_table(env: str, model: str, learner: str) -> None:
    found = losses(f"{env}_unknown_gain", model, learner)
    known = losses(env, "mlp", learner).d_optimal
    means = (geometric_mean(found.d_optimal), geometric_mean(found.random))
    ratios = (geometric_mean(found.d_optimal / known), means[0] / means[1])
    cells = " | ".join(f"{value:.3g}" for value in (geometric_mean(known), *means, *ratios))
    assert f"| {env} | `{model}` | `{learner}` | {len(found)} | {cells} |" in FINDINGS


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("model", ["affine", "black_box"])
@pytest.mark.parametrize("env", ["pendulum", "cartpole"])
def test_d_optimal_inputs_are_below_random_ones(env: str, model: str, learner: str) -> None:
    """As the page says: each with p < 1e-33, with affine under adam_window p < 1e-38."""
    found = losses(f"{env}_unknown_gain", model, learner)
    gaps = np.log(found.d_optimal / found.random)
    assert len(gaps) == 100
    assert gaps.mean() < 0
    default = (model, learner) == ("affine", "adam_window")
    assert stats.ttest_1samp(gaps, 0.0).pvalue < (1e-38 if default else 1e-33)


def test_the_factors_are_those_of_the_page() -> None:
    """A model that does not know the gain ends at so many times the loss of one that does."""
    factors = pd.Series(
        {
            (model, learner, env): geometric_mean(
                losses(f"{env}_unknown_gain", model, learner).d_optimal
                / losses(env, "mlp", learner).d_optimal
            )
            for model in ("affine", "black_box")
            for learner in LEARNERS
            for env in ("pendulum", "cartpole")
        }
    )
    assert (factors.xs(BELOW_TWICE, level=1) < 2.0).all()
    exception = ("affine", "gauss_newton", "pendulum")
    affine, black_box = factors.drop(exception)["affine"], factors["black_box"]
    assert f"{black_box.min():.3g} to {black_box.max():.3g} with `black_box`" in FINDINGS
    assert f"{affine.min():.3g} to {affine.max():.3g} with `affine`" in FINDINGS
    assert f"but for {factors[exception]:.3g} under `gauss_newton` on the pendulum" in FINDINGS
