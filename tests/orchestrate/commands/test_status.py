"""``status``: counts, failures by cause, launches, rate; once and watched."""

from __future__ import annotations

import io
import json
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from analysis.cli import main as analysis
from dopt.spec.trial import TrialSpec
from orchestrate.__main__ import main
from orchestrate.commands import plain
from orchestrate.commands.results import gather, grid_table
from orchestrate.executors.base import Event, InProcessExecutor, Task
from orchestrate.fingerprint import fingerprint
from orchestrate.program import UsageError, length_of_time, visible
from orchestrate.runner import start as runner
from orchestrate.runner import worker
from orchestrate.runner.start import Work
from orchestrate.store import Claim, ConfigRow, Failure, LaunchRecord, Reader, Store
from tests.orchestrate.commands.conftest import Answer, failure, on_both, run_now
from tests.orchestrate.runner.test_scheduler import Scripted, finish, keys
from tests.orchestrate.standins import quick, raising, unusable
from tests.orchestrate.standins import trial_of as short_trial
from tests.orchestrate.store.databases import execute
from tests.orchestrate.store.fakes import LAUNCH, Spec, result

Run = Callable[..., Answer]
Take = Callable[..., list[Claim]]


def rows(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines()]


@pytest.mark.usefixtures("grid")
class TestOnce:
    def test_counts_each_config(self, command: Run) -> None:
        table = rows(command("status").out)
        assert [" ".join(row) for row in table[:6]] == [
            "env label done of failed diverged running pending",
            "cartpole random, width=None 0 2 - - - 2",
            "cartpole random, width=8 0 1 - - 1 -",
            "pendulum d_optimal 0 3 2 1 - -",
            "pendulum random 3 3 - - - -",
            "total 3 9 2 1 1 2",
        ]

    @on_both
    def test_groups_failures_and_says_where(self, command: Run) -> None:
        out = command("status").out
        assert "2 trials (2 attempts), exception: pendulum/d_optimal" in out
        assert "ZeroDivisionError: seed 3 is broken" in out
        assert 'at "trial.py", line 7, in run' in out

    def test_says_who_works_on_it(self, command: Run, grid: int) -> None:
        assert f"{grid} on here, process 17, since " in command("status").out
        assert "alive for" in command("status").out

    @on_both
    def test_json(self, command: Run, grid: int) -> None:
        document = command("status", "--json").document
        assert document["trials"] == {
            **{"all": 9, "done": 3, "diverged": 1, "failed": 2},
            **{"cancelled": 0, "running": 1, "pending": 2},
        }
        assert document["complete"] is False
        assert document["per_second"] > 0
        assert document["seconds_left"] == pytest.approx(3 / document["per_second"])
        assert [config["n"] for config in document["configs"]] == [2, 1, 3, 3]
        (kind,) = document["failures"]
        assert (kind["cause"], kind["trials"], kind["attempts"]) == ("exception", 2, 2)
        assert kind["last_line"].startswith("ZeroDivisionError: seed")
        (launch,) = document["launches"]
        assert (launch["launch_id"], launch["alive"]) == (grid, True)

    def test_filters(self, command: Run) -> None:
        document = command("status", "--json", "--env", "cartpole").document
        assert {config["env"] for config in document["configs"]} == {"cartpole"}
        assert document["failures"] == []
        assert document["per_second"] == 0
        both = command("status", "--json", "--env", "pendulum", "cartpole", "--policy", "random")
        assert both.document["trials"]["all"] == 6

    def test_passwords_appear_nowhere(self, command: Run) -> None:
        for words in (["status"], ["status", "--json"], ["show", "--seed", "5", "--json"]):
            answer = command(*words)
            assert "hunter2" not in answer.out + answer.err


