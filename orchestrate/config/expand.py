"""Expansion of overrides to the combinations of a grid.

:func:`hydra.compose` composes the configuration of each choice of groups; scalar sweeps are a
product over its plain values. The result equals what Hydra's basic sweeper gives wherever that one
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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import hydra
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import ConfigCompositionException
from omegaconf import AnyNode, Container, DictConfig, ListConfig, OmegaConf, flag_override
from omegaconf.errors import OmegaConfBaseException

from dopt.errors import unknown_name
from dopt.registry import TARGET
from orchestrate.config import TRIAL_SECTIONS, Combination
from orchestrate.config.options import (
    KNOWN,
    Axis,
    keys_of,
    parsed_overrides,
    read_axes,
    unknown_field,
    unknown_setting,
)

Settings = dict[str, Any]
Check = Callable[[DictConfig], None]

_REFERENCE = re.compile(r"\$\{\s*([A-Za-z_]\w*(?:\.\w+)*)\s*\}")
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
    for arguments in grids:
        axes = read_axes(expansion.composer.loader, arguments)
        fixed = [axis for axis in axes if not (axis.kind == "scalar" and axis.swept)]
        for picks in itertools.product(*(range(len(axis.texts)) for axis in fixed)):
            result.extend(expansion.combinations(axes, _arguments(fixed, picks)))
    expansion.check_all_used()
    return result


@dataclasses.dataclass
class _Expansion:
    """State shared by the combinations of all choices.

    Attributes
    ----------
    used, lacking
        Keys that some choice uses, and choices, composed without it, that lack a key that is set.
    """

    composer: _Composer
    sections: Sequence[str]
    check: Check
    used: set[str] = dataclasses.field(default_factory=set)
    lacking: dict[str, list[DictConfig]] = dataclasses.field(default_factory=dict)

    def combinations(self, axes: Sequence[Axis], fixed: Mapping[int, str]) -> Iterator[Combination]:
        """Yield the combinations of one choice of all overrides except swept scalars."""
        first, lacking = self._compose(axes, fixed)
        self.check(first)
        unused = tuple(axis.key for axis in lacking)
        kept = [axis for axis in axes if axis not in lacking]
        used = tuple(axis.key for axis in kept if axis.replaces)
        self.used.update(used)
        for key in unused:
            self.lacking.setdefault(key, []).append(first)
        scalars = [axis for axis in kept if axis.kind == "scalar" and axis.swept]
        overrides = tuple(fixed[axis.place] for axis in kept if axis.swept and axis.place in fixed)
        overlay = _ScalarOverrides(first, [axis.key for axis in scalars], self.sections)
        if overlay.applicable:
            found = _overlaid(overlay, scalars, overrides)
        else:
            found = self._one_by_one(kept, fixed, scalars)
        yield from (dataclasses.replace(one, used=used, unused=unused) for one in found)

    def check_all_used(self) -> None:
        """Refuse a key that no choice has, with the nearest name in its place."""
        for key, configs in self.lacking.items():
            if key in self.used:
                continue
            holder, _, last = key.rpartition(".")
            while holder and not any(has_key(config, holder) for config in configs):
                holder, _, last = holder.rpartition(".")
            name = f"{holder}.{last}" if holder else last
            names = {one for config in configs for one in keys_of(_holder(config, holder), last)}
            targets = (OmegaConf.select(one, f"{holder}.{TARGET}") for one in configs if holder)
            target = next(filter(None, targets), None)
            raise unknown_field(name, target, names) if target else unknown_setting(name, names)

    def _compose(
        self, axes: Sequence[Axis], fixed: Mapping[int, str]
    ) -> tuple[DictConfig, list[Axis]]:
        """Return the configuration, and the axes whose key this choice lacks."""
        overrides = _in_order(axes, fixed)
        composed = self.composer.attempt(overrides)
        lacking = [] if composed is not None else self._lacking(axes, fixed)
        if lacking:
            kept = [axis for axis in axes if axis not in lacking]
            composed = self.composer.compose(_in_order(kept, fixed))
        return composed or self.composer.by_hydra(overrides), lacking

    def _lacking(self, axes: Sequence[Axis], fixed: Mapping[int, str]) -> list[Axis]:
        replacing = [axis for axis in axes if axis.replaces]
        others = [axis for axis in axes if axis not in replacing]
        bare = self.composer.attempt(_in_order(others, fixed))
        return [axis for axis in replacing if bare and not has_key(bare, axis.key)]

    def _one_by_one(
        self, axes: Sequence[Axis], fixed: Mapping[int, str], scalars: Sequence[Axis]
    ) -> Iterator[Combination]:
        """Compose each combination: a swept key holds a typed or structured value."""
        for picks in itertools.product(*(range(len(axis.texts)) for axis in scalars)):
            every = {**fixed, **_arguments(scalars, picks)}
            composed = self.composer.compose(_in_order(axes, every))
            overrides = tuple(every[axis.place] for axis in axes if axis.swept)
            yield Combination(
                _ScalarOverrides(composed, [], self.sections).settings([]), None, overrides
            )


def _arguments(axes: Sequence[Axis], picks: Sequence[int]) -> dict[int, str]:
    return {axis.place: axis.argument(pick) for axis, pick in zip(axes, picks, strict=True)}


def _in_order(axes: Sequence[Axis], fixed: Mapping[int, str]) -> list[str]:
    """Return an override for each axis: the one in ``fixed``, or the first value."""
    return [fixed.get(axis.place) or axis.argument(0) for axis in axes]


def _overlaid(
    overlay: _ScalarOverrides, scalars: Sequence[Axis], overrides: tuple[str, ...]
) -> Iterator[Combination]:
    """Yield one combination per set of values; seeds stay together if nothing depends on them."""
    together = [axis for axis in scalars if axis.key == "seed" and overlay.free("seed")]
    ranges = [range(1 if axis in together else len(axis.texts)) for axis in scalars]
    for picks in itertools.product(*ranges):
        chosen = list(zip(scalars, picks, strict=True))
        yield Combination(
            settings=overlay.settings([axis.values[pick] for axis, pick in chosen]),
            seeds=together[0].values if together else None,
            overrides=overrides
            + tuple(axis.argument(pick) for axis, pick in chosen if axis not in together),
        )


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
        self._parsed: dict[str, Override] = {}
        self._is_group: dict[str, bool] = {}
        self._options: dict[str, DictConfig | None] = {}
        self._frames: dict[tuple[str, ...], bytes] = {}
        self._latest: tuple[tuple[str, ...], bytes] = ((), b"")

    def compose(self, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration for overrides without sweeps."""
        return self.attempt(overrides) or self.by_hydra(overrides)

    def by_hydra(self, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration that Hydra composes, or raise its error."""
        return hydra.compose(self._name, [*self._own, *overrides])

    def attempt(self, overrides: Sequence[str]) -> DictConfig | None:
        """Return the configuration, or None if Hydra has to compose it or raise an error."""
        with contextlib.suppress(Exception):
            parsed = [self._override(word) for word in overrides]
            choices = [one for one in parsed if self._is_choice(one)]
            key = tuple(str(one.input_line) for one in choices)
            if not self._latest[1] or self._latest[0] != key:
                self._latest = key, pickle.dumps(self._chosen(choices))
            config: DictConfig = pickle.loads(self._latest[1])
            for one in parsed:
                if not self._is_choice(one):
                    _apply(one, config)
            return config
        return None

    def _chosen(self, choices: Sequence[Override]) -> DictConfig:
        """Return the configuration for choices of groups."""
        alone = {one.key_or_group: self._option(one) for one in choices if self._option(one)}
        frame = self._frame(choices, alone)
        written = [group for group in alone if group in frame]
        if written:  # other files write to these sections
            alone = {group: option for group, option in alone.items() if group not in written}
            frame = self._frame(choices, alone)
        with flag_override(frame, "struct", False):
            for group, option in alone.items():
                frame[group] = option
        return frame

    def _frame(self, choices: Sequence[Override], absent: Iterable[str]) -> DictConfig:
        """Return the configuration for choices, composed without some of their groups."""
        words = tuple(
            f"~{one.key_or_group}" if one.key_or_group in absent else str(one.input_line)
            for one in choices
        )
        if words not in self._frames:
            self._frames[words] = pickle.dumps(self.by_hydra(words))
        frame: DictConfig = pickle.loads(self._frames[words])
        return frame

    def _option(self, choice: Override) -> DictConfig | None:
        """Return the content of an option that has no defaults and fills the section of its group.

        It is None for every other option.
        """
        group, option = choice.key_or_group, choice.value()
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

    def _is_choice(self, override: Override) -> bool:
        """Return whether an override chooses an option of a group, as Hydra decides it."""
        group = override.key_or_group
        if group not in self._is_group:
            options = self.loader.get_group_options(group, results_filter=None)
            self._is_group[group] = bool(options)
        return self._is_group[group] and not isinstance(override.value(), dict)

    def _override(self, word: str) -> Override:
        if word not in self._parsed:
            [self._parsed[word]] = parsed_overrides([word], self.loader)
        return self._parsed[word]


def _apply(override: Override, config: DictConfig) -> None:
    """Set a value in a configuration; raise if only Hydra can, or if it has to refuse it."""
    forced = override.type == OverrideType.FORCE_ADD
    if override.package or not (forced or override.type == OverrideType.CHANGE):
        raise ConfigCompositionException(str(override.input_line))
    OmegaConf.update(config, override.key_or_group, override.value(), merge=True, force_add=forced)


class _ScalarOverrides:
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
        references = list(_interpolations(config, present))
        self._paths = {key: [key] for key in keys}
        self._computed = [path for path, raw in references if not self._follow(path, raw)]

    @property
    def applicable(self) -> bool:
        """Return whether every key holds an untyped scalar, so that it accepts any value."""
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


def _holder(config: DictConfig, path: str) -> object:
    """Return what a dotted path leads to, None without it."""
    node: object = config
    for part in path.split(".") if path else ():
        node = node._get_node(part) if isinstance(node, DictConfig) else None
    return node
