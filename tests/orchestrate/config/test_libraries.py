"""A grid whose library is missing is refused before anything is stored."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest

from dopt.errors import SpecificationError, install_command
from orchestrate.config.grid import Combination, Grid, build_grid


def grid(*policies: str) -> Grid:
    settings = [
        {
            "env": {"name": "pendulum"},
            "policy": {"name": policy},
            "model": {"name": "mlp"},
            "learner": {"name": "adam"},
            "seed": 0,
        }
        for policy in policies
    ]
    return build_grid([Combination(one, range(2)) for one in settings])


@pytest.mark.parametrize("policy", ["sac", "max_agent"])
def test_a_missing_library_is_refused_with_the_extra(
    policy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = importlib.util.find_spec

    def without(name: str, *rest: Any) -> Any:
        return None if name == "stable_baselines3" else real(name, *rest)

    grid("random", policy).check_libraries()
    monkeypatch.setattr(importlib.util, "find_spec", without)
    grid("random", "d_optimal").check_libraries()
    command = re.escape(install_command("agents"))
    message = f"policy '{policy}' needs the library stable_baselines3.*{command}"
    with pytest.raises(SpecificationError, match=message):
        grid("random", policy).check_libraries()


def test_each_extra_is_one_of_the_package() -> None:
    declared = Path("pyproject.toml").read_text()
    for spec in grid("sac", "max_agent").trials:
        assert f"\n{spec.policy.extra} = [" in declared
