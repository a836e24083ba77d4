"""One look for all figures: one colour and line style per policy, fixed sizes, embedded fonts."""

from __future__ import annotations

import unicodedata
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import matplotlib

LineStyle = str | tuple[float, tuple[float, ...]]

_OKABE_ITO: tuple[str, ...] = tuple(
    matplotlib.colors.to_hex(colour) for colour in matplotlib.color_sequences["okabe_ito"]
)
BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILLION, PURPLE = _OKABE_ITO
GREY = "#8c8c8c"
CYAN, WINE, INDIGO, OLIVE = "#7fc4e8", "#882255", "#332288", "#999933"
"""Where the sequence ends: as Paul Tol's muted colours, those that are far from the others."""

BROWN, PINK = "#8b4513", "#e7298a"
"""Further ones, likewise."""

TEXT_WIDTH = 6.75
"""Width of a figure over the page [inches]."""

COLUMN_WIDTH = 4.2
"""Width of a figure of one panel [inches]."""

GUIDE: dict[str, Any] = {"color": "black", "lw": 0.8, "ls": (0, (5, 2))}
"""Look of a straight line that marks a value, such as a limit."""

_RC: dict[Any, Any] = {
    "font.size": 8,
    "font.family": "DejaVu Sans",
    "axes.titlesize": 8.5,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.use_mathtext": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.5,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "legend.handlelength": 2.6,
    "lines.linewidth": 1.2,
    "figure.dpi": 200,
    "savefig.dpi": 200,
    "pdf.fonttype": 42,
    "ps.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "dopt",
    "path.simplify": False,
}


def styled() -> AbstractContextManager[None]:
    """Return the context in which figures are made and written."""
    return matplotlib.rc_context(_RC)


@dataclass(frozen=True)
class PolicyStyle:
    """How a policy is named and drawn in every figure."""

    label: str
    colour: str
    line: LineStyle
    width: float = 1.2


# The policies of the paper come first: their greys, as printed, are as far apart as can be.
_STYLES = {
    "d_optimal": PolicyStyle("D-optimal", VERMILLION, "-", 1.6),
    "oracle": PolicyStyle("oracle", BLACK, (0, (4, 1.5))),
    "uniform": PolicyStyle("uniform", PURPLE, (0, (6, 1.2, 1.2, 1.2))),
    "periodic": PolicyStyle("periodic", BLUE, (0, (1.2, 1.2)), 1.4),
    "random": PolicyStyle("random", CYAN, (0, (2.5, 1.2))),
    "random_held": PolicyStyle("held random", GREEN, (0, (6, 1.2, 1.2, 1.2, 1.2, 1.2))),
    "random_sphere": PolicyStyle("random on the sphere", ORANGE, (0, (8, 2))),
    "prbs": PolicyStyle("PRBS", WINE, (0, (1.2, 2.4))),
    "multisine": PolicyStyle("multisine", INDIGO, (0, (4, 1.2, 1.2, 1.2, 1.2, 1.2))),
    "chirp": PolicyStyle("chirp", OLIVE, (0, (6, 2.4))),
    "lookahead": PolicyStyle("look-ahead", BLACK, (0, (9, 1)), 1.6),
    "exact": PolicyStyle("exact gain", BROWN, (0, (5, 1))),
    "trace": PolicyStyle("trace", CYAN, (0, (2, 1))),
    "trace_linearized": PolicyStyle("trace, linearised", ORANGE, (0, (3, 1, 1, 1))),
    "a_optimal": PolicyStyle("A-optimal", PURPLE, (0, (7, 1.5))),
    "e_optimal": PolicyStyle("E-optimal", OLIVE, (0, (1, 2))),
    "task": PolicyStyle("task-optimal", GREEN, (0, (5, 1, 1, 1, 1, 1))),
    "max": PolicyStyle("ensemble disagreement", PINK, (0, (4, 1, 1, 1))),
    "gaussian_process": PolicyStyle("Gaussian process", "#aa4499", (0, (5, 1, 2, 1))),
    "gradient": PolicyStyle("D-optimal, by gradient", INDIGO, (0, (7, 1))),
    "linear": PolicyStyle("D-optimal, linear", "#661100", (0, (2, 1, 5, 1))),
}


def policy_style(policy: str) -> PolicyStyle:
    """Return a policy's style; policies of a user are grey, each with dashes from its name."""
    if policy in _STYLES:
        return _STYLES[policy]
    dash = 2.0 + sum(policy.encode()) % 7
    return PolicyStyle(policy.replace("_", " "), GREY, (0, (dash, 1.5)))


def environment_title(env: str) -> str:
    """Return the name of an environment as a title."""
    return env.replace("_", " ")


def mathematical(label: str) -> str:
    """Return a label whose dotted letters are set as mathematics, where the dot sits well."""
    pieces: list[str] = []
    for letter in unicodedata.normalize("NFD", label):
        if letter == "\N{COMBINING DOT ABOVE}":
            pieces[-1] = f"$\\dot{{{_LETTERS.get(pieces[-1], pieces[-1])}}}$"
        else:
            pieces.append(letter)
    return "".join(pieces)


_LETTERS = {"φ": r"\varphi"}
