"""The sampling planner: what its settings mean."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dopt.errors import IncompatibleError
from dopt.kernel.search.sampling import domain_weight
from dopt.policies.task_states import domain_box
from dopt.run import run_trial
from dopt.systems import SYSTEMS
from tests.dopt.kernel.calls import interpreted
from tests.dopt.oracles.traces import jacobian
from tests.dopt.trials import trial

SMALL = {"lookahead": 7, "hold": 3, "stride": 2, "plans": 9, "iterations": 2, "elites": 3}
GAUSS_NEWTON = {"name": "gauss_newton"}


def test_outside_of_the_domain_rows_count_less() -> None:
    """Beside a box that is never left nothing changes, and one that is does make a difference."""
    inputs = {}
    for name, half_widths in (("wide", (7.0, 1e6)), ("narrow", (0.02, 0.02))):
        for domain in ("everywhere", "box"):
            fields = SMALL | {"domain": domain, "lookahead": 12, "stride": 6}
            env = {"grid_half_widths": half_widths, "horizon": 14}
            spec = trial("pendulum", "icem", 3, env=env, policy=fields)
            inputs[name, domain] = run_trial(spec).inputs
    assert np.array_equal(inputs["wide", "box"], inputs["wide", "everywhere"])
    assert not np.array_equal(inputs["narrow", "box"], inputs["narrow", "everywhere"])


def test_the_weight_of_a_state_falls_with_its_distance_from_the_box_on_the_circle() -> None:
    system = SYSTEMS["arm"]()
    domain, half = domain_box(system, "box"), np.array(system.grid_half_widths)
    weight = interpreted(domain_weight)
    assert weight(domain, half) == 1.0
    assert weight(domain, half * [1.25, 1.0, 1.0, 1.0]) == pytest.approx(math.exp(-0.5))
    turned = half + np.array([2 * math.pi, 0.0, -2 * math.pi, 0.0])
    assert weight(domain, turned) == pytest.approx(1.0)


def test_where_every_plan_leaves_the_bounds_chance_decides() -> None:
    spec = trial("pendulum", "icem", 3, env={"state_limit": 3.2}, policy=SMALL)
    inputs = run_trial(spec).inputs
    assert np.abs(np.abs(inputs[np.isfinite(inputs)]) - spec.system.gamma).max() < 1e-12


def test_it_gathers_more_information_than_held_random_inputs() -> None:
    gained = []
    for policy, fields in (
        ("icem", {"lookahead": 20, "hold": 5, "stride": 5}),
        ("random_held", {}),
    ):
        spec = trial("arm", policy, 5, env={"horizon": 100}, policy=fields, learner=GAUSS_NEWTON)
        result = run_trial(spec)
        J = np.concatenate(jacobian(spec, result.parameters, result.states[:100]))
        gained.append(np.linalg.slogdet(1e-3 * np.eye(J.shape[1]) + J.T @ J)[1])
    assert gained[0] > gained[1] + 20.0


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"lookahead": 31}, "policy.lookahead is 31 steps, but a trial of env 'pendulum' has 30"),
        ({"stride": 8}, "policy.stride is 8 steps, but the plans have 7"),
        ({"elites": 10}, "policy.elites is 10, but an iteration draws 9 plans"),
    ],
)
def test_settings_that_make_no_plan_are_refused(fields: dict[str, int], sentence: str) -> None:
    with pytest.raises(IncompatibleError, match=sentence):
        trial("pendulum", "icem", policy=SMALL | fields)
