"""A small database that looks like a real one: true systems, made-up losses, the real store."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dopt.assessment import violations
from dopt.errors import IncompatibleError
from dopt.evaluation import simulate
from dopt.models import MLP
from dopt.result import Assessment, TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import System
from dopt.systems.properties import eigenmode
from orchestrate.store import LaunchRecord, Reader, RunRecord, Store

Array = npt.NDArray[np.float64]
Edit = Callable[[TrialSpec, TrialResult], TrialResult]
"""Change of a made-up result before it is stored."""

ENVIRONMENTS = ("pendulum", "cartpole", "arm", "quadrotor")
POLICIES = ("d_optimal", "oracle", "uniform", "periodic", "random")
RATES = {"d_optimal": 5.0, "oracle": 7.0, "uniform": 3.5, "periodic": 3.0, "random": 1.5}


def make_spec(system: str, name: str, seed: int, **sections: Mapping[str, object]) -> TrialSpec:
    """Return a trial of the paper's setting; ``sections`` override fields of env, model, ..."""
    linear = name == "oracle"
    mapping: dict[str, object] = {
        "env": {"name": system},
        "policy": {"name": name},
        "model": {"name": "linear" if linear else "mlp"},
        "learner": {"name": "recursive_least_squares" if linear else "adam_window"},
        "seed": seed,
    }
    for key, fields in sections.items():
        mapping[key] = {**mapping.get(key, {}), **fields}  # type: ignore[dict-item]
    return TrialSpec.from_mapping(mapping)


@contextmanager
def filled(folder: Path, specs: Sequence[TrialSpec], **options: Any) -> Iterator[Reader]:
    """Store trials in a new database in a folder, as ``fill`` does, and read it."""
    url = f"sqlite:///{folder}/results.db"
    fill(url, specs, **options)
    with Reader.open(url) as reader:
        yield reader


def make_grid(
    environments: Iterable[str] = ENVIRONMENTS,
    policies: Iterable[str] = POLICIES,
    seeds: Iterable[int] = range(4),
    **sections: Mapping[str, object],
) -> list[TrialSpec]:
    """Return the trials of a grid, incompatible pairs left out."""
    specs = []
    for env in environments:
        for policy in policies:
            try:
                specs += [make_spec(env, policy, seed, **sections) for seed in seeds]
            except IncompatibleError:
                continue
    return specs


def fake_result(spec: TrialSpec, diverged_at: int | None = None) -> TrialResult:
    """Simulate the true system under a stand-in for the policy; the losses fall exponentially."""
    [result] = fake_results([spec], {spec.trial_key: diverged_at} if diverged_at else {})
    return result


def fake_results(specs: Sequence[TrialSpec], diverged: Mapping[str, int]) -> list[TrialResult]:
    """Return results of trials; trials of one system are simulated together, which is faster."""
    draws = [np.random.default_rng(_entropy(spec)) for spec in specs]
    inputs = [_inputs(s.system, s.policy.name, rng) for s, rng in zip(specs, draws, strict=True)]
    members: dict[System, list[int]] = defaultdict(list)
    for i, spec in enumerate(specs):
        members[spec.system].append(i)
    states: dict[int, Array] = {}
    for system, group in members.items():
        together = np.stack([inputs[i] for i in group], axis=1)
        states.update(zip(group, np.moveaxis(simulate(system, together), 1, 0), strict=True))
    return [
        _result(spec, inputs[i], states[i], draws[i], diverged.get(spec.trial_key))
        for i, spec in enumerate(specs)
    ]


def _entropy(spec: TrialSpec) -> list[int]:
    return [spec.seed, *spec.policy.name.encode(), *spec.system.name.encode()]


def _result(
    spec: TrialSpec, inputs: Array, states: Array, rng: np.random.Generator, diverged_at: int | None
) -> TrialResult:
    system, policy = spec.system, spec.policy.name
    loss = _losses(system.horizon, RATES.get(policy, 2.0), rng)
    columns = {
        "loss": loss,
        "reachable_loss": 0.5 * loss,
        "plan_us": rng.gamma(5, 4, system.horizon) * _size(spec),
        "learn_us": rng.gamma(5, 8, system.horizon),
        "evaluate_us": rng.gamma(5, 2, system.horizon),
    }
    if diverged_at is not None:
        for values in (*columns.values(), inputs, states[1:]):
            values[diverged_at:] = np.nan
    assessments = _assessments(spec, rng) if spec.task else ()
    if spec.limits:
        last = system.horizon if diverged_at is None else diverged_at
        assessments += violations(spec.limits.excess(system, states[1 : last + 1]))
    return TrialResult(
        **columns,
        states=states,
        inputs=inputs,
        parameters=rng.normal(size=spec.model.n_parameters(system)),
        diverged_at=diverged_at,
        wall_seconds=0.1,
        cpu_seconds=0.1,
        assessments=assessments,
    )


