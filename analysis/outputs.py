"""Outputs of ``analysis figures``: which there are, where they come from, and how they are written.

Files are written whole, and only if their content has changed. The provenance has no times, so that
equal data give equal bytes.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib
import importlib.metadata
import json
import multiprocessing
import os
import platform
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures import wait as futures_wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import pandas as pd

from analysis.data.matching import AnalysisError
from analysis.data.selection import Selection
from analysis.stats.curves import PlotOptions
from analysis.tables.rendering import TABLES
from dopt import __version__
from orchestrate.files import make_folder, whole
from orchestrate.program import COMMIT_VARIABLE, commit_of, git
from orchestrate.store import Reader

LIBRARIES = ("matplotlib", "numpy", "pandas", "scipy", "sqlalchemy")
PACKAGE = Path(__file__).parent
"""The folder of the analysis."""

_PLOTS = {
    "figure1": ("loss_curves", "loss_plot", "loss"),
    "figure1_reachable": ("loss_curves", "loss_plot", "reachable_loss"),
    "figure2_phase_pendulum": ("phase_portraits", "phase_plot", "pendulum"),
    "figure2_phase_cartpole": ("phase_portraits", "phase_plot", "cartpole"),
    "figure2_spectrum": ("phase_portraits", "spectrum_plot", "cartpole"),
    "figure6_pareto": ("pareto", "PARETO"),
}
"""Module, name and subject of each figure, in the order of the page."""

FIGURES = tuple(_PLOTS)

NAMES = (*FIGURES, *TABLES)

WITH_EXPLORATIONS = ("figure1", *(name for name in FIGURES if name[:7] == "figure2"), "summary")
"""Outputs that compare no losses, and so show explorations too."""

TABLE_FILES = ("md", "tex", "csv")

PAGE = "README.md"

PICTURES = ("pdf", "svg", "png")

INTERRUPT_INTERVAL = 0.1
"""Seconds between two looks for Ctrl-C."""

T = TypeVar("T")


@functools.cache
def plots() -> dict[str, Plot[Any]]:
    """Return all figures by name, in their order; Matplotlib is loaded by the first call."""
    found = {}
    for name, (module, kind, *shown) in _PLOTS.items():
        plot = getattr(importlib.import_module(f"analysis.figures.{module}"), kind)
        found[name] = plot(*shown) if shown else plot
    return found


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What happened to one output: drawn, unchanged, or nothing stored for it."""

    name: str
    state: str


@dataclasses.dataclass(frozen=True)
class Task:
    """An output that is to be written: its trials, its provenance and its fingerprint."""

    name: str
    selection: Selection
    options: PlotOptions
    folder: Path
    facts: Mapping[str, Any]
    mark: str


def build(
    reader: Reader,
    selection: Selection,
    options: PlotOptions,
    folder: Path,
    names: tuple[str, ...] = NAMES,
    *,
    force: bool = False,
    workers: int = 1,
) -> Iterator[Outcome]:
    """Write the named outputs and the page of all into a folder; say of each what happened.

    ``workers`` outputs are written at a time, each in its own process if there are several.
    """
    make_folder(folder)
    planned = {name: _plan(name, reader, selection, options, folder, force) for name in names}
    tasks = {name: one for name, one in planned.items() if isinstance(one, Task)}
    with written(_write_output, reader, tasks, workers) as write:
        for name, one in planned.items():
            if isinstance(one, str):
                yield Outcome(name, one)
            else:
                write(name)
                yield Outcome(name, "written")
    if write_page(folder, (*TABLES, *FIGURES)):
        yield Outcome(PAGE, "written")


