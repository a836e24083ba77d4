"""Adam on minibatches of a buffer: which samples they are made of, and the steps they lead to."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch.func import grad, vmap

from dopt.kernel.run import KernelTrial
from dopt.randomness import draw
from tests.dopt.kernel.twin import observed
from tests.dopt.torch_models import model_of_one
from tests.dopt.trials import trial

REPLAY: dict[str, Any] = {"name": "adam_replay", "batch": 5, "steps": 3, "capacity": 7}
"""A buffer shorter than the trials, so that it goes round."""


def test_the_places_depend_on_the_seed_alone_and_move_no_other_draw() -> None:
    one, two = (draw(trial("arm", policy, 5, learner=REPLAY)) for policy in ("random", "uniform"))
    other, without = (
        draw(trial("arm", "random", 6, learner=REPLAY)),
        draw(trial("arm", "random", 5)),
    )
    assert np.array_equal(one.replay, two.replay)
    assert not np.array_equal(one.replay, other.replay)
    assert without.replay.size == 0
    for name in ("noise", "weights", "inputs", "components", "ties"):
        assert np.array_equal(getattr(one, name), getattr(without, name)), name


def test_every_place_that_holds_a_sample_is_drawn_alike() -> None:
    learner = REPLAY | {"batch": 4_000, "capacity": 10}
    places = draw(trial("pendulum", "random", learner=learner)).replay
    assert places.shape == (30, 3, 4_000)
    for t in (0, 3, 9, 29):
        filled = min(t + 1, 10)
        counts = np.bincount(places[t].ravel(), minlength=filled)
        assert len(counts) == filled
        assert counts * filled / 12_000 == pytest.approx(1.0, abs=0.2)


def test_a_step_follows_the_gradient_over_the_newest_samples_in_the_drawn_places() -> None:
    learner = REPLAY | {"beta_1": 0.0, "steps": 1}
    spec = trial("quadrotor", "random", 1, env={"horizon": 20}, learner=learner)
    fast, model, places = (
        KernelTrial(spec),
        model_of_one(spec.system, spec.model),
        draw(spec).replay,
    )

    def loss(theta: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return (vmap(model, in_dims=(None, 0))(theta, x) - y).square().sum(-1).mean()

    kept: dict[int, int] = {}
    for t in range(20):
        before = torch.tensor(fast.state.theta)
        fast.advance(t + 1)
        kept[t % 7] = t
        times = [kept[place] for place in places[t, 0].tolist()]
        states, targets = map(torch.tensor, (fast.record.states, observed(fast, t + 1)))
        expected = grad(loss)(before, states[times], targets[times])
        scale = float(expected.abs().max())
        # Without momentum the first moment of Adam is the gradient itself.
        assert fast.state.moment_1 == pytest.approx(expected.numpy(), rel=0.0, abs=1e-9 * scale)


def test_an_absurd_learning_rate_ends_a_trial() -> None:
    fast = KernelTrial(trial("pendulum", "random", learner=REPLAY | {"learning_rate": 1e300}))
    fast.advance(30)
    assert fast.diverged_at is not None
