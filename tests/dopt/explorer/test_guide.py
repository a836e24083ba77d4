"""The guide's own lines explore a plant."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.paths import ROOT

BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "plants.md").read_text(), re.DOTALL)


def test_its_lines_run_as_they_stand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    state = {"x": np.zeros(2), "u": np.zeros(1), "time": 0.0}

    def measure() -> tuple[Any, Any]:
        return state["x"].copy(), state["time"]

    def apply(u: np.ndarray) -> None:
        """Hold an input for one time step of a motor."""
        angle, rate = state["x"]
        slope = np.array([rate, 40.0 * u[0] - 20.0 * np.sin(angle) - 2.0 * rate])
        state["x"], state["time"] = state["x"] + 0.005 * slope, state["time"] + 0.005

    names: dict[str, Any] = {"measure": measure, "apply": apply}
    for block in BLOCKS:
        shorter = block.replace("2000", "150")
        exec(compile(shorter, "plants.md", "exec"), names)
    explorer = names["explorer"]
    assert explorer.n_steps == explorer.counts["learned"] == 150
    assert (tmp_path / "motor.jsonl").stat().st_size > 0
    assert "'learned': 150" in capsys.readouterr().out


def test_a_plant_is_declared_in_fifteen_lines() -> None:
    [declaration] = re.findall(r"motor = dopt\.Plant\(.*?\n\)", "".join(BLOCKS), re.DOTALL)
    assert len(declaration.splitlines()) <= 15
