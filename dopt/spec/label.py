"""Short human labels of configurations: the policy, and the settings that differ.

``config_label`` compares one configuration with the defaults of the classes that it names, such as
``D-optimal, adam_replay ×30, γ=3``; the results database stores it. ``labels`` compares
configurations that are shown together with each other, such as ``γ=2`` and ``γ=3``.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence

from dopt.control import Control
from dopt.declare.kernel_support import default_path
from dopt.declare.registry import SOURCE, TARGET, section_of
from dopt.declare.validated_fields import Validated
from dopt.errors import SpecificationError
from dopt.policies.titles import policy_title
from dopt.spec.added_fields import completed
from dopt.spec.config import SECTIONS
from dopt.spec.named_classes import REGISTRIES, section_class, section_name
from dopt.systems import System

Flat = Mapping[str, object]
"""A configuration by dotted path, such as ``env.gamma``."""

_MODEL_OF = {"oracle": "linear", "linear": "linear_state", "gaussian_process": "gaussian_process"}
"""Usual model of a policy; of the others it is the network."""

_LEARNER_OF = {"mlp": "adam_window", "gaussian_process": "conditioning"}
"""Usual learner of a model; of the others it is least squares."""

_TITLED = ("env.name", "policy.name")
_FIRST = ("model.name", "learner.name", "learner.steps")
_COLUMNS = {
    "gamma": "env.gamma",
    "dt": "env.dt",
    "horizon": "env.horizon",
    "width": "model.width",
    "depth": "model.depth",
}
"""Columns of the results database that stand for a setting."""

_LOSS = "env.loss"

_ALWAYS = (_LOSS, "limits.name", "limits.enforced")
"""Settings that a label always names where they are unusual, so that trials are not confused."""

_NAMED = ("limits.bounds.", "limits.rates.")
"""Settings that have no default: each stands under a name of the system."""

_FORMATS = {
    "env.gamma": "γ={}",
    "env.noise": "σ={}",
    "env.horizon": "horizon {}",
    _LOSS: "{} loss",
    "model.width": "width {}",
    "model.depth": "depth {}",
    "policy.regularization": "λ={}",
    "learner.regularization": "learner λ={}",
    "learner.steps": "×{}",
    "task.name": "task {}",
    "limits.name": "limits",
    "path": "{} path",
}


def config_label(config: Mapping[str, object]) -> str:
    """Return the policy's title and every setting that is not the default of what is named.

    Settings of a user's class are compared where that class is loaded, and left out elsewhere.
    """
    flat, usual = flatten(config), usual_values(config)
    known = [path for path in _paths([flat]) if path in usual]
    unusual = [path for path in known if _is_unusual(path, flat, usual)]
    return ", ".join([_title(flat), *_words(flat, unusual)])


def labels(configs: Sequence[Mapping[str, object]]) -> list[str]:
    """Return a label for each configuration that says only what differs among those of its env.

    The policy is named where several are shown. Of the settings that differ, usual values are left
    out, unless the label would be empty or equal to that of another configuration. Of a user's
    class whose defaults are unknown, a value is left out where all that have this class share it;
    its path and digest are named only where nothing else differs. A loss of its own and limits are
    always named, the bounds only where they differ.
    """
    flats = [flatten(completed(config)) for config in configs]
    titled = len({flat.get("policy.name") for flat in flats}) > 1
    places: dict[object, list[int]] = {}
    for place, flat in enumerate(flats):
        places.setdefault(flat.get("env.name"), []).append(place)
    found: dict[int, str] = {}
    for group in places.values():
        usual = [usual_values(configs[place]) for place in group]
        found |= zip(group, _labels([flats[place] for place in group], usual, titled), strict=True)
    return [found[place] for place in range(len(configs))]


def _labels(flats: Sequence[Flat], usual: Sequence[Flat], titled: bool) -> list[str]:
    """Return the labels of the configurations of one environment."""
    paths = [path for path in _paths(flats) if len({repr(flat.get(path)) for flat in flats}) > 1]
    rows = [
        _choices(flat, _with_shared(flat, own, flats), own, paths, flats, titled)
        for flat, own in zip(flats, usual, strict=True)
    ]
    counts = [Counter(column) for column in zip(*rows, strict=True)]
    return [
        next((text for text, n in zip(row, counts, strict=True) if n[text] == 1), row[-1])
        for row in rows
    ]


def _choices(
    flat: Flat,
    usual: Flat,
    own: Flat,
    differing: Sequence[str],
    flats: Sequence[Flat],
    titled: bool,
) -> list[str]:
    """Return the labels that a configuration may have, of which the first that is unique is taken.

    ``usual`` holds the values that are not named where they differ, and ``own`` the defaults.
    """
    paths = [path for path in differing if not _is_origin(path)]
    common = [path for path in paths if all(path in flat for flat in flats)]
    title = [_title(flat)] if titled or not paths else []
    words = _words(flat, [path for path in paths if _is_unusual(path, flat, usual)])
    brief = title + words or _words(flat, _telling(common)) or [_title(flat)]
    whole = title + _words(flat, [path for path in paths if path in flat], digits=17)
    rest = [path for path in _paths([flat]) if path in _ALWAYS and path not in paths]
    always = _words(flat, [path for path in rest if _is_unusual(path, flat, own)])
    origins = [path for path in differing if _is_origin(path) and _is_unusual(path, flat, usual)]
    origin = _words(flat, origins)
    ends = (brief, always), (whole, always), (brief, always, origin), (whole, always, origin)
    return [", ".join(itertools.chain(*parts)) for parts in ends]


def _is_origin(path: str) -> bool:
    """Return whether a path names the class or the file of a section."""
    return path.rpartition(".")[2] in (SOURCE, TARGET)


def _with_shared(flat: Flat, usual: Flat, flats: Sequence[Flat]) -> Flat:
    """Return the usual values; of a setting without one, the value that all of its class share."""
    found = dict(usual)
    for path in set(flat) - set(usual):
        section = path.partition(".")[0]
        name = flat.get(f"{section}.name")
        peers = [one for one in flats if name and one.get(f"{section}.name") == name]
        if peers and all(one.get(path) == flat[path] for one in peers):
            found[path] = flat[path]
    return found


def _telling(paths: Sequence[str]) -> list[str]:
    """Return the paths without the settings of sections whose names are among them."""
    named = {path.partition(".")[0] for path in paths if path.endswith(".name")}
    return [path for path in paths if path.endswith(".name") or path.partition(".")[0] not in named]


def _is_unusual(path: str, flat: Flat, usual: Flat) -> bool:
    """Return whether a configuration has a setting other than the default, versions apart."""
    hidden = path.endswith("_version")
    return not hidden and path in flat and (path not in usual or flat[path] != usual[path])


def limits_label(config: Mapping[str, object]) -> str:
    """Return the words for limits, such as ``limits, y=[-2, 2]``; empty without any."""
    flat, usual = flatten(config), usual_values(config)
    paths = [path for path in _paths([flat]) if path.startswith("limits.")]
    return ", ".join(_words(flat, [path for path in paths if _is_unusual(path, flat, usual)]))


def value_label(path: str, value: object) -> str:
    """Return the words for one value of a setting, such as ``γ=3`` or ``width 64``.

    ``path`` is a dotted path or a column; a section, such as ``learner``, stands for its name.
    """
    if value is None:
        return f"no {path.rpartition('.')[2]}"
    if path in ("policy", "policy.name"):
        return policy_title(str(value))
    if path in REGISTRIES or path.endswith(".name"):
        return str(value)
    return _word(_COLUMNS.get(path, path), value)


def usual_values(config: Mapping[str, object]) -> dict[str, object]:
    """Return the defaults of what a configuration names, by dotted path.

    Those of a user's class are known only where that class is loaded.
    """
    classes = {key: section_class(config, key) for key in REGISTRIES}
    usual: dict[str, object] = {}
    for key, cls in classes.items():
        if cls is not None:
            own = _defaults(cls, classes["env"])
            usual |= {f"{key}.{name}": value for name, value in own.items()}
    model = _MODEL_OF.get(section_name(config, "policy"), "mlp")
    learner = _LEARNER_OF.get(section_name(config, "model"), "recursive_least_squares")
    usual |= {"model.name": model, "learner.name": learner}
    usual |= {"task.name": None, "limits.name": None, _LOSS: None}
    usual |= {path: None for path in flatten(config) if path.startswith(_NAMED)}
    parts = [classes[key] for key in SECTIONS]
    if None not in parts:
        usual["path"] = default_path(parts)
    return usual


def flatten(config: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Return a nested mapping by dotted path."""
    flat: dict[str, object] = {}
    for key, value in config.items():
        path = f"{prefix}{key}"
        flat.update(flatten(value, f"{path}.") if isinstance(value, Mapping) else {path: value})
    return flat


