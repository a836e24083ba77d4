"""The pages for readers are true: their commands run and their queries answer."""

from __future__ import annotations

import importlib
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

import pytest

from analysis import cli
from benchmarks.cli import QUESTIONS
from dopt.result import TrialResult
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from orchestrate import __main__ as orchestrate
from orchestrate import launch
from orchestrate.__main__ import COMMANDS
from tests.analysis.synthetic import fill, make_grid
from tests.orchestrate.commands.test_design import LIMITS, ROBOT
from tests.pages import GENERATED, PAGES, Command, blocks, commands
from tests.paths import EXAMPLE, ROOT
from tests.typed_commands import empty_folder, run_typed

pytestmark = pytest.mark.xdist_group("docs")  # one database for all of them

TUTORIAL = "docs/tutorial.md"
STRUCTURE = "docs/structure.md"
PLUGINS = "docs/compiled_plugins.md"
SHARING = "docs/sharing.md"  # tests/test_pages.py
SHORT = {"env": {"horizon": 40}}
TASK = {"task": {"name": "control", "checkpoints": [20]}}

OTHERS = {"sh", "export", "docker", "mkdir", "git", "make", "set", "ray", "kubectl"}
SHELL = {
    "docs/plants.md": {"rig.py"},  # tests/dopt/explorer/test_explorer.py
    "docs/install.md": {".", "make"},
    # docs/example: tests/orchestrate/test_launches.py, test_slurm_workers.py
    "docs/many_machines.md": {*OTHERS, "bash", "sbatch"},
    "README.md": {"make"},
}
"""Programs that no test here runs, by page; those of three machines have tests of their own."""

# The map of the source code


def test_every_function_of_the_map_from_the_paper_exists() -> None:
    places = re.findall(r"`(dopt/[\w/]+\.py):([\w.]+)`", PAGES[STRUCTURE])
    assert len(places) > 30
    for path, name in places:
        module = importlib.import_module(path.removesuffix(".py").replace("/", "."))
        assert callable(attrgetter(name)(module)), f"{path}:{name}"


# Which commands a reader types


def test_every_command_is_one_that_is_tested() -> None:
    ours = {"launch.py", "orchestrate", "analysis", "benchmarks"}
    for command in commands():
        known = ours | SHELL.get(command.page, set())
        assert command.program in known or command.program.startswith("studies."), command


def test_every_target_of_make_exists() -> None:
    text = "\n".join(PAGES[page] for page in PAGES if page not in GENERATED)
    named = set(re.findall(r"^make ([a-z-]+)", text, flags=re.MULTILINE))
    named |= set(re.findall(r"`make ([a-z-]+)`", text))
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
    assert {"figures", "test"} <= named <= set(targets)


ACCEPTED = {
    (*c.variables.items(), *c.words): c for c in commands("launch.py") if c.page != TUTORIAL
}
"""Commands of launches outside the tutorial, each once: that is run from its first to its last."""


