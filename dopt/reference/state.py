"""Batch of trials as plans and learners see it: what was observed, parameters and information."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from dopt.errors import SpecificationError
from dopt.learning import InformationLearner
from dopt.policies import DOptimal, InformationPolicy
from dopt.policies.d_optimal import count_sketch
from dopt.randomness import draw
from dopt.reference.dynamics import LearnedDynamics
from dopt.reference.information import BatchInformation
from dopt.reference.models import model_function, network_function
from dopt.spec.compatibility import held_information
from dopt.spec.trial import TrialSpec
from dopt.systems.black_box import BlackBox
from dopt.types import Array


class BatchState:
    """n trials of one configuration in torch, before their first step.

    Parameters
    ----------
    specs : sequence of TrialSpec
        Trials that differ in the seed alone.
    device : str
        Torch device, ``"cpu"`` or ``"cuda"``.
    module : torch.nn.Module, optional
        Network from features to accelerations in place of the registered model; its parameters at
        the time of the call are the initial ones of every trial.

    Attributes
    ----------
    model : callable
        a_θ of the batch (:data:`dopt.reference.models.BatchModel`).
    theta : (n, q) tensor
        Parameters, of an ensemble those of its first member; the first ``n_learned`` of
        each trial are learned.
    members : (n, E, q) tensor or None
        Parameters of the networks of an ensemble.
    true_states : (n, T + 1, d) tensor
        Visited states of a simulation; those of ``states`` where all are known.
    states, inputs, targets : (n, T + 1, d), (n, T, m), (n, T, r) tensors
        States, known or estimated, applied inputs and observed accelerations; NaN where no trial
        has come yet.
    sampled_states : (n, T, d) tensor
        States at which the accelerations were observed.
    information : BatchInformation or None
        M in the space to which ``project`` maps gradients, (..., q).
    held : Information or None
        Form and λ of M.
    learned_rows : (r,) tensor
        Components of the derivative of the state that are learned.
    diverged : (n, 1) tensor
        Whether a trial has ended.
    noise, measurement_noise, open_loop, ties, radii : tensors
        Numbers of :class:`dopt.randomness.Draws` with the trials along the first axis.
    components, replay, plans, parameters : tensors
        More of them.

    Raises
    ------
    SpecificationError
        If the trials belong to different configurations.
    """

    def __init__(
        self, specs: Sequence[TrialSpec], device: str = "cpu", module: nn.Module | None = None
    ) -> None:
        if len({spec.config_key for spec in specs}) != 1:
            raise SpecificationError(
                f"{len(specs)} trials of different configurations were given, but those of a "
                f"batch may differ in the seed alone: run one batch for each configuration."
            )
        self.specs, self.device = list(specs), device
        self.system, self.config = specs[0].system, specs[0].config
        self._draw()
        self.model = model_function(self.system, self.config.model)
        if module is not None:
            self.model = network_function(self.system, module)
            flat = nn.utils.parameters_to_vector(module.parameters()).detach().double()
            self.theta = flat.to(device).repeat(len(specs), 1)
        count = self.config.model.n_members
        self.members = self.theta.view(len(specs), count, -1) if count > 1 else None
        if self.members is not None:
            self.theta = self.members[:, 0].clone()
            self.member_priors = self.members.clone()
        self.n_learned = self.theta.shape[1] - self.config.model.n_fixed_parameters(self.system)
        self._allocate()
        self._hold_information()

    @property
    def learned(self) -> LearnedDynamics:
        """The system with the model in the place of what is learned."""
        read = self.config.model.n_inputs_read(self.system)
        return LearnedDynamics(self.system, self.model, read)

    def points(self, states: Tensor, inputs: Tensor) -> Tensor:
        """Return what the model depends on at states (..., d) and inputs (..., m)."""
        return self.learned.points(states, inputs)

    def sampled_inputs(self, steps: int | slice) -> Tensor:
        """Return the inputs that belong to the accelerations of some steps, (n, ..., m)."""
        return self.inputs[:, steps]

    def tensor(self, values: Array) -> Tensor:
        """Return real numbers as a tensor where the trials are."""
        return torch.tensor(values, dtype=torch.float64, device=self.device)

    def _draw(self) -> None:
        draws = [draw(spec) for spec in self.specs]
        self.noise = self.tensor(np.stack([d.noise for d in draws]))
        self.measurement_noise = self.tensor(np.stack([d.measurement_noise for d in draws]))
        self.open_loop = self.tensor(np.stack([d.inputs for d in draws]))
        self.ties = self.tensor(np.stack([d.ties for d in draws]))
        self.radii = self.tensor(np.stack([d.radii for d in draws]))
        self.plans = self.tensor(np.stack([d.plans for d in draws]))
        self.parameters = self.tensor(np.stack([d.parameters for d in draws]))
        self.theta = self.tensor(np.stack([d.weights for d in draws]))
        self.components = torch.tensor(np.stack([d.components for d in draws]), device=self.device)
        self.replay = torch.tensor(np.stack([d.replay for d in draws]), device=self.device)

    def _allocate(self) -> None:
        n, T = len(self.specs), self.system.horizon
        self.states = self._unset(n, T + 1, self.system.n_states)
        if not isinstance(self.system, BlackBox):  # which starts where its episodes do
            self.states[:, 0] = self.tensor(np.array(self.system.initial_state))
        self.true_states = self.states.clone() if self.system.n_measured else self.states
        self.inputs = self._unset(n, T, self.system.n_inputs)
        self.targets = self._unset(n, T, self.system.n_learned)
        self.sampled_states = self._unset(n, T, self.system.n_states)
        self.learned_rows = torch.tensor(self.system.learned_rows, device=self.device)
        self.diverged = torch.zeros(n, 1, dtype=torch.bool, device=self.device)

    def _unset(self, *shape: int) -> Tensor:
        return torch.full(shape, torch.nan, dtype=torch.float64, device=self.device)

    def _hold_information(self) -> None:
        q, n_rows = self.theta.shape[1], self.system.n_learned * self.system.horizon
        self.held = held_information(self.config.policy, self.config.learner, q, n_rows)
        self.project: Callable[[Tensor], Tensor] = lambda rows: rows[..., : self.n_learned]
        self.information: BatchInformation | None = None
        if self.held and self._reads_information():
            self._choose_form(self.held.form)
            size = self.project(self.theta).shape[1]
            prior = self.held.regularization * torch.eye(size).to(self.theta)
            self.information = BatchInformation(prior.repeat(len(self.specs), 1, 1))

    def _reads_information(self) -> bool:
        """Tell whether a policy or a filter reads M; least squares sum their own here."""
        parts = (self.config.policy, self.config.learner)
        return any(isinstance(part, (InformationPolicy, InformationLearner)) for part in parts)

    def _choose_form(self, form: str) -> None:
        """Plan in the space of a sketch where the specification says so.

        The dual form is an algorithm of the kernel for the same M; the reference builds M.
        """
        q, policy = self.theta.shape[1], self.config.policy
        if self.config.model.structure == "least_squares":
            return
        if form == "sketch":
            assert isinstance(policy, DOptimal)
            buckets, signs = count_sketch(q, policy.sketch_size)
            matrix = torch.zeros(q, policy.sketch_size).to(self.theta)
            signed = torch.tensor(signs).to(self.theta)
            matrix[torch.arange(q), torch.tensor(buckets.astype(np.int64))] = signed
            self.project = lambda rows: rows @ matrix
