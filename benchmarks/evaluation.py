"""Cost of the evaluation of a step, compared with the step itself."""

from __future__ import annotations

from benchmarks import anchors
from benchmarks.rows import Row, Target, Timing
from benchmarks.trials import LARGE_GRID, cartpole, cost, run_in_turn, step_us
from dopt.evaluation import evaluation_set


def measure(quick: bool) -> list[Row]:
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
        Row("8,000 points", per_point * large.mean, "µs", None, anchors.EVALUATION, "", timings[1]),
    ]
