"""Configurations whose classes come from other states of a user's file: which of them are shown.

A section of a user's class holds the digest of its file, so that the trials of an edited file are
other trials. They are treated as those of versions of this package: of configurations that differ
in such digests alone, the one whose trials were registered last is shown.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence

from analysis.data.config_matching import read_condition
from dopt.declare.registry import SOURCE, TARGET
from orchestrate.store import ConfigRow, Reader

_LAST = (
    "SELECT max(r.trial_id) AS last FROM trial r JOIN config c ON c.config_id = r.config_id "
    "WHERE c.config_key = :config_key"
)


def latest_sources(
    reader: Reader, configs: Sequence[ConfigRow], apart: Collection[str] = ()
) -> list[ConfigRow]:
    """Return the configurations without those that another one of a later file replaces.

    Digests at the dotted paths ``apart``, such as ``env.source``, are told apart as settings are.
    """
    groups: dict[str, list[ConfigRow]] = {}
    for config in configs:
        groups.setdefault(_without_sources(config, apart), []).append(config)
    replaced: set[str] = set()
    for group in groups.values():
        if len(group) > 1:
            latest = max(group, key=lambda config: _last_trial(reader, config))
            replaced |= {config.config_key for config in group if config is not latest}
    return [config for config in configs if config.config_key not in replaced]


def source_notes(configs: Iterable[ConfigRow], chosen: Sequence[ConfigRow]) -> Iterable[str]:
    """Yield sentences on configurations of other files than those that are shown."""
    shown: dict[tuple[str, str, object], set[str]] = {}
    for config in chosen:
        for path, (target, digest) in _sources(config).items():
            shown.setdefault((config.env, path, target), set()).add(digest)
    others: dict[tuple[str, str, object], set[str]] = {}
    for config in configs:
        for path, (target, digest) in _sources(config).items():
            place = config.env, path, target
            if digest not in shown.get(place, {digest}):
                others.setdefault(place, set()).add(digest)
    for (env, path, target), digests in sorted(others.items(), key=lambda item: str(item[0])):
        here = ", ".join(sorted(shown[env, path, target]))
        ways = " or ".join(f"--where {path}={_argument(digest)}" for digest in sorted(digests))
        yield (
            f"{env}: {path} differs, as the file of {target} was edited: these trials have {here}, "
            f"those of other states of the file are not part of this (see {ways})"
        )


def _sources(config: ConfigRow) -> dict[str, tuple[object, str]]:
    """Return class and digest of each section of a user's class, by the path of the digest."""
    return {
        f"{key}.{SOURCE}": (section[TARGET], str(section[SOURCE]))
        for key, section in config.config.items()
        if isinstance(section, Mapping) and TARGET in section and SOURCE in section
    }


def _without_sources(config: ConfigRow, apart: Collection[str]) -> str:
    """Return the text of a configuration without the digests that are not told apart."""
    content = dict(config.config)
    for path in _sources(config):
        key = path.partition(".")[0]
        if path not in apart:
            content[key] = {k: v for k, v in content[key].items() if k != SOURCE}
    return json.dumps(content, sort_keys=True)


def _last_trial(reader: Reader, config: ConfigRow) -> int:
    """Return the identifier of the trial that was registered last, -1 where there is none."""
    (row,) = reader.rows(_LAST, config_key=config.config_key)
    return -1 if row.last is None else int(row.last)


def _argument(digest: str) -> str:
    """Return a digest as a condition takes it; one that reads as a number is quoted."""
    is_text = read_condition(f"{SOURCE}={digest}") == (SOURCE, digest)
    return digest if is_text else f"'{json.dumps(digest)}'"
