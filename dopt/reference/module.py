"""A torch network of the user's own as the model."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import nn
from torch.nn.utils import parameters_to_vector

from dopt.errors import SpecificationError
from dopt.models.base import Array, Model
from dopt.reference.models import network_function
from dopt.registry import SOURCE, TARGET, check_source, imported, source_digest
from dopt.systems.base import System


@dataclass(frozen=True, kw_only=True)
class Module(Model):
    """a_θ(x) = network(features of x), for a subclass of ``torch.nn.Module`` with parameters θ.

    The class is called with the numbers p of features and r of learned accelerations and with the
    entries of its section by keyword. Its ``forward`` maps features, (p,), to accelerations, (r,),
    in double precision, in evaluation mode, and differentiably by ``torch.func``. θ holds all its
    parameters in the order of ``named_parameters()``. Its own initialisation, from a torch
    generator that the trial seeds, gives the initial ones.

    Parameters
    ----------
    target : str
        Dotted path of the class.
    source : str
        Digest of the file that defines it.
    arguments : str
        Canonical JSON of the keyword arguments.
    """

    compiled: ClassVar[bool] = False

    target: str
    source: str
    arguments: str = "{}"

    @property
    def name(self) -> str:  # type: ignore[override]  # the class that is wrapped has the name
        return self.target.rpartition(".")[2]

    @classmethod
    def from_section(cls, given: Mapping[str, object]) -> Module:
        """Return the model that a configuration section with a ``_target_`` describes.

        Raises
        ------
        SpecificationError
            If the class is not a network, was stored in another state of its file, or an argument
            is nothing that JSON knows.
        """
        target = str(given[TARGET])
        network = imported("model", target, given)
        if not (isinstance(network, type) and issubclass(network, nn.Module)):
            raise SpecificationError(
                f"model.{TARGET} is '{target}', but a class derived from torch.nn.Module is "
                f"expected: correct the class or the path."
            )
        check_source("model", target, network, given)
        model = cls(target=target, source=source_digest(network), arguments=_canonical(given))
        if given.get("name", model.name) != model.name:
            raise SpecificationError(
                f"model.name is '{given['name']}', but {target} is called '{model.name}': leave "
                f"model.name out, or correct it."
            )
        return model

    def to_section(self) -> dict[str, object]:
        """Return the section from which :meth:`from_section` makes this model."""
        origin = {TARGET: self.target, SOURCE: self.source}
        return {"name": self.name, **origin, **json.loads(self.arguments)}

    @property
    def _class(self) -> type[nn.Module]:
        given = {SOURCE: self.source}
        found: Any = imported("model", self.target, given)
        network: type[nn.Module] = found
        check_source("model", self.target, network, given)
        return network

    def module(self, system: System) -> nn.Module:
        """Return the network for a system, with parameters that nobody should rely on."""
        return _network(self, len(system.features), system.n_learned)

    def n_parameters(self, system: System) -> int:
        return sum(parameter.numel() for parameter in self.module(system).parameters())

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        seed = int(rng.integers(2**63 - 1))
        drawn = _built(self, len(system.features), system.n_learned, seed)
        return _array(parameters_to_vector(drawn.parameters()))

    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        function = network_function(system, self.module(system))
        theta, states = torch.as_tensor(parameters), torch.as_tensor(points)
        with torch.no_grad():
            return _array(function(theta[None], states[None])[0])


def _canonical(given: Mapping[str, object]) -> str:
    arguments = {k: v for k, v in given.items() if k not in ("name", TARGET, SOURCE)}
    try:
        return json.dumps(arguments, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise SpecificationError(
            f"the arguments of model.{TARGET} are {arguments!r}, but finite numbers, texts and "
            f"lists of them are expected ({error}): change these arguments."
        ) from error


@functools.lru_cache(maxsize=16)
def _network(model: Module, n_features: int, n_outputs: int) -> nn.Module:
    """Return a network that has been tried out."""
    module = _built(model, n_features, n_outputs, 0)
    try:
        out = module(torch.zeros(n_features, dtype=torch.float64))
    except Exception as error:
        raise _wrong(model, f"maps {n_features} features to accelerations", error) from error
    if not isinstance(out, torch.Tensor) or out.shape != (n_outputs,):
        shape = tuple(out.shape) if isinstance(out, torch.Tensor) else type(out).__name__
        raise _wrong(model, f"maps {n_features} features to shape ({n_outputs},)", shape)
    if not any(parameter.numel() for parameter in module.parameters()):
        raise _wrong(model, "has parameters", "none")
    return module


def _built(model: Module, n_features: int, n_outputs: int, seed: int) -> nn.Module:
    """Return a new network in double precision; torch's own generator is left as it was."""
    arguments = json.loads(model.arguments)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        try:
            module = model._class(n_features, n_outputs, **arguments)
        except Exception as error:
            expected = f"takes {n_features} features, {n_outputs} outputs and {arguments}"
            raise _wrong(model, expected, error) from error
    return module.double().eval()


def _array(values: torch.Tensor) -> Array:
    array: Array = values.detach().numpy().astype(np.float64)
    return array


def _wrong(model: Module, expected: str, given: object) -> SpecificationError:
    return SpecificationError(
        f"model.{TARGET} is '{model.target}', but a network that {expected} is expected, and it "
        f"gave: {given}; correct the class or its arguments."
    )
