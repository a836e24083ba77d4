"""The sweeper that ``-m`` uses.

Annotations are not postponed here: Hydra's scan executes a plugin before it is in ``sys.modules``,
where a dataclass would look up postponed ones.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from orchestrate.hydra_plugins.dopt_grid._expansion import expand
from orchestrate.hydra_plugins.dopt_grid._unread import check_keys


@dataclass
class GridSweeperConf:
    """``params`` are sweeps that hold unless the command line names the same key."""

    _target_: str = "hydra_plugins.dopt_grid.sweeper.GridSweeper"
    params: dict[str, str] = field(default_factory=dict)


ConfigStore.instance().store(
    group="hydra/sweeper", name="grid", node=GridSweeperConf, provider="dopt_grid"
)


class GridSweeper(Sweeper):
    """Expands the whole grid and hands it, with the common settings, to the task function once.

    The task function gets a pair: the configuration without the sweeps, and the combinations.
    """

    def __init__(self, params: Mapping[str, str]) -> None:
        self.params = params

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.loader = hydra_context.config_loader
        self.task_function = task_function
        self.settings = config

    def sweep(self, arguments: list[str]) -> Any:
        defaults = [f"{key}={value}" for key, value in self.params.items()]
        arguments = defaults + arguments
        combinations = expand(self.loader, self.settings, arguments, check=check_keys)
        return self.task_function((self.settings, combinations))
