"""Trials that were stored before a field existed are found, compared and grouped by it."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

from analysis.cli import main
from analysis.data.matching import Filter, defaults, nearness, newest
from analysis.data.selection import select
from analysis.errors import AnalysisError
from analysis.tables.comparisons import compare_policies
from dopt.spec.trial import TrialSpec
from orchestrate.store import Reader
from tests.analysis.synthetic import fill, make_grid

PATH = "policy.information"
SHORT = {"env": {"horizon": 40}}
FRESH = {"policy": {"information": "fresh"}}


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a database with trials of before the field, as they were written, and of after."""
    url = f"sqlite:///{tmp_path_factory.mktemp('added')}/results.db"
    fill(url, make_grid(("pendulum",), ("d_optimal", "random"), range(5), **SHORT))
    fill(url, make_grid(("pendulum",), ("d_optimal",), range(5), **SHORT, **FRESH))
    return url


@pytest.fixture
def stored(url: str) -> Iterator[Reader]:
    with Reader.open(url) as opened:
        yield opened


def information(reader: Reader, **where: object) -> list[object]:
    """Return the values of the entries of D-optimal that a condition accepts."""
    wanted = Filter(policies=("d_optimal",), where=where)
    return [entry.config.config["policy"]["information"] for entry in select(reader, wanted).stored]


def test_the_old_rows_are_those_without_the_field(url: str) -> None:
    with sqlite3.connect(url.removeprefix("sqlite:///")) as connection:
        texts = [row[0] for row in connection.execute("SELECT config_json FROM config")]
    assert sum('"information"' in text for text in texts) == 1
    assert len(texts) == 3


def test_a_condition_tells_the_values_apart(stored: Reader) -> None:
    assert information(stored, **{PATH: "accumulated"}) == ["accumulated"]
    assert information(stored, **{PATH: "fresh"}) == ["fresh"]
    assert sorted(map(str, information(stored))) == ["accumulated", "fresh"]
    assert information(stored, **{"policy.refresh_every": 1}) == ["accumulated", "fresh"]
    with pytest.raises(AnalysisError, match='stored are "accumulated", "fresh"'):
        select(stored, Filter(where={PATH: "old"}))


def test_the_condition_finds_trials_that_are_all_old(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/results.db"
    fill(url, make_grid(("pendulum",), ("d_optimal",), range(2), **SHORT))
    with Reader.open(url) as reader:
        assert information(reader, **{PATH: "accumulated"}) == ["accumulated"]
        with pytest.raises(AnalysisError, match='stored are "accumulated": choose'):
            select(reader, Filter(where={PATH: "fresh"}))


def test_the_values_are_grouped_and_compared(stored: Reader) -> None:
    selection = select(stored, Filter(group_by=(PATH,)))
    assert selection.labels == ("information=accumulated", "information=fresh")
    assert [len(entry.trials) for entry in selection.entries] == [5, 5]
    table = compare_policies(stored, selection)
    assert list(table.variant) == ["information=fresh"]
    assert list(table.reference) == ["information=accumulated"]


def test_the_usual_value_stands_for_the_policy(stored: Reader) -> None:
    entries = select(stored, Filter()).entries
    assert [entry.config.config["policy"].get("information") for entry in entries] == [
        "accumulated",
        None,
    ]
    assert [entry.label for entry in entries] == ["D-optimal", "random"]
    old, new = sorted(stored.configs(), key=lambda one: "fresh" in one.label)[0::2]
    assert defaults(old)[PATH] == "accumulated"
    assert nearness(old) > nearness(new)


def test_stored_labels_name_what_is_not_usual(stored: Reader) -> None:
    labels = sorted(config.label for config in stored.configs())
    assert labels == [
        "D-optimal, horizon 40",
        "D-optimal, horizon 40, information=fresh",
        "random, horizon 40",
    ]


def test_commands_take_the_condition(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "--db", url, "--group-by", PATH]) == 0
    assert "information=fresh" in capsys.readouterr().out
    assert main(["compare", "--db", url, "--where", f"{PATH}=accumulated"]) == 0
    assert "random" in capsys.readouterr().out


def test_a_stored_configuration_gives_back_its_trial(stored: Reader) -> None:
    for config in stored.configs():
        content = {k: v for k, v in config.config.items() if k != "code_version"}
        assert TrialSpec.from_mapping(content).config_key == config.config_key


def test_a_new_criterion_replaces_the_old_one_of_the_same_configuration(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/results.db"
    noisy = {"learner": {"name": "ekf", "noise_variance": 0.5}}
    fill(url, make_grid(("pendulum",), ("exact", "d_optimal"), range(2), **SHORT, **noisy))
    with Reader.open(url) as reader:
        configs = reader.configs()
    exact = next(config for config in configs if config.policy == "exact")
    content = {k: v for k, v in exact.config.items() if k != "criterion_version"}
    assert len(content) == len(exact.config) - 1
    old = type(exact)(**{**vars(exact), "config": json.loads(json.dumps(content))})
    assert newest([*configs, old]) == configs
    assert newest([old]) == [old]
