"""Options of the groups of a launch, axes of a grid, and error messages with the nearest option.

A file holds the paper's systems and policies with the reasons for their numbers, and whatever
chooses more than one part. Every other system and policy is an option with the defaults of its
class, whose docstring gives units and reasons: ``env=beyond/chain``, ``policy=baseline/prbs``.

A grid has an axis for each override. Its values are what the words say, also where stock Hydra has
others: of a sorted range, the nearest decimals of a range of real numbers, and the same order each
time of a shuffled sweep.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast

from hydra.core.config_loader import ConfigLoader
from hydra.core.config_store import ConfigStore
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import (
    ChoiceSweep,
    Glob,
    Override,
    OverrideType,
    Quote,
    QuotedString,
    RangeSweep,
    Sweep,
    Transformer,
)
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationResolutionError,
    OmegaConfBaseException,
)

from dopt.errors import DoptError, SpecificationError, suggestion, unknown_name
from dopt.registry import TARGET, imported
from orchestrate.config import TRIAL_SECTIONS
from orchestrate.program import removed_word

NOT_SWEPT = ("launch", "store", "executor", "experiment", "hydra")
"""Groups and sections of the whole launch, which cannot be swept."""

MAX_VALUES = 1_000_000
"""Largest number of values of one sweep, so that a mistyped range does not fill the memory."""


@dataclasses.dataclass(frozen=True)
class Axis:
    """Key of an override and its values.

    Attributes
    ----------
    key
        Configuration key or group as typed, with its prefix ``+``, ``++`` or ``~`` and its package.
    texts
        The values as Hydra would write them after the equals sign.
    values
        The values, typed by Hydra's grammar.
    kind
        ``choice`` of a group, ``scalar`` that replaces a value, or ``edit``: any other change of
        the composed configuration, such as ``+k=1``, a list or a deletion.
    place
        Number of the override in its order.
    """

    key: str
    texts: tuple[str, ...]
    values: tuple[object, ...]
    kind: Literal["choice", "scalar", "edit"]
    place: int = 0

    @property
    def swept(self) -> bool:
        return len(self.texts) > 1

    @property
    def replaces(self) -> bool:
        """Return whether the override sets an existing key: no group, and no ``+`` or ``~``."""
        return self.kind != "choice" and self.key[0] not in "+~"

    def argument(self, index: int) -> str:
        """Return the override that sets value ``index``."""
        return f"{self.key}={self.texts[index]}"


def read_axes(loader: ConfigLoader, arguments: Sequence[str]) -> list[Axis]:
    """Return the axes that the overrides span.

    A later override of a key replaces earlier ones, but mappings are merged, as in a single trial.

    Raises
    ------
    HydraException
        If an override does not follow Hydra's grammar, or its sweep is empty or endless.
    SpecificationError
        If a glob matches nothing.
    """
    kept: list[Override] = []
    for one in parsed_overrides(arguments, loader):
        key = one.get_key_element()
        merged = _is_mapping(one)
        kept = [k for k in kept if k.get_key_element() != key or (merged and _is_mapping(k))]
        kept.append(one)
    axes = [dataclasses.replace(_axis(loader, one), place=i) for i, one in enumerate(kept)]
    return [_without_clash(axis, axes) for axis in axes]


def parsed_overrides(
    arguments: Sequence[str], loader: ConfigLoader | None = None
) -> list[Override]:
    """Return overrides by Hydra's grammar.

    Raises
    ------
    HydraException
        If one does not follow it, shuffles a list, or has a sweep within a list or a mapping.
    """
    parser = OverridesParser.create(config_loader=loader)
    named = parser.functions.functions
    named["sort"] = partial(_sorted, named["sort"])
    named["shuffle"] = partial(_unshuffled, named["shuffle"])
    parsed = parser.parse_overrides(list(arguments))
    for one in parsed:
        if not isinstance(one._value, Sweep) and _holds_sweep(one._value):
            raise ConfigCompositionException(
                f"'{one.input_line}' has a sweep within a list or a mapping, but a sweep of whole "
                "values is expected: write each list or mapping, with commas between them."
            )
    return parsed


def _sorted(
    sort: Callable[..., Any], *args: Any, sweep: Any = None, reverse: bool = False, **named: Any
) -> Any:
    """Sort as Hydra's ``sort``, except for a range, which Hydra turns into another range."""
    ranges = [one for one in (*args, sweep) if isinstance(one, RangeSweep)]
    if ranges:
        return ChoiceSweep(list=[*sorted(_range_values(ranges[0]), reverse=reverse)])
    return sort(*args, sweep=sweep, reverse=reverse, **named)


