"""Checks before a trial runs: names, numbers, scales and memory."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from dopt.errors import ScaleWarning, SpecificationError
from dopt.kernel.from_spec import empty_record, initial_state
from dopt.randomness import draw
from dopt.spec.config import LARGEST_HORIZON
from dopt.spec.custom_system import check_system, warn_of_scale
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, Feature, Pendulum, System
from dopt.systems.elementary import where
from tests.dopt.trials import PAIRS, covering, trial


def quadratic(state: Any, parameters: Any) -> tuple[Any, ...]:
    return (-(parameters[3] ** 2) * state[1],)


def divided(state: Any, parameters: Any) -> tuple[Any, ...]:
    return (-state[1] / parameters[3],)


def of_the_product(state: Any, parameters: Any) -> tuple[Any, ...]:
    return (-parameters[1] * parameters[3] * state[1],)


def broken_system(**attributes: Any) -> System:
    """Return a pendulum of another class, with some of its attributes replaced."""
    functions = {
        name: staticmethod(value) if callable(value) else value
        for name, value in attributes.items()
    }
    made: Any = dataclass(frozen=True, kw_only=True)(type("Broken", (Pendulum,), functions))
    system: System = made()
    return system


def known(rate: Callable[[Any, Any], Any]) -> Any:
    """Return a known part, in whose place that of the rate stands."""
    return lambda state, inputs, *_: (state[1], rate(state, inputs))


LINEAR = "linear_parameters"
MISSPELT = ("mass", "lenth", "gravity", "friction")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        (LINEAR, ("frition",), "of env 'pendulum' names 'frition', .* did you mean 'friction'"),
        ("physical", MISSPELT, "names 'lenth', but Broken has no attr.* lenth: float = pa"),
        ("accelerations", quadratic, "not affine in them"),
        ("accelerations", divided, "not affine in them"),
        ("accelerations", of_the_product, "are length, friction, but .* not affine in them"),
        ("accelerations", lambda x, *_: (1.0 / x[1],), r"gives inf for the derivative of .* at the "
         r"initial state, .* = 0.001, .* = 0, but a finite number is expected: .*initial_state"),
        ("accelerations", lambda x, *_: ((x[1] + 1.5) ** 0.5,),
         r"gives nan .* at a state of the evaluation grid, .* = -.*, .* env\.grid_half_widths"),
        ("known", known(lambda x, u: u[0] / x[1]), r"^known\(\) .* gives nan .* initial state"),
        ("learned_rows", (5,), r"of env 'pendulum' holds 5, but its 2 states .* 0 to 1"),
        ("learned_rows", (1, 1), r"of env 'pendulum' are \(1, 1\), but no row twice"),
        ("features", (Feature("cos", 7),), "features of env 'pendulum' holds 7"),
        ("features", (("cos", 0),), r"hold \('cos', 0\), .* Feature\('cos"),
        ("features", (Feature("tan", 0),), "kind='tan', .* of the kinds identity, cos, sin"),
        ("phase_plane", (0, -1), "phase_plane of env 'pendulum' holds -1"),
        ("accelerations", lambda x, *_: (x[0], x[1]), "returns 2 numbers, but a tuple of 1 is"),
        ("accelerations", lambda x, *_: -x[1], "one number, but a tuple of 1 is .* with its comma"),
        ("accelerations", lambda *_: None, r"accelerations\(\) .* fails .*TypeError"),
        ("accelerations", lambda x, *_: (math.sin(x[0]),), r"fails for arrays .*\.elementary"),
        ("accelerations", lambda x, *_: (1.0,) if x[1] > 0 else (-1.0,),
         r"fails for arrays of 5 states \(ValueError"),
        ("known", lambda *_: 0.0, r"known\(\) .* returns one number, but a tuple of 2 is expected"),
        ("known", lambda x, *_: (x[1],), "returns 1 numbers, .* of 2 .* for each state: correct"),
        ("known", known(lambda _, u: u[0] ** 2), "is not affine in the inputs"),
        ("known", known(lambda _, u: abs(u[0])), "is not affine in the inputs"),
    ],
)  # fmt: skip
def test_what_is_no_system_is_refused(name: str, value: Any, sentence: str) -> None:
    given = {name: value} | ({"compiled": False} if "inf" in sentence else {})
    if value in (quadratic, divided):
        given[LINEAR] = ("friction",)
    if value is of_the_product:
        given[LINEAR] = ("length", "friction")
    with pytest.raises(SpecificationError, match=sentence):
        check_system(broken_system(**given))


def test_a_product_is_affine_in_each_parameter_alone() -> None:
    check_system(broken_system(accelerations=of_the_product, linear_parameters=("friction",)))


@pytest.mark.filterwarnings("error")
def test_a_pole_that_no_trial_begins_at_and_no_grid_has_is_accepted() -> None:
    check_system(broken_system(accelerations=lambda x, *_: (where(x[1] > 50, np.inf, 0.0),)))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", sorted(SYSTEMS))
def test_what_is_shipped_is_sound_and_has_the_size_of_a_network(name: str) -> None:
    check_system(SYSTEMS[name]())
    warn_of_scale(SYSTEMS[name](), trial("pendulum", "random").model)


def test_the_number_and_the_unit_are_said() -> None:
    fast = broken_system(accelerations=lambda state, *_: (1e4 * state[1],))
    with pytest.warns(ScaleWarning, match=r"\[rad/s\] in env 'pendulum' has a root mean") as caught:
        dataclasses.replace(trial("pendulum", "random").config, system=fast)
    assert str(caught[0].message).endswith("times as large.")


def size(item: Any) -> int:
    """Return the bytes of all arrays in nested tuples."""
    if isinstance(item, np.ndarray):
        return item.nbytes
    return sum(map(size, item)) if isinstance(item, tuple) else 0


def held(spec: TrialSpec) -> int:
    """Return the bytes of what a trial is made of in the kernel, its evaluation aside."""
    draws = draw(spec)
    arrays = (draws.noise, draws.inputs, draws.components, draws.ties)
    record = empty_record(spec.system)
    return size(arrays) + size(record) + size(initial_state(spec, draws.weights, record))


@pytest.mark.parametrize(("env", "policy"), covering(PAIRS))
def test_a_usual_trial_needs_little(env: str, policy: str) -> None:
    assert trial(env, policy, env={"horizon": 500}).config.memory < 2**26


LEAST_SQUARES = {"learner": {"name": "recursive_least_squares"}}
FRESH = {"policy": {"information": "fresh"}, "env": {"horizon": 400}}


@pytest.mark.parametrize(
    ("policy", "changes", "setting"),
    [
        ("d_optimal", {"policy": {"form": "primal"}, "model": {"width": 40}}, "model.width"),
        ("d_optimal", {"policy": {"form": "dual"}, "env": {"horizon": 1500}}, "env.horizon"),
        ("d_optimal", {"policy": {"form": "sketch", "sketch_size": 1500}}, "policy.sketch_size"),
        ("d_optimal", FRESH, None),
        ("d_optimal", FRESH | {"model": {"width": 48}}, None),
        ("exact", FRESH, None),
        ("exact", FRESH | {"model": {"width": 48}}, None),
        ("lookahead", {"model": {"width": 48}, "learner": {"name": "adam"}}, None),
        ("exact", {"model": {"width": 48}, "learner": {"name": "ekf"}}, None),
        ("d_optimal", {"model": {"width": 48}, "learner": {"name": "gauss_newton"}}, None),
    ],
)
def test_what_is_large_is_estimated_and_named(
    policy: str, changes: dict[str, Any], setting: str | None
) -> None:
    sections = {"env": {"horizon": 300}} | changes if "learner" in changes else changes
    spec = trial("arm" if "information" in str(changes) else "cartpole", policy, **sections)
    assert setting in (None, spec.config.largest_setting)
    assert held(spec) <= (1.5 if "learner" in changes else 1.1) * spec.config.memory
    assert spec.config.memory <= (4 if setting else 8) * held(spec)


@pytest.mark.parametrize(
    ("changes", "setting"),
    [
        ({"model": {"width": 1_000_000}}, "model.width"),
        ({"model": {"depth": 2**31 - 1}}, "model.width"),
        ({"env": {"grid_points": (2**31 - 1,) * 3}}, "env.grid_points"),
        ({"policy": {"form": "sketch", "sketch_size": 10**6}}, "policy.sketch_size"),
        ({"policy": {"form": "dual"}, "env": {"horizon": 10**6}}, "env.horizon"),
        ({"model": {"name": "rff", "n_features": 10**6}} | LEAST_SQUARES, "model.n_features"),
    ],
)
def test_what_no_machine_can_hold_is_refused_by_name(changes: dict[str, Any], setting: str) -> None:
    with pytest.raises(SpecificationError, match=rf"GiB .* because of {setting}, .* smaller\.$"):
        trial("cartpole", "d_optimal", **changes)


@pytest.mark.parametrize("form", ["primal", "dual"])
def test_the_reference_holds_the_matrix_in_any_form(form: str) -> None:
    spec = trial("cartpole", "d_optimal", model={"width": 256}, policy={"form": form})
    q = spec.model.n_parameters(spec.system)
    there = dataclasses.replace(spec.config, path="reference")
    assert there.memory > 2 * 8 * q**2
    assert there.largest_setting == "model.width"


def test_a_horizon_has_a_bound() -> None:
    assert trial("pendulum", "random", env={"horizon": LARGEST_HORIZON}).system.horizon
    with pytest.raises(SpecificationError, match=r"env\.horizon is 10,000,001 steps, .* at most"):
        trial("pendulum", "random", env={"horizon": LARGEST_HORIZON + 1})
