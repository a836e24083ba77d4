"""Decisions about all comparisons of a study, with one error rate for all of them.

The probability of any wrong rejection in the whole study is at most α, whatever depends on what:
Holm's step-down procedure (1979), at each look, with group-sequential tests in place of p-values.
A test that rejects at a level rejects at all higher ones, so that this holds although each
comparison stops at a look of its own (W. Maurer and F. Bretz, "Multiple testing in group
sequential trials using graphical approaches", 2013).
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import TypeVar

from dopt.stopping.sign_flip_test import SignFlipTest

SIGNIFICANCE = 0.05
"""Probability of any wrong rejection in a study."""

Name = TypeVar("Name", bound=Hashable)


def newly_decided(
    undecided: Mapping[Name, SignFlipTest], significance: float = SIGNIFICANCE
) -> set[Name]:
    """Return which comparisons the looks so far decide, among all that are not decided yet.

    Each of m undecided ones is tested at the level α / m; with each decision m falls, until there
    is no further one.
    """
    left = dict(undecided)
    while left:
        found = {name for name, test in left.items() if test.rejects(significance / len(left))}
        if not found:
            break
        left = {name: test for name, test in left.items() if name not in found}
    return set(undecided) - set(left)
