"""Specifications of simulated trials and of explorations.

The loss of an exploration at step t is prequential: the error of the acceleration that the model
predicts for it, before it learns from that step. Its configuration says so in the section ``env``,
so that it is never the configuration of a simulated trial.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Mapping
from typing import Any, ClassVar

from dopt.arguments import instance, whole
from dopt.control import TASKS, Control
from dopt.errors import SpecificationError, unknown_name
from dopt.fields import Validated, default_path, parameter
from dopt.learning import LEARNERS, Learner
from dopt.limits import LIMITS, Limits
from dopt.models import MODELS, Model
from dopt.models.base import MLP
from dopt.policies import POLICIES, Policy
from dopt.registry import TARGET, Part, build, build_optional, check_stored
from dopt.spec.config import SECTIONS, TrialConfig, config_label, without_versions
from dopt.systems import System, system_from_mapping

LARGEST_SEED = 2**63 - 1
"""Fits into a column of every database."""

_KEYS = (*SECTIONS, "plant", "task", "limits", "assess", "path", "seed")


@dataclasses.dataclass(frozen=True)
class TrialSpec(Validated):
    """One trial: a configuration and a seed.

    ``trial_key`` is the SHA-256 of the canonical JSON; equal keys are the same trial. Where it runs
    and how it is stored is not part of it.
    """

    section: ClassVar[str] = "trial"

    config: TrialConfig
    seed: int = parameter(0, bound="nonnegative")

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", whole("seed", self.seed, 0, LARGEST_SEED))

    @classmethod
    def from_mapping(cls, given: Mapping[str, object]) -> TrialSpec:
        """Return the trial that a configuration describes.

        Parameters
        ----------
        given : mapping
            Sections ``env``, ``policy``, ``model`` and ``learner``, each with a ``name`` and the
            fields that differ from their defaults, the ``seed`` and the execution ``path``; without
            one, it is the kernel where that knows all parts, and the reference elsewhere. A
            section ``task`` with a name other than "none" says how the trial is assessed, a
            section ``limits`` what its states and inputs heed (:class:`dopt.limits.Limits`), and a
            section ``plant`` what hardware the system is behind (:func:`dopt.systems.Real`). With
            ``{"sample_loss": True}`` in a section ``assess`` it ends with the loss of a model that
            is fitted to its samples (:func:`dopt.offline_fit.sample_loss`).

        Raises
        ------
        SpecificationError
            If a name is unknown, a type is wrong or a value is outside its bound.
        IncompatibleError
            If the choices are valid one by one but make no sense together.
        """
        for key in given:
            if key not in _KEYS:
                raise unknown_name("configuration key", key, _KEYS)
        sections = {key: _section(given, key) for key in SECTIONS}
        env = sections["env"]
        if given.get("plant") is not None:
            env = {**env, "plant": _section(given, "plant")}
        return cls._of_parts(system_from_mapping(env), sections, given)

    @classmethod
    def _of_parts(
        cls, system: System, sections: Mapping[str, Part], given: Mapping[str, object]
    ) -> TrialSpec:
        policy = build("policy", POLICIES, sections["policy"])
        model = _model(sections["model"])
        learner = build("learner", LEARNERS, sections["learner"])
        path = given.get("path")
        path = default_path((system, policy, model, learner)) if path is None else str(path)
        task = build_optional("task", TASKS, given.get("task"))
        limits = build_optional("limits", LIMITS, given.get("limits"))
        sampled = _assesses_samples(given.get("assess"))
        config = TrialConfig(system, policy, model, learner, path, task, limits, sampled)
        return cls(config, given.get("seed", 0))  # type: ignore[arg-type]  # checked on creation

    @classmethod
    def from_names(
        cls,
        env: str | Mapping[str, object],
        policy: str | Mapping[str, object],
        *,
        model: str | Mapping[str, object] = "mlp",
        learner: str | Mapping[str, object] = "adam_window",
        limits: Mapping[str, object] | None = None,
        seed: int = 0,
    ) -> TrialSpec:
        """Return the trial of parts given by name, such as ``env="pendulum"``.

        Parameters
        ----------
        env, policy, model, learner : str or mapping
            Name of a registered class, with the defaults of its fields; or a section with the
            ``name`` and the fields that differ: ``env={"name": "pendulum", "gamma": 3.0}``.
        limits : mapping, optional
            Bounds and rates (:class:`dopt.limits.Limits`), such as
            ``{"bounds": {"y": [-2, 2]}}``.
        seed : int
            Seed of the noise, the initial parameters and the policy's own draws.

        Raises
        ------
        SpecificationError, IncompatibleError
            As :meth:`from_mapping`.
        """
        parts = {"env": env, "policy": policy, "model": model, "learner": learner}
        return cls.from_mapping({**_sections(parts), "limits": limits, "seed": seed})

    @classmethod
    def of_system(
        cls,
        system: System,
        policy: str | Mapping[str, object] | Policy,
        *,
        model: str | Mapping[str, object] | Model = "mlp",
        learner: str | Mapping[str, object] | Learner = "adam_window",
        limits: Mapping[str, object] | None = None,
        seed: int = 0,
        path: str | None = None,
    ) -> TrialSpec:
        """Return the trial of a system, with the other parts as in :meth:`from_names`, or objects.

        An object may be of a class that a notebook or a script defines: :func:`dopt.run_trial` runs
        it, and its cell or file is part of the key. A launch takes classes of other files alone.

        ``path`` is the execution path; without one it is chosen as in :meth:`from_mapping`.

        Raises
        ------
        SpecificationError, IncompatibleError
            If the system is no object of a class of systems, a class has no source, or as
            :meth:`from_mapping`.
        """
        given = _sections({"policy": policy, "model": model, "learner": learner})
        parts = {
            key: part if isinstance(part, Validated) else _section(given, key)
            for key, part in given.items()
        }
        rest: dict[str, object] = {"seed": seed, "limits": limits}
        rest |= {"path": path} if path else {}
        expected = "an object such as SYSTEMS['pendulum'](), and for a name TrialSpec.from_names,"
        instance("the system of TrialSpec.of_system", system, System, expected)
        return cls._of_parts(system, parts, rest)

    def with_seed(self, seed: int) -> TrialSpec:
        """Return the same configuration with another seed."""
        return TrialSpec(self.config, seed)

    @property
    def system(self) -> System:
        return self.config.system

    @property
    def policy(self) -> Policy:
        return self.config.policy

    @property
    def model(self) -> Model:
        return self.config.model

    @property
    def learner(self) -> Learner:
        return self.config.learner

    @property
    def task(self) -> Control | None:
        return self.config.task

    @property
    def limits(self) -> Limits | None:
        return self.config.limits

    @property
    def assessed_steps(self) -> tuple[int, ...]:
        """Numbers of explored steps after which the trial is assessed, none without a task."""
        return self.task.assessed_steps(self.system.horizon) if self.task else ()

    @property
    def config_json(self) -> str:
        """Canonical JSON without the seed (:attr:`dopt.spec.config.TrialConfig.canonical_json`)."""
        return self.config.canonical_json

    @property
    def config_key(self) -> str:
        """SHA-256 of :attr:`config_json`: the trial without its seed."""
        return self.config.key

    @functools.cached_property
    def trial_key(self) -> str:
        """SHA-256 of :meth:`canonical_json`."""
        return hashlib.sha256(self.canonical_json().encode()).hexdigest()

    def canonical_json(self) -> str:
        """Return the compact JSON of the content: sorted, except the seed, which comes last."""
        return f'{self.config_json[:-1]},"seed":{self.seed}}}'

    def to_mapping(self) -> dict[str, object]:
        """Return the mapping that :meth:`from_mapping` turns into this trial."""
        return {**without_versions(self.config.content()), "seed": self.seed}

    def columns(self) -> dict[str, str | int | float | None]:
        """Return what a table of configurations shows in columns of its own."""
        mlp = self.model if isinstance(self.model, MLP) else None
        return {
            "env": self.system.name,
            "policy": self.policy.name,
            "model": self.model.name,
            "learner": self.learner.name,
            "width": mlp.width if mlp else None,
            "depth": mlp.depth if mlp else None,
            "horizon": self.system.horizon,
            "dt": self.system.dt,
            "gamma": self.system.gamma,
            "label": config_label(json.loads(self.config_json)),
        }


def _sections(parts: Mapping[str, str | Part]) -> dict[str, Part]:
    return {key: {"name": part} if isinstance(part, str) else part for key, part in parts.items()}


def _model(section: Part) -> Model:
    """Return a registered model, or a network of the user's own, for which torch is loaded."""
    if isinstance(section, Validated) or TARGET not in section:
        return build("model", MODELS, section)
    from dopt.reference.models import Module

    return Module.from_section(section)


