"""Command line of the benchmarks and the table that it prints."""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from collections.abc import Sequence

from tabulate import tabulate

from benchmarks.machine import describe
from benchmarks.rows import Row

QUESTIONS = (
    "step",
    "compiled_plugins",
    "black_box",
    "jax_scan",
    "reference",
    "linearisation_gap",
    "adaptive_seeds",
    "evaluation",
    "trial",
    "width",
    "store",
    "orchestration",
    "scaling",
    "paper",
    "startup",
    "expansion",
    "figures",
    "pages",
)
HEADERS = ("question", "what", "measured", "target", "of target", "others", "× others", "note")
LEGEND = (
    "target: number of the target and its bound; of target: 1 or more meets it; others: the same "
    "in other people's code (benchmarks/anchors.py), and how many times faster this is."
)


def main(arguments: Sequence[str]) -> int:
    """Ask the questions and print the answers; 1 if one of them failed."""
    options = parser().parse_args(arguments)
    start = time.perf_counter()
    lines: list[list[str]] = []
    failed: list[str] = []
    about = describe()
    for question in options.only:
        try:
            rows = ask(question, options.quick)
        except Exception as error:
            failed.append(question)
            rows = [Row("failed", None, note=_first_line(error))]
        lines += [[question, row.what, *row.cells()] for row in rows]
    table = tabulate(lines, headers=HEADERS, tablefmt="github", disable_numparse=True)
    mode = "quick, for a look only" if options.quick else "medians"
    seconds = f"{time.perf_counter() - start:.0f} s in all"
    _say("\n".join([*about, f"{mode}, {seconds}", "", table, "", LEGEND]))
    return 1 if failed else 0


def ask(question: str, quick: bool) -> list[Row]:
    """Return the rows of one question; what it measures is imported now, not before."""
    sys.stderr.write(f"{question} ...\n")
    rows: list[Row] = importlib.import_module(f"benchmarks.{question}").measure(quick)
    return rows


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "--only",
        type=_questions,
        default=QUESTIONS,
        metavar="A,B",
        help=f"only these questions: {', '.join(QUESTIONS)}",
    )
    parser.add_argument("--quick", action="store_true", help="few repeats, for a look")
    return parser


def _questions(text: str) -> tuple[str, ...]:
    names = tuple(text.split(","))
    for name in names:
        if name not in QUESTIONS:
            raise argparse.ArgumentTypeError(
                f"'{name}' is no question, choose of {', '.join(QUESTIONS)}."
            )
    return names


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0]


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()
