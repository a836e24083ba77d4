"""Models of MuJoCo as black boxes: their truth, their starts, and what is refused."""

from __future__ import annotations

import dataclasses
import math
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pytest

from dopt.errors import IncompatibleError, SpecificationError, install_command
from dopt.evaluation import evaluation_set
from dopt.fields import parameter
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SIMULATORS, Feature
from dopt.systems.mujoco import MuJoCo, MuJoCoPendulum
from dopt.types import Array, Scalar

mujoco = pytest.importorskip("mujoco", reason="needs the extra mujoco")

if TYPE_CHECKING:
    from dopt.systems.black_box import BlackBox

MASS = 2.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Block(MuJoCo):
    """A block on a rail, with a motor that may push with ±3 N, by a user's model."""

    name: ClassVar[str] = "block"
    start: ClassVar[tuple[float, ...]] = (0.0,)
    state_labels: ClassVar[tuple[str, ...]] = ("y [m]", "ẏ [m/s]")
    input_labels: ClassVar[tuple[str, ...]] = ("u [N]",)
    learned_rows: ClassVar[tuple[int, ...]] = (1,)
    features: ClassVar[tuple[Feature, ...]] = (Feature("identity", 1),)
    phase_plane: ClassVar[tuple[int, int]] = (0, 1)
    grid_indices: ClassVar[tuple[int, ...]] = (1,)

    dt: float = parameter(0.01, "s", "positive")
    gamma: float = parameter(2.0, "N", "positive")
    horizon: int = parameter(50, "steps", "positive")
    grid_half_widths: tuple[float, ...] = parameter((2.0,), bound="positive")
    grid_points: tuple[int, ...] = parameter((16,), bound="positive")

    @classmethod
    def load(cls) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_string(f"""
            <mujoco>
              <option timestep="0.01"/>
              <worldbody><body>
                <joint name="rail" type="slide" axis="1 0 0"/>
                <geom type="box" size=".1 .1 .1" mass="{MASS}"/>
              </body></worldbody>
              <actuator><motor joint="rail" ctrllimited="true" ctrlrange="-3 3"/></actuator>
            </mujoco>""")

    @staticmethod
    def known(state: Scalar, inputs: Scalar, parameters: Scalar) -> tuple[Scalar, ...]:  # noqa: ARG004
        return state[1], 0.0 * state[1]


class TwoActuators(Block):
    """The block, with an actuator that its model lacks."""

    name: ClassVar[str] = "two_actuators"
    input_labels: ClassVar[tuple[str, ...]] = ("u [N]", "v [N]")


def specification(
    env: str = "mujoco_pendulum", policy: str = "random", seed: int = 0, **fields: Any
) -> TrialSpec:
    model = {"name": "affine", "width": 8}
    section = {"name": env, **fields}
    return TrialSpec.from_names(section, policy, model=model, learner="gauss_newton", seed=seed)


def points(system: BlackBox, n: int = 200) -> tuple[Array, Array]:
    """Return states of the evaluation box and inputs of norm γ at most."""
    found = evaluation_set(system)
    return found.states[:n], found.inputs[:n]


@pytest.mark.parametrize("env", SIMULATORS)
def test_a_trial_observes_the_truth_of_the_grid(env: str) -> None:
    """What the engine keeps from step to step, such as its guess of the forces, changes nothing."""
    spec = specification(env, "random_held", horizon=100)
    result = run_trial(spec)
    assert result.diverged_at is None
    system: Any = spec.system
    observed = system.observed(result.states, result.inputs)
    truth = system.true_accelerations(result.states[:-1], result.inputs)
    np.testing.assert_allclose(observed, truth, rtol=1e-4, atol=1e-6 * np.abs(truth).max())


def test_the_truth_of_the_pendulum_is_that_of_its_equation() -> None:
    """The engine takes damping implicitly: at the velocity after the step."""
    system = MuJoCoPendulum()
    states, inputs = points(system)
    length, radius, damping, weight = 0.5, 0.05, 0.1, 9.81
    inertia = length**2 + 0.4 * radius**2
    (angle, rate), u = states.T, inputs[:, 0]
    torque = weight * length * np.sin(angle) - damping * rate + u
    expected = torque / (inertia + system.dt * damping)
    np.testing.assert_allclose(system.true_accelerations(states, inputs)[:, 0], expected)


