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
import os
import platform
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from analysis.data.selection import Gap, Selection
from analysis.stats.curves import PlotOptions
from analysis.tables.rendering import TABLES
from dopt import __version__
from dopt.errors import counted
from orchestrate.errors import make_folder, whole
from orchestrate.program import COMMIT_VARIABLE, commit_of, git
from orchestrate.store import Reader

LIBRARIES = ("matplotlib", "numpy", "pandas", "scipy", "sqlalchemy")
PACKAGE = Path(__file__).parent
"""The folder of the analysis."""

_PLOTS = {
    "figure1": ("losses", "loss_plot", "loss"),
    "figure1_reachable": ("losses", "loss_plot", "reachable_loss"),
    "figure2_phase_pendulum": ("phase_portraits", "phase_plot", "pendulum"),
    "figure2_phase_cartpole": ("phase_portraits", "phase_plot", "cartpole"),
    "figure2_spectrum": ("phase_portraits", "spectrum_plot", "cartpole"),
    "figure6_pareto": ("losses", "PARETO"),
}
"""Module, name and subject of each figure, in the order of the page."""

FIGURES = tuple(_PLOTS)

NAMES = (*FIGURES, *TABLES)

WITH_EXPLORATIONS = ("figure1", *(name for name in FIGURES if name[:7] == "figure2"), "summary")
"""Outputs that compare no losses, and so show explorations too."""

TABLE_FILES = ("md", "tex", "csv")

PAGE = "README.md"

IDENTITY = ("env", "policy", "model", "learner", "width", "config_key")
"""Columns by which a configuration is named in the provenance."""

PICTURES = ("pdf", "svg", "png")


@functools.cache
def plots() -> dict[str, Plot[Any]]:
    """Return all figures by name, in their order; Matplotlib is loaded by the first call."""
    found = {}
    for name, (module, kind, *shown) in _PLOTS.items():
        plot = getattr(importlib.import_module(f"analysis.figures.{module}"), kind)
        found[name] = plot(*shown) if shown else plot
    return found


def build(
    reader: Reader,
    selection: Selection,
    options: PlotOptions,
    folder: Path,
    names: tuple[str, ...] = NAMES,
    *,
    force: bool = False,
) -> Iterator[tuple[str, str]]:
    """Write the named outputs and the page of all into a folder; yield names and what happened."""
    make_folder(folder)
    for name in names:
        part = selection if name in WITH_EXPLORATIONS else selection.simulated()
        yield name, _made(reader, part, options, folder, name, force=force)
    if write_page(folder, (*TABLES, *FIGURES)):
        yield PAGE, "written"


def _made(
    reader: Reader,
    selection: Selection,
    options: PlotOptions,
    folder: Path,
    name: str,
    *,
    force: bool,
) -> str:
    """Write an output where it is not as it would be written; return what happened."""
    is_figure = name in FIGURES
    part = (plots() if is_figure else TABLES)[name].part(selection, options)
    if not part.entries:
        return "not drawn, nothing is stored for it"
    request = {key: str(value) for key, value in dataclasses.asdict(options).items()}
    facts = describe(reader, part) | {"request": request, "name": name}
    # Where the data lie and which commit was checked out is no part of the fingerprint.
    marked = ("selection", "request", "versions", "name", "notes")
    mark = fingerprint({key: facts[key] for key in marked} | {"code": code_hash()})
    endings = (*PICTURES, "csv", "txt") if is_figure else TABLE_FILES
    if not force and is_current(folder, name, endings, mark):
        return "unchanged"
    words = (_draw if is_figure else _tabulate)(reader, part, options, folder, name, mark)
    write_provenance({**facts, **words, "fingerprint": mark}, folder, name)
    return "written"


def _draw(
    reader: Reader, selection: Selection, options: PlotOptions, folder: Path, name: str, mark: str
) -> dict[str, str]:
    from analysis.figures.panels import styled

    plot = plots()[name]
    with styled():
        drawing = plot.make(reader, selection, options)
        caption = drawing.caption
        if selection.gaps:
            warning = partial_warning(selection.gaps)
            caption = f"{warning} {caption}"
            drawing.figure.suptitle(warning, fontsize=8, color="#b00020", weight="bold")
        write_pictures(drawing.figure, folder, name, plot.title, mark)
    write_table(drawing.table, folder, name)
    write_text(caption + "\n", folder / f"{name}.txt")
    return plot.words(options) | {"caption": caption}


def _tabulate(
    reader: Reader, selection: Selection, options: PlotOptions, folder: Path, name: str, _: str
) -> dict[str, str]:
    kind = TABLES[name]
    table = kind.measure(reader, selection, options)
    text_table = kind.render(table)
    warning = f"{partial_warning(selection.gaps)}\n\n" if selection.gaps else ""
    write_table(table, folder, name)
    write_text(warning + text_table.markdown(), folder / f"{name}.md")
    comment = f"% {warning.rstrip()}\n" if warning else ""
    write_text(comment + text_table.latex(), folder / f"{name}.tex")
    return {"title": kind.title, "caption": warning + text_table.note}


def partial_warning(gaps: Iterable[Gap]) -> str:
    """Return the mark of an output that lacks trials."""
    return f"PARTIAL: {counted(sum(len(gap.seeds) for gap in gaps), 'trial')} missing."


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
                **{name: getattr(entry.config, name) for name in IDENTITY},
                "n_registered": len(entry.trials),
                "n_finished": len(entry.finished),
                "n_diverged": entry.n_diverged,
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
