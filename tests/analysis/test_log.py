"""Recorded runs from files, and the report of their health: of made-up truth and of real plants."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest
from scipy.io import savemat
from scipy.signal import lfilter

import analysis
from analysis import cli
from analysis.data.matching import AnalysisError
from analysis.log_health import (
    EXACT,
    MOST_ROWS,
    Effect,
    Health,
    effects,
    examine,
    quantum,
    unexplained_changes,
)
from analysis.log_report import lines, log_of, read_table
from dopt.errors import SpecificationError
from dopt.log import Log

DATA = os.environ.get("DOPT_DATA", "")
DT = 0.01
SEEDS = range(4)
Array = npt.NDArray[Any]

real = pytest.mark.skipif(not DATA, reason="DOPT_DATA is not set: no recorded runs of real plants")


# Made-up plants


def held(rng: np.random.Generator, n: int) -> Array:
    return np.repeat(rng.uniform(-3, 3, n // 10), 10)


def smooth(rng: np.random.Generator, n: int) -> Array:
    found = np.convolve(rng.normal(size=n + 200), np.exp(-np.arange(201) / 20.0), "valid")
    return found / found.std()


def motor(
    u: Array, *, delay: int = 0, force: Array | None = None, step: float = 0.003, rate: bool = False
) -> Array:
    """Return the measured angle, or rate, of θ'' = 40 u - 5 θ' - 8 sin θ + force."""
    angle, speed, found = 0.0, 0.0, []
    for k in range(len(u)):
        found.append(speed if rate else angle)
        a = 40 * u[max(k - delay, 0)] - 5 * speed - 8 * np.sin(angle)
        a += 0.0 if force is None else force[k]
        angle, speed = angle + DT * speed + 0.5 * DT**2 * a, speed + DT * a
    return np.round(np.array(found) / step) * step


def one_effect(y: Array, u: Array, name: str = "th") -> Effect:
    [found] = effects(Log({name: y, "u": u}, states=[name], inputs=["u"], dt=DT))
    return found


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_delay_is_found_in_open_loop(seed: int, delay: int) -> None:
    rng = np.random.default_rng(seed)
    for u in (held(rng, 2000), smooth(rng, 2000), rng.normal(size=2000)):
        effect = one_effect(motor(u, delay=delay), u)
        assert effect.delays == (delay, delay)
        assert not effect.closed_loop
        assert effect.has_effect
    effect = one_effect(motor(u, delay=delay, rate=True, step=0.01), u, "rate")
    assert effect.delays == (delay, delay)
    u, ramps = held(rng, 2000), np.cumsum(held(rng, 2000)) / 100
    seen = u + 0.01 * rng.normal(size=2000)
    times = rng.uniform(0.05, 10, (10, 1)) * np.arange(2000) * DT
    tones = np.sin(2 * np.pi * times + rng.uniform(0, 6, (10, 1))).sum(axis=0)
    for given, logged in ((u, seen), (ramps, ramps), (tones, tones)):
        assert not one_effect(motor(given, delay=delay), logged).closed_loop


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("delay", [0, 1, 6])
def test_a_delay_is_found_where_the_input_drives_the_state_itself(seed: int, delay: int) -> None:
    """As of a temperature or a level, of which no rate is measured."""
    rng = np.random.default_rng(seed)
    u, level, found = np.repeat(rng.uniform(0, 5, 100), 20), 20.0, []
    for k in range(len(u)):
        found.append(level)
        level += DT * (20.0 - level + 10 * u[max(k - delay, 0)])
    noisy = np.round(np.array(found) + 0.005 * rng.normal(size=len(u)), 2)
    assert one_effect(noisy, u, "level").delays == (delay, delay)


def test_a_shaft_that_turns_on_does_not_rest() -> None:
    turned = motor(np.ones(2000)) + 8.0 * np.arange(2000) * DT
    rests = examine(Log({"th": turned, "u": turned}, states=["th"], inputs=["u"], dt=DT)).resting
    assert not rests.any()


def test_what_turns_slowly_does_not_rest() -> None:
    """A twentieth of the fastest speed was taken for rest."""
    speed = np.repeat([8.0, 0.3], 1000)
    turned = np.round(np.cumsum(speed) * DT / 1e-3) * 1e-3
    log = Log({"th": turned, "u": speed}, states=["th"], inputs=["u"], dt=DT)
    assert not examine(log).resting.any()


