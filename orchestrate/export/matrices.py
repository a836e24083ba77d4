"""Results as named matrices in one npz file, a configuration at a time."""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from orchestrate.export import streams
from orchestrate.export.columns import STEP_COLUMNS, TRIALS
from orchestrate.store import ConfigRow, Reader
from orchestrate.store.serialization import stacked

Named = tuple[str, npt.NDArray[Any], tuple[str, ...]]
"""Name, array and the names of its axes."""

_AT_A_TIME = 100  # trajectories


def names(configs: Sequence[ConfigRow]) -> list[str]:
    """Return env/policy/width of each configuration, and the key where that is not unique."""
    short = [f"{c.env}/{c.policy}/{'-' if c.width is None else c.width}" for c in configs]
    count = Counter(short)
    return [
        f"{name}/{config.config_key[: streams.KEY_DIGITS]}" if count[name] > 1 else name
        for name, config in zip(short, configs, strict=True)
    ]


def curves(reader: Reader, configs: Sequence[ConfigRow]) -> Generator[Named, None, None]:
    """Yield the curves of the finished trials, (seed, t), NaN from a divergence or an end on."""
    for name, config in zip(names(configs), configs, strict=True):
        seeds, diverged, steps = _steps(reader, config)
        for column, values in zip(STEP_COLUMNS, steps, strict=True):
            yield f"{name}/{column}", values, ("seed", "t")
        yield f"{name}/seed", seeds, ("seed",)
        yield f"{name}/diverged", diverged, ("seed",)


def _steps(
    reader: Reader, config: ConfigRow
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_], npt.NDArray[np.float64]]:
    """Return seeds (n,), flags of divergence (n,) and the columns of the steps (5, n, T)."""
    trials: dict[int, bool] = {}
    lengths: Counter[int] = Counter()
    blocks = [np.empty((0, len(STEP_COLUMNS)))]
    with closing(streams.steps(reader, config)) as batches:
        for rows in batches:
            seeds, statuses, _t, *values = zip(*rows, strict=True)
            trials.update(zip(seeds, (status == "diverged" for status in statuses), strict=True))
            lengths.update(seeds)
            blocks.append(np.array(values, dtype=np.float64).T)
    ends = np.cumsum([lengths[seed] for seed in trials])[:-1]
    curves = np.split(np.concatenate(blocks), ends)
    steps = stacked(curves) if trials else np.empty((0, config.horizon, len(STEP_COLUMNS)))
    return (
        np.array([*trials], np.int64),
        np.array([*trials.values()], np.bool_),
        steps.T.swapaxes(1, 2),
    )


def trajectories(reader: Reader, configs: Sequence[ConfigRow]) -> Generator[Named, None, None]:
    """Yield states, inputs and final parameters of the finished trials."""
    for name, config in zip(names(configs), configs, strict=True):
        found = list(streams.of_config(reader, config, _AT_A_TIME))
        if found:
            yield f"{name}/states", stacked([one.states for *_, one in found]), _axes("state")
            yield f"{name}/inputs", stacked([one.inputs for *_, one in found]), _axes("input")
            parameters = np.stack([one.parameters for *_, one in found])
            yield f"{name}/parameters", parameters, ("seed", "parameter")
        yield f"{name}/seed", np.array([seed for seed, *_ in found], dtype=np.int64), ("seed",)
        diverged = [status == "diverged" for _, status, _ in found]
        yield f"{name}/diverged", np.array(diverged, dtype=np.bool_), ("seed",)


def assessments(reader: Reader, configs: Sequence[ConfigRow]) -> Generator[Named, None, None]:
    """Yield each measure of the finished trials, (seed, t), with its seeds and numbers of steps."""
    for name, config in zip(names(configs), configs, strict=True):
        for measure in reader.measures(config.config_key):
            found = reader.assessments(config.config_key, measure)
            yield f"{name}/{measure}", found.values, ("seed", "t")
            yield f"{name}/{measure}/seed", found.seeds, ("seed",)
            yield f"{name}/{measure}/t", found.t, ("t",)


def trials(reader: Reader, configs: Sequence[ConfigRow]) -> Generator[Named, None, None]:
    """Yield the columns of the table of trials; a missing number is NaN, a missing text empty."""
    table = streams.trials(reader, configs)
    batches = list(table.batches)
    for i, field in enumerate(TRIALS):
        values = [value for batch in batches for value in batch.column(i).to_pylist()]
        if str(field.type) == "string":
            array = np.array([value or "" for value in values], dtype=np.str_)
        elif None in values or str(field.type) == "double":
            array = np.array(values, dtype=np.float64)
        else:
            array = np.array(values, dtype=np.int64)
        yield field.name, array, ("trial",)


def write(path: Path, arrays: Iterator[Named]) -> dict[str, dict[str, Any]]:
    """Write the arrays one by one; return the axes and the shape of each."""
    written: dict[str, dict[str, Any]] = {}
    with zipfile.ZipFile(path, "w") as archive:
        for name, array, axes in arrays:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
            written[name] = {"axes": axes, "shape": array.shape, "dtype": str(array.dtype)}
    return written


def _axes(last: str) -> tuple[str, str, str]:
    return ("seed", "t", last)
