"""From a trial's specification to the compiled loop and back."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from dopt.errors import SpecificationError
from dopt.kernel import arguments as args
from dopt.kernel.equations import compiled_equations
from dopt.kernel.loop import compiled_loop, compiled_search
from dopt.kernel.points import own_targets
from dopt.kernel.setup import constants, empty_record, initial_state
from dopt.randomness import draw
from dopt.result import TrialResult
from dopt.spec import TrialSpec

FIRST_STEPS = 300
"""Steps of a trial before it is known what a step costs; those of the paper have no more."""

PIECE_SECONDS = 1.0
"""How often compiled code comes back to the interpreter, which can then heed a signal."""


class KernelTrial:
    """A trial in the compiled kernel, which can be advanced in pieces and looked at in between.

    Attributes
    ----------
    state, record : State, Record
        Arrays that :meth:`advance` writes in place.
    done : int
        Number of steps done.
    diverged_at : int or None
        Step at which the trial diverged.
    """

    def __init__(self, spec: TrialSpec) -> None:
        self.spec = spec
        *shared, points = constants(spec.cell)
        self.constants = (*shared, own_targets(points))
        draws = draw(spec)
        self.randomness = args.Randomness(*_fields(draws, args.Randomness))
        self.state = initial_state(spec, draws.weights)
        self.record = empty_record(spec.system)
        self.done = 0
        self.diverged_at: int | None = None

    @property
    def parameters(self) -> args.Floats:
        """Parameters of the model, (q,)."""
        return self.state.theta

    @property
    def states(self) -> args.Floats:
        """States x_0 ... x_T, (T + 1, d); NaN where the trial has not come yet."""
        return self.record.states

    def advance(self, last: int) -> None:
        """Run the steps up to ``last``, unless they are done or the trial has diverged.

        Raises
        ------
        SpecificationError
            If ``last`` lies beyond the horizon.
        """
        if last > self.spec.system.horizon:
            raise SpecificationError(
                f"step {last} was asked for, but the horizon is {self.spec.system.horizon}: raise "
                f"env.horizon."
            )
        if self.diverged_at is not None or last <= self.done:
            return
        world, network, rules, points = self.constants
        equations = compiled_equations(self.spec.system)
        call = (world, network, rules, self.randomness, points, self.state, self.record)
        loop, search = compiled_loop(call), compiled_search(call)
        self.done = int(loop(*equations, search, *call, self.done, last))
        if self.done < last:
            self.diverged_at = self.done


def run_trial_in_kernel(spec: TrialSpec) -> TrialResult:
    """Run a whole trial in compiled code."""
    wall, cpu = time.perf_counter(), time.process_time()
    trial = KernelTrial(spec)
    checkpoints = {}
    for step in spec.assessed_steps:
        _advance_in_pieces(trial, step)
        if trial.diverged_at is None:
            checkpoints[step] = trial.state.theta.copy()
    _advance_in_pieces(trial, spec.system.horizon)
    record, end = trial.record, trial.diverged_at
    if end is not None:
        for rows in record:
            rows[end:] = np.nan
    return TrialResult(
        **record._asdict(),
        parameters=trial.state.theta.copy(),
        diverged_at=end,
        wall_seconds=time.perf_counter() - wall,
        cpu_seconds=time.process_time() - cpu,
        checkpoints=checkpoints,
    )


def _advance_in_pieces(trial: KernelTrial, last: int) -> None:
    """Run a trial up to a step; the numbers do not depend on where it is cut."""
    steps = FIRST_STEPS
    while trial.done < last and trial.diverged_at is None:
        before, start = trial.done, time.perf_counter()
        trial.advance(min(last, before + steps))
        rate = (trial.done - before) / (time.perf_counter() - start)
        steps = max(1, int(rate * PIECE_SECONDS))


def _fields(source: object, kind: Any) -> list[Any]:
    return [getattr(source, name) for name in kind._fields]
