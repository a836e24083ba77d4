"""Matplotlib settings of all figures: sizes, fonts, axes."""

from __future__ import annotations

import unicodedata
from contextlib import AbstractContextManager
from typing import Any

import matplotlib

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
    """Return the context in which figures are made and written, whatever a matplotlibrc says."""
    defaults: dict[Any, Any] = {**matplotlib.rcParamsDefault}
    del defaults["backend"]  # none is needed, and to ask for it looks for one
    return matplotlib.rc_context({**defaults, **_RC})


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