@on_both
@pytest.mark.parametrize("left", [True, False])
def test_a_dead_launch_is_called_dead_and_continued_where_it_left_something(
    open_store: Callable[..., Store], command: Run, left: bool
) -> None:
    dead = open_store()
    launch = dead.begin_launch(LAUNCH)
    (claim,) = dead.claim(launch, dead.register(launch, [Spec()]).todo)
    assert left or dead.commit(claim, result(), run_now())
    dead.close()
    with open_store()._backend.transaction() as connection:
        connection.exec_driver_sql("UPDATE launch SET lease_until = 0")  # long ago, on PostgreSQL
    said = command("status").out
    assert ": dead" in said
    assert (": dead; run the same launch command again to continue" in said) == left
    assert ("continue" in said) == left
    assert command("status", "--json").document["launches"][0]["alive"] is False


def test_without_a_launch_it_says_how_to_go_on(store: Store, command: Run) -> None:
    launch = store.begin_launch(LAUNCH)
    store.register(launch, [Spec()])
    store.end_launch(launch, "interrupted")
    assert "run the same launch command again to continue" in command("status").out


@on_both
def test_attempts_that_were_made_good_are_no_failed_trials(
    store: Store, take: Take, command: Run, launch: int
) -> None:
    (claim,) = take(Spec())
    store.fail(claim, failure(1, "killed"), run_now())
    store.retry("failed")
    (claim,) = store.claim(launch, [claim.trial_key])
    store.commit(claim, result(), run_now())
    (kind,) = command("status", "--json").document["failures"]
    assert (kind["cause"], kind["trials"], kind["attempts"]) == ("killed", 0, 1)


def test_the_death_of_a_worker_has_no_message(
    store: Store, take: Take, command: Run, launch: int
) -> None:
    (claim,) = take(Spec())
    store.release(launch, [claim.trial_key], "killed")
    failures = command("status").out.partition("Failures\n")[2].partition("\n\n")[0]
    assert failures.strip() == "0 trials (1 attempt), killed: pendulum/random"


@on_both
def test_the_rate_is_that_of_the_living(store: Store, take: Take, reader: Reader, url: str) -> None:
    for claim in take(*(Spec(seed) for seed in range(4))):
        store.commit(claim, result(), run_now())
    execute(url, f"UPDATE attempt SET ended = '2026-01-01' WHERE trial_id = {claim.trial_id}")
    status = gather(reader, reader.configs())
    assert 3 / 120 < status.rate <= 3
    store.end_launch(1, "done")
    assert gather(reader, reader.configs()).rate == 0


class TestTable:
    def configs(self, reader: Reader, store: Store, specs: Sequence[Spec]) -> list[ConfigRow]:
        store.register(store.begin_launch(LAUNCH), specs)
        return reader.configs()

    def test_many_configurations_are_counted_together(self, reader: Reader, store: Store) -> None:
        specs = [
            Spec(0, env, policy, width) for env in "ab" for policy in "xyz" for width in (1, 2)
        ]
        configs = self.configs(reader, store, specs)
        assert len(self.shown(configs, 12)) == 1 + 12 + 1
        merged = self.shown(configs, 11)
        assert merged[0][:5] == ["env", "policy", "configs", "done", "of"]
        assert merged[1][:5] == ["a", "x", "2", "0", "2"]
        assert len(merged) == 1 + 6 + 1
        assert self.shown(configs, 5)[1][:4] == ["a", "6", "0", "6"]
        assert self.shown(configs, 1)[-1][:4] == ["total", "12", "0", "12"]

    def test_what_tells_configurations_apart_is_shown(self, reader: Reader, store: Store) -> None:
        configs = self.configs(reader, store, [Spec(horizon=5), Spec(horizon=6)])
        table = self.shown(configs, 10)
        assert table[0][:2] == ["env", "label"]
        labels = {" ".join(row[:3]) for row in table[1:3]}
        assert labels == {"pendulum random, horizon=5", "pendulum random, horizon=6"}

    def shown(self, configs: list[ConfigRow], most: int) -> list[list[str]]:
        console = Console(file=io.StringIO(), width=200)
        console.print(grid_table(configs, most))
        return rows(console.file.getvalue())  # type: ignore[attr-defined]


