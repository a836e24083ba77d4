"""Configurations of explorations, whose loss is prequential and not that of a grid.

The loss of an exploration at step t is the error of the acceleration that the model predicts for
it, before it learns from that step. Its configuration says so in the section ``env``, so that it is
never the configuration of a simulated trial.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dopt.declare.registry import check_stored
from dopt.spec.config import without_versions
from dopt.spec.label import config_label
from dopt.spec.trial import TrialSpec
from dopt.systems import System, system_from_mapping

MARK = {"loss": "prequential"}
"""Entry of the section ``env`` that marks an exploration, beside the fields of its system."""


def is_prequential(config: Mapping[str, Any]) -> bool:
    """Return whether a stored configuration is that of an exploration."""
    section = config.get("env")
    return isinstance(section, Mapping) and MARK.items() <= section.items()


def stored_trial(config: Mapping[str, Any], seed: int = 0) -> TrialSpec:
    """Return the trial of a stored configuration; raise SpecificationError if none can be made.

    Of classes of a user's own it runs the files of this machine, if they are the stored ones
    (:func:`dopt.declare.registry.check_stored`).
    """
    return TrialSpec.from_mapping({**without_versions(_checked(config)), "seed": seed})


def system_of(config: Mapping[str, Any]) -> System:
    """Return the system of a stored configuration; raise as :func:`stored_trial`."""
    return system_from_mapping(_checked(config)["env"])


def _checked(config: Mapping[str, Any]) -> dict[str, Any]:
    check_stored(config)
    if not is_prequential(config):
        return dict(config)
    return {**config, "env": {k: v for k, v in config["env"].items() if k not in MARK}}


@dataclass(frozen=True)
class PrequentialTrial:
    """An exploration as the trial that a results database holds.

    Attributes
    ----------
    spec : TrialSpec
        Plant or system, policy, model, learner and seed.
    """

    spec: TrialSpec

    @property
    def seed(self) -> int:
        return self.spec.seed

    @functools.cached_property
    def config_json(self) -> str:
        """Canonical JSON of the marked configuration."""
        content = json.loads(self.spec.config_json)
        content["env"] |= MARK
        return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)

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
        return {**self.spec.columns(), "label": config_label(json.loads(self.config_json))}
