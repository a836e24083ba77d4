"""Commands of a page, run in this process: one start of the interpreter serves all of them."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import pytest

from analysis import cli
from orchestrate import __main__ as orchestrate
from orchestrate import launch
from tests.paths import ROOT

STEPS, STEPS_OF_TASK = ("env.horizon=20",), ("env.horizon=100", "+task.iterations=1")
FRAMES = ["--frames", "4"]
"""Added to each launch and to each film: what a page shows does not depend on how long its trials
are, nor on how well its tasks are solved.
"""


def run_typed(
    line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Run a line with a launch, ``python -m orchestrate`` or ``python -m analysis``."""
    words = shlex.split(line)
    while re.match(r"[A-Z_]+=", words[0]):
        name, _, value = words.pop(0).partition("=")
        assert name == "PYTHONPATH", line
        monkeypatch.syspath_prepend(str(ROOT / value))
    assert words.pop(0) == "python", line
    try:
        code = _main(words, monkeypatch)
    except SystemExit as end:
        code = int(end.code or 0)
    said = capsys.readouterr()
    assert code == 0, f"{line}\n{said.out}{said.err}"
    assert said.out + said.err, line


def _main(words: list[str], monkeypatch: pytest.MonkeyPatch) -> int:
    if words[0] == "-m":
        program = {"orchestrate": orchestrate.main, "analysis": cli.main}[words[1]]
        return int(program(words[2:] + (FRAMES if words[2] == "animate" else [])))
    assert words[0] == "orchestrate/launch.py", words
    here = ["executor=inprocess" if word == "executor=local" else word for word in words[1:]]
    steps = STEPS_OF_TASK if any(word.startswith("task=") for word in here) else STEPS
    monkeypatch.setattr(sys, "argv", ["launch.py", *here, *steps])
    return int(launch.main())


def empty_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in a folder that looks like the repository, so that nothing is left in the real one."""
    for name in ("analysis", "dopt", "docs", "orchestrate"):
        (folder / name).symlink_to(ROOT / name)
    monkeypatch.chdir(folder)
    monkeypatch.delenv("DOPT_DB", raising=False)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
