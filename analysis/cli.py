"""Command line of the analysis: arguments, selection of trials, outputs and exit codes.

0: made; 1: something of the request has no data; 2: the request cannot be answered; 3: trials are
missing and ``--allow-partial`` was not given; 130: interrupted.
"""

from __future__ import annotations

import argparse
import socket
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd

from analysis import log_report, report
from analysis.data.matching import REFERENCE, AnalysisError, Filter, IncompleteError, read_condition
from analysis.data.selection import Selection, select
from analysis.outputs import NAMES, build, partial_warning
from analysis.serve import is_loopback
from analysis.stats.curves import Axis, PlotOptions, Spread, Statistic, median_seed
from analysis.stats.scores import Measure
from analysis.tables.rendering import (
    CALIBRATION,
    CALIBRATION_HELP,
    SAMPLE_LOSS_HELP,
    TABLES,
    TableKind,
    TextTable,
    comparison,
    incomplete,
    sample_loss_kind,
)
from dopt.errors import counted, install_command
from dopt.result import Assessment
from orchestrate.program import Parser, answered, folder, path, positive, tell
from orchestrate.store import DEFAULT_URL, Reader, Store, default_url

COLUMNS = ("loss", "reachable_loss")
FORMATS = ("markdown", "latex", "csv")
SERVE_HELP = "show the results in a browser, read-only, while a launch writes"
PORT = 8000
HOST = "127.0.0.1"


@answered
def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        options = parser().read(sys.argv[1:] if arguments is None else arguments)
        return int(options.run(options))
    except IncompleteError as error:
        tell(sys.stderr, f"{error}\n")
        return 3


@contextmanager
def _selected(options: argparse.Namespace) -> Iterator[tuple[Reader, Selection]]:
    """Open the database and select trials; say what is left out, and refuse missing trials."""
    with Reader.open(options.db) as reader:
        selection = select(reader, wanted(options))
        if selection.gaps and not options.allow_partial:
            raise incomplete(selection.gaps, "a complete grid is", "--env and --policy")
        for note in selection.notes:
            tell(sys.stderr, f"note: {note}\n")  # the output may be a CSV
        yield reader, selection


