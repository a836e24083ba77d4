"""State of an exploration, which changes by events alone: live, or as a journal replays them.

======================  =====================================================================
event                   meaning
======================  =====================================================================
``begin``, ``time``     the state from which the next step is taken
``plan``                the input that the policy chose at it, which is the answer unless there
                        is one
``missed``              the fallback that was the answer, as no plan was ready
``learn``, ``applied``, the state that followed, the input that was applied, and the seconds
``dt``, ``time``        between the two states
``gap``, ``time``       a state that followed after another time than about dt
``lost``                a state that could not be used, after which the present one is unknown
``counted``             something that changes nothing, by the name of its count
``refit``, ``fitted``,  parameters of the model, and values of the constants, delay and lag, that
``rows``, ``supply``,   a fit to so many rows has found, with the level at which inputs are cut if
``beside``              it found one; or the posterior of Gaussian processes with them is made
                        beside the one in force
``renewed``             that posterior, with the samples since, comes into force
======================  =====================================================================

Events are in the units of the plant; the steps are taken in scaled numbers
(:mod:`dopt.spec.scaled`).

Inputs of a plant may come late, slowly or cut. The learner is told what acts in the plant during a
step, and plans are made for the state that is predicted for the moment at which their input
arrives. What was asked before the first state, or before a reset, is taken for 0. In a gap the last
input is held as long as the gap lasts, or if that is not known, until nothing else is on the way.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import logging
import math
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as TooLate
from typing import TYPE_CHECKING

import numpy as np

from dopt.errors import ExplorationError
from dopt.evaluation import rates
from dopt.explorer.journal import Event, is_event
from dopt.explorer.refit import Found, Recording
from dopt.explorer.signs import Signs
from dopt.learning import GaussNewton, SimulationError
from dopt.models import MLP
from dopt.spec.custom_system import warn_of_sizes
from dopt.spec.scaled import scaled, scaled_trial
from dopt.spec.trial import TrialSpec
from dopt.systems.base import System, next_state
from dopt.systems.plant import ExploredPlant
from dopt.types import Array

if TYPE_CHECKING:
    from dopt.explorer.refit import FitRequest
    from dopt.kernel.evidence import Renewal
    from dopt.kernel.run import KernelSteps  # which loads the compiler
    from dopt.kernel.structs import Trial
    from dopt.reference.batch import ReferenceSteps

    Steps = KernelSteps | ReferenceSteps
    """The steps of a trial, in the kernel or in the reference."""

REMEMBERED = 1000
"""Inputs that are kept for another delay or lag; what was before the first is taken for it."""

SETTLED = 40.0
"""Time constants of the lag after which nothing is left of an earlier input in a double."""


class InFlight:
    """Inputs on their way to the plant of an exploration.

    Parameters
    ----------
    system : System
        Inputs of a system that was not made of a :class:`dopt.Plant` act at once.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        self.reset()

    def reset(self) -> None:
        """Take all inputs so far for 0."""
        system = self._system
        self._flight = system.flight() if isinstance(system, ExploredPlant) else None
        self._last = np.zeros(system.n_inputs)
        self._departed = collections.deque([self._last], maxlen=REMEMBERED)

    def retimed(self, system: ExploredPlant) -> InFlight:
        """Return the same inputs on their way to a plant with another delay or lag."""
        other = InFlight(system)
        if other._flight is not None:
            other._flight.settle(self._departed[0])
            for u in self._departed:
                other._flight.depart(other.cut(u))
        other._last, other._departed = self._last, self._departed
        return other

    def cut(self, u: Array) -> Array:
        """Return what the supply can apply of an input, (m,)."""
        limit = self._system.cut_at
        return u if limit == math.inf else np.clip(u, -limit, limit)

    def depart(self, u: Array) -> Array:
        """Send an input, and return what acts in the step that begins with it, (m,)."""
        if self._flight is None:
            return u
        self._last = u
        self._departed.append(u)
        return self._flight.depart(u)

    @property
    def waiting(self) -> Array:
        """Inputs that do not act yet, (n, m), the newest first."""
        waiting = self._flight.inputs if self._flight else ()
        return np.reshape(waiting, (-1, self._system.n_inputs))

    def hold(self, u: Array | None, seconds: float | None) -> None:
        """Hold an input, (m,), or the last one, for a time [s]; without a time, for long."""
        if self._flight is None:
            return
        self._last = self._last if u is None else self.cut(u)
        dt = self._system.dt
        longest = len(self._flight.inputs) + math.ceil(SETTLED * self._flight.lag / dt)
        steps = math.inf if seconds is None else seconds / dt
        if steps >= longest:
            self._flight.settle(self._last)
            self._departed.clear()
            self._departed.append(self._last)
            return
        for _ in range(round(steps)):
            self.depart(self._last)

    def ahead(self) -> tuple[Array, Array] | None:
        """Return what acts until an input that departs now arrives, (n, m), and how long [s], (n,).

        None where that acts at once.
        """
        return self._flight.ahead() if self._flight and self._flight.inputs else None

    def acted(self, inputs: Array) -> Array:
        """Return what acted in a run, (T, m), before which its first input was held."""
        cut = self.cut(inputs)
        if self._flight is None or not len(inputs):
            return cut
        run = InFlight(self._system)
        run.hold(cut[0], None)
        return np.array([run.depart(u) for u in cut])


