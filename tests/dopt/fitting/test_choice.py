"""Choices of segments and signals against dense information matrices of an exact solution."""

from __future__ import annotations

import itertools
import math
import re
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

import dopt
from dopt.errors import SpecificationError
from dopt.fitting.choice import Choice
from dopt.log import Log, Piece
from dopt.types import Array
from tests.dopt.fitting.test_fit import declared, run
from tests.paths import ROOT

DT = 1 / 64
NOISE = 0.02
GUESS = np.array([3.0, 0.8, 0.1])
SPREADS = np.array([1.0, 0.4, 0.3])


def motor(unit: float = 1.0, angle: float = 1.0, **changed: object) -> dopt.Plant:
    """Return a linear plant, its rate and angle by units."""
    numbers = zip(("gain", "damping", "bias"), GUESS, SPREADS, strict=True)
    rate = f"(gain * voltage + bias) / {unit} - damping * rate"
    given: dict[str, Any] = {
        "states": {"angle": "rad", "rate": "rad/s"},
        "inputs": {"voltage": "V"},
        "dt": DT,
        "gamma": 5.0,
        "known": {"angle": f"rate * {unit / angle}", "rate": rate},
        "constants": {name: dopt.unknown(at, spread=spread) for name, at, spread in numbers},
        "learned": ["rate"],
        "box": {"rate": 20.0 / unit, "angle": 20.0 / angle},
        "measured": {"angle": NOISE / angle},
    }
    return dopt.Plant(**(given | changed))


def response(constants: Array, start: Array, u: Array) -> Array:
    """Return the states of the exact solution under inputs that are held, (N, 2)."""
    gain, damping, bias = constants
    A = np.zeros((3, 3))
    A[0, 1], A[1, 1], A[1, 2] = 1.0, -damping, 1.0
    step, x = expm(A * DT), [np.asarray(start, float)]
    for v in u[:-1]:
        x.append((step @ [*x[-1], gain * v + bias])[:2])
    return np.array(x)


def sensitivities(u: Array, start: Array) -> tuple[Array, Array]:
    """Return R by the constants in deviations, and X by the initial state, from differences."""
    h, out = 1e-5, []
    for move in np.eye(5) * h:
        ends = [
            response(GUESS + sign * move[:3] * SPREADS, start + sign * move[3:], u)[:, 0]
            for sign in (1, -1)
        ]
        out.append((ends[0] - ends[1]) / (2 * h * NOISE))
    S = np.array(out).T
    return S[:, :3], S[:, 3:]


def log_det(parts: list[Array]) -> float:
    return math.log(np.linalg.det(np.eye(3) + sum(parts)))


def greedy(each: list[Array], k: int) -> tuple[list[int], list[float]]:
    taken: list[int] = []
    gains = []
    for _ in range(k):
        before = log_det([each[i] for i in taken])
        rest = [j for j in range(len(each)) if j not in taken]
        more = {j: log_det([each[i] for i in [*taken, j]]) - before for j in rest}
        taken.append(max(more, key=lambda j: more[j]))
        gains.append(more[taken[-1]])
    return taken, gains


