"""Meaning and unit of every column of a bundle, for its card."""

from __future__ import annotations

from collections.abc import Mapping

from orchestrate.store.schema import OUTCOME, RUN_COLUMNS

TABLE_TITLES: Mapping[str, str] = {
    "config": "one row for each configuration: all that defines a trial but its seed",
    "trial": "one row for each trial: a configuration with a seed",
    "step": "one row for each step of each finished trial",
    "trajectory": "one row for each finished trial: its arrays",
    "assessment": "one row for each measure of a finished trial that has a task or limits",
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
        "config_id": ("", "number of the configuration in this bundle"),
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
        "trial_id": ("", "number of the trial in this bundle"),
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
        "launch_id": ("", "number of the launch in this bundle"),
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
        "outcome": ("", "how the run ended"),
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
        "error_id": ("", "number of the error in this bundle"),
        "hash": ("", "hash of the traceback"),
        "type": ("", "class of the exception"),
        "message": ("", "message of the exception"),
        "traceback": ("", "traceback of the exception"),
    },
}
"""Unit and meaning of the columns of each table, in the order of the schema."""
