"""Compiled equations, steps, pointers to structures, callees, episodes and evaluation."""

from __future__ import annotations

import itertools
import pickle
import re
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from numba.core.codegen import CPUCodeLibrary
from numba.core.cpu import CPUContext
from numba.core.errors import TypingError

from dopt.evaluation import evaluation_set
from dopt.kernel import cache, run, warming
from dopt.kernel.compiler import compiled
from dopt.kernel.equations import compiled_equations
from dopt.kernel.held import HeldTrial, pointer_to, trial_in
from dopt.kernel.pointers import compiled_for, held_kind, kind_of
from dopt.kernel.run import KernelTrial, run_trial_in_kernel
from dopt.kernel.warming import leave_callees_out
from dopt.policies import Episodic
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, Chain, Pendulum, System
from dopt.types import Vector
from tests.dopt.custom_networks import model_of_one
from tests.dopt.custom_plugins import kept
from tests.dopt.kernel.twin import relative_gap
from tests.dopt.trials import trial

ALL = [*(cls() for cls in SYSTEMS.values()), Chain(n_links=3)]


@pytest.mark.parametrize("system", ALL, ids=lambda system: f"{system.name}-{system.n_states}")
def test_compiled_equations_are_those_of_the_system(system: System) -> None:
    rng = np.random.default_rng(0)
    equations, p = compiled_equations(system), np.array(system.parameters)
    x, u = rng.standard_normal(system.n_states), rng.standard_normal(system.n_inputs)
    known, learned = np.empty(system.n_states), np.empty(system.n_learned)
    equations.known(x, u, p, known)
    point = system.points(x[None], u[None])[0]
    equations.accelerations(point, p, learned)
    assert known == pytest.approx(np.array(system.known(tuple(x), tuple(u), system.parameters)))
    assert learned == pytest.approx(system.learned(x[None], inputs=u[None])[0], rel=1e-12)
    z, slopes = point + 1e-30j * rng.standard_normal(len(point)), np.empty(len(learned), complex)
    equations.complex_accelerations(z, p + 0j, slopes)
    exact = np.array(system.accelerations(tuple(z), system.parameters))
    assert slopes.imag == pytest.approx(exact.imag, rel=1e-10, abs=1e-42)


@dataclass(frozen=True, kw_only=True)
class Springy(Pendulum):
    """A system that no one has registered."""

    name: ClassVar[str] = "springy"

    @staticmethod
    def accelerations(state: Any, parameters: Any) -> tuple[Any, ...]:
        return (-parameters[2] * state[0] ** 3,)


def test_equations_from_elsewhere_are_compiled_but_not_cached() -> None:
    """Only the sources of the package are part of the name of the cache's folder."""
    equations, out = compiled_equations(Springy()), np.empty(1)
    equations.accelerations(np.array([2.0, 0.0]), np.array(Springy().parameters), out)
    assert out[0] == -80.0
    assert equations.accelerations.stats.cache_path is None
    own = compiled_equations(Pendulum()).accelerations
    assert str(cache.CACHE_FOLDER) in own.stats.cache_path


def symbols(system: System) -> list[str]:
    """Return the symbols of the compiled equations without Numba's running number."""
    names = [
        code.fndesc.mangled_name
        for function in compiled_equations(system)
        for code in function.overloads.values()
    ]
    return [re.sub(r"B\d+v\d+B", "", name) for name in names]


def test_no_two_systems_share_a_symbol() -> None:
    """Two that do and come from different processes can be taken for each other: wrong physics."""
    physics = {(cls.known, cls.accelerations): cls() for cls in SYSTEMS.values()}
    different = [*physics.values(), Chain(n_links=2)]
    shipped = [symbol for system in different for symbol in symbols(system)]
    assert len(shipped) == 3 * len(different)
    assert len(set(shipped)) == len(shipped)
    assert not set(symbols(Springy())[1:]) & set(shipped)


FRESH = {"information": "fresh", "refresh_every": 4}
CASES = [
    trial("pendulum", "d_optimal", 1, env={"horizon": 60}),
    trial("quadrotor", "d_optimal", 1, env={"horizon": 60}, policy={"form": "dual"}),
    trial("arm", "d_optimal", 1, env={"horizon": 60}, policy={"form": "sketch"}),
    trial("cartpole", "uniform", 1, env={"horizon": 60}),
    trial("car", "gaussian_process", 1, env={"horizon": 60}),
    trial("mass_spring", "d_optimal", 1, env={"horizon": 60}, policy=FRESH),
]


@pytest.mark.parametrize("spec", CASES, ids=lambda spec: spec.system.name)
def test_numbers_do_not_depend_on_pieces(spec: TrialSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = run_trial_in_kernel(spec)
    lasts: list[int] = []
    advance = KernelTrial.advance

    def noted(trial: KernelTrial, last: int) -> None:
        lasts.append(last)
        advance(trial, last)

    monkeypatch.setattr(KernelTrial, "advance", noted)
    monkeypatch.setattr(run, "FIRST_STEPS", 7)
    monkeypatch.setattr(run, "PIECE_SECONDS", 1e-9)
    pieces = run_trial_in_kernel(spec)
    assert lasts == [*range(7, 61)]
    for name in ("loss", "reachable_loss", "states", "inputs", "parameters"):
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name))


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
    function = compiled_for(numbers, (held_kind(fast.trial), kind_of(out)))
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


SMALL = {"hold": 3, "stride": 2, "plans": 9, "iterations": 2, "elites": 3, "samples": 6}


def spec_of(env: str, lookahead: int, replan_every: int, hold: int) -> TrialSpec:
    given = SMALL | {"lookahead": lookahead, "replan_every": replan_every, "hold": hold}
    return trial(env, "episodic", 3, policy=given, model={"width": 8})


