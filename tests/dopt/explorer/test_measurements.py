"""States that are late, lost, repeated, out of order or not finite: counted, not learned from."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopt import Explorer, Plant
from dopt.errors import SpecificationError
from tests.dopt.explorer.plants import MOTOR, following, motor_acceleration


class TestMeasurements:
    """States that are late, lost, repeated, out of order or no numbers."""

    def begun(self, **given: Any) -> tuple[Explorer, np.ndarray]:
        """Return an explorer after one step at 0.02 s, and its state."""
        explorer = Explorer(MOTOR, steps=20, **given)
        x = np.array([0.1, 0.0])
        u = explorer.ask(x, time=0.0)
        x = following(x, u)
        assert explorer.tell(x, time=0.02)
        return explorer, x

    def test_repeated_and_older_ones_change_nothing(self) -> None:
        explorer, x = self.begun()
        explorer.ask(x, time=0.02)
        before = explorer.parameters
        assert not explorer.tell(x, time=0.02)
        assert not explorer.tell(x + 1.0, time=0.01)
        assert np.array_equal(explorer.parameters, before)
        assert (explorer.counts["repeated"], explorer.counts["out_of_order"]) == (1, 1)
        assert explorer.tell(following(x, explorer.ask(x)), time=0.04)

    @pytest.mark.parametrize("value", [np.nan, np.inf, 1e5])
    def test_unusable_ones_end_a_transition(self, value: float) -> None:
        explorer, x = self.begun()
        explorer.ask(x, time=0.02)
        before = explorer.parameters
        assert not explorer.tell([0.0, value], time=0.04)
        assert not explorer.tell(x, time=0.06)  # from which the next step is taken
        assert np.array_equal(explorer.parameters, before)
        assert explorer.counts["unusable"] == 1
        assert explorer.tell(following(x, explorer.ask(x)), time=0.08)

    def test_an_unusable_state_is_answered_with_the_fallback(self) -> None:
        explorer, _ = self.begun(fallback=[0.3])
        assert explorer.ask([np.nan, 0.0], time=0.02) == 0.3
        assert explorer.counts["unusable"] == 1
        assert not explorer.tell([0.2, 0.0], time=0.04)  # from which it goes on

    @pytest.mark.parametrize("when", [0.025, 0.06])
    def test_too_early_and_too_late_ones_are_gaps(self, when: float) -> None:
        explorer, x = self.begun()
        u = explorer.ask(x, time=0.02)
        before = explorer.parameters
        assert not explorer.tell(following(x, u), time=when)
        assert np.array_equal(explorer.parameters, before)
        assert explorer.counts["gaps"] == 1
        assert explorer.n_steps == 1

    def test_an_infinite_acceleration_is_unusable(self) -> None:
        """The known part is infinite at one state: what is seen there is no number."""
        given = {f.name: getattr(MOTOR, f.name) for f in dataclasses.fields(MOTOR)}
        pole = {"known": {"angle": "rate", "rate": "gain * voltage + 1 / angle"}}
        explorer = Explorer(Plant(**(given | pole)), steps=20, learner="gauss_newton")
        explorer.ask([0.0, 0.0])
        assert not explorer.tell([0.1, 0.0], applied=[1.0])
        assert explorer.counts["unusable"] == 1
        assert explorer.n_steps == 0

    def test_an_angle_is_followed_over_many_turns(self) -> None:
        """Measured over one turn, and beyond the limit over many."""
        turning = [0.0, 2.5, 5.0, 7.5]
        wrapped = [(a + np.pi) % (2 * np.pi) - np.pi for a in turning]
        one, many = (Explorer(MOTOR, steps=20) for _ in range(2))
        for explorer, angles in ((one, wrapped), (many, [a + 2e4 * np.pi for a in turning])):
            explorer.ask([angles[0], 125.0])
            assert all(explorer.tell([a, 125.0], applied=[1.0]) for a in angles[1:])
        assert one.states[:, 0] == pytest.approx(turning)
        assert one.parameters == pytest.approx(many.parameters, rel=1e-3)

    def test_states_without_times_go_on_with_the_clock(self) -> None:
        explorer, x = self.begun()
        explorer.tell(following(x, explorer.ask(x)))
        assert explorer._state.time == pytest.approx(0.04)

    def test_many_in_vain_are_said(self, caplog: pytest.LogCaptureFixture) -> None:
        """Such as times in milliseconds."""
        explorer = Explorer(MOTOR, steps=40)
        with caplog.at_level("WARNING"):
            for step in range(30):
                explorer.ask([0.1, 0.0], time=20.0 * step)
                explorer.tell([0.1, 0.0], time=20.0 * (step + 1))
        assert len([r for r in caplog.records if "last 20 states" in r.message]) == 1

    def test_states_that_are_never_told_are_said(self, caplog: pytest.LogCaptureFixture) -> None:
        explorer = Explorer(MOTOR, steps=40)
        with caplog.at_level("WARNING"):
            for step in range(30):
                explorer.ask([0.1 * step, 0.0])
        assert len([r for r in caplog.records if "tell() each state" in r.message]) == 1

    def test_a_clock_that_began_anew_is_said(
        self, caplog: pytest.LogCaptureFixture, tmp_path: Path
    ) -> None:
        journal = tmp_path / "run.jsonl"
        with Explorer(MOTOR, steps=40, journal=journal) as explorer:
            explorer.ask([0.1, 0.0], time=1e3)
        with (
            Explorer(MOTOR, steps=40, journal=journal) as explorer,
            caplog.at_level("WARNING"),
        ):
            for step in range(30):
                explorer.tell([0.1, 0.1 * step], time=0.02 * step)
                explorer.ask([0.1, 0.1 * step], time=0.02 * step)
            assert explorer.counts["out_of_order"] == 30
        said = "call reset() if their clock began anew"
        assert len([r for r in caplog.records if said in r.message]) == 1

    @pytest.mark.parametrize("timed", [False, True])
    def test_a_state_that_is_told_and_asked_about_is_counted_once(self, timed: bool) -> None:
        explorer, x = self.begun()
        now = 0.02
        bad = [("unusable", [7.0, np.nan], 0.04), ("unusable", [0.0, 1e5], 0.06)]
        if timed:
            bad = [("repeated", x + 1.0, now), ("out_of_order", x + 1.0, 0.01), *bad]
        before = explorer.parameters
        for kind, state, when in bad:
            count = explorer.counts[kind]
            for _ in range(2):
                given = np.array(state)
                if explorer.counts[kind] == count:
                    assert not explorer.tell(given, time=when if timed else None)
                explorer.ask(given, time=when if timed else None)
                given[:] = 0.0
            assert explorer.counts[kind] == count + 1
        assert np.array_equal(explorer.parameters, before)
        assert not explorer.tell(x, time=0.08)
        assert explorer.tell(following(x, explorer.ask(x)), time=0.10)

    @pytest.mark.parametrize("time", [np.nan, np.inf, "1", True, [0.1]])
    def test_times_that_are_none_are_refused(self, time: Any) -> None:
        explorer, x = self.begun()
        with pytest.raises(SpecificationError, match="finite number of seconds"):
            explorer.tell(x, time=time)
        with pytest.raises(SpecificationError, match="finite number of seconds"):
            explorer.ask(x, time=time)

    def test_dt_is_measured(self) -> None:
        """With jitter of a quarter of dt the accelerations are seen as they are."""
        explorer, x = self.begun()
        u = explorer.ask(x, time=0.02)
        predicted = explorer.predict(x)[0, 0]
        assert explorer.tell(following(x, u, 0.025), time=0.045)
        assert explorer.errors[1] == pytest.approx(abs(motor_acceleration(x) - predicted), rel=1e-9)

    def test_a_state_that_was_not_told_is_a_jump(self) -> None:
        explorer, _ = self.begun()
        explorer.ask([1.0, 0.0], time=5.0)
        assert explorer.counts["jumps"] == 1
        assert explorer.tell(following(np.array([1.0, 0.0]), explorer.ask([1.0, 0.0])), time=5.02)
        assert np.array_equal(explorer.states[1], [1.0, 0.0])

    def test_the_answer_to_an_older_state_is_that_to_the_present_one(self) -> None:
        explorer, x = self.begun()
        u = explorer.ask(x, time=0.02)
        assert np.array_equal(explorer.ask([0.1, 0.0], time=0.0), u)
        assert explorer.counts["out_of_order"] == 1
        assert explorer.tell(following(x, u), time=0.04)

    def test_a_clock_that_starts_anew_is_followed_after_a_reset(self) -> None:
        explorer, x = self.begun()
        explorer.reset()
        u = explorer.ask(x, time=0.001)
        assert explorer.tell(following(x, u), time=0.021)
        assert (explorer.counts["resets"], explorer.counts["learned"]) == (1, 2)
