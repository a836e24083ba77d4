"""The analysis where the libraries of the browser, the extra ``serve``, are not installed."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.paths import ROOT

PROGRAM = """
import sys
for name in ("starlette", "uvicorn", "jinja2"):
    sys.modules[name] = None
from analysis.cli import main
sys.exit(main(sys.argv[1:]))
"""


def without_the_browser(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", PROGRAM, *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("command", [(), ("figures",), ("compare",), ("report",), ("serve",)])
def test_a_command_explains_itself(command: tuple[str, ...]) -> None:
    done = without_the_browser(*command, "--help")
    assert (done.returncode, done.stderr) == (0, "")


def test_the_browser_names_the_extra() -> None:
    done = without_the_browser("serve")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "pip install 'dopt[serve]'" in done.stderr