def _assessments(spec: TrialSpec, rng: np.random.Generator) -> tuple[Assessment, ...]:
    """Return costs that fall to the true model's, and successes that follow them."""
    rate = RATES.get(spec.policy.name, 2.0)
    rows = [Assessment(0, "true_model_success", 1.0), Assessment(0, "true_model_cost", 100.0)]
    for t in spec.assessed_steps:
        relative = 1.0 + 2.0 * np.exp(-rate * t / spec.system.horizon) * rng.uniform(0.8, 1.2)
        rows += [
            Assessment(t, "control_success", float(relative < 1.5)),
            Assessment(t, "control_cost", 100.0 * relative),
            Assessment(t, "free_run_error", relative - 1.0),
            Assessment(t, "coverage", t / spec.system.horizon),
        ]
    return tuple(rows)


def _size(spec: TrialSpec) -> float:
    """Return what planning costs more for a wider network: the square of the width."""
    return (spec.model.width / 16) ** 2 if isinstance(spec.model, MLP) else 1.0


def _inputs(system: System, policy: str, rng: np.random.Generator) -> Array:
    T, m, time = system.horizon, system.n_inputs, system.dt * np.arange(system.horizon)
    mode = eigenmode(system)
    if policy == "random" or mode is None:
        noise: Array = system.gamma / np.sqrt(m) * rng.normal(size=(T, m))
        return noise
    wave = np.sin(mode.frequency * time)
    if policy == "d_optimal":
        wave = np.where(rng.random(T) < 0.1, -1.0, 1.0) * np.where(wave < 0, -1.0, 1.0)
    elif policy != "periodic":
        wave = np.sign(wave + rng.normal(size=T))
    inputs: Array = system.gamma * wave[:, None] * mode.direction
    return inputs


def _losses(horizon: int, rate: float, rng: np.random.Generator) -> Array:
    level = np.exp(rng.normal(scale=0.4))
    floor = 0.3 * np.exp(rng.normal(scale=0.3))
    ripple = np.exp(np.cumsum(rng.normal(scale=0.02, size=horizon)))
    curve: Array = (12 * level * np.exp(-rate * np.arange(horizon) / horizon) + floor) * ripple
    return curve


def fill(
    url: str,
    specs: list[TrialSpec],
    skipped: Iterable[TrialSpec] = (),
    diverged: Mapping[str, int] | None = None,
    edit: Edit = lambda _, result: result,
) -> None:
    """Register all trials and run all but the skipped; ``diverged`` maps trial keys to steps.

    ``edit`` may change the made-up result of a trial before it is stored.
    """
    left = {spec.trial_key for spec in skipped}
    with Store.open(url) as store:
        launch = store.begin_launch(LaunchRecord(argv=["test"], overrides=[], host="h", pid=1))
        store.register(launch, specs)
        todo = [spec for spec in specs if spec.trial_key not in left]
        claims = {
            claim.trial_key: claim for claim in store.claim(launch, [s.trial_key for s in todo])
        }
        now = datetime(2026, 1, 1, tzinfo=UTC)
        run = RunRecord("h", 1, 0.1, 0.1, 1, now, now)
        lost = diverged or {}
        mine = [spec for spec in todo if spec.trial_key in claims]
        items = [
            (claims[spec.trial_key], edit(spec, result), run)
            for spec, result in zip(mine, fake_results(mine, lost), strict=True)
        ]
        assert all(store.commit_many(items))
        store.end_launch(launch, "done")


def simulated(spec: TrialSpec, _: TrialResult) -> TrialResult:
    """Return the result of the trial itself in place of a made-up one."""
    return run_trial(spec)


def valued(value: Callable[[TrialSpec, Assessment], float | None]) -> Edit:
    """Return an edit that gives assessments the value of a function; None keeps their own."""

    def edit(spec: TrialSpec, result: TrialResult) -> TrialResult:
        found = [(row, value(spec, row)) for row in result.assessments]
        rows = (row if new is None else row._replace(value=new) for row, new in found)
        return replace(result, assessments=tuple(rows))

    return edit
