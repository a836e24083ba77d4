"""The sweeper that ``-m`` uses.

Annotations are not postponed here: Hydra's scan executes a plugin before it is in ``sys.modules``,
where a dataclass would look up postponed ones.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

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
    params: dict[str, Any] = field(default_factory=dict)
    grids: list[dict[str, Any]] = field(default_factory=list)


ConfigStore.instance().store(
    group="hydra/sweeper", name="grid", node=GridSweeperConf, provider="dopt_grid"
)


class GridSweeper(Sweeper):
    """Hands the common settings, and what expands the grid, to the task function once.

    The task function gets a pair: the configuration without the sweeps, and a function that returns
    the combinations for the overrides of the command line. Hydra has not seen all of them.
    """

    def __init__(self, params: Mapping[str, Any], grids: Sequence[Mapping[str, Any]] = ()) -> None:
        self.grids = [{**params, **grid} for grid in grids] or [dict(params)]

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.loader = hydra_context.config_loader
        self.task_function = task_function
        self.settings = config

    def sweep(self, arguments: list[str]) -> Any:  # noqa: ARG002  # only what Hydra has seen
        return self.task_function((self.settings, self._combinations))

    def _combinations(self, words: Sequence[str]) -> list[Combination]:
        grids = [[*(_override(*item) for item in one.items()), *words] for one in self.grids]
        return expand(self.loader, self.settings, *grids, check=check_keys)


def _override(key: str, value: Any) -> str:
    """Return what would be typed: text as it is, such as ``range(0,5)``, YAML's values as JSON."""
    if isinstance(value, str):
        return f"{key}={value}"
    plain = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
    return f"{key}={json.dumps(plain)}"
