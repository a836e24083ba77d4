"""Installed programs beside modules of a user's own that have the names of our packages."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.paths import ROOT

SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


@pytest.mark.parametrize("program", sorted(SCRIPTS))
def test_a_module_of_the_users_own_does_not_stand_in_for_a_package(
    program: str, tmp_path: Path
) -> None:
    for name in ("analysis", "orchestrate"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('the wrong module')\n")
    module, _, function = SCRIPTS[program].partition(":")
    done = subprocess.run(
        [sys.executable, "-c", f"from {module} import {function}; {function}()", "--help"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert len(done.stdout.splitlines()) > 5
