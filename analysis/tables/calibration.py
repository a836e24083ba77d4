"""Table of the fit at held-out states, of the intervals' calibration, and of the inputs' energy."""

from __future__ import annotations

import numpy as np
import pandas as pd

from analysis.data.learned_model import learned_model
from analysis.data.trial_selection import Entry, Selection
from analysis.errors import AnalysisError
from analysis.formatting import number, share
from analysis.tables.registry import TableKind
from analysis.tables.rendering import TextTable
from dopt.calibration import HeldOutFit, held_out_fit
from dopt.types import Array
from orchestrate.store import Reader

HELP = "fit at held-out states, coverage of their intervals, energy of the inputs"

SETS = ("grid", "reachable")


def measure(reader: Reader, selection: Selection) -> pd.DataFrame:
    """Return medians over the trials that are done, one row for each environment and variant.

    Of each measure of :class:`dopt.calibration.HeldOutFit` on the grid and on the reachable set,
    and of the mean of ‖u‖²/γ² over the steps, ``energy``. Of the share covered it is the mean: that
    of all states of all trials.

    Raises
    ------
    AnalysisError
        If no selected trial is done.
    """
    entries = [one for one in selection.simulated().entries if one.final_losses()]
    if not entries:
        raise AnalysisError(
            "No selected trial is done, but the fit of a learned model needs some: run the grid, "
            "or ask for more."
        )
    return pd.DataFrame([_row(reader, entry) for entry in entries])


def _row(reader: Reader, entry: Entry) -> dict[str, object]:
    trials = pd.DataFrame([_trial(reader, entry, seed) for seed in entry.final_losses()])
    shares = {f"{kind}_covered": trials[f"{kind}_covered"].mean() for kind in SETS}
    names = {"env": entry.config.env, "policy": entry.config.policy, "label": entry.label}
    return {**names, **trials.median(), **shares, "n": len(trials)}


def _trial(reader: Reader, entry: Entry, seed: int) -> dict[str, float]:
    learned = learned_model(reader, entry.config, seed)
    stored = reader.trajectory(entry.config.config_key, seed)
    fits = held_out_fit(learned.spec, learned.parameters, stored.states, stored.inputs)
    row = {
        f"{kind}_{name}": float(getattr(fit, name))
        for kind, fit in zip(SETS, fits, strict=True)
        for name in HeldOutFit._fields
    }
    return row | {"energy": _energy(stored.inputs, learned.spec.system.gamma)}


def _energy(inputs: Array, gamma: float) -> float:
    return float(np.mean(np.sum(inputs**2, axis=1)) / gamma**2)


def render(table: pd.DataFrame) -> TextTable:
    """Return the table for people."""
    written = {"r_squared": number, "covered": share, "log_loss": number}
    rows = [
        [row["env"], row["label"]]
        + [text(row[f"{kind}_{name}"]) for name, text in written.items() for kind in SETS]
        + [number(row["energy"]), row["n"]]
        for row in table.to_dict("records")
    ]
    titles = ("R²", "within 90 %", "log loss")
    headers = [f"{title}, {kind}" for title in titles for kind in SETS]
    note = (
        "Accelerations on the evaluation grid and the reachable set, medians over n trials. Within "
        "90 %: share of all within their interval of 90 %; log loss: mean negative log likelihood "
        "[nat]; a dash where the model has no covariance. Energy: mean of ‖u‖²/γ²."
    )
    return TextTable(["env", "variant", *headers, "energy", "n"], rows, note)


KIND = TableKind(
    "Fit at held-out states",
    lambda selection, _=None: selection,
    lambda reader, selection, _: measure(reader, selection),
    lambda table, _: render(table),
)