@pytest.mark.parametrize("env", ["mujoco_pendulum", "mujoco_cartpole", "mujoco_acrobot"])
def test_the_engine_says_the_same_at_the_beginning_of_a_step(env: str) -> None:
    """Where nothing is stiff, the mean over a step is what it starts with, to first order."""
    system: Any = SIMULATORS[env]()
    states, inputs = points(system)
    model = system.load()
    data, expected = mujoco.MjData(model), []
    for x, u in zip(states, inputs, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = x[: model.nq], x[model.nq :], u
        mujoco.mj_forward(model, data)
        expected.append(data.qacc.copy())
    truth = system.true_accelerations(states, inputs)
    departure = np.sqrt(np.mean((truth - expected) ** 2) / np.mean(truth**2))
    assert 0 < departure < 0.05


@pytest.mark.parametrize("env", SIMULATORS)
def test_the_loss_is_over_the_grid(env: str) -> None:
    spec = specification(env, horizon=20)
    found, system = evaluation_set(spec.system), spec.system
    assert found.n_grid == math.prod(system.grid_points) == len(system.grid())
    np.testing.assert_array_equal(found.states[: found.n_grid], system.grid())
    result = run_trial(spec)
    model = spec.model
    at = system.points(found.states, found.inputs)
    modelled = model.predict_at(system, result.parameters, at)[: found.n_grid]
    errors = modelled - found.accelerations[: found.n_grid]
    expected = np.sqrt(np.mean(np.sum(errors**2, axis=1)))
    assert result.loss[-1] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("env", SIMULATORS)
def test_positions_change_by_the_known_rates(env: str) -> None:
    """The unit of the velocities is the declared one, up to their change within a step."""
    system: Any = SIMULATORS[env]()
    run = system.episode(0)
    n = system.n_states // 2
    for u in np.repeat(np.eye(system.n_inputs)[:1] * system.gamma, 30, axis=0):
        before = run.state
        run.step(u)
        mean = 0.5 * (before + run.state)
        known = np.array(system.known(tuple(mean), tuple(u), ()))
        departure = run.state[:n] - before[:n] - system.dt * known[:n]
        largest = np.abs(run.state[n:] - before[n:]).max() * system.rate_unit * system.dt
        assert np.abs(departure).max() <= 0.6 * largest + 1e-12
        assert not known[n:].any()


def test_the_seed_decides_about_the_start_and_policies_share_it() -> None:
    first, second, other = (
        run_trial(specification(policy=policy, seed=seed, horizon=5)).states
        for policy, seed in (("random", 0), ("d_optimal", 0), ("random", 1))
    )
    np.testing.assert_array_equal(first[0], second[0])
    assert first[0, 0] != other[0, 0]
    assert abs(first[0, 0] - math.pi) < 0.1
    assert first[0, 1] == 0


def test_warnings_while_a_model_is_read_are_logged() -> None:
    """The engine would write them into a file in the working folder."""

    class Warned(Block):
        @classmethod
        def load(cls) -> mujoco.MjModel:
            assert mujoco.get_mju_user_warning() is not None
            return super().load()

    mujoco.set_mju_user_warning(None)
    assert np.isfinite(Warned().episode(0).state).all()


def test_a_model_of_a_users_own_is_explored() -> None:
    system = Block()
    spec = specification()
    own = dataclasses.replace(spec, config=dataclasses.replace(spec.config, system=system))
    result = run_trial(own)
    np.testing.assert_allclose(system.observed(result.states, result.inputs), result.inputs / MASS)
    assert result.loss[-1] < 0.1 * result.loss[0]
    run = Block().episode(0)
    assert run.step(np.array([5.0])) == 3.0, "cut to the range of the actuator"
    assert run.state[1] == pytest.approx(0.01 * 3.0 / MASS)
    with pytest.raises(SpecificationError, match="1 positions, 1 velocities and 1 actuators"):
        TwoActuators(gamma=1.0).episode(0)


def test_numbers_that_explode_end_a_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The engine would go on from its first state, and write a file into the working folder."""
    monkeypatch.chdir(tmp_path)
    caplog.set_level("INFO")
    run: Any = SIMULATORS["mujoco_acrobot"]().episode(0)
    assert np.isnan(run.step_from(np.array([0.0, 0.0, 1e11, -1e11]), np.zeros(1))).all()
    assert np.isnan(run.state).all()
    assert "MuJoCo warns" in caplog.text
    assert not list(tmp_path.iterdir())
    other = MuJoCoPendulum().episode(0)
    other.step(np.array([math.nan]))  # in whose place it would apply 0
    assert np.isnan(other.state).all()


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"dt": 0.01}, r"env\.dt is 0\.01 s, but a step .* takes 0\.02 s: set env\.dt to that"),
        ({"gamma": 1.5}, r"env\.gamma is 1\.5, but the actuators .* go to 1 only"),
        ({"noise": 0.1}, r"env\.noise is 0\.1, but to mujoco_pendulum none can be added"),
        ({"start_spread": -1}, r"env\.start_spread"),
        ({"integrator": "rk4"}, r"env\.integrator is 'rk4', but .*: set it to euler"),
    ],
)
def test_what_the_engine_would_not_do_is_refused(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(SpecificationError, match=said):
        specification(**fields)


def test_a_stored_section_names_the_system_and_its_inputs_have_to_be_learned() -> None:
    spec = specification(start_spread=0.1)
    mapping = spec.to_mapping()
    assert mapping["env"]["name"] == "mujoco_pendulum"  # type: ignore[index]
    assert TrialSpec.from_mapping(mapping) == spec
    with pytest.raises(IncompatibleError, match=r"a model that learns the effect of the inputs"):
        TrialSpec.from_mapping({**mapping, "model": {"name": "mlp"}})


def test_without_the_extra_a_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    command = re.escape(install_command("mujoco"))
    with pytest.raises(SpecificationError, match=f"needs MuJoCo, .*: {command}"):
        MuJoCoPendulum(start_spread=0.02).episode(0)
