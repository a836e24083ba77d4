"""Rows about the paper's sentences, the tables that follow from them, and what the page says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dopt.kernel.run import KernelTrial
from dopt.randomness import draw
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from dopt.systems.properties import eigenmode
from studies.conclusions import filter as joint_filter
from studies.conclusions import network, tables, trials
from studies.conclusions.__main__ import PARTS, complete, main
from studies.conclusions.trials import Cell, Row
from tests.dopt.oracles.test_oracles import filtered
from tests.dopt.trials import trial

KEYS = tables.KEYS


def losses(*cell: str) -> pd.Series[float]:
    return tables.losses(tables.read(), *cell)


def geometric(values: pd.Series[float]) -> float:
    return float(np.exp(np.log(values).mean()))


def test_the_headlines_have_a_hundred_seeds_that_nothing_was_tuned_on() -> None:
    for env in trials.BEST:
        found = losses(env, "ideal", "best", "evidence")
        assert sorted(found.index) == list(range(200, 300))
    for learner in ("adam_window", "evidence"):
        for env in trials.SYSTEMS:
            assert len(losses(env, "ideal", "d_optimal", learner)) == 100


def test_the_sentences_of_the_page() -> None:
    oracle = losses("pendulum", "ideal", "oracle", "least_squares")
    best = losses("pendulum", "ideal", "best", "evidence")
    assert 3.0 < geometric(best / oracle) < 4.0
    assert (best < oracle).sum() <= 5
    arm = [losses("arm", "ideal", one, "evidence") for one in ("uniform", "d_optimal")]
    assert geometric(arm[0] / arm[1]) < 0.8
    rows = tables.read()
    share = tables.losses(rows, "cartpole", "ideal", "d_optimal", "adam_window", column="resonant")
    assert share.mean() == pytest.approx(0.14, abs=0.005)
    for learner, known in (("adam_window", 2), ("gauss_newton", 3), ("evidence", 3)):
        spaced = 0
        for env in trials.SYSTEMS:
            gaps = [
                tables.losses(rows, env, "ideal", policy, learner, column="gap").mean()
                for policy in tables.INPUTS
            ]
            spaced += gaps[0] == np.nanmin(gaps)
        assert spaced == known
    for policy in tables.RIVALS:
        assert geometric(losses("pendulum", "encoder", policy, "evidence")) < geometric(
            losses("pendulum", "encoder", "d_optimal", "evidence")
        )


@pytest.mark.parametrize("plant", ["ideal", *trials.PLANTS])
def test_every_cell_is_a_trial(plant: str) -> None:
    cells = [one for group in trials.cells() for one in group if one.plant == plant]
    assert cells
    for cell in cells:
        assert isinstance(cell.spec(0), TrialSpec)


def test_the_extent_of_states() -> None:
    system = SYSTEMS["pendulum"]()
    half = np.array(system.grid_half_widths)
    rng = np.random.default_rng(0)
    dense = rng.uniform(-1, 1, (20_000, 2)) * half
    width, gap = trials._extent(system, dense)
    assert width == pytest.approx(3**-0.5, rel=0.02)
    assert gap < 0.02
    _, far = trials._extent(system, np.zeros((5, 2)))
    assert far == pytest.approx(0.765, rel=0.02)  # mean distance from the centre of a square


def test_the_power_near_the_eigenfrequency() -> None:
    system = SYSTEMS["pendulum"]()
    time = system.dt * np.arange(500)[:, None]
    mode = eigenmode(system)
    assert mode is not None
    assert trials._resonant(system, np.sin(mode.frequency * time)) > 0.9
    assert trials._resonant(system, np.sin(3.0 * mode.frequency * time)) < 0.05


def test_missing_trials_are_run_and_appended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = Cell("pendulum", "ideal", "random", "adam_window")
    part = PARTS["sentences"]._replace(seeds=(0, 2), cells=lambda: [[cell]])
    path = tmp_path / "rows.csv"
    complete(path, part)
    first = pd.read_csv(path)
    assert list(first.columns) == [*KEYS, "seed", *Row._fields]
    assert first.seed.tolist() == [0, 1]
    assert np.isfinite(first[list(Row._fields)]).all(axis=None)
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:2]))
    complete(path, part)
    differing = ["step_ms", "worst_ms"]
    assert pd.read_csv(path).drop(columns=differing).equals(first.drop(columns=differing))
    main(["--rows", str(path)])
    assert "| inputs, learner |" in capsys.readouterr().out


def test_the_jacobian_of_the_network_is_its_derivative() -> None:
    rng, form = np.random.default_rng(0), network.Form(3, 2, by_feature=True)
    phi = network.products(rng.standard_normal((5, 2)), form.degree)
    one = network.Network(phi.shape[1], 2, form)
    theta = one.initial(rng)
    found, change = one.jacobian(theta, phi), 1e-6
    for j, unit in enumerate(np.eye(len(theta))):
        above, below = (one.predict(theta + sign * change * unit, phi) for sign in (1, -1))
        assert found[:, j] == pytest.approx((above - below).ravel() / (2 * change), abs=1e-8)


def test_the_network_finds_which_features_matter() -> None:
    rng, form = np.random.default_rng(1), network.Form(4, 1, by_feature=True)
    phi = rng.uniform(-2, 2, (200, 3))
    truth = np.sin(1.5 * phi[:, :1]) + 0.5 * phi[:, 1:2]  # the third is not in it
    one = network.Network(3, 1, form)
    targets = truth + 0.02 * rng.standard_normal(truth.shape)
    theta = max((one.fit(phi, targets, 4e-4, rng) for _ in range(3)), key=lambda fit: fit[1])[0]
    assert np.sqrt(np.mean((one.predict(theta, phi) - truth) ** 2)) < 0.02
    moved = phi + np.array([0.0, 0.0, 1.0])
    assert one.predict(theta, moved) == pytest.approx(one.predict(theta, phi), abs=0.05)


def test_the_products_of_features() -> None:
    found = network.products(np.array([[2.0, 3.0]]), 3)
    assert found.tolist() == [[2, 3, 4, 6, 9, 8, 12, 18, 27]]


def test_the_intervals_are_of_the_filter_over_both_at_once() -> None:
    env = {"horizon": 15, "measured_states": [0, 2], "measurement_noise": [1e-2, 2e-2]}
    learner = {"name": "joint_ekf", "refit_every": 1000}
    spec = trial("arm", "random", 4, env=env, model={"width": 3, "depth": 1}, learner=learner)
    run = KernelTrial(spec)
    run.advance(15)
    outputs = run.record.true_states[1:] @ spec.system.output_rows.T + draw(spec).measurement_noise
    states, _, variances = filtered(spec, outputs, run.record.inputs)
    d = spec.system.n_states
    inverse = joint_filter.inverse_information(run)
    assert np.diag(inverse) == pytest.approx(variances[d:], rel=1e-5)
    weighted, within, _ = joint_filter._intervals(run, 15)
    error = run.record.true_states[15] - states[15]
    assert within == np.mean(np.abs(error) <= 1.645 * np.sqrt(variances[:d]))
    assert weighted > np.max(error**2 / variances[:d]) / d * (1 - 1e-6)  # of all at once


def test_the_sentences_about_the_filter() -> None:
    rows = pd.read_csv(tables.FILTER).set_index(["env", "policy", "regularization", "steps"])
    for _, part in rows.groupby("env"):
        short, long, wide = (part.xs(key, level=(2, 3)) for key in ((3.0, 4), (3.0, 12), (0.3, 12)))
        assert short.fitted.mean() > 1.5 * long.fitted.mean()
        assert long.early.mean() > 2.0 * wide.early.mean()
        assert wide.early.mean() < 1.2
        assert wide.early_states.mean() > 0.85


def test_the_network_reads_as_much_as_the_process() -> None:
    rows = pd.read_csv(tables.NETWORK)
    best = rows[rows.form == "products, each with a prior"]
    assert set(best.env) == set(trials.SYSTEMS)
    assert (best.loss / best.process).max() < 3.0
