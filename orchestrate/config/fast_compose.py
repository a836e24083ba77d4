"""Hydra's composition, repeated quickly for many choices of groups."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
from collections.abc import Sequence

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, IConfigRepository
from hydra._internal.defaults_list import create_defaults_list
from hydra.core.config_loader import ConfigLoader
from hydra.core.default_element import GroupDefault, InputDefault
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf


class Composer:
    """Composes what Hydra would, from files that are read once and without Hydra's own settings.

    These settings are half of what Hydra composes for a job, and no trial depends on them. Where
    something is unusual, or goes wrong, Hydra itself composes and its result or error stands.
    """

    def __init__(self, loader: ConfigLoader, config: DictConfig) -> None:
        self._loader = loader
        self._config = config
        self._parser = OverridesParser.create(config_loader=loader)
        self._parsed: dict[str, Override] = {}
        usual = type(loader) is ConfigLoaderImpl and not config.hydra.searchpath
        self._files = _Files(loader.repository) if usual else None  # type: ignore[attr-defined]

    def compose(self, words: Sequence[str]) -> DictConfig:
        """Return the configuration for overrides without sweeps."""
        return self.attempt(words) or self.like_hydra(words)

    def attempt(self, words: Sequence[str]) -> DictConfig | None:
        """Return the configuration, or None where Hydra itself has to compose or to complain."""
        if self._files is not None:
            with contextlib.suppress(Exception):
                return self._quick(self._files, words)
        return None

    def like_hydra(self, words: Sequence[str]) -> DictConfig:
        """Return what Hydra composes for a job of a sweep."""
        return self._loader.load_sweep_config(self._config, list(words))

    def _quick(self, files: _Files, words: Sequence[str]) -> DictConfig:
        files.cache.clear()
        defaults = create_defaults_list(
            repo=files,
            config_name=self._config.hydra.job.config_name,
            overrides_list=[self._override(word) for word in words],
            prepend_hydra=False,
            skip_missing=False,
        )
        loader = self._loader
        assert isinstance(loader, ConfigLoaderImpl)
        config = loader._compose_config_from_defaults_list(defaults.defaults, files)
        OmegaConf.set_struct(config, True)
        ConfigLoaderImpl._apply_overrides_to_config(defaults.config_overrides, config)
        return config

    def _override(self, word: str) -> Override:
        if word not in self._parsed:
            self._parsed[word] = self._parser.parse_overrides([word])[0]
        return self._parsed[word]


class _Files(CachingConfigRepository):
    """Configuration files, read once; each composition gets copies that it may change."""

    def __init__(self, delegate: IConfigRepository) -> None:
        super().__init__(delegate)
        self._read: dict[str, ConfigResult | None] = {}

    def load_config(self, config_path: str) -> ConfigResult | None:
        if config_path not in self._read:
            self._read[config_path] = self.delegate.load_config(config_path)
        if config_path not in self.cache:
            self.cache[config_path] = _copy(self._read[config_path])
        return self.cache[config_path]


def _copy(result: ConfigResult | None) -> ConfigResult | None:
    if result is None:
        return None
    defaults = [item for item in result.defaults_list or [] if not _is_hydra(item)]
    return dataclasses.replace(result, config=copy.deepcopy(result.config), defaults_list=defaults)


def _is_hydra(item: InputDefault) -> bool:
    group = item.group if isinstance(item, GroupDefault) else None
    return group is not None and group.lstrip("/").startswith("hydra/")
