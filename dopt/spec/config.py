"""Configuration of a trial: everything except its seed; its classes, and labels for people.

``config_label`` compares one configuration with the defaults of the classes that it names, such as
``D-optimal, adam_replay ×30, γ=3``; the results database stores it. ``labels`` compares
configurations that are shown together with each other, such as ``γ=2`` and ``γ=3``.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from dopt.control import TASKS, Control
from dopt.control.task import GOALS, Goal
from dopt.errors import IncompatibleError, SpecificationError, unknown_name
from dopt.evaluation import LONGEST_RUN
from dopt.fields import Validated, default_path
from dopt.learning import LEARNERS, Conditioning, InformationLearner, JointKalman, Learner
from dopt.learning.base import CompiledLearner, CustomLearner
from dopt.limits import LIMITS, Limits
from dopt.models import MODELS, GaussianProcess, Model
from dopt.policies import (
    POLICIES,
    DOptimal,
    GradientDOptimal,
    Policy,
    RandomGaussian,
    Search,
    policy_title,
)
from dopt.policies.base import CompiledPolicy, CustomPolicy, OpenLoop, TaskPolicy
from dopt.policies.d_optimal import EQUAL_COST
from dopt.registry import SOURCE, TARGET, added_defaults, identifying_section, section_of
from dopt.spec.compatibility import (
    Information,
    check_reference,
    check_sampled,
    check_together,
    held_information,
    memory_by_setting,
    mismatch,
)
from dopt.spec.custom_system import check_system, warn_of_prior, warn_of_scale
from dopt.systems import NAMED_SYSTEMS, SYSTEMS, System
from dopt.systems.black_box import BlackBox

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


def completed(config: Mapping[str, object]) -> dict[str, object]:
    """Return a stored configuration with the defaults of the added fields that it lacks.

    The stored text is what the key is made of, which has no added field with its default
    (:func:`dopt.fields.parameter`). The fields of a user's class are known only
    where that class is loaded.
    """
    whole = dict(config)
    for key in REGISTRIES:
        section, cls = config.get(key), section_class(config, key)
        if isinstance(section, Mapping) and cls is not None:
            whole[key] = {**added_defaults(cls), **section}
    return whole


CODE_VERSION = 2
"""Version of the numbers of trials, part of every key: increased by a change that alters them."""

ASSESSMENT_VERSION = 2
"""Version of the numbers of assessments, part of the keys of trials that have a task."""

CRITERION_VERSION = 2
"""Version of the plans of searches with a noise variance ρ ≠ 1, part of the keys of such trials."""

REACHABLE_VERSION = 2
"""Version of the reachable set of trials that are longer than the runs from which it is drawn."""

PLAN_VERSION = 2
"""Version of linearized D-optimal plans for a model that is not affine in the inputs."""

FORM_VERSION = 2
"""Version of the form of M that ``auto`` takes where the cheapest one is too large."""

_VERSIONS = (
    "code_version",
    "assessment_version",
    "criterion_version",
    "reachable_version",
    "plan_version",
    "form_version",
)

LARGEST_HORIZON = 10_000_000
"""A trial is committed whole, one row for each step."""

LARGEST_MEMORY = 2**40
"""Bytes that a trial may need on any machine; a launch also asks its own."""

PATHS = ("kernel", "reference")

SECTIONS = ("env", "policy", "model", "learner")
"""Keys of the parts that every configuration has."""


@dataclasses.dataclass(frozen=True)
class TrialConfig:
    """A trial without its seed: one configuration of a grid.

    ``path`` is the execution path, "kernel" or "reference". Both mean the same, but their numbers
    agree to rounding only, which grows over a trial: so it is part of the trial's identity.
    Networks in torch run on the reference alone, most other choices in the kernel alone
    (:func:`dopt.spec.compatibility.check_reference`). ``task`` assesses the trial on
    the way, and ``limits`` bound its states and inputs; each is part of its identity only where
    it is given. So is ``sample_loss``: whether :func:`dopt.offline_fit.sample_loss` follows.
    """

    system: System
    policy: Policy
    model: Model
    learner: Learner
    path: str = "kernel"
    task: Control | None = None
    limits: Limits | None = None
    sample_loss: bool = False

    def __post_init__(self) -> None:
        if self.path not in PATHS:
            raise unknown_name("path", self.path, PATHS)
        if self.task is not None:
            if isinstance(self.system, BlackBox):
                raise mismatch("a task", "a system with equations", f"env '{self.system.name}'")
            if self.system.wrapped is not None:
                raise mismatch("a task", "plant 'ideal'", "plant 'real'")
            object.__setattr__(self, "task", self.task.resolved(self.system))
        self._check_runnable()
        if self.limits is not None:
            self.limits.check(self.system)
            estimated = self.system.n_measured and self.limits.enforced
            if estimated and not isinstance(self.learner, JointKalman):
                expected = "learner 'joint_ekf', which knows how uncertain its estimates are"
                given = f"learner '{self.learner.name}'"
                raise mismatch("limits of measured states", expected, given)
        if type(self.system) not in SYSTEMS.values():
            check_system(self.system)
            warn_of_scale(self.system, self.model)
        self.policy.check(self.system)
        if isinstance(self.policy, TaskPolicy) and self.system.wrapped is not None:
            raise mismatch(f"policy '{self.policy.name}'", "plant 'ideal'", "plant 'real'")
        if isinstance(self.policy, TaskPolicy) and not self.task and self.system.name not in GOALS:
            expected = "a section task with a goal, or a system with a control task of its own"
            given = f"env '{self.system.name}' without a task"
            raise mismatch(f"policy '{self.policy.name}'", expected, given)
        self._check_size()
        if isinstance(self.policy, Search) and self.policy.budget_us and self.path != "kernel":
            raise IncompatibleError(
                f"policy.budget_us is {self.policy.budget_us:g} µs, but only the compiled kernel "
                f"heeds it, which runs the shipped systems, networks and learners one trial at a "
                f"time: set it to 0."
            )
        check_together(self.system, self.policy, self.model, self.learner)
        warn_of_prior(self.policy, self.model, self.learner)
        if self.sample_loss:
            _ = self.process

    def _check_runnable(self) -> None:
        """Refuse users' parts that no path can run, and on the kernel what it lacks."""
        for part, registry, bases in (
            (self.policy, POLICIES, (OpenLoop, CustomPolicy, CompiledPolicy)),
            (self.learner, LEARNERS, (CustomLearner, CompiledLearner)),
        ):
            if type(part) not in [*registry.values()] and not isinstance(part, bases):
                derived = " or ".join(base.__name__ for base in bases)
                raise SpecificationError(
                    f"{part.section} is a {type(part).__name__} of your own, which brings nothing "
                    f"to run: derive it from {derived}, or take one of "
                    f"{', '.join(sorted(registry))}."
                )
        foreign = [part for part in self._parts if not part.compiled]
        if self.path == "kernel" and foreign:
            raise SpecificationError(
                f"path is 'kernel', but {foreign[0].section} '{foreign[0].name}' is not written "
                f"for it: set path to 'reference', or leave it out."
            )
        for part in (self.policy, self.learner):
            if isinstance(part, (CustomPolicy, CustomLearner)) and not part.compiled:
                raise SpecificationError(
                    f"{part.section} '{part.name}' declares compiled = False, as one that is "
                    f"written in torch did, but numpy is expected: leave that line out and write "
                    f"it in numpy, or derive it from Compiled{part.section.capitalize()}."
                )
        if self.path == "reference":
            check_reference(self._parts, enforced=bool(self.limits and self.limits.enforced))

    @functools.cached_property
    def goal(self) -> Goal:
        """Goal of a policy that learns a task: from the section, or else the system's own."""
        return (self.task or Control()).on(self.system)

    @functools.cached_property
    def process(self) -> TrialConfig:
        """Configuration with the Gaussian process that is fitted to the samples of a trial.

        Raises IncompatibleError or SpecificationError if a trial does not give samples for one.
        """
        check_sampled(self.system, self.model)
        model = GaussianProcess(hyperparameters="evidence")
        return TrialConfig(self.system, RandomGaussian(), model, Conditioning())

    @functools.cached_property
    def information(self) -> Information | None:
        """The one information matrix M of a trial; None where nothing needs it."""
        return held_information(*self._parts)

    @property
    def _parts(self) -> tuple[System, Policy, Model, Learner]:
        return self.system, self.policy, self.model, self.learner

    def _check_size(self) -> None:
        """Refuse what no machine can run, such as a mistyped number of zeros."""
        if self.system.horizon > LARGEST_HORIZON:
            raise SpecificationError(
                f"env.horizon is {self.system.horizon:,} steps, but it has to be at most "
                f"{LARGEST_HORIZON:,}: set env.horizon to a smaller number."
            )
        if self.memory > LARGEST_MEMORY:
            raise SpecificationError(
                f"a trial would need {self.memory / 2**30:,.0f} GiB of memory, most of it because "
                f"of {self.largest_setting}, but at most {LARGEST_MEMORY / 2**30:,.0f} GiB are "
                f"allowed: make {self.largest_setting} smaller."
            )

    @property
    def memory(self) -> int:
        """Estimated bytes of the matrices and arrays of one trial, beside the interpreter."""
        return sum(self._memory_by_setting.values())

    @property
    def largest_setting(self) -> str:
        """The setting that decides about most of the memory."""
        return max(self._memory_by_setting, key=lambda key: self._memory_by_setting[key])

    @functools.cached_property
    def _memory_by_setting(self) -> dict[str, int]:
        return memory_by_setting(*self._parts, self.path)

    @functools.cached_property
    def canonical_json(self) -> str:
        """Sorted, compact JSON of what identifies the configuration: what the key is made of.

        It is :meth:`content` without added fields that have their default
        (:func:`dopt.spec.config.completed` puts them back).
        """
        content = self._content(identifying_section)
        return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)

    def content(self) -> dict[str, object]:
        """Return every section with all its fields, and the code version, without the seed."""
        return self._content(section_of)

    def _content(self, written: Callable[[Validated], dict[str, object]]) -> dict[str, object]:
        content: dict[str, object] = {"code_version": CODE_VERSION, "path": self.path}
        content |= {key: written(part) for key, part in zip(SECTIONS, self._parts, strict=True)}
        if self.task is not None:
            content["task"] = written(self.task)
            content["assessment_version"] = ASSESSMENT_VERSION
        if self.limits is not None:
            content["limits"] = written(self.limits)
        if self.sample_loss:
            content["assess"] = {"sample_loss": True}
        learner, compared = self.learner, isinstance(self.policy, (Search, GradientDOptimal))
        if compared and isinstance(learner, InformationLearner) and learner.noise_variance != 1.0:
            content["criterion_version"] = CRITERION_VERSION
        if self.system.horizon > LONGEST_RUN:
            content["reachable_version"] = REACHABLE_VERSION
        if isinstance(self.policy, DOptimal) and not self.model.affine_in_inputs:
            content["plan_version"] = PLAN_VERSION
        if self._leaves_primal():
            content["form_version"] = FORM_VERSION
        return content

    def _leaves_primal(self) -> bool:
        """Return True if M is sketched because the primal form, the cheapest, is too large."""
        if not isinstance(self.policy, DOptimal) or self.policy.form != "auto":
            return False
        q = self.model.n_member_parameters(self.system)
        sketched = bool(self.information and self.information.form == "sketch")
        return sketched and q <= EQUAL_COST * self.system.n_learned * self.system.horizon

    @functools.cached_property
    def key(self) -> str:
        """SHA-256 of :attr:`canonical_json`: the key of the configuration, without a seed."""
        return hashlib.sha256(self.canonical_json.encode()).hexdigest()


