"""Recorded runs of four real plants: where they come from, and tables of them.

A run is read from a folder of gzipped CSV files, or downloaded once from the repository of its
authors, checked by its SHA-256, and converted: the columns that are used, in nine significant
digits, nothing resampled. Both give the same text, so the same numbers.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from dopt.errors import SpecificationError, unknown_name

HOST = "https://raw.githubusercontent.com"


@dataclass(frozen=True)
class Source:
    """A repository at a commit, and its runs of one plant.

    Attributes
    ----------
    repository, commit : str
    licence : str
    columns : tuple of str
        Columns that are kept.
    runs : mapping of str to (str, str)
        Path and SHA-256 of the original of each run, by its name.
    rows : int, optional
        Rows that are kept, from the first one; all where it is not given.
    """

    repository: str
    commit: str
    licence: str
    columns: tuple[str, ...]
    runs: Mapping[str, tuple[str, str]]
    rows: int | None = None

    @property
    def short(self) -> str:
        """Repository and commit as a page names them."""
        return f"{self.repository} ({self.commit[:7]})"


def _source(plant: str, *, rows: int | None = None, **given: str) -> Source:
    files = pd.read_csv(Path(__file__).with_name("registry.csv"))
    own = files[files.run.str.match(plant.replace(" ", "_"))]
    runs = {run: (path, digest) for run, path, digest in own.itertuples(index=False)}
    columns = tuple(given.pop("columns").split())
    return Source(runs=runs, columns=columns, rows=rows, **given)


SOURCES = {
    "disk": _source(
        "disk",
        repository="GerbenBeintema/gym-unbalanced-disk",
        commit="67deee0d2d28d93c6b0235ed1350b36a81c6aec3",
        licence="BSD-3-Clause by its pyproject",
        columns="u th",
        rows=30_000,
    ),
    "pendulum": _source(
        "pendulum",
        repository="dfki-ric-underactuated-lab/torque_limited_simple_pendulum",
        commit="ed17ea2d32a35ad944944ca03ef57693e2986732",
        licence="BSD-3-Clause",
        columns="time position velocity torque",
    ),
    "double pendulum": _source(
        "double pendulum",
        repository="dfki-ric-underactuated-lab/double_pendulum",
        commit="1e8544e67f3da72a51ee52fbbb278e131ce2a43f",
        licence="BSD-3-Clause",
        columns="time pos_meas1 pos_meas2 vel_meas1 vel_meas2 "
        "tau_con1 tau_con2 tau_meas1 tau_meas2",
    ),
    "qube": _source(
        "qube",
        repository="decargroup/closed_loop_koopman",
        commit="0b64a62e7f302441ce3580143a44d9d87c83532c",
        licence="MIT",
        columns="t theta alpha plant_input saturation",
    ),
}
"""Sources of the runs of each plant; paths and SHA-256 sums are in ``registry.csv``."""


def tables(plant: str, folder: Path | None, *, host: str = HOST) -> dict[str, pd.DataFrame]:
    """Return the runs of a plant by their names.

    Parameters
    ----------
    plant : str
        A key of ``SOURCES``.
    folder : Path, optional
        Holds ``RUN.csv.gz``; without it, originals are downloaded into the cache of the user.
    host : str
        Address before ``/REPOSITORY/COMMIT/PATH``.

    Raises
    ------
    SpecificationError
        If the folder does not hold a run, or one cannot be downloaded.
    """
    if plant not in SOURCES:
        raise unknown_name("plant with recorded runs", plant, SOURCES)
    source = SOURCES[plant]
    if folder is None:
        return {
            run: pd.read_csv(io.StringIO(converted(original(source, run, host), source)))
            for run in source.runs
        }
    return {run: read(folder / f"{run}.csv.gz") for run in source.runs}


def read(file: Path) -> pd.DataFrame:
    """Return a run in the converted form.

    Raises
    ------
    SpecificationError
        If there is no such file.
    """
    if not file.is_file():
        raise SpecificationError(
            f"{str(file)!r} is no file, but a recorded run is expected there: correct the folder, "
            f"or leave it out and unset DOPT_DATA, then the run is downloaded."
        )
    return pd.read_csv(file)


def original(source: Source, run: str, host: str = HOST) -> Path:
    """Return the place of the original of a run, which is downloaded if it was not yet.

    Raises
    ------
    SpecificationError
        If pooch is not installed, nothing answers, or the file has another SHA-256.
    """
    try:
        import pooch
    except ImportError:
        raise SpecificationError(
            "runs are to be downloaded, but pooch is not installed: run pip install pooch, or give "
            "a folder that holds them."
        ) from None
    path, digest = source.runs[run]
    address = f"{host}/{source.repository}/{source.commit}/{path}"
    try:
        found = pooch.retrieve(
            address,
            f"sha256:{digest}",
            fname=f"{run}.csv",
            path=pooch.os_cache("dopt") / source.commit[:7],
        )
    except (OSError, ValueError) as error:  # of requests, and of pooch where the sum is wrong
        raise SpecificationError(
            f"{address} could not be read ({str(error).splitlines()[0]}), but a file of the "
            f"SHA-256 {digest[:12]}… is expected: try again, or give a folder that holds {run}."
        ) from error
    return Path(found)


def converted(file: Path, source: Source) -> str:
    """Return the text of a run: its columns in nine significant digits."""
    table = pd.read_csv(file, skipinitialspace=True, nrows=source.rows)
    table.columns = [name.removeprefix("#").strip() for name in table.columns]
    kept = table[[*source.columns]].astype(float)
    return str(kept.to_csv(index=False, float_format="%.9g", lineterminator="\n"))