def _defaults(cls: type[Validated], env: type[Validated] | None) -> Mapping[str, object]:
    """Return the section of a class with nothing set; of a task, as the system resolves it."""
    if (cls, env) not in _known:
        _known[cls, env] = _default_section(cls, env)
    return _known[cls, env]


_known: dict[tuple[type, type | None], Mapping[str, object]] = {}


def _default_section(cls: type[Validated], env: type[Validated] | None) -> Mapping[str, object]:
    try:
        item = cls()
        system = env() if env else None
        if isinstance(item, Control) and isinstance(system, System):
            item = item.resolved(system)
    except (TypeError, SpecificationError):  # a class that has settings without a default
        return {}
    own = section_of(item)
    return {key: value for key, value in own.items() if key not in ("name", SOURCE, TARGET)}


def _title(flat: Flat) -> str:
    return policy_title(str(flat.get("policy.name", flat.get("policy", ""))))


def _paths(flats: Sequence[Flat]) -> list[str]:
    """Return all paths that a label can name, the model and the learner first.

    The name of limits goes before what they are.
    """
    paths = set().union(*flats) - set(_TITLED)
    rest = sorted(paths - set(_FIRST), key=lambda path: path.replace("limits.name", "limits."))
    return [*(path for path in _FIRST if path in paths), *rest]


def _words(flat: Flat, paths: Sequence[str], digits: int = 6) -> list[str]:
    """Return the words of some settings; steps of a learner stand behind its name."""
    words = {path: _word(path, flat[path], digits) for path in paths}
    if "learner.steps" in words:
        words["learner.steps"] = f"{flat['learner.name']} {words['learner.steps']}"
        words.pop("learner.name", None)
    return list(words.values())


def _word(path: str, value: object, digits: int = 6) -> str:
    name = path.rpartition(".")[2]
    return _FORMATS.get(path, "{}" if name == "name" else f"{name}={{}}").format(
        _text(value, digits)
    )


def _text(value: object, digits: int) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_text(one, digits) for one in value)}]"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)
