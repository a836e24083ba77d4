"""The sweeper that ``-m`` uses.

Annotations are not postponed here: Hydra's scan executes a plugin before it is in ``sys.modules``,
where a dataclass would look up postponed ones.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from orchestrate.grid import Combination
from orchestrate.hydra_plugins.dopt_grid._expansion import expand
from orchestrate.hydra_plugins.dopt_grid._unread import check_keys


@dataclass
class GridSweeperConf:
    """``params`` are sweeps that hold unless the command line names the same key.

    ``grids`` asks for several grids at once: each entry is laid over ``params``, and trials that
    are in more than one of them run once.
    """

    _target_: str = "hydra_plugins.dopt_grid.sweeper.GridSweeper"
    params: dict[str, str] = field(default_factory=dict)
    grids: list[dict[str, str]] = field(default_factory=list)


ConfigStore.instance().store(
    group="hydra/sweeper", name="grid", node=GridSweeperConf, provider="dopt_grid"
)


class GridSweeper(Sweeper):
    """Expands the whole grid and hands it, with the common settings, to the task function once.

    The task function gets a pair: the configuration without the sweeps, and the combinations.
    """

    def __init__(self, params: Mapping[str, str], grids: Sequence[Mapping[str, str]] = ()) -> None:
        self.grids = [{**params, **grid} for grid in grids] or [dict(params)]

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.loader = hydra_context.config_loader
        self.task_function = task_function
        self.settings = config

    def sweep(self, arguments: list[str]) -> Any:
        combinations = [
            combination
            for grid in self.grids
            for combination in self._expand([*_words(grid), *arguments])
        ]
        return self.task_function((self.settings, combinations))

    def _expand(self, arguments: list[str]) -> list[Combination]:
        return expand(self.loader, self.settings, arguments, check=check_keys)


def _words(grid: Mapping[str, str]) -> list[str]:
    return [f"{key}={value}" for key, value in grid.items()]
