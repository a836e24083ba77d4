"""Fits of the simulation beside an exploration, by a process of its own.

The process is given the plant and what was measured so far, and answers with the constants, the
delay, the lag and the network that :func:`dopt.fit` has found, as long as the rig needs for it: the
exploration goes on. A network of the fit sees states by their seen ranges, and one of the kernel
scaled numbers; both are affine in a state, so that the weights of one are the weights of the other.
"""

from __future__ import annotations

import contextlib
import math
import os
import pickle
import subprocess
import sys
import threading
import weakref
from array import array
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dopt.errors import ExplorationError, SpecificationError
from dopt.explorer.journal import Event
from dopt.log import Log, Piece
from dopt.spec.scaled import Scaled
from dopt.systems.plant import Plant, unknown
from dopt.types import Array

if TYPE_CHECKING:
    from dopt.kernel.evidence import Request, Samples  # which loads the compiler
    from dopt.kernel.learners import Problem

    FitRequest = tuple[Plant, Log, int, int] | Request | tuple[Samples | Problem, Array]
    """Request of a fit: plant, log, units of the network, seed; samples of processes, or these
    with the numbers that they are to have; or a network with its samples, and the parameters to
    begin with."""


class Recording:
    """Measurements and applied inputs of an exploration, in pieces without gaps.

    Attributes
    ----------
    rows : int
        Learned steps in all pieces.
    fitted : int
        Rows of the last fit that came into force, 0 without one.
    """

    def __init__(self) -> None:
        self._pieces: list[tuple[array[float], array[float], array[float]]] = []  # row by row
        self._ended = True
        self.rows = self.fitted = 0

    def note(self, event: Event, present: Array | None, time: float | None, dt: float) -> None:
        """Take in an event, given the state before it, its time, and the time of a sample."""
        if "learn" in event:
            assert present is not None
            if self._ended:
                self._pieces.append((array("d", [0.0]), array("d", present), array("d")))
                self._ended = False
            times, measured, inputs = self._pieces[-1]
            times.append(times[-1] + event["dt"])
            measured.extend(event["learn"])
            inputs.extend(event["applied"])
            self.rows += 1
        elif "begin" in event:
            again = present is not None and event["begin"] == present.tolist()
            late = 0.0 if event["time"] is None or time is None else event["time"] - time
            if again and not self._ended and 0.0 <= late < 0.5 * dt:
                self._pieces[-1][0][-1] += late  # the same state, with the time of the question
            else:
                self._ended = True
        elif "gap" in event or "lost" in event:
            self._ended = True
        elif "refit" in event:
            self.fitted = event["rows"]

    def log(self, plant: Plant) -> Log:
        """Return the log; the input of the last row of a piece is the one before it."""
        if not self._pieces:
            raise SpecificationError(
                "nothing was learned yet, but a log has two rows or more: ask() and tell() first."
            )
        states = [name for name in plant.states if name in plant.measured] or [*plant.states]
        pieces = []
        for time, measured, inputs in self._pieces:
            rows, held = len(time), inputs[-len(plant.inputs) :]
            y, u = (np.array(part).reshape(rows, -1) for part in (measured, inputs + held))
            pieces.append(Piece(np.array(time), y, u))
        return Log.of_pieces(states, [*plant.inputs], pieces)


class Found(NamedTuple):
    """Result of a fit, in the units of the plant."""

    constants: Array  # (c,)
    delay: float
    lag: float
    weights: Array  # W₁ (w, p), b₁ (w), W₂ (r, w), b₂ (r); empty without a network
    centers: Array  # (p,)
    scales: Array  # (p,)
    sizes: Array  # (r,)
    supply: float = math.inf  # by which inputs are cut, where the plant declares none

    @property
    def fitted(self) -> list[float]:
        """Constants, delay and lag."""
        return [*self.constants.tolist(), max(self.delay, 0.0), self.lag]

    def parameters(self, scaled: Scaled, width: int, present: Array) -> Array:
        """Return the parameters of a network in scaled numbers, (q,).

        Without a network its output layer is 0, and the first one as it is at present.
        """
        system = scaled.system
        features, p = system.features, len(system.features)
        first, last = width * p + width, present.copy()
        last[first:] = 0.0
        if not len(self.weights):
            return last
        divisors, by_state = np.array(system.feature_scales), np.zeros(p, bool)
        by_state[:] = [feature.kind == "identity" for feature in features]
        units = np.array([scaled.states[feature.index] for feature in features])
        gain = np.where(by_state, units / self.scales, 1.0) * divisors
        shift = np.where(by_state, -self.centers / self.scales, 0.0)
        W1 = self.weights[: width * p].reshape(width, p)
        b1, outputs = self.weights[width * p : first], self.weights[first:]
        sizes = self.sizes / scaled.accelerations
        of_rows = np.concatenate([np.repeat(sizes, width), sizes])
        return np.concatenate([(W1 * gain).ravel(), b1 + W1 @ shift, outputs * of_rows])


