"""Globs over the options of a group and of its folders: ``policy=glob([*,beyond/*])``."""

from __future__ import annotations

from fnmatch import fnmatchcase

from hydra.core.config_loader import ConfigLoader
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.types import Glob


def matches(loader: ConfigLoader, group: str, glob: Glob) -> tuple[str, ...]:
    """Return the options that a glob matches, folder by folder in the order of its patterns.

    As in Hydra, a pattern without a folder matches options of the group itself, not those in its
    folders; ``beyond/*`` matches those in the folder ``beyond``.
    """
    folders = dict.fromkeys(_folder(pattern) for pattern in glob.include)
    names = [name for folder in folders for name in _options(loader, group, folder)]
    return tuple(
        name for name in names if _any(name, glob.include) and not _any(name, glob.exclude)
    )


def every_option(loader: ConfigLoader, group: str) -> list[str]:
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
