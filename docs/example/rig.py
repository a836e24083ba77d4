"""A motor at the other end of a network, explored at 200 Hz: ``python docs/example/rig.py``.

The motor runs as a process of its own and stands for the rig of a laboratory. It turns an
unbalanced disk with dry friction, measures at times that jitter, and sends its state and the
voltage that it applied as datagrams, of which some are lost in either direction. Each of the two
processes may be killed and started again: the journal goes on.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import random
import socket
import struct
import subprocess
import sys
import threading
import time

import numpy as np

from dopt import Explorer, Plant
from dopt.errors import DoptError

DT = 0.005  # s
PATIENCE = 30.0  # s, for the first state
MOTOR = Plant(
    states={"angle": "rad", "rate": "rad/s"},
    inputs={"voltage": "V"},
    dt=DT,
    gamma=6.0,
    known={"angle": "rate", "rate": "gain * voltage"},
    constants={"gain": 40.0},
    learned=["rate"],
    angles=["angle"],
    box={"rate": 30.0},
)

STATE = struct.Struct("<qdddd")  # process, time, angle, rate, mean voltage since the last one
COMMAND = struct.Struct("<d")


def run_motor(port: int, loss: float, jitter: float) -> None:
    """Turn the motor in real time, and send its state to a port of this machine."""
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wire.connect(("127.0.0.1", port))
    angle = rate = voltage = area = 0.0
    measured = now = tick = time.monotonic()
    while True:
        tick = max(tick + DT, now + DT / 2)  # after a pause of this process it does not catch up
        planned = tick + DT * random.uniform(-jitter, jitter)
        while now < planned:
            wire.settimeout(max(planned - time.monotonic(), 1e-4))
            command = _received(wire, COMMAND.size, loss)
            before, now = now, min(max(time.monotonic(), now), planned + DT)
            area += voltage * (now - before)
            angle, rate = _moved(angle, rate, voltage, now - before)
            if command is not None:
                voltage = COMMAND.unpack(command)[0]
        mean, measured, area = area / (now - measured), now, 0.0
        if random.random() >= loss:
            with contextlib.suppress(ConnectionRefusedError):  # nobody listens yet
                wire.send(STATE.pack(os.getpid(), now, angle, rate, mean))


def _received(wire: socket.socket, size: int, loss: float) -> bytes | None:
    try:
        datagram = wire.recv(size)
    except (TimeoutError, ConnectionRefusedError):
        return None
    return datagram if random.random() >= loss else None


def _moved(angle: float, rate: float, voltage: float, seconds: float) -> tuple[float, float]:
    """Return the state after some seconds: gravity, viscous and dry friction."""
    steps = max(1, math.ceil(seconds / 2e-4))
    h = seconds / steps
    for _ in range(steps):
        friction = 2.0 * rate + 6.0 * math.tanh(rate / 0.1)
        rate += h * (40.0 * voltage - 60.0 * math.sin(angle) - friction)
        angle += h * rate
    return angle, rate


def explore(wire: socket.socket, explorer: Explorer, seconds: float) -> np.ndarray:
    """Answer states, for some seconds from the first; return the time that each answer took."""
    latencies: list[float] = []
    end, motor = time.monotonic() + PATIENCE, None
    wire.settimeout(1.0)
    while time.monotonic() < end:
        try:
            datagram, rig = wire.recvfrom(STATE.size)
        except TimeoutError:
            continue  # the motor is not there
        start = time.perf_counter()
        if not latencies:
            end = time.monotonic() + seconds
        process, clock, angle, rate, voltage = STATE.unpack(datagram)
        if motor not in (None, process):
            explorer.reset()  # another process, at rest
        motor = process
        explorer.tell([angle, rate], applied=[voltage], time=clock)
        wire.sendto(COMMAND.pack(*explorer.ask([angle, rate], time=clock)), rig)
        latencies.append(time.perf_counter() - start)
    return np.array(latencies)


def save(explorer: Explorer, url: str | None) -> None:
    """Save what there is; a database that fails does not end the exploration."""
    try:
        if url:
            explorer.save(url)
    except DoptError as error:
        print(error, file=sys.stderr, flush=True)


def save_each_second(explorer: Explorer, url: str | None, ended: threading.Event) -> None:
    """Save beside the loop, which does not wait for a disk."""
    while not ended.wait(1.0):
        save(explorer, url)


def draw(latencies: np.ndarray, path: str) -> None:
    """Draw the histogram of the seconds that answers took."""
    import matplotlib.pyplot as plt

    ms = 1e3 * latencies
    median, high, longest = np.percentile(ms, [50, 99, 100])
    figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
    axes.hist(ms, np.linspace(0.0, max(longest, 6.0), 120), log=True)
    axes.axvline(1.0, color="C1", linestyle="--", label="target 1 ms")
    axes.axvline(1e3 * DT, color="C3", label=f"step {1e3 * DT:g} ms")
    axes.set(xlabel="time of an answer [ms]", ylabel="answers")
    axes.set_title(
        f"{len(ms):,} answers: median {median:.2g} ms, p99 {high:.2g} ms, longest {longest:.2g} ms"
    )
    axes.legend()
    figure.savefig(path)


def main() -> None:
    """Start the motor and explore it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="from the first state")
    parser.add_argument("--journal", default="rig.jsonl")
    parser.add_argument("--loss", type=float, default=0.01, help="share of lost datagrams")
    parser.add_argument("--jitter", type=float, default=0.1, help="share of dt")
    parser.add_argument("--save", metavar="URL", help="results database, saved to once a second")
    parser.add_argument("--histogram", metavar="FILE", help="picture of the times of the answers")
    parser.add_argument("--port", type=int, default=0, help="of the explorer")
    parser.add_argument("--role", choices=("both", "motor", "explorer"), default="both")
    given = parser.parse_args()
    if given.role == "motor":
        run_motor(given.port, given.loss, given.jitter)
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wire.bind(("127.0.0.1", given.port))
    settings = {"steps": 60_000, "journal": given.journal, "fsync": False, "deadline": 0.8 * DT}
    with Explorer(MOTOR, **settings) as explorer:
        print(f"{explorer.n_steps} steps in the journal", flush=True)
        save(explorer, given.save)  # opens the database before the first state
        ended, motor = threading.Event(), None
        saver = threading.Thread(target=save_each_second, args=(explorer, given.save, ended))
        saver.start()
        if given.role == "both":
            port = str(wire.getsockname()[1])
            rest = ["--loss", str(given.loss), "--jitter", str(given.jitter)]
            command = [sys.executable, __file__, "--role", "motor", "--port", port, *rest]
            motor = subprocess.Popen(command)
        try:
            latencies = explore(wire, explorer, given.seconds)
        finally:
            if motor is not None:
                motor.kill()
                motor.wait()
            ended.set()
            saver.join()
        save(explorer, given.save)
        if not len(latencies):
            raise SystemExit(f"no measurement came within {PATIENCE:g} s: start the motor.")
        median, high, longest = np.percentile(1e6 * latencies, [50, 99, 100])
        print(f"{len(latencies)} answers: {median:.0f} µs, p99 {high:.0f}, longest {longest:.0f}")
        print(explorer.counts)
        if given.histogram:
            draw(latencies, given.histogram)
        print(f"error of the acceleration: {np.median(explorer.errors[-1000:]):.3g} rad/s²")


if __name__ == "__main__":
    main()
