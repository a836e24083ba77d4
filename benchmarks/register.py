"""Registration of a grid without running it: ``python -m benchmarks.register [key=value ...]``."""

from __future__ import annotations

import sys

from benchmarks.launches import RECORD
from benchmarks.processes import ROOT
from orchestrate.store import Store

sys.path.append(str(ROOT / "orchestrate"))  # where Hydra finds the sweeper


def main() -> None:
    """Register the trials of the command line in its database."""
    from orchestrate.config.grid import build_grid
    from orchestrate.config.request import read_command_line

    request = read_command_line()
    assert request is not None
    grid = build_grid(request.combinations)
    with Store.open(request.launch["store"]["url"]) as store:
        launch = store.begin_launch(RECORD)
        store.register(launch, grid.trials)
        store.end_launch(launch, "done")


if __name__ == "__main__":
    main()
