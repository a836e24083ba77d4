"""Sweeper for ``-m``.

Annotations are not postponed here: Hydra's scan executes a plugin before it is in ``sys.modules``,
where a dataclass resolves postponed ones.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from orchestrate.config.expand import expand
from orchestrate.config.grid import Combination
from orchestrate.config.unknown_keys import reject_unknown


@dataclass
class GridSweeperConf:
    """Configuration of the sweeper.

    ``params`` are sweeps that apply unless the command line sets the same key. ``grids`` defines
    several grids: each entry is merged over ``params``, and trials in several grids run once.
    """

    _target_: str = "hydra_plugins.dopt_grid.sweeper.GridSweeper"
    params: dict[str, Any] = field(default_factory=dict)
    grids: list[dict[str, Any]] = field(default_factory=list)


ConfigStore.instance().store(
    group="hydra/sweeper", name="grid", node=GridSweeperConf, provider="dopt_grid"
)


class GridSweeper(Sweeper):
    """Sweeper that calls the task function once, with the settings and an expansion function.

    The task function gets a pair: the configuration without the sweeps, and a function that returns
    the combinations for the overrides of the command line, some of which Hydra has not seen.
    """

    def __init__(self, params: Mapping[str, Any], grids: Sequence[Mapping[str, Any]] = ()) -> None:
        self.grids = [{**params, **grid} for grid in grids] or [dict(params)]

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.loader = hydra_context.config_loader
        self.task_function = task_function
        self.settings = config

    def sweep(self, arguments: list[str]) -> Any:  # noqa: ARG002  # without the deferred overrides
        return self.task_function((self.settings, self._combinations))

    def _combinations(self, words: Sequence[str]) -> list[Combination]:
        grids = [[*(_override(*item) for item in one.items()), *words] for one in self.grids]
        return expand(self.loader, self.settings, *grids, check=reject_unknown)


def _override(key: str, value: Any) -> str:
    """Return the override as typed: text such as ``range(0,5)`` unchanged, the rest as JSON."""
    if isinstance(value, str):
        return f"{key}={value}"
    plain = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
    return f"{key}={json.dumps(plain)}"