def _assesses_samples(section: object) -> bool:
    """Return whether a section ``assess`` asks for the sample loss."""
    if section in (None, {}, {"sample_loss": False}):
        return False
    if section == {"sample_loss": True}:
        return True
    raise SpecificationError(
        f"configuration key 'assess' is {str(section).replace(': None', ': null')}, but a section "
        "with sample_loss, true or false, is expected: write for instance assess.sample_loss=true."
    )


def _section(given: Mapping[str, object], key: str) -> Mapping[str, object]:
    section = given.get(key)
    kind = section if isinstance(section, type) else type(section)
    if issubclass(kind, Validated):
        what = "the class" if kind is section else "a"
        raise SpecificationError(
            f"configuration key '{key}' is {what} {kind.__name__}, but a name or a section is "
            f"expected: give objects, such as {kind.__name__}(), to TrialSpec.of_system."
        )
    if not isinstance(section, Mapping):
        raise SpecificationError(
            f"configuration key '{key}' is {section!r}, but a section with a name and fields is "
            f"expected: choose one, for instance {key}={_EXAMPLES[key]}."
        )
    return section


_EXAMPLES = {
    "env": "pendulum",
    "policy": "d_optimal",
    "model": "mlp",
    "learner": "adam_window",
    "plant": "real",
}


