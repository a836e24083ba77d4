"""Registration of a grid without running it: ``python -m benchmarks.register [key=value ...]``."""

from __future__ import annotations

from benchmarks.launches import RECORD
from orchestrate.store import Store


def main() -> None:
    """Register the trials of the command line in its database."""
    from orchestrate.config.command_line import read_command_line
    from orchestrate.config.grid import build_grid

    request = read_command_line()
    assert request is not None
    grid = build_grid(request.combinations)
    with Store.open(request.launch["store"]["url"]) as store:
        launch = store.begin_launch(RECORD)
        store.register(launch, grid.trials)
        store.end_launch(launch, "done")


if __name__ == "__main__":
    main()
