"""State feedback: an input for each state."""

from __future__ import annotations

from typing import Protocol

from dopt.types import Array


class Feedback(Protocol):
    """A law of control that is evaluated every ``hold`` steps; its input is held in between."""

    @property
    def hold(self) -> int: ...

    def __call__(self, state: Array) -> Array:
        """Return the input, (m,), ‖u‖ ≤ γ, at a state, (d,)."""
