"""Plain values, packed arrays, and the launch's provenance on its way through."""

from __future__ import annotations

import json
from datetime import datetime, timedelta, timezone

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from orchestrate.store import Reader, Store
from orchestrate.store.records import DTYPE, finite_list, pack, unpack, utc_text
from tests.orchestrate.store.fakes import LAUNCH, Array


@given(arrays.arrays(np.float64, arrays.array_shapes(min_dims=1, max_dims=2, min_side=0)))
def test_packed_arrays_come_back_bit_for_bit(array: Array) -> None:
    shape, data = pack(array)
    back = unpack(DTYPE, shape, data)
    assert back.shape == array.shape
    assert back.tobytes() == array.tobytes()


def test_arrays_of_any_layout_are_packed_rows_first() -> None:
    array = np.asfortranarray(np.arange(6.0).reshape(2, 3)).astype(">f8")
    shape, data = pack(array)
    assert json.loads(shape) == [2, 3]
    assert data == np.arange(6, dtype="<f8").tobytes()


@given(st.lists(st.floats()))
def test_numbers_that_are_not_finite_become_none(numbers: list[float]) -> None:
    expected = [x if np.isfinite(x) else None for x in numbers]
    assert finite_list(np.array(numbers, dtype=np.float64)) == expected


def test_times_are_utc_text_that_sorts() -> None:
    east = timezone(timedelta(hours=5, minutes=30))
    assert utc_text(datetime(2026, 1, 1, 5, 30, tzinfo=east)) == "2026-01-01T00:00:00.000000Z"


def test_a_launch_keeps_its_provenance(store: Store, reader: Reader) -> None:
    store.begin_launch(LAUNCH)
    (row,) = reader.query("SELECT * FROM launch")
    assert json.loads(row.argv) == list(LAUNCH.argv)
    assert json.loads(row.overrides) == list(LAUNCH.overrides)
    assert json.loads(row.versions) == dict(LAUNCH.versions)
    assert (row.host, row.pid, row.git_commit) == ("here", 17, LAUNCH.git_commit)
    assert (row.git_dirty, row.git_diff_hash, row.state) == (1, LAUNCH.git_diff_hash, "running")
