"""Cost of a step, by the kernel's own clocks, inside whole trials."""

from __future__ import annotations

from benchmarks import anchors
from benchmarks.rows import Anchor, Row, Target, Timing, number
from benchmarks.trials import TINY_GRID, cartpole, cost, run_in_turn, step_us
from dopt.run import run_trial


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
    results, fixed = run_in_turn(specs, 4 if quick else 15, run_trial)
    plan = cost(results["window"], lambda result: result.plan_us).mean
    learn = cost(results["window"], lambda result: result.learn_us).mean

    parts = f"; plan and inform {plan:.0f} µs, learn {learn:.0f} µs"
    found = {name: cost(trials, step_us) for name, trials in results.items()}

    def row(what: str, name: str, target: float, anchor: Anchor | None, note: str = "") -> Row:
        mean, note = found[name].mean, f"p99 {number(found[name].p99)} µs{note}"
        timing = Timing(found[name].quickest, "µs", fixed)
        return Row(what, mean, "µs", Target(1, target), anchor, note, timing)

    return [
        row("D-optimal, window of 100", "window", 125, anchors.STEP, parts),
        row("D-optimal, one sample", "one", 80, None),
        row("random policy, one sample", "random", 10, anchors.RANDOM_STEP),
        row("D-optimal, window of 100, evaluated on 520 points", "alone", 125, None),
    ]
