from __future__ import annotations

import math

import numpy as np
import pytest

from analysis.data.matching import Filter
from analysis.data.selection import select
from analysis.errors import AnalysisError
from analysis.figures.phase_portraits import measure_portraits, tabulate_portraits
from analysis.stats.curves import median_seed
from dopt.assessment import Plane
from dopt.systems import SYSTEMS
from orchestrate.store import Reader


def test_median_seed() -> None:
    assert median_seed({0: 3.0, 1: 1.0, 2: 2.0}) == 2
    assert median_seed({0: 4.0, 1: 3.0, 2: 2.0, 3: 1.0}) == 2
    assert median_seed({7: 1.0, 3: 1.0, 5: 1.0}) == 5


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_rests_inside_its_box(name: str) -> None:
    system = SYSTEMS[name]()
    plane = Plane.of(system)
    rest = np.array([system.equilibrium or (0.0,) * system.n_states])
    x, y = plane.wrapped(plane.project(rest))[0]
    (left, right), (bottom, top) = plane.box
    assert left < x < right
    assert bottom < y < top


def test_the_cartpole_is_centred_on_hanging() -> None:
    plane = Plane.of(SYSTEMS["cartpole"]())
    assert plane.box[0] == pytest.approx((0, 2 * math.pi))
    assert plane.angles == (True, False)


def test_panels_share_the_seed_and_the_start(reader: Reader) -> None:
    portraits = measure_portraits(reader, select(reader, Filter()), "pendulum")
    assert portraits.panels[0].policy == "d_optimal"
    for panel in portraits.panels:
        assert panel.start == pytest.approx(portraits.panels[0].start)
        assert panel.n == 5
        assert 0 < panel.coverage < 1


def test_the_line_goes_through_the_stored_states(reader: Reader) -> None:
    selection = select(reader, Filter())
    portraits = measure_portraits(reader, selection, "pendulum")
    key = selection.of("pendulum")[0].config.config_key
    states = reader.trajectory(key, portraits.seed).states
    table = tabulate_portraits(portraits)
    drawn = table[(table.policy == "d_optimal") & table.x.notna()]
    assert drawn.y.to_numpy() == pytest.approx(states[:, 1])
    assert (table.seed == portraits.seed).all()


def test_a_diverged_trial_has_no_share_in_the_coverage(reader: Reader) -> None:
    portraits = measure_portraits(reader, select(reader, Filter()), "cartpole")
    panel = portraits.panels[-1]
    assert (panel.policy, panel.n, panel.n_diverged) == ("random", 4, 1)


def test_without_the_reference_there_is_no_seed(reader: Reader) -> None:
    selection = select(reader, Filter(policies=("random",)))
    with pytest.raises(AnalysisError, match="no finished trial of d_optimal"):
        measure_portraits(reader, selection, "pendulum")
