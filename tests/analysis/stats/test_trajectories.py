"""Lines in a phase plane and spectra of inputs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from analysis.stats.curves import average_spectrum, periodogram, wrapped_line
from dopt.assessment import TURN, turns, wrap


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


def test_a_sine_on_the_grid_is_one_line_of_half_its_squared_amplitude() -> None:
    dt, steps, cycles = 0.02, 500, 7
    time = dt * np.arange(steps)
    wave = 3 * np.sin(2 * np.pi * cycles / (steps * dt) * time)
    frequency, density = periodogram(wave[None, :, None], dt)
    peak = np.argmax(density[0])
    assert frequency[peak] == pytest.approx(cycles / (steps * dt))
    assert density[0, peak] * frequency[1] == pytest.approx(9 / 2)
    assert np.delete(density[0], peak).max() < 1e-20


def test_white_noise_is_flat_at_its_variance_over_the_nyquist_frequency() -> None:
    dt, variance = 0.02, 4.0
    noise = np.sqrt(variance) * np.random.default_rng(0).normal(size=(400, 200, 1))
    spectrum = average_spectrum(noise, dt)
    level = variance / (0.5 / dt)
    assert spectrum.mean[1:-1] == pytest.approx(level, rel=0.25)
    # a periodogram ordinate is exponential: its quantiles are -log(0.9) and -log(0.1) of the mean
    assert spectrum.low[1:-1].mean() == pytest.approx(-np.log(0.9) * level, rel=0.1)
    assert spectrum.high[1:-1].mean() == pytest.approx(-np.log(0.1) * level, rel=0.1)
    assert spectrum.n == 400


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


def test_a_crossing_reaches_both_edges_at_the_interpolated_height() -> None:
    line = wrapped_line(np.array([[math.pi - 1, 0.0], [math.pi + 3, 4.0]]), 0)
    expected = np.array(
        [[math.pi - 1, 0], [math.pi, 1], [np.nan, np.nan], [-math.pi, 1], [-math.pi + 3, 4]]
    )
    assert line == pytest.approx(expected, nan_ok=True)


def test_a_crossing_to_the_other_side() -> None:
    line = wrapped_line(np.array([[-math.pi + 1, 0.0], [-math.pi - 1, 2.0]]), 0)
    assert line[1] == pytest.approx([-math.pi, 1])
    assert line[3] == pytest.approx([math.pi, 1])


def test_the_second_coordinate_can_be_the_angle() -> None:
    line = wrapped_line(np.array([[0.0, 0.0], [1.0, 4.0]]), 1)
    assert line[1] == pytest.approx([math.pi / 4, math.pi])
    assert line[-1] == pytest.approx([1.0, 4.0 - TURN])


def test_more_than_a_turn_in_a_step_is_a_plain_break() -> None:
    line = wrapped_line(np.array([[0.0, 0.0], [3 * TURN, 1.0]]), 0)
    assert line == pytest.approx(np.array([[0, 0], [np.nan, np.nan], [0, 1]]), nan_ok=True)


def test_a_line_within_one_turn_stays_as_it_is() -> None:
    points = np.array([[3.0, 1.0], [-3.0, 2.0], [0.0, 3.0]])
    assert np.array_equal(wrapped_line(points, 0), points)
