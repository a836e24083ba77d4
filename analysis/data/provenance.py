"""Provenance of figures and tables, without times, so that equal data give equal bytes."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

from analysis.data.trial_selection import Selection
from dopt import __version__
from orchestrate.program import COMMIT_VARIABLE, commit_of, git
from orchestrate.store import Reader

LIBRARIES = ("matplotlib", "numpy", "pandas", "scipy", "sqlalchemy")
PACKAGE = Path(__file__).parents[1]
"""The folder of the analysis."""


@functools.cache
def versions() -> dict[str, str | None]:
    """Return the versions of Python and the libraries; None where one is not installed."""
    found: dict[str, str | None] = {"python": platform.python_version(), "dopt": __version__}
    for library in LIBRARIES:
        try:
            found[library] = importlib.metadata.version(library)
        except importlib.metadata.PackageNotFoundError:
            found[library] = None
    return found


@functools.cache
def git_state() -> dict[str, str | bool | None]:
    """Return commit and dirty flag of the code; None outside a repository of its own.

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
