"""Recorded runs of real plants: their files, simulations and tables, and the choice of segments."""

from __future__ import annotations

import dataclasses
import gzip
import hashlib
import io
import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

import dopt
from dopt.errors import SpecificationError
from dopt.fitting.model import Model
from dopt.fitting.simulation import Data
from studies.real import choice, data, plants, results
from studies.real.__main__ import CASES, QUESTIONS, main, parts
from studies.real.protocol import Fold, closed_loop, folds
from tests.paths import ROOT, served

DATA = os.environ.get("DOPT_DATA")
recorded = pytest.mark.skipif(DATA is None, reason="DOPT_DATA names no folder of recorded runs")


@pytest.fixture
def host(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Serve ``tmp_path/host``, with a cache of downloads beside it."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "host").mkdir()
    with served(tmp_path / "host") as address:
        yield address


def serve(folder: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> data.Source:
    """Put an original where the repository would have it; return a source with one run."""
    source = data.SOURCES["double pendulum"]
    path, _ = source.runs["double_pendulum_00"]
    digest = hashlib.sha256(text.encode()).hexdigest()
    source = dataclasses.replace(source, runs={"double_pendulum_00": (path, digest)})
    monkeypatch.setitem(data.SOURCES, "double pendulum", source)
    place = folder / "host" / source.repository / source.commit / path
    place.parent.mkdir(parents=True)
    place.write_text(text)
    return source


def as_original(table: pd.DataFrame) -> str:
    """Return a run in the form of the originals: more columns, 18 digits, spaces in the head."""
    table = table.assign(pos_des1=0.0)
    head = ", ".join(table.columns)
    lines = [",".join(f"{value:.18e}" for value in row) for row in table.to_numpy(float)]
    return "\n".join([head, *lines]) + "\n"


ROWS = pd.DataFrame(
    {
        name: np.random.default_rng(i).standard_normal(5) * 10.0 ** (i - 4)
        for i, name in enumerate(data.SOURCES["double pendulum"].columns)
    }
)


def test_an_original_is_downloaded_checked_and_converted(
    host: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = serve(tmp_path, monkeypatch, as_original(ROWS))
    found = data.tables("double pendulum", None, host=host)["double_pendulum_00"]
    text = data.converted(data.original(source, "double_pendulum_00", host), source)
    assert text == ROWS.to_csv(index=False, float_format="%.9g", lineterminator="\n")
    pd.testing.assert_frame_equal(found, pd.read_csv(io.StringIO(text)))


@recorded
def test_a_run_is_converted_to_the_text_of_the_folder(
    host: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert DATA
    stored = Path(DATA) / "double_pendulum_00.csv.gz"
    source = serve(tmp_path, monkeypatch, as_original(data.read(stored)))
    found = data.converted(data.original(source, "double_pendulum_00", host), source)
    assert found == gzip.decompress(stored.read_bytes()).decode()


def test_a_file_of_another_sum_is_refused(
    host: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = serve(tmp_path, monkeypatch, as_original(ROWS))
    path, _ = source.runs["double_pendulum_00"]
    wrong = dataclasses.replace(source, runs={"double_pendulum_00": (path, "0" * 64)})
    with pytest.raises(SpecificationError, match="a file of the SHA-256 000000000000… is expected"):
        data.original(wrong, "double_pendulum_00", host)


def test_a_run_that_nobody_serves_is_named(host: str) -> None:
    with pytest.raises(SpecificationError, match=r"(?s)trajectory_00.*try again, or give a folder"):
        data.tables("double pendulum", None, host=host)


def test_a_folder_without_the_runs_is_named(tmp_path: Path) -> None:
    with pytest.raises(SpecificationError, match=r"disk_train\.csv\.gz' is no file"):
        data.tables("disk", tmp_path)


def test_a_run_to_predict_needs_one_plant(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--test", "some.csv"]) == 2
    assert "one plant is expected with it" in capsys.readouterr().err


def derivative(plant: plants.Plant, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    model = Model(plant)
    return model.derivative(model.prior, x, u)


def test_model_2_is_what_its_authors_publish() -> None:
    """Their mass matrix, Coriolis matrix, gravity and friction, with their constants."""
    rng = np.random.default_rng(0)
    x, tau = rng.standard_normal((50, 4)) * [2, 2, 4, 4], rng.standard_normal((50, 2))
    I1, I2, Ir, gear = 0.053470810264216295, 0.02392374528789766, 7.659297952841183e-05, 6.0
    m1, m2, l1, r1, r2, g = (
        0.5593806151425046,
        0.6043459469186889,
        0.3,
        0.3,
        0.18377686083653508,
        9.81,
    )
    found = derivative(plants.MODEL_2_PLANT, x, tau)
    for (q1, q2, v1, v2), torque, rates in zip(x, tau, found, strict=True):
        h = m2 * l1 * r2
        m12 = I2 + h * np.cos(q2) - gear * Ir
        m11 = I1 + I2 + m2 * l1**2 + 2 * h * np.cos(q2) + gear**2 * Ir + Ir
        M = np.array([[m11, m12], [m12, I2 + gear**2 * Ir]])
        C = h * np.sin(q2) * np.array([[-2 * v2, -v2], [v1, 0.0]])
        far = m2 * r2 * np.sin(q1 + q2)
        gravity = -g * np.array([(m1 * r1 + m2 * l1) * np.sin(q1) + far, far])
        v = np.array([v1, v2])
        friction = 0.001 * v + np.array([0.093, 0.078]) * np.arctan(100 * v)
        expected = np.linalg.solve(M, gravity + torque - C @ v - friction)
        assert rates == pytest.approx([v1, v2, *expected], abs=0.05)
        exact = np.linalg.solve(M, gravity + torque - C @ v)
        assert np.abs(rates[2:] - expected).max() < 0.02 * np.abs(exact - expected).max()


def test_the_rotary_pendulum_keeps_its_energy_without_friction() -> None:
    free = {name: plants.QUANSER[name] for name in ("gain", "b", "c", "g")}
    plant = plants.published(plants.QUBE, free)
    x = np.random.default_rng(1).standard_normal((20, 4)) * [1, 2, 5, 5]

    def energy(x: np.ndarray) -> np.ndarray:
        _, angle, v, w = x.T
        arm = 0.5 * (1 + free["b"] * np.sin(angle) ** 2) * v**2
        pendulum = 0.5 * free["b"] * w**2 + free["c"] * np.cos(angle) * v * w
        return arm + pendulum + free["g"] * np.cos(angle)

    flow, h = derivative(plant, x, np.zeros((20, 1))), 1e-5
    change = (energy(x + h * flow) - energy(x - h * flow)) / (2 * h)
    assert np.abs(change).max() < 1e-6 * np.abs(flow).max() ** 2


@pytest.mark.parametrize("right", [True, False])
def test_a_closed_loop_of_the_plant_itself_has_no_errors(right: bool) -> None:
    """Against an independent integrator, with a test signal."""
    case = CASES["qube"]
    assert case.reference is not None
    plant = dataclasses.replace(case.reference, constants=case.reference.constants | {"c1": 2.0})
    system, gains = plant.system(1), plants.BALANCER
    x, rates, last = np.array([0.02, 0.005, 0.0, 0.0]), np.zeros(2), np.zeros(2)
    angles, inputs = [], []
    for t in range(5000):
        rates, last = (rates + 50.0 * (x[:2] - last)) / 1.1, x[:2]
        asked = gains.proportional @ x[:2] + gains.derivative @ rates
        u = np.clip([asked + 0.1 * np.sin(0.01 * t)], -10.0, 10.0)
        angles.append(x[:2])
        inputs.append(u)
        flow = partial(lambda _, z, u: system.known(tuple(z), tuple(u), system.parameters), u=u)
        x = solve_ivp(flow, (0.0, 0.002), x, rtol=1e-10, atol=1e-12).y[:, -1]
    rows = np.zeros(len(angles), np.int64)
    time = 0.002 * np.arange(len(angles))
    data = Data(time, np.array(angles), np.array(inputs), rows, rows, np.ones(2))
    errors = closed_loop(plant if right else case.reference, gains, data)
    assert np.abs(inputs).max() < 10.0  # beyond it the test signal is not known
    assert ((errors < 1e-4) == right).all()


def test_a_ratio_has_the_interval_of_its_runs() -> None:
    rng = np.random.default_rng(2)
    theirs = [rng.standard_normal((60, 2, 2)) for _ in range(5)]
    found = [Fold(str(i), 0.5 * e, e, np.arange(60) // 6, "") for i, e in enumerate(theirs)]
    row = results.rows([q for q in QUESTIONS if q.plant == "qube"], {"qube": found}).iloc[0]
    assert row[["ratio", "ratio_low", "ratio_high"]].to_list() == pytest.approx([0.5] * 3)
    assert row.error_low < row.error < row.error_high
    assert (row.bound, row.kept) == ("ratio ≤ 0.45", "no")


@recorded
def test_pendulums_that_were_left_out_are_predicted_within_the_bounds() -> None:
    assert DATA
    found = folds(CASES["pendulum"], parts("pendulum", Path(DATA)), None, 2, lambda _: None)
    table = results.rows(QUESTIONS, {"pendulum": found})
    assert len(table) == 2
    assert (table.kept == "yes").all(), table.ratio


@recorded
def test_a_short_run_of_the_disk_predicts_what_follows() -> None:
    """Six constants fitted to 4,000 samples: their error in a free run is below .06 rad."""
    assert DATA
    runs = data.tables("disk", Path(DATA))["disk_train"]
    case = dataclasses.replace(CASES["disk"], options={"width": 0, "window": 1.0})
    given = {str(i): runs[i : i + 2000].reset_index(drop=True) for i in (0, 2000)}
    test = runs[4000:6000].reset_index(drop=True)
    (found,) = folds(case, given, test, 2, lambda _: None)
    assert len(found.ours) == 2000 - 51
    assert np.sqrt(np.mean(found.ours**2)) < 0.06


def test_the_page_has_the_table_of_the_stored_segments() -> None:
    rows = pd.read_csv(choice.STORED)
    assert rows.groupby("parameters").seed.nunique().to_dict() == {6: 20, 47: 20}
    page = (ROOT / "studies/real/README.md").read_text()
    assert choice.table(rows).markdown().strip() in page


def test_the_first_segment_at_which_an_error_is_reached_counts() -> None:
    assert choice.reached(np.array([0.3, 0.1, 0.2, 0.05]), 0.1) == 2
    assert choice.reached(np.array([0.3, np.inf]), 0.1) == 3, "never: one more than all"


def test_a_ratio_is_paired() -> None:
    """Seeds of other difficulty: each halves the number, whatever it is."""
    rows = [
        {"seed": s, "parameters": 6, "segments": n, "all": 1.0}
        | {by: 1.0 if n >= at else 2.0 for by, at in (("chosen", 3 * s), ("random", 6 * s))}
        for s in (1, 2, 4)
        for n in range(1, 31)
    ]
    line = choice.table(pd.DataFrame(rows)).rows[0]
    assert line[2:] == ["6", "12", "0.500 [0.500, 0.500]", "3, 0, 0"]


@recorded
def test_a_short_choice_of_segments_begins_as_the_random_one_and_gets_better() -> None:
    assert DATA
    blocks = parts("disk", Path(DATA)).values()
    logs = [dopt.Log.for_plant(part, choice.PLANT, CASES["disk"].columns) for part in blocks]
    found = choice.curves(logs, 1, 0, pool=12, most=5)
    assert found.segments.to_list() == [1, 2, 3, 4, 5]
    assert (found.parameters == 6).all()
    first, last = found.iloc[0], found.iloc[-1]
    assert first.chosen == first.random
    assert last.chosen < 0.06
    assert last["all"] < 0.06
