"""Configuration of Hydra in the tests: each file is parsed once in a process, not twice a launch.

Nor is a launch composed twice, to look first whether its configuration names a mode.
"""

from __future__ import annotations

import pickle
from pathlib import Path

from hydra._internal.config_repository import ConfigRepository
from hydra._internal.hydra import Hydra
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigResult, ConfigSource

_parse = ConfigRepository.load_config
_compose_mode = Hydra.get_mode
_parsed: dict[tuple[str, str, str, int], bytes] = {}


def parse_once() -> None:
    """Let launches in this process keep what they have parsed, and compose once."""
    setattr(ConfigRepository, "load_config", _load_config)  # noqa: B010  # mypy forbids the other way
    setattr(Hydra, "get_mode", _mode)  # noqa: B010


def _mode(hydra: Hydra, config_name: str | None, overrides: list[str]) -> object:
    """Return the mode that the configuration names, which no file of the project does."""
    if any("hydra" in override for override in overrides):
        return _compose_mode(hydra, config_name, overrides)
    return None


def _load_config(repository: ConfigRepository, config_path: str) -> ConfigResult | None:
    source = repository._find_object_source(config_path, ObjectType.CONFIG)
    if source is None or source.scheme() == "structured":
        return _parse(repository, config_path)
    key = (source.scheme(), source.path, config_path, _changed(source, config_path))
    if key not in _parsed:
        _parsed[key] = pickle.dumps(_parse(repository, config_path))
    content: ConfigResult = pickle.loads(_parsed[key])
    return content


def _changed(source: ConfigSource, config_path: str) -> int:
    """Return when a file was changed; those of a package do not change."""
    file = Path(source.path, source._normalize_file_name(config_path))
    return file.stat().st_mtime_ns if source.scheme() == "file" else 0
