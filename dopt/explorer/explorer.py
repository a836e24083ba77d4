"""Exploration of a plant by questions and answers: which input next, and what followed it."""

from __future__ import annotations

import dataclasses
import logging
import math
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import TIMEOUT_MAX
from types import FrameType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from dopt.arguments import finite, instance, numbers, seconds, whole, within
from dopt.errors import ExplorationError, SpecificationError
from dopt.explorer.journal import FORMAT, Event, Journal, foreign
from dopt.explorer.refit import FitBeside, first_evidence, first_simulation
from dopt.explorer.saving import Explored
from dopt.explorer.state import PunctualPlanner, may_remember_plans
from dopt.learning import Conditioning, GaussNewton, Learner, SimulationError
from dopt.models import Model
from dopt.policies import Policy
from dopt.policies.base import ROUNDING
from dopt.registry import section_of
from dopt.spec.config import LARGEST_HORIZON, completed, difference
from dopt.spec.scaled import in_scaled_numbers
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System
from dopt.systems.black_box import BlackBox
from dopt.systems.plant import Plant
from dopt.types import Array


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C back until the end: what is written is also done, and both once."""
    if threading.current_thread() is not threading.main_thread():
        yield  # which signals do not interrupt
        return
    pressed: list[FrameType | None] = []
    before = signal.signal(signal.SIGINT, lambda _, frame: pressed.append(frame))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if pressed and callable(before):
            before(signal.SIGINT, pressed[0])


MANY = 20
"""States in a row from which nothing was learned that are said."""

TIMED = 100
"""Steps whose times are compared with dt."""

_log = logging.getLogger("dopt.explorer")


STEPS = 20_000
"""Steps of an exploration unless it is told otherwise."""


class Explorer(Explored):
    """Explores a plant: chooses its inputs, and learns from the states that follow.

    >>> explorer = Explorer(plant, policy="d_optimal", journal="run.jsonl")
    >>> u = explorer.ask(x)  # x measured now
    >>> explorer.tell(x_next)  # x measured after u was applied for dt seconds

    Steps are counted by what was learned. A measurement that cannot be learned from changes no
    parameter; :attr:`counts` says how many there were of each kind:

    ``learned``
        transitions from one state to the next
    ``repeated``
        states with the time of the last one, which are left out
    ``out_of_order``
        states with an earlier time, which are left out
    ``gaps``
        states that came too early or too late after the last one for the input to have been held
        for about dt. The exploration goes on from them
    ``unusable``
        states with a number that is not finite or beyond the limit of the plant. The exploration
        goes on from the next state
    ``jumps``
        ``ask`` was called with a state other than the last one passed to ``tell``
    ``resets``
        calls of :meth:`reset`
    ``missed``
        questions that were answered with the fallback, because the plan was not ready in time
    ``refits``
        fits beside the exploration that came into force
    ``unmoved``
        stretches of 100 learned steps in which no parameter moved
    ``late``
        stretches of 300 steps whose errors, or changes of what is measured with noise, follow from
        inputs of earlier steps: a delay or a lag that was not declared
    ``early``
        such stretches that follow from inputs that are not to act yet: too long a delay is declared
    ``worse``
        tests, every 500 steps, in which the learned model predicted the last ones 50 at a time with
        1.25 times the error of the known part alone, or more
    ``altered``
        learned steps in which another input was applied than :meth:`ask` returned
    ``supply``
        fits that found a level beyond which inputs act no more, at which plans are then cut
    ``out_of_scale``
        learned accelerations of another size than a network learns, by the first 50 steps
    ``beyond``
        states beyond the limits
    ``narrow``
        sides of the box of which the first 500 states cover less than a tenth

    Each of the last nine is also said once, by a warning.

    Of a plant some of whose states are measured with noise (``Plant(measured=...)``), :meth:`ask`
    and :meth:`tell` are given these states, (n,), in the order of all, in their place; the learner
    'joint_ekf' estimates the others. Ask with what was told last: with another measurement the
    states that are not measured are unknown again.

    Parameters
    ----------
    plant : Plant or System
        The plant, which is explored in numbers that do not depend on its units
        (:mod:`dopt.spec.scaled`); a system, such as one of ``dopt.SYSTEMS`` or an
        environment of Gymnasium, says by its horizon how many steps there are.
    policy, model, learner : str, mapping or object
        As in :meth:`dopt.TrialSpec.of_system`. Without a model it is 'mlp', with one hidden layer
        for the learner 'simulation_error', which integrates a plant by the method of Runge and
        Kutta.
    limits : mapping, optional
        Bounds of states and inputs that inputs are to heed, and rates of inputs, such as
        ``{"bounds": {"angle": [-2, 2], "voltage": [-5, 5]}, "rates": {"voltage": 100}}``
        (:class:`dopt.limits.Limits`). Of states that are measured with noise they need the learner
        'joint_ekf'.
    seed : int
        Seed of the initial parameters and of the policy's own draws.
    steps : int
        Most steps of the exploration, for which memory is set aside.
    journal : str or Path, optional
        File that each event is written to before a call returns (:mod:`dopt.explorer.journal`).
        If it holds an exploration, that one goes on: the arguments have to describe the same.
    fsync : bool
        Whether events are on the disk, and not only in the file, before a call returns.
    deadline : float, optional
        Seconds that :meth:`ask` waits for a plan. Then it returns the fallback. With one,
        :meth:`tell` does not wait for fits beside the exploration.
    fallback : (m,), optional
        A safe input, 0 unless it is given.
    tolerance : float
        Share of dt by which the time between two states may differ from it.
    path : {"kernel", "reference"}, optional
        Where the steps are computed; the kernel, unless a part is not written for it.

    Raises
    ------
    SpecificationError, IncompatibleError
        As :meth:`dopt.TrialSpec.from_names`; also if the journal belongs to another exploration.
    """

    def __init__(
        self,
        plant: Plant | System,
        *,
        policy: str | Mapping[str, object] | Policy = "d_optimal",
        model: str | Mapping[str, object] | Model | None = None,
        learner: str | Mapping[str, object] | Learner = "adam_window",
        limits: Mapping[str, object] | None = None,
        seed: int = 0,
        steps: int = STEPS,
        journal: str | Path | None = None,
        fsync: bool = True,
        deadline: float | None = None,
        fallback: npt.ArrayLike | None = None,
        tolerance: float = 0.5,
        path: str | None = None,
    ) -> None:
        instance(
            "plant", plant, Plant | System, "a plant or a system such as SYSTEMS['pendulum']()"
        )
        instance("journal", journal, str | Path | None, "the path of a file")
        steps = whole("steps", steps, 1, LARGEST_HORIZON)
        named = getattr(learner, "name", learner)
        named = learner.get("name") if isinstance(learner, Mapping) else named
        if named == SimulationError.name:
            model = {"name": "mlp", "depth": 1} if model is None else model
            if isinstance(plant, Plant):
                plant = dataclasses.replace(plant, integrator="rk4")
        system = plant.system(steps) if isinstance(plant, Plant) else _declared(plant)
        spec = TrialSpec.of_system(
            *(system, policy),
            model=model or "mlp",
            learner=learner,
            limits=limits,
            seed=seed,
            path=path,
        )
        self._tolerance = within("tolerance", tolerance, 1.0)
        deadline = None if deadline is None else within("deadline", deadline, TIMEOUT_MAX)
        self._fallback = _safe_input(spec, fallback)
        about = _about(in_scaled_numbers(spec))
        self._journal = None if journal is None else Journal(journal, fsync, about)
        try:
            self._begin(self._as_begun(spec), deadline)
        except BaseException:
            if self._journal is not None:
                self._journal.close()
            raise

    def _as_begun(self, spec: TrialSpec) -> TrialSpec:
        """Return the specification of a new exploration, or of one as the journal began it."""
        journal = self._journal
        if journal is not None and journal.lacks("env", "scaled"):
            return spec
        stays = journal is not None and journal.lacks("learner", "overshoot")
        return in_scaled_numbers(spec, damped=not stays)

    def _begin(self, spec: TrialSpec, deadline: float | None) -> None:
        """Begin an exploration, or go on with the one in the journal."""
        system = spec.system
        measured_states = list(system.measured_states or range(system.n_states))
        self._angles = [i for i, row in enumerate(measured_states) if row in system.angle_indices]
        self._limits = system.state_limits[measured_states]
        self._limits[self._angles] = np.finfo(float).max
        super().__init__(spec)
        self._plans_each_step = may_remember_plans(spec)
        self._unlearned = 0  # states in a row from which nothing was learned
        self._told: tuple[Array, float | None] = np.empty(0), None  # the last one
        self._planner = PunctualPlanner(self._state.plan, deadline)
        self._fits: FitBeside | None = None
        if isinstance(spec.learner, SimulationError):
            self._fits = FitBeside(first_simulation())
        elif isinstance(spec.learner, GaussNewton) and spec.learner.fits_beside:
            self._fits = FitBeside(self._state.fit_request())
        elif (evidence := self._state.steps.evidence) is not None:
            self._fits = FitBeside(first_evidence(), evidence.first_request())
        self._waits, self._is_slow = deadline is None, False
        if self._journal is not None:
            self._resume(self._journal)

    def ask(self, state: npt.ArrayLike, time: float | None = None) -> Array:
        """Return the input u_t, (m,), for a state x_t, (d,), or what was measured of it, (n,).

        Asked again for the same state, it gives the same input.

        Parameters
        ----------
        state : (d,)
            State as it was measured last. If it is not the one that was told last, the exploration
            goes on from it; if it is an older one, the input is that for the one told last.
        time : float, optional
            When it was measured [s], by the clock that :meth:`tell` is given the times of.

        Raises
        ------
        SpecificationError
            If the state has another shape.
        ExplorationError
            If all steps are done.
        """
        x, now = self._measured(state), seconds(time)
        with uninterrupted(), self._lock, self._timed(0):
            self._require_step()
            if not self._is_usable(x):
                self._wait()
                if self._state.present is not None or not self._was_told(state, now):
                    self._note({"lost": "unusable"})
                return self._fallback.copy()
            return self._answer(x, now, self._was_told(state, now)).copy()

    def _was_told(self, state: npt.ArrayLike, now: float | None) -> bool:
        """Return True if a state was told last, and so is already counted."""
        told, then = self._told
        return now in (None, then) and np.array_equal(np.asarray(state), told, equal_nan=True)

    def _answer(self, x: Array, now: float | None, was_told: bool) -> Array:
        """Return the input for a usable state."""
        state = self._state
        elapsed = self._elapsed(now)
        same = state.present is not None and np.array_equal(x, state.present)
        older = state.present is not None and now is not None and elapsed <= 0.0
        if older and not same:
            if not was_told:
                kind = "out_of_order" if elapsed < 0.0 else "repeated"
                self._note({"counted": kind}, durable=False)
        elif not same or (now is not None and elapsed > 0.0):
            self._wait()
            self._note({"begin": x.tolist(), "time": now})
        if state.answer is None:
            self._wait()
            self._plan()
        assert state.answer is not None
        return state.answer

    def reset(self) -> None:
        """Forget the present state: the plant, or its clock, restarts with the next one."""
        with uninterrupted(), self._lock:
            self._require_open()
            self._wait()
            self._note({"lost": "resets"})

    def tell(
        self, state: npt.ArrayLike, applied: npt.ArrayLike | None = None, time: float | None = None
    ) -> bool:
        """Learn from the state x_{t+1}, (d,), that followed, and return whether that was possible.

        Of a plant some of whose states are measured it is these, (n,).

        Parameters
        ----------
        state : (d,)
            State that was measured after an input was held for about dt seconds.
        applied : (m,), optional
            That input, if it is another one than :meth:`ask` has returned.
        time : float, optional
            When the state was measured [s]. Without it, it counts as measured dt after the last.

        Raises
        ------
        SpecificationError
            If a shape is wrong, or the input is not finite.
        ExplorationError
            If all steps are done, if no input is known, or if the parameters are not finite any
            more.
        """
        x, now = self._measured(state), seconds(time)
        u = None if applied is None else finite("applied", applied, self.spec.system.n_inputs)
        with uninterrupted(), self._lock, self._timed(1):
            self._require_step()
            self._wait()
            self._told = np.array(state, dtype=float), now
            learned = self._take_in(x, u, now)
            if learned and self._fits is not None:
                self._refit(self._fits)
            if learned and not self._waits and self.n_steps % TIMED == 0:
                self._check_times()
            return learned

    def _take_in(self, x: Array, applied: Array | None, now: float | None) -> bool:
        state, dt = self._state, self.spec.system.dt
        elapsed = self._elapsed(now)
        u = state.answer if applied is None else applied
        u = None if u is None else state.flight.cut(u)
        if elapsed <= 0.0:
            kind = "repeated" if elapsed == 0.0 else "out_of_order"
            self._note({"counted": kind}, durable=False)
        elif not self._is_usable(x):
            self._note({"lost": "unusable"})
        elif state.present is None:
            self._note({"begin": x.tolist(), "time": now})
        elif abs(elapsed - dt) > self._tolerance * dt:
            self._note({"gap": x.tolist(), "time": now})
        elif u is None:
            raise ExplorationError(
                "a state was told before an input was asked for: call ask() first, or say which "
                "input was applied."
            )
        elif not np.isfinite(state.accelerations(x, u, elapsed)).all():
            self._note({"lost": "unusable"})
        else:
            if state.answer is None and self._plans_each_step:  # though none was asked for
                if not self._planner.plan():
                    self._planner.wait()
                self._note_plan(unasked=True)
            if now is None and state.time is not None:
                now = state.time + dt
            event = {"learn": x.tolist(), "applied": u.tolist(), "dt": elapsed, "time": now}
            self._note(event)
            return True
        return False

    def _refit(self, fits: FitBeside) -> None:
        """Bring a fit that is done into force, and begin the next one when it is due.

        Without a deadline a fit is waited for when the next one is due.
        """
        state, learner, rows = self._state, self.spec.learner, self._state.run.rows
        assert isinstance(learner, SimulationError | Conditioning | GaussNewton)
        due = max(learner.first_rows, (1.0 + learner.growth) * max(state.run.fitted, fits.rows))
        if fits.is_ready or (fits.is_running and self._waits and rows >= due):
            found = fits.take()
            if isinstance(found, str):
                _log.warning("no fit to %d rows came from the process: %s", fits.rows, found)
            if state.renewal is not None:
                self._note({"renewed": fits.rows})  # which makes it where the process has failed
            elif not isinstance(found, str):
                self._note(state.refitted(found, fits.rows, beside=not self._waits))
        if fits.is_running or self.n_steps == self.spec.system.horizon:
            return
        if (renewal := state.renewal) is not None:
            fits.begin(renewal.request(), state.run.fitted, renewal.install)
        elif rows >= due:
            fits.begin(state.fit_request(), rows)

    def _check_times(self) -> None:
        """Warn once where both calls together take longer than a step."""
        dt, t = 1e3 * self.spec.system.dt, self.n_steps
        times = 1e-3 * self._times[:, max(t - TIMED, 0) : t - 1].sum(axis=0)
        times = times[np.isfinite(times)]  # of steps that were not replayed
        taken = float(np.median(times)) if len(times) else 0.0
        if taken > dt and not self._is_slow:
            self._is_slow = True
            _log.warning(
                "ask() and tell() take %.3g ms together, the median of %d steps, but a step "
                "is to take %g ms: choose a faster policy or learner, such as "
                "learner={'name': 'gauss_newton', 'refit_every': 0}, which fits beside",
                *(taken, len(times), dt),
            )

    def _elapsed(self, now: float | None) -> float:
        """Return the seconds since the last state."""
        if now is None or self._state.time is None:
            return self.spec.system.dt
        return now - self._state.time

    def _measured(self, given: npt.ArrayLike) -> Array:
        """Return what was measured, with its angles within half a turn of the present ones."""
        x, present = numbers("state", given, len(self._limits)), self._state.present
        if present is not None:
            for i in self._angles:
                turns = (present[i] - x[i]) / (2 * math.pi)
                if abs(turns) > 0.5 and math.isfinite(turns):
                    x[i] += 2 * math.pi * np.round(turns)
        return x

    def _is_usable(self, x: Array) -> bool:
        """Return True if a state can be a measurement; angles may turn without bound."""
        return bool(np.all(np.abs(x) <= self._limits))  # also false for NaN

    def _require_open(self) -> None:
        if self._closed:
            raise ExplorationError(
                "the exploration is closed: open it again, with its journal if it goes on."
            )

    def _require_step(self) -> None:
        self._require_open()
        if self.n_steps == self.spec.system.horizon:
            raise ExplorationError(
                f"all {self.n_steps} steps of the exploration are done: begin another one with "
                f"more steps."
            )

    def _note(self, event: Event, *, durable: bool = True) -> None:
        """Write an event, and change by it."""
        if self._journal is not None:
            self._journal.write(event, durable=durable)
        self._state.do(event)
        if "learn" in event:
            self._unlearned = 0
        elif event.keys().isdisjoint(("plan", "missed")) and event.get("lost") != "resets":
            self._unlearned += 1
            if self._unlearned == MANY:
                _log.warning(
                    "nothing was learned from the last %d states (%s), but states are expected "
                    "every %g s: tell() each state that followed an input, give times in seconds, "
                    "call reset() if their clock restarted, and give a limit that no state is "
                    "beyond, and a policy and a learner that are faster than that",
                    *(MANY, self.counts, self.spec.system.dt),
                )

    def _plan(self) -> None:
        """Plan for the present state; the fallback is the answer if that is not ready in time."""
        if self._planner.plan():
            self._note_plan()
        if self._state.answer is None:
            self._note({"missed": self._fallback.tolist()}, durable=False)

    def _note_plan(self, **more: bool) -> None:
        planned = self._state.planned
        if np.isfinite(planned).all():
            self._note({"plan": planned.tolist(), **more}, durable=False)

    def _wait(self) -> None:
        """Wait for a plan that was not ready in time, which the policy may remember."""
        if self._planner.wait():
            self._note_plan()

    def _resume(self, journal: Journal) -> None:
        """Replay what the journal holds, or write what it is about."""
        if not journal.events:
            journal.write(_about(self.spec), durable=True)
            return
        stored, given = completed(journal.events[0]["trial"]), completed(self.spec.to_mapping())
        if stored != given:
            path, (then, now) = difference([stored, given])
            raise SpecificationError(
                f"the journal {journal.path} belongs to another exploration ({path} was {then!r} "
                f"and is {now!r}): give the same arguments as then, or another file."
            )
        for number, event in enumerate(journal.events[1:], start=2):
            if not self._state.may_replay(event):
                raise foreign(journal.path, f"line {number} is no event that can follow there")
            self._state.replay(event)

    def close(self) -> None:
        """Close the journal and end the thread of the planner."""
        if self._closed:
            return
        self._closed = True
        try:
            with uninterrupted(), self._lock:
                self._wait()
                self._state.finish()
        finally:
            self._planner.close()
            if self._fits is not None:
                self._fits.close()
            if self._journal is not None:
                self._journal.close()
            self._close_savers()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _about(spec: TrialSpec) -> Event:
    """Return the first line of a journal."""
    return {"format": FORMAT, "trial": spec.to_mapping()}


def _declared(system: System) -> System:
    """Return a system of which nothing but its declaration is used.

    A black box, such as an environment of Gymnasium, is not started: its known part is compiled,
    and its states are those that the explorer is told.

    Raises
    ------
    SpecificationError
        If its outputs mix states: those that begin an exploration would be unknown.
    """
    if system.output_matrix:
        raise SpecificationError(
            f"env.output_matrix is {list(system.output_matrix)}, but an explorer is told states, "
            f"all of them or some: set env.measured_states, or take the outputs for states."
        )
    if not isinstance(system, BlackBox) or system.measured:
        return system
    kind, section = type(system), section_of(system)
    declared: dict[str, Any] = {
        "compiled": True,
        "measured": True,
        "to_section": lambda self: section,  # noqa: ARG005  # the system's own
        "__module__": kind.__module__,
    }
    explored: type[System] = dataclasses.dataclass(frozen=True, kw_only=True)(
        type(kind.__name__, (kind,), declared)
    )
    return explored(**{key.name: getattr(system, key.name) for key in dataclasses.fields(system)})


def _safe_input(spec: TrialSpec, fallback: npt.ArrayLike | None) -> Array:
    """Return the fallback, (m,), 0 unless it is given, or raise SpecificationError."""
    m, gamma = spec.system.n_inputs, spec.system.gamma
    u = np.zeros(m) if fallback is None else finite("fallback", fallback, m)
    if np.linalg.norm(u) > gamma * (1 + ROUNDING):
        raise SpecificationError(
            f"fallback is {u.tolist()}, but its norm has to be at most {gamma:g}: lower it."
        )
    return u