# A planner that is waited for until a deadline.


class PunctualPlanner:
    """Makes plans in this thread, or with a deadline in a thread of its own.

    Compiled plans run beside the interpreter, so that the deadline holds while they do.

    Parameters
    ----------
    make : callable
        Makes a plan.
    deadline : float or None
        Seconds that one is waited for.
    """

    def __init__(self, make: Callable[[], None], deadline: float | None) -> None:
        self._make, self._deadline = make, deadline
        self._late: Future[None] | None = None
        self._thread = None if deadline is None else ThreadPoolExecutor(1, "planner")
        if self._thread is not None:
            self._thread.submit(int).result()  # the thread is there before the first deadline

    def plan(self) -> bool:
        """Make a plan, and return whether it was ready in time; otherwise call :meth:`wait`."""
        if self._thread is None:
            self._make()
            return True
        plan = self._thread.submit(self._make)
        try:
            plan.result(timeout=self._deadline)
        except TooLate:
            self._late = plan
            return False
        return True

    def wait(self) -> bool:
        """Wait for a plan that was not ready in time, and return whether there was one."""
        if self._late is None:
            return False
        plan, self._late = self._late, None
        plan.result()
        return True

    def close(self) -> None:
        """End the thread."""
        if self._thread is not None:
            self._thread.shutdown()


def may_remember_plans(spec: TrialSpec) -> bool:
    """Return True if the plan of a step may depend on earlier plans."""
    policy, q = spec.policy, spec.model.n_parameters(spec.system)
    compiled = policy.compiled and not policy.is_in_numpy()
    return not compiled or policy.memory_size(spec.system, q) > 0


SIZED_STEPS = 50
"""First steps over which the size of the accelerations is taken."""

_UNITS = (
    "check that the known part and the applied inputs are in the units of the states and inputs, "
    "or "
)

MANY_JUMPS = 10
"""Jumps of a plant some of whose states are measured after which that is said."""

_log = logging.getLogger("dopt.explorer")


