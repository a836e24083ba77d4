"""Expansion of overrides to the combinations of a grid.

:func:`hydra.compose` composes the configuration of each choice of groups, in which the other values
are set. The result equals what Hydra's basic sweeper gives wherever that one
succeeds, except for the values of some sweeps (:mod:`orchestrate.config.options`).

The basic sweeper fails if an override sets a key that only some of the choices have, such as
``policy.regularization=1e-2`` with every policy. Here the override applies to the choices that have
the key; it is an error only if no choice of any grid has it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import pickle
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import Any

import hydra
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import ConfigCompositionException
from omegaconf import Container, DictConfig, ListConfig, OmegaConf, flag_override
from omegaconf.errors import OmegaConfBaseException

from dopt.errors import unknown_name
from dopt.registry import TARGET
from orchestrate.config import TRIAL_SECTIONS, Combination
from orchestrate.config.options import (
    KNOWN,
    NOT_SWEPT,
    Axis,
    read_axes,
    unknown_field,
    unknown_setting,
)

Check = Callable[[DictConfig], None]
Pick = tuple[Axis, int]
"""Override, and which of its values."""

_REFERENCE = re.compile(r"\$\{\s*\.*[A-Za-z_]\w*(?:\.\w+)*\s*\}")
_ENVIRONMENT = re.compile(r"\$\{\s*oc\.env:[^${}]*\}")


def reject_unknown(config: DictConfig) -> None:
    """Refuse a top-level key that the launch does not read and no setting refers to.

    Settings of a task or of limits that were not chosen would be ignored: they are refused too.

    Raises
    ------
    SpecificationError
        With the nearest valid key.
    """
    for key in set(map(str, config)) - {*KNOWN, "hydra"}:
        own = [name for name in map(str, config) if name != "hydra"]
        reference = re.compile(rf"\$\{{[^{{}}]*\b{re.escape(key)}\b")
        texts = (_ENVIRONMENT.sub("", text) for _, text in _interpolations(config, own))
        if not any(map(reference.search, texts)):
            raise unknown_name("setting", key, KNOWN)
    for group in ("task", "limits"):
        section = OmegaConf.select(config, group)
        names = set(map(str, section)) if isinstance(section, DictConfig) else set()
        if names > {"name"} and section.name == "none":
            raise unknown_setting(f"{group}.{min(names - {'name'})}", ())


def expand(
    settings: DictConfig,
    *grids: Sequence[str],
    sections: Sequence[str] = TRIAL_SECTIONS,
    check: Check = reject_unknown,
) -> list[Combination]:
    """Return the combinations of one or several grids, of which ``build_grid`` makes trials.

    Parameters
    ----------
    settings
        Hydra's own settings in the configuration of the launch; Hydra has to be initialized.
    grids
        Overrides that span each grid (:func:`orchestrate.config.options.read_axes`).
    sections
        Top-level keys that the settings of a combination hold.
    check
        Called with each composed configuration; raises if that is invalid.

    Raises
    ------
    SpecificationError
        If an override sets a key that no choice of any grid has.
    """
    expansion = _Expansion(_Composer(settings), sections, check)
    result: list[Combination] = []
    for words in grids:
        axes = read_axes(expansion.composer.loader, words)
        counts = [1 if axis.key == "seed" else len(axis.texts) for axis in axes]
        for picks in itertools.product(*map(range, counts)):
            result.extend(expansion.combinations([*zip(axes, picks, strict=True)]))
    expansion.check_all_used()
    return result


@dataclasses.dataclass
class _Expansion:
    """State shared by the combinations of all choices.

    Attributes
    ----------
    used, lacking
        Keys that some choice uses, and the choices that lack a key that is set, each with its
        configuration.
    """

    composer: _Composer
    sections: Sequence[str]
    check: Check
    used: set[str] = dataclasses.field(default_factory=set)
    lacking: dict[str, dict[str, DictConfig]] = dataclasses.field(default_factory=dict)

    def combinations(self, picks: Sequence[Pick]) -> Iterator[Combination]:
        """Yield one combination, with all seeds, or one for each seed if something follows it."""
        config, lacking = self._compose(picks)
        self.check(config)
        used = tuple(axis.key for axis, _ in picks if axis.replaces and axis not in lacking)
        self.used.update(used)
        choices = " ".join(_words(_choices(picks)))
        for axis in lacking:
            self.lacking.setdefault(axis.key, {})[choices] = config
        if any(pick for axis, pick in picks if axis in lacking):
            return  # the same as with the first value of what is lacking
        swept = (axis for axis, _ in picks if axis.key == "seed" and len(axis.texts) > 1)
        seeds = next((axis.values for axis in swept), ())
        together = all(isinstance(seed, int) for seed in seeds) and _is_alone(config, "seed")
        present = [key for key in self.sections if key in config.keys()]  # noqa: SIM118
        for number in range(1 if together else len(seeds) or 1):
            if seeds:
                OmegaConf.update(config, "seed", seeds[number])
            yield Combination(
                settings={key: _resolved(config, key) for key in present},
                seeds=seeds if seeds and together else None,
                used=used,
                unused=tuple(axis.key for axis in lacking),
            )

    def check_all_used(self) -> None:
        """Refuse a key that no choice has, with the nearest name in its place."""
        for key, choices in self.lacking.items():
            if key in self.used:
                continue
            configs = choices.values()
            holder, _, last = key.rpartition(".")
            while holder and not any(has_key(config, holder) for config in configs):
                holder, _, last = holder.rpartition(".")
            name = f"{holder}.{last}" if holder else last
            names = {name for config in configs for name in _keys_below(config, holder)}
            targets = (OmegaConf.select(one, f"{holder}.{TARGET}") for one in configs if holder)
            target = next(filter(None, targets), None)
            raise unknown_field(name, target, names) if target else unknown_setting(name, names)

    def _compose(self, picks: Sequence[Pick]) -> tuple[DictConfig, list[Axis]]:
        """Return the configuration, and the axes whose key this choice lacks."""
        composed = self.composer.attempt(picks)
        lacking = [] if composed is not None else self._lacking(picks)
        if lacking:
            picks = [one for one in picks if one[0] not in lacking]
            composed = self.composer.attempt(picks)
        return composed or self.composer.by_hydra(_words(picks)), lacking

    def _lacking(self, picks: Sequence[Pick]) -> list[Axis]:
        bare = self.composer.attempt([one for one in picks if not one[0].replaces])
        replacing = (axis for axis, _ in picks if axis.replaces)
        return [axis for axis in replacing if bare and not has_key(bare, axis.key)]


def _words(picks: Iterable[Pick]) -> list[str]:
    """Return the overrides that set one value of each axis."""
    return [axis.argument(pick) for axis, pick in picks]


def _choices(picks: Iterable[Pick]) -> list[Pick]:
    return [(axis, pick) for axis, pick in picks if axis.chooses(pick)]


class _Composer:
    """Configurations for choices of groups and other overrides, as Hydra composes them.

    An option that only fills the section of its group, such as ``env=pendulum``, is put into a
    configuration that was composed without the group. So a grid of m by n such options takes one
    composition. Whatever is unusual or fails is left to :func:`hydra.compose`.
    """

    def __init__(self, settings: DictConfig) -> None:
        self.loader: ConfigLoader = GlobalHydra.instance().config_loader()
        self._name = settings.job.config_name
        self._own = list(settings.overrides.hydra)
        self._usual = not settings.searchpath
        self._options: dict[str, DictConfig | None] = {}
        self._frames: dict[tuple[str, ...], bytes] = {}
        self._latest: tuple[tuple[str, ...], bytes] = ((), b"")

    def by_hydra(self, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration that Hydra composes, or raise its error."""
        return hydra.compose(self._name, [*self._own, *overrides])

    def attempt(self, picks: Sequence[Pick]) -> DictConfig | None:
        """Return the configuration, or None if Hydra has to compose it or raise an error."""
        with contextlib.suppress(Exception):
            choices = _choices(picks)
            key = tuple(_words(choices))
            if not self._latest[1] or self._latest[0] != key:
                self._latest = key, pickle.dumps(self._chosen(choices))
            config: DictConfig = pickle.loads(self._latest[1])
            for axis, pick in picks:
                if not axis.chooses(pick):
                    _apply(axis.override, axis.values[pick], config)
            return config
        return None

    def _chosen(self, choices: Sequence[Pick]) -> DictConfig:
        """Return the configuration for choices of groups."""
        with contextlib.suppress(Exception):  # such as of an option that overrides another group
            return self._exchanged(choices)
        return self.by_hydra(_words(choices))

    def _exchanged(self, choices: Sequence[Pick]) -> DictConfig:
        """Return the configuration in which options are put into their sections."""
        options = {axis.override.key_or_group: self._option(axis, pick) for axis, pick in choices}
        alone = {group: option for group, option in options.items() if option}
        frame = self._frame(choices, alone)
        written = [group for group in alone if group in frame]
        if written:  # other files write to these sections
            alone = {group: option for group, option in alone.items() if group not in written}
            frame = self._frame(choices, alone)
        with flag_override(frame, "struct", False):
            for group, option in alone.items():
                frame[group] = option
        return frame

    def _frame(self, choices: Sequence[Pick], absent: Collection[str]) -> DictConfig:
        """Return the configuration for choices, composed without some of their groups."""
        groups = [axis.override.key_or_group for axis, _ in choices]
        pairs = zip(groups, _words(choices), strict=True)
        words = tuple(f"~{group}" if group in absent else word for group, word in pairs)
        if words not in self._frames:
            self._frames[words] = pickle.dumps(self.by_hydra(words))
        frame: DictConfig = pickle.loads(self._frames[words])
        return frame

    def _option(self, axis: Axis, pick: int) -> DictConfig | None:
        """Return the content of an option that has no defaults and fills the section of its group.

        It is None for every other option.
        """
        choice, option = axis.override, axis.values[pick]
        group = choice.key_or_group
        if choice.type != OverrideType.CHANGE or choice.package or not isinstance(option, str):
            return None
        path = f"{group}/{option}"
        if path not in self._options:
            sources = self.loader.get_sources() if self._usual and "/" not in group else []
            found = next((one.load_config(path) for one in sources if one.is_config(path)), None)
            own = found is not None and found.header["package"] in (None, "_group_", group)
            content = found.config if found is not None and own else None
            plain = isinstance(content, DictConfig) and "defaults" not in content
            self._options[path] = content if plain else None  # type: ignore[assignment]
        return self._options[path]


