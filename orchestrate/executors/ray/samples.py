"""Way of samples from Ray's workers to the driver: an actor that keeps them until they are taken.

The outcomes of a task come as a stream of its own, which says nothing while a trial runs.
"""

from __future__ import annotations

import time
from typing import Any

import ray
from ray.exceptions import RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from orchestrate.executors.live import Live
from orchestrate.records import Sample

Channel = tuple[float, Any]
"""Time between two samples [s] and the actor that collects them, as a worker gets them."""


class Kept:
    """Samples that have come since the last call of ``take``."""

    def __init__(self) -> None:
        self._samples: list[Sample] = []

    def put(self, sample: Sample) -> None:
        self._samples.append(sample)

    def take(self) -> list[Sample]:
        samples, self._samples = self._samples, []
        return samples


class Inbox:
    """Driver's side. The actor runs on the driver's machine and takes no core of it."""

    def __init__(self, seconds: float) -> None:
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        options: dict[str, Any] = {"num_cpus": 0, "scheduling_strategy": here}
        actor: Any = ray.remote(**options)(Kept)
        self.channel: Channel = (seconds, actor.remote())
        self._answer: Any = None
        self._next = 0.0

    def take(self) -> list[Sample]:
        """Return the samples that have arrived; never wait, and lose them if Ray is lost."""
        if self._answer is None:
            if time.monotonic() >= self._next:
                self._next = time.monotonic() + self.channel[0]
                self._answer = self.channel[1].take.remote()
            return []
        try:
            if not ray.wait([self._answer], timeout=0)[0]:
                return []
            answer, self._answer = self._answer, None
            samples: list[Sample] = ray.get(answer)
        except RayError:
            return []
        return samples


def live_to(channel: Channel | None) -> Live | None:
    """Return the worker's side, which sends without waiting."""
    if channel is None:
        return None
    seconds, actor = channel
    return Live(seconds, lambda sample: actor.put.remote(sample))
