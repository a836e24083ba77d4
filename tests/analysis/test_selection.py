"""Trials that stand for a policy, and those that a figure or a table is about."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf

import analysis
from analysis.cli import main
from analysis.data.matching import (
    USUAL,
    AnalysisError,
    Filter,
    _argument,
    choose,
    difference,
    newest,
)
from analysis.data.selection import Entry, Selection, environment_rank, policy_rank, ranges, select
from analysis.tables.comparisons import compare_policies, references
from dopt import registry
from dopt.policies import POLICIES
from dopt.spec import config as spec_config
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from orchestrate.store import ConfigRow, Reader, TrialRow
from tests.analysis.conftest import SHORT
from tests.analysis.synthetic import fill, filled, make_grid, make_spec
from tests.paths import EXAMPLE, ROOT


def config(system: str, name: str, **sections: Mapping[str, object]) -> ConfigRow:
    spec = make_spec(system, name, 0, **sections)
    counts = dict.fromkeys(
        ("n_done", "n_diverged", "n_failed", "n_cancelled", "n_pending", "n_running"), 0
    )
    mapping = json.loads(spec.config_json)
    return ConfigRow(spec.config_key, **spec.columns(), **counts, config=mapping)  # type: ignore[arg-type]


def choice(*counted: tuple[ConfigRow, int]) -> list[ConfigRow]:
    """Return which configurations are chosen, given their numbers of trials."""
    given = {one.config_key: one for one, _ in counted}
    found = choose(replace(one, n_done=n) for one, n in counted)
    return [given[one.config_key] for one in found]


WIDE = {"model": {"width": 64}}
NARROW = {"model": {"width": 8}}
GAMMA = {"env": {"gamma": 3.0}}
FAR = {"policy": {"lookahead": 20}}
ASSESSED = {"task": {"name": "control", "checkpoints": [100]}}


@pytest.mark.parametrize(
    ("counted", "chosen"),
    [
        # The setting with most trials of the reference decides for all policies.
        ([("d_optimal", WIDE, 20), ("d_optimal", {}, 100), ("random", {}, 10),
          ("random", WIDE, 50)], [1, 2]),
        ([("d_optimal", {}, 5), ("oracle", GAMMA, 9)], [0]),  # another world is never mixed in
        ([("random", WIDE, 3), ("random", {}, 4)], [1]),  # without the reference the commonest
        # More trials of the baselines settle a tie of the reference.
        ([("d_optimal", WIDE, 20), ("d_optimal", NARROW, 20), ("random", NARROW, 20)], [1, 2]),
        # A task is no departure, but the last to decide.
        ([("lookahead", FAR, 5), ("lookahead", ASSESSED, 5)], [1]),
        ([("lookahead", ASSESSED, 5), ("lookahead", {}, 5), ("lookahead", FAR, 5)], [1]),
    ],
)  # fmt: skip
def test_one_setting_is_chosen(
    counted: list[tuple[str, dict[str, dict[str, object]], int]], chosen: list[int]
) -> None:
    given = [(config("pendulum", policy, **more), n) for policy, more, n in counted]
    assert choice(*given) == [given[i][0] for i in chosen]


def test_a_tie_names_the_difference_and_the_way_out() -> None:
    wide, narrow = (config("pendulum", "d_optimal", **size) for size in (WIDE, NARROW))
    with pytest.raises(AnalysisError, match=r"20 trials each.*model\.width.*--where model\.width="):
        choice((wide, 20), (narrow, 20))


def test_between_learners_with_equal_trials_the_usual_one_decides() -> None:
    learners = {name: {"learner": {"name": name}} for name in ("adam_window", "ekf", "adam_replay")}
    configs = {
        (policy, name): config("pendulum", policy, **learner)
        for policy in ("d_optimal", "random")
        for name, learner in learners.items()
    }
    chosen = choice(*((one, 5) for one in configs.values()))
    assert chosen == [configs["d_optimal", "adam_window"], configs["random", "adam_window"]]


def test_what_is_usual_is_what_a_launch_takes() -> None:
    listed = OmegaConf.load(ROOT / "conf" / "config.yaml").defaults
    groups = [one for one in listed if isinstance(one, DictConfig)]
    taken = {key: option for group in groups for key, option in group.items()}
    assert {group: taken[group] for group in USUAL} == USUAL


def test_the_advice_on_a_tie_names_what_all_of_them_have() -> None:
    filters = [
        config("pendulum", "d_optimal", learner={"name": "ekf", "forgetting": value})
        for value in (0.9, 0.95)
    ]
    with pytest.raises(AnalysisError, match=r"differ in learner\.forgetting .* --where learner\."):
        choice(*((one, 5) for one in filters))
    path, values = difference([filters[0].config, config("pendulum", "d_optimal").config])
    assert (path, values) == ("learner.name", ["ekf", "adam_window"])
    assert difference([filters[0].config] * 2)[0] == "config_key"


def test_filter_by_value() -> None:
    wide = config("pendulum", "d_optimal", **WIDE)
    assert Filter(where={"model.width": 64}).accepts(wide)
    assert Filter(where={"env.gamma": int(wide.gamma)}).accepts(wide) == wide.gamma.is_integer()
    assert not Filter(where={"model.width": 16}).accepts(wide)
    assert not Filter(environments=("arm",)).accepts(wide)
    assert not Filter(policies=("random",)).accepts(wide)
    assert Filter(where={"model.width": 64}).accepts(config("pendulum", "oracle")), "has none"


OLD, NEW = "a" * 16, "b" * 16
SECTION = {"_target_": "vehicle.Boat", "name": "boat", "horizon": 20}


@pytest.fixture(autouse=True)
def _vehicle(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    yield
    sys.modules.pop("vehicle", None)


@pytest.fixture
def place(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path}/results.db"


def run(
    place: str, digest: str, policies: Iterable[str], n: int, monkeypatch: pytest.MonkeyPatch
) -> set[str]:
    """Store n seeds of the boat as a file of this digest defines it, and return their keys."""
    monkeypatch.setattr(registry, "source_digest", lambda _: digest)
    specs = [make_spec("boat", name, seed, env=SECTION) for name in policies for seed in range(n)]
    keys = {spec.config_key for spec in specs}
    fill(place, specs)
    return keys


def shown(place: str, wanted: Filter | None = None) -> tuple[set[str], tuple[str, ...]]:
    with Reader.open(place) as reader:
        selection = select(reader, wanted or Filter())
    return {entry.config.config_key for entry in selection.entries}, selection.notes


def test_the_trials_of_the_edited_file_are_shown(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = run(place, OLD, ("d_optimal", "random"), 3, monkeypatch)
    assert shown(place) == (old, ())
    new = run(place, NEW, ("d_optimal", "random"), 2, monkeypatch)
    assert shown(place) == (
        new,
        (
            f"boat: env.source differs, as the file of vehicle.Boat was edited: these trials have "
            f"{NEW}, trials of other states of the file are left out "
            f"(see --where env.source={OLD})",
        ),
    )
    assert shown(place, Filter(where={"env.source": OLD}))[0] == old
    assert shown(place, Filter(group_by=("policy", "env.source")))[0] == old | new
    with analysis.load(place) as results:
        assert set(results.trials().config_key) == new


def test_more_seeds_of_a_restored_file_are_the_last(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = run(place, OLD, ("d_optimal",), 1, monkeypatch)
    run(place, NEW, ("d_optimal",), 3, monkeypatch)
    assert run(place, OLD, ("d_optimal",), 2, monkeypatch) == old
    assert shown(place)[0] == old


def test_trials_of_two_files_are_not_compared(place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    old = run(place, OLD, ("d_optimal", "uniform"), 2, monkeypatch)
    run(place, NEW, ("random",), 2, monkeypatch)
    keys, notes = shown(place)
    assert keys == old
    assert any(f"env.source={NEW}" in note for note in notes)


def test_a_digest_of_digits_is_quoted() -> None:
    assert _argument("610137dcd1408bef") == "610137dcd1408bef"
    assert _argument("1234567890123456") == "'\"1234567890123456\"'"
    assert _argument("12345678901234e5") == "'\"12345678901234e5\"'"


def selected(folder: Path, *fillings: tuple[list[TrialSpec], list[TrialSpec]]) -> Selection:
    address = f"sqlite:///{folder}/results.db"
    for specs, skipped in fillings:
        fill(address, specs, skipped=skipped)
    with Reader.open(address) as reader:
        return select(reader, Filter())


def test_a_complete_grid_has_no_gap_though_periodic_cannot_fly(reader: Reader) -> None:
    selection = select(reader, Filter())
    assert selection.gaps == ()
    assert selection.environments == ("pendulum", "cartpole", "quadrotor")
    found = [entry.config.policy for entry in selection.of("quadrotor")]
    assert found == ["d_optimal", "oracle", "uniform", "random"]


def test_a_diverged_trial_is_finished_and_has_no_final_loss(reader: Reader) -> None:
    (entry,) = select(reader, Filter(("cartpole",), ("random",))).entries
    assert len(entry.finished) == 5
    assert sorted(entry.final_losses()) == [0, 1, 3, 4]


def test_pending_trials_are_a_gap(tmp_path: Path) -> None:
    specs = make_grid(("pendulum",), ("d_optimal", "random"), range(6), **SHORT)
    skipped = [s for s in specs if s.policy.name == "random" and s.seed in (1, 2, 5)]
    (gap,) = selected(tmp_path, (specs, skipped)).gaps
    assert (gap.env, gap.policy, gap.states) == ("pendulum", "random", "3 pending")
    assert ranges(gap.seeds) == "1-2, 5"


def test_seeds_that_only_another_policy_has_are_a_gap(tmp_path: Path) -> None:
    specs = make_grid(("pendulum",), ("d_optimal",), range(4), **SHORT)
    specs += make_grid(("pendulum",), ("random",), range(3), **SHORT)
    (gap,) = selected(tmp_path, (specs, [])).gaps
    assert (gap.policy, gap.seeds, gap.states) == ("random", (3,), "1 not registered")


def test_a_policy_that_an_environment_lacks_is_a_gap_where_it_makes_sense(tmp_path: Path) -> None:
    specs = make_grid(("pendulum",), ("d_optimal", "periodic"), range(2), **SHORT)
    specs += make_grid(("cartpole", "quadrotor"), ("d_optimal",), range(2), **SHORT)
    (gap,) = selected(tmp_path, (specs, [])).gaps
    assert (gap.env, gap.policy, gap.seeds) == ("cartpole", "periodic", (0, 1))


def test_other_configurations_are_noted(tmp_path: Path) -> None:
    specs = make_grid(("pendulum",), ("d_optimal", "random"), range(3), **SHORT)
    single = make_spec("pendulum", "random", 0, env={"gamma": 0.5, "horizon": 60})
    selection = selected(tmp_path, (specs, []), ([single], []))
    assert selection.gaps == ()
    assert len(selection.entries) == 2
    assert selection.notes == ("pendulum: 1 other stored configuration left out (see --where)",)


def test_assessments_of_different_versions_do_not_mix(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = {"task": {"name": "control", "checkpoints": [10]}}
    policies = ("d_optimal", "random")
    plain = make_grid(("pendulum",), policies, range(2))
    new = make_grid(("pendulum",), policies, range(2), **task)
    keys = {one.trial_key for one in (*plain, *new)}
    monkeypatch.setattr(spec_config, "ASSESSMENT_VERSION", 1)
    old = make_grid(("pendulum",), policies, range(2), **task)
    assert keys.isdisjoint(one.trial_key for one in old)
    with filled(tmp_path, [*plain, *old, *new]) as opened:
        kept = {row.config_key for row in newest(list(opened.configs()))}
    assert kept == {one.config_key for one in (*plain, *new)}


def test_fingerprint_tells_outcomes_apart(tmp_path: Path, reader: Reader) -> None:
    whole = select(reader, Filter())
    assert whole.fingerprint() == select(reader, Filter()).fingerprint()
    assert whole.fingerprint() != whole.only(["pendulum"]).fingerprint()
    specs = make_grid(("pendulum",), ("random",), range(2), **SHORT)
    before = selected(tmp_path, (specs, specs[:1])).fingerprint()
    assert before != selected(tmp_path, (specs, [])).fingerprint()


def test_every_registered_name_has_a_place_in_the_order() -> None:
    assert len({policy_rank(name)[0] for name in POLICIES}) == len(POLICIES)
    assert len({environment_rank(name)[0] for name in SYSTEMS}) == len(SYSTEMS)


@pytest.fixture(scope="module")
def bounds_url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a database of two policies under three bounds of the input."""
    url = f"sqlite:///{tmp_path_factory.mktemp('bounds')}/results.db"
    specs = []
    for gamma in (2, 3, 10):
        env = {"horizon": 40, "gamma": gamma}
        specs += make_grid(("pendulum",), ("d_optimal", "random"), range(4), env=env)
    fill(url, specs)
    return url


