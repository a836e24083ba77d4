"""Error rates, power, coverage and savings of the rules that decide how many seeds a grid needs.

Nothing is timed. The studies are simulated: logarithms of losses are drawn from four distributions,
and both configurations of a pair share a term of each seed, as common random numbers give one. The
savings are those on final losses of the claims (``docs/adaptive_seeds/final_losses.csv``): what
``launch.until`` would have run of the 4,600 trials, and whether it decides what all of them do.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.rows import Row
from dopt.stopping.family import SIGNIFICANCE, newly_decided
from dopt.stopping.fixed_width import half_width, is_narrow
from dopt.stopping.looks import looks
from dopt.stopping.sign_flip_test import FLIPS, SignFlipTest

Array = npt.NDArray[np.float64]
Draw = Callable[[np.random.Generator, tuple[int, ...]], Array]

SEEDS = 100
FEW_FLIPS = 1_999
"""The error rate holds for any number of flips; fewer than in a launch make the studies quick."""

CLAIMS = Path(__file__).resolve().parents[1] / "docs" / "adaptive_seeds"
REFERENCE = "D-optimal"

SHAPES: dict[str, Draw] = {
    "normal": lambda rng, size: rng.standard_normal(size),
    "skewed": lambda rng, size: (rng.gumbel(size=size) - np.euler_gamma) * np.sqrt(6) / np.pi,
    "heavy tails": lambda rng, size: rng.standard_t(3, size) / np.sqrt(3),
    "exponential": lambda rng, size: rng.standard_exponential(size) - 1,
}
"""Logarithms of losses, of mean 0 and standard deviation 1: normal, Gumbel's, Student's t with
three degrees of freedom, and exponential."""


@dataclass(frozen=True)
class Share:
    """Share of n simulated studies, and the mean number of seeds of a study."""

    value: float
    n: int
    seeds: float

    @property
    def note(self) -> str:
        error = 2 * np.sqrt(self.value * (1 - self.value) / self.n)
        return f"± {error:.2g}, {self.n:,} studies, {self.seeds:.0f} of {SEEDS} seeds"


def rejections(
    draw: Draw,
    studies: int,
    effect: float = 0.0,
    missing: float = 0.0,
    seed: int = 0,
    *,
    single: bool = False,
) -> Share:
    """Return the share of comparisons that are decided, each alone at the level 0.05.

    ``effect`` is the mean log ratio in standard deviations of a loss' logarithm, and ``missing``
    the share of seeds without a pair. With ``single`` there is one look, at all seeds.
    """
    rng = np.random.default_rng([1, seed])
    used = []
    for study in range(studies):
        variant, reference = draw(rng, (2, SEEDS))
        differences = effect + variant - reference
        differences[rng.random(SEEDS) < missing] = np.nan
        numbers = [SEEDS] if single else None
        used.append(decisions(differences[None], stream=study, numbers=numbers)[0])
    return _share(used)


def wrong_studies(draw: Draw, studies: int, comparisons: int, seed: int = 0) -> Share:
    """Return the share of studies with a wrong decision, and the seeds of their comparisons.

    All comparisons have one reference. Half of the variants differ from it by one standard
    deviation; a decision about another one is wrong.
    """
    rng = np.random.default_rng([2, seed])
    wrong, seeds = [], []
    for study in range(studies):
        reference, *variants = draw(rng, (1 + comparisons, SEEDS))
        effects = np.arange(comparisons) % 2
        used = decisions(np.array(variants) - reference + effects[:, None], stream=study)
        wrong.append(any(n for n, effect in zip(used, effects, strict=True) if not effect))
        seeds += [n or SEEDS for n in used]
    return Share(float(np.mean(wrong)), studies, float(np.mean(seeds)))


def decisions(
    differences: Array,
    flips: int = FEW_FLIPS,
    stream: int = 0,
    numbers: Sequence[int] | None = None,
) -> list[int | None]:
    """Return for each comparison of a study (m, n) the number of seeds that decided it.

    ``numbers`` are those of the looks, by default those of a launch.
    """
    tests = {row: SignFlipTest(flips, stream) for row in range(len(differences))}
    used: list[int | None] = [None] * len(differences)
    for n in numbers or looks(differences.shape[1]):
        for row, test in tests.items():
            test.look(differences[row, :n], n / differences.shape[1])
        for row in newly_decided(tests, SIGNIFICANCE):
            used[row] = n
            del tests[row]
    return used


def _share(used: list[int | None]) -> Share:
    seeds = float(np.mean([n or SEEDS for n in used]))
    return Share(float(np.mean([n is not None for n in used])), len(used), seeds)


def coverage(
    draw: Draw, studies: int, spread: float, relative: float = 0.05, seed: int = 0
) -> Share:
    """Return the share of studies whose interval holds the geometric mean of the losses.

    ``spread`` is the standard deviation of a loss' logarithm.
    """
    rng = np.random.default_rng([3, seed])
    held, seeds = [], []
    for _ in range(studies):
        losses = np.exp(spread * draw(rng, (SEEDS,)))
        n = next(n for n in looks(SEEDS) if n == SEEDS or is_narrow(losses[:n], relative))
        held.append(abs(np.mean(np.log(losses[:n]))) <= half_width(losses[:n]))
        seeds.append(n)
    return Share(float(np.mean(held)), studies, float(np.mean(seeds)))


def resampled_coverages(studies: int) -> dict[tuple[str, str], Share]:
    """Return the coverage for losses drawn from those of each configuration of the claims.

    Their logarithms are scaled to a spread of 0.15, so that the rule stops between its looks.
    """
    found = {}
    for name, losses in claimed_losses().items():
        logs = np.log(losses)
        if not np.isnan(logs).any():
            standard = (logs - np.mean(logs)) / np.std(logs)
            found[name] = coverage(_resampled(standard), studies, 0.15)
    return found


def _resampled(values: Array) -> Draw:
    return lambda rng, size: rng.choice(values, size)


def measure(quick: bool) -> list[Row]:
    """Return simulated error rates, power and coverage, and the savings on the claims."""
    studies = 100 if quick else 2_000
    simulated = [*_errors(studies), *_powers(studies), *_coverages(studies)]
    return [*simulated, *_savings()]


def _errors(studies: int) -> Iterator[Row]:
    for name, draw in SHAPES.items():
        found = rejections(draw, studies)
        yield Row(f"wrong decisions, one comparison, {name}", found.value, note=found.note)
    found = rejections(SHAPES["skewed"], studies, missing=0.1)
    yield Row("the same, skewed, 10 % without a pair", found.value, note=found.note)
    for name, draw in SHAPES.items():
        found = wrong_studies(draw, studies // 4, comparisons=8)
        what = f"studies with a wrong decision, 8 comparisons, {name}"
        yield Row(what, found.value, note=found.note)


def _powers(studies: int) -> Iterator[Row]:
    for effect in (0.1, 0.2, 0.4, 0.6, 1.0, 2.0):
        found = rejections(SHAPES["skewed"], studies // 4, effect)
        whole = rejections(SHAPES["skewed"], studies // 4, effect, single=True)
        note = f"{found.note}; {whole.value:.3g} with one look at all seeds"
        yield Row(f"power at {effect:g} standard deviations", found.value, note=note)


def _coverages(studies: int) -> Iterator[Row]:
    for name, draw in SHAPES.items():
        for spread in (0.05, 0.1, 0.15, 0.2):
            found = coverage(draw, studies, spread)
            yield Row(f"coverage of ci<5%, {name}, spread {spread:g}", found.value, note=found.note)
    by_name = resampled_coverages(studies // 2)
    lowest = min(by_name, key=lambda name: by_name[name].value)
    yield Row(
        "coverage of ci<5%, losses of the claims, spread 0.15",
        float(np.mean([found.value for found in by_name.values()])),
        note=f"mean of {len(by_name)}; lowest {by_name[lowest].value:.3f}, {' '.join(lowest)}",
    )


@dataclass(frozen=True)
class Claim:
    """Comparison of the claims.

    Attributes
    ----------
    seeds
        Seeds that decided it, None if all of them did not.
    below
        Whether the variant's losses are below the reference's, in the geometric mean over them.
    told_apart, published_below
        The same of the published comparison with all seeds: whether its adjusted p is below 0.05
        and its interval does not hold 1, and whether its ratio is below 1.
    """

    env: str
    variant: str
    seeds: int | None
    below: bool
    told_apart: bool
    published_below: bool

    @property
    def agrees(self) -> bool:
        """Whether the decision is the published one, the direction included."""
        if self.seeds is None or not self.told_apart:
            return (self.seeds is not None) == self.told_apart
        return self.below == self.published_below


def claims(flips: int = FLIPS) -> list[Claim]:
    """Return the comparisons of the claims, decided as ``launch.until=decided`` does."""
    losses = claimed_losses()
    published = {(row["env"], row["variant"]): row for row in _rows("comparisons.csv")}
    names = [name for name in losses if name[1] != REFERENCE]
    ratios = np.array([np.log(losses[name]) - np.log(losses[name[0], REFERENCE]) for name in names])
    return [
        Claim(
            *name,
            n,
            below=bool(np.nanmean(ratio[:n]) < 0),
            told_apart=_is_told_apart(published[name]),
            published_below=float(published[name]["loss_ratio"]) < 1,
        )
        for name, ratio, n in zip(names, ratios, decisions(ratios, flips), strict=True)
    ]


def _is_told_apart(row: dict[str, str]) -> bool:
    low, high = float(row["loss_low"]), float(row["loss_high"])
    return float(row["loss_p_adjusted"]) < SIGNIFICANCE and not low <= 1 <= high


def claimed_losses() -> dict[tuple[str, str], Array]:
    """Return the final losses of each environment and variant, (100,), NaN where it was not run."""
    return {
        (row.pop("env"), row.pop("variant")): np.array([float(x or "nan") for x in row.values()])
        for row in _rows("final_losses.csv")
    }


def _rows(name: str) -> list[dict[str, str]]:
    with (CLAIMS / name).open(newline="") as file:
        return list(csv.DictReader(file))


def _savings() -> Iterator[Row]:
    found = claims()
    envs = {claim.env for claim in found}
    run = sum(claim.seeds or SEEDS for claim in found)
    run += sum(max(one.seeds or SEEDS for one in found if one.env == env) for env in envs)
    total = SEEDS * (len(found) + len(envs))
    decided = sum(claim.seeds is not None for claim in found)
    note = f"{run:,} of {total:,} trials run, {decided} of {len(found)} comparisons decided"
    yield Row("claims, trials saved by until=decided", 1 - run / total, note=note)
    others = [f"{one.env} {one.variant}" for one in found if not one.agrees]
    agreed = 1 - len(others) / len(found)
    yield Row(
        "claims, decisions as published", agreed, note=f"other: {'; '.join(others) or 'none'}"
    )