class ExplorerState:
    """Measurements of an exploration and the model that was learned from them.

    Attributes
    ----------
    spec : TrialSpec
        Plant, policy, model, learner and seed.
    system : System
        The plant, with the constants, delay and lag that the last refit has found.
    run : Recording
        What was measured and applied, for fits.
    steps : Steps
        The arrays and the steps of the trial, in scaled numbers.
    states, inputs : (T + 1, d), (T, m)
        States and inputs in the units of the plant; where states are estimated, the estimates.
    errors : (T,)
        Errors of predictions (:attr:`dopt.Explorer.errors`).
    done : int
        Steps t that were learned from.
    present : (d,) or None
        State x_t, or what was measured of it; None where it is unknown.
    answer : (m,) or None
        Input that was given for it.
    was_asked : bool
        Whether somebody asked for that input.
    time : float or None
        When it was measured [s].
    excess : (T,)
        How far the state that each step led to, or its estimate, is beyond the limits, 0 without.
    counts : Counter of str
        Number of events of each kind (:class:`dopt.Explorer`).
    flight : InFlight
        Inputs that were asked and do not act yet.
    """

    def __init__(self, spec: TrialSpec) -> None:
        self.spec, self.system, self._scaled = spec, spec.system, scaled(spec.system)
        self.run = Recording()
        self.steps = _steps_of(scaled_trial(spec))
        self.done, self.counts = 0, Counter[str]()
        self.present: Array | None = None
        self.answer: Array | None = None
        self.time: float | None = None
        self.flight = InFlight(spec.system)
        self._rows = list(spec.system.learned_rows)
        self._measured = list(spec.system.measured_states or range(spec.system.n_states))
        steps = spec.system.horizon
        self.states = np.full((steps + 1, spec.system.n_states), np.nan)
        self.inputs, self.errors = np.zeros((steps, spec.system.n_inputs)), np.full(steps, np.nan)
        self._squares = np.zeros(spec.system.n_learned)
        self._told_of_plans, self.was_asked = False, True
        self._signs = Signs(spec)
        self.excess = np.zeros(spec.system.horizon)

    def do(self, event: Event) -> None:
        """Change by one event."""
        self.run.note(event, self.present, self.time, self.spec.system.dt)
        if "learn" in event:
            self._learn(event)
        elif "plan" in event:
            self.answer = np.array(event["plan"]) if self.answer is None else self.answer
            self.was_asked = not event.get("unasked")
        elif "missed" in event:
            self.counts["missed"] += 1
            self.answer = np.array(event["missed"])
        elif "begin" in event:
            x = np.array(event["begin"])
            self.counts["jumps"] += self.present is not None and not np.array_equal(x, self.present)
            if self.spec.system.n_measured and self.counts["jumps"] == MANY_JUMPS:
                _log.warning(
                    "%d times an input was asked for another measurement than the one told last, "
                    "and the states that are not measured were taken for 0: ask with the one told "
                    "last",
                    MANY_JUMPS,
                )
            self._hold_input(event["time"])
            self._move(x, event["time"])
        elif "gap" in event:
            self.counts["gaps"] += 1
            self._hold_input(event["time"])
            self.present = None  # after a gap the exploration goes on from any state
            self._move(np.array(event["gap"]), event["time"])
        elif "lost" in event:
            self.counts[event["lost"]] += 1
            if event["lost"] == "resets":
                self.flight.reset()
            else:
                self.flight.hold(self.answer, 0.0)
            self.present = self.answer = self.time = None
        elif "refit" in event:
            self._refit(event)
        elif "renewed" in event:
            self._renew()
        else:
            self.counts[event["counted"]] += 1

    def fit_request(self) -> FitRequest:
        """Return what a fit beside the exploration is given."""
        if self.steps.evidence is not None:
            return self.steps.evidence.request()
        if isinstance(self.spec.learner, GaussNewton):
            return self._samples(self.spec.learner)
        assert isinstance(self.spec.model, MLP)
        assert isinstance(self.spec.system, ExploredPlant)
        plant = self.spec.system.plant
        return plant, self.run.log(plant), self.spec.model.width, self.spec.seed

    @property
    def renewal(self) -> Renewal | None:
        """The posterior that is being made beside the one in force."""
        return self.steps.evidence.renewal if self.steps.evidence is not None else None

    @property
    def _trial(self) -> Trial:
        return self.steps.trial  # type: ignore[union-attr]  # of a learner of the kernel

    def _samples(self, learner: GaussNewton) -> FitRequest:
        from dopt.kernel.learners import Problem

        trial = self._trial
        features, targets = trial.state.window_features, trial.state.window_targets
        n = min(max(self.done, 1), features.shape[1])  # before the first step it is compiled
        ridge = trial.algorithm.learner[0] * learner.noise_variance
        kept = features[:, :n].copy(), targets[:, :n].copy()
        return Problem(trial.network, trial.state.prior, ridge, *kept), trial.state.theta.copy()

    def refitted(self, found: Found | Array, rows: int, *, beside: bool) -> Event:
        """Return the event of a fit to so many rows that comes into force, or is to be beside."""
        if isinstance(found, np.ndarray):
            event = {"refit": found.ravel().tolist(), "fitted": [], "rows": rows}
            return {**event, "beside": True} if beside and self.steps.evidence else event
        assert isinstance(self.spec.model, MLP)
        theta = found.parameters(self._scaled, self.spec.model.width, self.steps.parameters)
        event = {"refit": theta.tolist(), "fitted": found.fitted, "rows": rows}
        assert isinstance(self.spec.system, ExploredPlant)
        if found.supply < self.spec.system.plant.supply:
            event["supply"] = found.supply
        return event

    def _renew(self) -> None:
        evidence = self.steps.evidence
        assert evidence is not None
        assert evidence.renewal is not None
        evidence.renewal.finish()
        evidence.renewal = None
        self.counts["refits"] += 1

    def _refit(self, event: Event) -> None:
        evidence = self.steps.evidence
        if evidence is not None and event.get("beside"):
            evidence.begin_renewal(np.array(event["refit"]).reshape(evidence.numbers.shape))
            return
        self.counts["refits"] += 1
        if evidence is not None:
            numbers = np.array(event["refit"]).reshape(evidence.numbers.shape)
            evidence.take(numbers, event["rows"])
            return
        if isinstance(self.spec.learner, GaussNewton):
            self.steps.replace(np.array(event["refit"]), self._trial.plant.parameters)
            return
        assert isinstance(self.spec.system, ExploredPlant)
        system, plant = self.spec.system, self.spec.system.plant
        if "supply" in event:  # which the plant did not declare
            plant = dataclasses.replace(plant, supply=event["supply"])
            system = plant.system(system.horizon, scaled=system.scaled)
            self._signs.find_supply(self, event["supply"])
        self.system = dataclasses.replace(system, fitted=tuple(event["fitted"]))
        self._scaled = scaled(self.system)
        self.steps.replace(np.array(event["refit"]), np.array(event["fitted"][:-2]))
        self.flight = self.flight.retimed(self.system)

    def finish(self) -> None:
        """Do what is left of the tests for signs that the exploration fails."""
        self._signs.finish()

    def may_replay(self, event: Event) -> bool:
        """Return True if an event of a journal can follow the present state."""
        needs_state = event.keys() & {"learn", "plan", "missed"}
        follows = self.present is not None and self.done < self.spec.system.horizon
        whole = is_event(event, len(self._measured), self.spec.system.n_inputs)
        if "refit" in event:
            evidence, learner = self.steps.evidence, self.spec.learner
            fits = isinstance(learner, SimulationError | GaussNewton)
            sizes = len(self.steps.parameters), len(self.system.parameters) + 2
            if isinstance(learner, GaussNewton):
                fits, sizes = learner.fits_beside, (len(self.steps.parameters), 0)
            elif evidence is not None:
                fits, sizes = self.renewal is None, (evidence.numbers.size, 0)
            whole &= fits and (len(event["refit"]), len(event["fitted"])) == sizes
        whole &= "renewed" not in event or self.renewal is not None
        return whole and (follows or not needs_state)

    def replay(self, event: Event) -> None:
        """Do an event of a journal; a plan is made again, as the policy may remember it."""
        if "plan" in event:
            self.plan()
            self._compare(np.array(event["plan"]))
        self.do(event)

    def plan(self) -> None:
        """Plan the input at the state in which it will begin to act."""
        ahead = self.flight.ahead()
        if ahead is None:
            self.steps.plan_input(self.done)
            return
        inputs, seconds = self._scaled.of_inputs(ahead[0]), ahead[1]
        row = self.steps.states[self.done]
        present = row.copy()
        row[:] = self.steps.reached(self.done, inputs, seconds)
        try:
            self.steps.plan_input(self.done)
        finally:
            row[:] = present

    @property
    def planned(self) -> Array:
        """The input that it chose, (m,), as far as the supply can apply it."""
        return self.flight.cut(self.steps.inputs[self.done] * self._scaled.inputs)

    @property
    def waiting(self) -> Array:
        """Inputs that do not act yet, (n, m), the newest first."""
        return self.flight.waiting

    def _hold_input(self, time: float | None) -> None:
        """Move inputs in flight on to a state that did not follow within about dt.

        Without times, an input that was asked has been held for dt.
        """
        elapsed = None if self.present is None else self.spec.system.dt
        if self.present is not None and self.answer is None:
            elapsed = 0.0
        if self.time is not None and time is not None:
            elapsed = time - self.time
        self.flight.hold(self.answer, elapsed)

    def _move(self, x: Array, time: float | None) -> None:
        same = self.present is not None and np.array_equal(x, self.present)
        self.present, self.time, self.answer = x, time, None
        self._signs.restart(self.done)
        if not (same and self.spec.system.n_measured):  # then the estimate stays
            state = np.zeros(self.spec.system.n_states)
            state[self._measured] = x
            self.states[self.done] = state
            self.steps.begin(self.done, self._scaled.of_states(state))

    def _learn(self, event: Event) -> None:
        t, x, asked = self.done, np.array(event["learn"]), np.array(event["applied"])
        u, dt = self.flight.depart(asked), self._scaled.of_seconds(event["dt"])
        self.inputs[t], self.steps.inputs[t] = u, self._scaled.of_inputs(u)
        self.steps.measure(t, self._scaled.of_states(x, self._measured))
        self._watch_size(t, x, u, dt)
        error = self._error(t, dt)
        finite = self.steps.take_in(t, dt)
        if self.renewal is not None:
            self.renewal.note()
        unit = 1.0 if self.spec.system.n_measured else float(self._scaled.accelerations[0])
        self.errors[t] = self.steps.errors[t] * unit if error is None else error
        estimated = self.steps.states[t + 1] * self._scaled.states
        self.states[t + 1] = estimated if self.spec.system.n_measured else x
        if u is not asked:
            self.steps.note_asked(self._scaled.of_inputs(asked))
        if self.spec.limits is not None:
            reached = self.states[t + 1 : t + 2]
            self.excess[t] = self.spec.limits.excess(self.spec.system, reached)[0]
        self.done += 1
        self.counts["learned"] += 1
        self.present, self.time = x, event["time"]
        self._signs.learned(self, event, dt)
        self.answer = None
        if not finite:
            raise ExplorationError(
                f"the parameters are not finite after {self.done} steps: lower the learning rate, "
                f"or raise the regularization, and begin another journal."
            )

    def accelerations(self, following: Array, u: Array, dt: float) -> Array:
        """Return the accelerations that are observed from x_t to the next state, (r,), scaled.

        Where states are measured with noise they are not: 0 is returned.
        """
        if self.spec.system.n_measured:
            return np.zeros(len(self._rows))
        system, x, rows = self._scaled.system, self.steps.states[self.done], self._rows
        change, u = self._scaled.of_states(following) - x, self._scaled.of_inputs(u)
        with np.errstate(all="ignore"):
            known = np.array(system.known(tuple(x), tuple(u), system.parameters), dtype=float)
            seen: Array = change[rows] / dt - known[rows]
        return seen

    def _error(self, t: int, dt: float) -> float | None:
        """Return the error of accelerations that have several units; None if they have one."""
        units = self._scaled.accelerations
        if self.spec.system.n_measured or (units == units[0]).all():
            return None
        x, following = self.steps.states[t : t + 2]
        u, system = self.steps.inputs[t], self._scaled.system
        predict = functools.partial(self.spec.model.predict, system, self.steps.parameters)
        rate = functools.partial(rates, system, predict, u[None])
        with np.errstate(all="ignore"):
            missed = following - next_state(system.integrator, rate, x[None], dt)[0]
        return float(np.linalg.norm(units * missed[self._rows] / dt))

    def _watch_size(self, t: int, following: Array, u: Array, dt: float) -> None:
        """Warn once where the first accelerations are of another size than a network learns."""
        system = self.spec.system
        if t >= SIZED_STEPS or not isinstance(self.spec.model, MLP) or system.n_measured:
            return
        self._squares += self.accelerations(following, u, dt) ** 2
        if t == SIZED_STEPS - 1:
            sizes, where = np.sqrt(self._squares / SIZED_STEPS), f"over the first {t + 1} steps"
            units = self._scaled.accelerations if self._scaled.is_scaled else None
            self.counts["out_of_scale"] += warn_of_sizes(system, sizes, where, _UNITS, units)

    def _compare(self, planned: Array) -> None:
        """Warn once if a replayed plan differs from the recorded one."""
        if not np.array_equal(self.planned, planned) and not self._told_of_plans:
            self._told_of_plans = True
            _log.warning(
                "step %d of the journal is planned as %s here, but was planned as %s: another "
                "version or processor wrote it, or the policy plans for a limited time. The answer "
                "was the latter, and what was learned agrees to rounding",
                *(self.done, self.planned, planned),
            )


def _steps_of(spec: TrialSpec) -> Steps:
    if spec.config.path == "reference":
        from dopt.reference.batch import ReferenceSteps

        return ReferenceSteps(spec)
    from dopt.kernel.run import KernelSteps

    return KernelSteps(spec)
