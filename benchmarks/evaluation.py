"""Cost of the evaluation of a step, compared with the step itself."""

from __future__ import annotations

from benchmarks import anchors
from benchmarks.rows import Row, Target
from benchmarks.trials import LARGE_GRID, cartpole, median_of, run_in_turn, settled, step_us
from dopt.evaluation import evaluation_set


def measure(quick: bool) -> list[Row]:
    """Return the cost of an evaluation on the default grid and on 8,000 points."""
    specs = {"default": cartpole(), "large": cartpole(grid=LARGE_GRID)}
    sizes = {name: len(evaluation_set(spec.system).states) for name, spec in specs.items()}
    results = run_in_turn(specs, rounds=2 if quick else 6)
    cost = {
        name: median_of(trials, lambda result: settled(result.evaluate_us))
        for name, trials in results.items()
    }
    share = median_of(results["default"], lambda r: settled(r.evaluate_us) / step_us(r))
    points = f"{sizes['default']:,} points, reachable set included"
    per_point = cost["large"] / sizes["large"]
    return [
        Row("default grid", cost["default"], "µs", note=points),
        Row("default grid, in steps", share, "steps", Target(1, 2), note="issue: at most twice"),
        Row("8,000 points", 8_000 * per_point, "µs", anchor=anchors.EVALUATION),
    ]