def _unshuffled(shuffle: Callable[..., Any], *args: Any, **named: Any) -> Any:
    """Keep the order of a sweep, on which no result depends; refuse to shuffle a list."""
    shuffled = shuffle(*args, **named)
    if not isinstance(shuffled, Sweep):
        raise ValueError("a shuffled list is another value each time: write it in its order")
    shuffled.shuffle = False  # type: ignore[attr-defined]  # every sweep here has it
    return shuffled


def _holds_sweep(value: object) -> bool:
    parts = [*value.values()] if isinstance(value, Mapping) else value
    return isinstance(value, Sweep) or (isinstance(parts, list) and any(map(_holds_sweep, parts)))


def _is_mapping(override: Override) -> bool:
    values = _values(override._value)
    return override.type != OverrideType.DEL and all(isinstance(one, dict) for one in values)


def _values(value: object) -> list[Any]:
    """Return the values of a sweep of choices and ranges, or the one that is given."""
    if isinstance(value, ChoiceSweep):
        return [one for part in value.list for one in _values(part)]
    return _range_values(value) if isinstance(value, RangeSweep) else [value]


def _range_values(sweep: RangeSweep) -> list[int] | list[float]:
    """Return start + k · step before stop: whole numbers, or the nearest decimals."""
    bounds = sweep.start, sweep.stop, sweep.step
    given = f"range({','.join(map(str, bounds))})"
    try:
        start, stop, step = (Fraction(repr(bound)) for bound in bounds)
        count = math.ceil((stop - start) / step)
    except (ValueError, ZeroDivisionError) as error:
        raise ConfigCompositionException(
            f"{given} has no finite list of values: give finite numbers, and a step other than 0."
        ) from error
    if count > MAX_VALUES:
        raise ConfigCompositionException(
            f"{given} has more than {MAX_VALUES:,} values: check its bounds, or sweep in parts."
        )
    values = [start + k * step for k in range(count)]
    whole = all(isinstance(bound, int) for bound in bounds)
    return [int(value) for value in values] if whole else [float(value) for value in values]


def _axis(loader: ConfigLoader, override: Override) -> Axis:
    key = override.get_key_element()
    texts: tuple[str, ...]
    values: tuple[object, ...]
    value: object = override.value()
    if not override.is_sweep_override():
        texts, values = (override.get_value_element_as_str(),), (value,)
    elif isinstance(value, Glob):
        _check_key(override)
        texts = values = _matches(loader, override.key_or_group, value)
        if not texts:
            raise _no_match(loader, override, value)
    else:
        _check_key(override)
        found = _swept_values(override)
        texts = tuple(map(_text, found))
        values = tuple(one.text if isinstance(one, QuotedString) else one for one in found)
    options = loader.get_group_options(override.key_or_group, results_filter=None)
    if options and not any(isinstance(value, dict) for value in values):
        if None in values:
            names = _every_option(loader, override.key_or_group)
            raise unknown_name(override.key_or_group, "null", names)
        return Axis(key, texts, values, "choice")
    scalar = override.type == OverrideType.CHANGE and override.package is None
    return Axis(key, texts, values, "scalar" if scalar and all(map(_plain, values)) else "edit")