def parser() -> Parser:
    """Return the parser of all commands."""
    top = Parser(prog="python -m analysis", description=__doc__)
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    figures = _command(commands, "figures", _figures, "draw the paper's figures and tables")
    figures.add_argument("--out", type=folder("--out"), default="figures", help="folder (figures/)")
    figures.add_argument("--only", action="append", choices=NAMES, help="this output (repeat)")
    figures.add_argument(
        "--x", dest="axis", choices=list(Axis), default=Axis.STEPS, help="axis of figure 1"
    )
    figures.add_argument(
        "--statistic", choices=list(Statistic), default=Statistic.MEAN, help="centre of figure 1"
    )
    figures.add_argument(
        "--style",
        dest="spread",
        choices=list(Spread),
        default=Spread.BAND,
        help="intervals of figure 1",
    )
    figures.add_argument("--force", action="store_true", help="draw again what is unchanged")
    summary = _command(commands, "summary", _table, "mean final losses ± 2 SE, n")
    compare = _command(commands, "compare", _table, "every variant against the reference, paired")
    compare.add_argument("--column", choices=COLUMNS, default="loss", help="which loss")
    compare.add_argument(
        "--measure", choices=list(Measure), default=Measure.FINAL, help="what a trial is judged by"
    )
    aggregate = _command(
        commands, "aggregate", _table, "every variant against the reference, over all systems"
    )
    calibrated = _command(commands, "calibration", _table, CALIBRATION_HELP)
    sampled = _command(commands, "sample-loss", _table, SAMPLE_LOSS_HELP)
    sampled.add_argument("--store", action="store_true", help="keep what is fitted in the database")
    tables = {
        summary: lambda _: TABLES["summary"],
        compare: lambda options: comparison(options.column, Measure(options.measure)),
        aggregate: lambda _: TABLES["aggregate"],
        calibrated: lambda _: CALIBRATION,
        sampled: _sampled,
    }
    for table, kind in tables.items():
        table.add_argument("--format", choices=FORMATS, default=FORMATS[0])
        table.set_defaults(table=kind)
    for command in (figures, compare):
        command.add_argument(
            "--epsilon",
            type=positive("--epsilon", float),
            help="loss to reach (median final loss of random inputs)",
        )
    compared = _command(
        commands, "report", lambda options: report.run(options, wanted(options)), report.HELP
    )
    for command in (figures, compare, aggregate, compared):
        command.add_argument(
            "--reference",
            default=REFERENCE,
            metavar="POLICY",
            help=f"what all others are compared with ({REFERENCE}); with --group-by a value",
        )
    for command in (figures, summary, compare, aggregate, calibrated, sampled):
        command.add_argument(
            "--group-by",
            nargs="+",
            default=("policy",),
            metavar="KEY",
            help="settings of which each value is shown once, such as width or env.gamma (policy)",
        )
    compared.add_argument("--out", type=folder("--out"), default="report", help="folder (report/)")
    film = "a film of one stored trial: system, phase trace, learned and true force, loss"
    animate = commands.add_parser("animate", help=film, description=film)
    animate.set_defaults(run=_animate, allow_partial=True)
    add_database(animate)
    animate.add_argument("env", metavar="ENV", nargs=1, help="environment of the trial")
    animate.add_argument("policy", metavar="POLICY", nargs=1, help="policy of the trial")
    _add_where(animate)
    animate.add_argument("--seed", type=int, help="seed (default: of the median final loss)")
    animate.add_argument("--out", type=path("--out"), help=".gif or .mp4 (figures/ENV_POLICY.gif)")
    for option, default, what in (("--frames", 150, "pictures in all"), ("--fps", 15, "a second")):
        number = positive(option, int)
        animate.add_argument(option, type=number, default=default, help=f"{what} ({default})")
    recorded = commands.add_parser("log", help=log_report.HELP, description=log_report.HELP)
    log_report.add_arguments(recorded)
    recorded.set_defaults(run=log_report.run)
    fitted = commands.add_parser("fit", help=log_report.FIT_HELP, description=log_report.FIT_HELP)
    log_report.add_fit_arguments(fitted)
    fitted.set_defaults(run=log_report.run_fit)
    _add_serve(commands)
    return top


def _command(
    commands: argparse._SubParsersAction[Parser], name: str, run: object, help_text: str
) -> Parser:
    command = commands.add_parser(name, help=help_text, description=help_text)
    command.set_defaults(run=run)
    add_database(command)
    add_selection(command)
    return command


def add_selection(command: Parser) -> None:
    """Add the options that select trials."""
    command.add_argument("--env", nargs="+", default=(), help="only these environments")
    command.add_argument("--policy", nargs="+", default=(), help="only these policies")
    _add_where(command)
    command.add_argument("--allow-partial", action="store_true", help="go on without the missing")


def _add_where(command: Parser) -> None:
    command.add_argument(
        "--where",
        nargs="+",
        default=(),
        metavar="PATH=VALUE",
        help="only configurations with this value, such as model.width=32",
    )


def add_database(command: Parser) -> None:
    """Add the option ``--db``."""
    command.add_argument("--db", default=default_url(), help=f"database (DOPT_DB, {DEFAULT_URL})")


def wanted(options: argparse.Namespace) -> Filter:
    """Return the selection that the options of :func:`add_selection` ask for."""
    reference = getattr(options, "reference", REFERENCE)
    group_by = tuple(getattr(options, "group_by", ("policy",)))
    conditions = dict(map(read_condition, options.where))
    return Filter(tuple(options.env), tuple(options.policy), conditions, reference, group_by)


def _plot_options(options: argparse.Namespace) -> PlotOptions:
    """Return what a command was asked to show; options that it lacks are as usual."""
    kinds = {"axis": Axis, "statistic": Statistic, "spread": Spread}
    given: dict[str, Any] = {
        name: kind(getattr(options, name)) for name, kind in kinds.items() if name in options
    }
    return PlotOptions(**given, epsilon=getattr(options, "epsilon", None))