def _apply(override: Override, value: object, config: DictConfig) -> None:
    """Set a value in a configuration; raise if only Hydra can, or if it has to refuse it."""
    key, kind = override.key_or_group, override.type
    new = kind == OverrideType.ADD and not has_key(config, key)
    if override.package or not (new or kind in (OverrideType.CHANGE, OverrideType.FORCE_ADD)):
        raise ConfigCompositionException(str(override.input_line))
    added = kind != OverrideType.CHANGE
    OmegaConf.update(config, key, value, merge=True, force_add=added)


def _is_alone(config: DictConfig, key: str) -> bool:
    """Return whether no setting of a trial refers to a top-level key, as far as texts tell."""
    names = [name for name in map(str, config) if name not in NOT_SWEPT]
    plain = (_REFERENCE, _ENVIRONMENT)
    return all(
        key not in text and any(form.fullmatch(text) for form in plain)
        for _, text in _interpolations(config, names)
    )


def _interpolations(node: Any, keys: Sequence[Any], prefix: str = "") -> Iterator[tuple[str, str]]:
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
            yield from _interpolations(child, inner, f"{path}.")


def has_key(config: DictConfig, key: str) -> bool:
    """Return whether a dotted key, or an entry of a list, exists, whatever its value."""
    parent, _, last = key.rpartition(".")
    with contextlib.suppress(OmegaConfBaseException):
        holder = OmegaConf.select(config, parent) if parent else config
        if isinstance(holder, ListConfig):
            return last.isdecimal() and int(last) < len(holder)
        return isinstance(holder, DictConfig) and holder._get_node(last) is not None
    return False


def _resolved(config: DictConfig, path: str) -> Any:
    value = OmegaConf.select(config, path, throw_on_missing=True)
    if isinstance(value, Container):
        return OmegaConf.to_container(value, resolve=True, throw_on_missing=True)
    return value


def _keys_below(config: DictConfig, holder: str) -> Iterable[str]:
    """Return the keys below a key; none if it is missing or holds a value."""
    node: object = config
    for part in holder.split(".") if holder else ():
        node = node._get_node(part) if isinstance(node, DictConfig) else None
    if not isinstance(node, DictConfig) or node._is_none() or node._is_missing():
        return ()
    return [str(name) for name in node]
