"""A trial is a value: everything that it depends on, and a key made from that."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Collection, Mapping
from typing import Any, ClassVar

from dopt.compatibility import check_together, mismatch
from dopt.control import Control, task_from
from dopt.errors import IncompatibleError, SpecificationError, unknown_name
from dopt.fields import Checked, quantity
from dopt.learning import LEARNERS, Learner
from dopt.learning.base import Updated
from dopt.memory import memory_by_setting
from dopt.models import MODELS, Model
from dopt.models.mlp import MLP
from dopt.policies import POLICIES, Policy, Search
from dopt.policies.base import OpenLoop, Planned
from dopt.registry import TARGET, build, section_of
from dopt.soundness import check_system
from dopt.systems import SYSTEMS, System
from dopt.systems.black_box import BlackBox

CODE_VERSION = 1
"""Raised whenever a change of the code changes the numbers of a trial."""

ASSESSMENT_VERSION = 2
"""Raised whenever one changes the numbers of an assessment alone: for trials that have a task."""

_VERSIONS = ("code_version", "assessment_version")

LARGEST_SEED = 2**63 - 1
"""Fits into a column of every database."""

LARGEST_HORIZON = 10_000_000
"""A trial is committed whole, one row for each step."""

LARGEST_MEMORY = 2**40
"""Bytes that a trial may need on any machine; a launch also asks its own."""

PATHS = ("kernel", "reference")

_SECTIONS = ("env", "policy", "model", "learner")
_KEYS = (*_SECTIONS, "task", "path", "seed")


@dataclasses.dataclass(frozen=True)
class Cell:
    """A trial without its seed: one cell of a grid.

    ``path`` is the execution path, "kernel" or "reference". Both mean the same, but their numbers
    agree to rounding only, which grows over a trial: so it is part of the trial's identity. What
    the kernel does not know runs on the reference alone. ``task`` is what the trial is assessed by
    on the way, and no part of its identity where there is none.
    """

    system: System
    policy: Policy
    model: Model
    learner: Learner
    path: str = "kernel"
    task: Control | None = None

    def __post_init__(self) -> None:
        if self.path not in PATHS:
            raise unknown_name("path", self.path, PATHS)
        if self.task is not None:
            if isinstance(self.system, BlackBox):
                raise mismatch("a task", "a system with equations", f"env '{self.system.name}'")
            object.__setattr__(self, "task", self.task.resolved(self.system))
        self._check_runnable()
        if type(self.system) not in SYSTEMS.values():
            check_system(self.system)
        self.policy.check(self.system)
        self._check_size()
        if isinstance(self.policy, Search) and self.policy.budget_us and self.path != "kernel":
            raise IncompatibleError(
                f"policy.budget_us is {self.policy.budget_us:g} µs, but only the compiled kernel "
                f"heeds it, which runs the shipped systems, networks and learners one trial at a "
                f"time: set it to 0."
            )
        check_together(self.system, self.policy, self.model, self.learner)

    def _check_runnable(self) -> None:
        """Refuse parts of a user's own that no path can run, and on the kernel what it lacks."""
        for part, registry, bases in (
            (self.policy, POLICIES, (OpenLoop, Planned)),
            (self.learner, LEARNERS, (Updated,)),
        ):
            shipped: Collection[type] = registry.values()
            if type(part) not in shipped and not isinstance(part, bases):
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

    @property
    def _parts(self) -> tuple[System, Policy, Model, Learner]:
        return self.system, self.policy, self.model, self.learner

    def _check_size(self) -> None:
        """Refuse what no machine can run, such as a mistyped number of zeros."""
        if self.system.horizon > LARGEST_HORIZON:
            raise SpecificationError(
                f"env.horizon is {self.system.horizon:,} steps, but it has to be at most "
                f"{LARGEST_HORIZON:,}: set it so."
            )
        if self.memory > LARGEST_MEMORY:
            raise SpecificationError(
                f"a trial would need {self.memory / 2**30:,.0f} GiB of memory, most of it because "
                f"of {self.largest_setting}, but at most {LARGEST_MEMORY / 2**30:,.0f} GiB are "
                f"allowed: make {self.largest_setting} smaller."
            )

    @property
    def memory(self) -> int:
        """Bytes that one trial holds at once, beside the interpreter."""
        return sum(self._memory_by_setting.values())

    @property
    def largest_setting(self) -> str:
        """The setting that decides about most of the memory."""
        return max(self._memory_by_setting, key=lambda key: self._memory_by_setting[key])

    @functools.cached_property
    def _memory_by_setting(self) -> dict[str, int]:
        return memory_by_setting(*self._parts, self.path, self.task)

    @functools.cached_property
    def canonical_json(self) -> str:
        """Sorted, compact JSON of the content and the code version, without the seed."""
        content: dict[str, object] = {"code_version": CODE_VERSION, "path": self.path}
        content |= {key: section_of(part) for key, part in zip(_SECTIONS, self._parts, strict=True)}
        if self.task is not None:
            content["task"] = section_of(self.task)
            content["assessment_version"] = ASSESSMENT_VERSION
        return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)

    @functools.cached_property
    def key(self) -> str:
        return hashlib.sha256(self.canonical_json.encode()).hexdigest()


