"""Base class of model specifications; networks."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dopt.arguments import numbers, rows_of
from dopt.fields import KernelSupport, parameter
from dopt.systems.base import Feature, System, feature_values, with_inputs
from dopt.types import Array


@dataclass(frozen=True, kw_only=True)
class Model(KernelSupport):
    """A parametric model of the r learned accelerations of a system.

    ``structure`` says how its parameters can be learned: by gradient, by least squares because the
    model is linear in them, by conditioning on all samples, or by fits of one network of an
    ensemble after the other. A learner names the one it teaches. ``affine_in_inputs`` says whether
    the accelerations are affine in the inputs for any parameters; a model that does not read inputs
    is.
    """

    section: ClassVar[str] = "model"
    name: ClassVar[str]
    structure: ClassVar[str] = "gradient"
    affine_in_inputs: ClassVar[bool] = True

    @abstractmethod
    def n_parameters(self, system: System) -> int:
        """Return the number q of parameters for a system."""

    def n_fixed_parameters(self, system: System) -> int:  # noqa: ARG002  # of most models, none
        """Return how many of them, the last ones, stay as they were drawn."""
        return 0

    @property
    def n_members(self) -> int:
        """Number of ensemble members (1 for a single network)."""
        return 1

    def n_member_parameters(self, system: System) -> int:
        """Return the number of parameters of one member, which a learning step or plan works on."""
        return self.n_parameters(system) // self.n_members

    @abstractmethod
    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        """Draw the initial parameters, (q,)."""

    def predict(
        self, system: System, parameters: Array, states: Array, inputs: Array | None = None
    ) -> Array:
        """Return the modelled accelerations, (N, r), of states, (N, d), with parameters (q,).

        The inputs, (N, m), count in a model that reads them; without any they are 0. Raises
        ``SpecificationError`` for arrays of other shapes.
        """
        x = rows_of("states", states, system.n_states)
        u = None if inputs is None else rows_of("inputs", inputs, system.n_inputs)
        theta = numbers("the parameters", parameters, self.n_parameters(system))
        return self.predict_at(system, theta, self.points(system, x, u))

    @abstractmethod
    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        """Return the modelled accelerations, (N, r), at :meth:`points`, with parameters (q,)."""

    def n_inputs_read(self, system: System) -> int:  # noqa: ARG002  # of most models, none
        """Return how many inputs the model depends on: all m, or none."""
        return 0

    def points(self, system: System, states: Array, inputs: Array | None = None) -> Array:
        """Return what the model depends on: states (N, d), or states and inputs, (N, d + m)."""
        return with_inputs(states, inputs, self.n_inputs_read(system))

    def features(self, system: System) -> tuple[Feature, ...]:
        """Return the p features of a point: of the state, then the inputs that the model reads."""
        first, m = system.n_states, self.n_inputs_read(system)
        return (*system.features, *(Feature("identity", first + j) for j in range(m)))

    def feature_scales(self, system: System) -> tuple[float, ...]:
        """Return the divisor of each feature: the system's scale, and γ for an input."""
        return (*system.feature_scales, *[system.gamma] * self.n_inputs_read(system))

    def featurize(self, system: System, points: Array) -> Array:
        """Return the features, (N, p), of points."""
        scales = self.feature_scales(system)
        values = feature_values(self.features(system), scales, np.moveaxis(points, -1, 0))
        return np.stack(values, axis=-1)


