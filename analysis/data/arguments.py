"""Arguments of a notebook: what of the database is asked for, and which trial."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Iterable, Mapping

import pandas as pd

from analysis.data.config_matching import Filter, read_condition
from analysis.errors import AnalysisError


def request(env: object, policy: object, where: object) -> Filter:
    """Return the filter of a request; raise AnalysisError for arguments of another kind."""
    return Filter(
        _names("env", env, "pendulum", "cartpole"),
        _names("policy", policy, "random", "d_optimal"),
        {} if where is None else _conditions(where),
    )


def trial_key(trial: object) -> str:
    """Return the key of a trial that is given as its key or as a row of the table of trials."""
    if isinstance(trial, str):
        return trial
    if isinstance(trial, Mapping | pd.Series):
        key = trial.get("trial_key")
        if isinstance(key, str):
            return key
    given = f"a table of {len(trial)} rows" if isinstance(trial, pd.DataFrame) else _short(trial)
    raise AnalysisError(
        f"The trial is {given}, but one row of results.trials() or a trial key is expected: "
        f"give for instance results.trials().iloc[0]."
    )


def _names(what: str, given: object, *example: str) -> tuple[str, ...]:
    if isinstance(given, str):
        return (given,)
    names = tuple(given) if isinstance(given, Iterable) else (given,)
    known = tuple(name for name in names if isinstance(name, str))
    if len(known) < len(names):
        one, two = map(json.dumps, example)
        raise AnalysisError(
            f"{what} is {_short(given)}, but a name or a list of names is expected: "
            f"write for instance {what}={one} or {what}=[{one}, {two}]."
        )
    return known


def _conditions(given: object) -> Mapping[str, object]:
    if isinstance(given, Mapping) and all(isinstance(path, str) for path in given):
        return given
    texts = given if isinstance(given, list) else [given]
    read = [read_condition(text) for text in texts if isinstance(text, str)]
    meant = dict(condition for condition in read if condition) or {"model.width": 32}
    raise AnalysisError(
        f"where is {_short(given)}, but a mapping of dotted paths to values is expected: "
        f"write for instance where={meant!r}."
    )


def _short(given: object) -> str:
    return " ".join(reprlib.repr(given).split())
