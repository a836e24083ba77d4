"""Frame of every program: its parser, streams and signals, and the exit code of an error.

Messages of the parser are one sentence with the nearest valid name.
"""

from __future__ import annotations

import argparse
import errno
import functools
import importlib
import importlib.util
import io
import logging
import os
import re
import signal
import subprocess
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from importlib.machinery import PathFinder
from itertools import takewhile
from pathlib import Path
from typing import IO, Any, NoReturn, ParamSpec, TextIO

import dopt
from dopt.errors import DISTRIBUTION, DoptError, given_path, unknown_name
from dopt.process import end_at_interrupt, raise_at_interrupt
from orchestrate.errors import ExitCode, InfrastructureError, LaunchError, without_password

_INSTALLED = {
    "dopt": "python -m orchestrate",
    "dopt-analysis": "python -m analysis",
    "dopt-launch": "python orchestrate/launch.py",
}


SUCCESSORS = {
    "analysis --band": "v_trial has every final loss, of which SQL or pandas give quantiles",
    "analysis --figures": "open README.md in the folder of figures",
    "analysis --color-by": "the first setting of --group-by decides about the colours of figure 1",
    "analysis --diverged": "analysis.load().trials() has every final loss, for pandas' fillna",
    "analysis --workers": "one process draws all outputs of the paper's grid in seconds",
    "comparison_control": "python -m analysis report has a table of success and cost of control",
    "figure4_width": "python -m studies.speed.scaling q_dual prints the cost of a step",
    "figure4_width_loss": "python -m analysis summary --group-by width shows the losses",
    "figure5_control": "python -m analysis report has a table of success and cost of control",
    "figure7_profiles": "python -m analysis aggregate compares over all systems",
    "figure8_sensitivity": "python -m analysis summary --group-by learner.window shows each value",
    "figure9_limits": "the page of a trial in python -m analysis serve shows its bounded states",
    "orchestrate vacuum": "sqlite3 FILE VACUUM, or VACUUM in psql, gives the space back",
    "analysis floor": "fit the model of a trial to samples with dopt.fit_offline in Python",
    "--live": "look at the progress of a launch with watch python -m orchestrate status",
    "launch.live": "look at the progress of a launch with watch python -m orchestrate status",
    "status --watch": "watch python -m orchestrate status repeats it",
    "launch.reference": "compare with python -m analysis compare --reference POLICY",
    "launch.until=decided": "run a fixed range of seeds and python -m analysis compare, or give "
    "launch.until='ci<5%'",
    "export mlflow": "run studies/trackers/mlflow_runs.py on a SQLite file",
    "export wandb": "run studies/trackers/wandb_runs.py on a SQLite file",
    "export npz": "analysis.load() gives matrices and trajectories in Python, for numpy.savez",
    "export bundle": "copy trials into a file with python -m orchestrate merge OTHER --db "
    "sqlite:///FILE, or export trials, curves, trajectories and assessments as Parquet",
    "analysis yardsticks": "python -m studies.yardsticks makes these tables",
    "executor=slurm": "register the grid with launch.detach=true, and submit its workers with "
    "sbatch docs/example/slurm_workers.sh",
    "store=shards": "docs/example/share.sh runs a share of the seeds and copies its database",
    "launch.share": "docs/example/share.sh runs a share of the seeds and copies its database",
    "policy=beyond/sac": "studies/agents/README.md shows it as a policy of a study",
    "policy=beyond/max_agent": "studies/agents/README.md shows it as a policy of a study",
    "experiment=flex_table1_agents": "studies/agents/README.md has it as experiment=agents",
}
"""Successors of removed words, by command and word or by ``key=value`` of the configuration."""


class UsageError(DoptError):
    """Invalid command-line arguments.

    Not a ``ValueError``, so that argument types can raise it through :mod:`argparse`.
    """


class Parser(argparse.ArgumentParser):
    """Parser that raises ``UsageError`` instead of exiting, and rejects abbreviated options."""

    def __init__(self, prog: str, description: str | None = None, **options: Any) -> None:
        super().__init__(
            prog=as_started(prog), description=description, allow_abbrev=False, **options
        )

    def read(self, words: Sequence[str], *, mixed: bool = False) -> argparse.Namespace:
        """Return the arguments; raise ``UsageError`` for a surplus one.

        ``mixed`` accepts options between the positional arguments too.
        """
        read = self.parse_known_intermixed_args if mixed else self.parse_known_args
        arguments, unknown = read(list(words))
        for word in unknown:
            check_removed(f"{self.prog} {word.split('=')[0]}")
            if word.startswith("-"):
                options = {one for one in _options(self, words) if one.startswith("--")}
                raise UsageError(f"{unknown_name('option', word.split('=')[0], options)}")
        if unknown:
            self.error(f"unexpected argument {unknown[0]!r}")
        return arguments

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message.removeprefix('argument ')}: see {self.prog} --help.")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a value outside the choices, with the nearest one."""
        if action.choices is not None and value not in action.choices:
            check_removed(f"{self.prog} {value}")
            name = max(action.option_strings, key=len, default=action.metavar or action.dest)
            names = [str(choice) for choice in action.choices]
            raise UsageError(f"{unknown_name(str(name).lower(), value, names)}")


_UNSEEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Control characters except the tab and the newline, and what changes the direction of text."""


def visible(text: str) -> str:
    """Return a text for a terminal: what would command it, such as an escape, as its code."""
    return _UNSEEN.sub(lambda found: ascii(found[0])[1:-1], text)


def tell(stream: TextIO, text: str, *, exact: bool = False) -> None:
    """Write a text that may come from a database; an ``exact`` one as it is for programs."""
    stream.write(text if exact and not stream.isatty() else visible(text))
    stream.flush()


def discard_output() -> None:
    """Leave out the rest of the output, whose reader, such as ``head``, has closed it."""
    with suppress(io.UnsupportedOperation):  # it is no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def as_started(text: str) -> str:
    """Return a text with the names of the installed programs, if one of them is running."""
    if Path(sys.argv[0]).name in _INSTALLED:
        for name, command in _INSTALLED.items():
            text = text.replace(command, name)
    return text


def _options(parser: argparse.ArgumentParser, words: Sequence[str]) -> Iterator[str]:
    """Yield the options of a parser, and of the commands among ``words``."""
    for action in parser._actions:
        yield from action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            for name in set(words) & set(action.choices):
                yield from _options(action.choices[name], words)


def removed_word(typed: str) -> str | None:
    """Return what takes the place of a removed word; None if the text ends with no removed word.

    ``typed`` may begin with what leads to the word, such as ``python -m analysis floor``.
    """
    words = f" {typed}".replace(" dopt-", " ")
    for word, successor in SUCCESSORS.items():
        if words.endswith(f" {word}"):
            return f"'{word}' was removed: {successor}."
    return None


def check_removed(typed: str) -> None:
    """Raise ``UsageError`` if a typed text ends with a removed word."""
    if sentence := removed_word(typed):
        raise UsageError(sentence)


LARGEST = 1_000_000_000
"""Bound of seconds and GiB: system timers and limits overflow above it."""


def positive(option: str, number: type[int] | type[float]) -> Callable[[str], float]:
    """Return the argument type for a number above 0 and below ``LARGEST``."""
    expected = f"a {'whole number' if number is int else 'number'} above 0"

    def read(given: str) -> float:
        value: float = _number(
            option, number, expected, lambda value: 0 < value < float("inf"), given
        )
        if value >= LARGEST:
            raise UsageError(
                f"{option} is {given!r}, less than {LARGEST:,} is expected: give a smaller one."
            )
        return value

    return read


def integer(option: str) -> Callable[[str], int]:
    """Return the argument type for a whole number that a database can hold, 0 or above."""
    expected = "a whole number from 0 to 2^63 - 1"
    return partial(_number, option, int, expected, lambda value: 0 <= value < 2**63)


def _number(
    option: str, kind: Callable[[str], Any], expected: str, fits: Callable[[Any], bool], given: str
) -> Any:
    try:
        value = kind(given)
    except ValueError:
        value = -1
    if not fits(value):
        raise UsageError(f"{option} is {given!r}, {expected} is expected: give one.")
    return value


def path(option: str) -> Callable[[str], Path]:
    """Return the argument type for the path of a file or folder."""
    return partial(given_path, what=option, refusal=UsageError)


_FILES = (
    *(".csv", ".gif", ".html", ".json", ".md", ".npz"),
    *(".parquet", ".pdf", ".png", ".svg", ".tex", ".txt"),
)
"""Endings of files, which name no folder."""


def folder(option: str) -> Callable[[str], Path]:
    """Return the argument type for the path of a folder, which is not named like a file."""

    def read(given: str) -> Path:
        if given.endswith(_FILES):
            raise UsageError(f"{option} is {given!r}, but a folder is expected: give one.")
        return path(option)(given)

    return read


LONGEST = 100 * 365 * 86_400
"""Longest time [s] that an option takes: a hundred years."""

_TIME = re.compile(r"(?:(\d+)d)?(?:(\d+)h)?(?:(\d+)m)?(?:(\d+(?:\.\d+)?)s?)?")


def length_of_time(option: str) -> Callable[[str], float]:
    """Return the argument type for a time in seconds, such as ``90d``, ``1h30m`` or ``90``."""

    def read(given: str) -> float:
        found = _TIME.fullmatch(given)
        parts = [float(part or 0) for part in found.groups()] if found else [0.0] * 4
        whole = sum(part * unit for part, unit in zip(parts, (86_400, 3_600, 60, 1), strict=True))
        if whole > LONGEST:
            raise UsageError(
                f"{option} is {given!r}, at most a hundred years are expected: give a shorter time."
            )
        if not whole:
            raise UsageError(
                f"{option} is {given!r}, a time such as 55m, 1h30m or 90s is expected: give one."
            )
        return whole

    return read


ROOT = Path(__file__).resolve().parents[1]

COMMIT_VARIABLE = "DOPT_COMMIT"
"""Environment variable with the commit of code outside a repository, as in a container."""

LIMITS = (errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE)
"""Errors of a system that gives no more; it may at another time."""

Parameters = ParamSpec("Parameters")


def stored_results() -> NoReturn:
    """Run ``dopt``: commands on stored results."""
    run("orchestrate.__main__")


def analysis() -> None:
    """Run ``dopt-analysis``: figures, tables and the browser.

    An ``analysis.py`` in a folder of ``PYTHONPATH`` would be taken for the package of that name.
    """
    spec = PathFinder.find_spec("analysis", [str(ROOT)])
    if spec is None or spec.loader is None:
        raise ModuleNotFoundError(
            f"analysis is not installed beside orchestrate: install {DISTRIBUTION} again."
        )
    sys.modules["analysis"] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    importlib.import_module("analysis.__main__").program()


def run(module: str) -> NoReturn:
    """Run the function ``main`` of a module as a program of its own, and exit with its code."""
    end_at_interrupt()
    _open_streams()
    readable_streams()
    _tolerate_warnings()
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # nohup has it ignored
        signal.signal(signal.SIGHUP, lambda *_: signal.raise_signal(signal.SIGTERM))
    logging.raiseExceptions = False  # a log that cannot be written is lost
    os.environ["MPLBACKEND"] = "agg"  # another one may not be there
    sys.exit(_main(module))


def answered(main: Callable[Parameters, int]) -> Callable[Parameters, int]:
    """Return a function that prints what an exception of ``main`` says, and returns its code.

    :func:`exit_code` alone decides which code that is. ``HYDRA_FULL_ERROR=1`` shows the traceback.
    """

    @functools.wraps(main)
    def guarded(*arguments: Parameters.args, **options: Parameters.kwargs) -> int:
        try:
            return main(*arguments, **options)
        except KeyboardInterrupt:
            return ExitCode.INTERRUPTED
        except BrokenPipeError:
            discard_output()
            return ExitCode.DONE
        except Exception as error:
            return _answer(error)

    return guarded


def exit_code(error: Exception) -> ExitCode:
    """Return the exit code that an exception becomes.

    2 is for what the user can mend, 75 for what the same command may do later, 70 for a defect.
    """
    if isinstance(error, InfrastructureError) or _at_a_limit(error):
        return ExitCode.INFRASTRUCTURE
    kinds = (DoptError, OSError, ImportError, UnicodeDecodeError)
    return ExitCode.BAD_REQUEST if isinstance(error, kinds) else ExitCode.DEFECT


def _at_a_limit(error: BaseException | None) -> bool:
    if error is None or isinstance(error, DoptError):
        return False
    thread = isinstance(error, RuntimeError) and "can't start new thread" in str(error)
    one = thread or isinstance(error, MemoryError) or getattr(error, "errno", None) in LIMITS
    return one or _at_a_limit(error.__context__)  # what is cleaned up then may fail, too


def _answer(error: Exception) -> ExitCode:
    code, full = exit_code(error), without_password(traceback.format_exc())
    hidden = "" if isinstance(error, DoptError | OSError) else hiding(full)
    if hidden:
        code = ExitCode.BAD_REQUEST
    if code == ExitCode.DEFECT or os.environ.get("HYDRA_FULL_ERROR") == "1":
        tell(sys.stderr, full)
    if isinstance(error, OSError) and not error.filename:
        discard_output()  # which may be what cannot be written
    sentence = without_password(as_started(_sentence(error, code, hidden)))
    tell(sys.stderr, f"error: {sentence}\n")
    return code


def _sentence(error: Exception, code: ExitCode, hidden: str) -> str:
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    if isinstance(error, DoptError):
        return str(error)
    if isinstance(error, UnicodeDecodeError):
        return f"A file is no text in UTF-8 ({error}): mend it, such as a matplotlibrc."
    if hidden or isinstance(error, ImportError):
        return (
            f"{type(error).__name__}: {error}: {hidden or 'install dopt and its libraries again.'}"
        )
    if code == ExitCode.INFRASTRUCTURE:
        return (
            f"The system gives this process no further process, thread, file or memory ({reason}): "
            "raise its limits (ulimit, pids.max) or use fewer workers, and run the same command "
            "again."
        )
    if isinstance(error, OSError):
        return (
            f"{error.filename or 'The output, or a file,'} cannot be used ({reason}): check the "
            "path, its permissions and the room on its disk, or give another one."
        )
    return (
        "this is a defect of the program (traceback above); committed trials are kept: report it, "
        "and run the same command again."
    )


def say(text: str) -> None:
    """Print a line and flush it; the trials go on although nobody reads the output any longer."""
    try:
        tell(sys.stdout, f"{without_password(as_started(text))}\n")
    except OSError as error:
        discard_output()
        if not isinstance(error, BrokenPipeError):
            sys.stderr.write(f"note: the output is lost from here on ({error.strerror}).\n")


def hiding(text: str) -> str:
    """Return a clause on the file that hides a module of the standard library, or nothing.

    Python finds a module in the folders of ``PYTHONPATH`` first. ``text`` is a traceback, which
    names the module or the file.
    """
    library = str(Path(os.__file__).parent)
    for folder in takewhile(lambda one: one != library, sys.path):
        for path in (*Path(folder).glob("*.py"), *Path(folder).glob("*/__init__.py")):
            name = path.parent.name if path.name == "__init__.py" else path.stem
            if name in sys.stdlib_module_names and (str(path) in text or f"'{name}'" in text):
                return f"{path} hides the module {name} of the standard library: rename this file."
    return ""


@answered
def _main(module: str) -> int:
    try:
        _check_folder()
        if "--version" in sys.argv[1:]:
            say(version())
            return ExitCode.DONE
        main = importlib.import_module(module).main
        raise_at_interrupt()
        return int(main())
    finally:
        sys.stdout.flush()


def _check_folder() -> None:
    try:
        Path.cwd()
    except OSError as error:
        folder = str(Path("/proc/self/cwd").readlink()).removesuffix(" (deleted)")
        raise LaunchError(
            f"The current folder {folder} cannot be used ({error.strerror}), it may have been "
            "deleted: change to another one."
        ) from error


def version() -> str:
    """Return the version of dopt, with its commit where that is known."""
    try:
        number = dopt.__version__
    except ModuleNotFoundError:  # run from its sources
        number = "(not installed)"
    commit = commit_of(ROOT) or os.environ.get(COMMIT_VARIABLE)
    return f"dopt {number}" + (f", commit {commit}" if commit else "")


def commit_of(root: Path) -> str | None:
    """Return the commit of the code; a repository that merely holds an installed copy has none."""
    top = git(root, "rev-parse", "--show-toplevel")
    if top is None or Path(os.fsdecode(top.strip())).resolve() != root.resolve():
        return None
    commit = git(root, "rev-parse", "HEAD")
    return commit.decode().strip() if commit else None


def git(root: Path, *arguments: str) -> bytes | None:
    """Return what git prints, or None outside a repository and without git."""
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, check=True, timeout=20
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout


class _Lossy(io.FileIO):
    """Standard error that loses what cannot be written, as when its terminal is gone."""

    def write(self, data: object, /) -> int:
        try:
            return super().write(data)  # type: ignore[arg-type]
        except OSError:
            return len(memoryview(data))  # type: ignore[arg-type]


def _open_streams() -> None:
    """Open the streams that are closed: the next files that are opened would take their place."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))
    raw: IO[bytes] = io.BufferedWriter(_Lossy(2, "w", closefd=False))
    sys.stderr = io.TextIOWrapper(raw, encoding=sys.stderr.encoding, line_buffering=True)


def readable_streams() -> None:
    """Let letters that a terminal does not know be written as their codes."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _tolerate_warnings() -> None:
    """Print the warnings that PYTHONWARNINGS makes errors: libraries' warnings end no program."""
    if any(action == "error" for action, *_ in warnings.filters):
        warnings.resetwarnings()
        warnings.simplefilter("default")
        given = os.environ.get("PYTHONWARNINGS", "")
        os.environ["PYTHONWARNINGS"] = given.replace("error", "default")  # of workers, too
