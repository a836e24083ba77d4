"""A grid that does not fit into the memory is refused before it starts."""

from __future__ import annotations

from typing import Any

import pytest

from orchestrate.config import Combination, Grid, build_grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.errors import LaunchError
from orchestrate.runner.chunks import BYTES_PER_GIB, check_memory, memory_of_this_machine


def grid(seeds: int, width: int, form: str = "primal") -> Grid:
    """Return trials of the pendulum; width 100 has q = 10,601 parameters and needs 1.69 GiB."""
    settings: dict[str, Any] = {
        "env": {"name": "pendulum"},
        "policy": {"name": "d_optimal", "form": form},
        "model": {"name": "mlp", "width": width},
        "learner": {"name": "adam"},
        "seed": 0,
    }
    return build_grid([Combination(settings, range(seeds))])


def launch(executor: str = "local", **settings: Any) -> LaunchSettings:
    return LaunchSettings(executor, "sqlite:///results.db", **settings)


def test_what_fits_is_accepted() -> None:
    check_memory(grid(100, 16), launch(workers=64), machine=2 * BYTES_PER_GIB)
    check_memory(grid(100, 100), launch(workers=2), machine=4 * BYTES_PER_GIB)
    check_memory(grid(2, 100), launch(workers=64), machine=4 * BYTES_PER_GIB)
    check_memory(grid(100, 100), launch("inprocess"), machine=2 * BYTES_PER_GIB)


def test_one_trial_that_does_not_fit_is_refused_with_what_decides() -> None:
    with pytest.raises(LaunchError, match=r"policy=d_optimal needs 1\.6\d GiB .* has 1 GiB: make "):
        check_memory(grid(1, 100), launch(), machine=BYTES_PER_GIB)


@pytest.mark.parametrize(
    ("settings", "advice"),
    [
        (launch(workers=8), "8 trials at the same time need 13.* set launch.workers=4"),
        (launch("ray", workers=8), "set launch.workers=4"),
        (launch("lockstep", executor_options={"batch": 20}), "20 trials .* set executor.batch=4"),
    ],
)
def test_too_many_at_once_are_refused_with_how_many_fit(
    settings: LaunchSettings, advice: str
) -> None:
    with pytest.raises(LaunchError, match=advice):
        check_memory(grid(100, 100), settings, machine=8 * BYTES_PER_GIB)


def test_of_another_machine_nothing_is_known() -> None:
    check_memory(grid(9, 100), launch("ray", ray_address="ray://head:10001"), machine=BYTES_PER_GIB)
    check_memory(
        grid(9, 100), launch("lockstep", executor_options={"device": "cuda"}), machine=BYTES_PER_GIB
    )


def test_the_limit_of_a_worker_holds_everywhere() -> None:
    with pytest.raises(LaunchError, match=r"launch\.memory_gib allows 0\.5 GiB: raise it"):
        check_memory(grid(1, 100), launch("ray", ray_address="ray://h:1", memory_gib=0.5))


def test_this_machine_has_memory() -> None:
    assert 2**28 < memory_of_this_machine() < 2**50


def test_only_the_cores_that_we_may_use_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {3})
    check_memory(grid(100, 100), launch(), machine=2 * BYTES_PER_GIB)