def _check_key(override: Override) -> None:
    if override.key_or_group.replace("/", ".").split(".")[0] in NOT_SWEPT:
        raise ConfigCompositionException(
            f"'{override.input_line}' sweeps a setting of the launch, but only settings of trials "
            "can be swept: give one value."
        )


def _swept_values(override: Override) -> list[Any]:
    line, found = override.input_line, _values(override._value)
    if any(isinstance(one, Sweep) for one in found):
        raise ConfigCompositionException(
            f"'{line}' has no finite list of values: use a choice a,b or range(start,stop,step)."
        )
    if not found:
        raise ConfigCompositionException(
            f"'{line}' has no values, at least one is expected: check its bounds."
        )
    return found


def _no_match(loader: ConfigLoader, override: Override, glob: Glob) -> Exception:
    key = override.key_or_group
    if options := _every_option(loader, key):
        pattern = ",".join(glob.include)
        hint = suggestion(pattern, sorted(options))
        return SpecificationError(f"no name of {key} matches the pattern '{pattern}': {hint}")
    names = sorted(name for name in loader.list_groups("") if name != "hydra")
    return ConfigCompositionException(
        f"'{override.input_line}' is a glob, but '{key}' is not a group: groups are "
        f"{', '.join(names)}."
    )


def _matches(loader: ConfigLoader, group: str, glob: Glob) -> tuple[str, ...]:
    """Return the options that a glob matches, folder by folder in the order of its patterns.

    As in Hydra, a pattern without a folder matches options of the group itself, not those in its
    folders; ``beyond/*`` matches those in the folder ``beyond``.
    """
    folders = dict.fromkeys(_folder(pattern) for pattern in glob.include)
    names = [name for folder in folders for name in _options(loader, group, folder)]
    return tuple(
        name for name in names if _any(name, glob.include) and not _any(name, glob.exclude)
    )


def _every_option(loader: ConfigLoader, group: str) -> list[str]:
    """Return the options of a group and of its folders."""
    folders = loader.get_group_options(group, results_filter=ObjectType.GROUP)
    return [name for folder in ("", *folders) for name in _options(loader, group, folder)]


def _options(loader: ConfigLoader, group: str, folder: str) -> list[str]:
    path = f"{group}/{folder}" if folder else group
    found = loader.get_group_options(path, results_filter=ObjectType.CONFIG)
    return [f"{folder}/{option}" if folder else option for option in found]


def _any(name: str, patterns: list[str]) -> bool:
    return any(
        _folder(name) == _folder(pattern) and fnmatchcase(name, pattern) for pattern in patterns
    )


def _folder(name: str) -> str:
    return name.rpartition("/")[0]


def _text(value: Any) -> str:
    """Return a value as an override has it; a text that would be read as a number is quoted."""
    text = Transformer.str(value)
    if isinstance(value, str) and parsed_overrides([f"k={text}"])[0].value() != value:
        return QuotedString(value, Quote.single).with_quotes()
    return text


def _plain(value: object) -> bool:
    """Return whether ``value`` is a plain value, with no interpolation."""
    if isinstance(value, str):
        return "${" not in value and value != "???"
    return value is None or isinstance(value, bool | int | float)


def _without_clash(axis: Axis, axes: Sequence[Axis]) -> Axis:
    """Turn a scalar into an edit if another override changes the same part of the tree."""
    edits = (_path(other.key) for other in axes if other is not axis and other.kind != "choice")
    pairs = (zip(_path(axis.key), edit, strict=False) for edit in edits)
    if axis.kind == "scalar" and any(all(a == b for a, b in one) for one in pairs):
        return dataclasses.replace(axis, kind="edit")
    return axis


def _path(key: str) -> list[str]:
    return key.lstrip("+~").split("@")[0].split(".")


CONFIGURATION = Path(__file__).resolve().parents[1] / "conf"


