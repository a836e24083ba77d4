"""Section of a report on control: success and cost with the models of each variant."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
import numpy.typing as npt
import pandas as pd

from analysis.data.curves import read_curves
from analysis.data.trial_selection import Selection
from analysis.formatting import but_lost, number, within
from analysis.line_styles import environment_title
from analysis.report.variant_table import SIGNIFICANCE
from analysis.report.variants import VariantGroup
from analysis.stats.control import TrueModel, measure_control
from analysis.stats.paired_tests import benjamini_hochberg, mcnemar
from analysis.tables.rendering import TextTable
from orchestrate.store import Assessments, Reader

NOTE = (
    "Success: share of trials whose planned episode reached its goal, with the Wilson interval; "
    f"with a star where the adjusted p is below {SIGNIFICANCE}: exact McNemar test against the "
    "first row, paired over seeds, the false discovery rate of all variants and numbers of steps "
    "of the report (Benjamini-Hochberg). Cost: geometric mean of the episode's cost by that of the "
    "true model under the same planner, noise and draws, with Student's interval. True "
    "model: what the "
    "same planner achieves that predicts with the true system, on the same seeds; no explored step "
    "changes it, and its cost is the unit. Lost: episodes in no mean of costs, as theirs or that "
    "of the true model is not finite; they are in the success. Loss: that on the grid after as "
    "many steps, geometric mean. Free run: root mean square error of predictions that run free, by "
    "that of the prediction that nothing changes, mean at the end of the trial without those lost "
    "as the error is not finite."
)
TRUTH = "true model"
SUCCESS, FREE_RUN = "control_success", "free_run_error"
ESTIMATES = ("success", "success_low", "success_high", "cost", "cost_low", "cost_high")

Array = npt.NDArray[np.float64]
Row = Mapping[str, object]


def tabulate(reader: Reader, groups: Sequence[VariantGroup]) -> pd.DataFrame | None:
    """Return one row for each environment, variant and number of steps, None without a task."""
    rows = [row for group in groups if group.assessed for row in _rows(reader, group)]
    if not rows:
        return None
    table = pd.DataFrame(rows)
    table["success_p_adjusted"] = benjamini_hochberg(table["success_p"].tolist())
    return table


def _rows(reader: Reader, group: VariantGroup) -> Iterator[dict[str, object]]:
    assessed = group.assessed
    curves = measure_control(reader, Selection(assessed))
    successes = [reader.assessments(one.config.config_key, SUCCESS) for one in assessed]
    reference = successes[0] if assessed[0] is group.reference else None
    for one, curve, own in zip(assessed, curves, successes, strict=True):
        losses = read_curves(reader, one, "loss").values
        free_runs = reader.assessments(one.config.config_key, FREE_RUN)
        for k, t in enumerate(curve.t.tolist()):
            yield {
                "env": group.env,
                "variant": one.label,
                "t": t,
                "n": int(curve.n[k]),
                **{name: float(getattr(curve, name)[k]) for name in ESTIMATES},
                "lost": int(curve.lost[k]),
                "success_p": _test(own, reference, t),
                "loss": _geometric_mean(losses[:, t - 1]) if t else math.nan,
                **_free_run(free_runs, t, int(curve.n[k])),
                "described": curve.described,
            }
    steps = sorted({int(t) for curve in curves for t in curve.t})
    yield from (_truth(group.env, curves[0].truth, t) for t in steps)


def _truth(env: str, truth: TrueModel, t: int) -> dict[str, object]:
    """Return a row of the true model: the same after any number of steps, its cost the unit."""
    return {
        "env": env,
        "variant": TRUTH,
        "t": t,
        "n": truth.n,
        "success": truth.success,
        "success_low": truth.success_low,
        "success_high": truth.success_high,
        "cost": 1.0 if truth.lost < truth.n else math.nan,
        "lost": truth.lost,
        "described": str(truth.n),
    }


def _test(own: Assessments, reference: Assessments | None, t: int) -> float:
    """Return p of the successes after t explored steps, over the seeds that reached them."""
    if reference is None or own is reference or t == 0:
        return math.nan
    ours, theirs = (_at(found, t) for found in (own, reference))
    seeds = sorted(set(ours) & set(theirs))
    return mcnemar(*(np.array([each[seed] for seed in seeds]) for each in (ours, theirs)))


def _at(found: Assessments, t: int) -> dict[int, float]:
    """Return the number of each seed that reached t steps."""
    rows, columns = np.nonzero(np.isfinite(found.values) & (found.t == t))
    return dict(zip(found.seeds[rows].tolist(), found.values[rows, columns].tolist(), strict=True))


def _geometric_mean(values: Array) -> float:
    known = values[np.isfinite(values) & (values > 0)]
    return float(np.exp(np.mean(np.log(known)))) if len(known) else math.nan


def _free_run(found: Assessments, t: int, reached: int) -> dict[str, object]:
    """Return the mean error after t steps, and of how many trials it is not finite."""
    errors = found.values[:, found.t == t]
    finite = errors[np.isfinite(errors)]
    mean = float(np.mean(finite)) if len(finite) else math.nan
    return {"free_run": mean, "free_run_lost": max(0, reached - len(finite))}


def section(table: pd.DataFrame) -> str:
    """Return the section in Markdown of a table of :func:`tabulate`."""
    parts = [_part(str(env), rows) for env, rows in table.groupby("env", sort=False)]
    return "\n\n".join(["## Control with the learned model", NOTE, *parts])


def _part(env: str, table: pd.DataFrame) -> str:
    rows: dict[str, dict[int, Row]] = {}
    for row in table.to_dict("records"):
        rows.setdefault(str(row["variant"]), {})[int(row["t"])] = {
            str(key): value for key, value in row.items()
        }
    steps = sorted({t for found in rows.values() for t in found})
    success = TextTable(
        ["variant", *(f"success after {t}" for t in steps), "n"],
        [
            [label, *(_entry_text(found, t, _success) for t in steps), _last(found)["described"]]
            for label, found in rows.items()
        ],
    )
    worth = TextTable(
        [
            "variant",
            *(f"cost after {t}" for t in steps),
            *(f"loss after {t}" for t in steps if t),
            "free run",
        ],
        [
            [
                label,
                *(_entry_text(found, t, _cost) for t in steps),
                *(
                    _entry_text(found, t, lambda row: number(_float(row, "loss")))
                    for t in steps
                    if t
                ),
                _entry_text(found, steps[-1], _free_run_text),
            ]
            for label, found in rows.items()
        ],
    )
    return f"### {environment_title(env)}\n\n{success.markdown()}\n\n{worth.markdown()}"


def _last(found: Mapping[int, Row]) -> Row:
    return found[max(found)]


def _entry_text(found: Mapping[int, Row], t: int, text: Callable[[Row], str]) -> str:
    """Return the text of a number of steps, a dash where there is none."""
    return text(found[t]) if t in found else "–"


def _success(row: Row) -> str:
    centre, low, high = (_float(row, f"success{end}") for end in ("", "_low", "_high"))
    star = "*" if _float(row, "success_p_adjusted") < SIGNIFICANCE else ""
    return number(math.nan) if math.isnan(low) else f"{centre:.2f}{star} [{low:.2f}, {high:.2f}]"


def _loss(row: Row) -> str:
    return number(_float(row, "loss"))


def _cost(row: Row) -> str:
    centre, low, high = (_float(row, f"cost{end}") for end in ("", "_low", "_high"))
    alone = "1" if row["variant"] == TRUTH and centre == 1 else number(centre)
    text = alone if math.isnan(low) else within(centre, low, high)
    return but_lost(text, int(_float(row, "lost")))


def _free_run_text(row: Row) -> str:
    if row["variant"] == TRUTH:
        return number(math.nan)
    return but_lost(number(_float(row, "free_run")), int(_float(row, "free_run_lost")))


def _float(row: Row, column: str) -> float:
    value = row[column]
    return float(value) if isinstance(value, int | float) else math.nan
