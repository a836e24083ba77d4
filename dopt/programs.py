"""Entry points of the installed programs; each imports the packages installed beside this one.

A folder that ``PYTHONPATH`` names, for the classes of a user's own, comes before the installed
packages: an ``analysis.py`` in it would be taken for the package of that name.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from importlib.machinery import PathFinder
from pathlib import Path

from dopt.errors import DISTRIBUTION


def dopt() -> None:
    """Run ``dopt``: commands on stored results."""
    _take("orchestrate")
    importlib.import_module("orchestrate.program").run("orchestrate.__main__")


def dopt_analysis() -> None:
    """Run ``dopt-analysis``: figures, tables and the browser."""
    _take("orchestrate")
    _take("analysis")
    importlib.import_module("analysis.__main__").program()


def dopt_launch() -> None:
    """Run ``dopt-launch``: trials and grids of trials."""
    _take("orchestrate")
    importlib.import_module("orchestrate.launch").program()


def _take(package: str) -> None:
    """Import the package of that name which lies in the same folder as this one."""
    spec = PathFinder.find_spec(package, [str(Path(__file__).resolve().parents[1])])
    if spec is None or spec.loader is None:
        raise ModuleNotFoundError(
            f"{package} is not installed beside dopt: install {DISTRIBUTION} again."
        )
    sys.modules[package] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
