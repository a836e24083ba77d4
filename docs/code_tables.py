"""Tables of the pages that are made from the code: options, settings, columns, source map."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import functools
import inspect
import re
import sqlite3
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from analysis.cli import parser
from dopt import LEARNERS, MODELS, POLICIES, Explorer, Plant
from dopt.assessment import MEASURES
from dopt.control import TASKS
from dopt.explorer.signs import STORED
from dopt.fitting.export import FIT_MEASURES
from dopt.kernel import plugin
from dopt.systems import NAMED_SYSTEMS
from dopt.systems.base import System
from dopt.trial_view import TrialView
from orchestrate.config.options import CONFIGURATION, option_names
from orchestrate.store.schema import OUTCOME, RUN_COLUMNS, VIEWS, metadata

ROOT = Path(__file__).parents[1]

Rows = Iterable[Sequence[str]]

CLASSES: dict[str, Mapping[str, type]] = {
    "env": NAMED_SYSTEMS,
    "policy": POLICIES,
    "model": MODELS,
    "learner": LEARNERS,
    "task": TASKS,
}

COMMENTED = re.compile(r"^ *([\w.]+):(?: +([^#\n]*?))? *(?:# (.*))?$", re.MULTILINE)
"""A setting of a file of options: key, value and comment."""


TABLE_TITLES: Mapping[str, str] = {
    "config": "one row for each configuration: all that defines a trial but its seed",
    "trial": "one row for each trial: a configuration with a seed",
    "step": "one row for each step of each finished trial",
    "trajectory": "one row for each finished trial: its arrays",
    "assessment": "one row for each measure of a finished trial: of a task, limits or samples",
    "launch": "one row for each command that ran trials",
    "attempt": "one row for each run of a trial, lost runs included",
    "error": "one row for each distinct traceback",
}
"""In the order of the card."""

_TRIAL_ID = ("", "trial, a row of `trial`")
_LAUNCH_ID = ("", "launch, a row of `launch`")
_ERROR_ID = ("", "error, a row of `error`")
_OUTCOME = {name: (one.unit, one.meaning) for name, one in OUTCOME.items()}

COLUMNS: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "config": {
        "config_id": ("", "number of the configuration"),
        "config_key": ("", "SHA-256 of `config_json`"),
        "env": ("", "system"),
        "policy": ("", "policy that chooses the inputs"),
        "model": ("", "model that is learned"),
        "learner": ("", "rule that updates the parameters of the model"),
        "width": ("units", "width of the hidden layers"),
        "depth": ("layers", "number of hidden layers"),
        "horizon": ("steps", "number of steps of a trial"),
        "dt": ("s", "duration of a step"),
        "gamma": ("unit of the input", "bound of the norm of an input"),
        "config_json": ("", "the whole configuration, without the fields that have the defaults"),
        "label": ("", "the policy, and every setting that is not the default"),
    },
    "trial": {
        "trial_id": ("", "number of the trial"),
        "trial_key": ("", "SHA-256 of configuration and seed"),
        "config_id": ("", "configuration, a row of `config`"),
        "seed": ("", "seed of all random numbers of the trial"),
        "status": ("", "pending, running, done, diverged, failed or cancelled"),
        "owner": ("", "launch that runs the trial"),
        "attempt": ("", "number of runs"),
        **_OUTCOME,
        "launch_id": _LAUNCH_ID,
        "error_id": _ERROR_ID,
        "registered_by": ("", "number of the launch that registered it"),
    },
    "step": {
        "trial_id": _TRIAL_ID,
        "t": ("step", "number of the step, from 0; its time is t · dt"),
        "loss": (
            "unit of the accelerations (m/s², rad/s²)",
            "root-mean-square error of the learned accelerations over the evaluation grid",
        ),
        "reachable_loss": (
            "unit of the accelerations (m/s², rad/s²)",
            "the same over states that the true system visits under strong inputs",
        ),
        "plan_us": ("µs", "time of planning"),
        "learn_us": ("µs", "time of learning"),
        "evaluate_us": ("µs", "time of evaluation"),
    },
    "trajectory": {
        "trial_id": _TRIAL_ID,
        "dtype": ("", "type of the numbers, always 64-bit floating point"),
        "states_shape": ("", "number of states (T + 1) and of their components d, as JSON"),
        "states": ("SI units: m, rad, m/s, rad/s", "states before step 0 to after the last one"),
        "inputs_shape": ("", "number of steps T and of inputs m, as JSON"),
        "inputs": ("unit of the input (N, N m)", "inputs of all steps"),
        "parameters_shape": ("", "number of parameters, as JSON"),
        "parameters": ("", "parameters of the model after the last step"),
    },
    "assessment": {
        "trial_id": _TRIAL_ID,
        "t": ("steps", "explored steps before the assessment"),
        "measure": ("", "name of the measure, such as control_success, coverage or violations"),
        "value": ("of the measure", "value; missing where it is not finite"),
    },
    "launch": {
        "launch_id": ("", "number of the launch"),
        "token": ("", "name of the launch that no other one has"),
        "state": ("", "running, done, failed, interrupted or lost"),
        "started": ("UTC", "time of the start"),
        "ended": ("UTC", "time of the end"),
        "lease_until": ("s since 1970", "time until which a launch on PostgreSQL counted as alive"),
        "host": ("", "host of the command"),
        "pid": ("", "process of the command"),
        "argv": ("", "command line as JSON, passwords replaced"),
        "overrides": ("", "settings of the command line as JSON, passwords replaced"),
        "git_commit": ("", "commit of the code"),
        "git_dirty": ("0 or 1", "whether the code differed from the commit"),
        "git_diff_hash": ("", "SHA-256 of the difference from the commit"),
        "versions": ("", "versions of interpreter, libraries and processor, as JSON"),
        "exit_code": ("", "exit code of the command"),
        "fingerprint": ("", "digests of the code, and versions of libraries, as JSON"),
    },
    "attempt": {
        "trial_id": _TRIAL_ID,
        "attempt": ("", "number of the run, from 1"),
        "launch_id": _LAUNCH_ID,
        "outcome": (
            "",
            "done, diverged, failed, released (given back: its process died, or a stop)"
            " or lost (its launch died)",
        ),
        "cause": ("", "why it failed"),
        "node": ("", "host of the run"),
        "pid": ("", "process of the run"),
        "claimed": ("UTC", "time at which the launch claimed the trial"),
        "started": ("UTC", "time of the start"),
        "ended": ("UTC", "time of the end"),
        **{name: _OUTCOME[name] for name in RUN_COLUMNS if name != "node"},
        "error_id": _ERROR_ID,
    },
    "error": {
        "error_id": ("", "number of the error"),
        "hash": ("", "hash of the traceback"),
        "type": ("", "class of the exception"),
        "message": ("", "message of the exception"),
        "traceback": ("", "traceback of the exception"),
    },
}
"""Unit and meaning of the columns of each table, in the order of the schema."""


def markdown(head: Sequence[str], rows: Rows) -> str:
    first, *others = (f"| {' | '.join(line)} |" for line in (head, *rows))
    return "\n".join([first, "|---" * len(head) + "|", *others]) + "\n"


def cell(text: str) -> str:
    """Return a text of a docstring or comment as one cell of a table."""
    plain = re.sub(r":\w+:`~?([^`]*)`", r"`\1`", " ".join(text.split()))
    return plain.replace("``", "`").rstrip(".:").replace("|", r"\|")


def first_sentence(text: str) -> str:
    return re.split(r"(?<=\.) (?=[A-Z`])", cell(text))[0].rstrip(".:")


def comment(path: Path) -> str:
    """Return what a file of options says of itself in its first lines."""
    lines = re.sub(r"# @package \S+\n", "", path.read_text()).splitlines()
    end = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    return " ".join(line.lstrip("# ") for line in lines[:end])


def choices(cls: type) -> dict[str, tuple[str, ...]]:
    """Return the choices of the fields that are one of some words."""
    return {one.name: one.metadata.get("choices", ()) for one in dataclasses.fields(cls)}


def settings(values: Mapping[str, Any], among: Mapping[str, tuple[str, ...]]) -> str:
    """Return settings with their defaults and other choices, as one cell of a table."""

    def text(value: object) -> str:
        if value is None or isinstance(value, bool):
            return "null" if value is None else str(value).lower()
        return str(value).replace(" ", "").replace("'", "")

    def shown(key: str, value: object) -> str:
        others = [f"`{one}`" for one in among.get(key, ()) if one != value]
        return f"`{key}={text(value)}`" + (f" (or {', '.join(others)})" if others else "")

    return " ".join(shown(key, value) for key, value in values.items() if key != "name")


def fields(cls: type) -> dict[str, object]:
    found = {one.name: one.default for one in dataclasses.fields(cls)}
    return {key: list(one) if isinstance(one, tuple) else one for key, one in found.items()}


def option(group: str, name: str) -> list[str]:
    """Return the row of an option: name, what it is, its settings with their defaults."""
    path, known = CONFIGURATION / group / f"{name}.yaml", CLASSES.get(group, {})
    if path.exists():
        said, found = comment(path), yaml.safe_load(path.read_text())
        own = {key: one for key, one in found.get(group, found).items() if key != "defaults"}
        cls = known.get(str(own.get("name")))
    else:
        folder, _, short = name.rpartition("/")
        cls = known[f"mujoco_{short}" if folder == "mujoco" else short]
        said, own = inspect.getdoc(cls) or "", fields(cls)
    shared = fields(System) if group == "env" else {}
    own = {key: one for key, one in own.items() if key not in shared}
    return [f"`{name}`", first_sentence(said), settings(own, choices(cls) if cls else {})]


def of_group(group: str) -> str:
    """Return the options of a group; the complete grids of an experiment are no settings."""
    rows = [option(group, name) for name in option_names(group)]
    if group == "experiment":
        return markdown(["experiment", "grid"], [row[:2] for row in rows])
    return markdown([group, "is", "settings"], rows)


def explained(section: str, keys: Callable[[str], bool] = bool) -> str:
    """Return settings with their defaults and the comments behind them."""
    rows = [
        [f"`{key}`", f"`{value}`", said] for key, value, said in COMMENTED.findall(section)
        if keys(key)
    ]  # fmt: skip
    return markdown(["key", "default", "meaning"], rows)


def system_settings() -> str:
    """Return the settings that all systems have, with the values of the pendulum."""
    text = (CONFIGURATION / "env/pendulum.yaml").read_text()
    return explained(text, fields(System).__contains__)


def launch_settings() -> str:
    text = (CONFIGURATION / "config.yaml").read_text()
    section = text.split("\nlaunch:\n")[1].split("\n\n")[0]
    return explained(section.replace("  ray:\n    address", "  ray.address"))


def columns() -> str:
    """Return the columns of every table of the database, with unit and meaning."""
    rows = [
        [f"`{table}`", f"`{name}`", unit, said]
        for table, found in COLUMNS.items()
        for name, (unit, said) in found.items()
    ]
    return markdown(["table", "column", "unit", "meaning"], rows)


ROW_OF = {
    "v_trial": "trial", "v_curve": "trial and step", "v_curve_stats": "configuration and step",
    "v_progress": "configuration", "v_failures": "failed attempt",
    "v_assessment": "trial, step and measure",
}  # fmt: skip


def views() -> str:
    """Return the columns of every view of the database that it has beside the shared ones."""
    with sqlite3.connect(":memory:") as database:
        for table in metadata.sorted_tables:
            names = ", ".join(column.name for column in table.columns)
            database.execute(f"CREATE TABLE {table.name} ({names})")
        for name, query in VIEWS.items():
            database.execute(f"CREATE VIEW {name} AS {query}")
        found = {
            name: [one[0] for one in database.execute(f"SELECT * FROM {name}").description]
            for name in VIEWS
        }
    shared = [name for name in found["v_trial"] if all(name in names for names in found.values())]
    rows = [
        [f"`{view}`", ROW_OF[view], ", ".join(f"`{one}`" for one in names if one not in shared)]
        for view, names in found.items()
    ]
    return markdown(["view", "one row per", "columns"], rows)


def tables() -> str:
    return markdown(
        ["table", "content"], [[f"`{name}`", one] for name, one in TABLE_TITLES.items()]
    )


def measures(of: Mapping[str, str] | None = None) -> str:
    of = {**MEASURES, **STORED} if of is None else of
    rows = [[f"`{name}`", said] for name, said in of.items()]
    return markdown(["measure", "value"], rows)


def trial_view() -> str:
    """Return the methods of a view of a trial."""
    rows = []
    for name, made in vars(TrialView).items():
        if not name.startswith("_"):
            said = first_sentence(inspect.getdoc(made) or "").removeprefix("Return ")
            names = list(inspect.signature(made).parameters)[1:] if callable(made) else None
            rows.append([f"`{name}`" if names is None else f"`{name}({', '.join(names)})`", said])
    return markdown(["view", "is"], rows)


def figure_options() -> str:
    """Return the options of ``python -m analysis figures`` with their help."""
    commands = next(
        one for one in parser()._actions if one.dest == argparse.SUPPRESS and one.choices
    )
    rows = []
    for one in commands.choices["figures"]._actions:
        if one.dest not in ("help", "only"):
            choices = f" `{'` `'.join(map(str, one.choices))}`" if one.choices else ""
            rows.append(
                [f"`{one.option_strings[0]}`{choices}", cell((one.help or "").replace("%%", "%"))]
            )
    return markdown(["option", "meaning"], rows)


def kernel_helpers() -> str:
    """Return the functions of the kernel that compiled policies and learners may call."""
    rows = []
    for name in plugin.__all__:
        made = getattr(plugin, name)
        if inspect.isclass(made):
            continue
        made = getattr(made, "py_func", made)
        said = first_sentence(inspect.getdoc(made) or "").removeprefix("Return ")
        names = ", ".join(inspect.signature(made).parameters)
        rows.append([f"`{plugin.__name__}.{name}({names})`", said])
    return markdown(["function", "result"], rows)


def source_map() -> str:
    """Return the modules and folders of the packages with the first lines of their docstrings."""

    def said(path: Path) -> str:
        text = ast.get_docstring(ast.parse(path.read_text())) or ""
        return text.partition("\n")[0].replace("``", "").replace(":mod:", "").replace("`", "")

    lines = []
    for package in ("dopt", "orchestrate", "orchestrate/store", "analysis"):
        folder = ROOT / package
        lines.append(f"{package + '/':<22}{said(folder / '__init__.py')}")
        files = [one for one in sorted(folder.glob("*.py")) if not one.name.startswith("__")]
        lines += [f"  {one.name:<20}{said(one)}" for one in files]
        for one in sorted(folder.glob("*/__init__.py")):
            if (name := one.parent.name) != "store":
                lines.append(f"  {name + '/':<20}{said(one)}")
    return "```text\n" + "\n".join(lines) + "\n```\n"


def arguments(cls: type) -> str:
    """Return the arguments of a class as its docstring explains them."""
    text = (inspect.getdoc(cls) or "").split("Parameters\n----------\n")[1]
    text = text.split("\nRaises\n------")[0]
    found = re.findall(r"^(\w.*?) : (.*)\n((?: +.*\n?|\n)+)", text, re.MULTILINE)
    defaults = {one.name: one.default for one in inspect.signature(cls).parameters.values()}

    def shown(names: str) -> str:
        given = [defaults[name] for name in names.split(", ")]
        return ", ".join(
            f"`{one!r}`" for one in given if one not in (inspect.Parameter.empty, None)
        )

    rows = [[f"`{names}`", kind, shown(names), cell(said)] for names, kind, said in found]
    return markdown(["argument", "type", "default", "meaning"], rows)


TABLES: dict[str, Callable[[], str]] = {
    "plant_arguments": functools.partial(arguments, Plant),
    "explorer_arguments": functools.partial(arguments, Explorer),
    "fit_measures": functools.partial(measures, FIT_MEASURES),
}
TABLES |= {
    made.__name__: made
    for made in (
        launch_settings,
        system_settings,
        tables,
        columns,
        measures,
        trial_view,
        views,
        source_map,
        figure_options,
        kernel_helpers,
    )
}
TABLES |= {
    f"{group}_options": functools.partial(of_group, group)
    for group in (
        *("env", "policy", "model", "learner", "plant", "limits", "task"),
        *("executor", "store", "experiment"),
    )
}  # fmt: skip
