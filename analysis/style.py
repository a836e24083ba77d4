"""Line styles of policies and values, and numbers, counts and units as texts for people.

No plotting library is loaded. The CSV beside a table has all digits.
"""

from __future__ import annotations

import colorsys
import math
import re
import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from dopt.policies import policy_title
from dopt.systems import System

Dashes = str | tuple[float, tuple[float, ...]]
"""``"-"``, or an offset and lengths of strokes and gaps in units of the line's width."""

BLACK, GREY = "#000000", "#8c8c8c"
VERMILLION, GREEN, BLUE, PURPLE = "#D55E00", "#009E73", "#0072B2", "#CC79A7"
"""Colours of Okabe and Ito with a contrast of at least 3 : 1 to white."""

GOLD, SEA, TEAL = "#a87b00", "#3a96c8", "#00594c"
"""Their orange and sky blue, darkened to that contrast, and a dark green."""

WINE, INDIGO, OLIVE, MAROON, ORCHID = "#882255", "#332288", "#999933", "#661100", "#aa4499"
"""Muted colours of Paul Tol."""

BROWN, PINK = "#8b4513", "#e7298a"


@dataclass(frozen=True)
class LineStyle:
    """Label, colour and dashes of a line in every figure; ``width`` in points."""

    label: str
    colour: str
    line: Dashes
    width: float = 1.2


# The policies of the paper come first: their greys, as printed, are as far apart as can be.
_POLICIES: dict[str, tuple[str, Dashes, float]] = {
    "d_optimal": (VERMILLION, "-", 1.6),
    "oracle": (BLACK, (0, (4, 1.5)), 1.2),
    "uniform": (PURPLE, (0, (6, 1.2, 1.2, 1.2)), 1.2),
    "periodic": (BLUE, (0, (1.2, 1.2)), 1.4),
    "random": (TEAL, (0, (2.5, 1.2)), 1.2),
    "random_held": (GREEN, (0, (6, 1.2, 1.2, 1.2, 1.2, 1.2)), 1.2),
    "random_sphere": (GOLD, (0, (8, 2)), 1.2),
    "prbs": (WINE, (0, (1.2, 2.4)), 1.2),
    "multisine": (INDIGO, (0, (4, 1.2, 1.2, 1.2, 1.2, 1.2)), 1.2),
    "chirp": (OLIVE, (0, (6, 2.4)), 1.2),
    "periodic_square": (SEA, (0, (5, 1.2)), 1.2),
    "lookahead": (BLACK, (0, (9, 1)), 1.6),
    "icem": (TEAL, (0, (9, 1, 2, 1)), 1.6),
    "episodic": (BLUE, (0, (9, 1, 1, 1, 1, 1)), 1.2),
    "exact": (BROWN, (0, (5, 1)), 1.2),
    "trace": (SEA, (0, (2, 1)), 1.2),
    "trace_linearized": (GOLD, (0, (3, 1, 1, 1)), 1.2),
    "a_optimal": (PURPLE, (0, (7, 1.5)), 1.2),
    "e_optimal": (OLIVE, (0, (1, 2)), 1.2),
    "task": (GREEN, (0, (5, 1, 1, 1, 1, 1)), 1.2),
    "max": (PINK, (0, (4, 1, 1, 1)), 1.2),
    "gaussian_process": (ORCHID, (0, (5, 1, 2, 1)), 1.2),
    "gradient": (INDIGO, (0, (7, 1)), 1.2),
    "linear": (MAROON, (0, (2, 1, 5, 1)), 1.2),
    "space_filling": (WINE, (0, (7, 1, 2, 1)), 1.2),
}

SEQUENCE = (VERMILLION, BLUE, GREEN, BLACK, PURPLE, GOLD, INDIGO, PINK, OLIVE, SEA, WINE, TEAL)
"""Colours of the values of any other setting, in the order in which they are shown."""

_DASHES: tuple[Dashes, ...] = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (6, 1.2, 1.2, 1.2)))


def policy_style(policy: str) -> LineStyle:
    """Return a policy's style; policies of a user have a colour and dashes from their name."""
    if policy in _POLICIES:
        return LineStyle(policy_title(policy), *_POLICIES[policy])
    number = zlib.crc32(policy.encode())
    channels = colorsys.hls_to_rgb(number % 360 / 360, 0.5, 0.75)
    light = sum(w * c**2.2 for w, c in zip((0.2126, 0.7152, 0.0722), channels, strict=True))
    scale = min(1.0, (0.25 / light) ** (1 / 2.2))  # for a contrast of 3 : 1 to white
    colour = "#" + "".join(f"{round(255 * scale * channel):02x}" for channel in channels)
    return LineStyle(policy_title(policy), colour, (0, (2.0 + number // 360 % 7, 1.5)))


def sequence_style(place: int, same: int, label: str, colour: str | None = None) -> LineStyle:
    """Return the style of the value at a place, with ``same`` lines of its colour before it."""
    dashes = _DASHES[(place // len(SEQUENCE) + same) % len(_DASHES)]
    return LineStyle(label, colour or SEQUENCE[place % len(SEQUENCE)], dashes)


def environment_title(env: str) -> str:
    """Return the name of an environment as a title."""
    return env.replace("_", " ")


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


def percent_text(mean: float, error: float, n: int) -> str:
    """Return a mean share in per cent ± 2 standard errors, alone for one trial, empty for none."""
    return f"{plus_minus(100 * mean, 200 * error if n > 1 else 0.0)} %" if n else ""


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