@pytest.fixture
def bounds(bounds_url: str) -> Iterator[Reader]:
    with Reader.open(bounds_url) as opened:
        yield opened


def test_each_value_is_shown_once_in_the_order_of_the_numbers(bounds: Reader) -> None:
    selection = select(bounds, Filter(group_by=("env.gamma",)))
    assert selection.labels == ("γ=2", "γ=3", "γ=10")
    assert {entry.config.policy for entry in selection.entries} == {"d_optimal"}
    one = select(bounds, Filter(policies=("random",), group_by=("gamma",)))
    assert {entry.config.policy for entry in one.entries} == {"random"}


@pytest.mark.parametrize(
    ("given", "name"), [("d_optimal", "γ=2"), ("10.0", "γ=10"), ("γ=3", "γ=3")]
)
def test_values_are_compared_with_the_default_or_the_one_that_is_named(
    bounds: Reader, given: str, name: str
) -> None:
    table = compare_policies(
        bounds, select(bounds, Filter(reference=given, group_by=("env.gamma",)))
    )
    assert set(table.reference) == {name}
    assert len(table) == 2


def test_policies_are_compared_under_the_same_setting(
    bounds_url: str, bounds: Reader, capsys: pytest.CaptureFixture[str]
) -> None:
    table = compare_policies(bounds, select(bounds, Filter(group_by=("policy", "env.gamma"))))
    assert dict(zip(table.variant, table.reference, strict=True)) == {
        f"random, γ={gamma}": f"D-optimal, γ={gamma}" for gamma in (2, 3, 10)
    }
    assert main(["compare", "--db", bounds_url, "--group-by", "policy", "env.gamma"]) == 0
    assert "| reference (same env.gamma) " in capsys.readouterr().out
    named = Filter(reference="D-optimal, γ=3", group_by=("policy", "env.gamma"))
    table = compare_policies(bounds, select(bounds, named))
    assert set(table.reference) == {"D-optimal, γ=3"}
    assert len(table) == 5


