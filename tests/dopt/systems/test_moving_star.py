"""The moving star: the damped mass that it stands for, its field and its orbit."""

from __future__ import annotations

import numpy as np
import pytest

from dopt.systems import MovingStar


def damped_mass(star: MovingStar, friction: float, dt: float, forces: np.ndarray) -> np.ndarray:
    """Return the positions of a mass of 1 kg, q̈ = F + u - α q̇, by the Euler map."""
    at, velocity = np.array(star.initial_state), np.zeros(2)
    positions = [at]
    for t, force in enumerate(forces):
        push = star.friction * star.learned(at[None], t)[0]
        at, velocity = at + dt * velocity, velocity + dt * (push + force - friction * velocity)
        positions.append(at)
    return np.array(positions)


def test_a_step_is_that_of_the_mass_in_flex_one_step_earlier() -> None:
    """With α dt = 1 a velocity has no memory. Their force is that where the mass was before."""
    star = MovingStar(period=1e6, horizon=60)
    rng = np.random.default_rng(0)
    forces = 50.0 * rng.normal(size=(60, 2))
    expected = damped_mass(star, friction=100.0, dt=0.01, forces=forces)
    at = np.array(star.initial_state)
    for t, force in enumerate(forces):
        assert at == pytest.approx(expected[t + 1], abs=1e-4)
        at = at + star.dt * star.derivative(at, force, t)
    assert np.linalg.norm(at - np.array(star.initial_state)) > 0.02


def test_the_force_points_away_from_the_star_and_falls_to_half_at_its_radius() -> None:
    star = MovingStar(radius=0.3, strength=2.0, friction=4.0, core=1e-6)
    centre = np.array([star.orbit, 0.0])
    for angle in (0.3, 2.0, 5.0):
        away = np.array([np.cos(angle), np.sin(angle)])
        near, far = (star.learned((centre + s * away)[None])[0] for s in (1e-3, 0.3))
        assert near == pytest.approx(2.0 / 4.0 * away, rel=1e-4)
        assert far == pytest.approx(1.0 / 4.0 * away, rel=1e-4)
    assert star.learned(centre[None])[0] == pytest.approx(0.0)


def test_the_star_goes_round_once_in_a_period() -> None:
    star = MovingStar(period=0.02, dt=1e-4, horizon=401, orbit=0.7)
    places = [star.physical.index(name) for name in ("center_x", "center_y")]
    path = star.history[:, places]
    assert np.linalg.norm(path, axis=1) == pytest.approx(0.7)
    for turned in (path[200], path[400]):
        assert turned == pytest.approx(path[0])
    assert path[50] == pytest.approx([0.0, 0.7], abs=1e-12)
    assert star.history[0] == pytest.approx(star.parameters)
