"""``python -m analysis fit PLANT LOG…``: a fit to recorded runs, its report, picture and model."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from analysis.errors import AnalysisError
from analysis.logs.report import names_of
from analysis.logs.tables import read_table
from dopt.errors import given_path
from dopt.log import Log
from dopt.systems.plant import Plant
from orchestrate.program import path, positive, tell
from orchestrate.store import Store

HELP = "fit a plant's unknown constants and a network to recorded runs: report, picture, model"


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Add the files and the options of the command."""
    command.add_argument("plant", metavar="PLANT", help="the arguments of dopt.Plant (.yaml)")
    command.add_argument(
        "logs", metavar="LOG", nargs="+", help=".csv, .csv.gz, .parquet, .mat, .h5"
    )
    command.add_argument("--validate", metavar="LOG", nargs="+", default=(), help="other runs")
    command.add_argument("--columns", help="columns, such as angle=th,voltage=u (the same names)")
    command.add_argument("--units", help="units of columns, such as t=ms,th=counts/4096")
    command.add_argument("--time", help="column of the stamps (time, t or timestamp)")
    command.add_argument("--width", type=int, default=16, help="units of the network, 0: none (16)")
    command.add_argument(
        "--hold", choices=("zero", "linear"), default="zero", help="input between two rows (zero)"
    )
    command.add_argument("--window", type=positive("--window", float), help="window [s] (chosen)")
    command.add_argument("--out", type=path("--out"), default="fit", help="folder (fit/)")
    command.add_argument(
        "--db",
        metavar="URL",
        help="database that stores the fit, such as sqlite:///results.db (no database)",
    )


def run(options: argparse.Namespace) -> int:
    """Fit, print the report, save the picture and the model, and store the fit where asked."""
    import dopt

    if options.db:
        Store.open(options.db).close()  # before minutes of fitting
    plant = read_plant(options.plant)
    given = {
        "columns": names_of("--columns", options.columns),
        "units": names_of("--units", options.units),
        "time": options.time,
    }
    logs = [_log(file, plant, given) for file in options.logs]
    tests = [_log(file, plant, given) for file in options.validate]
    found = dopt.fit(
        plant,
        logs,
        validate=tests or None,
        width=options.width,
        hold=options.hold,
        window=options.window,
        progress=lambda text: tell(sys.stderr, f"{text}\n"),
    )
    tell(sys.stdout, f"{found.report()}\n")
    from analysis.figures.reports import draw_fit  # Matplotlib: other commands do without it

    options.out.mkdir(parents=True, exist_ok=True)
    draw_fit(found, (tests or logs)[0], options.out / "fit.png")
    found.save(options.out / "model.npz")
    tell(sys.stdout, f"picture: {options.out / 'fit.png'}\nmodel: {options.out / 'model.npz'}\n")
    if options.db:
        tell(sys.stdout, f"trial: {found.store(options.db)}\n")
    return 0


def read_plant(file: str) -> Plant:
    """Return the plant that a YAML file declares.

    An unknown number is ``{value: 25, factor: 2}`` or ``{value: 0, spread: 0.1}``, an encoder
    ``{counts: 2048}``.

    Raises
    ------
    AnalysisError
        If the file cannot be read, or is no mapping.
    SpecificationError
        If the plant is not as :class:`dopt.Plant` says.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError  # type: ignore[import-untyped]  # which has no types

    source = given_path(file, "the file of a plant", AnalysisError)
    try:
        section: Any = OmegaConf.to_container(OmegaConf.load(source), resolve=True)
    except (OSError, ValueError, YAMLError, OmegaConfBaseException) as error:
        raise AnalysisError(
            f"{source} cannot be read ({error}), but the arguments of dopt.Plant in YAML are "
            f"expected: correct it."
        ) from error
    if not isinstance(section, dict):
        raise AnalysisError(
            f"{source} holds a {type(section).__name__}, but the arguments of dopt.Plant by their "
            f"names are expected, such as 'dt: 0.01': correct it."
        )
    return Plant.from_mapping(section)


def _log(file: str, plant: Plant, given: dict[str, Any]) -> Log:
    log = Log.for_plant(read_table(file).rename(columns=str), plant, **given)
    for note in log.notes:
        tell(sys.stderr, f"{Path(file).name}: {note}\n")
    return log
