"""``status``: counts, failures by cause, launches, rate; once and watched."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from orchestrate.commands import status
from orchestrate.commands.command import plain
from orchestrate.commands.results import grid_table
from orchestrate.commands.status import watch
from orchestrate.queries import Status, gather
from orchestrate.store import Claim, ConfigRow, Reader, Store, StoreUnavailableError
from tests.orchestrate.commands.conftest import WAITING, Answer, failure, run_now
from tests.orchestrate.store.fakes import LAUNCH, Spec, result
from tests.orchestrate.store.places import execute

Run = Callable[..., Answer]
Take = Callable[..., list[Claim]]


def rows(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines()]


@pytest.mark.usefixtures("grid")
class TestOnce:
    def test_counts_each_config(self, command: Run) -> None:
        table = rows(command("status").out)
        assert [" ".join(row) for row in table[:6]] == [
            "env policy width done of failed diverged running pending",
            "cartpole random - 0 2 - - - 2",
            "cartpole random 8 0 1 - - 1 -",
            "pendulum d_optimal 16 0 3 2 1 - -",
            "pendulum random 16 3 3 - - - -",
            "total 3 9 2 1 1 2",
        ]

    def test_groups_failures_and_says_where(self, command: Run) -> None:
        out = command("status").out
        assert "2 trials (2 attempts), exception: pendulum/d_optimal" in out
        assert "ZeroDivisionError: seed 3 is broken" in out
        assert 'at "trial.py", line 7, in run' in out

    def test_says_who_works_on_it(self, command: Run, grid: int) -> None:
        assert f"{grid} on here, process 17, since " in command("status").out
        assert "alive for" in command("status").out

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

    def test_an_unknown_name_has_a_nearest_one(self, command: Run) -> None:
        answer = command("status", "--env", "pendulun")
        assert (answer.code, answer.out) == (2, "")
        assert "did you mean 'pendulum'?" in answer.err

    def test_passwords_appear_nowhere(self, command: Run) -> None:
        for words in (["status"], ["status", "--json"], ["show", "--seed", "5", "--json"]):
            answer = command(*words)
            assert "hunter2" not in answer.out + answer.err


def test_a_dead_launch_is_called_dead(open_store: Callable[..., Store], command: Run) -> None:
    dead = open_store()
    launch = dead.begin_launch(LAUNCH)
    dead.claim(launch, dead.register(launch, [Spec()]).todo)
    dead.close()
    with open_store()._backend.transaction() as connection:
        connection.exec_driver_sql("UPDATE launch SET lease_until = 0")  # long ago, on PostgreSQL
    assert ": dead; run the same launch command again to continue" in command("status").out
    assert command("status", "--json").document["launches"][0]["alive"] is False


def test_without_a_launch_it_says_how_to_go_on(store: Store, command: Run) -> None:
    launch = store.begin_launch(LAUNCH)
    store.register(launch, [Spec()])
    store.end_launch(launch, "interrupted")
    assert "run the same launch command again to continue" in command("status").out


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
        assert self.shown(configs, 10)[0][:4] == ["env", "policy", "width", "horizon"]

    def shown(self, configs: list[ConfigRow], most: int) -> list[list[str]]:
        console = Console(file=io.StringIO(), width=200)
        console.print(grid_table(configs, most))
        return rows(console.file.getvalue())  # type: ignore[attr-defined]


@pytest.mark.usefixtures("grid")
class TestWatch:
    def finish(self, store: Store, launch: int) -> None:
        store.release(launch)
        keys = [spec.trial_key for spec in WAITING]
        for claim in store.claim(launch, [*keys, Spec(0, env="cartpole", width=8).trial_key]):
            store.commit(claim, result(), run_now())

    def test_it_ends_when_the_grid_is_complete(
        self, command: Run, store: Store, grid: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        pause = SimpleNamespace(sleep=lambda _: self.finish(store, grid))
        monkeypatch.setattr(status, "time", pause)
        answer = command("status", "--watch", "0.2")
        first, *_, last = answer.out.splitlines()
        assert "6 of 9 trials have an outcome" in first
        assert "9 of 9 trials have an outcome" in last
        assert answer.code == 1  # two have failed

    def test_its_json_is_one_document_at_the_end(
        self, command: Run, store: Store, grid: int
    ) -> None:
        self.finish(store, grid)
        store.retry("failed")
        (claim, other) = store.claim(grid, [Spec(i, policy="d_optimal").trial_key for i in (3, 4)])
        store.commit(claim, result(), run_now())
        store.commit(other, result(), run_now())
        answer = command("status", "--watch", "--json")
        assert answer.document["complete"] is True
        assert answer.code == 0


def test_a_watch_waits_for_a_database_that_went_away(capsys: pytest.CaptureFixture[str]) -> None:
    answers: list[Any] = [StoreUnavailableError("gone for now", transient=True), *[_complete()] * 2]

    def look() -> Status:
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        assert isinstance(answer, Status)
        return answer

    assert watch(look, 0.01, quiet=False).total == 1
    assert capsys.readouterr().out.splitlines()[0] == "gone for now"
    answers[:] = [StoreUnavailableError("gone for ever")]
    with pytest.raises(StoreUnavailableError):
        watch(look, 0.01, quiet=False)


def test_in_a_terminal_it_draws_in_place(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=80, height=24, color_system=None)
    monkeypatch.setattr(status, "console", lambda: console)
    status._in_place(["gone for now", _complete()])
    assert "gone for now" in screen.getvalue()
    assert "1 of 1 trials have an outcome" in screen.getvalue()
    assert screen.getvalue().endswith("\x1b[?25h")  # the cursor is back


def _complete() -> Status:
    names = {"env": "a", "policy": "b", "model": "mlp", "learner": "adam", "config_key": "0"}
    numbers = {"width": 1, "depth": 1, "horizon": 1, "dt": 0.1, "gamma": 1.0}
    states = dict.fromkeys(("diverged", "failed", "cancelled", "pending", "running"), 0)
    counted = {f"n_{state}": number for state, number in {"done": 1, **states}.items()}
    return Status([ConfigRow(**names, **numbers, **counted, label="", config={})], [], [], 0.0)  # type: ignore[arg-type]


def test_control_characters_are_shown_as_text() -> None:
    assert plain("a\x1b[31mb\r\nd").plain == "a\\x1b[31mb\\r\nd"