MARK = {"loss": "prequential"}
"""Entry of the section ``env`` that marks an exploration, beside the fields of its system."""

FIT_MARK = {"loss": "simulation"}
"""The same of a fit to recorded runs."""


def is_prequential(config: Mapping[str, Any]) -> bool:
    """Return whether a stored configuration belongs to an exploration."""
    return _has_mark(config, MARK)


def is_fit(config: Mapping[str, Any]) -> bool:
    """Return whether a stored configuration belongs to a fit to recorded runs."""
    return _has_mark(config, FIT_MARK)


def _has_mark(config: Mapping[str, Any], mark: Mapping[str, str]) -> bool:
    section = config.get("env")
    return isinstance(section, Mapping) and mark.items() <= section.items()


def stored_trial(config: Mapping[str, Any], seed: int = 0) -> TrialSpec:
    """Return the trial of a stored configuration; raise SpecificationError if none can be made.

    It runs this machine's files of users' classes, if they are the stored ones
    (:func:`dopt.registry.check_stored`).
    """
    return TrialSpec.from_mapping({**without_versions(_checked(config)), "seed": seed})


def system_of(config: Mapping[str, Any]) -> System:
    """Return the system of a stored configuration; raise as :func:`stored_trial`."""
    return system_from_mapping(_checked(config)["env"])


def _checked(config: Mapping[str, Any]) -> dict[str, Any]:
    check_stored(config)
    if not (is_prequential(config) or is_fit(config)):
        return dict(config)
    return {**config, "env": {k: v for k, v in config["env"].items() if k not in MARK}}


class MarkedTrial:
    """Entry of a results database that no launch can run, such as an exploration."""

    seed: int
    config_json: str

    @functools.cached_property
    def config_key(self) -> str:
        """SHA-256 of :attr:`config_json`."""
        return hashlib.sha256(self.config_json.encode()).hexdigest()

    @functools.cached_property
    def trial_key(self) -> str:
        """SHA-256 of the marked configuration with the seed."""
        text = f'{self.config_json[:-1]},"seed":{self.seed}}}'
        return hashlib.sha256(text.encode()).hexdigest()

    def columns(self) -> dict[str, str | int | float | None]:
        """Return what a table of configurations shows in columns of its own."""
        raise NotImplementedError


def marked_json(content: Mapping[str, object]) -> str:
    """Return the canonical JSON of a marked configuration."""
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)


class PrequentialTrial(MarkedTrial):
    """An exploration as the trial that a results database holds.

    Attributes
    ----------
    spec : TrialSpec
        Plant or system, policy, model, learner and seed.
    config_json : str
        Canonical JSON of the marked configuration.
    """

    def __init__(self, spec: TrialSpec) -> None:
        content = json.loads(spec.config_json)
        content["env"] |= MARK
        self.spec, self.seed, self.config_json = spec, spec.seed, marked_json(content)

    def columns(self) -> dict[str, str | int | float | None]:
        """Return what a table of configurations shows in columns of its own."""
        return {**self.spec.columns(), "label": config_label(json.loads(self.config_json))}
