"""Classes that the sections of a configuration name."""

from __future__ import annotations

import sys
from collections.abc import Mapping

from dopt.control import TASKS
from dopt.declare.registry import TARGET
from dopt.declare.validated_fields import Validated
from dopt.learning import LEARNERS
from dopt.limits import LIMITS
from dopt.models import MODELS
from dopt.policies import POLICIES
from dopt.systems import NAMED_SYSTEMS

REGISTRIES: Mapping[str, Mapping[str, type[Validated]]] = {
    "env": NAMED_SYSTEMS,
    "policy": POLICIES,
    "model": MODELS,
    "learner": LEARNERS,
    "task": TASKS,
    "limits": LIMITS,
}
"""Registered classes of every section."""


def section_name(config: Mapping[str, object], key: str) -> str:
    """Return the name in a section, or the text that stands in its place; empty without one."""
    section = config.get(key)
    return str(section.get("name")) if isinstance(section, Mapping) else str(section or "")


def section_class(config: Mapping[str, object], key: str) -> type[Validated] | None:
    """Return the class of a section: a registered one, or a user's that is loaded already."""
    section = config.get(key)
    if not isinstance(section, Mapping) or TARGET not in section:
        return REGISTRIES[key].get(section_name(config, key))
    module, _, name = str(section[TARGET]).rpartition(".")
    found = getattr(sys.modules.get(module), name, None)
    return found if isinstance(found, type) and issubclass(found, Validated) else None
