"""Which configurations ``launch.until=decided`` compares."""

from __future__ import annotations

import pytest

from dopt.spec.trial import TrialSpec
from orchestrate.config.grid import Grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.config.stopping_rule import UntilDecided
from orchestrate.errors import LaunchError
from orchestrate.runner.seed_plan import SeedPlan
from tests.orchestrate.standins import grid_of, specification, trial_of


def test_each_environment_and_width_has_its_reference() -> None:
    """A wider network is compared with D-optimal inputs of the same width, where there are any."""
    widths = [
        TrialSpec.from_mapping({**trial_of(policy, seed).to_mapping(), "model": model})
        for seed in range(20)
        for policy, model in (
            ("d_optimal", {"name": "mlp", "width": 2}),
            ("d_optimal", {"name": "mlp", "width": 3}),
            ("random", {"name": "mlp", "width": 3}),
            ("uniform", {"name": "mlp", "width": 4}),
        )
    ]
    heavier = [*grid_of(["random", "d_optimal"], 20, mass=2.0).trials]
    both = Grid([*widths, *heavier], n_jobs=len(widths) + len(heavier), left_out={})
    compared = _compared(both)
    by_width = {"d_optimal": 3, "random": 3, "uniform": 4}
    assert ("random", by_width["random"], "d_optimal", 3, False) in compared
    assert ("uniform", by_width["uniform"], "d_optimal", 2, False) in compared
    assert ("random", 2, "d_optimal", 2, True) in compared
    assert len(compared) == 3


def _compared(of: Grid) -> set[tuple[str, object, str, object, bool]]:
    """Return policy and width of each variant and of its reference, and whether it is heavier."""
    settings = LaunchSettings("inprocess", "sqlite://", until=UntilDecided())
    rule = SeedPlan(of, settings)._rule
    first = {one.config_key: one for one in reversed(of.trials)}
    found = set()
    for key, comparison in rule._comparisons.items():  # type: ignore[union-attr]
        own, reference = first[key], first[comparison.reference]
        assert own.system == reference.system
        heavier = own.system != specification().system
        names = [(one.policy.name, one.columns()["width"]) for one in (own, reference)]
        found.add((*names[0], *names[1], heavier))
    return found


def test_a_comparison_without_a_pair_is_refused() -> None:
    own = [trial_of("uniform", seed) for seed in range(10)]
    other = [trial_of("d_optimal", seed) for seed in range(10, 20)]
    apart = Grid([*own, *other], n_jobs=20, left_out={})
    settings = LaunchSettings("inprocess", "sqlite://", until=UntilDecided())
    with pytest.raises(LaunchError, match="uniform has no seed in common with its reference"):
        SeedPlan(apart, settings)


@pytest.mark.parametrize("policies", [["random", "uniform"], ["d_optimal"]])
def test_a_grid_without_comparisons_is_refused(policies: list[str]) -> None:
    settings = LaunchSettings("inprocess", "sqlite://", until=UntilDecided())
    with pytest.raises(LaunchError, match=r"compares with launch\.reference=d_optimal"):
        SeedPlan(grid_of(policies, 20), settings)
