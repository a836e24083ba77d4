"""Which keys of a grid some choice had, and the refusal of one that none had."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from omegaconf import DictConfig

from dopt.errors import SpecificationError, unknown_name
from orchestrate.hydra_plugins.dopt_grid._overlay import has_key

_OF_NOBODY = ("hydra", "name")
"""Keys that nobody sets by hand."""


@dataclasses.dataclass
class Keys:
    """Keys that were set in some choice, and the choices that lack a key."""

    used: set[str] = dataclasses.field(default_factory=set)
    lacking: dict[str, list[DictConfig]] = dataclasses.field(default_factory=dict)

    def note(self, config: DictConfig, used: Iterable[str], lacking: Iterable[str]) -> None:
        """Take in a choice, as it is composed without the keys that it lacks."""
        self.used.update(used)
        for key in lacking:
            self.lacking.setdefault(key, []).append(config)

    def check_all_used(self) -> None:
        """Refuse a key that no choice had.

        Raises
        ------
        SpecificationError
            With the nearest of the names that the choices have in its place.
        """
        for key, configs in self.lacking.items():
            if key not in self.used:
                raise _unknown(key, configs)


def _unknown(key: str, configs: Iterable[DictConfig]) -> SpecificationError:
    holder, _, last = key.rpartition(".")
    while holder and not any(has_key(config, holder) for config in configs):
        holder, _, last = holder.rpartition(".")
    names = {name for config in configs for name in _names(config, holder)}
    return unknown_name(f"setting of {holder}" if holder else "setting", last, names)


def _names(config: DictConfig, holder: str) -> Iterable[str]:
    """Return the keys below a key; none below a value, or where it is not there."""
    node: object = config
    for part in holder.split(".") if holder else ():
        node = node._get_node(part) if isinstance(node, DictConfig) else None
    if not isinstance(node, DictConfig) or node._is_none() or node._is_missing():
        return ()
    return [str(name) for name in node if name not in _OF_NOBODY]