@dataclass(frozen=True, kw_only=True)
class MLP(Model):
    """Network of ``depth`` hidden layers of ``width`` tanh units and a linear output layer.

    The flat parameter vector is W₁, b₁, W₂, b₂, ... with each W row by row (outputs × inputs), the
    order of ``torch.nn.utils.parameters_to_vector`` for a stack of ``torch.nn.Linear``.

    Parameters
    ----------
    width : int
        Units in each hidden layer (16 in the paper).
    depth : int
        Number of hidden layers (2 in the paper).
    """

    name: ClassVar[str] = "mlp"
    compiled: ClassVar[bool] = True

    width: int = parameter(16, "units", "positive")
    depth: int = parameter(2, "layers", "positive")

    def layer_sizes(self, system: System) -> tuple[int, ...]:
        """Return the number of units of every layer, from the features to the outputs."""
        return (self.n_first_inputs(system), *[self.width] * self.depth, system.n_learned)

    def layer_inputs(self, system: System) -> tuple[int, ...]:
        """Return the number of inputs of every layer, as many as its matrix has columns."""
        return (*self.layer_sizes(system)[:-2], self.n_output_inputs(system))

    def n_first_inputs(self, system: System) -> int:
        """Return how many features the first layer has for inputs."""
        return len(self.features(system))

    def n_output_inputs(self, system: System) -> int:  # noqa: ARG002  # the units of a hidden layer
        """Return how many inputs the output layer has."""
        return self.width

    def output_inputs(self, system: System, hidden: Array, features: Array) -> Array:  # noqa: ARG002  # the hidden layer alone
        """Return the inputs of the output layer for the last hidden layer, (N, w)."""
        return hidden

    def n_parameters(self, system: System) -> int:
        n_in, n_out, width = self.n_first_inputs(system), system.n_learned, self.width
        hidden = (n_in + 1) * width + (self.depth - 1) * (width + 1) * width
        return hidden + (self.n_output_inputs(system) + 1) * n_out

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        """Draw every weight and bias of a layer uniformly in ±1/√(units below it)."""
        return np.concatenate(
            [
                rng.uniform(-1.0, 1.0, (n_in + 1) * n_out) / np.sqrt(below)
                for n_in, below, n_out in self._layers(system)
            ]
        )

    def _layers(self, system: System) -> list[tuple[int, int, int]]:
        """Return for each layer the number of its inputs, of the units below it and of its own."""
        sizes = self.layer_sizes(system)
        return list(zip(self.layer_inputs(system), sizes[:-1], sizes[1:], strict=True))

    def weights(self, system: System, parameters: Array) -> list[tuple[Array, Array]]:
        """Return views of each layer's W, (..., outputs, inputs), and b in parameters, (..., q)."""
        views, first, leading = [], 0, parameters.shape[:-1]
        for n_in, _, n_out in self._layers(system):
            middle, last = first + n_in * n_out, first + (n_in + 1) * n_out
            W = parameters[..., first:middle].reshape(*leading, n_out, n_in)
            views.append((W, parameters[..., middle:last]))
            first = last
        return views

    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        features = self.featurize(system, points)
        values = features[:, : self.layer_sizes(system)[0]]
        *hidden, (W, b) = self.weights(system, parameters)
        for V, c in hidden:
            values = np.tanh(values @ V.T + c)
        return self.output_inputs(system, values, features) @ W.T + b


@dataclass(frozen=True, kw_only=True)
class BlackBoxMLP(MLP):
    """a_θ(x, u): a network (:class:`dopt.models.MLP`) of the features of x and of u/γ.

    Nothing is assumed of the effect of the inputs.
    """

    name: ClassVar[str] = "black_box"
    compiled: ClassVar[bool] = True
    affine_in_inputs: ClassVar[bool] = False

    def n_inputs_read(self, system: System) -> int:
        return system.n_inputs


@dataclass(frozen=True, kw_only=True)
class AffineMLP(BlackBoxMLP):
    """a_θ(x) + B_θ(x) u, with a_θ and the columns of B_θ the outputs of one network of x.

    With h the last hidden layer, the output layer is linear in (h, h u₁/γ, ..., h u_m/γ, u/γ): one
    matrix W, (r, (1 + m) w + m), and a bias, (r,). In the flat parameter vector they come last, as
    the last layer of :class:`dopt.models.MLP` does.
    """

    name: ClassVar[str] = "affine"
    compiled: ClassVar[bool] = True
    affine_in_inputs: ClassVar[bool] = True

    def n_first_inputs(self, system: System) -> int:
        return len(system.features)

    def n_output_inputs(self, system: System) -> int:
        return (1 + system.n_inputs) * self.width + system.n_inputs

    def output_inputs(self, system: System, hidden: Array, features: Array) -> Array:
        m = system.n_inputs
        u = features[:, -m:]
        products = [hidden * u[:, j : j + 1] for j in range(m)]
        return np.concatenate([hidden, *products, u], axis=1)


@dataclass(frozen=True, kw_only=True)
class Ensemble(MLP):
    """The mean of E networks (:class:`dopt.models.MLP`) with initial parameters of their own.

    The first member is the network of the same seed: it learns at each step and plans are made with
    it, so that the trial explores as with one network. The others take turns, one learns at each
    step, so that a step costs two learning steps whatever E is. Losses, predictions and control use
    the mean of all members, whose errors partly cancel. It goes with a learner that fits all
    samples again at each step. The parameters are the members' parameters, one after the other.
    Reference: B. Lakshminarayanan et al., "Simple and scalable predictive uncertainty
    estimation using deep ensembles" (2017).

    Parameters
    ----------
    members : int
        Number of networks E.
    """

    name: ClassVar[str] = "ensemble"
    compiled: ClassVar[bool] = True
    structure: ClassVar[str] = "ensemble"

    members: int = parameter(5, "networks", "positive")

    @property
    def n_members(self) -> int:
        return self.members

    def n_parameters(self, system: System) -> int:
        return self.members * super().n_parameters(system)

    def initial_parameters(self, system: System, rng: np.random.Generator) -> Array:
        """Draw the parameters of one member after the other, as :class:`dopt.models.MLP` does."""
        drawn = [super(Ensemble, self).initial_parameters(system, rng) for _ in range(self.members)]
        return np.concatenate(drawn)

    def predict_at(self, system: System, parameters: Array, points: Array) -> Array:
        """Return the mean of the members' accelerations, (N, r)."""
        members = parameters.reshape(self.members, -1)
        values = [super(Ensemble, self).predict_at(system, theta, points) for theta in members]
        mean: Array = np.mean(values, axis=0)
        return mean
