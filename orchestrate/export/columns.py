"""Columns of the exported tables, in the order of the file."""

from __future__ import annotations

import pyarrow as pa

from orchestrate.store.schema import OUTCOME_COLUMNS, trial

_TEXT, _WHOLE, _REAL = pa.string(), pa.int64(), pa.float64()
STEP_COLUMNS = ("loss", "reachable_loss", "plan_us", "learn_us", "evaluate_us")
_NAMES = (("env", _TEXT), ("policy", _TEXT), ("model", _TEXT), ("learner", _TEXT))
_SIZES = (("width", _WHOLE), ("depth", _WHOLE))
_KINDS = {int: _WHOLE, float: _REAL, str: _TEXT}
_OUTCOME = tuple((name, _KINDS[trial.c[name].type.python_type]) for name in OUTCOME_COLUMNS)

CURVES = pa.schema(
    [
        ("config", _TEXT),
        *_NAMES,
        *_SIZES,
        ("seed", _WHOLE),
        ("status", _TEXT),
        ("t", _WHOLE),
        *((name, _REAL) for name in STEP_COLUMNS),
    ]
)
"""One row for each step; ``config`` is the beginning of the configuration's key."""

TRIALS = pa.schema(
    [
        ("trial_key", _TEXT),
        ("config_key", _TEXT),
        *_NAMES,
        *_SIZES,
        *(("horizon", _WHOLE), ("dt", _REAL), ("gamma", _REAL)),
        *(("seed", _WHOLE), ("status", _TEXT), ("attempt", _WHOLE)),
        *_OUTCOME,
        *(("launch_id", _WHOLE), ("error_type", _TEXT), ("error_message", _TEXT)),
    ]
)
"""One row for each trial, with or without a result."""


ASSESSMENTS = pa.schema(
    [
        ("config", _TEXT),
        *_NAMES,
        *_SIZES,
        *(("seed", _WHOLE), ("status", _TEXT), ("t", _WHOLE), ("measure", _TEXT), ("value", _REAL)),
    ]
)
"""One row for each measure of a trial after t explored steps."""


def trajectories(n_states: int, n_inputs: int) -> pa.Schema:
    """Return the columns of trajectories: one row for each t from 0 to T, without an input at T."""
    kept = [field for field in CURVES if field.name not in STEP_COLUMNS]
    states = [pa.field(f"state_{i}", _REAL) for i in range(n_states)]
    inputs = [pa.field(f"input_{i}", _REAL) for i in range(n_inputs)]
    return pa.schema([*kept, *states, *inputs])
