"""Each kind of damage is found, named, and left as it is, on every database."""

from __future__ import annotations

import hashlib
import random
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest

from orchestrate.store import Claim, Reader, Store, StoreError
from orchestrate.store.maintenance import Finding, examine
from orchestrate.store.schema import STEP_VALUES
from tests.orchestrate.store.databases import columns, contents, execute, file_of
from tests.orchestrate.store.fakes import LAUNCH, RUN, Spec, assessed, diverged, result, run_all

Take = Callable[..., list[Claim]]


@pytest.fixture
def grid(store: Store, launch: int, take: Take, url: str) -> str:
    """Three finished trials of two policies each, one of them diverged; return the URL."""
    specs = [Spec(seed, policy=policy) for policy in ("random", "uniform") for seed in range(3)]
    for claim, spec in zip(take(*specs), specs, strict=True):
        store.commit(claim, diverged(3) if spec.seed == 1 else result(spec.seed), RUN)
    store.end_launch(launch, "done")
    return url


def harm(url: str, *statements: str) -> None:
    for statement in statements:
        execute(url, statement)


def only(url: str) -> Finding:
    """Return the one finding; nothing in the database may have changed."""
    before = contents(url, columns(url))
    (found,) = examine(url)
    assert contents(url, columns(url)) == before
    return found


def test_results_of_different_code_are_noted(grid: str) -> None:
    more = "token, state, started, host, pid, argv, overrides, versions"
    copied = more.replace("token", "'another'")
    harm(
        grid,
        """UPDATE launch SET fingerprint = '{"code of dopt": "a"}'""",
        f"INSERT INTO launch ({more}) SELECT {copied} FROM launch",
        "UPDATE trial SET launch_id = 2 WHERE trial_id = 1",
    )
    assert examine(grid) == [], "the code of an older program is unknown"
    harm(grid, """UPDATE launch SET fingerprint = '{"code of dopt": "b"}' WHERE launch_id = 2""")
    one = only(grid)
    assert (one.severity, one.count) == ("note", 1)
    assert "with different fingerprints" in one.sentence


def test_nothing_is_wrong(grid: str) -> None:
    assert examine(grid) == []


@pytest.mark.parametrize(
    ("harms", "severity", "words", "count"),
    [
        ("DELETE FROM step WHERE trial_id = 3 AND t = 6", "error", "one step for each t", 1),
        ("DELETE FROM step WHERE trial_id = 1 AND t = 2", "error", "one step for each t", 1),
        ("UPDATE step SET t = 7 WHERE t = 6 AND trial_id = 4", "error", "one step for each t", 1),
        ("DELETE FROM trajectory WHERE trial_id < 3", "error", "without a trajectory", 2),
        ("UPDATE step SET loss = NULL WHERE trial_id = 1 AND t = 2", "error", "lack a loss", 1),
        ("UPDATE step SET loss = 1.0 WHERE trial_id = 2 AND t = 5", "error", "one after that", 1),
        ("UPDATE trial SET final_loss = 9.0 WHERE trial_id = 1", "error", "final loss", 1),
        ("UPDATE trial SET best_loss = {inf} WHERE trial_id = 1", "error", "not finite", 1),
        ("UPDATE step SET plan_us = {inf} WHERE t = 0", "error", "not finite", 6),
        ("UPDATE config SET config_json = '{}' WHERE config_id = 1", "error", "configurations", 1),
        ("UPDATE trial SET seed = 77 WHERE trial_id = 1", "error", "trials whose key", 1),
        ("UPDATE launch SET state = 'running'", "note", "launches recorded as running", 1),
    ],
)  # fmt: skip
def test_damage_is_found(grid: str, harms: str, severity: str, words: str, count: int) -> None:
    infinity = "9e999" if grid.startswith("sqlite") else "'infinity'"
    harm(grid, harms.replace("{inf}", infinity))
    before = contents(grid, columns(grid))
    findings = examine(grid)
    assert contents(grid, columns(grid)) == before
    found = next(one for one in findings if words in one.sentence)
    assert (found.severity, found.count) == (severity, count)
    assert f": {count}" in found.sentence
    assert found.advice


