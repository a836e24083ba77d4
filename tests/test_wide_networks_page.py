"""The table on the page about wide networks is computed as all other comparisons are."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from analysis.stats.intervals import standard_error
from analysis.stats.scores import compare
from tests.pages import DOCS, PAGES

LOSSES = pd.read_csv(DOCS / "sketch_losses.csv").set_index(["env", "width", "form", "seed"])


@pytest.mark.parametrize("env", ["cartpole", "pendulum", "quadrotor"])
@pytest.mark.parametrize("width", [16, 64])
def test_a_row_of_the_sketch_table(env: str, width: int) -> None:
    pairs = LOSSES.loc[(env, width)].final_loss.unstack("form")
    assert list(pairs.index) == list(range(20))
    exact, sketch = pairs["dual"].to_numpy(), pairs["sketch"].to_numpy()
    found = compare(sketch, exact, np.random.default_rng(0))
    means = [f"{x.mean():.2f} ± {2 * float(standard_error(x)):.2f}" for x in (exact, sketch)]
    row = f"| {env} | {width} | {' | '.join(means)} | {found.ratio:.2f} | {found.p_value:.2f} |"
    assert row in PAGES["docs/wide_networks.md"]