@pytest.mark.parametrize("seed", range(10))
def test_an_input_without_effect_is_said_to_explain_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for u in (held(rng, 2000), smooth(rng, 2000)):
        moved = motor(0 * u, force=100 * smooth(rng, 2000))
        effect = one_effect(moved, u)
        assert effect.explains_nothing
        assert effect.delays is None
        assert not one_effect(motor(u), u).explains_nothing


@pytest.mark.parametrize("seed", SEEDS)
def test_an_arm_that_is_moved_by_hand_is_said_to_explain_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle = motor(np.zeros(3000), force=300 * smooth(rng, 3000))
    u = np.round(2.0 * np.sin(angle) / 0.01) * 0.01
    effect = one_effect(angle, u)
    assert effect.follows_state
    assert effect.explains_nothing
    assert effect.closed_loop


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("jumps", "step"), [(False, 0.003), (True, 0.003), (True, 1e-4)])
def test_feedback_is_found_although_a_signal_or_a_set_point_is_added(
    seed: int, jumps: bool, step: float
) -> None:
    """The jumps of a set point were all that was left to tell, and called open loop."""
    rng = np.random.default_rng(seed)
    signal = np.repeat(rng.uniform(-3, 3, 10), 300) if jumps else 0.3 * smooth(rng, 3000)
    angle, speed, seen, u = 0.0, 0.0, [0.0], []
    for k in range(3000):
        seen.append(round(angle / step) * step)
        u.append(-2 * seen[-1] - 5 * (seen[-1] - seen[-2]) + signal[k])
        a = 40 * u[-1] - 5 * speed + 8 * np.sin(angle)
        angle, speed = angle + DT * speed + 0.5 * DT**2 * a, speed + DT * a
    effect = one_effect(np.array(seen[1:]), np.array(u))
    assert effect.closed_loop
    assert not effect.explains_nothing


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("gain", [0.0, 1.0])
def test_feedback_is_found_of_an_input_that_stays_at_its_limits(seed: int, gain: float) -> None:
    """The rows at the limits, which the past tells, hid the speed that is fed back in between."""
    rng = np.random.default_rng(seed)
    signal = np.repeat(rng.uniform(-3, 3, 100), 40)
    angle, speed, seen, u = 0.0, 0.0, [], []
    for wanted in signal:
        seen.append(round(angle / 1e-3) * 1e-3)
        u.append(float(np.clip(wanted - 0.03 * gain * speed, -1.0, 1.0)))
        speed += DT * (40 * u[-1] - speed)
        angle += DT * speed
    assert np.mean(np.diff(u) == 0) > 0.3
    assert one_effect(np.array(seen), np.array(u)).closed_loop == bool(gain)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_smooth_input_of_a_controller_is_not_called_open_loop(seed: int) -> None:
    """Its past tells all of it but the last digit: a cylinder with a fine scale."""
    rng = np.random.default_rng(seed)
    place, speed, seen, u = 0.1, 0.0, [], []
    for wanted in np.repeat(rng.uniform(0.05, 0.25, 20), 200):
        seen.append(round((place + 1e-4 * rng.normal()) / 1e-4) * 1e-4)
        u.append(round(float(np.clip(40 * (wanted - seen[-1]), -8, 8)), 2))
        for _ in range(10):
            place, speed = place + 1e-3 * speed, speed + 1e-3 * 60 * (0.06 * u[-1] - speed)
    effect = one_effect(np.array(seen), np.array(u), "x")
    assert effect.closed_loop or effect.may_be_closed


