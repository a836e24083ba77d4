"""Evaluation points of a system in the arrays of the compiled loop."""

from __future__ import annotations

import numpy as np

from dopt.algorithm import ModelKind
from dopt.evaluation import EvaluationSet, evaluation_set
from dopt.kernel import structs as args
from dopt.kernel.evaluation import BLOCK
from dopt.models.base import Model
from dopt.systems.base import System
from dopt.types import Array, Integers, Stack


def evaluation_points(system: System, model: Model, network: args.Network) -> args.Evaluation:
    """Return the points of a system in the form that its model takes."""
    points = evaluation_set(system)
    if network.kind == ModelKind.LINEAR:
        return _linear_evaluation(system, points)
    features = model.featurize(system, model.points(system, points.states, points.inputs))
    columns = [features.T, points.accelerations.T]
    parts = [slice(0, points.n_grid), slice(points.n_grid, None)]
    blocks_of_features, targets, sizes = zip(
        *(_blocks(columns[0][:, part], columns[1][:, part]) for part in parts), strict=True
    )
    blocks = np.concatenate(blocks_of_features)
    return args.Evaluation(
        blocks.astype(np.float32),
        blocks,
        np.zeros((0, 0, 0)),
        np.zeros(1, dtype=np.int64),
        np.concatenate(targets),
        np.concatenate(sizes),
        np.zeros((0, 0, 0)),
        np.zeros((0, 0)),
        _followed(system, points),
        _bounds(*map(len, sizes)),
        _size(system, points),
    )


def _bounds(n_grid: int, n_reachable: int) -> Integers:
    """Return where the grid begins and ends, and where the reachable set ends."""
    return np.cumsum([0, n_grid, n_reachable], dtype=np.int64)


def _followed(system: System, points: EvaluationSet) -> Array:
    """Return the states at which the truth is evaluated anew at each step."""
    followed = system.points(points.states, points.inputs)
    return followed if len(system.history) > 1 else followed[:0]


def points_of_trial(
    points: args.Evaluation, network: args.Network, horizon: int
) -> args.Evaluation:
    """Return points with what a trial has for itself.

    These are its random features at the points, or room for the kernel between the points and its
    samples, and targets to write into if the truth changes with time.
    """
    if len(points.states):
        own = (points.block_targets.copy(), points.targets.copy())
        points = points._replace(block_targets=own[0], targets=own[1])
    if network.kind == ModelKind.RANDOM_FEATURES:
        values = network.waves.frequencies @ points.features
        values += network.waves.phases[:, None]
        np.cos(values, out=values)
        values *= network.waves.scale
        points = points._replace(basis=values, n_basis=np.array([values.shape[1]]))
    elif network.kind == ModelKind.LINEAR_STATE:
        points = points._replace(basis=points.features)
    elif network.kind == ModelKind.GAUSSIAN_PROCESS:
        room = np.zeros((points.bounds[2], horizon, BLOCK))
        points = points._replace(basis=room, n_basis=np.zeros(1, dtype=np.int64))
    return points


def _blocks(features: Array, targets: Array) -> tuple[Stack, Stack, Integers]:
    """Cut columns of points, (·, N), into padded blocks, (blocks, ·, BLOCK), and their sizes."""
    n = features.shape[1]
    starts = range(0, n, BLOCK)
    sizes = np.array([min(BLOCK, n - start) for start in starts], dtype=np.int64)

    def cut(columns: Array) -> Array:
        padded = np.zeros((len(columns), BLOCK * len(starts)))
        padded[:, :n] = columns
        return np.ascontiguousarray(padded.reshape(len(columns), -1, BLOCK).swapaxes(0, 1))

    return cut(features), cut(targets), sizes


def _linear_evaluation(system: System, points: EvaluationSet) -> args.Evaluation:
    at = system.points(points.states, points.inputs)
    offset, *units = (
        np.stack(np.broadcast_arrays(*system.accelerations(tuple(at.T), form)), axis=-1)
        for form in system.linear_form
    )
    regressors = np.stack([unit - offset for unit in units], axis=-1)
    return args.Evaluation(
        np.zeros((0, 0, 0), dtype=np.float32),
        np.zeros((0, 0, 0)),
        np.zeros((0, 0, 0)),
        np.zeros(1, dtype=np.int64),
        np.zeros((0, 0, 0)),
        np.zeros(0, dtype=np.int64),
        np.ascontiguousarray(regressors),
        np.ascontiguousarray(points.accelerations - offset),
        _followed(system, points),
        _bounds(points.n_grid, len(points.states) - points.n_grid),
        _size(system, points),
    )


def _size(system: System, points: EvaluationSet) -> float:
    """Return the root mean square norm of the targets, at the first or the last step."""
    ends = [points.accelerations]
    if len(system.history) > 1:
        ends.append(system.learned(points.states, system.horizon - 1, points.inputs))
    return max(float(np.sqrt(np.mean(np.sum(targets**2, axis=1)))) for targets in ends)
