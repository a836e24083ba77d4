"""A real launch of stand-in trials that pass a gate: ``python -m ... URL SEEDS FOLDER``."""

from __future__ import annotations

import sys
from pathlib import Path

from orchestrate.config import Grid
from orchestrate.config.launch_settings import LaunchSettings
from orchestrate.runner.run_grid import Work, launch_grid
from orchestrate.store import LaunchRecord
from tests.analysis.browser.grids import SHORT
from tests.analysis.synthetic import fake_result, make_grid
from tests.orchestrate.faults.trials import Gate, Gated


def main(url: str, seeds: int, folder: Path) -> int:
    """Launch pendulum trials of two policies into a database."""
    specs = make_grid(("pendulum",), ("d_optimal", "random"), range(seeds), **SHORT)
    settings = LaunchSettings(executor="inprocess", store_url=url, workers=1)
    record = LaunchRecord(argv=["launch"], overrides=[], host="here", pid=1)
    work = Work(Gated(fake_result, Gate(folder)), prepare=lambda: None)
    grid = Grid(specs, n_jobs=len(specs), left_out={})
    return int(launch_grid(grid, settings, record, work, lambda _: None, stream=None))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])))