GROUPS = [
    (policy, gamma, width)
    for policy in ("d_optimal", "random", "uniform")
    for gamma in (2.0, 3.0)
    for width in (4, 8)
]


@given(
    chosen=st.lists(st.sampled_from(GROUPS), min_size=1, unique=True),
    reference=st.sampled_from(["d_optimal", "random"]),
    diverged=st.sets(st.sampled_from(GROUPS)),
)
def test_a_reference_differs_in_the_policy_alone_wherever_it_is_stored(
    chosen: list[tuple[str, float, int]], reference: str, diverged: set[tuple[str, float, int]]
) -> None:
    entries = tuple(entry(*one, diverged=one in diverged) for one in chosen)
    keys = ("policy", "env.gamma", "width")
    selection = Selection(entries, reference=reference, group_by=keys)
    overall = selection.reference_of("pendulum")
    rows = list(references(selection, "pendulum"))
    assert len({id(one) for one, _, _ in rows}) == len(rows)
    for one, other, same in rows:
        stored = (reference, *one.group[1:])
        assert one is not other
        assert same == (stored in chosen and stored not in diverged and one.group != stored)
        assert other.group == stored if same else other is overall
    left_out = [one for one in entries if all(one is not row[0] for row in rows)]
    if overall is not None:
        assert {one.config.policy for one in left_out} <= {overall.config.policy}
        assert all(one is overall or one.config.policy == reference for one in left_out)


