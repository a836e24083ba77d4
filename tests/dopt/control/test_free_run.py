from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dopt.control.planning import (
    STARTS,
    forecast_by,
    forecast_by_equations,
    free_run_error,
    held_out,
)
from dopt.evaluation import reachable_states
from dopt.systems import SYSTEMS, Pendulum


@pytest.mark.parametrize("name", sorted(SYSTEMS))
def test_the_true_model_makes_no_error(name: str) -> None:
    system = SYSTEMS[name]()
    assert free_run_error(system, forecast_by_equations(system), 20) == 0.0


def test_one_step_of_a_constant_error_is_known() -> None:
    pendulum = Pendulum()
    truth = held_out(pendulum, 1)
    error = free_run_error(
        pendulum, forecast_by(pendulum, lambda states, _: pendulum.learned(states) + 3.0), 1
    )
    change = np.mean((truth.states[0] - truth.starts)[:, 1] ** 2)
    assert error == pytest.approx(np.sqrt(0.5 * (pendulum.dt * 3.0) ** 2 / change), rel=1e-9)


def test_an_error_of_the_model_grows_with_the_steps() -> None:
    pendulum = Pendulum()
    wrong = dataclasses.replace(pendulum, gravity=9.0)
    errors = [
        free_run_error(
            pendulum, forecast_by(pendulum, lambda states, _: wrong.learned(states)), steps
        )
        for steps in (5, 20, 50)
    ]
    assert errors == sorted(errors)
    assert errors[0] < 0.8 * errors[-1]


def test_what_is_held_out_depends_on_the_system_alone() -> None:
    first = held_out(Pendulum(), 25)
    held_out.cache_clear()
    again = held_out(Pendulum(noise=0.1), 25)
    np.testing.assert_array_equal(first.states, again.states)
    assert first.inputs.shape == (256, 25, 1)
    assert np.allclose(np.abs(first.inputs), Pendulum().gamma)


def test_it_starts_all_along_the_reachable_trajectories() -> None:
    """Those of the first steps alone are slow: the system was still gaining energy."""
    system = SYSTEMS["cartpole"]()
    reachable = reachable_states(system)
    starts = held_out(system, 5).starts
    assert len(starts) == STARTS
    late = np.any(np.all(starts[:, None] == reachable[-3:], axis=2), axis=0)
    assert late.any()
    assert starts.std(axis=0) == pytest.approx(reachable.std(axis=0), rel=0.1)


def test_a_model_that_explodes_has_no_finite_error() -> None:
    pendulum = Pendulum()
    error = free_run_error(
        pendulum, forecast_by(pendulum, lambda states, _: 1e300 * states[:, 1:] ** 3), 25
    )
    assert not np.isfinite(error)
