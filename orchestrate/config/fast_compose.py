"""Fast repetition of Hydra's composition for many choices of groups."""

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
    """Composer with Hydra's result, which reads files once and leaves out Hydra's own settings.

    These settings are half of a composed configuration, and no trial depends on them. In unusual
    cases and after an error Hydra itself composes, and its result or error is used.
    """

    def __init__(self, loader: ConfigLoader, config: DictConfig) -> None:
        self._loader = loader
        self._config = config
        self._parser = OverridesParser.create(config_loader=loader)
        self._parsed: dict[str, Override] = {}
        usual = type(loader) is ConfigLoaderImpl and not config.hydra.searchpath
        self._files = _Files(loader.repository) if usual else None  # type: ignore[attr-defined]

    def compose(self, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration for overrides without sweeps."""
        return self.attempt(overrides) or self.like_hydra(overrides)

    def attempt(self, overrides: Sequence[str]) -> DictConfig | None:
        """Return the configuration, or None if Hydra itself has to compose it or raise an error."""
        if self._files is not None:
            with contextlib.suppress(Exception):
                return self._quick(self._files, overrides)
        return None

    def like_hydra(self, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration that Hydra composes for a job of a sweep."""
        return self._loader.load_sweep_config(self._config, list(overrides))

    def _quick(self, files: _Files, overrides: Sequence[str]) -> DictConfig:
        files.cache.clear()
        defaults = create_defaults_list(
            repo=files,
            config_name=self._config.hydra.job.config_name,
            overrides_list=[self._override(word) for word in overrides],
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
