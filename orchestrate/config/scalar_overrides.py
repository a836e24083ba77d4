"""Scalar overrides in a composed configuration, with their references, without recomposition."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence
from typing import Any

from omegaconf import AnyNode, Container, DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

Settings = dict[str, Any]

_REFERENCE = re.compile(r"\$\{\s*([A-Za-z_]\w*(?:\.\w+)*)\s*\}")
_ENVIRONMENT = re.compile(r"\$\{\s*oc\.env:[^${}]*\}")


class ScalarOverrides:
    """Composed configuration in which the scalars at ``keys`` change.

    Plain references such as ``model.width: ${width}`` are tracked by name; OmegaConf resolves any
    other interpolation again each time.

    Parameters
    ----------
    config
        Configuration that was composed with some value for each of the keys.
    keys
        Dotted keys of the scalars.
    sections
        Top-level keys that the settings hold.
    """

    def __init__(self, config: DictConfig, keys: Sequence[str], sections: Sequence[str]) -> None:
        self._config = config
        self._keys = list(keys)
        present = [key for key in sections if key in config.keys()]  # noqa: SIM118
        self._base = {key: _resolved(config, key) for key in present}
        references = list(interpolations(config, present))
        self._paths = {key: [key] for key in keys}
        self._computed = [path for path, raw in references if not self._follow(path, raw)]

    @property
    def applicable(self) -> bool:
        """Whether every key holds an untyped scalar, so that it accepts any value."""
        return all(type(_node(self._config, key)) is AnyNode for key in self._keys)

    def free(self, key: str) -> bool:
        """Return whether no other key depends on ``key``."""
        return not self._computed and self._paths.get(key) == [key]

    def settings(self, values: Sequence[object]) -> Settings:
        """Return the resolved sections with one value for each key."""
        changes = dict(zip(self._keys, values, strict=True))
        result = dict(self._base)
        fresh: set[str] = set()
        for key, value in changes.items():
            for path in self._paths[key]:
                _put(result, path, value, fresh)
        if self._computed:
            for key, value in changes.items():
                OmegaConf.update(self._config, key, value)
            for path in self._computed:
                _put(result, path, _resolved(self._config, path), fresh)
        return result

    def _follow(self, path: str, raw: str) -> bool:
        """Return whether ``path`` is constant, or equal to one of the keys."""
        if _ENVIRONMENT.fullmatch(raw):
            return True
        match = _REFERENCE.fullmatch(raw)
        if match is None:
            return False
        if match[1] in self._paths:
            self._paths[match[1]].append(path)
            return True
        target = _node(self._config, match[1])
        if target is None or isinstance(target, Container):
            return False
        return not target._is_interpolation() or self._follow(path, str(target._value()))


def interpolations(node: Any, keys: Sequence[Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the dotted path and text of each interpolation below ``node``."""
    for key in keys:
        child, path = node._get_node(key), f"{prefix}{key}"
        if child._is_interpolation():
            yield path, str(child._value())
        elif (
            isinstance(child, DictConfig | ListConfig)
            and not child._is_none()
            and not child._is_missing()
        ):
            inner = range(len(child)) if isinstance(child, ListConfig) else list(child)
            yield from interpolations(child, inner, f"{path}.")


def _node(config: DictConfig, key: str) -> Any:
    parent, _, last = key.rpartition(".")
    holder = OmegaConf.select(config, parent) if parent else config
    return holder._get_node(last) if isinstance(holder, DictConfig) else None


def has_key(config: DictConfig, key: str) -> bool:
    """Return whether a dotted key, or an entry of a list, exists, whatever its value."""
    parent, _, last = key.rpartition(".")
    with contextlib.suppress(OmegaConfBaseException):
        holder = OmegaConf.select(config, parent) if parent else config
        if isinstance(holder, ListConfig):
            return last.isdecimal() and int(last) < len(holder)
        return _node(config, key) is not None
    return False


def _resolved(config: DictConfig, path: str) -> Any:
    value = OmegaConf.select(config, path, throw_on_missing=True)
    if isinstance(value, Container):
        return OmegaConf.to_container(value, resolve=True, throw_on_missing=True)
    return value


def _put(result: Settings, path: str, value: object, fresh: set[str]) -> None:
    """Set a path in nested dicts; dicts not in ``fresh`` are shared, and are copied first."""
    *parents, last = path.split(".")
    if (parents or [last])[0] not in result:
        return
    holder: Any = result
    for depth, key in enumerate(parents):
        index = _index(holder, key)
        trail = ".".join(parents[: depth + 1])
        if trail not in fresh:
            holder[index] = holder[index].copy()
            fresh.add(trail)
        holder = holder[index]
    holder[_index(holder, last)] = value


def _index(holder: object, key: str) -> Any:
    return int(key) if isinstance(holder, list) else key
