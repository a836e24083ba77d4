"""The interval that stops a configuration covers the geometric mean as often as it says."""

from __future__ import annotations

import numpy as np
import pytest

from studies.adaptive_seeds.coverage import SHAPES, coverage, resampled_coverages

STUDIES = 1_000


@pytest.mark.parametrize("shape", ["normal", "skewed", "heavy tails"])
@pytest.mark.parametrize("spread", [0.1, 0.15])
def test_at_least_95_percent_of_simulated_studies_are_covered(shape: str, spread: float) -> None:
    found = coverage(SHAPES[shape], STUDIES, spread)
    assert found.value >= 0.95 - 3 * np.sqrt(0.05 * 0.95 / STUDIES)
    assert found.seeds < 65, "it stops before all seeds are used"


def test_the_interval_covers_with_losses_as_launches_have_them() -> None:
    found = [share.value for share in resampled_coverages(100).values()]
    assert len(found) == 38
    assert np.mean(found) >= 0.95
    assert min(found) >= 0.95 - 4 * np.sqrt(0.05 * 0.95 / 100)
