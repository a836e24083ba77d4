"""Fields that a stored configuration lacks, because they were added later or have their default."""

from __future__ import annotations

from collections.abc import Mapping

from dopt.declare.registry import added_defaults
from dopt.spec.named_classes import REGISTRIES, section_class


def completed(config: Mapping[str, object]) -> dict[str, object]:
    """Return a stored configuration with the defaults of the added fields that it lacks.

    The stored text is what the key is made of, which has no added field with its default
    (:func:`dopt.declare.validated_fields.parameter`). The fields of a user's class are known only
    where that class is loaded.
    """
    whole = dict(config)
    for key in REGISTRIES:
        section, cls = config.get(key), section_class(config, key)
        if isinstance(section, Mapping) and cls is not None:
            whole[key] = {**added_defaults(cls), **section}
    return whole
