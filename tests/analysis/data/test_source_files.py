"""Trials of an edited file of a user's class: which are shown, and what is said of the others."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

import analysis
from analysis.data.config_matching import Filter
from analysis.data.source_files import _argument
from analysis.data.trial_selection import select
from dopt.declare import registry
from orchestrate.store import Reader
from tests.analysis.synthetic import fill, make_spec
from tests.paths import EXAMPLE

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
