"""Scores: one number for each trial, which tables average, and their paired comparison.

Policies are compared in the same environment on the same seeds, with common random numbers. The
import of scipy.stats takes longer than most commands: it is done where a test is made.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from analysis.data.samples import read_sample
from analysis.data.selection import Entry
from analysis.stats.curves import CONFIDENCE, band, interval_of_mean
from dopt.types import Array, Booleans
from orchestrate.store import Assessments, Reader


class Measure(StrEnum):
    """Measure by which a trial is judged.

    ``FINAL`` is the loss after the last step, ``AUC`` the geometric mean of the loss over all
    steps, whose logarithm is the area under the logarithmic loss curve by its length, and ``STEPS``
    the number of inputs until the loss first is at most ε.
    """

    FINAL = "final"
    AUC = "auc"
    STEPS = "steps"


BySeed = Mapping[int, float]
"""One number for each seed of an entry whose trial did not diverge."""


def values_of(scores: BySeed) -> Array:
    """Return the numbers (n,), by rising seed."""
    return np.array([scores[seed] for seed in sorted(scores)], dtype=float)


def final_losses(reader: Reader, entry: Entry, column: str) -> BySeed:
    """Return the loss after the last step of each trial; from the summary column where it is."""
    if column != "loss":
        return _scores(reader, entry, column, lambda values: values[:, -1])
    return entry.final_losses()


def mean_losses(reader: Reader, entry: Entry, column: str) -> BySeed:
    """Return the geometric mean of the loss over all steps of each trial."""
    return _scores(reader, entry, column, mean_over_steps)


def first_passage(values: Array, threshold: float) -> Array:
    """Return the number of inputs until a curve of (n, T) first is at most the threshold.

    The first loss counts as one input. A curve that never gets there is censored: inf.
    """
    reached = values <= threshold
    return np.where(reached.any(axis=1), reached.argmax(axis=1) + 1.0, np.inf)


def last_passage(values: Array, threshold: float) -> Array:
    """Return the number of inputs after which a curve of (n, T) stays at most the threshold.

    The first loss counts as one input. A curve that ends above it is censored: inf.
    """
    above = ~(values <= threshold)
    n_steps = values.shape[1]
    last = np.where(above.any(axis=1), n_steps - above[:, ::-1].argmax(axis=1), 0)
    return np.where(last < n_steps, last + 1.0, np.inf)


def steps_to(
    reader: Reader,
    entry: Entry,
    column: str,
    threshold: float,
    passage: Callable[[Array, float], Array] = first_passage,
) -> BySeed:
    """Return the steps until the loss is at most the threshold, inf where it never is.

    By default for the first time (:func:`first_passage`).
    """
    return _scores(reader, entry, column, lambda values: passage(values, threshold))


def mean_over_steps(values: Array) -> Array:
    """Return exp of the mean logarithm along the steps of losses (n, T); 0 where one of them is."""
    with np.errstate(divide="ignore"):
        found: Array = np.exp(np.mean(np.log(values), axis=1))
    return found


def _scores(reader: Reader, entry: Entry, column: str, score: Callable[[Array], Array]) -> BySeed:
    sample = read_sample(reader, entry, column)
    return dict(zip(sample.seeds.tolist(), score(sample.values).tolist(), strict=True))


@dataclass(frozen=True)
class Comparison:
    """Comparison of a variant's losses with a reference's over shared seeds.

    Attributes
    ----------
    n_pairs : int
        Seeds on which neither diverged.
    ratio, low, high : float
        Geometric mean of loss / reference loss over the pairs of which both are finite, and its
        paired interval; below 1 the variant is better. NaN, as the p-value is, where a loss is 0
        and has no logarithm.
    improvement : float
        Probability of improvement: share of pairs with the lower loss, ties counted half.
    p_value : float
        Two-sided Wilcoxon signed-rank test of the logarithms' differences.
    """

    n_pairs: int
    ratio: float
    low: float
    high: float
    improvement: float
    p_value: float


def compare(loss: Array, reference: Array, rng: np.random.Generator) -> Comparison:
    """Compare losses, both (n,) and paired by position; NaN where n is too small.

    A loss may be inf, worse than every finite one: it has no ratio, but counts in the probability
    of improvement and as the largest difference in the test; two of a pair are equal. A pair with a
    NaN is left out.
    """
    known = ~(np.isnan(loss) | np.isnan(reference))
    loss, reference = loss[known], reference[known]
    n, unknown = len(loss), float("nan")
    if not n:
        return Comparison(0, *[unknown] * 5)
    wins = float(np.mean(loss < reference) + np.mean(loss == reference) / 2)
    if np.min(loss) <= 0 or np.min(reference) <= 0:
        return Comparison(n, unknown, unknown, unknown, wins, unknown)
    both_lost = np.isinf(loss) & np.isinf(reference)
    ours, theirs = (np.log(np.where(both_lost, 1.0, one)) for one in (loss, reference))
    finite = np.isfinite(loss) & np.isfinite(reference)
    difference = ours - theirs
    p_value = signed_rank(difference)
    if not finite.any():
        return Comparison(n, unknown, unknown, unknown, wins, p_value)
    low, high = np.exp(interval_of_mean(difference[finite], rng))
    ratio = float(np.exp(np.mean(difference[finite])))
    return Comparison(n, ratio, float(low), float(high), wins, p_value)


def without_ratio(loss: Array, reference: Array) -> int:
    """Return how many pairs of (n,) are in no ratio, as one of the two is not finite."""
    return int(np.sum(~(np.isfinite(loss) & np.isfinite(reference))))


def signed_rank(differences: Array) -> float:
    """Return the two-sided Wilcoxon signed-rank p of (n,); 1 when nothing differs."""
    if not np.any(differences):
        return 1.0
    from scipy import stats

    return float(stats.wilcoxon(differences).pvalue)


def benjamini_hochberg(p_values: Sequence[float]) -> list[float]:
    """Return p adjusted for the false discovery rate over a table; NaN is no test and stays."""
    p = np.asarray(p_values, dtype=float)
    tested = np.isfinite(p)
    adjusted = np.full(p.shape, np.nan)
    if tested.any():
        from scipy import stats

        adjusted[tested] = stats.false_discovery_control(p[tested], method="bh")
    return [float(value) for value in adjusted]


@dataclass(frozen=True)
class HittingTimes:
    """Comparison of the steps in which a variant and a reference reach a loss, over shared seeds.

    A trial that never reaches it is censored at the end of the trial: it lost to any that did, and
    two such trials are a tie.

    Attributes
    ----------
    n_pairs : int
        Seeds on which neither diverged.
    reached, reached_reference : int
        Trials that reached it.
    median, median_reference : float
        Median number of steps, the upper one of two; inf unless more than half reached it.
    improvement : float
        Share of pairs in which the variant was earlier, ties counted half.
    p_value : float
        Two-sided sign test of the pairs that are no tie.
    """

    n_pairs: int
    reached: int
    reached_reference: int
    median: float
    median_reference: float
    improvement: float
    p_value: float


def compare_hitting_times(steps: Array, reference: Array) -> HittingTimes:
    """Compare steps, both (n,) and paired by position, inf where the loss was never reached."""
    earlier, later = int(np.sum(steps < reference)), int(np.sum(steps > reference))
    n = len(steps)
    return HittingTimes(
        n_pairs=n,
        reached=int(np.isfinite(steps).sum()),
        reached_reference=int(np.isfinite(reference).sum()),
        median=censored_median(steps),
        median_reference=censored_median(reference),
        improvement=(earlier + (n - earlier - later) / 2) / n if n else float("nan"),
        p_value=sign_test(earlier, later) if n else float("nan"),
    )


def mcnemar(successes: Array, reference: Array) -> float:
    """Return the exact two-sided McNemar p of successes, 0 or 1, both (n,) and paired by position.

    It is the sign test of the pairs of which one succeeded alone.
    """
    return sign_test(int(np.sum(successes > reference)), int(np.sum(successes < reference)))


def censored_median(steps: Array) -> float:
    """Return the median of (n,), the upper one of two; inf where it is censored, NaN for none."""
    return float(np.sort(steps)[len(steps) // 2]) if len(steps) else float("nan")


def sign_test(wins: int, losses: int) -> float:
    """Return the two-sided p of the sign test; 1 when nothing differs."""
    if not wins + losses:
        return 1.0
    from scipy import stats

    return float(stats.binomtest(wins, wins + losses).pvalue)


def on_front(costs: Array) -> Booleans:
    """Return which of n choices are on the Pareto front of their costs (n, k), lower is better.

    A choice is dominated by another that costs at most as much in every respect and less in one.
    Equal choices do not dominate each other. One with an unknown cost, NaN, is not on the front.
    """
    one, other = costs[:, None, :], costs[None, :, :]
    dominated = np.any(np.all(other <= one, axis=2) & np.any(other < one, axis=2), axis=1)
    found: Booleans = ~dominated & ~np.isnan(costs).any(axis=1)
    return found


Interval = tuple[float, float, float]
"""Centre, low and high."""


def common_task(entries: Iterable[Entry]) -> str | None:
    """Return the task by which most trials were assessed, None without one.

    Costs and successes of different tasks are not compared.
    """
    totals: Counter[str] = Counter()
    for entry in entries:
        task = task_of(entry)
        if task is not None:
            totals[task] += len(entry.trials)
    return max(totals, key=lambda task: (totals[task], task)) if totals else None


def task_of(entry: Entry) -> str | None:
    """Return the task by which trials of an entry were assessed, as JSON, None without one."""
    task = entry.config.config.get("task")
    return json.dumps(task, sort_keys=True) if task and entry.final_losses() else None


def measured(reader: Reader, entry: Entry, *measures: str) -> list[Assessments]:
    """Return measures of the trials that the entry holds as finished, all of one moment."""
    seeds = [trial.seed for trial in entry.finished]
    with reader.moment() as moment:
        found = [moment.assessments(entry.config.config_key, measure) for measure in measures]
    kept = [np.isin(one.seeds, seeds) for one in found]
    return [
        Assessments(one.seeds[rows], one.t, one.values[rows], one.diverged[rows])
        for one, rows in zip(found, kept, strict=True)
    ]


def true_model(reader: Reader, entries: Iterable[Entry]) -> dict[str, float]:
    """Return what the true model achieved on the seeds of some entries, each seed once.

    Trials of one seed, environment and task share that episode: it is the ceiling of the others.
    ``n`` seeds, the share of successes with its Wilson interval of 95 %, ``success``,
    ``success_low`` and ``success_high``, and how many of the episodes have no finite cost,
    ``lost``. NaN without seeds.
    """
    successes: dict[int, float] = {}
    costs: dict[int, float] = {}
    with reader.moment() as moment:
        for entry in entries:
            own = measured(moment, entry, "true_model_success", "true_model_cost")
            for total, found in zip((successes, costs), own, strict=True):
                total.update(_first(found))
    known = [seed for seed, success in successes.items() if np.isfinite(success)]
    finite = usable(np.array([costs.get(seed, np.nan) for seed in known]))
    shares = success_rate(np.array(list(successes.values())))
    columns = ("success", "success_low", "success_high")
    return {
        "n": len(known),
        **dict(zip(columns, shares, strict=True)),
        "lost": int(np.sum(~finite)),
    }


def _first(found: Assessments) -> dict[int, float]:
    """Return the number of each seed after the first number of steps."""
    return dict(zip(found.seeds.tolist(), found.values[:, :1].ravel().tolist(), strict=True))


def relative_costs(reader: Reader, entry: Entry) -> Assessments:
    """Return the cost of each trial and number of steps, relative to its true model's.

    It is inf where the episode has no finite cost, and NaN where there was no episode or where the
    true model's has no finite cost, so that nothing can be said.
    """
    measures = "control_cost", "control_success", "true_model_cost"
    costs, successes, truths = measured(reader, entry, *measures)
    reached, of_seed = np.isfinite(successes.values), _first(truths)
    divisors = np.array([of_seed.get(seed, np.nan) for seed in costs.seeds.tolist()])
    divisors = np.where(usable(divisors), divisors, np.nan)
    values = np.where(reached & ~np.isfinite(costs.values), np.inf, costs.values)
    return Assessments(costs.seeds, costs.t, values / divisors[:, None], costs.diverged)


def success_rate(successes: Array) -> Interval:
    """Return the share of successes among (n,), NaN left out, with its Wilson interval."""
    known = successes[np.isfinite(successes)]
    if not len(known):
        return np.nan, np.nan, np.nan
    from scipy import stats  # its import takes longer than most commands

    test = stats.binomtest(int(np.sum(known)), len(known))
    interval = test.proportion_ci(confidence_level=CONFIDENCE, method="wilson")
    return float(np.mean(known)), float(interval.low), float(interval.high)


def usable(values: Array) -> Booleans:
    """Return which costs or ratios have a logarithm."""
    return np.isfinite(values) & (values > 0)


def geometric_mean(ratios: Array) -> Interval:
    """Return the geometric mean of the finite ones of (n,), with Student's interval."""
    known = np.log(ratios[usable(ratios)])
    found = band(known[:, None])
    centre, low, high = (float(np.exp(end[0])) for end in (found.centre, found.low, found.high))
    return centre, low, high


def scores_at(reader: Reader, entry: Entry, t: int) -> BySeed:
    """Return the relative cost of each trial that reached t explored steps.

    As in :func:`relative_costs` a lost episode has inf, and NaN where the true model's was lost.
    """
    with reader.moment() as moment:
        costs = relative_costs(moment, entry)
        (successes,) = measured(moment, entry, "control_success")
    reached = np.isfinite(successes.values)
    at = costs.t == t
    seeds = costs.seeds[reached[:, at].any(axis=1)]
    column = costs.values[reached & at]
    return dict(zip(seeds.tolist(), column.tolist(), strict=True))
