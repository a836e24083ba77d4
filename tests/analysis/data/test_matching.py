"""The configuration that stands for a policy, and the state of a user's file."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

import analysis
from analysis.data.matching import USUAL, Candidate, Filter, _argument, choose, difference, flatten
from analysis.data.selection import select
from analysis.errors import AnalysisError
from dopt import registry
from orchestrate.store import ConfigRow, Reader
from tests.analysis.synthetic import fill, make_spec
from tests.paths import EXAMPLE, ROOT


def config(system: str, name: str, **sections: Mapping[str, object]) -> ConfigRow:
    spec = make_spec(system, name, 0, **sections)
    counts = dict.fromkeys(
        ("n_done", "n_diverged", "n_failed", "n_cancelled", "n_pending", "n_running"), 0
    )
    mapping = json.loads(spec.config_json)
    return ConfigRow(spec.config_key, **spec.columns(), **counts, config=mapping)  # type: ignore[arg-type]


WIDE = {"model": {"width": 64}}


NARROW = {"model": {"width": 8}}


def test_the_setting_with_most_trials_of_the_reference_decides_for_all_policies() -> None:
    usual, wide = config("pendulum", "d_optimal"), config("pendulum", "d_optimal", **WIDE)
    random, more = config("pendulum", "random"), config("pendulum", "random", **WIDE)
    chosen = choose(
        [Candidate(wide, 20), Candidate(usual, 100), Candidate(random, 10), Candidate(more, 50)]
    )
    assert {entry.config_key for entry in chosen} == {usual.config_key, random.config_key}


def test_the_oracle_comes_with_the_model_of_its_own() -> None:
    usual, oracle = config("pendulum", "d_optimal"), config("pendulum", "oracle")
    assert choose([Candidate(usual, 5), Candidate(oracle, 9)]) == [usual, oracle]


def test_another_world_is_never_mixed_in() -> None:
    usual = config("pendulum", "d_optimal")
    oracle = config("pendulum", "oracle", env={"gamma": 3.0})
    assert choose([Candidate(usual, 5), Candidate(oracle, 9)]) == [usual]


def test_without_the_reference_the_commonest_setting_is_taken() -> None:
    few, many = config("pendulum", "random", **WIDE), config("pendulum", "random")
    assert choose([Candidate(few, 3), Candidate(many, 4)]) == [many]


def test_a_tie_names_the_difference_and_the_way_out() -> None:
    wide, narrow = (config("pendulum", "d_optimal", **size) for size in (WIDE, NARROW))
    with pytest.raises(AnalysisError, match=r"20 trials each.*model\.width.*--where model\.width="):
        choose([Candidate(wide, 20), Candidate(narrow, 20)])


def test_a_task_is_no_departure_but_the_last_to_decide() -> None:
    task = {"task": {"name": "control", "checkpoints": [100]}}
    plain = config("pendulum", "lookahead")
    assessed = config("pendulum", "lookahead", **task)
    far = config("pendulum", "lookahead", policy={"lookahead": 20})
    assert choose([Candidate(far, 5), Candidate(assessed, 5)]) == [assessed]
    assert choose([Candidate(assessed, 5), Candidate(plain, 5), Candidate(far, 5)]) == [plain]


def test_policies_under_other_limits_are_never_mixed_in() -> None:
    rail = {"bounds": {"y": [-2.0, 2.0]}}
    kinds = {
        "none": {},
        "counted": {"limits": {**rail, "enforced": False}},
        "enforced": {"limits": {**rail, "enforced": True}},
    }
    stored = {
        (policy, kind): config("cartpole", policy, **limits)
        for policy in ("d_optimal", "random", "oracle")
        for kind, limits in kinds.items()
    }

    def chosen(**trials: int) -> set[str]:
        pool = [Candidate(one, trials.get(kind, 0)) for (_, kind), one in stored.items()]
        kept = {one.config_key for one in choose([one for one in pool if one.n_trials])}
        return {kind for (_, kind), one in stored.items() if one.config_key in kept}

    assert chosen(none=5, counted=5, enforced=5) == {"none"}
    assert chosen(counted=5, enforced=5) == {"enforced"}
    assert chosen(none=3, counted=5) == {"counted"}
    reference, oracle = stored["d_optimal", "enforced"], stored["oracle", "none"]
    assert choose([Candidate(reference, 5), Candidate(oracle, 9)]) == [reference]


def test_of_learners_with_as_many_trials_that_of_a_launch_decides() -> None:
    learners = {name: {"learner": {"name": name}} for name in ("adam_window", "ekf", "adam_replay")}
    configs = {
        (policy, name): config("pendulum", policy, **learner)
        for policy in ("d_optimal", "random")
        for name, learner in learners.items()
    }
    chosen = choose([Candidate(one, 5) for one in configs.values()])
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
        choose([Candidate(one, 5) for one in filters])
    path, values = difference([filters[0].config, config("pendulum", "d_optimal").config])
    assert (path, values) == ("learner.name", ["ekf", "adam_window"])


def test_a_tie_between_variants_of_one_policy_is_an_error_too() -> None:
    mild, strong = (
        config("pendulum", "d_optimal", policy={"regularization": value}) for value in (1e-2, 1e-4)
    )
    with pytest.raises(AnalysisError, match=r"policy\.regularization"):
        choose([Candidate(mild, 5), Candidate(strong, 5)])


def test_more_trials_of_the_baselines_settle_a_tie_of_the_reference() -> None:
    wide, narrow = (config("pendulum", "d_optimal", **size) for size in (WIDE, NARROW))
    random = config("pendulum", "random", **NARROW)
    chosen = choose([Candidate(wide, 20), Candidate(narrow, 20), Candidate(random, 20)])
    assert chosen == [narrow, random]


def test_filter_by_value() -> None:
    wide = config("pendulum", "d_optimal", **WIDE)
    assert Filter(where={"model.width": 64}).accepts(wide)
    assert Filter(where={"env.gamma": int(wide.gamma)}).accepts(wide) == wide.gamma.is_integer()
    assert not Filter(where={"model.width": 16}).accepts(wide)
    assert not Filter(environments=("arm",)).accepts(wide)
    assert not Filter(policies=("random",)).accepts(wide)


def test_a_condition_says_nothing_of_a_model_without_the_value() -> None:
    assert Filter(where={"model.width": 64}).accepts(config("pendulum", "oracle"))


def test_a_condition_that_nothing_meets_is_a_sentence() -> None:
    configs = [config("pendulum", "oracle"), config("pendulum", "random")]
    with pytest.raises(AnalysisError, match=r"model\.with names no value .* model\.width"):
        Filter(where={"model.with": 16}).check_where(configs)
    with pytest.raises(AnalysisError, match=r"model\.width=9 fits no .* stored are 16"):
        Filter(where={"model.width": 9}).check_where(configs)


def test_flatten() -> None:
    assert flatten({"a": {"b": 1, "c": {"d": 2}}, "e": 3}) == {"a.b": 1, "a.c.d": 2, "e": 3}


def test_difference_of_equal_configurations_is_their_key() -> None:
    same = config("pendulum", "random").config
    assert difference([same, same])[0] == "config_key"


OLD, NEW = "a" * 16, "b" * 16


SECTION = {"_target_": "vehicle.Boat", "name": "boat", "horizon": 20}


@pytest.fixture(autouse=True)
def _vehicle(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    yield
    sys.modules.pop("vehicle", None)


@pytest.fixture
def url(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path}/results.db"


def run(
    url: str, digest: str, policies: Iterable[str], n: int, monkeypatch: pytest.MonkeyPatch
) -> set[str]:
    """Store n seeds of the boat as a file of this digest defines it, and return their keys."""
    monkeypatch.setattr(registry, "source_digest", lambda _: digest)
    specs = [make_spec("boat", name, seed, env=SECTION) for name in policies for seed in range(n)]
    keys = {spec.config_key for spec in specs}
    fill(url, specs)
    return keys


def shown(url: str, wanted: Filter | None = None) -> tuple[set[str], tuple[str, ...]]:
    with Reader.open(url) as reader:
        selection = select(reader, wanted or Filter())
    return {entry.config.config_key for entry in selection.entries}, selection.notes


def test_the_trials_of_the_edited_file_are_shown(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    old = run(url, OLD, ("d_optimal", "random"), 3, monkeypatch)
    assert shown(url) == (old, ())
    new = run(url, NEW, ("d_optimal", "random"), 2, monkeypatch)
    assert shown(url) == (
        new,
        (
            f"boat: env.source differs, as the file of vehicle.Boat was edited: these trials have "
            f"{NEW}, those of other states of the file are not part of this "
            f"(see --where env.source={OLD})",
        ),
    )
    assert shown(url, Filter(where={"env.source": OLD}))[0] == old
    assert shown(url, Filter(group_by=("policy", "env.source")))[0] == old | new
    with analysis.load(url) as results:
        assert set(results.trials().config_key) == new


def test_more_seeds_of_a_restored_file_are_the_last(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = run(url, OLD, ("d_optimal",), 1, monkeypatch)
    run(url, NEW, ("d_optimal",), 3, monkeypatch)
    assert run(url, OLD, ("d_optimal",), 2, monkeypatch) == old
    assert shown(url)[0] == old


def test_trials_of_two_files_are_not_compared(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    old = run(url, OLD, ("d_optimal", "uniform"), 2, monkeypatch)
    run(url, NEW, ("random",), 2, monkeypatch)
    keys, notes = shown(url)
    assert keys == old
    assert any(f"env.source={NEW}" in note for note in notes)


def test_a_digest_of_digits_is_quoted() -> None:
    assert _argument("610137dcd1408bef") == "610137dcd1408bef"
    assert _argument("1234567890123456") == "'\"1234567890123456\"'"
    assert _argument("12345678901234e5") == "'\"12345678901234e5\"'"