EVIL = "\x1b]52;c;cm0gLXJmIH4=\x07\x1b[2J\x9b31m\r\u202egpj.exe\x00"
SHOWN = r"\x1b]52;c;cm0gLXJmIH4=\x07\x1b[2J\x9b31m\r\u202egpj.exe"
STORED = EVIL.rstrip("\0")


@pytest.fixture
def evil(store: Store, url: str) -> str:
    """Fill the database with texts that would command a terminal."""
    number = store.begin_launch(replace(LAUNCH, host=STORED, argv=("launch.py", STORED)))
    claims = store.claim(number, store.register(number, [Spec(0), Spec(1), Spec(2)]).todo)
    store.commit(claims[0], result(0), replace(run_now(), node=STORED))
    traceback = f"Traceback (most recent call last):\n  File {STORED}\nValueError: {STORED}"
    store.fail(claims[1], Failure("ValueError", STORED, traceback, "exception"), run_now())
    execute(url, f"UPDATE config SET label = '{STORED}', env = '{STORED}'")
    return url


def is_harmless(text: str) -> bool:
    return all(one in "\n\t" or unicodedata.category(one) not in ("Cc", "Cs") for one in text) and (
        not set(text) & set("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\u200e\u200f")
    )


@pytest.mark.parametrize(
    "words",
    [
        ["status", "--all"],
        ["show", "--seed", "0"],
        ["show", "--seed", "1"],
        ["query", "SELECT label, host, message FROM config, launch, error"],
        ["doctor"],
        ["prune", "--dry-run", "--older-than", "1s"],
        ["export", "trials", "/nowhere\x1b[2J/x.csv"],
        ["status", "--env", STORED + "x"],
    ],
    ids=" ".join,
)
def test_commands(evil: str, command: Callable[..., Answer], words: list[str]) -> None:  # noqa: ARG001
    answer = command(*words)
    assert is_harmless(answer.out + answer.err), ascii(answer.out + answer.err)


def test_what_is_shown(evil: str, command: Callable[..., Answer]) -> None:  # noqa: ARG001
    """Rich leaves a bell and the return to the beginning of a line out of its texts."""
    assert SHOWN.replace(r"\x07", "").replace(r"\r", "") in command("status").out
    assert f"ValueError: {SHOWN}" in command("show", "--seed", "1").out


