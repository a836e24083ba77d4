"""Rows of the benchmark table: a measured value beside its target and its reference speed."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Target:
    """Value that is asked for.

    Attributes
    ----------
    number
        Of the target in the list of nine that the report explains.
    value
        Bound, in the unit of the row.
    at_least
        Whether larger is better.
    """

    number: int
    value: float
    at_least: bool = False

    def ratio(self, measured: float) -> float:
        """Return how many times better than the bound a value is; 1 meets it."""
        if self.at_least:
            return measured / self.value
        return self.value / measured if measured > 0 else float("inf")

    def text(self) -> str:
        return f"{'≥' if self.at_least else '≤'} {number(self.value)}"


@dataclass(frozen=True)
class Anchor:
    """Value of other people's code in the unit of the row, and where it comes from."""

    value: float
    source: str


TIMES = frozenset({"µs", "ms", "s", "min"})


@dataclass(frozen=True)
class Timing:
    """A time that the history keeps.

    Attributes
    ----------
    value, unit
        Quickest section, or CPU seconds, of what was measured; or a rate, whose unit ends in
        ``/s``.
    calibration
        Seconds of the quickest section of the fixed work beside it (:mod:`benchmarks.calibration`).
    """

    value: float
    unit: str
    calibration: float

    @property
    def cost(self) -> float:
        """Time in times of the fixed work, up to a factor that depends on the unit alone."""
        time = self.value if self.unit in TIMES else 1.0 / self.value
        return time / self.calibration


@dataclass(frozen=True)
class Row:
    """One line of the table; a value of None is a measurement that was left out, see ``note``.

    ``timing`` is what the history keeps, where that is more robust than the value.
    """

    what: str
    value: float | None
    unit: str = ""
    target: Target | None = None
    anchor: Anchor | None = None
    note: str = ""
    timing: Timing | None = None

    def cells(self) -> list[str]:
        """Return measured value, target, ratio to it, anchor, ratio to it and note as texts."""
        if self.value is None:
            return ["left out", *[""] * 4, self.note]
        target, anchor = self.target, self.anchor
        return [
            f"{number(self.value)} {self.unit}".strip(),
            f"{target.number}: {target.text()}" if target else "",
            f"{target.ratio(self.value):.2f}" if target else "",
            number(anchor.value) if anchor else "",
            number(anchor.value / self.value) if anchor else "",
            self.note,
        ]


def number(value: float) -> str:
    """Return a number with three significant digits or all of its whole ones."""
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.3g}"
