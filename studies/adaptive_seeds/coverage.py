"""Coverage of the interval by which ``launch.until='ci<5%'`` decides how many seeds a grid needs.

Nothing is timed. Logarithms of losses are drawn from four distributions, and from the final losses
of 38 configurations (``docs/adaptive_seeds/final_losses.csv``).
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from orchestrate.runner.seed_plan import half_width, is_narrow, looks

Array = npt.NDArray[np.float64]
Draw = Callable[[np.random.Generator, tuple[int, ...]], Array]

SEEDS = 100
CLAIMS = Path(__file__).resolve().parents[2] / "docs/adaptive_seeds/final_losses.csv"

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
    """Return the coverage for losses drawn from the losses of each configuration of the claims.

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


def coverages(studies: int) -> Iterator[str]:
    """Yield lines with the simulated coverage: by shape and spread, and of stored losses."""
    for name, draw in SHAPES.items():
        for spread in (0.05, 0.1, 0.15, 0.2):
            found = coverage(draw, studies, spread)
            yield f"{name}, spread {spread:g}: {found.value:.3f} ({found.note})"
    by_name = resampled_coverages(studies // 2)
    lowest = min(by_name, key=lambda name: by_name[name].value)
    mean = np.mean([found.value for found in by_name.values()])
    yield (
        f"losses of the claims, spread 0.15: {mean:.3f} (mean of {len(by_name)}; lowest "
        f"{by_name[lowest].value:.3f}, {' '.join(lowest)})"
    )


def claimed_losses() -> dict[tuple[str, str], Array]:
    """Return the final losses of each environment and variant, (100,), NaN where it was not run."""
    with CLAIMS.open(newline="") as file:
        return {
            (row.pop("env"), row.pop("variant")): np.array(
                [float(x or "nan") for x in row.values()]
            )
            for row in csv.DictReader(file)
        }


if __name__ == "__main__":
    for line in coverages(100 if "--quick" in sys.argv else 2_000):
        sys.stdout.write(f"{line}\n")
