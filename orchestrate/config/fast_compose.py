"""Fast repetition of Hydra's composition for many choices of groups."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import pickle
from collections.abc import Collection, Sequence

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, IConfigRepository
from hydra._internal.defaults_list import create_defaults_list
from hydra.core.config_loader import ConfigLoader
from hydra.core.default_element import GroupDefault, InputDefault, ResultDefault
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf, flag_override


class Composer:
    """Composer with Hydra's result, which reads files once and leaves out Hydra's own settings.

    These settings are half of a composed configuration, and no trial depends on them. In unusual
    cases and after an error Hydra itself composes, and its result or error is used.

    Options that fill a section alone, such as ``env=pendulum`` and ``env=arm``, are exchanged in a
    configuration that was composed with one of them.
    """

    def __init__(self, loader: ConfigLoader, config: DictConfig) -> None:
        self._loader = loader
        self._config = config
        self._parser = OverridesParser.create(config_loader=loader)
        self._parsed: dict[str, Override] = {}
        usual = type(loader) is ConfigLoaderImpl and not config.hydra.searchpath
        self._files = _Files(loader.repository) if usual else None  # type: ignore[attr-defined]
        self._composed: dict[tuple[str, ...], _Composed] = {}
        self._latest: tuple[tuple[str, ...], bytes] | None = None
        self._sections: dict[str, bytes] = {}

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
        choices: list[Override] = []
        others: list[Override] = []
        for word in overrides:
            override = self._override(word)
            (choices if files.is_choice(override) else others).append(override)
        config = self._chosen(files, choices)
        ConfigLoaderImpl._apply_overrides_to_config(others, config)
        return config

    def _chosen(self, files: _Files, choices: Sequence[Override]) -> DictConfig:
        """Return the configuration for choices of groups, which the caller may change."""
        key = tuple(str(one.input_line) for one in choices)
        if self._latest is None or self._latest[0] != key:
            self._latest = key, pickle.dumps(self._exchanged(files, choices))
        return _restored(self._latest[1])

    def _exchanged(self, files: _Files, choices: Sequence[Override]) -> DictConfig:
        options = [one for one in choices if files.is_section(one)]
        composed = self._similar(files, choices, options)
        alone = [one for one in options if composed.source(one)]
        if len(alone) < len(options):  # other files write to the sections of the rest
            composed = self._similar(files, choices, alone)
        config = _restored(composed.pickled)
        with flag_override(config, ["struct", "no_deepcopy_set_nodes"], [False, True]):
            for one in alone:
                source = composed.source(one)
                if source is None:
                    return _restored(self._compose(files, choices).pickled)
                config[one.key_or_group] = self._section(files, source, one)
        return config

    def _similar(
        self, files: _Files, choices: Sequence[Override], options: Sequence[Override]
    ) -> _Composed:
        """Return a configuration that was composed for these choices, or for other ``options``."""
        pattern = tuple(
            one.key_or_group if one in options else str(one.input_line) for one in choices
        )
        if pattern not in self._composed:
            self._composed[pattern] = self._compose(files, choices)
        return self._composed[pattern]

    def _section(self, files: _Files, source: ResultDefault, option: Override) -> DictConfig:
        """Return the content of an option that takes the place of another one."""
        path = f"{option.key_or_group}/{option.value()}"
        if path not in self._sections:
            default = dataclasses.replace(source, config_path=path)
            loaded = _implementation(self._loader)._load_single_config(default, files).config
            self._sections[path] = pickle.dumps(loaded[option.key_or_group])
        return _restored(self._sections[path])

    def _compose(self, files: _Files, choices: Sequence[Override]) -> _Composed:
        files.cache.clear()
        defaults = create_defaults_list(
            repo=files,
            config_name=self._config.hydra.job.config_name,
            overrides_list=list(choices),
            prepend_hydra=False,
            skip_missing=False,
        ).defaults
        config = _implementation(self._loader)._compose_config_from_defaults_list(defaults, files)
        OmegaConf.set_struct(config, True)
        fixed = not any(files.follows_choices(one) for one in defaults)
        writers = [(one, files.sections(one)) for one in defaults] if fixed else []
        return _Composed(pickle.dumps(config), writers)

    def _override(self, word: str) -> Override:
        if word not in self._parsed:
            self._parsed[word] = self._parser.parse_overrides([word])[0]
        return self._parsed[word]


@dataclasses.dataclass(frozen=True)
class _Composed:
    """Configuration for choices of groups, and the files that write to its sections.

    It is kept pickled: to restore a configuration takes a quarter of the time of a copy.
    """

    pickled: bytes
    writers: Sequence[tuple[ResultDefault, Collection[str]]]

    def source(self, option: Override) -> ResultDefault | None:
        """Return the only file that writes to the section of an option; None if there are more."""
        group = option.key_or_group
        found = [file for file, sections in self.writers if group in sections]
        alone = len(found) == 1 and found[0].package == found[0].override_key == group
        return found[0] if alone else None


def _restored(pickled: bytes) -> DictConfig:
    config: DictConfig = pickle.loads(pickled)
    return config


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

    def is_choice(self, override: Override) -> bool:
        """Return whether an override chooses an option of a group, as Hydra decides it."""
        return self.group_exists(override.key_or_group) and not isinstance(override.value(), dict)

    def is_section(self, choice: Override) -> bool:
        """Return whether an option fills the section of its group and has no defaults."""
        group, option = choice.key_or_group, choice.value()
        if choice.type != OverrideType.CHANGE or choice.package or not isinstance(option, str):
            return False
        found = None if "/" in group else self.load_config(f"{group}/{option}")
        return (
            found is not None
            and not found.defaults_list
            and found.header["package"] in (None, "_group_", group)
        )

    def sections(self, default: ResultDefault) -> Collection[str]:
        """Return the top-level keys to which a file of a composed configuration writes."""
        if default.package:
            return (default.package.split(".")[0],)
        found = self.load_config(str(default.config_path))
        return () if found is None else [str(key) for key in found.config]

    def follows_choices(self, default: ResultDefault) -> bool:
        """Return whether the defaults of a file refer to options: ``- ${env}_policy``."""
        found = self.load_config(str(default.config_path))
        items = found.defaults_list if found is not None else None
        names = (
            getattr(item, "value", None) or getattr(item, "path", None) for item in items or ()
        )
        return any("${" in str(name) for name in names)


def _copy(result: ConfigResult | None) -> ConfigResult | None:
    if result is None:
        return None
    defaults = [item for item in result.defaults_list or [] if not _is_hydra(item)]
    return dataclasses.replace(result, config=copy.deepcopy(result.config), defaults_list=defaults)


def _is_hydra(item: InputDefault) -> bool:
    group = item.group if isinstance(item, GroupDefault) else None
    return group is not None and group.lstrip("/").startswith("hydra/")


def _implementation(loader: ConfigLoader) -> ConfigLoaderImpl:
    assert isinstance(loader, ConfigLoaderImpl)
    return loader