def pool_of_signals(seed: int, n: int = 8, rows: int = 40) -> list[Array]:
    rng = np.random.default_rng(seed)
    return [
        rng.uniform(0.02, 3) * np.repeat(rng.uniform(-1, 1, rows // h), h)[:, None]
        for h in rng.choice([1, 4, 10, 20], n)
    ]


def check(found: Choice, each: list[Array], k: int) -> None:
    expected, gains = greedy(each, k)
    assert found.indices == tuple(expected)
    np.testing.assert_allclose(found.gains, gains, rtol=1e-4)
    whole = log_det(each)
    shares = [log_det([each[i] for i in expected[: n + 1]]) / whole for n in range(k)]
    np.testing.assert_allclose(found.shares, shares, rtol=1e-4)
    best = max(log_det([each[i] for i in some]) for some in itertools.combinations(range(8), k))
    assert (1 - 1 / math.e) * best <= found.gains.sum() <= best * (1 + 1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_signals_are_chosen_as_by_dense_matrices(seed: int) -> None:
    pool, start = pool_of_signals(seed), np.array([0.3, -0.5])
    each = [(R := sensitivities(u[:, 0], start)[0]).T @ R for u in pool]
    check(dopt.choose(motor(), pool, 4, start=start, width=0), each, 4)


def logs_of_motor(seed: int, angle: float = 1.0) -> list[dopt.Log]:
    rng, logs = np.random.default_rng(seed), []
    for u in pool_of_signals(seed):
        x = response(GUESS, rng.normal(size=2), u[:, 0])[:, :1] / angle
        piece = Piece(np.arange(len(u)) * DT, x, u)
        logs.append(dopt.Log.of_pieces(["angle"], ["voltage"], [piece]))
    return logs


@pytest.mark.parametrize("seed", range(3))
def test_what_an_unknown_initial_state_explains_does_not_count(seed: int) -> None:
    logs, each, rng = logs_of_motor(seed), [], np.random.default_rng(seed)
    for u in pool_of_signals(seed):
        states = response(GUESS, rng.normal(size=2), u[:, 0])
        R, X = sensitivities(u[3:36, 0], states[3])  # the first three rows are the delay's
        P = np.eye(len(X)) - X @ np.linalg.pinv(X)
        each.append(R.T @ P @ R)
    found = dopt.choose(motor(), logs, 4, width=0, refit=False, window=32 * DT)
    check(found, each, 4)
    assert [log is logs[i] for i, log in zip(found.indices, found.logs, strict=True)] == [True] * 4


def by_error(pool: list[tuple[Array, Array]], k: int) -> list[int]:
    """Return the greedy choice, each candidate by a fit of a linear model and all its residuals."""
    taken: list[int] = []

    def left(some: list[int]) -> float:
        rows = [np.eye(3), *(pool[i][0] for i in some)]
        values = [np.zeros(3), *(pool[i][1] for i in some)]
        move = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0]
        return sum(float(np.sum((e - R @ move) ** 2)) for R, e in pool)

    for _ in range(k):
        rest = [j for j in range(len(pool)) if j not in taken]
        taken.append(min(rest, key=lambda j: left([*taken, j])))
    return taken


@pytest.mark.parametrize("seed", range(4))
def test_what_lowers_the_error_of_the_pool_is_taken(seed: int) -> None:
    """With other constants for each log, so that none of them stands for all."""
    rng, logs, pool = np.random.default_rng(seed), [], []
    for u in pool_of_signals(seed):
        constants, start = GUESS + rng.normal(size=3) * SPREADS / 3, rng.normal(size=2)
        x = response(constants, start, u[:, 0])[:, :1] + rng.normal(size=(len(u), 1)) * NOISE
        logs.append(Log.of_pieces(["angle"], ["voltage"], [Piece(np.arange(len(u)) * DT, x, u)]))
        R, X = sensitivities(u[3:36, 0], start)
        e = (x[3:36, 0] - response(GUESS, start, u[3:36, 0])[:, 0]) / NOISE
        start = start + np.linalg.pinv(X) @ e  # which fits best
        R, P = sensitivities(u[3:36, 0], start)[0], np.eye(len(X)) - X @ np.linalg.pinv(X)
        pool.append((P @ R, P @ e))
    found = dopt.choose(motor(), logs, 4, by="error", width=0, refit=False, window=32 * DT)
    assert found.indices == tuple(by_error(pool, 4))


@pytest.mark.parametrize("by", ["error", "information"])
@pytest.mark.parametrize(("width", "refit"), [(0, False), (0, True), (4, True)])
def test_units_do_not_matter(width: int, refit: bool, by: str) -> None:
    how: Any = {"width": width, "refit": refit, "window": 0.5, "taken": [2], "by": by}
    first, *others = (
        dopt.choose(motor(unit, angle), logs_of_motor(1, angle), 3, **how)
        for unit, angle in ((1.0, 1.0), (1000.0, 1.0), (0.01, 50.0))
    )
    for other in others:
        assert other.indices == first.indices
        np.testing.assert_allclose(other.gains, first.gains, rtol=1e-4)


def test_a_refit_finds_the_constants_in_the_segments_that_move() -> None:
    """Of a long rest and a short motion, segments of the motion are taken, and tell the truth."""
    moving, rest = run(0, 480), run(1, 2400)
    rest.loc[:, ["angle", "voltage"]] = 0.0
    logs = [dopt.Log.for_plant(table, declared()) for table in (rest, moving)]
    found = dopt.choose(declared(), logs, 4, seconds=1.0, width=0)
    assert all(place.startswith("log 1") for place in found.places)
    assert (len(found.states), found.pool) == (5, 47 + 9)
    (value, error), (_, before) = (s.constants["gain"] for s in (found.states[-1], found.states[0]))
    assert abs(value - 24.0) < 0.2
    assert error < 0.2 * before
    assert "of 56 candidates, 5 parameters" in found.report()
    fitted = dopt.fit(declared(), [*found.logs], width=0, window=0.6)
    assert len(fitted.chosen.solution.windows.rows) == 4


def test_outliers_of_the_segments_that_were_chosen_are_counted() -> None:
    table = run(0, 600)
    table.loc[range(40, 600, 60), "angle"] += 3.0
    log = dopt.Log.for_plant(table, declared())
    assert log.outliers == {"angle": 10}
    found = dopt.choose(declared(), log, 5, seconds=1.0, width=0, refit=False)
    counts = [one.outliers["angle"] for one in found.logs]
    assert counts == [int(np.isnan(one.pieces[0].measured).sum()) for one in found.logs]
    said = f"{sum(counts)} outliers of angle left out"
    assert said in dopt.fit(declared(), found.logs, width=0, window=0.4).report()


def test_a_fit_counts_as_known() -> None:
    plant = declared()
    found = dopt.fit(plant, run(0, 600), width=0)
    signals = [np.full((50, 1), 0.1), np.linspace(-2.5, 2.5, 50)[:, None]]
    after = dopt.choose(found, signals, 1, start=[0.0, 0.0])
    before = dopt.choose(plant, signals, 1, start=[0.0, 0.0], width=0)
    assert after.indices == before.indices == (1,)
    np.testing.assert_array_equal(after.states[0].p, found.chosen.solution.p)
    assert after.gains[0] < 0.1 * before.gains[0]
    recorded = dopt.choose(found, run(3, 402), 2, seconds=1.0)
    assert recorded.states[-1].constants["gain"][0] == pytest.approx(24.0, abs=0.1)


def test_a_random_order_takes_each_once() -> None:
    logs, how = logs_of_motor(0), {"by": "random", "width": 0, "refit": False, "window": 0.5}
    orders = [
        dopt.choose(motor(), logs, 7, taken=[3], seed=s, **how).indices  # type: ignore[arg-type]
        for s in (0, 0, 1)
    ]
    assert orders[0] == orders[1] != orders[2]
    assert sorted(orders[0]) == [0, 1, 2, 4, 5, 6, 7]


def test_a_signal_that_leaves_the_limit_tells_nothing() -> None:
    known = {"angle": "rate", "rate": "gain * voltage - damping * rate + bias + 40 * rate"}
    found = dopt.choose(
        motor(known=known), [np.full((400, 1), 5.0), np.zeros((9, 1))], 1, start=[0, 1], width=0
    )
    assert found.indices == (1,)


def test_the_example_of_the_page_runs() -> None:
    page = (ROOT / "docs/fitting.md").read_text()
    (code,) = (
        block for block in re.findall(r"```python\n(.*?)```", page, re.S) if "choose" in block
    )
    given = {"plant": declared(), "logs": [run(seed, 600) for seed in range(3)]}
    exec(code, given)
    assert given["best"] in range(50)


LOGS = logs_of_motor(0)
KNOWN = {"gain": 3.0, "damping": 0.8, "bias": 0.1}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"plant": {}}, r"dopt\.Plant or a result of dopt\.fit is expected"),
        ({"k": 9}, r"k is 9 and taken is \[\], but different candidates, at most 8 in all"),
        ({"k": 1.5}, r"k is 1\.5, but a whole number"),
        ({"taken": [1, 1]}, r"taken is \[1, 1\]"),
        ({"taken": [8]}, "an index in taken is 8"),
        ({"by": "informaton"}, "did you mean 'information'"),
        ({"pool": []}, "no log was given"),
        ({"pool": [np.zeros((9, 1))]}, "the pool holds arrays, but logs are expected"),
        ({"pool": LOGS[0], "k": 2}, "at most 1 in all"),
        ({"window": 9.0}, "no candidate has a window of 9 s"),
        ({"seconds": 99.0}, "seconds is 99, but segments"),
        ({"width": -1}, "width is -1"),
        ({"weight": 0.0}, r"weight is 0\.0"),
        ({"start": [0.0]}, r"start has the shape \(1,\)"),
        ({"start": [0, 0], "pool": [np.zeros((9, 2))]}, r"signal 0 has the shape \(9, 2\)"),
        ({"start": [0, 0], "seconds": 1.0}, "leave seconds out"),
        ({"start": [0, 0], "by": "error"}, "by is 'error' with signals, but logs, in"),
        ({"start": [0, 0], "plant": motor(measured={})}, "declare 'measured'"),
        ({"plant": motor(constants=KNOWN)}, "something to learn is expected"),
    ],
)
def test_what_cannot_be_chosen_is_said(changed: dict[str, object], said: str) -> None:
    given: Any = {"plant": motor(), "pool": LOGS, "k": 1, "width": 0, "window": 0.5}
    with pytest.raises(SpecificationError, match=said):
        dopt.choose(**(given | changed))
