"""Short human labels of configurations: the policy, and the settings that differ.

``config_label`` compares one configuration with the defaults of the classes that it names, such as
``D-optimal, adam_replay ×30, γ=3``; the results database stores it. ``labels`` compares
configurations that are shown together with each other, such as ``γ=2`` and ``γ=3``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from dopt.control import Control
from dopt.errors import SpecificationError
from dopt.fields import Validated, default_path
from dopt.policies import policy_title
from dopt.registry import SOURCE, TARGET, section_of
from dopt.spec.config import REGISTRIES, SECTIONS, completed, section_class, section_name
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

_NAMED = ("limits.bounds.", "limits.rates.", "env.plant.")
"""Settings that have no default, or are there only where they differ from it."""

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
    flat = flatten(config)
    return _label(flat, _named(flat, usual_values(config), set(flat)), titled=True)


def labels(configs: Sequence[Mapping[str, object]]) -> list[str]:
    """Return a different label for each configuration of an environment.

    It has the policy's title, where several are shown, and the settings that are not the default,
    except settings that all configurations of the environment share. Limits and a loss of its own
    are always named. Configurations that are alike in this are told apart by what else differs.
    """
    flats = [flatten(completed(config)) for config in configs]
    usual = [usual_values(config) for config in configs]
    titled = len({flat.get("policy.name") for flat in flats}) > 1
    found = [""] * len(flats)
    for env in {flat.get("env.name") for flat in flats}:
        places = [place for place, flat in enumerate(flats) if flat.get("env.name") == env]
        differing = _differing([flats[place] for place in places])
        named = {place: _named(flats[place], usual[place], differing) for place in places}
        for place in places:
            bare = named[place] <= set(_ALWAYS)
            found[place] = _label(flats[place], named[place], titled or bare)
        for text in {found[place] for place in places}:
            alike = [place for place in places if found[place] == text]
            others = _differing([flats[place] for place in alike])
            plain = {path for path in others if path.rpartition(".")[2] not in (SOURCE, TARGET)}
            for place in alike if others else ():
                paths = named[place] | (plain or others)
                found[place] = _label(flats[place], paths, titled or not plain, digits=17)
    return found


def _differing(flats: Sequence[Flat]) -> set[str]:
    """Return the paths at which configurations differ, or where some have nothing."""
    return {path for path in _paths(flats) if len({repr(flat.get(path)) for flat in flats}) > 1}


def _named(flat: Flat, usual: Flat, differing: set[str]) -> set[str]:
    """Return the differing paths with another value than the default; versions have none."""
    wanted = (differing | set(_ALWAYS)) & set(flat) & set(usual)
    return {path for path in wanted if flat[path] != usual[path] and not path.endswith("_version")}


def _label(flat: Flat, paths: Collection[str], titled: bool, digits: int = 6) -> str:
    words = _words(flat, [path for path in _paths([flat]) if path in paths], digits)
    return ", ".join([_title(flat), *words] if titled or not words else words)


def limits_label(config: Mapping[str, object]) -> str:
    """Return the words for limits, such as ``limits, y=[-2, 2]``; empty without any."""
    flat = flatten(config)
    named = _named(flat, usual_values(config), set(flat))
    paths = [path for path in _paths([flat]) if path in named and path.startswith("limits.")]
    return ", ".join(_words(flat, paths))


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

    Defaults of a user's class are known only where that class is loaded.
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
    usual["env.plant.name"] = "real"  # its settings say more
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
