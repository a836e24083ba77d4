"""Numbers, counts and units as texts for people; the CSV beside a table has all digits."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping

from dopt.systems import System


def number(value: float, digits: int = 3) -> str:
    """Return a number with some significant digits, a dash for NaN."""
    if math.isnan(value):
        return "–"
    if value == 0 or not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}" if value else "0"
    rounded = float(f"{value:.{digits - 1}e}")
    places = digits - 1 - math.floor(math.log10(abs(rounded)))
    return f"{rounded:.{max(places, 0)}f}"


def p_text(value: float) -> str:
    """Return a p-value to two significant digits, a dash for none."""
    if math.isnan(value):
        return "–"
    return f"{value:.2g}" if value >= 1e-4 else f"{value:.0e}"


def share(value: float) -> str:
    """Return a share to two places, a dash for none."""
    return "–" if math.isnan(value) else f"{value:.2f}"


def plus_minus(value: float, error: float) -> str:
    """Return ``mean ± error``, the error to two digits and the mean to the same place.

    A mean that :func:`number` writes with an exponent has it here too: ``(4.02 ± 0.62)e-05``.
    """
    if not error > 0:
        return number(value)
    if 0 < abs(value) < 1e-4:
        exponent = math.floor(math.log10(abs(value)))
        scale = 10.0**exponent
        return f"({plus_minus(value / scale, error / scale)})e{exponent:03d}"
    places = max(0, 1 - math.floor(math.log10(error)))
    return f"{value:.{places}f} ± {error:.{places}f}"


def steps_text(median: float, horizon: int) -> str:
    """Return a median number of steps, ``> horizon`` for one that is censored, a dash for NaN."""
    if math.isnan(median):
        return "–"
    return f"> {horizon}" if math.isinf(median) else f"{median:.0f}"


def within(value: float, low: float, high: float) -> str:
    """Return a number with its interval, or alone without one."""
    if math.isnan(low):
        return number(value)
    return f"{number(value)} [{number(low)}, {number(high)}]"


def but_lost(text: str, lost: int) -> str:
    """Return what is said of some episodes, and how many are not in it: ``1.3, 2 lost``."""
    return f"{text}, {lost} lost" if lost else text


def but_diverged(count: int, diverged: int) -> str:
    """Return a number of trials or pairs, and how many trials diverged: ``98, 2 diverged``."""
    return f"{count}, {diverged} diverged" if diverged else str(count)


def of_finished(used: int, finished: int, diverged: int) -> str:
    """Return how many finished trials are in a statistic, such as ``98/100, 2 diverged``."""
    return f"{used}/{finished}, {diverged} diverged" if diverged else str(used)


def count_text(counts: Mapping[str, str]) -> str:
    """Return the counts by policy as a text: the commonest one, then those that differ from it.

    ``{"a": "100", "b": "100", "c": "98/100, 2 diverged"}`` gives
    ``n = 100; c: 98/100, 2 diverged``.
    """
    if not counts:
        return "n = 0"
    common, _ = Counter(counts.values()).most_common(1)[0]
    others = [f"{name}: {count}" for name, count in counts.items() if count != common]
    return "; ".join([f"n = {common}", *others])


def loss_unit(system: System) -> str:
    """Return the unit of the loss, the learned accelerations' own, such as ``rad/s²``.

    Where these have several units the loss is the root of a sum over them: ``m/s², rad/s²``.
    """
    units = [_rate(unit_of(system.state_labels[row])) for row in system.learned_rows]
    return ", ".join(sorted(set(units)))


def unit_of(label: str, without: str = "1") -> str:
    """Return the unit in a label, such as N of ``u [N]``; ``without`` where it has none."""
    found = re.search(r"\[([^\]]+)\]", label)
    return found.group(1) if found else without


def _rate(unit: str) -> str:
    """Return a unit by second: ``rad/s`` gives ``rad/s²``."""
    return f"{unit}²" if unit.endswith("/s") else f"{unit}/s"
