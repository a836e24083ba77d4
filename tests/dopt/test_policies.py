"""Inputs of every policy, space-filling designs, and disagreement of held candidates."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from dopt.errors import IncompatibleError, SpecificationError
from dopt.kernel.run import SteppedTrial
from dopt.policies import POLICIES
from dopt.policies.base import OpenLoop
from dopt.policies.held_candidates import DisagreementPlan, SpaceFilling, SpaceFillingPlan
from dopt.randomness import draw
from dopt.run import run_trial
from dopt.systems import SYSTEMS
from dopt.systems.properties import eigenmode
from dopt.trial_view import Array, TrialView
from tests.dopt.trials import ALL_PAIRS, covering, trial

BOUNDED = [
    (env, policy) for env, policy in ALL_PAIRS if not getattr(POLICIES[policy], "exceeds", False)
]


OTHER_NORMS = {"chirp", "multisine", "periodic", "random"}
"""Policies whose inputs have other norms than γ, with a model that is affine in the inputs."""


def open_loop(env: str, policy: str, horizon: int, **fields: Any) -> np.ndarray:
    """Return the inputs of a policy that observes nothing, (T, m), at γ = 3."""
    spec = trial(env, policy, env={"horizon": horizon, "gamma": 3.0}, policy=fields)
    assert isinstance(spec.policy, OpenLoop)
    return draw(spec).inputs


@pytest.mark.parametrize(("env", "policy"), covering(BOUNDED))
def test_inputs_obey_the_bound(env: str, policy: str) -> None:
    """The first one is drawn, on the sphere, where a policy is in closed loop."""
    spec = trial(env, policy, 1, env={"horizon": 12})
    inputs = run_trial(spec).inputs
    norms = np.linalg.norm(inputs, axis=1)
    assert isinstance(spec.policy, OpenLoop) or np.array_equal(inputs[0], draw(spec).inputs[0])
    assert norms.max() <= spec.system.gamma * (1 + 1e-12)
    if policy not in OTHER_NORMS:
        assert norms == pytest.approx(spec.system.gamma, rel=1e-12)


@pytest.mark.parametrize(
    ("policy", "env"), [("random", "pendulum"), ("random", "arm"), ("random_sphere", "arm")]
)
def test_white_inputs_have_the_energy_of_the_bound_and_no_memory(policy: str, env: str) -> None:
    u = open_loop(env, policy, 40_000)
    m = u.shape[1]
    assert (u**2).sum(axis=1).mean() == pytest.approx(9.0, rel=0.03)
    assert u.mean(axis=0) == pytest.approx(0.0, abs=0.1)
    assert np.atleast_2d(np.cov(u.T)) == pytest.approx(9.0 / m * np.eye(m), abs=0.2)
    assert abs((u[1:] * u[:-1]).sum(axis=1).mean()) < 0.05 * 9.0
    if policy == "random":  # they are Gaussian
        kurtosis = (u**4).mean(axis=0) / (u**2).mean(axis=0) ** 2
        assert kurtosis == pytest.approx(3.0, rel=0.1)


@pytest.mark.parametrize("hold", [1, 10, 500])
@pytest.mark.parametrize("env", ["pendulum", "quadrotor"])
def test_held_inputs_change_at_each_span_and_only_there(env: str, hold: int) -> None:
    u = open_loop(env, "random_held", 64, hold=hold)
    assert u.shape[0] == 64
    changes = np.flatnonzero(np.any(np.diff(u, axis=0) != 0.0, axis=1)) + 1
    assert np.all(changes % hold == 0)
    if env == "quadrotor":
        assert changes.tolist() == list(range(hold, 64, hold))


@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm"])
def test_a_periodic_input_is_one_line_at_the_eigenfrequency(env: str) -> None:
    spec = trial(env, "periodic", env={"horizon": 4_000, "gamma": 3.0})
    u = draw(spec).inputs
    mode = eigenmode(spec.system)
    assert mode is not None
    along = u @ mode.direction
    assert np.linalg.norm(u, axis=1) == pytest.approx(np.abs(along), abs=1e-12)
    assert np.abs(along).max() == pytest.approx(3.0, rel=1e-3)
    power = np.abs(np.fft.rfft(along)) ** 2
    frequencies = 2 * np.pi * np.fft.rfftfreq(len(along), spec.system.dt)
    near = np.abs(frequencies - mode.frequency) <= 2 * frequencies[1]
    assert power[near].sum() > 0.9 * power.sum()


def test_a_system_without_an_oscillation_takes_a_frequency() -> None:
    damped, policy = {"horizon": 50, "friction": 10.0}, {"frequency": 5.0}
    u = draw(trial("pendulum", "periodic", env=damped, policy=policy)).inputs
    times = 0.02 * np.arange(50)
    assert u[:, 0] == pytest.approx(2.0 * np.sin(5.0 * times), abs=1e-12)
    with pytest.raises(IncompatibleError, match=r"set policy\.frequency, or choose another policy"):
        trial("pendulum", "periodic", env=damped)


@pytest.mark.parametrize("env", ["pendulum", "cartpole", "arm"])
def test_the_square_wave_has_the_signs_of_the_sine_and_twice_its_energy(env: str) -> None:
    sine, square = (open_loop(env, name, 4_000) for name in ("periodic", "periodic_square"))
    assert np.linalg.norm(square, axis=1) == pytest.approx(3.0, rel=1e-12)
    assert np.all((sine * square).sum(axis=1) >= 0.0)
    along, size = (sine * square).sum(axis=1) / 3.0, np.linalg.norm(sine, axis=1)
    assert along == pytest.approx(size, abs=1e-12)
    energies = [(u**2).sum(axis=1).mean() for u in (sine, square)]
    assert energies == pytest.approx([4.5, 9.0], rel=0.01)


@pytest.mark.parametrize(
    ("policy", "env", "share"),
    [("multisine", "pendulum", 1 / 3), ("multisine", "arm", 1 / 3), ("chirp", "pendulum", 0.5)],
)
def test_the_mean_square_of_inputs_is_the_stated_share(policy: str, env: str, share: float) -> None:
    energies = [
        (draw(trial(env, policy, seed, env={"horizon": 500, "gamma": 3.0})).inputs ** 2).sum(axis=1)
        for seed in range(10)
    ]
    assert np.mean(energies) == pytest.approx(9.0 * share, rel=0.1)


@pytest.mark.parametrize("seed", range(5))
def test_no_two_inputs_of_a_short_binary_sequence_are_the_same(seed: int) -> None:
    spec = trial("chain", "prbs", seed, env={"horizon": 30, "n_links": 5}, policy={"hold": 10})
    columns = np.unique(draw(spec).inputs, axis=1)
    assert columns.shape == (30, 5)


@pytest.mark.parametrize("env", ["pendulum", "arm"])
def test_a_binary_sequence_is_balanced_and_white_over_its_clock(env: str) -> None:
    u = open_loop(env, "prbs", 10 * 1023, hold=10)
    m = u.shape[1]
    assert np.abs(u) == pytest.approx(3.0 / np.sqrt(m))
    clock = u[::10] * np.sqrt(m) / 3.0
    assert np.abs(clock.sum(axis=0)) == pytest.approx(1.0)  # one sign is met once more
    for shift in (1, 2, 17):
        correlation = (np.roll(clock, shift, axis=0) * clock).sum(axis=0)
        assert correlation == pytest.approx(-1.0)  # of all but zero, for a maximal sequence
    if m == 2:
        assert abs(clock[:, 0] @ clock[:, 1]) == pytest.approx(1.0)


@pytest.mark.parametrize("env", ["pendulum", "arm"])
@pytest.mark.parametrize("band", [0.05, 0.2])
def test_a_multisine_is_flat_inside_its_band_and_nothing_outside(env: str, band: float) -> None:
    u = open_loop(env, "multisine", 1_000, band=band)
    m, highest = u.shape[1], int(band * 500)
    power = np.abs(np.fft.rfft(u, axis=0)) ** 2
    for j in range(m):
        inside = np.arange(1 + j, highest + 1, m)
        assert power[inside, j] == pytest.approx(power[inside[0], j], rel=1e-6)
        assert np.delete(power[:, j], inside).max() < 1e-12 * power[inside[0], j]
    crest = np.linalg.norm(u, axis=1).max() / np.sqrt((u**2).sum(axis=1).mean())
    assert crest < 2.2  # of random phases it would be about 3


@pytest.mark.parametrize("env", ["pendulum", "arm"])
def test_a_chirp_rises_to_its_band(env: str) -> None:
    u = open_loop(env, "chirp", 4_000, band=0.2)
    if u.shape[1] == 2:
        assert np.linalg.norm(u, axis=1) == pytest.approx(3.0)
    crossings = np.flatnonzero(np.diff(np.sign(u[:, 0])) != 0)
    early, late = (np.sum(crossings < 400), np.sum(crossings >= 3_600))
    assert late == pytest.approx(0.2 * 0.95 * 400, rel=0.05)  # two zeros a period
    assert early == pytest.approx(0.2 * 0.05 * 400, abs=2)


@pytest.mark.parametrize("policy", ["prbs", "multisine", "chirp"])
def test_the_seed_gives_the_phase(policy: str) -> None:
    one, same, other = (
        draw(trial("pendulum", policy, seed, env={"horizon": 200})).inputs for seed in (1, 1, 2)
    )
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


CRITERIA = ("gsx", "igs", "idw")


class Straight(TrialView):
    """A trial of the pendulum whose model is a plain function of the point."""

    def __init__(self, t: int, *, reads_inputs: bool = False) -> None:
        rng = np.random.default_rng(t)
        self.system, self.t = SYSTEMS["pendulum"](), t
        self.states, self.inputs = rng.normal(size=(t + 1, 2)), rng.normal(size=(t, 1))
        self.sampled_inputs, self.sampled = self.inputs, self.states[:-1]
        self.accelerations = 3.0 * rng.normal(size=(t, 1))
        self.parameters, self.tie = np.zeros(1), np.array([1.0])
        self._reads_inputs = reads_inputs

    def points(self, states: Array, inputs: Array) -> Array:
        return np.concatenate([states, inputs], axis=1) if self._reads_inputs else states

    def predict(self, states: Array) -> Array:
        return states.sum(axis=1, keepdims=True) ** 2

    def following(self, state: Array, inputs: Array) -> Array:
        return state + np.array([0.1, 0.3]) * inputs

    def jacobian(self, state: Array) -> Array:
        raise NotImplementedError

    def jacobian_change(self, state: Array, directions: Array) -> Array:
        raise NotImplementedError

    def input_matrix(self, state: Array) -> Array:
        raise NotImplementedError


def test_an_input_is_held_for_a_step_at_least() -> None:
    with pytest.raises(SpecificationError, match=r"number of steps .* is 0"):
        Straight(3).held(np.zeros((1, 1)), 0)


def written_out(policy: SpaceFilling, view: Straight, u: float) -> float:
    """Return the worth of an input, sample by sample."""
    system, gamma = view.system, view.system.gamma
    state = view.states[-1]
    for _ in range(policy.lookahead):
        state = view.following(state, np.array([[u]]))[0]
    point = view.points(state[None], np.array([[u]]))
    scale = float(view.accelerations.std())
    pairs = []
    for x, v, y in zip(view.sampled, view.inputs, view.accelerations, strict=True):
        there = view.points(x[None], v[None])
        gap = system.featurize(state[None]) - system.featurize(x[None])
        apart = float(np.sum(gap**2)) + float(np.sum((point - there)[0, 2:] ** 2)) / gamma**2
        pairs.append((apart, float((view.predict(point)[0, 0] - y[0]) / scale) ** 2))
    if policy.criterion == "gsx":
        return math.sqrt(min(apart for apart, _ in pairs))
    if policy.criterion == "igs":
        return min(math.sqrt(apart * differing) for apart, differing in pairs)
    weights = [math.exp(-apart) / apart for apart, _ in pairs]
    spread = sum(w * differing for w, (_, differing) in zip(weights, pairs, strict=True))
    distance = math.atan(1 / sum(weights)) * 2 / math.pi
    return spread / sum(weights) + policy.weight * distance


@pytest.mark.parametrize(
    ("criterion", "lookahead", "reads_inputs"),
    list(itertools.product(CRITERIA, (1, 3), (False, True))),
)
def test_an_input_is_worth_what_its_formula_says(
    criterion: str, lookahead: int, reads_inputs: bool
) -> None:
    policy = SpaceFilling(criterion=criterion, lookahead=lookahead, weight=0.7)
    for t in (2, 9, 40):
        view = Straight(t, reads_inputs=reads_inputs)
        plan = SpaceFillingPlan(policy, view.system)
        gamma = view.system.gamma
        expected = [written_out(policy, view, u) for u in (gamma, -gamma)]
        np.testing.assert_allclose(plan.worth(view, np.array([[gamma], [-gamma]])), expected)
        assert plan.choose(view)[0] == (gamma if expected[0] > expected[1] else -gamma)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_equal_worth_is_decided_by_the_random_direction(criterion: str) -> None:
    for tie in (1.0, -1.0):
        view = Straight(5)
        view.following = lambda state, inputs: np.repeat(state[None], len(inputs), 0)  # type: ignore[method-assign]
        view.tie = np.array([tie])
        plan = SpaceFillingPlan(SpaceFilling(criterion=criterion), view.system)
        assert plan.choose(view)[0] == tie * view.system.gamma


def test_a_place_that_was_seen_is_worth_nothing_new() -> None:
    """At a sample itself the inverse distance has no weight left, and no number is infinite."""
    view = Straight(5)
    view.following = lambda _, inputs: np.repeat(view.sampled[:1], len(inputs), 0)  # type: ignore[method-assign]
    inputs = np.array([[1.0]])
    for criterion in ("gsx", "igs"):
        plan = SpaceFillingPlan(SpaceFilling(criterion=criterion), view.system)
        assert plan.worth(view, inputs)[0] == 0.0
    gap = (view.predict(view.sampled[:1]) - view.accelerations[:1]) / view.accelerations.std()
    plan = SpaceFillingPlan(SpaceFilling(criterion="idw"), view.system)
    assert plan.worth(view, inputs)[0] == pytest.approx(float(gap[0, 0]) ** 2, rel=1e-6)
    view.following = lambda state, inputs: state + 1e3 * inputs  # type: ignore[method-assign]
    assert np.isfinite(plan.worth(view, inputs)).all(), "far from all samples"


def started(env: str, steps: int, **policy: int) -> tuple[SteppedTrial, DisagreementPlan]:
    """Return a trial after some steps, and its plan."""
    fast = SteppedTrial(trial(env, "max", 3, policy=policy, env={"horizon": 12}))
    fast.advance(steps)
    assert fast._parts is not None
    assert isinstance(fast._parts._planner, DisagreementPlan)
    return fast, fast._parts._planner


@pytest.mark.parametrize("lookahead", [1, 3])
@pytest.mark.parametrize("env", ["cartpole", "quadrotor"])
def test_the_worth_is_the_variance_across_networks_where_the_input_leads(
    env: str, lookahead: int
) -> None:
    fast, plan = started(env, 4, ensemble=3, lookahead=lookahead, candidates=5)
    system, predict = fast.spec.system, fast.spec.model.predict
    members = [fast.parameters, *plan._others]
    assert fast._parts is not None
    found = plan.worth(fast._parts._view(4))
    for u, worth in zip(plan._inputs, found, strict=True):
        z, expected = fast.states[4], 0.0
        for _ in range(lookahead):
            mean = np.mean([predict(system, theta, z[None])[0] for theta in members], axis=0)
            step = np.array(system.known(tuple(z), tuple(u), system.parameters))
            step[list(system.learned_rows)] += mean
            z = z + system.dt * step
            each = [predict(system, theta, z[None])[0] for theta in members]
            expected += np.var(each, axis=0).sum()
        assert worth == pytest.approx(expected, rel=1e-9)
    fast.advance(5)
    assert np.array_equal(fast.inputs[4], plan._inputs[np.argmax(found)])
    assert np.ptp(found) > 0.0


@pytest.mark.parametrize("learner", ["adam", "adam_window"])
def test_every_network_learns_what_the_trials_own_learns(learner: str) -> None:
    """Started from the same weights they stay the same."""
    fast = SteppedTrial(trial("arm", "max", 3, learner={"name": learner}))
    plan = fast._parts._planner  # type: ignore[union-attr]
    assert isinstance(plan, DisagreementPlan)
    assert len(np.unique(np.concatenate([fast.parameters[None], plan._others]), axis=0)) == 5
    plan._others[:] = fast.parameters
    fast.advance(12)
    assert plan._others == pytest.approx(np.tile(fast.parameters, (4, 1)), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("model", ["rff", "grey_box", "ensemble"])
def test_an_ensemble_is_one_of_several_networks(model: str) -> None:
    with pytest.raises(SpecificationError, match=r"policy\.ensemble is 1.*at least 2"):
        trial("arm", "max", policy={"ensemble": 1})
    learner = {"rff": "recursive_least_squares", "ensemble": "gauss_newton"}.get(model, "adam")
    with pytest.raises(IncompatibleError, match="policy 'max' goes with model 'mlp'"):
        trial("arm", "max", model={"name": model}, learner={"name": learner})
