from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from analysis.stats.spectrum import average_spectrum, periodogram


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