@pytest.mark.parametrize(("replan_every", "hold"), [(2, 1), (6, 3), (11, 10)])
def test_between_two_searches_inputs_are_those_of_the_plan(replan_every: int, hold: int) -> None:
    spec = spec_of("arm", 11, replan_every, hold)
    policy = spec.policy
    assert isinstance(policy, Episodic)
    fast = KernelTrial(spec)
    shape = (1 + policy.elites, policy.segments, 2)
    starts = [1, *range(replan_every, 30, replan_every), 30]  # at which plans are drawn
    for start, following in itertools.pairwise(starts):
        fast.advance(start + 1)
        best = fast.state.policy_memory.reshape(shape)[1].copy()
        fast.advance(following)
        assert np.array_equal(fast.state.policy_memory.reshape(shape)[1], best)
        for t in range(start, following):
            assert np.array_equal(fast.record.inputs[t], best[t // hold - start // hold])
    assert len(np.unique(fast.record.inputs[1:], axis=0)) > 3


@pytest.mark.parametrize(("env", "hold"), [("pendulum", 1), ("arm", 3)])
def test_planned_anew_at_every_step_it_is_the_sampling_planner(env: str, hold: int) -> None:
    fields = SMALL | {"lookahead": 7, "hold": hold}
    every = run_trial(spec_of(env, 7, 1, hold))
    plain = run_trial(trial(env, "icem", 3, policy=fields, model={"width": 8}))
    assert relative_gap(every.inputs, plain.inputs) < 1e-9


def losses(spec: TrialSpec, theta: np.ndarray, step: int = 0) -> tuple[float, float]:
    """Return the L2 errors over the grid and over the reachable states, point by point."""
    points, model = evaluation_set(spec.system), model_of_one(spec.system, spec.model)
    found = np.stack([model(torch.tensor(theta), x).numpy() for x in torch.tensor(points.states)])
    squares = ((found - spec.system.learned(points.states, step)) ** 2).sum(axis=1)
    means = squares[: points.n_grid].mean(), squares[points.n_grid :].mean()
    return float(np.sqrt(means[0])), float(np.sqrt(means[1]))


@pytest.mark.parametrize(("bend", "precision"), [(0.5, 1e-5), (0.1, 1e-8), (1e-3, 1e-6)])
def test_a_small_loss_is_not_lost_in_rounding(bend: float, precision: float) -> None:
    """One tanh of a small argument nearly is the friction of a pendulum without gravity."""
    spec = trial(
        "pendulum",
        "random",
        env={"horizon": 1, "gravity": 0.0, "grid_points": [16, 16]},
        model={"depth": 1, "width": 1},
        learner={"learning_rate": 1e-300},
    )
    pendulum, fast = spec.system, KernelTrial(spec)
    width = pendulum.grid_half_widths[1]
    slope = -3.0 * pendulum.friction / (pendulum.mass * pendulum.length**2)  # type: ignore[attr-defined]
    fast.state.theta[:] = [0.0, 0.0, bend, 0.0, slope * width / bend, 0.0]
    fast.advance(1)
    grid, reachable = losses(spec, fast.state.theta)
    assert grid < bend**2 * abs(slope) * width
    assert fast.record.loss[0] == pytest.approx(grid, rel=precision)
    assert fast.record.reachable_loss[0] == pytest.approx(reachable, rel=precision)


@pytest.mark.parametrize("points", [[1, 1], [15, 17], [16, 16], [257, 1], [40, 20]])
def test_any_number_of_points_is_evaluated(points: list[int]) -> None:
    spec = trial("pendulum", "random", env={"horizon": 1, "grid_points": points})
    fast = KernelTrial(spec)
    fast.advance(1)
    grid, reachable = losses(spec, fast.state.theta)
    assert fast.record.loss[0] == pytest.approx(grid, rel=1e-5)
    assert fast.record.reachable_loss[0] == pytest.approx(reachable, rel=1e-5)


def test_steps_that_are_done_are_not_done_again() -> None:
    spec = trial("pendulum", "d_optimal", 1)
    straight, back = KernelTrial(spec), KernelTrial(spec)
    straight.advance(20)
    for last in (10, 5, 10, 20):
        back.advance(last)
    np.testing.assert_array_equal(back.parameters, straight.parameters)
    assert np.isnan(back.states[21:]).all()


def test_callees_have_no_code_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """And callees are optimized in their callers alone."""
    for owner, name in (
        (CPUCodeLibrary, "_optimize_final_module"),
        (CPUCodeLibrary, "_finalize_final_module"),
        (CPUContext, "get_executable"),
    ):
        monkeypatch.setattr(owner, name, getattr(owner, name))  # is as before when the test ends
    optimized: list[str] = []

    def optimize(library: CPUCodeLibrary) -> None:
        optimized.append(library.name)
        whole(library)

    whole = warming._optimize
    monkeypatch.setattr(warming, "_optimize", optimize)

    @compiled
    def total(values: Vector) -> float:
        result = 0.0
        for value in values:
            if value < 0.0:
                raise ValueError("a value is below zero")
            result += value
        return result

    @compiled
    def mean(values: Vector) -> float:
        return total(values) / len(values)

    leave_callees_out()
    assert mean(np.array([1.0, 2.0, 6.0])) == 3.0
    with pytest.raises(ValueError, match="below zero"):
        mean(np.array([1.0, -2.0]))
    for function, count in ((mean, 1), (total, 0)):
        [result] = function.overloads.values()  # has the compiler's back end made code of it?
        assert (result.library._compiled_object is not None) == count
        assert sum(function.__name__ in name for name in optimized) == count