@dataclass
class Sweeps:
    """Setting ``hydra.sweeper`` of a grid, which :mod:`orchestrate.config` expands itself.

    ``params`` are sweeps that apply unless the command line sets the same key. ``grids`` defines
    several grids: each entry is merged over ``params``, and trials in several grids run once.
    """

    params: dict[str, Any] = field(default_factory=dict)
    grids: list[dict[str, Any]] = field(default_factory=list)


@functools.cache
def register() -> None:
    """Tell Hydra, once in a process, the options that are no files."""
    store = ConfigStore.instance()
    # Hydra copies the store, which nothing changes, with every source of every composition.
    setattr(store, "__deepcopy__", lambda _: store)  # noqa: B010  # mypy forbids the other way
    store.store(group="hydra/sweeper", name="grid", node=Sweeps)
    for path, section in _classes().items():
        group, _, name = path.rpartition("/")
        store.store(group=group, name=name, node=dict(section), package=group.split("/")[0])


def option_names(group: str) -> list[str]:
    """Return the options of a group, those in its folders last; empty for a name of no group."""
    if not group:
        return []
    folder = CONFIGURATION / group
    files = (path.relative_to(folder).with_suffix("") for path in folder.rglob("*.yaml"))
    names = {path.as_posix() for path in files}
    names |= {path.removeprefix(f"{group}/") for path in _classes() if path.startswith(f"{group}/")}
    return sorted(names, key=lambda name: ("/" in name, name))


@functools.cache
def _classes() -> Mapping[str, Mapping[str, object]]:
    """Return the options that are classes without a file: path, and default section."""
    options = {}
    for path, name, cls in _named():
        if not (CONFIGURATION / f"{path}.yaml").exists():
            fields = {field.name: field.default for field in dataclasses.fields(cls)}
            listed = {key: list(v) if isinstance(v, tuple) else v for key, v in fields.items()}
            options[path] = {"name": name, **listed}
    return options


def _named() -> Iterator[tuple[str, str, type]]:
    """Yield path, name and class of the systems, policies and tasks outside the paper."""
    from dopt.control import TASKS
    from dopt.policies import POLICIES
    from dopt.policies.base import OpenLoop
    from dopt.systems import NAMED_SYSTEMS

    for name, system in NAMED_SYSTEMS.items():
        if not (CONFIGURATION / f"env/{name}.yaml").exists():
            library, _, short = name.partition("_")
            path = f"mujoco/{short}" if library == "mujoco" else f"beyond/{name}"
            yield f"env/{path}", name, system
    for name, policy in POLICIES.items():
        if not (CONFIGURATION / f"policy/{name}.yaml").exists():
            folder = "baseline" if issubclass(policy, OpenLoop) else "beyond"
            yield f"policy/{folder}/{name}", name, policy
    for name, task in TASKS.items():
        yield f"task/{name}", name, task


KNOWN = (*TRIAL_SECTIONS, "width", "launch", "store", "executor")
"""Top-level keys that a launch reads, beside Hydra's own."""

_NOTHING = ("none", "ideal")
"""Options without settings of groups that may be left out."""

_NOT_SETTABLE = ("hydra", "name", TARGET)
"""Keys that messages do not suggest."""

_SEVERAL = re.compile(r"(?:Ambiguous value for argument|Sweep parameters) ('.*?')(?: requires|\n)")

_OPTION = re.compile(r"(hydra/[^/]+|[^/]+)/(.+)")
"""Group and option; groups of Hydra itself have two parts."""

_BARE = re.compile(r"[^=]+")
_NOISE = re.compile(r"\s*(\^|See https?:|full_key:|object_type=|reference_type=|To append |$)")


