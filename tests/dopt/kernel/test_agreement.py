"""Agreement of kernel, torch path and plain Python over every choice, determinism, stability."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pytest

from dopt.algorithm import Form, Score
from dopt.errors import IncompatibleError, SpecificationError
from dopt.kernel.from_spec import KINDS, network_of
from dopt.kernel.linear_algebra import dense, initial_covariance, rank_update
from dopt.kernel.pointers import function_of
from dopt.kernel.run import KernelTrial
from dopt.learning import LEARNERS
from dopt.learning.base import Learner
from dopt.models import MODELS, RFF
from dopt.models.base import Model
from dopt.policies import POLICIES, Search
from dopt.policies.base import OpenLoop, Policy
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.compatibility import REFERENCE_POLICIES
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from tests.dopt.custom_plugins import Alternating, Average
from tests.dopt.kernel.test_information import jacobians
from tests.dopt.kernel.twin import interpreted, relative_gap, run
from tests.dopt.trials import LEARNERS as FIXED
from tests.dopt.trials import PAIRS, SMALL_GRIDS, SMALL_SEARCHES, covering, trial
from tests.paths import printed

ENVS = ("arm", "mass_spring", "pendulum")
"""Systems of which the first one that a choice fits is taken."""

FORMS = [form.name.lower() for form in Form]
SMALL: dict[str, dict[str, Any]] = {
    **SMALL_SEARCHES,
    "adam_replay": {"capacity": 5, "batch": 4, "steps": 2},
    "adam_window": {"window": 4},
    "ekf": {"forgetting": 0.98},
    "joint_ekf": {"refit_every": 4, "steps": 2},
}
MEASURED = {"measured_states": [0, 1], "measurement_noise": [0.01, 0.01]}
"""Sensors for learners that estimate states."""


def combined(env: str, policy: str, model: str, learner: str, form: str) -> TrialSpec | None:
    """Return the trial of some choices; None where they do not go together."""
    chosen = {"policy": policy, "model": model, "learner": learner}
    sections = {key: {"name": name, **SMALL.get(name, {})} for key, name in chosen.items()}
    if form != "auto":
        sections["policy"] |= {"form": form, "sketch_size": 48}
    grid = {"name": env, "horizon": 9, "grid_points": list(SMALL_GRIDS[env])}
    if LEARNERS[learner].estimates_states:
        grid |= MEASURED
        if hasattr(POLICIES[policy], "regularization"):
            sections["policy"] |= {"regularization": 3.0}
    try:
        return TrialSpec.from_mapping({"env": grid, **sections, "seed": 3})
    except IncompatibleError:
        return None


def first_fitting(**chosen: Iterable[str]) -> TrialSpec | None:
    """Return the trial of the first choices that go together."""
    among: dict[str, Iterable[str]] = {"env": ENVS, "policy": POLICIES, "learner": LEARNERS}
    among |= {"model": MODELS, "form": ["auto"]} | chosen
    choices = (dict(zip(among, one, strict=True)) for one in itertools.product(*among.values()))
    return next((spec for one in choices if (spec := combined(**one)) is not None), None)


OF_TRIALS = [name for name in LEARNERS if name != "simulation_error"]
"""Learners that do without a :class:`dopt.Plant`, which is measured and not simulated."""


def cases() -> Iterator[tuple[str, TrialSpec | None]]:
    """Yield every learner in every form of M that a policy with it can hold, and every policy."""
    forms = [name for name in POLICIES if hasattr(POLICIES[name], "sketch_size")]
    for learner in OF_TRIALS:
        yield learner, first_fitting(learner=[learner])
        for form in FORMS:
            yield f"{learner}-{form}", first_fitting(policy=forms, learner=[learner], form=[form])
    for policy in POLICIES:
        yield policy, first_fitting(policy=[policy])
    for model in MODELS:
        yield f"model-{model}", first_fitting(model=[model])


CASES = {name: spec for name, spec in cases() if spec is not None}
"""A trial for every choice, by the name of the choice."""


WINDOW = {"name": "adam_window", "window": 4}
"""Shorter than the trials, so that the kernel's ring of samples goes round twice."""
NEWEST = {"name": "adam"}
LOSS = 1e-5
"""The kernel judges a model in single precision, down to a floor; what it decides by is double."""


