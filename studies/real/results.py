"""Rows of the page: errors on runs that were left out, beside the reference, with intervals."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from analysis.style import within
from analysis.tables.rendering import TextTable
from studies.real.data import SOURCES
from studies.real.protocol import Array, Fold

DRAWS = 2000
LEVEL = 0.95


def root_mean_square(runs: Sequence[Array]) -> Array:
    """Return the root mean square of the errors of all runs, each (k, h, n)."""
    found: Array = np.sqrt(np.mean(np.square(np.concatenate(runs)), axis=0))
    return found


def typical(runs: Sequence[Array]) -> Array:
    """Return the geometric mean over runs of the median error."""
    medians = [np.median(np.abs(run), axis=0) for run in runs]
    found: Array = np.exp(np.mean(np.log(np.maximum(medians, 1e-12)), axis=0))
    return found


@dataclass(frozen=True)
class Question:
    """A number that is asked of the errors on the runs that were left out.

    Attributes
    ----------
    plant : str
    words : str
        What it is, for a reader.
    measure : callable
        Of errors to (h, n).
    places : (int, int)
        Which horizon and which measured state.
    at_most : float
        Bound that is to be kept; NaN without one.
    of_ratio : bool
        Whether the bound is one of the ratio to the reference, and not of the error.
    """

    plant: str
    words: str
    measure: Callable[[Sequence[Array]], Array]
    places: tuple[int, int] = (0, 0)
    at_most: float = np.nan
    of_ratio: bool = True


def rows(questions: Sequence[Question], found: Mapping[str, Sequence[Fold]]) -> pd.DataFrame:
    """Return a row for each question about plants whose runs were predicted."""
    return pd.DataFrame([_row(one, found[one.plant]) for one in questions if one.plant in found])


def _row(question: Question, folds: Sequence[Fold]) -> dict[str, object]:
    centre = _both(question, [(fold.ours, fold.theirs) for fold in folds])
    rng = np.random.default_rng(zlib.crc32(f"{question.plant}/{question.words}".encode()))
    drawn = np.array([_both(question, _drawn(folds, rng)) for _ in range(DRAWS)])
    tail = (1 - LEVEL) / 2
    ends = np.nanquantile(drawn, [tail, 1 - tail], axis=0)
    row: dict[str, object] = {"plant": question.plant, "question": question.words}
    row |= {"runs": len(folds), "windows": sum(len(fold.ours) for fold in folds)}
    for name, value, low, high in zip(("error", "reference", "ratio"), centre, *ends, strict=True):
        row |= {name: value, f"{name}_low": low, f"{name}_high": high}
    of = "ratio" if question.of_ratio else "error"
    bound = "" if np.isnan(question.at_most) else f"{of} ≤ {question.at_most:g}"
    kept = centre[2 if question.of_ratio else 0] <= question.at_most
    return row | {"bound": bound, "kept": ("yes" if kept else "no") if bound else ""}


def _both(question: Question, runs: Sequence[tuple[Array, Array]]) -> tuple[float, float, float]:
    """Return the error, the error of the reference, and their ratio."""
    ours, theirs = (
        float(question.measure(side)[question.places]) for side in zip(*runs, strict=True)
    )
    return ours, theirs, ours / theirs if theirs > 0 else np.nan


def _drawn(folds: Sequence[Fold], rng: np.random.Generator) -> list[tuple[Array, Array]]:
    """Return errors of runs that are drawn with replacement, and of stretches within each."""
    out = []
    for i in rng.integers(len(folds), size=len(folds)):
        fold = folds[i]
        kinds = np.unique(fold.stretches)
        counts = np.bincount(rng.integers(len(kinds), size=len(kinds)), minlength=len(kinds))
        at = np.repeat(
            np.arange(len(fold.stretches)), counts[np.searchsorted(kinds, fold.stretches)]
        )
        out.append((fold.ours[at], fold.theirs[at]))
    return out


def table(found: pd.DataFrame) -> TextTable:
    """Return the table of the page."""
    lines = [
        [
            row["plant"],
            row["question"],
            *(
                within(row[what], row[f"{what}_low"], row[f"{what}_high"])
                for what in ("error", "reference", "ratio")
            ),
            f"{row['bound']}: {row['kept']}" if row["kept"] else "–",
        ]
        for row in found.fillna({"bound": "", "kept": ""}).to_dict("records")
    ]
    named = {plant.split(",")[0] for plant in found.plant}
    sources = [
        f"{name}: {one.short}, {one.licence}" for name, one in SOURCES.items() if name in named
    ]
    head = ["plant", "error", "here [rad]", "reference [rad]", "ratio", "bound"]
    return TextTable(head, lines, f"Runs of {'; '.join(sources)}.")
