"""Assessments, coverage of the phase plane, and evaluation sets."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from collections import Counter
from typing import Any, ClassVar

import numpy as np
import pytest

from dopt import assessment
from dopt.assessment import MEASURES, SAMPLE_LOSS, Plane, assess, assessed, coverage
from dopt.errors import IncompatibleError, SpecificationError
from dopt.evaluation import (
    _SEED,
    LONGEST_RUN,
    evaluation_set,
    reachable_states,
    simulate,
    visited_points,
)
from dopt.kernel import run
from dopt.limits import VIOLATIONS, WORST
from dopt.offline_fit import fit_offline, recorded_samples, sample_loss
from dopt.policies import PeriodicSquare
from dopt.result import TrialResult
from dopt.run import rerun, run_trial
from dopt.spec.config import REACHABLE_VERSION
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, Cartpole, Pendulum
from dopt.systems.properties import eigenmode
from orchestrate.executors.base import Task
from orchestrate.executors.lockstep import run_batch
from tests.dopt.trials import trial

SHORT: dict[str, Any] = {"name": "control", "checkpoints": [10], "steps": 12, "settle_steps": 2}
SHORT |= {"samples": 8, "elites": 2, "lookahead": 3}


def short(env: str, policy: str, seed: int = 1, **task: object) -> TrialSpec:
    return TrialSpec.from_mapping(
        {**trial(env, policy, seed).to_mapping(), "task": {**SHORT, **task}}
    )


@pytest.fixture(scope="module")
def done() -> TrialResult:
    return run_trial(short("pendulum", "d_optimal"))


def test_every_measure_is_there_at_every_step(done: TrialResult) -> None:
    found = [(row.t, row.measure) for row in done.assessments]
    once = ("true_model_success", "true_model_cost")
    others = (*once, "feedback_success", "feedback_cost", VIOLATIONS, WORST, SAMPLE_LOSS)
    often = [name for name in MEASURES if name not in others]
    expected = {(0, name) for name in once} | set(itertools.product((0, 10, 30), often))
    assert len(found) == len(set(found))
    assert set(found) == expected


def test_pieces_and_repetition_change_nothing(
    done: TrialResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "FIRST_STEPS", 3)
    monkeypatch.setattr(run, "PIECE_SECONDS", 1e-9)
    assert run_trial(short("pendulum", "d_optimal")).assessments == done.assessments
    again = rerun(short("pendulum", "d_optimal"), [10, 30])
    np.testing.assert_array_equal(done.checkpoints[10], again.parameters[0])
    np.testing.assert_array_equal(done.checkpoints[30], done.parameters)


def test_exploration_does_not_notice_that_and_when_it_is_assessed(done: TrialResult) -> None:
    more = run_trial(short("pendulum", "d_optimal", checkpoints=[5, 10, 20])).assessments
    assert set(done.assessments) < set(more)
    plain = run_trial(trial("pendulum", "d_optimal", 1))
    assert plain.assessments == ()
    for name in ("loss", "reachable_loss", "states", "inputs", "parameters"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(done, name))


def test_both_paths_and_the_batch_agree(done: TrialResult) -> None:
    spec = short("pendulum", "d_optimal")
    spec = dataclasses.replace(spec, config=dataclasses.replace(spec.config, path="reference"))
    alone = run_trial(spec).assessments
    tasks = [Task(one.trial_key, one) for one in (spec, spec.with_seed(2))]
    batch = run_batch(tasks, "cpu")[0].outcome
    assert isinstance(batch, TrialResult)
    for rows in (alone, batch.assessments):
        assert [row[:2] for row in rows] == [row[:2] for row in done.assessments]
        np.testing.assert_allclose(
            [row.value for row in rows], [row.value for row in done.assessments], rtol=1e-6
        )


def test_policies_of_one_seed_share_what_is_not_theirs(
    done: TrialResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And do not compute it again."""
    episodes, whole = [], assessment.run_episode

    def counted(*arguments: object) -> object:
        episodes.append(arguments)
        return whole(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(assessment, "run_episode", counted)
    other = run_trial(short("pendulum", "random")).assessments
    assert len(episodes) == 2  # of those after 0, 10 and 30 steps and with the true model
    shared = [row for row in done.assessments if row.t == 0]
    assert [row for row in other if row.t == 0] == shared
    assert [row for row in other if row.t] != [row for row in done.assessments if row.t]
    assert run_trial(short("pendulum", "random", 2)).assessments[1] != other[1]


def test_with_the_true_model_learned_both_costs_are_one() -> None:
    spec = short("pendulum", "oracle")
    truth = [getattr(spec.system, name) for name in spec.system.linear_parameters]
    assert spec.task is not None
    rows = assess(spec, spec.task, {0: np.array(truth)}, np.zeros((1, 2)))
    values = {row.measure: row.value for row in rows}
    assert values["control_cost"] == pytest.approx(values["true_model_cost"], rel=1e-9)
    assert values["free_run_error"] < 1e-12
    assert values["coverage"] == 1 / 400


def test_nothing_is_said_of_what_a_diverged_trial_did_not_reach() -> None:
    spec = short("pendulum", "random", checkpoints=[1, 30])
    low = dataclasses.replace(spec.system, state_limit=0.4)
    result = run_trial(TrialSpec(dataclasses.replace(spec.config, system=low), 1))
    assert result.diverged_at is not None
    assert 1 < result.diverged_at < 30
    assert {row.t for row in result.assessments} == {0, 1}


BOX = ((-1.0, 1.0), (0.0, 4.0))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Turned(Cartpole):
    """Looked at from the cart."""

    phase_plane: ClassVar[tuple[int, int]] = (0, 1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Round(Turned):
    """On a track that is closed."""

    angle_indices: ClassVar[tuple[int, ...]] = (0, 2)


EVERYWHERE = list(itertools.product(np.linspace(-0.95, 0.95, 20), np.linspace(0.1, 3.9, 20)))


@pytest.mark.parametrize(
    ("points", "cells", "share"),
    [
        ([[-0.5, 1.0], [-0.6, 1.1]], 2, 0.25),
        (EVERYWHERE, 20, 1.0),
        ([[-1.5, 1.0], [0.5, 5.0], [np.nan, np.nan], [0.5, np.nan]], 4, 0.0),
    ],
)
def test_coverage_counts_the_cells_in_which_a_point_lies(
    points: Any, cells: int, share: float
) -> None:
    """Points outside and after a divergence lie in none."""
    assert coverage(np.array(points), BOX, cells=cells) == share


def test_an_axis_on_which_nothing_is_judged_has_what_can_be_reached() -> None:
    """As of a boat, whose drag does not depend on where it is."""
    cart = Turned()
    assert 0 not in cart.grid_indices, "its position"
    reached = reachable_states(cart)[:, 0]
    plane = Plane.of(cart)
    assert plane.box == ((reached.min(), reached.max()), cart.grid_box()[1])
    assert plane.coverage(reachable_states(cart)) > 0.1
    assert Plane.of(Round()).box[0] == pytest.approx((-math.pi, math.pi)), "a whole turn"


NAMES = sorted(SYSTEMS)


@pytest.mark.parametrize("name", NAMES)
def test_reachable_states_are_a_function_of_the_system_alone(name: str) -> None:
    system = SYSTEMS[name]()
    first = reachable_states(system)
    np.random.standard_normal(3)  # noqa: NPY002  # the state that everything may share
    assert np.array_equal(first, reachable_states(dataclasses.replace(system)))
    quiet = dataclasses.replace(system, noise=0.0, grid_points=(1,) * len(system.grid_points))
    assert np.array_equal(first, reachable_states(quiet))
    assert first.shape == (512, system.n_states)
    # The sample has a state at most as often as the runs, some of which begin alike.
    visited, _ = visited_points(system, np.random.default_rng(_SEED))
    assert Counter(map(tuple, first.tolist())) <= Counter(map(tuple, visited.tolist()))


def test_a_long_horizon_adds_no_runs_and_is_part_of_the_key_of_a_trial() -> None:
    longest, longer = Pendulum(horizon=LONGEST_RUN), Pendulum(horizon=50 * LONGEST_RUN)
    assert np.array_equal(reachable_states(longest), reachable_states(longer))
    keys = [trial("pendulum", "random", env={"horizon": s.horizon}) for s in (longest, longer)]
    versions = [json.loads(spec.config_json).get("reachable_version") for spec in keys]
    assert versions == [None, REACHABLE_VERSION]


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "arm"])
def test_the_reachable_set_has_states_that_the_square_wave_visits(name: str) -> None:
    """One of its eight sequences is the policy's, except at steps where the sine is zero."""
    system = SYSTEMS[name]()
    mode = eigenmode(system)
    assert mode is not None
    inputs = PeriodicSquare().inputs(system, np.random.default_rng(0))
    inputs[np.sin(mode.frequency * system.dt * np.arange(len(inputs))) == 0.0] = 0.0
    wave = simulate(system, inputs[:, None])[1:, 0]
    reached = {state.tobytes() for state in reachable_states(system)}
    shared = sum(state.tobytes() in reached for state in wave)
    assert 0.05 * len(reached) < shared < 0.25 * len(reached)


