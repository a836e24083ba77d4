"""Published tables: of small grids against their definitions, and the stored ones; exponents."""

from __future__ import annotations

import contextlib
import dataclasses
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest

from analysis.style import steps_text
from dopt.assessment import parameter_error, true_parameters
from dopt.errors import SpecificationError
from dopt.result import Assessment, TrialResult
from dopt.run import rerun, run_trial
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS, CoupledPendulums, UnbalancedDisk
from studies.yardsticks import disk as table_disk
from studies.yardsticks import pendulums as table_3
from studies.yardsticks import star as table_star
from studies.yardsticks import swing_up as table_1
from studies.yardsticks.__main__ import main
from studies.yardsticks.common import FLEX_SWING_UP, exponent, median, slopes
from studies.yardsticks.disk import TEST_SAMPLES, rate_error
from studies.yardsticks.star import CENTRE
from tests.analysis.synthetic import fill, make_spec, simulated
from tests.dopt.trials import trial
from tests.pages import DOCS

MEASURED = {"measured_states": [1], "measurement_noise": [0.045], "initial_state": [0.0, 0.0]}
LIMITS = {"name": "box", "bounds": {"ω": [-4.5, 4.5]}, "steps": 1, "margin": 1.0}


def disk(
    policy: str, seed: int, *, enforced: bool = True, horizon: int = 60, **planned: Any
) -> TrialSpec:
    env = {"dt": 0.025, "integrator": "rk4", "horizon": horizon, **MEASURED}
    parts = {"learner": {"name": "joint_ekf"}, "policy": planned}
    free = trial("unbalanced_disk", policy, seed, env=env, **parts)
    return TrialSpec.from_mapping(free.to_mapping() | {"limits": LIMITS | {"enforced": enforced}})


DISKS = [
    disk(policy, seed, enforced=enforced, **planned)
    for enforced in (False, True)
    for policy, planned in (("random", {}), ("space_filling", {"criterion": "gsx"}))
    for seed in range(2)
]


def named(spec: TrialSpec) -> tuple[bool, str, int]:
    policy = getattr(spec.policy, "criterion", spec.policy.name)
    return spec.limits.enforced, policy, spec.seed  # type: ignore[union-attr]


def test_rows_follow_from_the_trials(made: Made) -> None:
    rows = made.read("active_sysid_trials")
    table = rows.set_index(["enforced", "policy", "seed"]).sort_index()
    assert len(table) == len(DISKS)
    for spec in DISKS:
        result, row = run_trial(spec), table.loc[named(spec)]
        assert row.error == pytest.approx(rate_error(spec, result.parameters), rel=1e-12)
        assert row.turned == pytest.approx(np.abs(result.states[:, 0]).max())
        counted = [one.value for one in result.assessments if one.measure == "violations"]
        assert row.violations == pytest.approx(sum(counted) / 60)
        if not spec.limits.enforced:  # type: ignore[union-attr]
            assert row.violations > 0.0


def test_the_true_model_is_left_with_the_noise_and_none_with_the_motion() -> None:
    """The noise of 2,000 samples is known to 1.6 % (one standard deviation)."""
    env = {"dt": 0.025, "integrator": "rk4", **MEASURED}
    parts = {"model": {"name": "linear"}, "learner": {"name": "joint_ekf"}}
    spec = trial("unbalanced_disk", "random", 0, env=env, **parts)
    truth = np.array([getattr(spec.system, name) for name in UnbalancedDisk.linear_parameters])
    assert rate_error(spec, truth) == pytest.approx(0.045, rel=4 * 0.016)
    other = rate_error(spec, 0.5 * truth)
    assert 1.0 < other < 10.0
    assert rate_error(spec, np.full(3, -1e6)) == np.inf
    assert TEST_SAMPLES == 2000


