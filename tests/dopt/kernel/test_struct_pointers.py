"""Compiled functions read a trial by pointer: the same numbers and the same arrays."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from numba.core.errors import TypingError

from dopt.kernel import pointers
from dopt.kernel.held import HeldTrial, pointer_to, trial_in
from dopt.kernel.pointers import compiled_for, held_kind, kind_of, path_of
from dopt.kernel.run import KernelTrial
from dopt.spec.trial import TrialSpec
from dopt.types import Vector
from tests.dopt.newcomers import kept
from tests.dopt.trials import trial


@kept
def numbers(held: HeldTrial, out: Vector) -> None:
    """Read numbers, arrays and structures in structures, and write through one of them."""
    whole = trial_in(held)
    plant, network = whole.plant, whole.network
    waves = network.waves
    out[0], out[1], out[2] = plant.dt, plant.n_inputs, waves.scale
    out[3], out[4] = waves.frequencies.shape[0], waves.frequencies[0, 1]
    out[5] = 1.0 if whole.limits.enforced else 0.0
    out[6] = whole.state.theta[1:3].sum()
    whole.state.covariance.n_pending[0] = 7


def test_a_pointer_reads_and_writes_what_the_structures_hold() -> None:
    fast, out = KernelTrial(TrialSpec.from_names("pendulum", "d_optimal")), np.empty(7)
    plant, waves, theta = fast.trial.plant, fast.trial.network.waves, fast.state.theta
    assert waves.frequencies.size == 0
    waves = waves._replace(frequencies=np.arange(6.0).reshape(2, 3), scale=0.25)
    network = fast.trial.network._replace(waves=waves)
    fast.trial = fast.trial._replace(network=network)
    function = compiled_for(path_of(numbers), numbers, (held_kind(fast.trial), kind_of(out)))
    function(fast.held, out)
    assert out.tolist() == [plant.dt, plant.n_inputs, 0.25, 2.0, 1.0, 0.0, theta[1:3].sum()]
    assert fast.state.covariance.n_pending[0] == 7


def test_a_field_that_does_not_exist_is_refused_by_name() -> None:
    fast = KernelTrial(TrialSpec.from_names("pendulum", "d_optimal"))

    def wrong(held: HeldTrial) -> float:
        return float(trial_in(held).plant.mass)

    with pytest.raises(TypingError, match=r"Unknown attribute 'mass' of type pointer\(Plant"):
        kept(wrong).compile((held_kind(fast.trial),))  # type: ignore[attr-defined]


def test_a_pointer_s_type_is_that_of_its_structure() -> None:
    """The cache of machine code finds functions by the types of their arguments."""
    short, other = (
        kind_of(KernelTrial(TrialSpec.from_names(env, "d_optimal")).trial)
        for env in ("pendulum", "arm")
    )
    assert pointer_to(short) == pointer_to(other)
    assert pickle.loads(pickle.dumps(pointer_to(short))) == pointer_to(short)
    assert pointer_to(short) != pointer_to(short.types[0])
    assert len(str(pointer_to(short))) < 40  # names of machine code are made of it


@pytest.mark.parametrize(
    ("fields", "others"),
    [
        ({}, set()),
        ({"limits": {"bounds": {"φ": [-4.0, 4.0]}}}, {"limit_input", "note_error"}),
        ({"env": {"integrator": "rk4"}}, {"observe"}),
        (
            {"env": {"measured_states": [0], "measurement_noise": [0.01]}},
            {"estimate_state"},
        ),
    ],
)
def test_a_trial_calls_the_steps_that_it_consists_of(
    fields: dict[str, dict[str, object]], others: set[str]
) -> None:
    mapping = trial("pendulum", "d_optimal").to_mapping()
    for section, changes in fields.items():
        mapping[section] = mapping.get(section, {}) | changes
    chosen = pointers.other_steps(KernelTrial(TrialSpec.from_mapping(mapping)).trial)
    for name, (usual, other) in pointers.OTHER_STEPS.items():
        assert chosen[name] is (other if name in others else usual)
