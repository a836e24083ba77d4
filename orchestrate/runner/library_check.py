"""Check that the libraries which a grid cannot do without are installed, before anything runs."""

from __future__ import annotations

import importlib.util

from orchestrate.config.grid import Grid
from orchestrate.errors import LaunchError


def check_libraries(grid: Grid) -> None:
    """Refuse a grid with a policy whose library is not installed on this machine.

    Raises
    ------
    LaunchError
        If it is missing.
    """
    for policy in {type(trial.policy): trial.policy for trial in grid.trials}.values():
        if policy.library and importlib.util.find_spec(policy.library) is None:
            raise LaunchError(
                f"policy '{policy.name}' needs the library {policy.library}, but it is not "
                f"installed: pip install 'dopt[{policy.extra}]', or leave the policy out."
            )
