"""Parameter errors: of parameters themselves, and from the loss of the linear model."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dopt.assessment import loss_by_parameter_error, parameter_error, true_parameters
from dopt.errors import SpecificationError
from dopt.run import rerun, run_trial
from dopt.systems import SYSTEMS, CoupledPendulums
from tests.dopt.trials import trial


def test_the_loss_of_coupled_pendulums_is_their_parameter_error_times_a_constant() -> None:
    spec = trial("coupled_pendulums", "oracle", env={"n_pendulums": 3, "grid_half_widths": [2.0]})
    steps = [1, 10, 30]
    parameters = rerun(spec, steps).parameters
    errors = np.array([parameter_error(spec.system, theta) for theta in parameters])
    losses = run_trial(spec).loss[np.array(steps) - 1]
    assert losses == pytest.approx(loss_by_parameter_error(spec.system) * errors, rel=1e-9)
    assert errors[0] > 100 * errors[-1] > 0


def test_true_parameters_are_those_of_the_step() -> None:
    worn = SYSTEMS["drifting_pendulum"]()
    names = worn.linear_parameters
    first, last = (true_parameters(worn, step) for step in (0, worn.horizon + 5))
    assert first[names.index("friction")] == worn.friction
    assert last[names.index("friction")] == worn.history[-1][worn.physical.index("friction")]
    assert parameter_error(worn, first, worn.horizon) == pytest.approx(abs(last - first).max())


def test_systems_whose_loss_is_no_parameter_error_are_refused() -> None:
    with pytest.raises(SpecificationError, match=r"'pendulum' weighs its parameters differently"):
        loss_by_parameter_error(SYSTEMS["pendulum"]())
    uneven = CoupledPendulums(n_pendulums=2, grid_half_widths=(1.0, 1.1))
    with pytest.raises(SpecificationError, match=r"dopt\.run"):
        loss_by_parameter_error(uneven)
    even = dataclasses.replace(uneven, grid_half_widths=(1.0,))
    assert loss_by_parameter_error(even) == pytest.approx(1 / 3**0.5, rel=1e-3)


def test_a_system_without_linear_parameters_is_refused() -> None:
    class Nothing(CoupledPendulums):
        pass

    system = Nothing()
    object.__setattr__(system, "linear_parameters", ())
    with pytest.raises(SpecificationError, match="no parameters that its accelerations are linear"):
        true_parameters(system)