@dataclasses.dataclass(frozen=True)
class TrialSpec(Checked):
    """One trial: a cell of the grid and a seed.

    ``trial_key`` is the SHA-256 of the canonical JSON; equal keys are the same trial. Where it runs
    and how it is stored is not part of it.
    """

    section: ClassVar[str] = "trial"

    cell: Cell
    seed: int = quantity(0, bound="nonnegative")

    def __post_init__(self) -> None:
        whole = isinstance(self.seed, int) and not isinstance(self.seed, bool)
        if not whole or not 0 <= self.seed <= LARGEST_SEED:
            raise SpecificationError(
                f"seed is {_shown(self.seed)}, but a whole number of 0 or above and below 2^63 is "
                f"expected: set it so."
            )

    @classmethod
    def from_mapping(cls, given: Mapping[str, object]) -> TrialSpec:
        """Return the trial that a configuration describes.

        Parameters
        ----------
        given : mapping
            Sections ``env``, ``policy``, ``model`` and ``learner``, each with a ``name`` and the
            fields that differ from their defaults, the ``seed`` and the execution ``path``; without
            one, it is the kernel where that knows all parts, and the reference elsewhere. A
            section ``task`` with a name other than "none" says how the trial is assessed.

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
        sections = {key: _section(given, key) for key in _SECTIONS}
        system = build("env", SYSTEMS, sections["env"])
        policy = build("policy", POLICIES, sections["policy"])
        model = _model(sections["model"])
        learner = build("learner", LEARNERS, sections["learner"])
        compiled = all(part.compiled for part in (system, policy, model, learner))
        path = str(given.get("path", "kernel" if compiled else "reference"))
        cell = Cell(system, policy, model, learner, path, task_from(given.get("task")))
        return cls(cell, given.get("seed", 0))  # type: ignore[arg-type]  # checked on creation

    def with_seed(self, seed: int) -> TrialSpec:
        """Return the same cell with another seed."""
        return TrialSpec(self.cell, seed)

    @property
    def system(self) -> System:
        return self.cell.system

    @property
    def policy(self) -> Policy:
        return self.cell.policy

    @property
    def model(self) -> Model:
        return self.cell.model

    @property
    def learner(self) -> Learner:
        return self.cell.learner

    @property
    def task(self) -> Control | None:
        return self.cell.task

    @property
    def assessed_steps(self) -> tuple[int, ...]:
        """Numbers of explored steps after which the trial is assessed, none without a task."""
        return self.task.assessed_steps(self.system.horizon) if self.task else ()

    @property
    def config_json(self) -> str:
        """Canonical JSON without the seed."""
        return self.cell.canonical_json

    @property
    def config_key(self) -> str:
        """SHA-256 of :attr:`config_json`: the trial without its seed."""
        return self.cell.key

    @functools.cached_property
    def trial_key(self) -> str:
        """SHA-256 of :meth:`canonical_json`."""
        return hashlib.sha256(self.canonical_json().encode()).hexdigest()

    def canonical_json(self) -> str:
        """Return the compact JSON of the content: sorted, but for the seed, which comes last."""
        return f'{self.config_json[:-1]},"seed":{self.seed}}}'

    def to_mapping(self) -> dict[str, object]:
        """Return the mapping that :meth:`from_mapping` turns into this trial."""
        return without_versions(json.loads(self.canonical_json()))

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
        }


def without_versions(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a trial or a cell without the versions of the code."""
    return {key: value for key, value in content.items() if key not in _VERSIONS}


def _model(section: Mapping[str, object]) -> Model:
    """Return a registered model, or a network of the user's own, for which torch is loaded."""
    if TARGET not in section:
        return build("model", MODELS, section)
    from dopt.reference.module import Module

    return Module.from_section(section)


def _shown(value: object) -> str:
    return "null" if value is None else repr(value)


def _section(given: Mapping[str, object], key: str) -> Mapping[str, object]:
    section = given.get(key)
    if not isinstance(section, Mapping):
        raise SpecificationError(
            f"configuration key '{key}' is {section!r}, but a section with a name and fields is "
            f"expected: choose one, for instance {key}={_EXAMPLES[key]}."
        )
    return section


_EXAMPLES = {"env": "pendulum", "policy": "d_optimal", "model": "mlp", "learner": "adam_window"}