@pytest.mark.parametrize("name", NAMES)
def test_the_truth_at_the_points_is_that_of_the_system(name: str) -> None:
    system = SYSTEMS[name]()
    points = evaluation_set(system)
    assert points.n_grid == math.prod(system.grid_points)
    assert np.array_equal(points.states[: points.n_grid], system.grid())
    rows = list(system.learned_rows)
    known = np.array(
        [
            system.derivative(x, u)[rows]
            - np.array(system.known(tuple(x), tuple(u), system.parameters))[rows]
            for x, u in zip(points.states[::50], points.inputs[::50], strict=True)
        ]
    )
    assert points.accelerations[::50] == pytest.approx(known, rel=1e-10, abs=1e-9)


def test_states_that_overflow_or_are_beyond_the_limit_are_left_out() -> None:
    """Without a warning on the way (warnings are errors)."""
    assert np.isfinite(evaluation_set(Pendulum(dt=50.0, horizon=400)).states).all()
    points = evaluation_set(Pendulum(state_limit=1e-9, initial_state=(1.0, 0.0)))
    assert len(points.states) == points.n_grid


def sampled(env: str, policy: str, seed: int = 1, /, **sections: Any) -> TrialSpec:
    """Return a trial that ends with its sample loss."""
    mapping = trial(env, policy, seed, **sections).to_mapping()
    return TrialSpec.from_mapping(mapping | {"assess": {"sample_loss": True}})