def format_error(error: Exception) -> str:
    """Return one line: the given value, the expected one, and the remedy."""
    if isinstance(error, DoptError):
        return _one_line(str(error))
    if isinstance(error, MissingConfigException) and error.options:
        return _unknown_option(str(error.missing_cfg_file), error.options)
    if isinstance(error, MissingConfigException):
        return (
            f"there is no configuration {error.missing_cfg_file!r}: leave --config-name out, or "
            "name the folder of its file with --config-dir FOLDER."
        )
    if isinstance(error, OverrideParseException) and _BARE.fullmatch(error.override):
        return f"'{error.override}' is not an override: write key=value, such as env=arm."
    if isinstance(error, OverrideParseException):
        told = str(error.message)
        reason = "" if "Lexer" in told or "expecting" in told else f" ({_one_line(told)})"
        return (
            f"cannot read the override '{error.override}'{reason}: put a value with special "
            "characters into quotes of its own, as in \"env.name='a=b'\"."
        )
    if match := _SEVERAL.search(str(error)):
        return f"{match[1]} gives several values to one trial: add -m for a grid, or quote it."
    if str(error).startswith("Config group override must be"):
        return (
            "the option of a group is a number, but one of its names is expected: write for "
            "instance env=pendulum or policy=d_optimal."
        )
    cause = error.__cause__ if isinstance(error, ConfigCompositionException) else error
    if isinstance(cause, ConfigAttributeError | ConfigKeyError) and cause.full_key:
        return _unknown_key(cause)
    if isinstance(cause, InterpolationResolutionError):
        return (
            f"what {cause.full_key or 'a setting'} refers to with ${{...}} cannot be found "
            f"({_one_line(str(cause))}): name a setting, or oc.env: and a variable that is set."
        )
    if isinstance(cause, OmegaConfBaseException) and cause is not error:
        return _one_line(f"{error} {cause}")
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _one_line(str(error))
    return _one_line(f"{type(error).__name__}: {error} (HYDRA_FULL_ERROR=1 shows the traceback)")


def _unknown_option(given: str, options: Iterable[str]) -> str:
    """Return the message for an option without a configuration file.

    In ``policy/beyond/exact`` the group is ``policy``: folders in it are part of the option.
    """
    match = _OPTION.fullmatch(given)
    group, option = match.groups() if match else ("", given)
    if sentence := removed_word(f"{group}={option}"):
        return sentence
    unknown = unknown_name(group or "configuration", option, {*options, *option_names(group)})
    return f"{unknown} A file of another folder is found with --config-dir FOLDER."


def _unknown_key(cause: OmegaConfBaseException) -> str:
    parent, key = cause.parent_node, str(cause.full_key)
    names = keys_of(parent, key.rpartition(".")[2])
    if isinstance(parent, DictConfig) and TARGET in names:
        return str(unknown_field(key, str(parent[TARGET]), names))
    return str(unknown_setting(key, names))


def keys_of(section: object, last: str) -> list[str]:
    """Return the keys of a section, and ``env.gamma`` where they are searched for ``gamma``."""
    if not isinstance(section, DictConfig) or section._is_none() or section._is_missing():
        return []
    inner = {str(name): section._get_node(name) for name in section}
    below = (name for name, one in inner.items() if isinstance(one, DictConfig) and last in one)
    return [*inner, *(f"{name}.{last}" for name in below)]


@functools.cache
def content_of(path: Path) -> Mapping[str, Any]:
    """Return the content of a file; empty for an option outside this folder."""
    content = OmegaConf.to_container(OmegaConf.load(path)) if path.is_file() else {}
    return {str(key): value for key, value in content.items()} if isinstance(content, dict) else {}


def unknown_setting(key: str, names: Iterable[str]) -> SpecificationError:
    """Return the error for a dotted key, with the nearest of the names in its place."""
    holder, _, last = key.rpartition(".")
    settable = [name for name in names if name not in _NOT_SETTABLE]
    options = [name for name in option_names(holder) if name not in _NOTHING]
    if not settable and len(options) < len(option_names(holder)):
        return SpecificationError(
            f"setting of {holder} '{last}' is unknown without an option that has it: add "
            f"{' or '.join(f'{holder}={name}' for name in options)}."
        )
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


def _one_line(text: str) -> str:
    """Join the lines, without pointers, links and repetitions."""
    return " ".join(line.strip() for line in text.splitlines() if not _NOISE.match(line)).strip()