def test_the_analysis(evil: str, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (
        ["summary"],
        ["summary", "--format", "latex"],
        ["compare"],
        ["summary", "--env", "x"],
    ):
        analysis([*words, "--db", evil, "--allow-partial"])
        output = capsys.readouterr()
        assert is_harmless(output.out + output.err), ascii(output.out + output.err)


def test_what_programs_read_stays_exact(evil: str, command: Callable[..., Answer]) -> None:  # noqa: ARG001
    sql = "SELECT label FROM config"
    assert command("query", "--csv", sql).out == f"label\n{STORED}\n"
    assert json.loads(command("query", "--json", sql).out)["rows"] == [[STORED]]


def test_colours_of_the_program_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    from orchestrate.commands import console

    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    screen = console()
    with screen.capture() as captured:
        screen.print(f"a{STORED}", style="bold red")
    assert captured.get().startswith("\x1b[1;31m")
    assert SHOWN.replace(r"\x07", "").replace(r"\r", "") in captured.get()


def test_letters_of_every_language_stay() -> None:
    text = "déjà vu, Ελληνικά, 日本語, עברית, العربية, 👩‍🔬 ∞\tµ\n"
    assert visible(text) == text
    assert visible(EVIL) == SHOWN + r"\x00"
    assert plain("a\x1b[31mb\r\nd").plain == "a\\x1b[31mb\\r\nd"


GRID = ("-m", "env=pendulum", "policy=random,uniform", "seed=range(3)", "env.horizon=5")
LEAVE = "launch.detach=true"

Launch = Callable[..., tuple[int, str, str]]


@pytest.fixture
def pull(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Launch:
    """Return a function that runs commands, and trials of stand-ins in this process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DOPT_DB", raising=False)
    monkeypatch.setattr(worker, "WORK", Work(raising))
    monkeypatch.setattr(runner, "make_executor", lambda _, run, __: InProcessExecutor(run))

    def run(*words: str) -> tuple[int, str, str]:
        code = main(words)
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return run


def test_a_launch_leaves_its_grid_to_workers(command_line: Launch, pull: Launch) -> None:
    code, said, _ = command_line(*GRID, LEAVE)
    assert code == 0
    assert "0 of 6 already done, 6 registered; start workers with" in said
    _, out, _ = pull("status")
    assert "registered a grid for workers" in out
    assert "No worker is running: start workers with python -m orchestrate work" in out
    code, out, _ = pull("work", "--until", "5m")
    assert (code, out.splitlines()[0].split(",")[0]) == (1, "6 trials wait")
    assert "4 trials done, 0 of them diverged, 2 failed" in out
    assert "2 failed: ZeroDivisionError" in out
    assert pull("work")[0] == 0
    assert "registered a grid for workers" not in pull("status")[1]


def test_a_worker_that_can_run_no_trial_hands_back_what_it_holds(
    command_line: Launch, pull: Launch, monkeypatch: pytest.MonkeyPatch
) -> None:
    command_line(*GRID, LEAVE)
    monkeypatch.setattr(worker, "WORK", Work(unusable))
    code, _, errors = pull("work", "--processes", "1")
    assert (code, errors.splitlines()[-1]) == (2, "error: the machine has no compiler: install one")
    monkeypatch.setattr(worker, "WORK", Work(quick))
    assert pull("work")[0] == 0


def test_a_trial_that_was_taken_away_is_not_run_twice_at_once(
    command_line: Launch, pull: Launch, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its lease had run out while it ran here, and it waits in the database again."""
    command_line(*GRID, LEAVE)

    def fate(chunk: Sequence[Task], _: int) -> list[Event]:
        executor.held -= {*keys(chunk)}
        if executor.held and len(executor.given) <= 3:
            with Store.open(f"sqlite:///{tmp_path}/results/results.db") as other:
                other.release(2)
        return finish(chunk)

    class Watched(Scripted):
        held = frozenset[str]()

        def start(self) -> None:
            self.slots = 1

        def submit(self, chunk: Sequence[Task]) -> None:
            super().submit(chunk)
            assert self.held.isdisjoint(keys(chunk))
            self.held |= {*keys(chunk)}

    executor = Watched(fate)
    monkeypatch.setattr(runner, "make_executor", lambda *_: executor)
    code, out, _ = pull("work")
    assert "results refused: the lease had run out" in out
    assert "6 trials done" in out
    assert code == 0


def test_a_launch_that_left_and_is_repeated_says_what_is_done(
    command_line: Launch, pull: Launch
) -> None:
    command_line(*GRID, LEAVE)
    pull("work")
    _, said, _ = command_line(*GRID, LEAVE, "launch.retry=failed")
    assert "4 of 6 already done, 2 registered" in said


def test_a_worker_ends_when_the_rest_cannot_run_here(
    command_line: Launch, pull: Launch, monkeypatch: pytest.MonkeyPatch
) -> None:
    command_line(*GRID, LEAVE)
    monkeypatch.setattr("orchestrate.runner.worker.memory_of_this_machine", lambda: 10)
    code, out, err = pull("work")
    assert code == 3
    assert "6 left" in out
    assert err.count("3 trials are left to other workers") == 2
    assert err.count("give a lower --processes") == 2


def test_lengths_of_time() -> None:
    read, known = length_of_time("--until"), {"55m": 3300.0, "1h30m": 5400.0, "90": 90.0}
    for given, seconds in (known | {"0.5s": 0.5, "2d": 172_800.0}).items():
        assert read(given) == seconds
    for wrong in ("", "m", "5x", "-3m", "0"):
        with pytest.raises(UsageError, match="such as 55m"):
            read(wrong)


def test_every_trial_is_rebuilt_as_it_was_registered(command_line: Launch, pull: Launch) -> None:
    ran: list[TrialSpec] = []

    def run(spec: TrialSpec) -> object:
        ran.append(spec)
        return raising(spec)

    worker.WORK = Work(run)  # type: ignore[arg-type]
    command_line(*GRID, LEAVE)
    pull("work")
    assert len({spec.trial_key for spec in ran}) == 6
    _, out, _ = pull("query", "SELECT trial_key FROM trial", "--json")
    assert all(spec.trial_key in out for spec in ran)


def test_a_factor_of_memory_needs_a_limit(command_line: Launch, pull: Launch) -> None:
    command_line(*GRID, LEAVE)
    code, _, errors = pull("work", "--retry-memory", "2")
    assert code == 2
    assert "is 2, but there is no limit that it could raise: set --memory-gib" in errors


DONE = "SELECT count(*) AS n FROM trial WHERE status = 'done'"


@pytest.fixture
def code(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Return a function after which launches and workers of this process run other code."""

    def change(digest: str) -> None:
        changed = {**fingerprint(), "code of dopt": digest}
        monkeypatch.setattr("orchestrate.runner.saving.fingerprint", lambda: changed)
        monkeypatch.setattr("orchestrate.runner.worker.fingerprint", lambda: changed)

    return change


def test_a_worker_leaves_trials_that_other_code_has_registered(
    command_line: Launch, pull: Launch, code: Callable[[str], None]
) -> None:
    code("aaaa")
    command_line(*GRID, LEAVE)
    code("bbbb")
    left, out, err = pull("work")
    assert left == 3
    assert "0 trials wait" in out
    assert err.count("6 trials are left, which other code has registered") == 1
    assert "(the code of dopt is aaaa there and bbbb here): run a worker with that code, or" in err
    assert "0" in pull("query", DONE)[1]
    command_line(*GRID, LEAVE)  # the same command with the code of the worker
    assert pull("work")[0] == 1
    assert "4" in pull("query", DONE)[1]
    assert "different code" not in pull("status")[1]


def test_a_grid_of_an_older_program_waits_for_its_launch_command(
    command_line: Launch, pull: Launch, tmp_path: Path
) -> None:
    command_line(*GRID, LEAVE)
    execute(f"sqlite:///{tmp_path}/results/results.db", "UPDATE launch SET fingerprint = NULL")
    left, _, err = pull("work")
    assert left == 3
    assert "6 trials are left, which other code has registered (an older program): run" in err
    command_line(*GRID, LEAVE)
    assert pull("work")[0] == 1


def test_trials_of_two_codes_go_to_the_workers_of_each(
    command_line: Launch, pull: Launch, code: Callable[[str], None]
) -> None:
    code("aaaa")
    command_line(*GRID, LEAVE)
    code("bbbb")
    command_line(*GRID[:-2], "seed=range(1)", GRID[-1], LEAVE)
    assert pull("work")[0] == 3
    assert "2" in pull("query", DONE)[1]
    code("aaaa")
    assert pull("work")[0] == 1
    assert "4" in pull("query", DONE)[1]
    assert "2 configurations with results of different code" in pull("status")[1]
    found = pull("doctor")[1]
    assert "results of code or libraries with different fingerprints: 2" in found
    rows = pull("query", "SELECT trial_key FROM trial WHERE status = 'done'", "--json")[1]
    code("cccc")
    command_line(*GRID, LEAVE)
    pull("work")
    assert pull("query", "SELECT trial_key FROM trial WHERE status = 'done'", "--json")[1] == rows


def test_a_claim_leaves_what_was_taken_over_since_it_was_looked_for(tmp_path: Path) -> None:
    spec = short_trial("random", seed=0)
    with Store.open(f"sqlite:///{tmp_path}/results.db") as store:
        old, new = (
            store.begin_launch(LaunchRecord([], [], "here", 1, fingerprint={"code": digest}))
            for digest in "ab"
        )
        keys = store.register(old, [spec]).todo
        store.register(new, [spec])
        assert store.claim(old, keys, alike=True) == []
        assert len(store.claim(new, keys, alike=True)) == 1
