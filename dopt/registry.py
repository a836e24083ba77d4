"""From configuration sections to specification dataclasses and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TypeVar

from dopt.errors import SpecificationError, unknown_name
from dopt.fields import Checked

T = TypeVar("T", bound=Checked)


def build(section: str, registry: Mapping[str, type[T]], given: Mapping[str, object]) -> T:
    """Return the registered dataclass that ``given`` names, filled with its other entries.

    Raises
    ------
    SpecificationError
        If the name or a field is unknown, or a value does not fit.
    """
    if "name" not in given:
        raise SpecificationError(
            f"{section}.name is missing, one of {', '.join(sorted(registry))} is expected: set it."
        )
    name = given["name"]
    if not isinstance(name, str) or name not in registry:
        raise unknown_name(section, name, registry)
    cls = registry[name]
    fields = [field.name for field in dataclasses.fields(cls)]
    for key in given:
        if key != "name" and key not in fields:
            raise unknown_name(f"{section}.{name} field", key, fields)
    return cls(**{key: value for key, value in given.items() if key != "name"})


def section_of(item: Checked) -> dict[str, object]:
    """Return the configuration section that :func:`build` turns into ``item``."""
    fields = {field.name: getattr(item, field.name) for field in dataclasses.fields(item)}
    listed = {key: list(v) if isinstance(v, tuple) else v for key, v in fields.items()}
    return {"name": getattr(item, "name", None), **listed}
