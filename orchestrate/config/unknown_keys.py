"""Refusal of unused configuration keys, such as a misspelt ``+key``."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import cast

from omegaconf import DictConfig, OmegaConf

from dopt.declare.registry import TARGET, imported
from dopt.errors import SpecificationError, unknown_name
from orchestrate.config.scalar_overrides import has_key, interpolations

KNOWN = (
    "env",
    "policy",
    "model",
    "learner",
    "task",
    "limits",
    "seed",
    "width",
    "launch",
    "store",
    "executor",
)
"""Top-level keys that a launch reads, beside Hydra's own."""

_NOT_SETTABLE = ("hydra", "name", TARGET)
"""Keys that messages do not suggest."""


def reject_unknown(config: DictConfig) -> None:
    """Refuse a top-level key that the launch does not read and no setting refers to.

    Raises
    ------
    SpecificationError
        With the nearest valid key.
    """
    for key in set(map(str, config)) - {*KNOWN, "hydra"}:
        own = [name for name in map(str, config) if name != "hydra"]
        reference = re.compile(rf"\$\{{[^{{}}]*\b{re.escape(key)}\b")
        if not any(reference.search(text) for _, text in interpolations(config, own)):
            raise unknown_name("setting", key, KNOWN)


def check_launch(launch: Mapping[str, object], folder: Path) -> None:
    """Refuse an unknown setting of the launch, its store or its executor.

    Parameters
    ----------
    launch
        The sections ``launch``, ``store`` and ``executor`` in plain types.
    folder
        Folder of the configuration files.
    """
    executor = launch["executor"]
    name = executor.get("name") if isinstance(executor, Mapping) else None
    _check("launch", launch["launch"], _read(folder / "config.yaml").get("launch"))
    _check("store", launch["store"], dict.fromkeys(("url", "folder", "every")))
    _check("executor", executor, _read(folder / "executor" / f"{name}.yaml"))


def _check(path: str, given: object, known: object) -> None:
    if not isinstance(given, Mapping) or not isinstance(known, Mapping) or not known:
        return
    for key, value in given.items():
        if key not in known:
            raise unknown_name(f"setting of {path}", key, map(str, known))
        _check(f"{path}.{key}", value, known[key])


def _read(path: Path) -> dict[str, object]:
    """Return the content of a file; empty for an option outside this folder."""
    content = OmegaConf.to_container(OmegaConf.load(path)) if path.is_file() else {}
    return {str(key): value for key, value in content.items()} if isinstance(content, dict) else {}


@dataclasses.dataclass
class UnusedKeys:
    """Keys that some choice uses, and choices without a key that is set."""

    used: set[str] = dataclasses.field(default_factory=set)
    lacking: dict[str, list[DictConfig]] = dataclasses.field(default_factory=dict)

    def note(self, config: DictConfig, used: Iterable[str], lacking: Iterable[str]) -> None:
        """Record a choice, composed without the keys that it lacks."""
        self.used.update(used)
        for key in lacking:
            self.lacking.setdefault(key, []).append(config)

    def check_all_used(self) -> None:
        """Refuse a key that no choice has.

        Raises
        ------
        SpecificationError
            With the nearest name in its place.
        """
        for key, configs in self.lacking.items():
            if key not in self.used:
                raise _unknown(key, configs)


def unknown_setting(key: str, names: Iterable[str]) -> SpecificationError:
    """Return the error for a dotted key, with the nearest of the names in its place."""
    holder, _, last = key.rpartition(".")
    settable = [name for name in names if name not in _NOT_SETTABLE]
    return unknown_name(f"setting of {holder}" if holder else "setting", last, settable)


def unknown_field(key: str, target: str, names: Iterable[str]) -> SpecificationError:
    """Return the error for a key of a custom class.

    Parameters
    ----------
    key
        Dotted key, such as ``env.mass``.
    target
        Dotted path of the class.
    names
        Keys of the section in its configuration file, where a field may be missing.
    """
    holder, _, last = key.rpartition(".")
    try:
        fields = inspect.signature(cast("type", imported(holder, target))).parameters
    except SpecificationError as error:
        return error
    if last in fields:
        return SpecificationError(
            f"'{key}' is a field of {target}, but its configuration file does not set it: "
            f"add it with +{key}=."
        )
    return unknown_setting(key, {*names, *fields})


def _unknown(key: str, configs: Sequence[DictConfig]) -> SpecificationError:
    holder, _, last = key.rpartition(".")
    while holder and not any(has_key(config, holder) for config in configs):
        holder, _, last = holder.rpartition(".")
    name = f"{holder}.{last}" if holder else last
    names = {name for config in configs for name in _keys_below(config, holder)}
    targets = (OmegaConf.select(config, f"{holder}.{TARGET}") for config in configs if holder)
    target = next((target for target in targets if target), None)
    return unknown_field(name, target, names) if target else unknown_setting(name, names)


def _keys_below(config: DictConfig, holder: str) -> Iterable[str]:
    """Return the keys below a key; none if it is missing or holds a value."""
    node: object = config
    for part in holder.split(".") if holder else ():
        node = node._get_node(part) if isinstance(node, DictConfig) else None
    if not isinstance(node, DictConfig) or node._is_none() or node._is_missing():
        return ()
    return [str(name) for name in node]
