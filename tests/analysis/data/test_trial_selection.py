from __future__ import annotations

from pathlib import Path

import pytest

from analysis.data.config_matching import Filter
from analysis.data.latest_configs import newest
from analysis.data.missing_trials import ranges
from analysis.data.trial_selection import Selection, environment_rank, policy_rank, select
from analysis.errors import AnalysisError
from dopt.policies import POLICIES
from dopt.spec import config
from dopt.spec.trial import TrialSpec
from dopt.systems import SYSTEMS
from orchestrate.store import Reader
from tests.analysis.conftest import SHORT
from tests.analysis.synthetic import fill, make_grid, make_spec


def stored(folder: Path, *fillings: tuple[list[TrialSpec], list[TrialSpec]]) -> Selection:
    address = f"sqlite:///{folder}/results.db"
    for specs, skipped in fillings:
        fill(address, specs, skipped=skipped)
    with Reader.open(address) as reader:
        return select(reader, Filter())


def test_a_complete_grid_has_no_gap_though_periodic_cannot_fly(reader: Reader) -> None:
    selection = select(reader, Filter())
    assert selection.gaps == ()
    assert selection.environments == ("pendulum", "cartpole", "quadrotor")
    assert selection.policies == ("d_optimal", "oracle", "uniform", "periodic", "random")
    assert [entry.config.policy for entry in selection.of("quadrotor")] == [
        "d_optimal",
        "oracle",
        "uniform",
        "random",
    ]


def test_a_diverged_trial_is_finished_and_has_no_final_loss(reader: Reader) -> None:
    (entry,) = select(reader, Filter(("cartpole",), ("random",))).entries
    assert len(entry.finished) == 5
    assert sorted(entry.final_losses()) == [0, 1, 3, 4]


def test_pending_trials_are_a_gap(tmp_path: Path) -> None:
    specs = make_grid(("pendulum",), ("d_optimal", "random"), range(6), **SHORT)
    skipped = [s for s in specs if s.policy.name == "random" and s.seed in (1, 2, 5)]
    (gap,) = stored(tmp_path, (specs, skipped)).gaps
    assert (gap.env, gap.policy, gap.states) == ("pendulum", "random", "3 pending")
    assert gap.describe_seeds() == "1-2, 5"


def test_seeds_that_only_another_policy_has_are_a_gap(tmp_path: Path) -> None:
    specs = make_grid(("pendulum",), ("d_optimal",), range(4), **SHORT)
    specs += make_grid(("pendulum",), ("random",), range(3), **SHORT)
    (gap,) = stored(tmp_path, (specs, [])).gaps
    assert (gap.policy, gap.seeds, gap.states) == ("random", (3,), "1 not registered")


def test_a_policy_that_an_environment_lacks_is_a_gap_where_it_makes_sense(tmp_path: Path) -> None:
    specs = make_grid(("pendulum",), ("d_optimal", "periodic"), range(2), **SHORT)
    specs += make_grid(("cartpole", "quadrotor"), ("d_optimal",), range(2), **SHORT)
    (gap,) = stored(tmp_path, (specs, [])).gaps
    assert (gap.env, gap.policy, gap.seeds) == ("cartpole", "periodic", (0, 1))


def test_other_configurations_are_noted(tmp_path: Path) -> None:
    specs = make_grid(("pendulum",), ("d_optimal", "random"), range(3), **SHORT)
    single = make_spec("pendulum", "random", 0, env={"gamma": 0.5, "horizon": 60})
    selection = stored(tmp_path, (specs, []), ([single], []))
    assert selection.gaps == ()
    assert len(selection.entries) == 2
    assert selection.notes == (
        "pendulum: 1 other stored configurations are not part of this (see --where)",
    )


def test_assessments_of_different_versions_do_not_mix(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = {"task": {"name": "control", "checkpoints": [10]}}
    policies = ("d_optimal", "random")
    plain = make_grid(("pendulum",), policies, range(2))
    new = make_grid(("pendulum",), policies, range(2), **task)
    keys = {one.trial_key for one in (*plain, *new)}
    monkeypatch.setattr(config, "ASSESSMENT_VERSION", 1)
    old = make_grid(("pendulum",), policies, range(2), **task)
    assert keys.isdisjoint(one.trial_key for one in old)
    url = f"sqlite:///{tmp_path}/versions.db"
    fill(url, [*plain, *old, *new])
    with Reader.open(url) as opened:
        kept = {row.config_key for row in newest(list(opened.configs()))}
    assert kept == {one.config_key for one in (*plain, *new)}


def test_fingerprint_tells_outcomes_apart(tmp_path: Path, reader: Reader) -> None:
    whole = select(reader, Filter())
    assert whole.fingerprint() == select(reader, Filter()).fingerprint()
    assert whole.fingerprint() != whole.only(["pendulum"]).fingerprint()
    specs = make_grid(("pendulum",), ("random",), range(2), **SHORT)
    before = stored(tmp_path, (specs, specs[:1])).fingerprint()
    assert before != stored(tmp_path, (specs, [])).fingerprint()


@pytest.mark.parametrize(
    ("wanted", "sentence"),
    [
        (Filter(("submarine",)), r"environment 'submarine', choose one of cartpole, pendulum"),
        (Filter(policies=("greedy",)), r"policy 'greedy', choose one of d_optimal"),
        (Filter(("quadrotor",), ("periodic",)), r"No configuration .* fits"),
    ],
)
def test_requests_without_an_answer_are_sentences(
    reader: Reader, wanted: Filter, sentence: str
) -> None:
    with pytest.raises(AnalysisError, match=sentence):
        select(reader, wanted)


def test_every_registered_name_has_a_place_in_the_order() -> None:
    assert len({policy_rank(name)[0] for name in POLICIES}) == len(POLICIES)
    assert len({environment_rank(name)[0] for name in SYSTEMS}) == len(SYSTEMS)


def test_ranges() -> None:
    assert ranges([4, 0, 1, 2, 7, 8]) == "0-2, 4, 7-8"
    assert ranges([]) == ""
