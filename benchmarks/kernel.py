"""Questions about single trials: a step, its evaluation, a whole trial, and the torch path."""

from __future__ import annotations

import time

import numpy as np

from benchmarks.rows import (
    EVALUATION,
    LOCKSTEP,
    RANDOM_STEP,
    STEP,
    Anchor,
    Row,
    Target,
    Timing,
    fixed_seconds,
    number,
)
from benchmarks.trials import LARGE_GRID, TINY_GRID, cartpole, cost, run_in_turn, step_us
from dopt.evaluation import evaluation_set
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec


def step(quick: bool) -> list[Row]:
    """Return the cost of a D-optimal step at q = 386, by what it learns from, and of a random one.

    A step is planning, the update of the information matrix and learning; its evaluation is
    another question.
    """
    specs = {
        "window": cartpole(),
        "one": cartpole(learner="adam"),
        "random": cartpole("random", "adam"),
        "alone": cartpole(grid=TINY_GRID),
    }
    results, fixed = run_in_turn(specs, 4 if quick else 15, run_trial)
    plan = cost(results["window"], lambda result: result.plan_us).mean
    learn = cost(results["window"], lambda result: result.learn_us).mean

    parts = f"; plan and inform {plan:.0f} µs, learn {learn:.0f} µs"
    found = {name: cost(trials, step_us) for name, trials in results.items()}

    product = product_us()
    meaning = f"numpy multiplies a 386 × 386 matrix and a vector in {number(product)} µs"

    def in_products(what: str, name: str, target: float) -> Row:
        return Row(what, found[name].mean / product, "products", Target(1, target), note=meaning)

    def row(what: str, name: str, target: float, anchor: Anchor | None, note: str = "") -> Row:
        mean, note = found[name].mean, f"p99 {number(found[name].p99)} µs{note}"
        timing = Timing(found[name].quickest, "µs", fixed)
        return Row(what, mean, "µs", Target(1, target), anchor, note, timing)

    return [
        row("D-optimal, window of 100", "window", 125, STEP, parts),
        row("D-optimal, one sample", "one", 80, None),
        row("random policy, one sample", "random", 10, RANDOM_STEP),
        row("D-optimal, window of 100, evaluated on 520 points", "alone", 125, None),
        in_products("D-optimal, window of 100, in products", "window", 3.2),
        in_products("D-optimal, one sample, in products", "one", 2.3),
    ]


def product_us() -> float:
    """Return microseconds of the quickest of 300 products of a 386 × 386 matrix and a vector."""
    rng = np.random.default_rng(0)
    A, x = rng.normal(size=(386, 386)), rng.normal(size=386)
    taken = []
    for _ in range(300):
        start = time.perf_counter()
        A @ x
        taken.append(time.perf_counter() - start)
    return 1e6 * min(taken)


def evaluation(quick: bool) -> list[Row]:
    """Return the cost of an evaluation on the default grid and on 8,000 points."""
    specs = {"default": cartpole(), "large": cartpole(grid=LARGE_GRID)}
    sizes = {name: len(evaluation_set(spec.system).states) for name, spec in specs.items()}
    results, fixed = run_in_turn(specs, rounds=4 if quick else 6)
    default, large = (
        cost(results[name], lambda result: result.evaluate_us) for name in ("default", "large")
    )
    share = default.mean / cost(results["default"], step_us).mean
    points, per_point = sizes["default"], 8_000 / sizes["large"]
    note = f"{points:,} points, reachable set included; p99 {default.p99:.0f} µs"
    timings = [Timing(one.quickest, "µs", fixed) for one in (default, large)]
    return [
        Row("default grid", default.mean, "µs", note=note, timing=timings[0]),
        Row("default grid, in steps", share, "steps", Target(1, 2)),
        Row("8,000 points", per_point * large.mean, "µs", None, EVALUATION, "", timings[1]),
    ]


TARGET_SECONDS = 0.158
"""A fortieth of what the authors' code took for 500 steps when the target was set."""


def trial(quick: bool) -> list[Row]:
    """Return seconds of a D-optimal trial of 500 steps, beside the authors' code.

    For the default grid the anchor is 500 steps without any evaluation, which favours the authors'
    code: how long it takes for so few points is not known.
    """
    specs = {"default": cartpole(), "large": cartpole(grid=LARGE_GRID)}
    rounds = 8 if quick else 12
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in specs}
    fixed = []
    for seed in range(-1, rounds):
        for name, spec in specs.items():
            taken[name].append(_seconds(spec.with_seed(max(seed, 0))))
        fixed.append(fixed_seconds())
    microseconds = {"default": STEP.value, "large": STEP.value + EVALUATION.value}
    rows = []
    for name, what in (("default", "default grid"), ("large", "8,000 points")):
        steps = specs[name].system.horizon
        anchor = Anchor(1e-6 * steps * microseconds[name], STEP.source)
        target = Target(2, TARGET_SECONDS) if name == "default" else None
        wall, cpu = map(min, zip(*taken[name][1:], strict=True))
        timing = Timing(cpu, "s", min(fixed))
        rows.append(Row(what, wall, "s", target, anchor, f"{cpu:.4f} s of CPU", timing))
    return rows


def _seconds(spec: TrialSpec) -> tuple[float, float]:
    """Return the seconds of a trial: elapsed, and of the processor."""
    wall, cpu = time.perf_counter(), time.process_time()
    run_trial(spec)
    return time.perf_counter() - wall, time.process_time() - cpu


BATCH = 100
SKIPPED = 14
"""First steps of a batch, in which torch allocates."""

SETTLED = 160
"""Steps of one trial: the window is full after 100."""


def reference(quick: bool) -> list[Row]:
    """Return the cost of a step for each trial of a batch, and trial-steps per second."""
    return _rows(1, SETTLED) + ([] if quick else _rows(BATCH, SKIPPED + 10))


def _rows(size: int, steps: int) -> list[Row]:
    from dopt.reference.batch import run_trials

    specs = [cartpole(seed=seed, horizon=steps) for seed in range(size)]
    result = run_trials(specs)[0]
    plan, learn, evaluation = _settled(result)
    what = f"torch, {f'{size} trials in lockstep' if size > 1 else 'one trial'} on cpu"
    known = LOCKSTEP if size == BATCH else None
    note = f"{min(steps, 100)} samples in the window"
    return [
        Row(what, plan + learn, "µs a step", anchor=known, note=note),
        Row(f"{what}, planned and informed", 1e6 / plan, "trial-steps/s"),
        Row(f"{what}, evaluated", 1e6 / (plan + learn + evaluation), "trial-steps/s"),
    ]


def _settled(result: TrialResult) -> list[float]:
    """Return microseconds for one trial of the batch: to plan and inform, to learn, to evaluate."""
    last = slice(max(SKIPPED, len(result.loss) - 20), None)
    parts = result.plan_us, result.learn_us, result.evaluate_us
    return [float(part[last].mean()) for part in parts]
