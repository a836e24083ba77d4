"""Group-sequential test of paired log ratios by random flips of their signs.

Two configurations that do not differ give log ratios d_1, d_2, ... over shared seeds whose
distribution is symmetric about 0, as the Wilcoxon signed-rank test assumes: given the |d_i|, each
sign is a fair coin. The test draws B other vectors of signs and follows the statistic of all
1 + B, the observed one included, from look to look. At look k it rejects those floor((1 + B) α_k)
vectors that have the largest statistics among the ones not yet rejected. Under the null hypothesis
the 1 + B vectors are exchangeable, so that the observed one is rejected at any of the looks with a
probability of at most Σ_k α_k = α, for any B and any |d_i|. A vector that is rejected at a level is
also rejected, not later, at every higher one.

Legend: k = 1 ... K looks, n_k seeds up to look k, W_k = |Σ_i sign(d_i) r_i| with r_i the rank of
|d_i| among the differences other than 0 (Wilcoxon 1945), α_k = α (t_k² - t_{k-1}²) the error that
may be spent at look k, t_k = n_k / n_K, t_0 = 0.

Sources: permutation paths over looks as in AdaStop (T. Mathieu et al., "AdaStop: adaptive
statistical testing for sound comparisons of deep RL agents", 2023), here with paired signs; error
spending (K. Lan and D. DeMets, 1983) by a power of the share of seeds (K. Kim and D. DeMets, 1987).
"""

from __future__ import annotations

import functools

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Statistics = npt.NDArray[np.float32]

FLIPS = 99_999
"""Random vectors of signs. With 42 comparisons at the level 0.05, the error that may be spent up to
a fifth of the seeds is 5e-5: four of them."""

SPENDING_POWER = 2
"""Power ρ of the share of seeds. Of the 4,600 trials of the claims, ρ = 1, 2 and 3 run 2,130, 2,170
and 2,360 and decide the same; the larger ρ is, the more error is left for the last looks."""

_BLOCK_ROWS = 100


class SignFlipTest:
    """Test of one comparison, look after look.

    Parameters
    ----------
    flips : int
        Number B of random vectors of signs.
    stream : int
        Stream of random numbers that they are drawn from. The decisions of a test are a function of
        it and of the differences.
    """

    def __init__(self, flips: int = FLIPS, stream: int = 0) -> None:
        self._flips = flips
        self._stream = stream
        self._looks: list[tuple[float, Statistics]] = []

    def look(self, differences: Array, share: float) -> None:
        """Look at the differences so far.

        Parameters
        ----------
        differences : (n,)
            Log ratios in the order of the seeds; those of earlier looks come first. NaN where a
            seed gives no pair, ±inf where one loss is worse than all finite ones.
        share : float
            Share t of the seeds at most that this look has, not below that of the look before.
        """
        self._looks.append((share, _statistics(differences, self._flips, self._stream)))

    def rejects(self, level: float) -> bool:
        """Tell whether a look so far rejects that the two do not differ.

        Over all looks the probability of it is at most ``level`` if they do not.
        """
        alive = np.ones(1 + self._flips, dtype=np.bool_)
        before = 0.0
        for share, statistics in self._looks:
            spent = level * (share**SPENDING_POWER - before**SPENDING_POWER)
            alive &= ~_largest(np.where(alive, statistics, -1), int(spent * len(alive)))
            if not alive[0]:
                return True
            before = share
        return False


def _largest(values: Statistics, count: int) -> npt.NDArray[np.bool_]:
    """Return which of (m,) are the ``count`` largest; none of those that tie with the next one."""
    if count <= 0:
        return np.zeros(len(values), dtype=np.bool_)
    place = len(values) - count - 1
    above: npt.NDArray[np.bool_] = values > np.partition(values, place)[place]
    return above


def _statistics(differences: Array, flips: int, stream: int) -> Statistics:
    """Return |Σ sign r| of the differences (n,) and of each vector of signs, (1 + B,).

    Sums of ranks and half ranks are exact in single precision, and so are ties of the statistics.
    """
    ranks = _ranks(np.abs(differences)).astype(np.float32)
    signs = np.sign(np.where(ranks > 0, differences, 0.0)).astype(np.float32)
    sums = np.zeros(1 + flips, dtype=np.float32)
    sums[0] = np.sum(signs * ranks)
    for start in range(0, len(ranks), _BLOCK_ROWS):
        part = ranks[start : start + _BLOCK_ROWS]
        drawn = _signs(stream, start // _BLOCK_ROWS, flips)[: len(part)]
        sums[1:] += part @ drawn.astype(np.float32)
    return np.abs(sums)


def _ranks(sizes: Array) -> Array:
    """Return the ranks of (n,) among those above 0, the mean rank for ties; 0 for 0 and NaN."""
    counted = sizes > 0
    _, place, equal = np.unique(sizes[counted], return_inverse=True, return_counts=True)
    ranks = np.zeros(len(sizes))
    ranks[counted] = (np.cumsum(equal) - (equal - 1) / 2)[place]
    return ranks


@functools.lru_cache(maxsize=4)
def _signs(stream: int, block: int, flips: int) -> npt.NDArray[np.int8]:
    """Return the signs of a hundred seeds, (100, B), the same in every process."""
    rng = np.random.default_rng([stream, block])
    return 2 * rng.integers(0, 2, (_BLOCK_ROWS, flips), dtype=np.int8) - 1
