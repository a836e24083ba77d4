"""Cost of a step, by the kernel's own clocks, inside whole trials."""

from __future__ import annotations

from benchmarks import anchors
from benchmarks.rows import Row, Target
from benchmarks.trials import TINY_GRID, cartpole, median_of, run_in_turn, settled, step_us


def measure(quick: bool) -> list[Row]:
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
    results = run_in_turn(specs, rounds=2 if quick else 15)
    cost = {name: median_of(trials, step_us) for name, trials in results.items()}
    plan = median_of(results["window"], lambda result: settled(result.plan_us))
    learn = median_of(results["window"], lambda result: settled(result.learn_us))
    parts = f"plan and inform {plan:.0f} µs, learn {learn:.0f} µs"
    return [
        Row("D-optimal, window of 100", cost["window"], "µs", Target(1, 125), anchors.STEP, parts),
        Row("D-optimal, one sample", cost["one"], "µs", Target(1, 80)),
        Row("random policy, one sample", cost["random"], "µs", Target(1, 10), anchors.RANDOM_STEP),
        Row("D-optimal, window of 100, evaluated on 520 points", cost["alone"], "µs"),
    ]