@pytest.mark.parametrize("step", [1e-6, 1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize(("gain", "fluid"), [(3, 14), (9, 60)])
def test_feedback_without_noise_is_seen_through_the_steps_of_a_scale(
    step: float, gain: float, fluid: float
) -> None:
    """The steps hide what a measurement adds to the past, but not the law between set points."""
    (place, speed), found = (0.1, 0.0), []
    for wanted in np.repeat(np.random.default_rng(0).uniform(-0.15, 0.15, 27), 150):
        found.append((round(place / step) * step, gain * (wanted - place)))
        for _ in range(10):
            place, speed = place + 1e-3 * speed, speed + 1e-3 * fluid * (0.9 * found[-1][1] - speed)
    effect = one_effect(*np.array(found).T, "x")
    assert effect.closed_loop or effect.may_be_closed


@pytest.mark.parametrize("seed", SEEDS)
def test_no_law_is_seen_in_inputs_that_were_chosen_before(seed: int) -> None:
    rng, t = np.random.default_rng(seed), np.arange(4000) * DT
    levels = np.repeat(rng.uniform(-1, 1, 40), 100)
    tones = np.sin(np.outer(t, (1.9, 4.4, 6.9)) + rng.uniform(0, 6, 3)).sum(axis=1)
    for u in (levels, held(rng, 4000), smooth(rng, 4000), tones, lfilter([1], [20, -19], levels)):
        found = log_of(pd.DataFrame({"t": t, "th": motor(u, step=1e-4), "u": u}))
        assert unexplained_changes(found.pieces, 0) > 50 * EXACT


@pytest.mark.parametrize("slower", [2, 3, 10])
def test_a_slow_sensor_beside_a_fast_one_is_no_defect(slower: int) -> None:
    """Where no two rows that follow each other have all states, no effect is judged."""
    rng, t = np.random.default_rng(0), np.arange(2000) * DT
    u, other = held(rng, 2000), smooth(rng, 2000)
    slow = np.where(np.arange(2000) % slower, np.nan, motor(u))
    text = report({"t": t, "th": slow, "volt": 12 - 0.1 * t, "u1": u, "u2": other})
    for name in ("u1", "u2"):
        assert f"{name}: constant, or too few rows in a row that have all states" in text


def test_gaps_and_missing_values_do_no_harm() -> None:
    u = held(np.random.default_rng(0), 3000)
    y, t = motor(u, delay=2), np.arange(3000) * DT
    y[::97] = np.nan
    t[1000:] += 7.0
    log = Log({"t": t, "th": y, "u": u}, states=["th"], inputs=["u"])
    [effect] = examine(log).effects
    assert effect.delays == (2, 2)
    short = Log({"t": t[:20], "th": y[:20], "u": u[:20]}, states=["th"], inputs=["u"])
    assert examine(short).effects == ()


# Signals


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("step", [np.pi / 1000, 0.00038147, 0.1, 1.0])
def test_a_quantum_survives_rounding_unused_levels_and_offsets(seed: int, step: float) -> None:
    rng = np.random.default_rng(seed)
    counts = np.round(rng.normal(0, 300, 4000)).astype(int)
    counts = counts[(counts % 7 != 3) | (counts > 100)]
    levels = np.unique([float(f"{value:.9g}") for value in (counts + 0.5) * step])
    assert quantum(levels) == pytest.approx(step, rel=1e-4)
    assert np.isnan(quantum(np.unique(rng.normal(size=4000))))
    assert np.isnan(quantum(np.unique([float(f"{one:.9g}") for one in rng.normal(size=4000)])))


@pytest.mark.parametrize("seed", SEEDS)
def test_noise_is_measured_and_at_least_of_the_quantum(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.arange(5000) * DT
    for sigma, step in ((0.02, 1e-3), (1e-6, 0.01)):
        y = np.round((np.sin(3 * t) + rng.normal(0, sigma, 5000)) / step) * step
        health = examine(Log({"t": t, "th": y, "u": t}, states=["th"], inputs=["u"]))
        truth = max(sigma, step / np.sqrt(12))
        assert health.states[0].noise == pytest.approx(truth, rel=0.25)


def test_saturation_is_seen_and_a_switched_input_is_none() -> None:
    rng = np.random.default_rng(0)
    wild = smooth(rng, 4000)
    t = np.arange(4000) * DT
    inputs = {"clipped": np.clip(wild, -9, 1.5), "free": wild, "switched": np.sign(wild)}
    log = Log({"t": t, "th": t, **inputs}, states=["th"], inputs=list(inputs))
    clipped, free, switched = examine(log).inputs
    assert clipped.at_high == int((wild >= 1.5).sum())
    assert (clipped.at_low, free.at_low, free.at_high) == (0, 0, 0)
    assert (switched.at_low, switched.at_high, switched.levels) == (0, 0, 2)


# What the report says


def report(columns: dict[str, Any], **options: Any) -> str:
    table = pd.DataFrame(columns)
    log = log_of(table, **options)
    return "\n".join(lines(log, examine(log), table))


@pytest.mark.parametrize("seed", SEEDS)
def test_likely_mistakes_of_units_are_said(seed: int) -> None:
    rng = np.random.default_rng(seed)
    u = held(rng, 3000)
    angle, t = motor(u, step=1e-4), np.arange(3000) * DT
    degrees = np.degrees(angle)
    counts = np.round(angle / (2 * np.pi) * 4096).astype(int)
    for column, words in (
        (np.round(degrees % 360, 1), "th: wraps about every 360: an angle in deg?"),
        (counts % 4096, "th: wraps about every 4096: an angle in counts/4096?"),
        (angle % (2 * np.pi), "th: wraps about every 6.28319: an angle in rad?"),
        (counts, "th: whole numbers"),
        (np.round(5 * degrees, 1), "turns if it is an angle in radians; degrees?"),
    ):
        text = report({"t": t, "th": column, "u": u})
        assert words in text
        assert "explains nothing" not in text
    for scale, unit in ((1e3, "ms"), (1e6, "us"), (1e9, "ns")):
        assert f"--units time={unit}" in report({"t": t * scale, "th": angle, "u": u})
    for name in ("level [cm]", "T_degC"):
        assert "?" not in report({"t": t, name: np.round(5 * degrees, 1), "u": u})
    dates = pd.Timestamp("2026-03-01") + pd.to_timedelta(100 * t, "s")
    for stamps, options in ((dates, {}), (2 * t, {"units": {"t": 60.0}})):
        assert "stamps in" not in report({"t": stamps, "th": angle, "u": u}, **options)
    clean = report({"t": t, "th": angle, "u": u})
    assert "?" not in clean
    assert f"every {1e3 * DT:.1f} ms" in clean


def test_a_number_that_stands_for_a_missing_one_is_said_and_left_out() -> None:
    """Its jumps were taken for the ends of a turn, and the rest of the log for rest."""
    u = held(np.random.default_rng(0), 2000)
    angle = motor(u)
    whole = report({"t": np.arange(2000) * DT, "th": angle, "u": u})
    text = report({"t": np.arange(2000) * DT, "th": np.r_[angle[:-3], 3 * [-9999.0]], "u": u})
    assert "th: -9999 in 3 rows, far from all others: not measured there?" in text
    assert "wraps" not in text
    assert "rest: nothing moves" not in text
    assert "far from" not in whole


def test_a_rate_with_a_gap_does_not_wrap() -> None:
    """The way over missing values was taken for the end of a turn."""
    rate = 3 * np.sin(2 * np.arange(2000) * DT)
    rate[940:1000] = np.nan  # from its least to its largest value
    assert "wraps" not in report({"t": np.arange(2000) * DT, "v": rate, "u": rate + 1})
    rate[941:1000:20] = 0.0
    assert "wraps" not in report({"t": np.arange(2000) * DT, "v": rate, "u": rate + 1})


def test_words_dates_and_names_with_units_do_no_harm() -> None:
    t = np.arange(50.0) * DT
    table = pd.DataFrame({"t": t, "th": t, "u [V]": t, "mode": "manual", "date": "2026-03-01"})
    table["note"] = ["begin", *[np.nan] * 49]
    log = log_of(table)
    assert (log.states, log.inputs) == (("th",), ("u [V]",))
    assert "mode: words, not used" in lines(log, examine(log), table)


def test_columns_that_are_named_like_inputs_are_and_flags_are_not_states() -> None:
    t = np.arange(50.0) * DT
    base = {"Time": t, "th": t, "ok": np.ones(50, dtype=bool)}
    for names, wanted in (
        (("u",), ("u",)),
        (("motor_voltage", "valve_cmd"), ("motor_voltage", "valve_cmd")),
        (("tau_con1", "tau_meas1"), ("tau_meas1",)),
    ):
        log = log_of(pd.DataFrame({**base, **dict.fromkeys(names, t)}))
        assert (log.states, log.inputs) == (("th",), wanted)
    log = log_of(pd.DataFrame({**base, "current": t, "u": t}), states=["th", "current"])
    assert log.inputs == ("u",)
    with pytest.raises(AnalysisError, match=r"none of the columns Time, th, ok .*--inputs"):
        log_of(pd.DataFrame(base))
    with pytest.raises(SpecificationError, match="or the time between two rows as dt"):
        log_of(pd.DataFrame({"th": t, "u": t}))


@pytest.mark.parametrize("digits", range(3, 8))
def test_rounding_to_decimals_is_no_encoder(digits: int) -> None:
    """An input with six decimals had 6,283,185 steps a turn."""
    rng, t = np.random.default_rng(0), np.arange(3000) * DT
    u = np.round(smooth(rng, 3000), digits)
    assert "a turn)" not in report({"t": t, "th": motor(u, step=1e-3), "u": u})


# Files


def frame() -> pd.DataFrame:
    t = np.arange(100) * DT
    return pd.DataFrame({"t": t, "th": np.sin(t), "u": np.cos(t)})


def write_hdf5(path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, values in frame().items():
            file[f"run/{name}"] = values.to_numpy()
        file["run/mass"] = 2.0


def write_compound(path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file["run"] = frame().to_records(index=False)


def scope() -> dict[str, Any]:
    """Return what Simulink keeps of signals, each with its label."""
    signals = [{"values": frame()[name], "label": name} for name in ("th", "u")]
    return {"time": frame().t, "signals": signals}


def comma() -> str:
    return str(frame().to_csv(index=False))


def dated() -> pd.DataFrame:
    """Return a table with dates for an index, as data bases keep it."""
    index = pd.Timestamp("2026-06-01") + pd.to_timedelta(frame().t, unit="s")
    return frame().drop(columns="t").set_index(pd.DatetimeIndex(index, name="when"))


def series(name: str) -> dict[str, Any]:
    """Return what MATLAB keeps of one signal, with its own copy of the stamps."""
    return {"time": frame().t.to_numpy(), name: frame()[name].to_numpy()}


WRITERS: dict[str, Callable[[Path], Any]] = {
    "run.csv": lambda path: frame().to_csv(path, index=False),
    "run.csv.gz": lambda path: frame().to_csv(path, index=False),
    "comments.csv": lambda path: path.write_text(f"# rig 3, tilted\n\n{comma()}"),
    "preamble.csv": lambda path: path.write_text(f"Rig 3\nrate, 100, Hz\n\n{comma()}"),
    "commented_names.csv": lambda path: path.write_text(f"#{comma()}"),
    "units.csv": lambda path: path.write_text(comma().replace("\n", "\n[s],,\n", 1)),
    "blank.csv": lambda path: path.write_text(comma().replace(",", "  ")),
    "dated.parquet": lambda path: dated().to_parquet(path),
    "clocks.mat": lambda path: savemat(path, {n: series(n) for n in ("th", "u")}),
    "semicolons.csv": lambda path: frame().to_csv(path, index=False, sep=";", decimal=","),
    "points.csv": lambda path: frame().to_csv(path, index=False, sep=";"),
    "tabs.csv": lambda path: frame().to_csv(path, index=False, sep="\t"),
    "blanks.csv": lambda path: path.write_text(frame().to_csv(index=False).replace(",", " , ")),
    "ended.csv": lambda path: path.write_text(frame().to_csv(index=False, lineterminator=",\n")),
    "numbered.csv": lambda path: frame().to_csv(path),
    "run.parquet": lambda path: frame().to_parquet(path),
    "run.mat": lambda path: savemat(path, {**frame().to_dict("list"), "mass": 2.0}),
    "struct.mat": lambda path: savemat(path, {"run": frame().to_dict("list")}),
    "scope.mat": lambda path: savemat(path, {"run": scope()}),
    "run.h5": write_hdf5,
    "new.mat": write_hdf5,
    "octave.mat": write_hdf5,
    "compound.h5": write_compound,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_log_is_read_from_every_kind_of_file(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    WRITERS[name](path)
    if name == "new.mat":  # MATLAB writes 512 bytes of its own in front
        path.write_bytes(
            b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM" + bytes(384) + path.read_bytes()
        )
    log = analysis.read_log(path)
    assert [one.split(".")[-1] for one in (*log.states, *log.inputs)] == ["th", "u"]
    np.testing.assert_allclose(log.pieces[0].measured[:, 0], frame().th, atol=1e-15)
    np.testing.assert_allclose(log.pieces[0].time, frame().t, atol=1e-15)


def test_names_may_begin_with_a_digit(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("1st u,2nd angle,t\n0.5,1,0\n0.5,1,1\n")
    assert [*read_table(tmp_path / "run.csv")] == ["1st u", "2nd angle", "t"]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("run.txt", b"", r"ends with .txt, but a log is read from .csv"),
        ("none.csv", None, "is no file"),
        ("run.csv", b"# rig 3\n0,1,2\n", "cannot be read"),
        ("run.csv", b"0,1.5,2\n0.01,1.6,2\n", "first line has numbers and no names"),
        ("run.csv", b"t,th,u\n", "has no rows"),
        ("run.csv", b"", "cannot be read"),
        ("run.csv.gz", b"no gzip", "cannot be read"),
        ("run.parquet", b"no parquet", "cannot be read"),
        ("run.mat", b"no mat file", "cannot be read"),
        ("run.h5", b"no hdf5", "cannot be read"),
    ],
)
def test_a_file_that_is_no_log_is_answered_by_a_sentence(
    name: str, content: bytes | None, words: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(AnalysisError, match=words) as raised:
        read_table(tmp_path / name)
    assert "expected" in str(raised.value) or "convert it" in str(raised.value)


@pytest.mark.parametrize("encoding", ["cp1252", "utf-16", "utf-8-sig"])
def test_a_spreadsheet_of_windows_is_read(encoding: str, tmp_path: Path) -> None:
    renamed = frame().rename(columns={"t": "Zeit [s]", "th": "Fühler_deg"})
    renamed.to_csv(tmp_path / "run.csv", index=False, sep=";", decimal=",", encoding=encoding)
    log = analysis.read_log(tmp_path / "run.csv")
    assert (log.states, log.notes) == (
        ("Fühler_deg",),
        ("Column 'Fühler_deg' is kept in deg: units= or --units converts it.",),
    )
    np.testing.assert_allclose(log.pieces[0].time, frame().t, atol=1e-15)


def test_what_a_file_holds_is_said_if_it_is_no_table_or_more(tmp_path: Path) -> None:
    savemat(tmp_path / "mixed.mat", {"a": np.zeros(5), "b": np.zeros(7), "c": np.zeros(9)})
    with pytest.raises(AnalysisError, match=r"holds a \(5,\), b \(7,\), c \(9,\)"):
        read_table(tmp_path / "mixed.mat")
    savemat(tmp_path / "run.mat", {**frame().to_dict("list"), "edges": np.zeros(7)})
    assert analysis.read_log(tmp_path / "run.mat").notes[0].endswith("left out: edges (7).")


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "run.h5").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(AnalysisError, match=r"needs the library h5py: .*\[logs\]"):
        read_table(tmp_path / "run.h5")


# The command


def test_the_command_prints_and_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    u = held(np.random.default_rng(0), 2000)
    u[1000] = np.nan
    counts = np.round(motor(np.nan_to_num(u), step=1e-4) / (2 * np.pi) * 2000).astype(int)
    table = pd.DataFrame({"ms": 10 * np.arange(2000), "enc": counts % 2000, "u": u})
    table.to_csv("run.csv", index=False)
    words = ["--states", "th=enc", "--time", "ms", "--units", "ms=ms,th=counts/2000"]
    assert cli.main(["log", "run.csv", *words, "--angles", "th"]) == 0
    said = capsys.readouterr().out
    assert "1,999 rows, 2 pieces" in said
    assert "steps of 0.00314159 (2,000 a turn)" in said
    assert "suspected delay: 0 samples" in said
    assert "in radians" not in said  # its unit was declared
    assert "th [rad, from counts/2000]: " in said
    assert "pieces end there: row 1000" in said
    assert Path("figures/run.png").stat().st_size > 10_000
    assert cli.main(["log", "run.csv", *words, "--inputs", "u=", "--out", "a.pdf"]) == 2
    assert "--inputs is 'u=', but names" in capsys.readouterr().err
    assert cli.main(["log", "none.csv"]) == 2
    assert cli.main(["log", "run.csv", "--out", "a.xyz"]) == 2
    assert "endings .png, .pdf, .svg" in capsys.readouterr().err
    named = table.rename(columns={"ms": "Zeit [ms]", "enc": "level [mm]", "u": "u_rpm"})
    named.to_csv("named.csv", index=False)
    assert cli.main(["log", "named.csv", "--columns", "level=level [mm],u=u_rpm"]) == 0
    said = capsys.readouterr().out
    assert "level [mm]: " in said
    assert "u: " in said
    assert "'u_rpm' is kept in rpm: units= or --units converts it" in said
    assert "degrees" not in said
    both = ["--columns", "angle=enc,motor_torque=u", "--time", "ms", "--units", "ms=ms"]
    assert cli.main(["log", "run.csv", *both]) == 0
    assert "states angle, inputs motor_torque" in capsys.readouterr().out
    assert cli.main(["log", "run.csv", *both, "--inputs", "motor_torque=u"]) == 0
    assert "states angle, inputs motor_torque" in capsys.readouterr().out


# Recorded runs of real plants (their sources and licences: README.md in the folder of DOPT_DATA)


@cache
def recorded(name: str) -> tuple[Health, str]:
    """Return the health of a real log and the report on it."""
    table = read_table(Path(DATA) / f"{name}.csv.gz")
    log = log_of(table, **({"dt": 0.025} if name == "disk_train" else {}))
    health = examine(log)
    return health, "\n".join(lines(log, health, table))


MOVED = ("disk_train", *(f"pendulum_{one}" for one in ("sysid", "sac", "ddp", "ilqr")))
QUBE = tuple(f"qube_0{k}" for k in range(6))
DOUBLE = tuple(f"double_pendulum_0{k}" for k in range(4))


@real
@pytest.mark.parametrize("name", [*MOVED, *QUBE, *DOUBLE])
def test_real_inputs_with_an_effect_are_not_called_useless(name: str) -> None:
    health, text = recorded(name)
    assert not any(effect.explains_nothing for effect in health.effects)
    assert "explains nothing" not in text
    assert "?" not in text


@real
def test_the_disk_answers_one_sample_late_in_open_loop() -> None:
    health, text = recorded("disk_train")
    assert health.states[0].quantum == pytest.approx(np.pi / 1000, rel=1e-4)
    assert "(2,000 a turn)" in text
    assert "suspected delay: 1 sample of 25.0 ms" in text
    assert "u: open loop" in text


@real
@pytest.mark.parametrize("name", QUBE)
def test_the_servo_is_in_closed_loop_with_an_encoder_of_2048_counts(name: str) -> None:
    health, text = recorded(name)
    assert text.count("(2,048 a turn)") == 2
    [effect] = health.effects
    assert effect.closed_loop
    assert effect.delays is not None
    assert effect.delays[0] <= 0 <= effect.delays[1] <= 1
    assert "saturation: a flag" in text


@real
@pytest.mark.parametrize("name", MOVED[1:])
def test_the_pendulum_is_in_closed_loop_without_a_delay_that_can_be_told(name: str) -> None:
    [effect] = recorded(name)[0].effects
    assert effect.closed_loop
    assert effect.delays is None


@real
def test_the_arm_under_gravity_compensation_was_moved_by_hand() -> None:
    text = recorded("pendulum_gravity")[1]
    assert "torque: this input explains nothing here" in text
    assert "R² = 1.000" in text


@real
def test_the_failure_stands_in_stiction() -> None:
    health, text = recorded("pendulum_pd_failure")
    assert health.resting.mean() > 0.6
    assert "nothing moves in 70 % of the log" in text
    assert "nothing moves" not in recorded("qube_00")[1]


@real
@pytest.mark.parametrize("name", DOUBLE)
def test_the_double_pendulum_has_encoders_and_no_pieces_at_jitter(name: str) -> None:
    health, text = recorded(name)
    quanta = [one.quantum for one in health.states[:2]]
    np.testing.assert_allclose(quanta, 12.5 / 2**15, rtol=1e-3)
    assert "1 piece without gaps" in text
    assert "closed loop" not in text  # under commands that were planned before


@real
def test_the_numbers_of_30_000_rows_take_less_than_a_second() -> None:
    """Four seconds are what the command may take with its start; imports and ink are the rest."""
    table = read_table(Path(DATA) / "pendulum_gravity.csv.gz")
    assert len(table) == 30_000 < MOST_ROWS
    spent = []
    for _ in range(3):
        start = time.process_time()
        examine(log_of(table))
        spent.append(time.process_time() - start)
    assert min(spent) < 1.0
