"""Global random generators, lent to a library that draws from them."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch


class GlobalRandomness:
    """States of the global generators of Python, numpy and torch that one agent goes on from.

    Parameters
    ----------
    seed : int
        Seed of all three, below 2^32.
    """

    def __init__(self, seed: int) -> None:
        with _kept():
            random.seed(seed)
            np.random.seed(seed)  # noqa: NPY002  # the generator that the library draws from
            torch.manual_seed(seed)
            self._states = _states()

    @contextmanager
    def lent(self) -> Iterator[None]:
        """Make the global generators those of the agent; afterwards they are as before."""
        with _kept():
            _restore(self._states)
            yield
            self._states = _states()


@contextmanager
def _kept() -> Iterator[None]:
    before = _states()
    try:
        yield
    finally:
        _restore(before)


def _states() -> tuple[Any, ...]:
    return random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002


def _restore(states: tuple[Any, ...]) -> None:
    own, numpy_state, torch_state = states
    random.setstate(own)
    np.random.set_state(numpy_state)  # noqa: NPY002
    torch.set_rng_state(torch_state)