def without_versions(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a trial or a configuration without the versions of the code."""
    return {key: value for key, value in content.items() if key not in _VERSIONS}


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
    return _label(flatten(config), unusual(config), titled=True)


def unusual(config: Mapping[str, object]) -> set[str]:
    """Return the dotted paths of settings that have another value than the default."""
    flat = flatten(config)
    return _named(flat, usual_values(config), set(flat))


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
    title = policy_title(str(flat.get("policy.name", flat.get("policy", ""))))
    return ", ".join([title, *words] if titled or not words else words)


def limits_label(config: Mapping[str, object]) -> str:
    """Return the words for limits, such as ``limits, y=[-2, 2]``; empty without any."""
    flat, named = flatten(config), unusual(config)
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


def difference(configs: Sequence[Mapping[str, object]]) -> tuple[str, list[object]]:
    """Return the first dotted path in which configurations differ, and its values.

    One that all of them have goes before one that some lack, a name before what comes with it.
    """
    flat = [flatten(config) for config in configs]
    known = set().union(*flat)
    paths = [path for path in known if any(one.get(path) != flat[0].get(path) for one in flat)]
    if not paths:
        return "config_key", [None for _ in configs]

    def order(path: str) -> tuple[bool, bool, str]:
        return not all(path in one for one in flat), not path.endswith((".name", TARGET)), path

    path = min(paths, key=order)
    return path, [entry.get(path) for entry in flat]


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
    form = _FORMATS.get(path, "{}" if name == "name" else f"{name}={{}}")
    return form.format(_text(value, digits))


def _text(value: object, digits: int) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_text(one, digits) for one in value)}]"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)
