"""From combinations to distinct, typed trials."""

from __future__ import annotations

from typing import Any

import pytest

from dopt.errors import IncompatibleError, SpecificationError
from orchestrate.config import Combination, build_grid

SETTINGS: dict[str, Any] = {
    "env": {"name": "pendulum"},
    "policy": {"name": "random"},
    "model": {"name": "mlp"},
    "learner": {"name": "adam"},
    "seed": 0,
}


def combination(seeds: tuple[int, ...] | None = (0, 1), **sections: object) -> Combination:
    return Combination({**SETTINGS, **sections}, seeds)


def test_every_config_gets_its_first_seed_before_any_gets_its_second() -> None:
    grid = build_grid([combination(), combination(policy={"name": "uniform"})])
    order = [(trial.policy.name, trial.seed) for trial in grid.trials]
    assert order == [("random", 0), ("uniform", 0), ("random", 1), ("uniform", 1)]


def test_a_trial_that_is_named_twice_is_one_trial() -> None:
    grid = build_grid([combination((0, 1, 1)), combination(None, env={"name": "pendulum"})])
    assert [trial.seed for trial in grid.trials] == [0, 1]
    assert (grid.n_jobs, grid.repeats) == (4, 2)


def test_an_integer_and_an_equal_float_name_one_trial() -> None:
    grid = build_grid(
        [combination((0,), env={"name": "pendulum", "gamma": gamma}) for gamma in (2, 2.0)]
    )
    assert len(grid.trials) == 1


def test_a_pair_that_makes_no_sense_is_left_out_with_the_reason() -> None:
    periodic = {"name": "periodic"}
    grid = build_grid([combination(), combination(env={"name": "quadrotor"}, policy=periodic)])
    [(reason, count)] = grid.left_out.items()
    assert count == 2
    assert reason.startswith("env=quadrotor policy=periodic: ")
    assert "eigenmode" in reason
    assert len(grid.trials) == 2
    assert grid.repeats == 0


def test_alone_such_a_pair_is_an_error_and_so_is_a_grid_of_nothing_else() -> None:
    pair = combination(env={"name": "quadrotor"}, policy={"name": "periodic"})
    with pytest.raises(IncompatibleError):
        build_grid([pair], single=True)
    with pytest.raises(SpecificationError, match="the grid is empty: env=quadrotor"):
        build_grid([pair])


@pytest.mark.parametrize("seeds", [(-1,), ("x",), (1.5,), (True,)])
def test_a_seed_is_a_whole_number_of_at_least_zero(seeds: Any) -> None:
    with pytest.raises(SpecificationError, match="seed"):
        build_grid([combination(seeds)])


OWN = {"_target_": "tests.dopt.custom_networks.Stack"}


def test_a_grid_holds_trials_of_both_paths() -> None:
    grid = build_grid([combination(), combination(model=OWN)])
    paths = {(trial.model.name, trial.config.path) for trial in grid.trials}
    assert paths == {("mlp", "kernel"), ("Stack", "reference")}
    together = grid.on_path("reference")
    assert {trial.config.path for trial in together.trials} == {"reference"}
    same = [trial.trial_key for trial in together.trials if trial.model.name == "Stack"]
    assert same == [trial.trial_key for trial in grid.trials if trial.model.name == "Stack"]
