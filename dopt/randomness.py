"""Random numbers of a trial, drawn before it starts; plans and updates in numpy have own streams.

One seed gives named child streams, so that a draw for one purpose does not shift another. Policies
that are compared at the same seed share initial weights and process noise (common random numbers).
Both execution paths use the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dopt.errors import SpecificationError
from dopt.learning import AdamReplay
from dopt.policies import ICEM
from dopt.policies.base import ROUNDING, OpenLoop, ball_norms, on_sphere
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.types import Array

_STREAMS = {
    "noise": 0,
    "weights": 1,
    "inputs": 2,
    "components": 3,
    "ties": 4,
    "planner": 5,
    "updater": 6,
    "control_noise": 7,
    "control_plans": 8,
    "replay": 9,
    "environment": 10,
    "uniform_states": 11,
    "sampled_plans": 12,
    "sampled_parameters": 13,
    "measurement_noise": 14,
    "radii": 15,
    "evidence": 16,
}

PLANNED_DIMENSIONS = 4
"""Planned inputs have the norms of points drawn uniformly from a ball of 4 m dimensions."""


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the named child stream of a trial's seed."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_STREAMS[name],)))


def episode_seed(seed: int) -> int:
    """Return the seed of the episode of a trial's black box."""
    return int(stream(seed, "environment").integers(2**31))


@dataclass(frozen=True)
class Draws:
    """Random numbers of one trial.

    Attributes
    ----------
    noise : (T, d)
        w_t, variance dt σ².
    measurement_noise : (T, n)
        v_{t+1} of the n measured states, in their units; (T, 0) where all are known.
    weights : (q,)
        Initial parameters.
    inputs : (T, m)
        The whole input sequence of an open-loop policy; otherwise uniform on the sphere ‖u‖ = γ,
        of which a closed-loop policy takes the first.
    components : (T,)
        Index among the r learned accelerations of the component k of Algorithm 2.
    ties : (T, m)
        Unit vectors that decide between inputs of equal value.
    radii : (T, 2)
        Norm in γ of the planned input, and of the next sample's input in the criterion of that
        plan. They are 1 unless the model is not affine in the inputs: it learns only where in the
        ball ‖u‖ ≤ γ it has samples. Then the first is the norm of a uniform point of a ball of
        4 m dimensions, the second of a ball of m.
    replay : (T, steps, batch)
        Places of the buffer that make the minibatches of a learner with replay; otherwise empty.
    plans, parameters : (blocks, ·), (q, s)
        Standard normal numbers of the sampling planner (:class:`dopt.policies.ICEM`); otherwise
        empty.
    """

    noise: Array
    measurement_noise: Array
    weights: Array
    inputs: Array
    components: npt.NDArray[np.int64]
    ties: Array
    radii: Array
    replay: npt.NDArray[np.int64]
    plans: Array
    parameters: Array


def draw(spec: TrialSpec) -> Draws:
    """Draw the random numbers of a trial."""
    system, policy, seed = spec.system, spec.policy, spec.seed
    sphere = (system.horizon, system.n_inputs)
    plans, parameters, replay = np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((0, 0, 0), np.int64)
    if isinstance(policy, ICEM):
        plans = policy.draw_plans(system, stream(seed, "sampled_plans"))
        plans = plans.reshape(len(plans), -1)
        q = spec.model.n_member_parameters(system)
        parameters = policy.draw_parameters(q, stream(seed, "sampled_parameters"))
    if isinstance(spec.learner, AdamReplay):
        replay = spec.learner.places(system.horizon, stream(seed, "replay"))
    if isinstance(policy, OpenLoop):
        inputs = _open_loop(policy, system, stream(seed, "inputs"))
    else:
        inputs = on_sphere(stream(seed, "inputs").standard_normal(sphere), system.gamma)
    return Draws(
        noise=process_noise(system, seed),
        measurement_noise=measurement_noise(system, seed),
        weights=initial_weights(spec),
        inputs=np.ascontiguousarray(inputs),
        components=stream(seed, "components").integers(system.n_learned, size=system.horizon),
        ties=on_sphere(stream(seed, "ties").standard_normal(sphere), 1.0),
        radii=_radii(spec),
        replay=replay,
        plans=plans,
        parameters=parameters,
    )


def _radii(spec: TrialSpec) -> Array:
    T, m = spec.system.horizon, spec.system.n_inputs
    if spec.model.affine_in_inputs:
        return np.ones((T, 2))
    return ball_norms(stream(spec.seed, "radii"), (T, 2), np.array([PLANNED_DIMENSIONS * m, m]))


def process_noise(system: System, seed: int) -> Array:
    """Return w_t of equation 2, (T, d), variance dt σ²; 0 for inputs in flight."""
    own = system.n_states - system.n_carried
    noise = stream(seed, "noise").standard_normal((system.horizon, own))
    scaled: Array = np.sqrt(system.dt) * system.noise * noise
    return np.pad(scaled, ((0, 0), (0, system.n_carried))) if system.n_carried else scaled


def measurement_noise(system: System, seed: int) -> Array:
    """Return v_{t+1} of y = C x + v, (T, n), for the measured states."""
    noise = stream(seed, "measurement_noise").standard_normal((system.horizon, system.n_measured))
    return np.array(system.measurement_noise) * noise


def initial_weights(spec: TrialSpec) -> Array:
    """Return the initial parameters of the model of a trial, (q,)."""
    return spec.model.initial_parameters(spec.system, stream(spec.seed, "weights"))


def _open_loop(policy: OpenLoop, system: System, rng: np.random.Generator) -> Array:
    """Return the inputs of a policy, (T, m), which may be a user's own."""
    inputs = np.asarray(policy.inputs(system, rng))
    expected = (system.horizon, system.n_inputs)
    if inputs.shape != expected or inputs.dtype.kind not in "fiu":
        raise SpecificationError(
            f"policy '{policy.name}' returned inputs of shape {inputs.shape} and type "
            f"{inputs.dtype}, but real numbers of shape {expected} are expected: correct its "
            f"inputs()."
        )
    largest = float(np.linalg.norm(inputs, axis=1).max())
    if not largest <= system.gamma * (1 + ROUNDING) and not policy.exceeds:
        raise SpecificationError(
            f"policy '{policy.name}' returned an input of norm {largest:.6g}, but env.gamma is "
            f"{system.gamma:g}: scale it down, or set exceeds = True in its class if that is meant."
        )
    return inputs.astype(np.float64)
