"""Configurations of the newest code and of the last state of users' files, without the others."""

from __future__ import annotations

import json

from analysis.data.source_files import latest_sources
from orchestrate.store import ConfigRow, Reader


def latest(reader: Reader, configs: list[ConfigRow]) -> list[ConfigRow]:
    """Return the configurations of the newest code, and of the last state of users' files."""
    return latest_sources(reader, newest(configs))


def newest(configs: list[ConfigRow]) -> list[ConfigRow]:
    """Return the configurations of the newest code version: other versions' numbers do not mix.

    Of those with a task, whose assessments have a version of their own, the newest of these; and of
    those that differ in the version of the criterion of their plans alone, the newest.
    """
    code = max((config.config.get("code_version", 0) for config in configs), default=0)
    assessment = max((_assessment_version(config) or 0 for config in configs), default=0)
    found = [
        config
        for config in configs
        if config.config.get("code_version", 0) == code
        and _assessment_version(config) in (None, assessment)
    ]
    criteria: dict[str, int] = {}
    for config in found:
        content, version = _criterion(config)
        criteria[content] = max(version, criteria.get(content, version))
    return [config for config in found if _criterion(config)[1] == criteria[_criterion(config)[0]]]


def _criterion(config: ConfigRow) -> tuple[str, int]:
    """Return the configuration but for the version of the criterion of plans, and this version."""
    content = dict(config.config)
    version = int(content.pop("criterion_version", 1))
    return json.dumps(content, sort_keys=True), version


def _assessment_version(config: ConfigRow) -> int | None:
    return int(config.config.get("assessment_version", 1)) if config.config.get("task") else None