def follows(
    made: Made, name: str, keys: list[str], value: str, compared: tuple[Any, str]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Check the medians and a ratio of a table; return it, and the values of its trials by seed."""
    trials, table = made.read(f"{name}_trials"), made.read(name).set_index(keys)
    by_seed = trials.pivot_table(index="seed", columns=keys, values=value)[table.index]
    assert table["median"].to_numpy() == pytest.approx(by_seed.median().to_numpy())
    logs = np.log(by_seed[compared] / by_seed[compared[0], "random"])
    assert table.ratio[compared] == pytest.approx(np.exp(logs.mean()))
    return table, by_seed


def test_medians_counts_and_ratios_of_disks_follow_from_the_trials(made: Made) -> None:
    table, errors = follows(made, "active_sysid", ["enforced", "policy"], "error", (True, "gsx"))
    assert (table.reached == (errors <= 0.83).sum()).all()
    assert "published: idw" in made.shown
    assert "| rate within 4.5 rad/s" in made.shown


def test_a_trial_that_diverged_counts_with_an_infinite_error(tmp_path: Path) -> None:
    address = f"sqlite:///{tmp_path}/diverged.db"
    whole = disk("random", 0, enforced=False).to_mapping()
    env = whole["env"] | {"state_limit": 5.0}  # type: ignore[operator]
    spec = TrialSpec.from_mapping(whole | {"env": env})
    assert run_trial(spec).diverged
    fill(address, [spec], edit=simulated)
    assert main(["--db", address, "--out", str(tmp_path)]) == 0
    row = pd.read_csv(tmp_path / "active_sysid_trials.csv").iloc[0]
    assert row.error == np.inf
    assert np.isnan(row.turned)
    assert 0.0 <= row.violations < 1.0


NARROW = disk("random", 0).to_mapping() | {"limits": LIMITS | {"bounds": {"ω": [-2.0, 2.0]}}}


@pytest.mark.parametrize("other", [TrialSpec.from_mapping(NARROW), trial("pendulum", "random")])
def test_a_database_without_trials_of_a_published_table_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], other: TrialSpec
) -> None:
    """Trials within other bounds answer another question."""
    address = f"sqlite:///{tmp_path}/other.db"
    fill(address, [other], edit=simulated)
    assert main(["--db", address, "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "holds no trials of a published table" in said
    assert "experiment=flex_table1 or flex_table3 or flex_star or active_sysid" in said


LEARNED: dict[str, dict[str, Any]] = {
    "model": {"name": "linear"},
    "learner": {"name": "ekf", "regularization": 1e-8},
}


def pendulums(policy: str, n: int, seed: int, **env: object) -> TrialSpec:
    planned: dict[str, Any] = {"regularization": 1e-8} if policy == "d_optimal" else {}
    fields = {"n_pendulums": n, "horizon": 40, **env}
    return trial("coupled_pendulums", policy, seed, env=fields, policy=planned, **LEARNED)


SPECS = [
    pendulums(policy, n, seed)
    for policy in ("d_optimal", "random")
    for n in (1, 2)
    for seed in range(3)
]


def test_samples_are_those_after_which_the_error_stays_small(made: Made) -> None:
    table = made.read("flex_table3_trials")
    assert len(table) == len(SPECS)
    for spec in SPECS:
        mask = (table.policy == spec.policy.name) & (table.seed == spec.seed)
        (row,) = table[mask & (table.n_pendulums == spec.system.n_learned)].to_dict("records")
        steps = list(range(1, spec.system.horizon + 1))
        errors = [parameter_error(spec.system, one) for one in rerun(spec, steps).parameters]
        above = [t for t, error in zip(steps, errors, strict=True) if error > table_3.ERROR]
        assert row["samples"] == (max(above, default=0) + 1 if errors[-1] <= 0.01 else np.inf)
        assert row["final_error"] == pytest.approx(errors[-1], rel=1e-6)


def test_the_loss_of_coupled_pendulums_is_their_parameter_error_times_a_constant() -> None:
    spec = trial("coupled_pendulums", "oracle", env={"n_pendulums": 3, "grid_half_widths": [2.0]})
    steps = [1, 10, 30]
    parameters = rerun(spec, steps).parameters
    errors = np.array([parameter_error(spec.system, theta) for theta in parameters])
    losses = run_trial(spec).loss[np.array(steps) - 1]
    assert losses == pytest.approx(table_3.loss_by_parameter_error(spec.system) * errors, rel=1e-9)
    assert errors[0] > 100 * errors[-1] > 0


def test_systems_whose_loss_is_no_parameter_error_are_refused() -> None:
    with pytest.raises(SpecificationError, match=r"'pendulum' weighs its parameters differently"):
        table_3.loss_by_parameter_error(SYSTEMS["pendulum"]())
    uneven = CoupledPendulums(n_pendulums=2, grid_half_widths=(1.0, 1.1))
    with pytest.raises(SpecificationError, match=r"dopt\.run"):
        table_3.loss_by_parameter_error(uneven)
    object.__setattr__(uneven, "linear_parameters", ())
    with pytest.raises(SpecificationError, match="no parameters that its accelerations are linear"):
        true_parameters(uneven)
    even = dataclasses.replace(uneven, grid_half_widths=(1.0,))
    assert table_3.loss_by_parameter_error(even) == pytest.approx(1 / 3**0.5, rel=1e-3)


def test_medians_and_ratios_of_pendulums_follow_from_the_trials(made: Made) -> None:
    for size in (1, 2):
        keys = ["n_pendulums", "policy"]
        follows(made, "flex_table3", keys, "samples", (size, "d_optimal"))
    assert "published: FLEX" in made.shown
    assert table_3.published_exponent("FLEX") == pytest.approx(1.18, abs=0.005)


BOX = {"name": "grey_box", "unknown": list(CENTRE), "initial": [0.1, 0.1]}


def star(policy: str, seed: int, rate: float = 0.02, **env: Any) -> TrialSpec:
    learner = {"name": "adam", "learning_rate": rate}
    fields = {"horizon": 12, **env}
    return trial("moving_star", policy, seed, env=fields, model=BOX, learner=learner)


STARS = [star(*each) for each in (("random", 0), ("random", 1), ("exact", 0), ("exact", 1))]
STARS += [star("random", seed, 0.01) for seed in (0, 1)]


def test_errors_are_half_the_squared_distances_to_the_star_at_the_last_step(made: Made) -> None:
    table = made.read("flex_star_trials").set_index(["learner", "policy", "seed"])
    assert len(table) == len(STARS)
    for spec in STARS:
        rate = spec.learner.learning_rate
        angle = 2 * np.pi * 11 / 1000
        theta = simulated(spec, None).parameters  # type: ignore[arg-type]
        assert 0.0 < table.apart[(f"adam, rate {rate:g}", spec.policy.name, spec.seed)] < 0.3
        distance = np.hypot(*(theta - 0.9 * np.array([np.cos(angle), np.sin(angle)])))
        row = table.loc[(f"adam, rate {rate:g}", spec.policy.name, spec.seed)]
        assert row.error == pytest.approx(0.5 * distance**2, rel=1e-9)
    assert "adam, rate 0.01" in made.shown


def test_medians_counts_and_ratios_of_stars_follow_from_the_trials(made: Made) -> None:
    learner = "adam, rate 0.02"
    table, errors = follows(made, "flex_star", ["learner", "policy"], "error", (learner, "exact"))
    assert (table.lost == (errors > 0.5).sum()).all()


SOLVED = {
    ("random", 0): (0, 1, 0, 1),
    ("random", 1): (0, 0, 0, 0),
    ("random", 2): (0, 1, 1, 0),
    ("d_optimal", 0): (0, 0, 1, 1),
    ("d_optimal", 1): (0, 1, 1, 1),
    ("d_optimal", 2): (1, 1, 1, 1),
}
"""Success of the episodes after 0, 10, 20 and 30 steps, by policy and seed."""

SAMPLES = {
    ("random", 0): (30, 10),
    ("random", 1): (np.inf, np.inf),
    ("random", 2): (np.inf, 10),
    ("d_optimal", 0): (20, 20),
    ("d_optimal", 1): (10, 10),
    ("d_optimal", 2): (0, 0),
}
"""Samples until they succeed from then on, and for the first time."""


def swing_up(policy: str, seed: int, **sections: Any) -> TrialSpec:
    env = {"horizon": 30, "grid_points": (4, 4)}
    task = {"name": "control", "checkpoints": [10, 20]}
    return make_spec("pendulum", policy, seed, env=env, task=task, **sections)


def solved_as_listed(spec: TrialSpec, result: TrialResult) -> TrialResult:
    """Return the result with the successes of the list, up to where it diverged."""
    values = zip((0, 10, 20, 30), SOLVED[spec.policy.name, spec.seed], strict=True)
    last = spec.system.horizon if result.diverged_at is None else result.diverged_at
    rows = tuple(Assessment(t, "control_success", float(one)) for t, one in values if t <= last)
    return dataclasses.replace(result, assessments=rows)


SWINGS = [swing_up(*one) for one in SOLVED]


class Made(NamedTuple):
    """Folder of the tables of a database, and what was printed."""

    folder: Path
    shown: str

    def read(self, name: str) -> pd.DataFrame:
        return pd.read_csv(self.folder / f"{name}.csv")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Return all tables of one database with small grids of each kind."""
    folder = tmp_path_factory.mktemp("published")
    fill(f"sqlite:///{folder}/r.db", [*DISKS, *SPECS, *STARS], edit=simulated)
    fill(f"sqlite:///{folder}/r.db", SWINGS, edit=solved_as_listed)
    with contextlib.redirect_stdout(io.StringIO()) as shown:
        assert main(["--db", f"sqlite:///{folder}/r.db", "--out", str(folder)]) == 0
    return Made(folder, shown.getvalue())


def test_samples_are_those_after_which_every_episode_succeeds(made: Made) -> None:
    table = made.read("flex_table1_trials").set_index(["policy", "seed"])
    assert len(table) == len(SAMPLES)
    for key, expected in SAMPLES.items():
        assert tuple(table.loc[key, ["samples", "first"]]) == expected
    assert set(table.horizon) == {30}


def test_medians_and_improvements_follow_from_the_trials(made: Made) -> None:
    table = made.read("flex_table1").set_index("policy")
    assert tuple(table.samples[["d_optimal", "random"]]) == (10, np.inf)
    assert tuple(table["first"][["d_optimal", "random"]]) == (10, 10)
    assert tuple(table.samples_unsolved[["d_optimal", "random"]]) == (0, 2)
    assert tuple(table.first_unsolved[["d_optimal", "random"]]) == (0, 1)
    assert table.improvement["d_optimal"] == 1.0
    assert table.p_adjusted["d_optimal"] == pytest.approx(2 * 0.5**3)
    assert np.isnan(table.improvement["random"])


def test_a_trial_that_diverged_is_not_solved(tmp_path: Path) -> None:
    address = f"sqlite:///{tmp_path}/diverged.db"
    lost = swing_up("d_optimal", 1)
    fill(address, SWINGS, diverged={lost.trial_key: 15}, edit=solved_as_listed)
    main(["--db", address, "--out", str(tmp_path)])
    table = pd.read_csv(tmp_path / "flex_table1_trials.csv").set_index(["policy", "seed"])
    assert tuple(table.loc[("d_optimal", 1), ["samples", "first"]]) == (np.inf, 10)


def test_the_tables_show_the_published_rows_and_what_is_censored(made: Made) -> None:
    lines = made.shown.splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    assert ["policy", "pendulum, mlp"] in rows
    assert ["published: RHC", "500"] in rows
    assert ["published: random", "> 2000"] in rows
    assert ["published: FLEX", "–"] in rows  # its model of the pendulum is linear
    assert FLEX_SWING_UP["FLEX"]["pendulum", "linear"] == 50
    assert ["random", "> 30 [30, > 30]; 2"] in rows
    assert ["d_optimal", "1.00; 0.25"] in rows


def test_a_policy_that_learns_the_task_has_a_row_for_its_own_feedback(tmp_path: Path) -> None:
    def edit(spec: TrialSpec, result: TrialResult) -> TrialResult:
        result = solved_as_listed(spec, result)
        if spec.policy.name == "random":
            return result
        own = (Assessment(t, "feedback_success", float(t == 30)) for t in (0, 10, 20, 30))
        return dataclasses.replace(result, assessments=(*result.assessments, *own))

    address = f"sqlite:///{tmp_path}/agent.db"
    fill(address, SWINGS, edit=edit)
    main(["--db", address, "--out", str(tmp_path)])
    trials = pd.read_csv(tmp_path / "flex_table1_trials.csv").set_index(["policy", "seed"])
    for seed in range(3):
        assert trials.samples["d_optimal, its own feedback", seed] == 30
    for key, expected in SAMPLES.items():
        assert tuple(trials.loc[key, ["samples", "first"]]) == expected
    table = pd.read_csv(tmp_path / "flex_table1.csv").set_index("policy")
    assert set(table.index) == {"random", "d_optimal", "d_optimal, its own feedback"}
    assert table.samples_unsolved["d_optimal, its own feedback"] == 0


@pytest.mark.parametrize(
    ("specs", "said", "where"),
    [
        (
            [disk("random", 0), disk("random", 0, horizon=10)],
            "rate within 4.5 rad/s with the policy 'random'",
            "env.horizon=10",
        ),
        ([pendulums("random", 2, 0), pendulums("random", 2, 0, gamma=2.0)], "", "env.gamma=2.0"),
        ([star("random", 0), star("random", 0, gamma=20.0)], "", "env.gamma=20.0"),
        (
            [swing_up("random", 0), swing_up("random", 0, learner={"name": "gauss_newton"})],
            "",
            "learner.name=gauss_newton",
        ),
    ],
)
def test_two_kinds_of_one_policy_are_refused(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    specs: list[TrialSpec],
    said: str,
    where: str,
) -> None:
    given = ["--db", f"sqlite:///{tmp_path}/two.db", "--out", str(tmp_path)]
    is_listed = specs[0].system.name == "pendulum"
    fill(given[1], specs, edit=solved_as_listed if is_listed else simulated)
    assert main(given) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "choose by --where" in error
    assert main([*given, "--where", where]) == 0


SIZES = (2, 5, 10, 20, 50)


def scattered(power: float, seed: int, n: int = 100) -> dict[int, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {size: 3.0 * size**power * np.exp(0.3 * rng.normal(size=n)) for size in SIZES}


def test_the_exponent_of_a_power_law_is_its_power() -> None:
    exact = {size: np.full(4, 3.0 * size**1.25) for size in SIZES}
    found = exponent(exact, np.random.default_rng(0))
    assert found == pytest.approx((1.25, 1.25, 1.25), rel=1e-12)
    assert slopes(SIZES, np.array([[size**0.5 for size in SIZES]])) == pytest.approx([0.5])


def test_intervals_cover_the_power_and_are_as_wide_as_its_estimates_scatter() -> None:
    found = np.array(
        [exponent(scattered(1.2, seed, n=40), np.random.default_rng(seed)) for seed in range(30)]
    )
    centres, low, high = found.T
    assert np.sum((low <= 1.2) & (high >= 1.2)) >= 24  # of 30; fewer come once in 1,700 times
    assert np.mean(high - low) == pytest.approx(2 * 1.96 * np.std(centres), rel=0.4)


def test_sizes_whose_median_is_not_reached_are_left_out() -> None:
    samples = scattered(1.0, 1)
    whole = exponent({s: v for s, v in samples.items() if s < 50}, np.random.default_rng(3))
    samples[50][:60] = np.inf
    assert exponent(samples, np.random.default_rng(3)) == whole
    few = {size: samples[size] for size in (2, 5, 50)}
    assert np.isnan(exponent(few, np.random.default_rng(3))).all()


def test_a_median_may_be_censored_in_part() -> None:
    values = np.concatenate([np.arange(1.0, 56.0), np.full(45, np.inf)])
    centre, low, high = median(values, np.random.default_rng(0))
    assert centre == 50.5
    assert 35 < low < centre < high
    assert median(np.full(9, np.inf), np.random.default_rng(0)) == (np.inf, np.inf, np.inf)


# Rows about published numbers follow from their trials, and the claims of the pages from the rows.


def stored(name: str) -> pd.DataFrame:
    return pd.read_csv(DOCS / f"yardsticks/{name}.csv")


def rows(name: str, *keys: str) -> pd.DataFrame:
    return stored(name).set_index(list(keys)).sort_index()


@pytest.mark.parametrize(
    ("name", "tabulate", "keys", "seeds"),
    [
        ("active_sysid", table_disk.tabulate, ["enforced", "policy"], 20),
        ("agents/flex_table1", table_1.tabulate, ["env", "policy"], 20),
        ("flex_star", table_star.tabulate, ["learner", "policy"], 100),
        ("flex_table1", table_1.tabulate, ["env", "model", "policy"], 100),
    ],
)
def test_stored_rows_follow_from_the_stored_trials(
    name: str, tabulate: Callable[[pd.DataFrame], pd.DataFrame], keys: list[str], seeds: int
) -> None:
    trials, expected = stored(f"{name}_trials"), rows(name, *keys)
    found = tabulate(trials).set_index(keys).sort_index()
    numbers = [column for column in found.columns if column != "model"]
    ours, theirs = (one[numbers].to_numpy(float) for one in (found, expected))
    assert ours == pytest.approx(theirs, rel=1e-9, nan_ok=True)
    assert expected.n.max() == seeds
    for _, part in trials.groupby(keys):
        assert sorted(part.seed) == list(range(100, 100 + seeds))


def test_the_claims_about_the_disk() -> None:
    table = rows("active_sysid", "enforced", "policy")
    medians, ratios, reached = table["median"], table.ratio, table.reached[True]
    assert reached["d_optimal"] == reached["random_held"] == 20
    assert (table.median_high[True][["d_optimal", "random_held"]] < table_disk.TARGET).all()
    assert table.median_low[True, "random"] > table_disk.TARGET
    assert (table.ratio_low[:, "idw"] > 1.0).all()
    assert (table.ratio_low[:, "gsx"] > 1.0).all()
    assert table.ratio_high[True, "d_optimal"] < 1.0 < table.ratio_low[False, "d_optimal"]
    assert medians[True].idxmin() == ratios[True].idxmin() == "random_held"
    assert medians[False].idxmin() == "random"
    assert table.turned[True].idxmax() == "random_held"


def test_the_claims_about_agents() -> None:
    table = rows("agents/flex_table1", "env", "policy")
    own = table.xs("sac, its own feedback", level="policy")
    assert (own.horizon == 2000).all()
    assert np.isinf(own.samples).all()
    assert table.samples["pendulum", "max_agent"] < 2000
    assert table.horizon["cartpole", "max_agent"] == 1000
    assert np.isinf(table.samples["cartpole", "max_agent"])
    for env in ("pendulum", "cartpole"):  # not told apart from random inputs
        assert table.p_adjusted[env, "max_agent"] > 0.05
    assert table.p_adjusted["cartpole", "d_optimal"] < 0.001


def test_the_claims_about_the_star() -> None:
    table = rows("flex_star", "learner", "policy")
    slow, fast, fit = "adam, rate 0.01", "adam, rate 0.02", "gauss_newton"
    assert table.median_low[slow, "random"] <= 3.0 <= table.median_high[slow, "random"]
    for learner in (slow, fast):
        assert table.ratio_high[learner, "d_optimal"] < 0.2
    assert table.ratio_low[fit, "d_optimal"] < 1.0 < table.ratio_high[fit, "d_optimal"]
    assert table.median_high[fast, "d_optimal"] < 1e-3 < table.median_low[slow, "d_optimal"] / 10
    assert table.ratio_high[slow, "episodic"] < table.ratio_low[slow, "d_optimal"]
    assert table.median_low[fast, "episodic"] < table.median_high[fast, "d_optimal"]
    assert np.ptp(table["median"][fit]) < 1e-5


def test_the_claims_about_the_swing_up() -> None:
    table = rows("flex_table1", "env", "model", "policy")
    pendulum, linear, cartpole = ("pendulum", "mlp"), ("pendulum", "linear"), ("cartpole", "mlp")

    def shown(column: tuple[str, str], policy: str) -> list[str]:
        row = table.loc[(*column, policy)]
        names = ("samples", "samples_low", "samples_high")
        return [steps_text(row[name], int(row.horizon)) for name in names]

    adjusted = table.p_adjusted
    assert adjusted[(*cartpole, "d_optimal")] < 0.001
    assert adjusted[(*pendulum, "d_optimal")] > 0.05
    told = adjusted.loc[pendulum].dropna() < 0.05
    assert list(told[told].index) == ["uniform"]
    for column in (pendulum, cartpole):
        ends = table.loc[column].loc[["d_optimal", "episodic"]]
        assert ends.samples_low.max() <= ends.samples_high.min()
    # Five trials of one policy alone: no exact test of pairs tells them from none at 0.05.
    left = table.samples_unsolved
    assert (left[(*cartpole, "d_optimal")], left[(*cartpole, "episodic")]) == (5, 0)
    assert shown(linear, "d_optimal") == shown(linear, "random")
    random = table.loc[(*cartpole, "random")]
    assert random.n - random.samples_unsolved == 1
    assert np.isinf(random.samples_low)


PENDULUMS = rows("flex_table3", "policy", "n_pendulums")
TRIALS = stored("flex_table3_trials")


@pytest.mark.parametrize("policy", ["random", "episodic"])
def test_the_rows_of_pendulums_follow_from_the_trials(policy: str) -> None:
    own = TRIALS[TRIALS.policy.isin({policy, "random"}) & (TRIALS.n_pendulums != 50)]
    found = table_3.tabulate(own).set_index(["policy", "n_pendulums"])
    columns = ["n", "reached", "median", "median_low", "median_high", "ratio", "ratio_low"]
    for size in (2, 5, 10, 20):
        ours, theirs = (
            one.loc[(policy, size), columns].to_numpy(float) for one in (found, PENDULUMS)
        )
        assert ours == pytest.approx(theirs, rel=1e-12, nan_ok=True)


@pytest.mark.parametrize("policy", ["d_optimal", "exact"])
def test_exponents_follow_from_the_trials(policy: str) -> None:
    own = TRIALS[TRIALS.policy == policy]
    by_size = {int(n): part.samples.to_numpy(float) for n, part in own.groupby("n_pendulums")}
    columns = ["exponent", "exponent_low", "exponent_high"]
    found = exponent(by_size, np.random.default_rng(20_230_426))
    expected = PENDULUMS.loc[(policy, 50), columns].to_numpy(float)
    assert found == pytest.approx(expected, rel=1e-12)


def test_all_trials_of_pendulums_but_two_reach_the_error_on_the_same_seeds() -> None:
    lost = TRIALS[~np.isfinite(TRIALS.samples)]
    kinds = sorted(zip(lost.policy, lost.n_pendulums, strict=True))
    assert kinds == [("d_optimal", 50), ("random", 50)]
    for kind, part in TRIALS.groupby(["policy", "n_pendulums"]):
        seeds = 10 if kind == ("episodic", 50) else 100
        assert sorted(part.seed) == list(range(100, 100 + seeds))


def test_the_claims_about_pendulums() -> None:
    table = PENDULUMS
    ratios = table.drop(index="random", level="policy")
    assert (ratios.loc[["exact", "episodic"], "ratio_high"] < 1.0).all()
    drawn = ratios.loc["d_optimal"]
    assert (drawn.ratio_high.drop(50) < 1.0).all()
    assert drawn.ratio_high[50] > 1.0
    assert (ratios.ratio_low > 0.5).all()
    assert table.exponent_low.loc[("exact", 50)] > table.exponent_high.loc[("random", 50)]
    assert table.ratio_high.loc[("random_held", 50)] < table.ratio_low.loc[("exact", 50)]
    behind = (table.ratio.loc["random_held"] / table.ratio.loc["exact"]).drop(50)
    assert 1.0 <= behind.min() < behind.max() < 1.07
    assert table.median_high.loc[("episodic", 50)] < table.median_low.loc[("exact", 50)]
    gaps = table.loc["episodic", "median"] - table.loc["exact", "median"]
    assert gaps.drop(50).abs().max() <= 2