def test_a_sample_loss_is_part_of_a_trial_only_where_it_is_asked_for() -> None:
    plain = trial("pendulum", "random", 1)
    off = TrialSpec.from_mapping(plain.to_mapping() | {"assess": {"sample_loss": False}})
    spec = sampled("pendulum", "random")
    assert off.trial_key == plain.trial_key != spec.trial_key
    assert TrialSpec.from_mapping(spec.to_mapping()) == spec
    result, without = run_trial(spec), run_trial(plain)
    assert without.assessments == ()
    np.testing.assert_array_equal(result.loss, without.loss)
    (row,) = result.assessments
    assert row == (30, SAMPLE_LOSS, sample_loss(plain, without.states, without.inputs))
    lost = dataclasses.replace(result, diverged_at=7, assessments=())
    assert assessed(spec, lost).assessments == ()


def test_a_sample_loss_knows_neither_policy_nor_model_nor_learner() -> None:
    result = run_trial(trial("cartpole", "random", 1))
    taught = {"model": {"name": "rff"}, "learner": {"name": "recursive_least_squares"}}
    specs = trial("cartpole", "d_optimal", 1, **taught), trial("cartpole", "oracle", 1)
    losses = {sample_loss(spec, result.states, result.inputs) for spec in specs}
    assert losses == {sample_loss(trial("cartpole", "random", 1), result.states, result.inputs)}


def test_a_sample_loss_tells_samples_of_a_linear_system() -> None:
    """Between the loss by least squares, which is told the form, and a network's."""
    spec = trial("mass_spring", "random", 2, env={"horizon": 200})
    result = run_trial(spec)
    samples, grid = recorded_samples(spec.system, result.states, result.inputs), spec.system.grid()
    theta = np.linalg.lstsq(samples.states, samples.accelerations, rcond=None)[0]
    errors = grid @ theta - spec.system.learned(grid)
    least = np.sqrt(np.mean(np.sum(errors**2, axis=1)))
    network = fit_offline(spec, samples.states, samples.accelerations).loss
    assert least < sample_loss(spec, result.states, result.inputs) < 0.1 * network


def test_a_trial_without_samples_of_a_model_of_the_states_is_refused() -> None:
    reading = {"model": {"name": "black_box"}}
    noisy = {"env": {"measured_states": [0], "measurement_noise": [0.01]}}
    noisy |= {"learner": {"name": "joint_ekf", "noise_variance": 0.01}}
    for sections, words in ((reading, "which reads inputs"), (noisy, "measured with noise")):
        with pytest.raises(IncompatibleError, match=words):
            sampled("pendulum", "random", **sections)
    with pytest.raises(IncompatibleError, match="which reads inputs"):
        sampled("pendulum_unknown_gain", "random")
    for given in ({"sample_loss": "on"}, {"sample_los": True}, True):
        with pytest.raises(SpecificationError, match="sample_loss"):
            TrialSpec.from_mapping(trial("pendulum", "random").to_mapping() | {"assess": given})
