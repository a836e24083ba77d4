"""The analysis where the libraries of the browser, the extra ``serve``, are not installed."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.paths import ROOT

COMMANDS = [["--help"], *([name, "--help"] for name in ("figures", "compare", "report", "serve"))]
SERVE = ["serve"]
PROGRAM = """
import contextlib, io, json, sys
for name in ("starlette", "uvicorn", "jinja2"):
    sys.modules[name] = None
from analysis.cli import main
for words in json.loads(sys.argv[1]):
    out, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        try:
            code = main(words)
        except SystemExit as end:
            code = end.code or 0
    print(json.dumps([code, out.getvalue(), errors.getvalue()]))
"""


@pytest.fixture(scope="module")
def answers() -> dict[str, tuple[int, str, str]]:
    """Return exit code, output and errors of each command, all run in one process."""
    given = [*COMMANDS, SERVE]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(given)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    lines = map(json.loads, done.stdout.splitlines())
    return {" ".join(words): tuple(line) for words, line in zip(given, lines, strict=True)}


@pytest.mark.parametrize("command", [" ".join(words) for words in COMMANDS])
def test_a_command_explains_itself(command: str, answers: dict[str, tuple[int, str, str]]) -> None:
    code, out, errors = answers[command]
    assert (code, errors) == (0, "")
    assert "usage" in out.lower()


def test_the_browser_names_the_extra(answers: dict[str, tuple[int, str, str]]) -> None:
    code, _, errors = answers["serve"]
    assert code == 2
    assert errors.count("\n") == 1
    assert "pip install 'dopt-exploration[serve]'" in errors