@pytest.mark.parametrize(
    ("harms", "words"),
    [
        ("DELETE FROM assessment WHERE trial_id = 1 AND t = 3", "that lack assessments: 1"),
        ("DELETE FROM assessment WHERE trial_id = 1", "that lack assessments: 1"),
        (
            "UPDATE trial SET status = 'failed' WHERE trial_id = 1",
            "unfinished trials with steps, a trajectory or assessments: 1",
        ),
        ("UPDATE assessment SET value = {inf} WHERE trial_id = 2 AND t = 0", "not finite"),
    ],
)
def test_damaged_assessments(store: Store, take: Take, url: str, harms: str, words: str) -> None:
    for claim, seed in zip(take(Spec(0), Spec(1)), (0, 1), strict=True):
        store.commit(claim, assessed(seed), RUN)
    store.end_launch(1, "done")
    assert examine(url) == []
    infinity = "9e999" if url.startswith("sqlite") else "'infinity'"
    harm(url, harms.replace("{inf}", infinity))
    assert words in " ".join(one.sentence for one in examine(url))


def test_a_task_without_an_assessment(store: Store, take: Take, url: str) -> None:
    (claim,) = take(Spec())
    store.commit(claim, result(), RUN)
    store.end_launch(1, "done")
    document = '{"task":{"name":"control"}}'
    digest = hashlib.sha256(document.encode()).hexdigest()
    harm(url, f"UPDATE config SET config_json = '{document}', config_key = '{digest}'")
    sentences = " ".join(one.sentence for one in examine(url))
    assert "done trials that lack assessments: 1" in sentences


def test_nan_in_postgresql(postgresql_url: str) -> None:
    run_all(postgresql_url, Spec())
    for name in STEP_VALUES[1:]:
        harm(postgresql_url, f"UPDATE step SET {name} = 'NaN' WHERE t = 1")
        assert "not finite" in only(postgresql_url).sentence
        harm(postgresql_url, f"UPDATE step SET {name} = 1.0 WHERE t = 1")


def test_claims_of_the_dead(url: str) -> None:
    with Store.open(url) as store:
        launch = store.begin_launch(LAUNCH)
        store.claim(launch, store.register(launch, [Spec(0), Spec(1)]).todo)
    harm(url, "UPDATE launch SET lease_until = 0")  # for SQLite the process is gone already
    found = examine(url)
    assert [(one.severity, one.count) for one in found] == [("note", 1), ("note", 2)]
    assert "trials held by launches that do not run: 2" in found[1].sentence


def test_a_launch_that_lives_is_no_finding(store: Store, take: Take, url: str) -> None:
    take(Spec(0))
    assert store.recover() == 0
    assert examine(url) == []


@pytest.fixture(scope="module")
def forty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a SQLite database with forty long trials, in one file."""
    path = tmp_path_factory.mktemp("forty") / "results.db"
    run_all(f"sqlite:///{path}", *(Spec(seed, horizon=300) for seed in range(40)))
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    return path


@pytest.fixture
def file(forty: Path, sqlite_url: str) -> Path:
    path = file_of(sqlite_url)
    path.parent.mkdir()
    shutil.copy(forty, path)
    return path


@pytest.mark.usefixtures("file")
def test_rows_that_refer_to_nothing(sqlite_url: str) -> None:
    harm(sqlite_url, "UPDATE trial SET error_id = 7 WHERE trial_id < 4")
    found = only(sqlite_url)
    assert "missing rows: 3, in trial" in found.sentence


@pytest.mark.parametrize("seed", range(10))
def test_overwritten_pages_are_never_read_as_numbers(
    file: Path, sqlite_url: str, seed: int
) -> None:
    """The doctor or the opening says that it is lost, and a reader fails or is right."""
    with Reader.open(sqlite_url) as reader:
        right = reader.curves(Spec(horizon=300).config_key).values.tolist()
    numbers = random.Random(seed)
    data = bytearray(file.read_bytes())
    page = numbers.randrange(len(data) // 4096)
    data[4096 * page : 4096 * (page + 1)] = numbers.randbytes(4096)
    file.write_bytes(data)
    try:
        findings = examine(sqlite_url)
    except StoreError as error:
        assert "damaged" in str(error) or "not a SQLite database" in str(error)  # noqa: PT017
        return
    assert findings[0].severity == "error"
    try:
        with Reader.open(sqlite_url) as reader:
            values = reader.curves(Spec(horizon=300).config_key).values.tolist()
    except StoreError as error:
        assert "damaged" in str(error)  # noqa: PT017
    else:
        assert values == right