def _plan(
    name: str,
    reader: Reader,
    selection: Selection,
    options: PlotOptions,
    folder: Path,
    force: bool,
) -> Task | str:
    """Return what is to be written, or why nothing is."""
    if name not in WITH_EXPLORATIONS:
        selection = selection.simulated()
    kind = plots()[name] if name in FIGURES else TABLES[name]
    part = kind.part(selection, options)
    if not part.entries:
        return "not drawn, nothing is stored for it"
    facts = describe(reader, part) | {"request": options.as_dict(), "name": name}
    # Where the data lie and which commit was checked out is no part of the fingerprint.
    marked = ("selection", "request", "versions", "name", "notes")
    mark = fingerprint({key: facts[key] for key in marked} | {"code": code_hash()})
    endings = (*PICTURES, "csv", "txt") if name in FIGURES else TABLE_FILES
    if not force and is_current(folder, name, endings, mark):
        return "unchanged"
    return Task(name, part, options, folder, facts, mark)


def _write_output(reader: Reader, task: Task) -> None:
    words = (_draw if task.name in FIGURES else _tabulate)(reader, task)
    facts = {**task.facts, **words, "fingerprint": task.mark}
    write_provenance(facts, task.folder, task.name)


def _draw(reader: Reader, task: Task) -> dict[str, str]:
    from analysis.figures.panels import styled

    name, plot, folder = task.name, plots()[task.name], task.folder
    with styled():
        drawing = plot.make(reader, task.selection, task.options)
        caption = drawing.caption
        if task.selection.gaps:
            warning = partial_warning(task.selection)
            caption = f"{warning} {caption}"
            drawing.figure.suptitle(warning, fontsize=8, color="#b00020", weight="bold")
        write_pictures(drawing.figure, folder, name, plot.title, task.mark)
    write_table(drawing.table, folder, name)
    write_text(caption + "\n", folder / f"{name}.txt")
    return plot.words(task.options) | {"caption": caption}


def _tabulate(reader: Reader, task: Task) -> dict[str, str]:
    name, folder, kind = task.name, task.folder, TABLES[task.name]
    table = kind.measure(reader, task.selection, task.options)
    text_table = kind.render(table, task.options)
    warning = f"{partial_warning(task.selection)}\n\n" if task.selection.gaps else ""
    write_table(table, folder, name)
    write_text(warning + text_table.markdown(), folder / f"{name}.md")
    comment = f"% {warning.rstrip()}\n" if warning else ""
    write_text(comment + text_table.latex(), folder / f"{name}.tex")
    return {"title": kind.title, "caption": warning + text_table.note}


def partial_warning(selection: Selection) -> str:
    """Return the mark of an output that lacks trials."""
    return f"PARTIAL: {sum(len(gap.seeds) for gap in selection.gaps)} trials missing."


@functools.cache
def versions() -> dict[str, str | None]:
    """Return the versions of Python and the libraries; None where one is not installed."""
    found: dict[str, str | None] = {"python": platform.python_version(), "dopt": __version__}
    for library in LIBRARIES:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[library] = importlib.metadata.version(library)
    return dict.fromkeys(LIBRARIES) | found


@functools.cache
def git_state() -> dict[str, str | bool | None]:
    """Return commit and dirty flag of the code; None if it is not in its own repository.

    A repository that merely holds an installed copy is another one; ``DOPT_COMMIT`` then gives the
    commit. As at the first call: code that changes later does not run in this process.
    """
    commit = commit_of(PACKAGE.parent)
    if commit is None:
        return {"commit": os.environ.get(COMMIT_VARIABLE) or None, "dirty": None}
    return {
        "commit": commit,
        "dirty": bool(git(PACKAGE.parent, "status", "--porcelain", "--untracked-files=no")),
    }