def entry(policy: str, gamma: float, width: int, *, diverged: bool) -> Entry:
    """Return a configuration with one trial."""
    specification = make_spec("pendulum", policy, 0, env={"gamma": gamma}, model={"width": width})
    config = {k: v for k, v in specification.to_mapping().items() if k != "seed"}
    row = ConfigRow(
        *(f"{policy}{gamma}{width}", "pendulum", policy, "mlp", "adam_window", width, 2, 40, 0.02),
        *(gamma, "", 1, 0, 0, 0, 0, 0, config),
    )
    values = dict.fromkeys(one.name for one in dataclasses.fields(TrialRow))
    status, loss = ("diverged", None) if diverged else ("done", 1.0)
    trial = TrialRow(**values | {"seed": 0, "status": status, "final_loss": loss})  # type: ignore[arg-type]
    return Entry(row, (trial,), f"{policy}, {gamma}, {width}", (policy, gamma, width))


def test_a_setting_that_nothing_has_is_a_sentence(bounds: Reader) -> None:
    with pytest.raises(AnalysisError, match=r"'env.gama' is no setting .* env.gamma"):
        select(bounds, Filter(group_by=("env.gama",)))


def test_outputs_are_grouped_by_settings(bounds_url: str, tmp_path: Path) -> None:
    grouped = ["--group-by", "policy", "env.gamma"]
    only = ["--only", "figure1", "--only", "summary", "--out", str(tmp_path)]
    assert main(["figures", "--db", bounds_url, *only, *grouped]) == 0
    table = (tmp_path / "figure1.csv").read_text().splitlines()
    assert {line.split(",")[2] for line in table[1:]} == {'"D-optimal', '"random'}
    assert "| random, γ=10 |" in " ".join((tmp_path / "summary.md").read_text().split())
