"""Registry of executors: three files for a new one, and no heavy import before it is used."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from orchestrate.executors.registry import EXECUTORS
from tests.paths import ROOT

CommandLine = Callable[..., tuple[int, str, str]]

LAUNCH = """
import json, sys
from orchestrate.runner import launch, start
from orchestrate.runner.run_grid import Work
from tests.orchestrate.standins import quick

if __name__ == "__main__":
    start.WORK = Work(quick, prepare=lambda: None)
    code = launch.main()
    print(json.dumps([code, sorted({"ray", "torch"} & set(sys.modules))]))
"""


def test_each_executor_has_a_configuration_file() -> None:
    files = {path.stem for path in (ROOT / "conf" / "executor").glob("*.yaml")}
    assert files == set(EXECUTORS)


@pytest.mark.parametrize("name", ["local", "lockstep", "ray", "slurm"])
def test_an_executor_is_named_in_its_own_files_and_the_registry_only(name: str) -> None:
    module = f"orchestrate.executors.{name}"
    own = {f"orchestrate/executors/{name}.py", "orchestrate/executors/registry.py"}
    for path in (ROOT / "orchestrate").rglob("*.py"):
        file = str(path.relative_to(ROOT))
        if file in own or file.startswith(f"orchestrate/executors/{name}/"):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert not str(node.module).startswith(module), file
            if isinstance(node, ast.Compare):
                values = [one.value for one in node.comparators if isinstance(one, ast.Constant)]
                assert name not in values or (name == "local" and "ray" in file), file


MINE = """
from orchestrate.executors.inprocess import InProcessExecutor
from orchestrate.executors.registry import ExecutorFactory

given = []

def make(settings, run, _):
    given.append(settings.executor_options["nice"])
    return InProcessExecutor(run)

FACTORY = ExecutorFactory(make, lambda _: 1)
"""


def test_a_new_executor_needs_a_module_a_file_and_an_entry(
    command_line: CommandLine, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "my_executor.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(EXECUTORS, "mine", "my_executor")  # type: ignore[arg-type]
    (tmp_path / "conf" / "executor").mkdir(parents=True)
    (tmp_path / "conf" / "executor" / "mine.yaml").write_text("name: mine\nnice: 5\n")
    code, output, errors = command_line(
        *("-m", "env.horizon=5", "policy=random", "seed=0,1", "executor=mine", "executor.nice=7"),
        f"hydra.searchpath=[file://{tmp_path / 'conf'}]",
    )
    assert (code, sys.modules.pop("my_executor").given) == (0, [7]), errors
    assert "2 to run with executor=mine" in output


def test_an_unknown_executor_is_refused_with_the_nearest_name(command_line: CommandLine) -> None:
    code, _, errors = command_line("env.horizon=5", "executor.name=locla")
    assert code == 2
    assert "executor.name 'locla' is unknown" in errors
    assert "'local'" in errors


def test_local_processes_load_neither_ray_nor_torch(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(LAUNCH)
    words = ["-m", "env.horizon=5", "policy=random", "seed=0,1", "executor=local"]
    done = subprocess.run(
        [sys.executable, str(program), *words, "launch.workers=1"],
        cwd=tmp_path,
        env={"PATH": "", "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert json.loads(done.stdout.splitlines()[-1]) == [0, []], done.stderr