def code_hash() -> str:
    """Return the SHA-256 of the files of the analysis: a changed drawing is drawn again."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def describe(reader: Reader, selection: Selection) -> dict[str, Any]:
    """Return what every output says of its origin."""
    missing = {(gap.env, gap.policy): len(gap.seeds) for gap in selection.gaps}
    return {
        "database": reader.safe_url,
        "schema": reader.schema_version(),
        "selection": selection.fingerprint(),
        "git": git_state(),
        "versions": versions(),
        # The key of released files, of what is a configuration everywhere else.
        "cells": [
            {
                "env": entry.config.env,
                "policy": entry.config.policy,
                "model": entry.config.model,
                "learner": entry.config.learner,
                "width": entry.config.width,
                "config_key": entry.config.config_key,
                "n_registered": len(entry.trials),
                "n_finished": len(entry.finished),
                "n_diverged": sum(trial.status == "diverged" for trial in entry.trials),
                "n_missing": missing.get((entry.config.env, entry.config.policy), 0),
            }
            for entry in selection.entries
        ],
        "absent": [
            [env, policy]
            for env, policy in missing
            if all((e.config.env, e.config.policy) != (env, policy) for e in selection.entries)
        ],
        "launches": [
            {"commit": one.git_commit, "dirty": bool(one.git_dirty), "host": one.host}
            for one in reader.launches()
        ],
        "notes": list(selection.notes),
    }


def write_page(folder: Path, names: Iterable[str]) -> bool:
    """Write the page of those outputs that the folder holds; False if it was the same already."""
    found = [section for name in names if (section := _section(folder, name))]
    if not found:
        return False
    text = "\n\n".join(["# Figures and tables", _origin(folder), *found]) + "\n"
    target = folder / PAGE
    if target.is_file() and target.read_text(encoding="utf-8") == text:
        return False
    write_text(text, target)
    return True


def _section(folder: Path, name: str) -> str | None:
    """Return the section of an output on the page, None for one that is not there."""
    is_figure, facts = name in FIGURES, _facts(folder, name)
    shown = folder / f"{name}.{'png' if is_figure else 'md'}"
    if not facts or not shown.is_file():
        return None
    title = facts["title"]
    endings: tuple[str, ...] = ("csv", "tex", "json")
    if is_figure:
        text, endings = (
            f"![{title}]({shown.name})\n\n{facts['caption']}",
            ("pdf", "svg", "csv", "json"),
        )
    else:
        text = shown.read_text(encoding="utf-8").rstrip()
    links = " · ".join(f"[{name}.{ending}]({name}.{ending})" for ending in endings)
    return f"## {title}\n\n{text}\n\n{links}"


def _origin(folder: Path) -> str:
    """Return a sentence on the databases and the code that the outputs come from."""
    all_facts = [_facts(folder, path.stem) for path in sorted(folder.glob("*.json"))]
    known = [facts for facts in all_facts if facts]
    databases = sorted({str(facts["database"]) for facts in known})
    versions = sorted({str(facts["versions"]["dopt"]) for facts in known})
    return (
        f"Made by dopt {', '.join(versions)} from {', '.join(f'`{url}`' for url in databases)}. "
        f"Each output has its numbers as CSV and its provenance as JSON beside it."
    )


def _facts(folder: Path, name: str) -> Mapping[str, Any] | None:
    """Return what an output says of itself, None where it is not there or not whole."""
    try:
        found = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    wanted = {"title", "caption", "database", "versions"}
    return found if isinstance(found, dict) and wanted <= found.keys() else None


if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from analysis.figures.panels import Plot


def fingerprint(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of everything that an output depends on."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def is_current(folder: Path, name: str, endings: tuple[str, ...], mark: str) -> bool:
    """Return True if all files of an output exist and were made from the same content."""
    found = _facts(folder, name)
    whole_set = all((folder / f"{name}.{ending}").is_file() for ending in endings)
    return whole_set and found is not None and found.get("fingerprint") == mark


def write_pictures(figure: Figure, folder: Path, name: str, title: str, mark: str) -> None:
    """Write a figure in every format, with its title and fingerprint, in the context of the style.

    The layout is computed once, so that all formats show the same picture and none is drawn twice.
    """
    layout = figure.get_layout_engine()
    if layout is not None:
        layout.execute(figure)
        figure.set_layout_engine(None)
    for ending in PICTURES:
        with whole(folder / f"{name}.{ending}") as part:
            figure.savefig(part, format=ending, metadata=_metadata(ending, title, mark))


def _metadata(ending: str, title: str, mark: str) -> dict[str, Any]:
    """Return metadata without a clock; with SOURCE_DATE_EPOCH set, matplotlib writes that date."""
    about = f"fingerprint {mark}, see the JSON file beside this one"
    clock = {"pdf": "CreationDate", "svg": "Date"}.get(ending)
    undated = {clock: None} if clock and "SOURCE_DATE_EPOCH" not in os.environ else {}
    return {"Title": title, "Subject" if ending == "pdf" else "Description": about, **undated}


def write_table(table: pd.DataFrame, folder: Path, name: str) -> None:
    """Write the CSV of a table; NaN is an empty field, numbers have all their digits."""
    write_text(table.to_csv(index=False, lineterminator="\n"), folder / f"{name}.csv")


def write_provenance(content: Mapping[str, Any], folder: Path, name: str) -> None:
    """Write the JSON beside an output; the last of its files, so that it vouches for the others."""
    text = json.dumps(content, indent=2, sort_keys=True, ensure_ascii=False)
    write_text(text + "\n", folder / f"{name}.json")


def write_text(text: str, target: Path) -> None:
    """Write a file whole or not at all."""
    with whole(target) as part:
        part.write_text(text, encoding="utf-8")


@contextmanager
def written(
    write: Callable[[Reader, T], None], reader: Reader, tasks: Mapping[str, T], workers: int
) -> Iterator[Callable[[str], None]]:
    """Yield a function that returns when the task of a name is written, by one of ``workers``.

    With one worker or one task it writes in this process. Several are forks of it, which import
    nothing again, and each opens the database for itself. The function raises what ``write`` does,
    ``AnalysisError`` if a process was killed, and ``KeyboardInterrupt`` after Ctrl-C.
    """
    processes = min(workers, len(tasks))
    if processes < 2:
        yield lambda name: write(reader, tasks[name])
        return
    context = multiprocessing.get_context("fork")
    with (
        _deferred_interrupt() as raise_interrupt,
        ProcessPoolExecutor(processes, context, _ignore_interrupt) as pool,
    ):
        try:
            futures = {
                name: pool.submit(_write_apart, write, reader.url, tasks[name]) for name in tasks
            }
        except (OSError, RuntimeError):  # no further process or thread
            for process in multiprocessing.active_children():
                process.kill()  # it would wait for work for ever
            raise

        def wait(name: str) -> None:
            raise_interrupt()
            while not futures_wait([futures[name]], timeout=INTERRUPT_INTERVAL).done:
                raise_interrupt()
            try:
                futures[name].result()
            except BrokenProcessPool as error:
                raise AnalysisError(
                    f"A process was killed before {name} was written, perhaps as memory ran "
                    f"out: give --workers 1."
                ) from error

        try:
            yield wait
        finally:
            pool.shutdown(cancel_futures=True)


def _write_apart(write: Callable[[Reader, T], None], url: str, task: T) -> None:
    with Reader.open(url) as reader:
        write(reader, task)


@contextmanager
def _deferred_interrupt() -> Iterator[Callable[[], None]]:
    """Yield a function that raises ``KeyboardInterrupt`` if Ctrl-C came; nothing else does.

    Raised at once, it could come between two statements of the pool that hold its locks. Threads
    other than the main one never get it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    received: list[int] = []

    def raise_interrupt() -> None:
        if received:
            raise KeyboardInterrupt

    previous = signal.signal(signal.SIGINT, lambda number, _: received.append(number))
    try:
        yield raise_interrupt
    finally:
        signal.signal(signal.SIGINT, previous)
    raise_interrupt()


def _ignore_interrupt() -> None:
    """Leave Ctrl-C, which the whole group of processes gets, to the first of them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