def learners_of(env: str, policy: str) -> list[dict[str, Any]]:
    """Return the learners to run a pair with.

    Inputs that are drawn before a trial depend neither on the learner nor on the model, and a
    learner takes every system of the same model in the same way.
    """
    if policy in FIXED:
        return [{}]
    if issubclass(POLICIES[policy], OpenLoop) and policy != "random":
        return [WINDOW] if env in PAPER else []
    return [NEWEST, WINDOW] if env in PAPER else [WINDOW]


PAPER = ("pendulum", "cartpole", "arm", "quadrotor")
PAIR_CASES = [
    pytest.param(env, policy, learner, id=f"{env}-{policy}-{learner.get('name', 'usual')}")
    for env, policy in PAIRS
    if not SYSTEMS[env].reads_inputs  # which the model of the torch path does not
    if POLICIES[policy] in REFERENCE_POLICIES or issubclass(POLICIES[policy], OpenLoop)
    for learner in learners_of(env, policy)
]


def check_agreement(spec: TrialSpec) -> tuple[TrialResult, TrialResult]:
    """Run on both paths; states and inputs have to agree to 1e-8."""
    fast, plain = run_trial(spec, "kernel"), run_trial(spec, "reference")
    assert np.isfinite(plain.loss).all()
    assert relative_gap(fast.inputs, plain.inputs) < 1e-8
    assert relative_gap(fast.states, plain.states) < 1e-8
    # Least squares of the reference squares the condition, which shows once the loss is tiny.
    rounding = 1e-8 * plain.loss.max()
    assert fast.loss == pytest.approx(plain.loss, rel=LOSS, abs=rounding)
    assert fast.reachable_loss == pytest.approx(plain.reachable_loss, rel=LOSS, abs=rounding)
    assert fast.diverged_at is None
    assert plain.diverged_at is None
    return fast, plain


@pytest.mark.parametrize(("env", "policy", "learner"), PAIR_CASES)
def test_both_paths_run_the_same_trial(env: str, policy: str, learner: dict[str, Any]) -> None:
    horizon = 6 if learner == NEWEST else 9  # no window to fill
    spec = trial(env, policy, 3, env={"horizon": horizon}, learner=learner)
    fast, plain = check_agreement(spec)
    if policy not in FIXED:  # least squares and a process are solved for, at a large condition
        assert relative_gap(fast.parameters, plain.parameters) < 1e-8


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_the_information_matrix_agrees_for_a_deep_network(form: str) -> None:
    policy, model = {"form": form, "sketch_size": 48}, {"width": 9, "depth": 3}
    check_agreement(trial("arm", "d_optimal", 2, env={"horizon": 14}, policy=policy, model=model))


def test_times_are_measured_and_add_up_to_less_than_the_whole() -> None:
    result = run_trial(trial("arm", "d_optimal"))
    for column in (result.plan_us, result.learn_us, result.evaluate_us):
        assert np.all(column[1:] > 0.0)
        assert column.sum() < 1e6 * result.wall_seconds


def test_the_kernel_does_not_pretend_to_run_what_it_lacks() -> None:
    mapping = trial("pendulum", "random").to_mapping()
    own = {"_target_": "tests.dopt.custom_networks.Stack"}
    with pytest.raises(SpecificationError, match="path is 'kernel', but model 'Stack'"):
        TrialSpec.from_mapping(mapping | {"model": own, "path": "kernel"})


@pytest.mark.parametrize(
    ("what", "sections"),
    [
        ("policy 'exact'", {"policy": {"name": "exact"}}),
        ("policy.information 'fresh'", {"policy": {"name": "d_optimal", "information": "fresh"}}),
        ("limits", {"limits": {"bounds": {"φ": [-1.0, 1.0]}}}),
        (
            "states that are measured with noise",
            {"env": {"name": "pendulum", "measured_states": [0], "measurement_noise": [0.1]}},
        ),
    ],
)
def test_torch_refuses_what_the_kernel_runs_alone(what: str, sections: dict[str, Any]) -> None:
    """The sentence names the executor that runs it."""
    spec = TrialSpec.from_mapping(trial("pendulum", "d_optimal").to_mapping() | sections)
    with pytest.raises(IncompatibleError, match=f"^{what} .* executor=local"):
        run_trial(spec, "reference")


