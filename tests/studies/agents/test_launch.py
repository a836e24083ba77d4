"""A launch with an agent as a plug-in, by the option files of the study."""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrate import __main__ as orchestrate
from orchestrate.runner import launch
from tests.paths import ROOT

QUICK = ("env.horizon=20", "policy.warm_up=5", "policy.batch=4", "executor=inprocess")


@pytest.mark.parametrize("policy", ["sac", "max_agent"])
def test_an_agent_is_a_policy_of_a_launch(
    policy: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    url = f"sqlite:///{tmp_path}/results.db"
    more = ("policy.lookahead=6", "policy.fit_updates=5") if policy == "max_agent" else ()
    words = ("--config-dir", str(ROOT / "studies/agents/conf"), "-m", f"policy={policy}", "seed=0")
    monkeypatch.setattr("sys.argv", ["launch.py", *words, *QUICK, *more, f"store.url={url}"])
    assert launch.main() == 0
    capsys.readouterr()
    assert orchestrate.main(["status", "--db", url]) == 0
    assert policy in capsys.readouterr().out


@pytest.mark.parametrize("word", ["policy=beyond/sac", "experiment=flex_table1_agents"])
def test_the_place_where_an_agent_was_names_the_study(
    word: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["launch.py", "-m", word])
    assert launch.main() == 2
    assert "studies/agents/README.md" in capsys.readouterr().err


def test_every_trial_of_the_experiment_is_possible(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ["--config-dir", str(ROOT / "studies/agents/conf"), "-m", "seed=0"]
    words += ["experiment=agents", "launch.dry_run=true"]
    words.append(f"store.url=sqlite:///{tmp_path}/results.db")
    monkeypatch.setattr("sys.argv", ["launch.py", *words])
    assert launch.main() == 0
    assert "8 trials, 0 done" in capsys.readouterr().out
