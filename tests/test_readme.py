"""The README keeps its word: its commands run, its SQL answers, its files exist."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from orchestrate.commands import COMMANDS as COMMANDS_OF_THE_STORE
from orchestrate.store import Reader

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
COMMANDS = [
    line.split("#")[0].strip()
    for line in README.splitlines()
    if line.startswith("    python orchestrate/launch.py")
]
AFTERWARDS = [
    line.split("#")[0].strip()
    for line in README.splitlines()
    if line.startswith("    python -m orchestrate")
]
QUERIES = re.findall(r"```sql\n(.*?)```", README, flags=re.DOTALL)
FIGURES = re.findall(r"`python -m analysis figures --only (\w+)`", README)
LINKS = [link for link in re.findall(r"\]\(([^)]+)\)", README) if "://" not in link]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a Python command from the root of the repository."""
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the address of a small grid's database, made by the launch itself."""
    url = f"sqlite:///{tmp_path_factory.mktemp('readme') / 'results.db'}"
    grid = ("env=pendulum,cartpole", "policy=random,periodic,d_optimal", "seed=range(3)")
    widths = ("env=cartpole", "policy=d_optimal", "width=4,8", "seed=range(3)")
    settings = ("env.horizon=12", "executor=inprocess", f"store.url={url}")
    for trials in (grid, widths):
        done = run("orchestrate/launch.py", "-m", *trials, *settings)
        assert done.returncode == 0, done.stderr
    return url


def test_it_shows_commands_queries_and_figures() -> None:
    assert len(COMMANDS) >= 6
    assert len(QUERIES) >= 5
    assert len(FIGURES) >= 4


@pytest.mark.parametrize("command", COMMANDS)
def test_every_launch_command_is_accepted(command: str, tmp_path: Path) -> None:
    arguments = shlex.split(command)[1:]
    if "-m" in arguments:
        arguments += ["launch.dry_run=true", f"store.url=sqlite:///{tmp_path / 'results.db'}"]
    elif "--help" not in arguments:
        arguments += ["--cfg", "job"]
    done = run(*arguments)
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_every_command_has_a_line() -> None:
    shown = {shlex.split(command)[3] for command in AFTERWARDS}
    assert shown == {command.name for command in COMMANDS_OF_THE_STORE}


@pytest.mark.parametrize("command", AFTERWARDS)
def test_every_command_on_results_works(command: str, database: str, tmp_path: Path) -> None:
    other = tmp_path / "results" / "other.db"
    other.parent.mkdir()
    shutil.copy(database.removeprefix("sqlite:///"), other)
    done = subprocess.run(
        [sys.executable, *shlex.split(command)[1:]],
        cwd=tmp_path,
        env={**os.environ, "DOPT_DB": database, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout


@pytest.mark.parametrize("query", QUERIES, ids=[q.splitlines()[0].strip("- ") for q in QUERIES])
def test_every_query_answers(query: str, database: str) -> None:
    with Reader.open(database) as reader:
        rows = reader.query(query)
    assert len(rows) > 0 or "v_failures" in query


def test_every_figure_is_drawn(database: str, tmp_path: Path) -> None:
    names = [word for figure in FIGURES for word in ("--only", figure)]
    wanted = (*names, "--allow-partial", "--out", str(tmp_path))
    done = run("-m", "analysis", "figures", "--db", database, *wanted)
    assert done.returncode == 0, done.stderr
    assert {path.stem for path in tmp_path.glob("*.pdf")} == set(FIGURES)


@pytest.mark.parametrize("link", LINKS)
def test_every_link_leads_to_a_file(link: str) -> None:
    assert (ROOT / link).exists()


def test_every_folder_of_the_layout_exists() -> None:
    layout = README.split("## Layout")[1].split("##")[0]
    folders = re.findall(r"^    (\w+)/", layout, flags=re.MULTILINE)
    assert folders
    assert all((ROOT / folder).is_dir() for folder in folders)