@pytest.mark.parametrize("name", CASES)
def test_every_choice_runs_and_agrees_where_both_paths_run_it(name: str) -> None:
    spec = CASES[name]
    fast = run_trial(spec)
    assert np.isfinite(fast.loss).all()
    try:
        plain = run_trial(spec, "reference")
    except IncompatibleError as error:
        assert "runs in the compiled kernel alone" in str(error)  # noqa: PT017  # the rest agrees
        return
    # An ascent may end on a flat top, where inputs are known to the root of the rounding.
    expected = 1e-6 if spec.policy.name == "gradient" else 1e-8
    assert relative_gap(fast.inputs, plain.inputs) < expected
    # Least squares of the reference squares the condition.
    expected = 1e-5 if spec.learner.structure == "least_squares" else expected
    assert relative_gap(fast.parameters, plain.parameters) < expected


def test_the_cases_cover_the_registries_and_the_forms() -> None:
    specs = list(CASES.values())
    assert {spec.policy.name for spec in specs} == set(POLICIES)
    assert {spec.learner.name for spec in specs} == set(OF_TRIALS)
    assert {spec.model.name for spec in specs} == set(MODELS)
    held = {spec.config.information for spec in specs if spec.config.path == "kernel"}
    assert {one.form for one in held if one is not None} == {form.name.lower() for form in Form}


@pytest.mark.parametrize("registry", [POLICIES, LEARNERS, MODELS])
def test_classes_say_if_they_are_compiled(
    registry: dict[str, type[Policy | Learner | Model]],
) -> None:
    for name, cls in registry.items():
        declaring = next(base for base in cls.__mro__ if "compiled" in base.__dict__)
        assert declaring is cls or "name" not in declaring.__dict__, name


def test_a_new_policy_or_learner_is_four_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its class, with a twin in numpy, its kernel function and its line in the registry run it.

    The fourth file is its option under conf/, which only names it. No dispatch, no structure and no
    other path has to know of it.
    """
    monkeypatch.setitem(POLICIES, "alternating", Alternating)
    monkeypatch.setitem(LEARNERS, "average", Average)
    spec = combined("arm", "alternating", "mlp", "average", "auto")
    assert spec is not None
    assert spec.config.path == "kernel"
    fast, plain = run_trial(spec), run_trial(spec, "reference")
    assert relative_gap(fast.inputs, plain.inputs) < 1e-12
    assert relative_gap(fast.parameters, plain.parameters) < 1e-8


@pytest.mark.parametrize(
    ("base", "more"),
    [(Policy, {}), (Learner, {"kernel_function": "dopt.kernel.learners.forgotten"})],
)
def test_a_kernel_function_that_does_not_exist_is_named(base: Any, more: dict[str, str]) -> None:
    part = type("New", (base,), {"name": "new", "compiled": True, **more})()
    with pytest.raises(SpecificationError, match="'new' names the kernel function"):
        function_of(part, None)


def test_a_model_that_the_kernel_does_not_know_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(KINDS, RFF)
    with pytest.raises(SpecificationError, match="model 'rff' says that it is compiled"):
        network_of(SYSTEMS["pendulum"](), RFF())


def test_policies_that_search_have_all_scores() -> None:
    searching = [cls() for cls in POLICIES.values() if issubclass(cls, Search)]
    assert {policy.score for policy in searching} == set(Score)


NUMBERS = ("loss", "reachable_loss", "states", "inputs", "parameters")


def numbers(result: TrialResult) -> bytes:
    return b"".join(getattr(result, name).tobytes() for name in NUMBERS)


def test_the_same_trial_gives_the_same_bits_whatever_ran_before() -> None:
    """The second time after other trials than the first time."""
    specs = [trial(env, policy, 8) for env, policy in covering(PAIRS)]
    first = [numbers(run_trial(spec)) for spec in specs]
    run_trial(trial("arm", "d_optimal", 9, model={"width": 11}))
    run_trial(trial("quadrotor", "oracle", 10))
    for spec, expected in zip(reversed(specs), reversed(first), strict=True):
        again = numbers(run_trial(TrialSpec.from_mapping(spec.to_mapping())))
        assert again == expected, spec.config.label


def test_another_process_gives_the_same_bits() -> None:
    program = (
        "from dopt.run import run_trial\n"
        "from tests.dopt.trials import trial\n"
        "result = run_trial(trial('cartpole', 'd_optimal', 8))\n"
        f"print(b''.join(getattr(result, name).tobytes() for name in {NUMBERS}).hex())"
    )
    assert bytes.fromhex(printed(program)) == numbers(run_trial(trial("cartpole", "d_optimal", 8)))


def test_seeds_share_what_they_are_told_apart_by() -> None:
    """Trials of one configuration start from one state and are judged on the same points."""
    one, two = KernelTrial(trial("arm", "d_optimal", 0)), KernelTrial(trial("arm", "d_optimal", 1))
    assert one.trial[:3] == two.trial[:3]  # plant, network and algorithm: the same arrays
    assert one.points is two.points
    assert np.array_equal(one.record.states[0], two.record.states[0])


SMALL_MLP = {"width": 3, "depth": 1}
AFFINE = {"name": "affine", **SMALL_MLP}
STAR = {"name": "grey_box", "unknown": ["center_x", "center_y"], "initial": [0.1, 0.1]}
ENCODERS = {"measured_states": [0, 2], "measurement_noise": [0.01, 0.01], "horizon": 6}
PLAIN_TRIALS = [
    trial("pendulum", "d_optimal", 1, env={"horizon": 6}, model=AFFINE),
    trial("moving_star", "lookahead", 1, env={"horizon": 12}, model=STAR),
    trial("arm", "random", 1, env=ENCODERS, model=SMALL_MLP, learner={"name": "joint_ekf"}),
]
PLAIN_PROGRAM = """
import json, sys
from numba.core.dispatcher import Dispatcher
from dopt.kernel import loop
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
assert not isinstance(loop.advance, Dispatcher)
found = []
for mapping in json.loads(sys.argv[1]):
    result = run_trial(TrialSpec.from_mapping(mapping))
    found.append({name: getattr(result, name).tolist() for name in sys.argv[2:]})
