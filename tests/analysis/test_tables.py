"""Tables, control, lines in a phase plane and spectra as numbers."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from analysis.cli import main
from analysis.data.matching import Filter
from analysis.data.selection import select
from analysis.figures.phase_portraits import measure_spectra, spectrum_caption
from analysis.stats.curves import (
    Axis,
    PlotOptions,
    average_spectrum,
    measure_curves,
    periodogram,
    tabulate_curves,
    wrapped_line,
)
from analysis.stats.scores import relative_costs, scores_at, true_model
from analysis.style import number, p_text, percent_text, plus_minus
from analysis.tables.comparisons import compare_policies, summarise
from analysis.tables.rendering import comparison_table, summary_table
from analysis.tables.variants import VariantGroup, tabulate_control_of, variant_groups
from dopt.assessment import TURN, turns, wrap
from dopt.offline_fit import held_out_fit
from dopt.result import Assessment
from dopt.run import run_trial
from orchestrate.store import Assessments, Reader
from tests.analysis.conftest import SHORT
from tests.analysis.synthetic import (
    fake_result,
    fill,
    filled,
    make_grid,
    make_spec,
    simulated,
    valued,
)
from tests.dopt.trials import trial

SEEDS = range(5)
TASK = {"task": {"name": "control", "checkpoints": [20]}}


def final(env: str, policy: str, seed: int) -> float:
    spec = make_spec(env, policy, seed, env={"horizon": 60})
    return float(fake_result(spec).loss[-1])


def test_summary_follows_from_the_trials(reader: Reader) -> None:
    table = summarise(reader, select(reader, Filter()))
    row = table[(table.env == "pendulum") & (table.policy == "uniform")].iloc[0]
    losses = np.array([final("pendulum", "uniform", seed) for seed in SEEDS])
    assert row.loss == pytest.approx(losses.mean())
    assert row.loss_2se == pytest.approx(2 * losses.std(ddof=1) / math.sqrt(5))
    assert row.reachable_loss == pytest.approx(losses.mean() / 2)
    assert row.n == 5


def test_a_diverged_trial_is_left_out_and_counted(reader: Reader) -> None:
    selection = select(reader, Filter(("cartpole",), ("random",)))
    losses = [final("cartpole", "random", seed) for seed in SEEDS if seed != 2]
    left_out = summarise(reader, selection).iloc[0]
    assert (left_out.n, left_out.n_diverged) == (4, 1)
    assert left_out.loss == pytest.approx(np.mean(losses))


def test_comparison_pairs_the_seeds(reader: Reader) -> None:
    table = compare_policies(reader, select(reader, Filter()))
    row = table[(table.env == "cartpole") & (table.policy == "random")].iloc[0]
    seeds = [seed for seed in SEEDS if seed != 2]
    logs = [
        math.log(final("cartpole", "random", seed) / final("cartpole", "d_optimal", seed))
        for seed in seeds
    ]
    assert (row.n_pairs, row.n_diverged) == (4, 1)
    assert row.ratio == pytest.approx(math.exp(np.mean(logs)))
    assert row.low <= row.ratio <= row.high
    assert row.p_adjusted >= row.p_value
    assert len(table) == 4 + 4 + 3


def test_a_row_does_not_depend_on_the_others(reader: Reader) -> None:
    whole = compare_policies(reader, select(reader, Filter()))
    part = compare_policies(
        reader, select(reader, Filter(("cartpole",), ("d_optimal", "periodic")))
    )
    same = whole[(whole.env == "cartpole") & (whole.policy == "periodic")]
    columns = ["n_pairs", "ratio", "low", "high", "p_value"]
    assert same[columns].to_numpy().tolist() == part[columns].to_numpy().tolist()


def test_curves_are_means_on_the_exact_grid(reader: Reader) -> None:
    selection = select(reader, Filter(("pendulum",), ("random",)))
    table = tabulate_curves(measure_curves(reader, selection, "loss", PlotOptions()))
    losses = [
        fake_result(make_spec("pendulum", "random", seed, env={"horizon": 60})).loss
        for seed in SEEDS
    ]
    assert table["t"].tolist() == list(range(60))
    assert table["mean"].to_numpy() == pytest.approx(np.mean(losses, axis=0))
    timed = PlotOptions(axis=Axis.SECONDS)
    seconds = tabulate_curves(measure_curves(reader, selection, "loss", timed))
    dt = selection.entries[0].config.dt
    assert seconds["x"].to_numpy() == pytest.approx(dt * table["x"].to_numpy())


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (plus_minus(12.345, 0.567), "12.35 ± 0.57"),
        (plus_minus(1234.5, 56.7), "1234 ± 57"),
        (plus_minus(0.01234, 0.00056), "0.01234 ± 0.00056"),
        (plus_minus(4.021e-5, 6.2e-6), "(4.02 ± 0.62)e-05"),
        (plus_minus(2.0, math.nan), "2.00"),
        (plus_minus(math.nan, math.nan), "–"),
        (percent_text(0.1234, 0.00021, 100), "12.340 ± 0.042 %"),
        (percent_text(0.125, math.nan, 1), "12.5 %"),
        (percent_text(math.nan, math.nan, 0), ""),
        (number(0.5), "0.500"),
        (number(1234.0), "1230"),
        (number(0.0123456), "0.0123"),
        (number(0.9996), "1.00"),
        (number(999.6), "1000"),
        (number(1.5e-7), "1.50e-07"),
        (number(0.0), "0"),
        (p_text(0.0123), "0.012"),
        (p_text(3.21e-9), "3e-09"),
    ],
)
def test_numbers_as_words(words: str, text: str) -> None:
    assert words == text


def test_markdown_shows_counts_and_dashes() -> None:
    nothing = {"ratio": math.nan, "low": math.nan, "high": math.nan, "improvement": math.nan}
    row = {"env": "arm", "variant": "random", "reference": "D-optimal", "n_pairs": 0}
    row |= {"n_diverged": 3, **nothing}
    table = pd.DataFrame([row | {"p_value": math.nan, "p_adjusted": math.nan}])
    assert "Student's below 30 and above 2000 pairs" in comparison_table(table).note
    line = comparison_table(table).markdown().splitlines()[2]
    assert [field.strip() for field in line.strip("|").split("|")] == [
        "arm", "random", "D-optimal", "–", "–", "–", "–", "0, 3 diverged",
    ]  # fmt: skip
    values = {
        f"{name}{part}": value
        for name in ("loss", "reachable_loss")
        for part, value in (("", 1.0), ("_2se", 0.1), ("_median", 0.9), ("_iqm", 0.95))
    }
    counts = {"env": "arm", "policy": "random", "label": "random", "n": 98, "n_diverged": 2}
    summary = summary_table(pd.DataFrame([counts | values]))
    assert "1.00 ± 0.10" in summary.markdown()
    assert "Diverged trials are left out." in summary.markdown()
    assert summary.latex().startswith("% Loss: mean +- 2 standard errors over n trials;")


LEARNER = {"name": "gauss_newton"}
TAUGHT = [trial("pendulum", "d_optimal", seed, learner=LEARNER) for seed in range(3)]
UNSURE = [trial("pendulum", "random", seed, learner={"name": "adam_window"}) for seed in range(3)]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> str:
    address = f"sqlite:///{tmp_path_factory.mktemp('calibration')}/results.db"
    fill(address, TAUGHT + UNSURE, edit=simulated)
    return address


def test_rows_are_the_medians_of_the_trials(small: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibration", "--db", small, "--format", "csv"]) == 0
    table = pd.read_csv(io.StringIO(capsys.readouterr().out)).set_index("policy")
    results = [run_trial(spec) for spec in TAUGHT]
    fits = [
        held_out_fit(spec, one.parameters, one.states, one.inputs)
        for spec, one in zip(TAUGHT, results, strict=True)
    ]
    row = table.loc["d_optimal"]
    for name in ("r_squared", "covered", "log_loss"):
        for kind in ("grid", "reachable"):
            average = np.mean if name == "covered" else np.median
            expected = average([getattr(getattr(fit, kind), name) for fit in fits])
            assert row[f"{kind}_{name}"] == pytest.approx(expected, rel=1e-3)
    assert row.energy == pytest.approx(1.0)  # every input is on the sphere
    assert row.n == 3
    assert np.isnan(table.loc["random", "grid_covered"])


def test_a_model_without_a_covariance_has_a_dash(
    small: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibration", "--db", small, "--policy", "random"]) == 0
    (row,) = [line for line in capsys.readouterr().out.splitlines() if "pendulum" in line]
    cells = [cell.strip() for cell in row.split("|")[1:-1]]
    assert cells[4:8] == ["–"] * 4
    assert "–" not in cells[2:4] + cells[8:]


def test_a_database_without_a_finished_trial_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    address = f"sqlite:///{tmp_path}/none.db"
    fill(address, TAUGHT, skipped=TAUGHT)
    assert main(["calibration", "--db", address, "--allow-partial"]) == 2
    assert "No selected trial is done" in capsys.readouterr().err


def control_of(reader: Reader, group: VariantGroup) -> pd.DataFrame:
    """Return the rows of the table of control of an environment, by policy."""
    table = tabulate_control_of(reader, [group])
    assert table is not None
    names = {one.label: one.config.policy for one in group.variants}
    return table.assign(policy=table["variant"].map(names)).set_index("policy")


def test_the_numbers_follow_from_the_trials(reader: Reader, group: VariantGroup) -> None:
    curve = control_of(reader, group).loc["uniform"].set_index("t")
    (entry,) = (one for one in group.assessed if one.config.policy == "uniform")
    task = entry.config.config["task"]
    specs = make_grid(("pendulum",), ("uniform",), range(5), **SHORT, task=task)
    rows = [fake_result(spec).assessments for spec in specs]
    assert curve.index.tolist() == [0, 20, 40, 60]
    assert curve["n"].tolist() == [5] * 4
    for t, row in curve.iterrows():
        costs = [_value(of, t, "control_cost") / 100.0 for of in rows]
        assert row["cost"] == pytest.approx(np.exp(np.mean(np.log(costs))))
        assert row["cost_low"] < row["cost"] < row["cost_high"]
        assert row["success"] == np.mean([_value(of, t, "control_success") for of in rows])


@pytest.mark.parametrize(
    "measure",
    [
        lambda reader, group: control_of(reader, group)["cost"].to_numpy(),
        lambda reader, group: relative_costs(reader, group.reference).values,
        lambda reader, group: list(scores_at(reader, group.reference, 20).items()),
        lambda reader, group: list(true_model(reader, group.variants).values()),
    ],
)
def test_what_is_finished_during_a_read_is_not_in_a_part_of_it(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    measure: Callable[[Reader, VariantGroup], object],
) -> None:
    address = f"sqlite:///{tmp_path}/live.db"
    specs = make_grid(("pendulum",), ("d_optimal",), range(6), **SHORT, **TASK)
    other = make_grid(("pendulum",), ("random",), range(2), **SHORT)
    fill(address, [*specs, *other], skipped=specs[2:])
    read, left = Reader.assessments, [spec for spec in specs[2:] if spec.seed % 2]

    def assessments(self: Reader, config_key: str, measure: str) -> Assessments:
        found = read(self, config_key, measure)
        if left:
            fill(address, [left.pop()])
        return found

    with Reader.open(address) as reader:
        (group,) = variant_groups(reader, Filter())
        expected = measure(reader, group)
        fill(address, specs[2::2])  # between the selection and the read
        monkeypatch.setattr(Reader, "assessments", assessments)
        np.testing.assert_array_equal(measure(reader, group), expected)
    assert len(left) < 2


def _value(rows: tuple[Assessment, ...], t: int, measure: str) -> float:
    return next(row.value for row in rows if (row.t, row.measure) == (t, measure))


def test_wilson_intervals_equal_the_textbook(reader: Reader, group: VariantGroup) -> None:
    curve = control_of(reader, group).loc["d_optimal"]
    first, last = (curve.iloc[place] for place in (0, -1))
    assert (first["success"], last["success"]) == (0.0, 1.0)
    z = 1.959963985
    edge = z**2 / (5 + z**2)  # no success in five
    assert (first["success_low"], first["success_high"]) == pytest.approx((0, edge))
    assert (last["success_low"], last["success_high"]) == pytest.approx((1 - edge, 1))


def test_costs_without_a_true_model_to_divide_by_are_counted(tmp_path: Path) -> None:
    policies, seeds = ("d_optimal", "random"), tuple(range(5))
    specs = make_grid(("pendulum",), policies, seeds, **SHORT, **TASK)
    edit = valued(lambda _, row: np.inf if row.measure == "true_model_cost" else None)
    with filled(tmp_path, specs, edit=edit) as reader:
        (group,) = variant_groups(reader, Filter())
        curves = control_of(reader, group).loc[["d_optimal", "random"]]
    assert (curves["lost"] == 5).all()
    assert curves["cost"].isna().all()
    assert curves.loc["d_optimal", "success"].iloc[-1] == 1.0


@given(
    st.integers(2, 65).flatmap(
        lambda steps: arrays(float, (2, steps, 2), elements=st.floats(-10, 10, width=32))
    ),
    st.floats(0.001, 1.0),
)
def test_parseval(inputs: np.ndarray, dt: float) -> None:
    frequency, density = periodogram(inputs, dt)
    power = density.sum(axis=1) * (frequency[1] - frequency[0])
    assert power == pytest.approx((inputs**2).sum(axis=2).mean(axis=1), rel=1e-9, abs=1e-12)
    assert frequency[-1] <= 0.5 / dt * (1 + 1e-12)


def test_white_noise_is_flat_at_its_variance_over_the_nyquist_frequency() -> None:
    dt, variance = 0.02, 4.0
    noise = np.sqrt(variance) * np.random.default_rng(0).normal(size=(400, 200, 1))
    spectrum = average_spectrum(noise, dt)
    level = variance / (0.5 / dt)
    assert spectrum["mean"][1:-1] == pytest.approx(level, rel=0.25)
    # a periodogram ordinate is exponential: its quantiles are -log(0.9) and -log(0.1) of the mean
    assert spectrum["quantile_10"][1:-1].mean() == pytest.approx(-np.log(0.9) * level, rel=0.1)
    assert spectrum["quantile_90"][1:-1].mean() == pytest.approx(-np.log(0.1) * level, rel=0.1)


ANGLES = st.lists(st.floats(-30, 30), min_size=1, max_size=30)
CENTRES = st.sampled_from([0.0, math.pi, -1.0])


@given(ANGLES, CENTRES)
def test_wrapped_angles_are_the_same_angle_within_one_turn(
    angles: list[float], centre: float
) -> None:
    given_angles = np.array(angles)
    inside = wrap(given_angles, centre)
    assert np.all(np.abs(inside - centre) <= math.pi + 1e-9)
    assert np.cos(inside) == pytest.approx(np.cos(given_angles), abs=1e-9)
    assert np.sin(inside) == pytest.approx(np.sin(given_angles), abs=1e-9)


@given(st.lists(st.floats(-3.0, 3.0), min_size=2, max_size=40), CENTRES)
def test_a_line_is_never_drawn_across_the_panel(steps: list[float], centre: float) -> None:
    angle = np.cumsum(steps)
    line = wrapped_line(np.stack([angle, np.arange(len(angle))], axis=1), 0, centre)
    jumps = np.abs(np.diff(line[:, 0]))
    drawn = jumps[np.isfinite(jumps)]
    assert np.all(drawn <= np.max(np.abs(np.diff(angle))) + 1e-9)
    finite = line[np.isfinite(line[:, 0])]
    assert np.all(np.abs(finite[:, 0] - centre) <= math.pi + 1e-9)
    breaks = np.isnan(line[:, 0]).sum()
    assert breaks == np.count_nonzero(np.diff(turns(angle, centre)))


NAN = math.nan


@pytest.mark.parametrize(
    ("points", "axis", "drawn"),
    [
        (  # both edges are reached at the interpolated height
            [[math.pi - 1, 0], [math.pi + 3, 4]],
            0,
            [[math.pi - 1, 0], [math.pi, 1], [NAN, NAN], [-math.pi, 1], [3 - math.pi, 4]],
        ),
        (
            [[1 - math.pi, 0], [-math.pi - 1, 2]],
            0,
            [[1 - math.pi, 0], [-math.pi, 1], [NAN, NAN], [math.pi, 1], [math.pi - 1, 2]],
        ),
        (
            [[0, 0], [1, 4]],
            1,
            [[0, 0], [math.pi / 4, math.pi], [NAN, NAN], [math.pi / 4, -math.pi], [1, 4 - TURN]],
        ),
        ([[0, 0], [3 * TURN, 1]], 0, [[0, 0], [NAN, NAN], [0, 1]]),  # more than a turn in a step
        ([[3, 1], [-3, 2], [0, 3]], 0, [[3, 1], [-3, 2], [0, 3]]),
    ],
)
def test_a_line_breaks_at_the_edges_by_hand(
    points: list[list[float]], axis: int, drawn: list[list[float]]
) -> None:
    line = wrapped_line(np.array(points, float), axis)
    assert line == pytest.approx(np.array(drawn), nan_ok=True)


def test_frequencies_inputs_and_counts(reader: Reader) -> None:
    spectra = measure_spectra(reader, select(reader, Filter()), "cartpole")
    assert spectra.by_policy["random"][["n", "n_diverged"]].iloc[0].tolist() == [4, 1]
    assert spectra.unit == "N"
    # cart and pole about hanging: below this, the pole alone on a fixed cart swings slower
    assert spectra.eigenfrequency is not None
    assert spectra.eigenfrequency > math.sqrt(10) / (2 * math.pi)
    rows = spectra.by_policy["d_optimal"]  # bang-bang: its power is the bound squared
    assert rows["mean"].sum() * rows.frequency_hz.iloc[1] == pytest.approx(spectra.gamma**2)
    assert np.all(rows["quantile_10"] <= rows["quantile_90"])


def test_a_policy_of_which_every_trial_diverged_is_named(tmp_path: Path) -> None:
    specs = make_grid(("cartpole",), ("d_optimal", "random"), range(3), **SHORT)
    lost = {spec.trial_key: 9 for spec in specs if spec.policy.name == "random"}
    with filled(tmp_path, specs, diverged=lost) as reader:
        spectra = measure_spectra(reader, select(reader, Filter()), "cartpole")
    assert set(spectra.table["policy"]) == {"d_optimal"}
    assert spectra.diverged == ("random",)
    assert "Not drawn, because every trial diverged: random." in spectrum_caption(spectra)
