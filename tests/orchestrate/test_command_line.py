"""Command lines of a user, and the answers."""

from __future__ import annotations

import argparse
import os
import re
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from analysis.cli import main as analysis
from analysis.cli import parser as parser_of_analysis
from dopt.errors import _say_once
from dopt.result import TrialResult
from dopt.spec.trial import TrialSpec
from orchestrate.__main__ import COMMANDS
from orchestrate.__main__ import main as orchestrate
from orchestrate.program import SUCCESSORS
from orchestrate.runner import start
from orchestrate.runner.start import Work
from orchestrate.store import Reader, Store, StoreError, default_url
from orchestrate.store.backend import parse_url
from orchestrate.store.sqlite import existing_path
from tests.orchestrate.standins import quick, raising, unusable
from tests.pages import commands
from tests.paths import ROOT, ran

Command = Callable[..., tuple[int, str, str]]

OPTIONS = ROOT / "docs" / "example" / "conf"

SHORT = ("env.horizon=5", "executor=inprocess")
LOCAL = ("env.horizon=5", "executor=local", "launch.workers=1")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["env=pendulm"], "env 'pendulm' is unknown.* did you mean 'pendulum'"),
        (["-m", "env=pendulm,arm"], "env 'pendulm' is unknown.* did you mean 'pendulum'"),
        (["env.gama=3"], "setting of env 'gama' is unknown.* did you mean 'gamma'"),
        (["-m", "env.gama=3,4"], "setting of env 'gama' is unknown.* did you mean 'gamma'"),
        (["evn=pendulum"], "setting 'evn' is unknown.* did you mean 'env'"),
        (["-m", "seed=range(0,0)"], "'seed=range\\(0,0\\)' has no values"),
        (["-m", "width=glob(*)"], "is a glob, but 'width' is not a group"),
        (["-m", "launch.workers=1,2"], "sweeps a setting of the launch"),
        (["env=pendulum", "launch.detach=true"], "launch.detach is for grids"),
        (["-m", "launch.detach=true", "launch.until=ci<5%"], "leaves before there are any"),
        (["width=wide"], "model.width is 'wide' .* a whole number is expected"),
        (["+env.colour=red"], "'colour' is unknown"),
        (["+results=x"], "setting 'results' is unknown"),  # a word in the usual URL of the store
        (["seed=99999999999999999999"], "seed is 9+, but a whole number from 0 to 9,223"),
        (
            ["policy=random", "policy.regularization=1"],
            "'regularization' is unknown, no setting of policy exists",
        ),
        (["seed=1,2"], "'seed=1,2' gives several values to one trial: add -m"),
        (["launch.ray=3"], "launch.ray is 3, but a section"),
        (["env=[1"], "cannot read the override 'env=\\[1' .*: put a value with special characters"),
        (["env=quadrotor", "policy=periodic"], "eigenmode"),
        (["-m", "env=quadrotor", "policy=periodic"], "the grid is empty: env=quadrotor"),
        (["executor.name=locla"], "executor.name 'locla' is unknown.* did you mean 'local'"),
        *(
            ([*words, "executor=lockstep", f"executor.device={device}"], f"device is '{device}'")
            for words, device in (([], "cuda:99"), (["-m", "seed=0"], "banana"), ([], "meta"))
        ),
        (["plant=real", "plant.delay=-1"], "plant.delay is -1.0 samples"),
        (["plant.delay=1"], "setting of plant 'delay' is unknown without .*: add plant=real"),
        (["+limits.bounds={y:[-1,1]}"], "'bounds' is unknown without .*: add limits=box or lim"),
        (["-m", "seed=0", "++task.steps=3"], "'steps' is unknown without .*: add task=control"),
        (["+env=arm"], "'\\+env=arm' adds an option, but env has one already: leave out the \\+"),
        (["plant=real", "plant.delay=1", "model=affine"], "goes with a model of the state alone"),
        (["executor=rey"], "executor 'rey' is unknown.* did you mean 'ray'"),
        (["launch.retry=fail"], "launch.retry 'fail' is unknown.* did you mean 'failed'"),
        (["launch.workers=0"], "launch.workers is 0, but null or a whole number above 0"),
        (["-m", "executor=local", "launch.workers=1001"], "1,001 processes .* at most 1,000 on"),
        (["-m", "executor=ray", "launch.workers=1001"], "1,001 processes .* launch.workers"),
        (["launch.dryrun=true"], "did you mean 'dry_run'"),
        (["store.url="], "store.url is '', but a text is expected"),
        (["store.url=mysql://you:secret@host/db"], "not supported"),
        (["store.url=postgresql://you:secret@host:port/db"], "The database URL cannot be read"),
        (["store.url=sqlite:////dev/null/results.db"], "cannot be made or opened"),
        (["store.url=sqlite://results/x.db"], "names a host, .* sqlite:///results/x.db"),
        (["store.url=sqlite:///$HOME/r.db"], "database URL is '\\$HOME/r.db', but \\$HOME is expa"),
        (["store.url=sqlite:///a\nb.db"], "holds the control character '\\\\n'"),
        (["store.url=sqlite:///r.db?mode=ro"], "has a \\?, behind which SQLite takes no options"),
        (["store.url=sqlite:///r\udcff.db"], "bytes that are no text in UTF-8"),
        (["--cfg", "jobs"], "--cfg 'jobs' is unknown.* did you mean 'job'"),
        (["--bogus"], "option '--bogus' is unknown"),
        (["--mutlirun", "seed=1,2"], "did you mean '--multirun'"),
        (["--package"], "--package/-p: expected one argument"),
        (["--config-dir", "/no"], "--config-dir is '/no', but a folder is expected: give one"),
        (["--config-path", "/no"], "--config-path is '/no', but a folder is expected: give one"),
        (["--config-path", "."], "--config-path is '.', but a whole path is expected"),
        (["--shell-completion", "bash"], "--shell-completion names no shell, but one is expected"),
        (["gamma=3"], "setting 'gamma' is unknown: did you mean 'env.gamma'"),
        (["--config-name", "no"], "no configuration 'no': leave --config-name out"),
        (["seed=${no}"], "what seed refers to .* cannot be found .*: name a setting, or oc.env:"),
        (["env.dt=${oc.env:NO}"], "what env.dt refers to .*'NO' not found.*variable that is set"),
        (["env.dt=${env.dt}"], "what env.dt refers to .* cannot be found \\(Recursive"),
        (["=3"], "'=3' names no key: write key=value"),
        (["-m", "--cfg", "job"], "-m and --cfg cannot be combined"),
        (["--resolve"], "--resolve goes with --cfg or --help"),
        (["env=null"], "env is null, but one of arm, cartpole, pendulum, quadrotor, beyond/car"),
        (["env="], "env is empty, but one of arm"),
        (["experiment=null"], "'experiment=null' is what a launch without it has: leave it out"),
        (["policy=5"], "the option of a group is a number, but one of its names is expected"),
        (["--config-dir", str(OPTIONS), "env=boat", "env.mass=3"], "add it with \\+env\\.mass="),
        (["--config-dir", str(OPTIONS), "env=boat", "env.gama=3"], "did you mean 'gamma'"),
        (["env=[arm,cartpole]"], "env is the list \\[arm,cartpole\\], .*-m env=a,b"),
        (["-m", "env=null,arm"], "env 'null' is unknown"),
        (["-m", "policy=null,random"], "'null' is unknown: choose one of baseline/chirp, "),
        (["~policy"], "'~policy' deletes what a launch needs: leave it out"),
        (["-m", "~launch.timeout"], "an override deletes 'timeout', which a launch needs"),
        (["pendulum"], "'pendulum' is not an override: write key=value"),
        (["seed=abc"], "seed is 'abc', but a whole number"),
        (["env.horizon=null"], "env.horizon is null, but a whole number is expected"),
        (["+launch.ray.adress=x"], "setting of launch.ray 'adress' is unknown"),
        (["executor=local", "+executor.device=cuda"], "setting of executor 'device' is unknown"),
        (["experiment=width", "width=8", "env=arm"], "is a grid .*policy=d_optimal.*: add -m"),
        (["-m", "task=none,control", "task.stps=9"], "setting of task 'stps' .*mean 'steps'"),
        (["policy=random_held"], "did you mean 'baseline/random_held'"),
        (["hydra/launcher=basci"], "hydra/launcher 'basci' is .* did you mean 'basic'"),
        (["policy=beyond/exact", "policy.form=dual"], "setting of policy 'form' is unknown"),
        (["-m", "hydra/sweeper=basic", "seed=1,2"], "hydra/sweeper is set, but"),
        (["width=1000000"], "would need .* GiB of memory, .* make model.width smaller"),
        (["-m", "width=8,99999", "launch.memory_gib=1"], "but launch.memory_gib allows 1 GiB"),
    ],
)
def test_a_wrong_command_is_one_sentence_and_leaves_nothing(
    command_line: Command,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.syspath_prepend(OPTIONS.parent)  # the module of env=boat
    code, output, errors = command_line(*arguments)
    assert code == 2, output + errors
    assert output == ""
    assert re.fullmatch("error: [^\n]+\n", errors), errors
    assert re.search(words, errors), errors
    assert "secret" not in errors
    assert list(tmp_path.iterdir()) == []


def test_a_trial_prints_its_result_and_is_stored(command_line: Command, tmp_path: Path) -> None:
    arguments = ("env=arm", "policy=random", "seed=3", *SHORT)
    code, output, errors = command_line(*arguments)
    assert (code, errors) == (0, "")
    assert re.match(
        r"env=arm policy=random model=mlp width=16 seed=3 · final loss \S+ · .*5 steps", output
    )
    again = command_line(*arguments)
    head, result = output.split(" · ", 1)
    assert again == (0, f"{head} · already done, nothing to run · {result}", "")
    assert [path.name for path in tmp_path.iterdir()] == ["results"]


def test_a_grid_runs_once_and_the_default_is_a_hundred_seeds(command_line: Command) -> None:
    grid = ("-m", "env=arm,quadrotor", "policy=random,periodic", *LOCAL)
    code, output, _ = command_line(*grid)
    assert code == 0, output
    assert "left out 100 trials: env=quadrotor policy=periodic" in output
    assert "0 of 300 already done, 300 to run" in output
    assert "300 of 300 done, 0 failed" in output
    assert "300 of 300 already done, nothing to run" in command_line(*grid)[1]


def test_every_policy_runs_behind_real_hardware(command_line: Command, tmp_path: Path) -> None:
    policies = "policy=glob([*,baseline/*,beyond/exact,beyond/gradient,beyond/max,beyond/episodic])"
    small = ("plant=ideal,real", "plant.delay=0,1.5", "plant.supply=1", "env.grid_points=[2,2]")
    words = ("-m", "env=pendulum", policies, *small, "seed=0", "env.horizon=50")
    code, output, errors = command_line(*words, "executor=inprocess")
    assert code == 0, errors + output
    assert re.search("\\b0 failed.*\\b0 diverged", output)
    with sqlite3.connect(tmp_path / "results/results.db") as connection:
        sql = "SELECT group_concat(label, ';') FROM config WHERE policy = 'd_optimal'"
        [labels] = connection.execute(sql).fetchone()
    grid = "D-optimal, grid_points=[2, 2], horizon 50"
    assert set(labels.split(";")) == {*(grid, f"{grid}, supply=1", f"{grid}, delay=1.5, supply=1")}


def test_a_failed_trial_says_how_to_run_it_again(
    command_line: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("orchestrate.runner.start.WORK", Work(raising))
    code, output, _ = command_line("seed=2", *SHORT)
    assert (code, "failed with ZeroDivisionError" in output) == (1, True)
    assert "launch.retry" not in output
    code, output, _ = command_line("seed=2", *SHORT)
    assert code == 1
    assert "already run (launch.retry=failed runs it again) · failed with Zero" in output
    code, output, _ = command_line("seed=2", *SHORT, "launch.retry=failed")
    assert "already run" not in output


def test_a_slow_preparation_is_announced_also_for_a_single_trial(
    command_line: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("orchestrate.runner.start.ANNOUNCE_AFTER_SECONDS", 0.01)

    @contextmanager
    def prepare(_: object) -> Iterator[None]:
        yield
        time.sleep(0.5)

    monkeypatch.setattr("orchestrate.runner.start.WORK", Work(quick, prepare))
    code, _, errors = command_line(*SHORT)
    assert (code, errors.startswith("compiling the kernel")) == (0, True)


@pytest.mark.parametrize("words", [("seed=2",), ("-m", "seed=1,2")])
def test_where_numba_is_disabled_nothing_is_registered(
    command_line: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words: tuple[str, ...]
) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    code, output, errors = command_line(*words, *SHORT)
    assert (code, output) == (2, "")
    assert errors.startswith("error: NUMBA_DISABLE_JIT is 1")
    assert (len(errors.splitlines()), "unset it" in errors) == (1, True)
    assert not (tmp_path / "results").exists()
    assert command_line(*words, *SHORT, "launch.dry_run=true")[0] == 2


def test_a_trial_that_finds_the_machine_unusable_ends_the_launch_with_its_sentence(
    command_line: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("orchestrate.runner.start.WORK", Work(unusable))
    code, _, errors = command_line("seed=2", *SHORT)
    assert (code, errors) == (2, "error: the machine has no compiler: install one\n")
    assert command_line("-m", "seed=2,3", *SHORT)[0] == 2


def test_flags_may_stand_anywhere(command_line: Command) -> None:
    code, output, _ = command_line("env=arm", "--cfg", "job", "width=8", "--package", "env")
    assert code == 0
    assert "name: arm" in output
    code, output, _ = command_line("seed=1,2", "-m", "policy=random", "launch.dry_run=true")
    assert (code, output.splitlines()[-1]) == (0, "2 trials, 0 done, 2 to run")


def test_an_experiment_whose_sweeps_are_all_decided_is_one_trial(command_line: Command) -> None:
    decided = ("experiment=smoke", "env=arm", "policy=random", "seed=0")
    code, output, errors = command_line(*decided, "launch.dry_run=true")
    assert (code, errors) == (0, "")
    assert "1 trial, 0 done, 1 to run" in output


def test_provenance_is_written_without_passwords(command_line: Command, tmp_path: Path) -> None:
    command_line("-m", "seed=1,2", "+model.note=1", *SHORT)  # refused, and not written down
    command_line("-m", "seed=1,2", "~launch.ray", "+launch.ray={address: 'ray://u:pw@h'}", *SHORT)
    with sqlite3.connect(tmp_path / "results/results.db") as connection:
        [(argv, overrides, versions)] = connection.execute(
            "SELECT argv, overrides, versions FROM launch"
        )
    connection.close()
    assert "pw" not in argv + overrides
    assert "seed=1,2" in overrides
    assert "env.horizon=5" in argv
    assert "env.horizon=5" in overrides
    assert "numpy" in versions


def test_help_and_configuration(command_line: Command) -> None:
    code, output, _ = command_line("--help")
    assert code == 0
    assert "python orchestrate/launch.py" in output
    assert "env: arm, cartpole, pendulum, quadrotor" in output


def test_it_runs_from_any_folder_without_being_installed(tmp_path: Path) -> None:
    """The real thing, once: no output folders, no change of folder, the plugin found."""
    grid = ("-m", "env=glob(*)", "seed=0", "launch.dry_run=true")
    done = ran(ROOT / "orchestrate/launch.py", *grid, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "4 trials, 0 done, 4 to run" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_failure_may_say_what_no_terminal_shows(
    command_line: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unspeakable(_: TrialSpec) -> TrialResult:
        raise OSError("cannot read \udcff")

    monkeypatch.setattr("orchestrate.runner.start.WORK", Work(unspeakable))
    code, out, _ = command_line("-m", "seed=0", "env.horizon=5", "executor=inprocess")
    assert code == 1
    assert r"1 failed: OSError: cannot read \udcff" in out


def test_a_defect_of_the_program_is_not_taken_for_failed_trials(
    command_line: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def broken(*_: object) -> None:
        raise AssertionError("nobody thought of postgresql://me:secret@host/db")

    monkeypatch.setattr("orchestrate.runner.start.Chunks", broken)
    url = f"sqlite:///{tmp_path}/results.db"
    code, _, errors = command_line("env=pendulum", f"store.url={url}")
    assert code == 70
    assert "Traceback" in errors
    assert "report it" in errors.splitlines()[-1]
    assert "secret" not in errors
    with Reader.open(url) as reader:
        assert reader.rows("SELECT state, exit_code FROM launch")[0] == ("failed", 70)


def test_a_single_trial_that_is_interrupted_before_its_start_says_so(
    command_line: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(start, "free_trials", interrupted)
    code, output, errors = command_line("env=pendulum", *SHORT)
    assert (code, errors) == (130, "")
    assert re.fullmatch(r"env=pendulum .* · not started · sqlite:.*\n", output)


def test_a_dry_run_shows_the_grid_and_makes_no_database(
    command_line: Command, tmp_path: Path
) -> None:
    grid = ("-m", "policy=random,oracle", "width=8,16", "seed=range(4)", *SHORT)
    code, output, _ = command_line(*grid, "launch.dry_run=true")
    assert code == 0
    assert list(tmp_path.iterdir()) == []
    assert re.search(r"pendulum +random, .*width 8 +4 +0 +0 +4\n", output)
    assert len(re.findall("oracle", output)) == 1, "a model without width runs once"
    assert "12 trials, 0 done, 12 to run" in output
    command_line(*grid, "seed=range(3)")
    assert "12 trials, 9 done, 3 to run" in command_line(*grid, "launch.dry_run=true")[1]


def test_a_dry_run_counts_trials_that_run_again(
    command_line: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Failed(dict[str, str]):
        def get(self, _key: str, _default: object = None) -> str:  # type: ignore[override]
            return "failed"

    monkeypatch.setattr("orchestrate.runner.start._statuses", lambda _: Failed())
    grid = ("-m", "policy=random", "seed=range(4)", "launch.dry_run=true", *SHORT)
    assert "4 trials, 0 done, 0 to run" in command_line(*grid)[1]
    assert "4 trials, 0 done, 4 to run" in command_line(*grid, "launch.retry=failed")[1]


def test_a_dry_run_tells_its_configs_apart(command_line: Command) -> None:
    _, output, _ = command_line(
        "-m", "env=arm,pendulum", "policy=random", "env.mass=2,3", "env.dt=0.01,0.02", "seed=0",
        "launch.dry_run=true",
    )  # fmt: skip
    assert "env.mass applies to env=pendulum only\n" in output
    assert re.search(r"env +configuration +trials", output)
    assert re.search(r"arm +random, dt=0.01 +1", output)
    assert re.search(r"pendulum +random, .*mass=3 +1", output)
    assert "6 trials" in output


SHOWN = {word for command in commands("launch.py") for word in command.words}
"""Words of the commands on the pages, which ``tests/test_docs.py`` gives."""


def test_every_experiment_is_a_grid(command_line: Command) -> None:
    """Those of the pages are run there; a setting of one grid is not said to hold for others."""
    said = {}
    for path in (ROOT / "conf" / "experiment").glob("*.yaml"):
        name = f"experiment={path.stem}"
        if path.stem == "beyond" or name not in SHOWN:
            code, output, errors = command_line("-m", name, "seed=0", "launch.dry_run=true")
            assert code == 0, errors
            assert re.search(r"[1-9][\d,]* trials, 0 done", output)
            said[path.stem] = output
    assert said["beyond"].startswith("learner.forgetting applies to learner=ekf only\n")


GRID = ("-m", "policy=random", "seed=0,1", *SHORT)


@pytest.mark.parametrize("worker", [False, True])
def test_a_grid_goes_on_when_its_output_is_closed(
    command_line: Command, tmp_path: Path, worker: bool
) -> None:
    """As by ``| head``."""
    url = f"sqlite:///{tmp_path}/results/results.db"
    words = [str(ROOT / "orchestrate/launch.py"), *GRID]
    if worker:
        assert command_line(*GRID, "launch.detach=true")[0] == 0
        words = ["-m", "orchestrate", "work", "--processes", "1", "--db", url]
    with subprocess.Popen(
        [sys.executable, *words], cwd=tmp_path, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert "rror" not in process.stderr.read()
    assert process.returncode == 0
    with Reader.open(url) as reader:
        rows = reader.rows("SELECT count(*) FROM trial WHERE status = 'done'")
        assert [tuple(row) for row in rows] == [(2,)]


@pytest.mark.parametrize(
    "word", [name for name in SUCCESSORS if name.startswith(("launch.", "executor=", "store="))]
)
def test_settings_of_a_launch(command_line: Callable[..., tuple[int, str, str]], word: str) -> None:
    code, output, errors = command_line("-m", word if "=" in word else f"{word}=1")
    assert (code, output) == (2, "")
    assert errors == f"error: '{word}' was removed: {SUCCESSORS[word]}.\n"


@pytest.mark.parametrize("words", [["work", "--live", "1"], ["work", "--live=1"]])
def test_options(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert orchestrate(words) == 2
    assert f"'--live' was removed: {SUCCESSORS['--live']}." in capsys.readouterr().err


FROM_VARIABLE = "The database URL in the environment variable DOPT_DB cannot be read"


def test_a_path_in_the_variable_is_answered_with_the_variable_and_the_url(
    command_line: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DOPT_DB", "mine/x.db")
    code, _, errors = command_line(*SHORT)
    assert code == 2
    assert f"{FROM_VARIABLE}: write it as sqlite:///mine/x.db." in errors
    monkeypatch.setenv("DOPT_DB", "me:secret@host/x.db")
    _, _, errors = command_line(*SHORT)
    assert f"{FROM_VARIABLE}: write it as sqlite:///results/results.db or " in errors
    assert "secret" not in errors
    monkeypatch.setenv("DOPT_DB", "  ")
    assert "error: The database URL cannot be read: write it as" in command_line(*SHORT)[2]
    _, _, errors = command_line(*SHORT, "store.url=mine/x.db")
    assert "The database URL cannot be read: write it as sqlite:///mine/x.db." in errors
    monkeypatch.setenv("DOPT_DB", "sqlite:///${HOME}/r.db")
    said = "in the environment variable DOPT_DB is '${HOME}/r.db', but ${HOME} is expand"
    assert said in command_line(*SHORT)[2]


def test_an_empty_variable_counts_as_unset(
    command_line: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DOPT_DB", "")
    code, output, errors = command_line(*SHORT)
    assert (code, errors) == (0, "")
    assert "sqlite:///results/results.db" in output
    assert default_url() == "sqlite:///results/results.db"


ARGUMENTS = {
    "show": ["0"],
    "retry": ["failed"],
    "query": ["SELECT 1"],
    "export": ["trials", "trials.csv"],
    "merge": ["other.db"],
    "backup": ["copy.db"],
    "prune": ["--env", "arm", "--yes"],
    "animate": ["arm", "random"],
}
"""Arguments that the commands need beside their options."""

ANALYSES = ("figures", "summary", "compare", "aggregate", "calibration", "sample-loss")
ANALYSES += ("report", "animate")


@pytest.fixture
def notes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a file that is no database, in the working folder beside one that is."""
    monkeypatch.chdir(tmp_path)
    with Store.open("sqlite:///other.db"):
        pass
    path = tmp_path / "notes.toml"
    path.write_text("[project]\nname = 'something else'\n")
    return path


NO_DATABASE = (
    "error: sqlite:///{} is not a SQLite database, but a results database of this program is "
    "expected: give the URL of another one, or of a new one, or restore a copy if it was one.\n"
)


PROGRAMS = [
    *((orchestrate, command.name) for command in COMMANDS if command.needs_database),
    *((analysis, name) for name in ANALYSES),
]


@pytest.mark.parametrize(("program", "name"), PROGRAMS)
def test_a_file_of_something_else_is_refused_by_every_command(
    program: Callable[[list[str]], int], name: str, notes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, words = notes.read_bytes(), [name, *ARGUMENTS.get(name, [])]
    code = program([*words, "--db", "sqlite:///notes.toml"])
    assert (code, *capsys.readouterr()) == (2, "", NO_DATABASE.format("notes.toml"))
    if name == "merge":
        code = program(["merge", "notes.toml", "--db", "sqlite:///other.db"])
        assert (code, *capsys.readouterr()) == (2, "", NO_DATABASE.format(notes))
    assert notes.read_bytes() == before


@pytest.mark.usefixtures("notes")
@pytest.mark.parametrize("words", [[], ["-m", "seed=0,1"], ["launch.dry_run=true"]])
def test_a_file_of_something_else_is_refused_by_a_launch(
    command_line: Command, words: list[str]
) -> None:
    answer = command_line(*words, *SHORT, "store.url=sqlite:///notes.toml")
    assert answer == (2, "", NO_DATABASE.format("notes.toml"))


TRIAL = ("env=pendulum", "policy=random", *SHORT)


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    _say_once.cache_clear()
    (tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.mark.parametrize(
    "given", ["sqlite:///~/r.db", "sqlite:///~/r.db\n", " sqlite:/// ~/r.db\t"]
)
def test_a_database_in_the_home_folder(
    command_line: Command, monkeypatch: pytest.MonkeyPatch, home: Path, given: str
) -> None:
    monkeypatch.setenv("DOPT_DB", given)
    code, output, errors = command_line(*TRIAL)
    assert (code, errors) == (0, "")
    assert output.rstrip().endswith(f"sqlite:///{home}/r.db")
    assert (home / "r.db").is_file()
    assert orchestrate(["status"]) == 0
    assert orchestrate(["status", "--db", f"{given} "]) == 0
    monkeypatch.delenv("DOPT_DB")
    assert "already done" in command_line(*TRIAL, f"store.url={given}")[1]
    assert [path.name for path in Path.cwd().iterdir()] == ["home"]


@pytest.mark.parametrize(
    "name", ['it\'s "ü" (b).db', "[x]{y},z=1.db", "b~ a.db", "größe/100%25 %3F.db"]
)
def test_a_database_of_any_name(command_line: Command, tmp_path: Path, name: str) -> None:
    url = f"sqlite:///./{name}"
    for words in (TRIAL, ("-m", "seed=0", *TRIAL)):
        code, output, errors = command_line(*words, f"store.url={url}")
        assert (code, errors) == (0, "")
    said = output.splitlines()[0].rpartition(" · ")[2]
    assert "ü" in said if "ü" in name else "%C3" not in said
    for given in (url, said):
        assert orchestrate(["status", "--db", given]) == 0
    assert orchestrate(["merge", "--db", "sqlite:///merged.db", str(parse_url(url).database)]) == 0
    assert orchestrate(["merge", "--db", "sqlite:///merged.db", str(tmp_path)]) == 0


def test_a_password_may_hold_what_a_path_may_not() -> None:
    url = parse_url("postgresql://me:$HOME%7E~%0A@host/dopt\n")
    assert (url.password, url.database) == ("$HOME~~\n", "dopt")
    with pytest.raises(StoreError, match="holds the control character") as raised:
        Reader.open("postgresql://me:secret@host/do\npt")
    assert "secret" not in str(raised.value)
    assert str(existing_path(parse_url("sqlite:////dev/../etc/hostname "))) == "/etc/hostname"


def parsers() -> Iterator[argparse.ArgumentParser]:
    yield from (command.parser() for command in COMMANDS)
    for action in parser_of_analysis()._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices.values()


def test_every_command_explains_itself_and_takes_no_path_unread() -> None:
    for parser in parsers():
        assert "%%" not in parser.format_help()
    needing = [one.parser().format_help() for one in COMMANDS if one.needs_database]
    assert all("--db URL" in said for said in needing)
    actions = [one for parser in parsers() for one in parser._actions]
    assert not [one.dest for one in actions if one.type in (Path, os.fspath)]
    assert sum("given_path" in repr(one.type) for one in actions) >= 6


def test_paths_of_options_are_read(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ("backup $X/r.db", "export curves --out $X/c.csv", "merge $X/other.db"):
        assert orchestrate(words.split()) == 2
        assert "'$X/" in capsys.readouterr().err
    assert analysis(["figures", "--out", "$X/f"]) == 2
    assert "--out is '$X/f', but $X is expanded by a shell" in capsys.readouterr().err


def test_the_cache_of_the_kernel(tmp_path: Path, home: Path) -> None:
    words = (ROOT / "orchestrate/launch.py", *TRIAL, "launch.dry_run=true")
    refused = ran(*words, folder=tmp_path, DOPT_CACHE="$HOME/cache")
    assert refused.returncode == 2
    assert refused.stderr.startswith("error: DOPT_CACHE is '$HOME/cache', but $HOME is expanded")
    assert ran(*words, folder=tmp_path, DOPT_CACHE="~/cache\n").returncode == 0
    assert [path.name for path in home.iterdir()] == ["cache"]
    assert [path.name for path in tmp_path.iterdir()] == ["home"]