print(json.dumps(found))
"""
EXACT, SINGLE = ("states", "inputs", "parameters"), ("loss", "reachable_loss")
"""Columns computed in double precision, and losses, which may be judged in single precision."""


def test_the_kernel_in_plain_python_gives_the_same_trials() -> None:
    given = json.dumps([spec.to_mapping() for spec in PLAIN_TRIALS])
    plain = json.loads(printed(PLAIN_PROGRAM, given, *EXACT, *SINGLE, DOPT_PLAIN="1"))
    for spec, found in zip(PLAIN_TRIALS, plain, strict=True):
        compiled = run_trial(spec)
        for name in EXACT:
            values = getattr(compiled, name)
            scale = np.abs(values).max()
            assert np.array(found[name]) == pytest.approx(values, rel=0.0, abs=1e-12 * scale), name
        for name in SINGLE:
            values = getattr(compiled, name)
            assert np.array(found[name]) == pytest.approx(values, rel=1e-5), name


STEPS = 2_000
REGULARIZATION = 1e-7


def test_many_steps_at_a_tiny_regularization_drift_little() -> None:
    spec = trial(
        "cartpole",
        "d_optimal",
        env={"horizon": STEPS},
        policy={"regularization": REGULARIZATION, "form": "primal"},
        learner={"name": "adam"},
    )
    fast = KernelTrial(spec)
    q = len(fast.state.theta)
    M = REGULARIZATION * np.eye(q)
    for start in range(0, STEPS, 500):
        parameters = run(fast, 500)
        J = jacobians(spec, parameters, fast.record.states[start : start + 500])
        rows = J.reshape(-1, q)
        M += rows.T @ rows
        carried = dense(fast.state.covariance)
        assert np.array_equal(carried, carried.T)
        assert np.linalg.eigvalsh(carried)[0] > 0.0
        probes = jacobians(spec, np.repeat(parameters[-1:], 36, axis=0), spec.system.grid())[:, 0]
        gain = np.log1p(np.einsum("ni,ij,nj->n", probes, carried, probes))
        fresh = np.log1p(np.einsum("ni,in->n", probes, np.linalg.solve(M, probes.T)))
        assert gain == pytest.approx(fresh, rel=1e-6)


def test_a_negative_variance_is_mended() -> None:
    rng = np.random.default_rng(0)
    axes, _ = np.linalg.qr(rng.standard_normal((6, 6)))
    broken = axes @ np.diag([2.0, 1.0, 0.5, 0.1, 1e-3, -1e-6]) @ axes.T
    carried = initial_covariance(6, 1.0, n_rows=1, n_planned=1)
    carried.upper[:6, :6] = broken
    interpreted(rank_update)(carried, axes[:, 5:].T.copy(), np.zeros(1))
    assert np.linalg.eigvalsh(dense(carried))[0] >= -1e-15
    assert np.linalg.norm(dense(carried) - broken, 2) < 2e-6
