"""Functions and structures of the kernel for compiled policies and learners in other files.

They keep their names and signatures; the modules that define them may change.
"""

from __future__ import annotations

from dopt.kernel.integration import input_columns, learned_columns, predicted_state
from dopt.kernel.learners import adam_step, sampled_point, store_sample
from dopt.kernel.linear_algebra import quadratic_forms
from dopt.kernel.model import model_point, model_rows
from dopt.kernel.structs import Trial

__all__ = [
    "Trial",
    "adam_step",
    "input_columns",
    "learned_columns",
    "model_point",
    "model_rows",
    "predicted_state",
    "quadratic_forms",
    "sampled_point",
    "store_sample",
]
