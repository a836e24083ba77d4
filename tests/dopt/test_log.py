"""Logs: what each fault of a recorded run means."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest

import dopt
from dopt.errors import SpecificationError
from dopt.log import Log
from tests.dopt.explorer.plants import MOTOR
from tests.paths import loaded_by

N = 200
T = np.arange(N) * 0.01
TURN = 2 * np.pi


def table(**columns: npt.ArrayLike) -> dict[str, Any]:
    return {"t": T, "th": 0.3 * np.sin(9 * T), "u": np.cos(5 * T)} | columns


def log(data: Any = None, **options: Any) -> Log:
    return Log(table() if data is None else data, **{"states": ["th"], "inputs": ["u"]} | options)


def said(found: Log, words: str) -> bool:
    return any(words in note for note in found.notes)


def motor(**more: Any) -> dopt.Plant:
    given: dict[str, Any] = {"inputs": {"v": "V"}, "dt": 0.01, "box": {"rate": 30.0}}
    given |= {"known": {"angle": "rate", "rate": "40*v"}, "constants": {}}
    return dataclasses.replace(MOTOR, **(given | more))


# What a clean table is


def test_a_clean_table_is_one_piece_without_notes() -> None:
    found = log()
    [piece] = found.pieces
    assert found.notes == ()
    assert (found.states, found.inputs, found.n_rows) == (("th",), ("u",), N)
    np.testing.assert_array_equal(piece.time, T)
    np.testing.assert_array_equal(piece.measured[:, 0], table()["th"])
    np.testing.assert_array_equal(piece.inputs[:, 0], table()["u"])
    assert {part.dtype for part in piece} == {np.dtype(np.float64)}


def test_frames_mappings_and_arrays_are_the_same_log() -> None:
    columns = table()
    array = np.column_stack(list(columns.values()))
    frame = pd.DataFrame(columns, index=np.arange(N)[::-1])
    for found in (log(frame), log(array, columns=list(columns)), log(frame.astype("Float64"))):
        for part, same in zip(found.pieces[0], log().pieces[0], strict=True):
            np.testing.assert_array_equal(part, same)
    named = log(table(om=9 * T), states={"rate": "om", "angle": "th"}, inputs={"volt": "u"})
    assert (named.states, named.inputs) == (("rate", "angle"), ("volt",))
    np.testing.assert_array_equal(named.pieces[0].measured[:, 0], 9 * T)
    spaced = log({"th": T, "u": T}, dt=0.5)
    np.testing.assert_array_equal(spaced.pieces[0].time, 0.5 * np.arange(N))
    assert said(log(dt=0.5), "Column 't' is not used")
    for data, options in ((T, {}), (np.zeros((5, 2)), {"columns": ["t"]}), ("run.csv", {})):
        with pytest.raises(SpecificationError, match="expected"):
            log(data, **options)


def test_the_input_is_not_shifted_and_nothing_is_resampled() -> None:
    jittered = T + np.random.default_rng(0).uniform(-0.004, 0.004, N)
    found = log(table(t=jittered))
    np.testing.assert_allclose(np.diff(found.pieces[0].time), np.diff(jittered), atol=1e-12)
    assert len(found.pieces) == 1


# Stamps


@pytest.mark.parametrize(
    ("stamps", "options"),
    [
        (T * 1e3, {"units": {"t": "ms"}}),
        ((T * 1e6).round().astype(np.int64), {"units": {"time": "us"}}),
        ((T * 1e9).round().astype(np.int64) + 1_700_000_000_123_456_789, {"units": {"t": "ns"}}),
        (T + 1.7e9, {}),
        (np.datetime64("2026-01-01") + (T * 1e6).round().astype("timedelta64[us]"), {}),
        (pd.date_range("2026-01-01", periods=N, freq="10ms", tz="Europe/Paris"), {}),
        (pd.to_timedelta(T, "s"), {}),
        (pd.Index(T), {}),
        ([f"2026-01-01 00:00:0{k // 100}.{k % 100:02d}" for k in range(N)], {}),
        ([f"2026-01-01T00:00:0{k // 100},{k % 100:02d}+01:00" for k in range(N)], {}),
        ([f"2026-01-01 00:00:0{k // 100}.{k % 100:02d} Z" for k in range(N)], {}),
        ([f"{one:.2f}" for one in T], {}),
        (T * 1e3, {"units": {"t": "1e-3"}}),
    ],
)
def test_stamps_of_every_kind_are_seconds_from_the_first(stamps: Any, options: Any) -> None:
    """In a column, or given apart, as of the index of a table, which ended in an error of numpy."""
    whole = pd.DataFrame(table(t=stamps))
    found = log(whole, **options)
    np.testing.assert_allclose(found.pieces[0].time, T, atol=3e-7)
    [unit] = options.get("units", {"t": 1.0}).values()
    for apart in (stamps, whole.t, whole.set_index("t").index):
        found = log(whole.drop(columns="t"), time=apart, units={"time": unit})
        np.testing.assert_allclose(found.pieces[0].time, T, atol=3e-7)


def test_dates_may_be_missing_and_change_their_offset() -> None:
    stamps = [f"2026-10-25 02:59:59.{k:02d}+02" for k in range(100)]
    stamps += [f"2026-10-25T02:00:00.{k:02d}+0100" for k in range(100)]
    stamps[0] = stamps[150] = ""
    found = log(table(t=stamps))
    np.testing.assert_allclose(found.pieces[0].time, T[:149], atol=1e-9)
    np.testing.assert_allclose(found.pieces[1].time, T[150:-1], atol=1e-9)


def test_a_state_that_is_called_like_a_clock_is_none() -> None:
    """Of a temperature."""
    columns = {"T": np.sin(T), "u": np.cos(T)}
    given: dict[str, Any] = {"states": {"T": "K"}, "known": {"T": "u"}, "learned": ["T"]}
    plant = dopt.Plant(**given, inputs={"u": "W"}, dt=0.01, gamma=1.0, box={"T": 1.0})
    for more in ({"time": T}, {}):
        np.testing.assert_allclose(Log.for_plant(columns | more, plant).pieces[0].time, T)


def test_a_clock_in_a_group_is_found() -> None:
    found = Log({"run.t": T, "run.th": T, "run.u": T}, states=["run.th"], inputs=["run.u"])
    np.testing.assert_array_equal(found.pieces[0].time, T)


def test_a_counter_of_microseconds_that_begins_again_goes_on() -> None:
    ticks = ((T * 1e6).round().astype(np.uint64) + 2**32 - 1_000_000).astype(np.uint32)
    for stamps, unit in ((ticks, "us"), (ticks.astype(np.int64), "us"), (ticks / 1e6, "s")):
        found = log(table(t=stamps), units={"t": unit})
        [piece] = found.pieces
        np.testing.assert_allclose(piece.time, T, atol=1e-9)
        assert said(found, "begins again after 4294.97 s at row 100")
    short = log(table(t=(np.arange(N) * 10 + 64_900).astype(np.uint16)), units={"t": "ms"})
    np.testing.assert_allclose(short.pieces[0].time, np.arange(N) * 0.01, atol=1e-9)


def test_dates_are_stamps_where_no_column_is_named_like_a_clock() -> None:
    frame = pd.DataFrame(table()).drop(columns="t")
    dates = pd.Timestamp("2026-03-01") + pd.to_timedelta(T, "s")
    clock, text = [f"{one:%H:%M:%S.%f}" for one in dates], [one.isoformat(" ") for one in dates]
    for given in (
        frame.set_index(pd.DatetimeIndex(dates, name="when")),
        frame.set_index(pd.TimedeltaIndex(dates - dates[0])),
        frame.assign(when=dates),
        frame.assign(logged=text),
        frame.assign(time=clock),
        frame.assign(**{"a.time": T, "b.time": T}),
    ):
        [piece] = log(given).pieces
        np.testing.assert_allclose(piece.time, T, atol=1e-8)
        [piece] = Log.for_plant(given, motor(), columns={"angle": "th", "v": "u"}).pieces
        np.testing.assert_allclose(piece.time, T, atol=1e-8)


def test_a_repeated_stamp_leaves_out_the_later_row() -> None:
    rows = np.sort(np.r_[0:N, 50, 50, 120])
    found = log({name: values[rows] for name, values in table(k=np.arange(N)).items()})
    np.testing.assert_array_equal(found.pieces[0].time, T)
    assert said(found, "repeated, left out: 3 rows, first row 51")


def test_a_row_out_of_order_is_left_out_and_a_restarted_clock_begins_a_piece() -> None:
    swapped = np.r_[0:50, 51, 50, 52:N]
    found = log({name: values[swapped] for name, values in table().items()})
    assert found.n_rows == N - 1
    assert said(found, "Out of order, left out: row 51")
    restarted = log(table(t=np.r_[T[:80], T[: N - 80]]))
    assert [len(piece.time) for piece in restarted.pieces] == [80, N - 80]
    assert said(restarted, "runs backwards, new pieces begin: row 80")


@pytest.mark.parametrize("seed", range(3))
def test_a_gap_begins_a_piece_and_jitter_does_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.choice([0.001, 0.005, 0.02], N, p=[0.2, 0.7, 0.1])
    steps[[60, 150]] = 0.5
    found = log(table(t=np.cumsum(steps)))
    assert [len(piece.time) for piece in found.pieces] == [60, 90, 50]
    assert said(found, "2 rows, first row 60")
    assert len(log(table(t=np.cumsum(steps)), gap=1.0).pieces) == 1


# Values


def test_a_missing_measurement_stays_and_a_missing_input_ends_a_piece() -> None:
    th, u, t = table()["th"].copy(), table()["u"].copy(), T.copy()
    th[[7, 8]], u[100], t[150] = (np.nan, np.inf), np.nan, np.nan
    found = log(table(th=th, u=u, t=t))
    assert [len(piece.time) for piece in found.pieces] == [100, 49, 49]
    assert np.isnan(found.pieces[0].measured[[7, 8], 0]).all()
    assert said(found, "'th' is missing in 2 rows")
    assert said(found, "Without time or input, not used, pieces end there: 2 rows, first row 100")


def test_whole_numbers_truth_values_and_masked_arrays_are_numbers() -> None:
    masked = np.ma.masked_equal(np.arange(N, dtype=np.int16) % 50, 3)
    found = log(table(th=masked, u=T > 1))
    assert np.isnan(found.pieces[0].measured[3, 0])
    assert set(found.pieces[0].inputs[:, 0]) == {0.0, 1.0}
    objects = np.array([None, *table()["th"][1:]], dtype=object)
    assert np.isnan(log(table(th=objects)).pieces[0].measured[0, 0])


@pytest.mark.parametrize("span", [2.9, 20.0])
@pytest.mark.parametrize(("low", "high", "unit"), [(-np.pi, np.pi, "rad"), (0, 360, "deg")])
def test_an_angle_within_a_turn_is_unwrapped(
    span: float, low: float, high: float, unit: str
) -> None:
    """Also where values are missing and a gap begins another piece."""
    angle = span * np.sin(4 * T) + 1
    raw = (angle / TURN * (high - low) - low) % (high - low) + low
    raw[[40, 41]] = np.nan
    found = log(table(th=raw, t=T + 5.0 * (T[120] <= T)), angles="th", units={"th": unit})
    for piece, rows in zip(found.pieces, (slice(0, 120), slice(120, N)), strict=True):
        got, truth = piece.measured[:, 0], angle[rows]
        there = np.isfinite(got)
        np.testing.assert_allclose(np.diff(got[there]), np.diff(truth[there]), atol=1e-9)
    assert said(found, "unwrapped")


def test_a_glitch_is_no_turn() -> None:
    """One value beyond a turn left every passage of its end in the angle."""
    turning = 0.1 * np.arange(3000)
    angle = (turning + np.pi) % (2 * np.pi) - np.pi
    angle[1000] = 40.0
    found = log({"t": 0.01 * np.arange(3000), "th": angle, "u": turning}, angles=["th"])
    left = np.delete(found.pieces[0].measured[:, 0] - turning, 1000)
    np.testing.assert_allclose(left, 0.0, atol=1e-9)
    assert said(found, "passes its end")


@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("size", [3.0, TURN])
def test_wrong_readings_of_an_encoder_are_left_out(size: float, wrapped: bool) -> None:
    """One or two rows long, up to whole turns, which a wrapped angle does not see."""
    t = 0.01 * np.arange(4000)
    angle = 8.0 * np.sin(2.0 * t) + 3.0 * np.sin(5.0 * t)
    wrong = np.random.default_rng(0).choice(np.arange(5, 3990, 10), 20, replace=False)
    wrong[10] = wrong[9] + 1
    read = angle.copy()
    read[wrong] += size
    read = np.round(read * 2000 / TURN) * TURN / 2000
    read = read % TURN if wrapped else read
    found = log({"t": t, "th": read, "u": t}, angles=["th"])
    got = found.pieces[0].measured[:, 0]
    seen = np.isfinite(got)
    np.testing.assert_allclose(np.ptp((got - angle)[seen]), 0.0, atol=0.01)
    if size < TURN or not wrapped:
        assert set(np.flatnonzero(~seen)) == set(wrong)
        assert said(found, "20 outliers of th left out")


def test_a_motion_with_corners_and_noise_has_no_outliers() -> None:
    rng, t = np.random.default_rng(0), np.arange(3000.0)
    for noise in (0.0, 0.1):
        falls = 20.0 * np.exp(-0.2 * (t % 200))  # as a tank empties
        for motion in (np.abs(t % 40 - 20), np.sign(np.sin(0.03 * t)), falls, 0.0 * t):
            found = log({"t": t, "th": motion + noise * rng.normal(size=3000), "u": t})
            assert not said(found, "outlier")


def test_counts_become_radians_and_counters_go_on() -> None:
    angle = 30.0 * np.sin(2 * T)
    counts = np.round(angle / TURN * 4096).astype(np.int64)
    for raw in (counts % 4096, (counts * 16).astype(np.int16)):
        per_turn = 4096 if raw.max() < 5000 else 4096 * 16
        found = log(table(th=raw), angles=["th"], units={"th": f"counts/{per_turn}"})
        got = found.pieces[0].measured[:, 0]
        np.testing.assert_allclose(got - got[0], angle - angle[0], atol=TURN / 4096)
    for bits in (16, 32):  # from near the end of its range, and not from turns away
        raw = (np.round((angle - 7.0) * 2e3 / TURN).astype(np.int64)) % 2**bits
        found = log(table(th=raw), units={"th": "counts/2000"})
        np.testing.assert_allclose(found.pieces[0].measured[:, 0], angle - 7.0, atol=2e-3)
        assert said(found, f"counter of {bits} bits")
    kept = log(table(th=counts), angles=["th"], units={"th": "counts/4096"})
    assert said(kept, "counts turns")


# Plants


def test_the_log_of_a_plant_has_its_names_angles_and_step() -> None:
    data = {"th": 12.0 * T % TURN, "v": T}
    found = Log.for_plant(data, motor(), columns={"angle": "th"})
    assert (found.states, found.inputs) == (("angle",), ("v",))
    np.testing.assert_allclose(found.pieces[0].measured[:, 0], 12.0 * T, atol=1e-9)
    assert found.step == pytest.approx(0.01)
    assert said(found, "the plant's dt of 0.01 s")
    assert said(found, "left to the fit: rate")
    measured = motor(measured={"angle": 0.01})
    assert Log.for_plant({"angle": T, "v": T}, motor(), columns={}).states == ("angle",)
    array = np.column_stack([T, T, T])
    assert Log.for_plant(array, measured, columns=["t", "angle", "v"]).states == ("angle",)


def test_a_column_that_a_plant_needs_is_asked_for() -> None:
    both = motor(measured={"angle": 0.01, "rate": 0.1})
    for data, plant, words in (
        ({"angle": T, "v": T}, both, "'rate', but no such column is there"),
        ({"angle": T, "volt": T}, motor(), "'v', but no such column is there: choose one of"),
        ({"th": T, "v": T}, motor(), "none is named like a state"),
    ):
        with pytest.raises(SpecificationError, match=words):
            Log.for_plant(data, plant)
    with pytest.raises(SpecificationError, match="'columns' of a log 'agle'"):
        Log.for_plant({"angle": T, "v": T}, motor(), columns={"agle": "th"})


# Refusals


@pytest.mark.parametrize(
    ("columns", "options", "words"),
    [
        ({}, {"states": ["theta"]}, "'theta', but no such column is there: did you mean 'th'"),
        ({}, {"states": []}, r"states of a log are \[\]"),
        ({}, {"angles": ["thh"]}, "did you mean 'th'"),
        ({}, {"time": "stamp"}, "column in 'time' of a log 'stamp' is unknown"),
        ({}, {"time": "t", "dt": 0.1}, "one of the two is expected"),
        ({}, {"dt": -1.0, "time": None}, "dt of a log is -1.0"),
        ({}, {"gap": 0.0}, "gap of a log is 0.0"),
        ({}, {"units": {"th": "degrees"}}, "counts a turn"),
        ({}, {"units": {"speed": "deg"}}, "column in 'units' of a log 'speed'"),
        ({"time": T}, {}, "t and time are called time"),
        ({}, {"states": ["th", "t"], "time": None}, "columns t, th, u, of which none is called"),
        ({"th": T[1:]}, {}, r"th \(199,\)"),
        ({"th": ["1,5"] * N}, {}, "'1,5' in row 0.*decimal point"),
        ({"th": ["1.5"] * 9 + ["bad"] * (N - 9)}, {}, "'bad' in row 9"),
        ({"th": ["rad"] + ["1.5"] * (N - 1)}, {}, "'rad' in row 0.*remove the row, if it holds"),
        ({"t": ["25.10.2026 02:00:00"] * N}, {}, "'25.10.2026 02:00:00'.*to_datetime"),
        ({"t": ["2026-13-01"] * N}, {}, "'2026-13-01' in row 0"),
        ({"t": T[::-1]}, {}, "sort the rows by time"),
        ({"th": T + 1j}, {}, "complex128"),
        ({"th": T * np.nan}, {}, "no value at all"),
        ({"u": np.where(np.arange(N) % 2, T, np.nan)}, {}, "ffill"),
        ({"t": np.floor(T)}, {}, "198 of 200 rows of a log repeat"),
        ({"t": (T + 1.7e9).astype(np.float32)}, {}, "float32.*read them as float64"),
    ],
)
def test_a_fault_is_answered_by_a_sentence(
    columns: dict[str, Any], options: dict[str, Any], words: str
) -> None:
    with pytest.raises(SpecificationError, match=words) as raised:
        log(table(**columns), **options)
    text = str(raised.value)
    assert "expected" in text or "unknown" in text or "choose one of" in text.lower()
    assert text.endswith(".")


# Where it runs


def test_a_log_needs_numpy_alone_and_no_unix() -> None:
    program = (
        "import sys\n"
        "for name in ('fcntl', 'resource', 'pwd'): sys.modules[name] = None\n"
        "import dopt\n"
        "log = dopt.Log({'t': [0, 1, 2], 'a': [1, 2, 3], 'u': [0, 0, 1]}, states=['a'], "
        "inputs=['u'])\n"
        "assert log.n_rows == 3\n"
    )
    loaded = {name.partition(".")[0] for name in loaded_by(program)}
    assert not loaded & {"pandas", "scipy", "numba", "torch", "sqlalchemy", "matplotlib"}


# Names of clocks


@pytest.mark.parametrize(
    ("name", "step"),
    [
        ("Zeit [ms]", 1e-3),
        ("Time [ms]", 1e-3),
        ("t (ms)", 1e-3),
        ("time_ms", 1e-3),
        ("timestamp_us", 1e-6),
        ("Zeit [s]", 1.0),
        ("run.t_s", 1.0),
        ("t/ms", 1e-3),
        ("time in µs", 1e-6),
        ("Time [min]", 60.0),
    ],
)
def test_a_clock_may_have_its_unit_in_its_name(name: str, step: float) -> None:
    found = log({name: T / step, "th": T, "u": T})
    np.testing.assert_allclose(found.pieces[0].time, T, atol=1e-12)
    given = log({name: T * 1e9, "th": T, "u": T}, units={name: "ns"})
    np.testing.assert_allclose(given.pieces[0].time, T, atol=1e-12)
    assert not log({name: T, "t": T, "th": T, "u": T}).notes, "one without a unit goes before"


@pytest.mark.parametrize("name", ["T_s", "t_min", "t [N]", "time_out", "timer", "t_max"])
def test_what_is_no_clock_is_not_taken_for_one(name: str) -> None:
    with pytest.raises(SpecificationError, match=r"of which none is called time.*--time.*--dt"):
        log({name: T, "th": T, "u": T})
