"""Command line of a launch: checked, composed by Hydra, and returned in plain types.

Hydra composes the configuration of the launch, with the overrides that have one value. A grid is
expanded from it (:mod:`orchestrate.config.expand`).
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Quote, QuotedString
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dopt.errors import SpecificationError
from orchestrate.config import TRIAL_SECTIONS, Combination
from orchestrate.config.expand import expand, reject_unknown
from orchestrate.config.options import (
    CONFIGURATION,
    content_of,
    option_names,
    parsed_overrides,
    register,
)
from orchestrate.program import Parser, UsageError, as_started, check_removed

PROGRAM = "python orchestrate/launch.py"
LAUNCH_SECTIONS = ("launch", "store", "executor")

_SWITCHES = (
    ("--help", "-h"),
    ("--hydra-help",),
    ("--version",),
    ("--resolve",),
    ("--run", "-r"),
    ("--multirun", "-m"),
    ("--shell-completion", "-sc"),
)
_OPTIONS = (
    ("--package", "-p"),
    ("--config-path", "-cp"),
    ("--config-name", "-cn"),
    ("--config-dir", "-cd"),
)
_INFO = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")

_UNQUOTED = re.compile(r"(?s)(?!null$)[^'\"](?:(?!,\w+://).)*")
"""Database URL that may hold a character which Hydra takes in quotes alone; not several."""

_CHOICE = re.compile(r"(?P<added>\+{0,2})(?P<group>[\w/]+)(?P<package>@[\w.:]*)?=(?P<value>.*)")
_NO_OPTION = re.compile(r"(null|\[.*\]|)\s*")
_OF_TRIALS = re.compile(rf"[+~]*(?:{'|'.join(TRIAL_SECTIONS)})\.")
"""Override of a key that may exist only in some options of a grid."""

_NEEDED = re.compile(rf"~(?:{'|'.join((*LAUNCH_SECTIONS, *TRIAL_SECTIONS, 'width'))})(?:=.*)?")
"""Deletion of what every launch reads."""

_COMPLETION = re.compile("(install|uninstall|query)=")
_OF_HYDRA = re.compile(r"[+~]*hydra[./]")
_OWN_GRIDS = re.compile(r"[+~]*(hydra/sweeper|hydra\.mode)=")


@dataclass(frozen=True)
class Request:
    """Combinations and launch settings of a command line, in plain types."""

    combinations: Sequence[Combination]
    launch: dict[str, Any]
    overrides: tuple[str, ...]
    single: bool


def read_command_line() -> Request | None:
    """Return the request of ``sys.argv``, or None if Hydra has printed its answer (``--help``).

    ``sys.argv`` then has the flags before the overrides, and the quotes that Hydra requires.

    Raises
    ------
    UsageError
        If a flag is unknown, flags contradict each other, or a setting was removed.
    Exception
        Errors of Hydra and of the grid.
    """
    flags = _checked(_parser().read(sys.argv[1:], mixed=True))
    options = [word for word in sys.argv[1:] if word not in flags.overrides]
    words = [_quoted(word) for word in flags.overrides]
    sys.argv[1:] = [*options, *words]
    grid = flags.multirun and not (flags.help or flags.hydra_help)
    if grid:
        options = [word for word in options if word not in ("-m", "--multirun")]
    given = tuple(word for word in words if not _OF_HYDRA.match(word))
    found: list[Request | Exception] = []

    def capture(config: DictConfig) -> None:
        try:
            found.append(_grid(config, given) if grid else _single(config, given))
        except Exception as error:  # Hydra would add a line of its own
            found.append(error)

    register()
    answer = io.StringIO()
    words = _of_launch(words) if grid else words
    with _hydra_called_with([*options, *words]):
        try:
            with contextlib.redirect_stdout(answer):
                if options or any(map(_OF_HYDRA.match, words)):
                    folder = str(CONFIGURATION)
                    hydra.main(version_base="1.3", config_path=folder, config_name="config")(
                        capture
                    )()
                else:  # as hydra.main does, which composes everything twice
                    with hydra.initialize_config_dir(str(CONFIGURATION), version_base="1.3"):
                        config = hydra.compose("config", list(words), return_hydra_config=True)
                        HydraConfig.instance().set_config(config)
                        capture(config)
        finally:
            if text := answer.getvalue():
                sys.stdout.write(as_started(text))
    request = found[0] if found else None
    if isinstance(request, Exception):
        raise request
    return request


def _parser() -> Parser:
    """Return a parser for the flags of Hydra."""
    parser = Parser(prog=PROGRAM, add_help=False)
    parser.add_argument("overrides", nargs="*")
    for names in _SWITCHES:
        parser.add_argument(*names, action="store_true")
    for names in _OPTIONS:
        parser.add_argument(*names)
    parser.add_argument("--cfg", "-c", choices=("job", "hydra", "all"))
    parser.add_argument("--info", "-i", nargs="?", const="all", choices=_INFO)
    return parser


def _checked(flags: argparse.Namespace) -> argparse.Namespace:
    if flags.multirun and flags.cfg:
        raise UsageError(
            "-m and --cfg cannot be combined, a configuration describes one trial: look at a grid "
            "with launch.dry_run=true, or leave out -m."
        )
    given = {
        "--run": flags.run,
        "--multirun": flags.multirun,
        "--cfg": flags.cfg,
        "--shell-completion": flags.shell_completion,
        "--info": flags.info,
    }
    several = [name for name, value in given.items() if value]
    if len(several) > 1:
        raise UsageError(f"{' and '.join(several)} cannot be combined: leave one out.")
    if flags.resolve and not (flags.cfg or flags.help):
        raise UsageError("--resolve goes with --cfg or --help: add one of them.")
    if flags.shell_completion and not any(map(_COMPLETION.match, flags.overrides)):
        raise UsageError(
            "--shell-completion names no shell, but one is expected: write for instance "
            "--shell-completion install=bash."
        )
    for option, name in (("--config-dir", flags.config_dir), ("--config-path", flags.config_path)):
        if name and not Path(name).is_dir():
            raise UsageError(
                f"{option} is '{name}', but a folder is expected: give one that exists."
            )
    if flags.config_path and not Path(flags.config_path).is_absolute():  # from Hydra's view
        raise UsageError(
            f"--config-path is '{flags.config_path}', but a whole path is expected: write "
            f"--config-path {Path(flags.config_path).absolute()}, or add files by --config-dir."
        )
    for word in flags.overrides:
        if word.startswith("="):
            raise UsageError(f"'{word}' names no key: write key=value, such as env=arm.")
        check_removed(word)
        check_removed(word.partition("=")[0])
        if _NEEDED.fullmatch(word):
            raise UsageError(
                f"'{word}' deletes what a launch needs: leave it out, or give another value."
            )
        own = _OWN_GRIDS.match(word)
        if own and word != "hydra/sweeper=grid":
            raise UsageError(
                f"{own[1]} is set, but this program expands its grids itself: leave {own[1]} out."
            )
        _check_choice(word)
    return flags


def _check_choice(word: str) -> None:
    """Refuse null, a list or an empty value as the option of a group, and one more option."""
    match = _CHOICE.fullmatch(word)
    options = ", ".join(option_names(match["group"])) if match else ""
    if not match or not options:
        return
    group, value = match["group"], match["value"]
    if match["added"] and not match["package"] and not value.startswith("{"):
        raise UsageError(f"'{word}' adds an option, but {group} has one already: leave out the +.")
    if group == "experiment" and value.strip() == "null":
        raise UsageError(f"'{word}' is what a launch without it has: leave it out.")
    if group != "experiment" and _NO_OPTION.fullmatch(value):
        what = f"the list {value}" if value.startswith("[") else value or "empty"
        raise SpecificationError(
            f"{group} is {what}, but one of {options} is expected: give one, or several to a grid "
            f"as in -m {group}=a,b."
        )


def _quoted(word: str) -> str:
    """Return ``launch.until=ci<5%`` or a URL with the quotes that Hydra requires around them."""
    key, _, value = word.partition("=")
    rule = key.lstrip("+") == "launch.until" and value.startswith("ci")
    if rule or (key.lstrip("+") == "store.url" and _UNQUOTED.fullmatch(value)):
        return f"{key}={QuotedString(value, Quote.single).with_quotes()}"
    return word


def _of_launch(words: Sequence[str]) -> list[str]:
    """Return the overrides of a grid that Hydra composes first.

    Sweeps are left out, and so are keys that only some swept options have, such as
    ``policy.budget_us=20`` with ``policy=beyond/exact,random``.
    """
    parsed = parsed_overrides(words)
    return [
        word
        for word, one in zip(words, parsed, strict=True)
        if not one.is_sweep_override() and not _OF_TRIALS.match(word)
    ]


@contextlib.contextmanager
def _hydra_called_with(words: Sequence[str]) -> Iterator[None]:
    """Give Hydra the words, and let it raise its errors in place of printing them.

    Workers do not inherit the setting.
    """
    arguments, before = list(sys.argv), os.environ.get("HYDRA_FULL_ERROR")
    sys.argv[1:] = words
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield
    finally:
        sys.argv[:] = arguments
        del os.environ["HYDRA_FULL_ERROR"]
        if before is not None:
            os.environ["HYDRA_FULL_ERROR"] = before


def _grid(config: DictConfig, overrides: tuple[str, ...]) -> Request:
    settings = HydraConfig.get()
    params = dict(settings.sweeper.params)
    grids = [{**params, **grid} for grid in settings.sweeper.grids] or [params]
    words = [[*(_override(*item) for item in one.items()), *overrides] for one in grids]
    combinations = expand(settings, *words)  # type: ignore[arg-type]  # a DictConfig of this type
    for one in parsed_overrides(overrides):  # a setting of the launch may refer to one of a trial
        if _OF_TRIALS.match(str(one.input_line)) and not one.is_sweep_override():
            with contextlib.suppress(OmegaConfBaseException):
                OmegaConf.update(config, one.key_or_group, one.value())
    return Request(combinations, _plain(config, LAUNCH_SECTIONS), overrides, single=False)


def _single(config: DictConfig, overrides: tuple[str, ...]) -> Request:
    _require_multirun(overrides, HydraConfig.get())
    parsed_overrides(overrides)
    reject_unknown(config)
    combination = Combination(_plain(config, TRIAL_SECTIONS))
    return Request([combination], _plain(config, LAUNCH_SECTIONS), overrides, single=True)


def _require_multirun(overrides: Sequence[str], settings: Any) -> None:
    """Refuse an experiment whose sweeps would be ignored without ``-m``."""
    named = {word.lstrip("+").partition("=")[0] for word in overrides}
    usual = content_of(CONFIGURATION / "config.yaml")["hydra"]["sweeper"]["params"]
    sweeps = dict(settings.sweeper.params)
    for grid in settings.sweeper.grids:
        sweeps |= grid
    left = [
        f"{key}={value}"
        for key, value in sweeps.items()
        if key not in named and usual.get(key) != value
    ]
    if left:
        raise UsageError(
            f"experiment={settings.runtime.choices.get('experiment')} is a grid "
            f"({' '.join(left)}): add -m, or give each of these keys one value for a single trial."
        )


def _override(key: str, value: Any) -> str:
    """Return the override as typed: text such as ``range(0,5)`` unchanged, the rest as JSON."""
    if isinstance(value, str):
        return f"{key}={value}"
    plain = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
    return f"{key}={json.dumps(plain)}"


def _plain(config: DictConfig, sections: Sequence[str]) -> dict[str, Any]:
    """Return the sections, resolved and in plain types."""
    parts: Mapping[str, Any] = {key: config[key] for key in sections}
    return {
        key: OmegaConf.to_container(part, resolve=True) if OmegaConf.is_config(part) else part
        for key, part in parts.items()
    }