@pytest.mark.parametrize("command", ACCEPTED.values(), ids=str)
def test_every_launch_command_is_accepted(
    command: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if "PYTHONPATH" in command.variables:
        monkeypatch.syspath_prepend(str(EXAMPLE))
    more: tuple[str, ...] = ()
    if "-m" in command.words:
        more = ("launch.dry_run=true", f"store.url=sqlite:///{tmp_path / 'results.db'}")
        if not any(word.startswith("seed=") for word in command.words):
            more = (*more, "seed=0")  # the same configurations, composed once and not 100 times
    elif "--help" not in command.words:
        more = ("--cfg", "job")
    monkeypatch.setattr(sys, "argv", ["launch.py", *command.words, *more])
    monkeypatch.chdir(ROOT)
    try:
        code = launch.main()
    except SystemExit as end:  # Hydra's own after --help
        code = end.code or 0  # type: ignore[assignment]
    printed = capsys.readouterr()
    assert code == 0, printed.err
    assert printed.out
    if any(word.startswith("experiment=") for word in command.words):
        assert re.search(r"[1-9][\d,]* trials, 0 done", printed.out)


def _run_one(spec: TrialSpec, made_up: TrialResult) -> TrialResult:
    """Run the trials of which a page makes a film: a film replays its trial."""
    if (spec.system.name, spec.policy.name) != ("cartpole", "d_optimal"):
        return made_up
    untasked = {key: value for key, value in spec.to_mapping().items() if key != "task"}
    result = run_trial(TrialSpec.from_mapping(untasked))
    return replace(result, assessments=made_up.assessments)


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a small database with what the pages ask for: policies, widths, learners, control."""
    url = f"sqlite:///{tmp_path_factory.mktemp('docs') / 'results.db'}"
    both, seeds = ("pendulum", "cartpole"), range(5)
    more = make_grid(both, ("lookahead", "random_held"), seeds, **SHORT, **TASK)
    fill(url, make_grid(both, seeds=seeds, **SHORT, **TASK) + more, edit=_run_one)
    planned = {"policy": {"lookahead": 10}, **SHORT, **TASK}
    fill(url, make_grid(both, ("icem",), seeds, **planned))
    ekf = {"learner": {"name": "ekf"}, **SHORT, **TASK}
    fill(url, make_grid(both, ("d_optimal", "lookahead"), seeds, **ekf))
    for width in (4, 8):
        wide = {"model": {"width": width}, **SHORT, **TASK}
        fill(url, make_grid(("cartpole",), ("d_optimal",), seeds, **wide))
    return url


@pytest.fixture(scope="module")
def narrow_database(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a database of few models of few parameters, whose fits take milliseconds."""
    url = f"sqlite:///{tmp_path_factory.mktemp('narrow') / 'results.db'}"
    both, seeds = ("pendulum", "cartpole"), range(3)
    narrow = {"model": {"width": 4}, **SHORT}
    ekf = make_grid(both, ("d_optimal", "random"), seeds, learner={"name": "ekf"}, **narrow)
    fill(url, make_grid(both, ("d_optimal", "random"), seeds, **narrow))
    fill(url, ekf)
    return url


@pytest.fixture
def typed(
    database: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Callable[[Command], str]:
    """Return a function that runs a command on the database, in a new folder: what it printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DOPT_DB", database)

    def run(command: Command) -> str:
        words = list(command.words)
        if "--db" in words:  # the database of a study, which takes hours
            del words[words.index("--db") : words.index("--db") + 2]
        code = orchestrate.main(words) if command.program == "orchestrate" else cli.main(words)
        printed = capsys.readouterr()
        assert code == 0, printed.err
        return printed.out

    return run


def _on_results(*programs: str) -> list[Command]:
    """Return the commands outside the pages that are run as a whole; each of them once."""
    found = [
        c for c in commands(*programs) if c.page not in (TUTORIAL, PLUGINS, SHARING, *GENERATED)
    ]
    return list({c.words: c for c in found if c.words and c.words[0] != "COMMAND"}.values())


@pytest.mark.parametrize("command", _on_results("orchestrate"), ids=str)
def test_every_command_on_results_works(
    command: Command, typed: Callable[[Command], str], database: str, tmp_path: Path
) -> None:
    (tmp_path / "results").mkdir()
    shutil.copy(database.removeprefix("sqlite:///"), tmp_path / "results" / "other.db")
    (tmp_path / "results" / "shards").mkdir()
    shutil.copy(tmp_path / "results" / "other.db", tmp_path / "results" / "shards")
    words = tuple("SELECT 1 AS one" if word == "SELECT ..." else word for word in command.words)
    if command.words[0] == "design":
        pytest.importorskip("mujoco", reason="needs MuJoCo")
        (tmp_path / "arm.xml").write_text(ROBOT.replace("upper", "link7").replace("lower", "hand"))
        (tmp_path / "limits.yaml").write_text(LIMITS)
        words += () if "--check" in words else ("--effort", "2", "--seconds", "2")
    assert typed(Command(command.page, {}, "orchestrate", words))


def test_every_command_has_a_line() -> None:
    shown = {
        c.words[0] for c in commands("orchestrate", pages=("docs/command_line.md",)) if c.words
    }
    assert shown - {"COMMAND"} == {command.name for command in COMMANDS}


def _outputs(command: Command) -> list[str]:
    return [
        name
        for word, name in zip(command.words, command.words[1:], strict=False)
        if word == "--only"
    ]


def test_every_output_has_a_line_and_a_command_that_draws_it() -> None:
    """The pictures themselves are drawn by the tests of the figures and by the tutorial."""
    rows = re.findall(r"^\| (`.*?`) \|", PAGES["docs/figures.md"], flags=re.MULTILINE)
    assert set(cli.NAMES) <= {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    for command in _on_results("analysis"):
        if _outputs(command):
            assert cli.parser().read(command.words).only == _outputs(command)


@pytest.mark.parametrize(
    "command", [c for c in _on_results("analysis") if not _outputs(c)], ids=str
)
def test_every_command_of_the_analysis_works(
    command: Command,
    typed: Callable[[Command], str],
    narrow_database: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    extra = {"animate": ("--frames", "2")}
    extra |= dict.fromkeys(("summary", "compare", "aggregate", "report"), ())
    extra |= dict.fromkeys(("calibration", "sample-loss", "log"), ())
    if command.words[0] in ("calibration", "sample-loss"):
        monkeypatch.setenv("DOPT_DB", narrow_database)
    if command.words[0] == "log":
        rows = (f"{10 * k},{k * k // 50 % 4096},{k % 7 - 3}\n" for k in range(400))
        Path("run.csv").write_text("t,th,u\n" + "".join(rows))
    if command.words[0] in ("serve", "fit"):  # whose own tests start them
        assert cli.parser().read(command.words)
    else:
        more = extra.get(command.words[0], ("--only", "summary"))
        assert typed(Command(command.page, {}, "analysis", (*command.words, *more)))


def test_every_benchmark_exists() -> None:
    for command in commands("benchmarks"):
        assert set(command.words[-1].split(",")) <= set(QUESTIONS), command


# The tutorial, from its first command to its last


@pytest.mark.long
def test_the_tutorial_runs_from_its_first_command_to_its_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    empty_folder(tmp_path, monkeypatch)
    lines = [line for block in blocks(PAGES[TUTORIAL], "bash") for line in block.splitlines()]
    assert len(lines) >= 15
    for line in lines:
        if "serve" not in line:  # which does not end; its own tests start it
            run_typed(line, monkeypatch, capsys)
    for snippet in blocks(PAGES[TUTORIAL], "python"):
        exec(compile(snippet, TUTORIAL, "exec", dont_inherit=True), {})
        assert capsys.readouterr().out, snippet
    written = {str(path.relative_to(tmp_path)) for path in (tmp_path / "figures").rglob("*.*")}
    assert {
        "figures/README.md",
        "figures/figure1.pdf",
        "figures/comparison.tex",
        "figures/robust/figure1.png",
        "figures/pendulum_d_optimal.gif",
    } <= written
