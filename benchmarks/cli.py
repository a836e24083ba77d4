"""Command line of the benchmarks: a table, and the history that its run is added to."""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tabulate import tabulate

from benchmarks import history
from benchmarks.history import Run, Slower, describe
from benchmarks.rows import Row, fixed_seconds, number

QUESTIONS = {
    **dict.fromkeys(("step", "reference", "evaluation", "trial"), "kernel"),
    "jax_scan": "jax_scan",
    **dict.fromkeys(
        ("store", "orchestration", "scaling", "paper", "startup", "expansion"), "grids"
    ),
    **dict.fromkeys(("figures", "pages"), "reading"),
}
"""Modules that answer the questions, each by a function of its name."""

HEADERS = ("question", "what", "measured", "target", "of target", "others", "× others", "note")
LEGEND = (
    "target: number of the target and its bound; of target: 1 or more meets it; others: the same "
    "in other people's code, measured as follows, and how many times faster this is."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Ask the questions and print the answers; 1 if one failed, or a row has become slower."""
    options = parser().parse_args(arguments)
    known = history.read(options.against) if options.against else []
    start = time.perf_counter()
    lines: list[list[str]] = []
    others: set[str] = set()
    failed: list[str] = []
    about, run = describe(), Run.now()
    for question in options.only:
        try:
            rows = _ask_for(run, question, options.quick)
        except Exception as error:
            failed.append(question)
            rows = [Row("failed", None, note=f"{type(error).__name__}: {error}".splitlines()[0])]
        lines += [[question, row.what, *row.cells()] for row in rows]
        others |= {f"{number(row.anchor.value)}: {row.anchor.source}" for row in rows if row.anchor}
    table = tabulate(lines, headers=HEADERS, tablefmt="github", disable_numparse=True)
    mode = "quick, for a look only" if options.quick else "means, quickest of several runs"
    seconds = f"{time.perf_counter() - start:.0f} s in all"
    _say("\n".join([*about, f"{mode}, {seconds}", "", table, "", LEGEND, *sorted(others)]))
    slower = _confirmed(known, run, options.quick)
    history.append(options.history, run)
    for row in slower:
        _say(f"slower: {row}")
    return 1 if failed or slower else 0


AGAIN = 2
"""Times that the question of a slower row is asked again, before the row counts as slower."""


def _confirmed(known: Sequence[Run], run: Run, quick: bool) -> list[Slower]:
    """Return the rows of a run that are slower each time that their questions are asked."""
    slower = history.slower(known, run)
    for _ in range(AGAIN):
        for question in dict.fromkeys(row.question for row in slower):
            _ask_for(run, question, quick)
        slower = history.slower(known, run)
    return slower


def ask(question: str, quick: bool) -> list[Row]:
    """Return the rows of one question; what it measures is imported now, not before."""
    sys.stderr.write(f"{question} ...\n")
    module = importlib.import_module(f"benchmarks.{QUESTIONS[question]}")
    rows: list[Row] = getattr(module, question)(quick)
    return rows


def _ask_for(run: Run, question: str, quick: bool) -> list[Row]:
    """Return the rows of one question, and add them to a run."""
    before = fixed_seconds()
    rows = ask(question, quick)
    run.add(question, rows, min(before, fixed_seconds()))
    return rows


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "--only",
        type=_questions,
        default=tuple(QUESTIONS),
        metavar="A,B",
        help=f"only these questions: {', '.join(QUESTIONS)}",
    )
    parser.add_argument("--quick", action="store_true", help="few repeats, for a look")
    parser.add_argument(
        "--history",
        type=Path,
        default=Path("results/benchmarks.jsonl"),
        metavar="FILE",
        help="file that the run is added to (default: %(default)s)",
    )
    parser.add_argument(
        "--against",
        type=Path,
        metavar="FILE",
        help=f"history of earlier runs: fail if a row takes {history.SLOWER:g} times its median on "
        f"the same processor, {history.SLOWER_ELSEWHERE:g} times on others",
    )
    return parser


def _questions(text: str) -> tuple[str, ...]:
    names = tuple(text.split(","))
    for name in names:
        if name not in QUESTIONS:
            raise argparse.ArgumentTypeError(
                f"'{name}' is no question, choose of {', '.join(QUESTIONS)}."
            )
    return names


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