def first_evidence() -> Request:
    """Return a small fit of the evidence."""
    from dopt.kernel.evidence import Request

    y = np.sin(np.arange(4.0))
    return Request(y[None], y[None], np.ones(4), np.ones((1, 1, 5)), None)


def first_simulation() -> tuple[Plant, Log, int, int]:
    """Return a small fit: dx/dt = -a x + u."""
    u, fall = np.sign(np.sin(np.arange(150.0))), np.exp(-0.1 * np.arange(150.0))
    x = np.append(0.0, np.convolve(u, (1.0 - fall[1]) * fall)[:149])
    plant = Plant(
        states={"x": "m"},
        inputs={"u": "m/s"},
        dt=0.1,
        gamma=1.0,
        known={"x": "u - a * x"},
        constants={"a": unknown(1.0)},
        learned=["x"],
        box={"x": 1.0},
        delay=unknown(0.0, spread=0.1),
        lag=unknown(0.01),
    )
    pieces = [Piece(0.1 * np.arange(150.0), x[:, None], u[:, None])]
    return plant, Log.of_pieces(["x"], ["u"], pieces), 1, 0


class FitBeside:
    """A process that fits one log at a time.

    Attributes
    ----------
    rows : int
        Rows of the log that was given last.
    """

    def __init__(self, *first: FitRequest) -> None:
        self.rows = 0
        self._thread = ThreadPoolExecutor(1, "fit")
        self._starting, self._is_closed = threading.Lock(), False
        self._process: subprocess.Popen[bytes] | None = None
        self._answer: Future[Any] | None = None
        for request in first:  # compiled before the first fit is due
            self._thread.submit(self._ask, request)

    @property
    def is_running(self) -> bool:
        return self._answer is not None

    @property
    def is_ready(self) -> bool:
        return self._answer is not None and self._answer.done()

    def begin(
        self, request: FitRequest, rows: int, then: Callable[[Any], None] | None = None
    ) -> None:
        """Begin a fit to so many rows, after which another thread does something with it."""
        self.rows = rows
        self._answer = self._thread.submit(self._ask, request, then)

    def take(self) -> Any:
        """Wait for what the fit has found, or for the sentence that says why there is nothing."""
        assert self._answer is not None
        answer, self._answer = self._answer, None
        return answer.result()

    def _ask(self, request: FitRequest, then: Callable[[Any], None] | None = None) -> Any:
        with self._starting:
            if self._is_closed:
                return "the exploration is closed"
            if self._process is None or self._process.poll() is not None:
                self._process = _started()
                weakref.finalize(self, _end, self._process)
        assert self._process.stdin
        assert self._process.stdout
        try:
            pickle.dump(request, self._process.stdin)
            self._process.stdin.flush()
            answer = pickle.load(self._process.stdout)  # of our own process
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            _end(self._process)
            return f"its process has ended ({type(error).__name__}); another one begins"
        if then is not None and not isinstance(answer, str):
            then(answer)
        return answer

    def close(self) -> None:
        """End the process, whatever it does."""
        with self._starting:
            self._is_closed = True
            if self._process is not None:
                self._process.kill()
        self._thread.shutdown(cancel_futures=True)
        if self._process is not None:
            _end(self._process)


def _started() -> subprocess.Popen[bytes]:
    paths = os.pathsep.join(path for path in sys.path if path)
    try:
        return subprocess.Popen(
            [sys.executable, "-c", "from dopt.explorer.fit_service import serve; serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": paths},
        )
    except OSError as error:
        raise ExplorationError(
            f"the process that fits beside the exploration cannot be started ({error}): free "
            f"memory, or choose another learner."
        ) from error


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    with contextlib.suppress(OSError):
        process.communicate()  # closes the pipes, and waits