def _figures(options: argparse.Namespace) -> int:
    asked = _plot_options(options), options.out, tuple(options.only or NAMES)
    empty = 0
    with _selected(options) as (reader, selection):
        for name, state in build(reader, selection, *asked, force=options.force):
            tell(sys.stdout, f"{options.out / name}: {state}\n")
            empty += bool(options.only) and state.startswith("not drawn")
    return 1 if empty else 0


def _animate(options: argparse.Namespace) -> int:
    from analysis import film  # Matplotlib: other commands do without it

    (env,), (policy,) = options.env, options.policy
    target = options.out or Path("figures") / f"{env}_{policy}.gif".replace("/", "_")
    film.writer_of(target)
    with _selected(options) as (reader, selection):
        [entry] = selection.entries
        losses = entry.final_losses()
        if options.seed is None and not losses:
            raise AnalysisError(
                f"{env} × {policy} has no finished trial that did not diverge: run one, or give "
                f"--seed."
            )
        seed = median_seed(losses) if options.seed is None else options.seed
        story = film.tell(reader, entry, seed, options.frames)
    film.shoot(story, target, options.fps)
    tell(sys.stdout, f"{target}: seed {seed}, {counted(len(story.steps), 'picture')}\n")
    return 0


def _table(options: argparse.Namespace) -> int:
    """Print the table of a command."""
    kind, form = options.table(options), options.format
    with _selected(options) as (reader, selection):
        table = kind.measure(reader, selection, _plot_options(options))
    if selection.gaps:
        tell(sys.stderr, f"{partial_warning(selection.gaps)}\n")
    tell(sys.stdout, _text(kind.render(table), table, form), exact=form == "csv")
    return 0


def _sampled(options: argparse.Namespace) -> TableKind:
    """Return the table of sample losses, which stores them where it was asked to."""

    def keep(fitted: Mapping[str, Assessment]) -> None:
        if options.store and fitted:
            with Store.open(options.db) as store:
                store.add_assessments(fitted)

    return sample_loss_kind(lambda text: tell(sys.stderr, f"note: {text}\n"), keep)


def _text(text_table: TextTable, table: pd.DataFrame, form: str) -> str:
    if form == "csv":
        return table.to_csv(index=False)
    return text_table.latex() if form == "latex" else text_table.markdown()


def _add_serve(commands: argparse._SubParsersAction[Parser]) -> None:
    serve = commands.add_parser("serve", help=SERVE_HELP, description=SERVE_HELP)
    serve.set_defaults(run=_serve)
    add_database(serve)
    serve.add_argument("--port", type=int, default=PORT, help=f"port, 0: any free one ({PORT})")
    serve.add_argument("--host", default=HOST, help=f"address to listen at ({HOST})")


def _serve(options: argparse.Namespace) -> int:
    """Serve until the user ends it with Ctrl-C."""
    try:
        from analysis.serve.app import Server, create_app
    except ModuleNotFoundError as error:
        raise AnalysisError(
            f"The browser needs the library {error.name}: "
            f"install it with {install_command('serve')}."
        ) from error
    app = create_app(options.db, options.host)
    listening = _listen(options.host, options.port)
    sys.stdout.write(_greeting(options, listening.getsockname()[1]))
    sys.stdout.flush()
    try:
        Server(app).run(sockets=[listening])
    except KeyboardInterrupt:
        return 0
    finally:
        listening.close()
    return 0


def _listen(host: str, port: int) -> socket.socket:
    """Return a listening socket; raise ``AnalysisError`` where the address is taken or wrong."""
    if not 0 <= port < 2**16:
        raise AnalysisError(f"--port is {port}, expected is a number of 0 to 65535: give one.")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise AnalysisError(
            f"The browser cannot listen at {host}:{port} ({error}): give another --port or --host, "
            f"--port 0 takes any free port."
        ) from error


def _greeting(options: argparse.Namespace, port: int) -> str:
    host = f"[{options.host}]" if ":" in options.host else options.host
    text = f"Results browser at http://{host}:{port}/ (read-only; Ctrl-C ends it)\n"
    if not is_loopback(options.host):
        text += "Whoever reaches this machine can read the database: there is no password.\n"
    return text
