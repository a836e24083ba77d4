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
        Path and SHA-256 of the original of each run, by the name of the run.
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


_PENDULUM = "results/control_method_{}/data_measured.csv"
_DOUBLE = "data/experiment_records/design_A.0/20220815/sys_id/trajectory_{}.csv"
_QUBE = "dataset/controller_20230828/qube_20230828T{}.csv"

SOURCES = {
    "disk": Source(
        "GerbenBeintema/gym-unbalanced-disk",
        "67deee0d2d28d93c6b0235ed1350b36a81c6aec3",
        "BSD-3-Clause by its pyproject",
        ("u", "th"),
        {
            "disk_train": (
                "disc-benchmark-files/training-val-test-data.csv",
                "3c3323ec752af2d5b0035e891c13836360d0e0bf04e9e3ab9f109f182029b094",
            )
        },
        rows=30_000,
    ),
    "pendulum": Source(
        "dfki-ric-underactuated-lab/torque_limited_simple_pendulum",
        "ed17ea2d32a35ad944944ca03ef57693e2986732",
        "BSD-3-Clause",
        ("time", "position", "velocity", "torque"),
        {
            f"pendulum_{name}": (_PENDULUM.format(folder), digest)
            for name, folder, digest in (
                (
                    "sysid",
                    "pd/system_identification",
                    "3a5728e9c5530dd9066c0d7fda4c6a9bf50d86f94538629ace6d2508a7053469",
                ),
                ("sac", "sac", "e2bfed62046a1bfdbfc8ff5322afd54acbf10521a683668c30ee39b241ea20d9"),
                ("ddp", "ddp", "14748fd189abae7b6392a016f2f0494b54bb2a8c014bc435a84b58dbecb2da35"),
                (
                    "ilqr",
                    "ilqr",
                    "f678b8650c167b04476be244f1b2d807d3e0949c5d7b7fa58522164bdcad0afe",
                ),
            )
        },
    ),
    "double pendulum": Source(
        "dfki-ric-underactuated-lab/double_pendulum",
        "1e8544e67f3da72a51ee52fbbb278e131ce2a43f",
        "BSD-3-Clause",
        tuple(
            f"{name}{joint}" if name != "time" else name
            for name in ("time", "pos_meas", "vel_meas", "tau_con", "tau_meas")
            for joint in ("1", "2")[: 1 if name == "time" else 2]
        ),
        {
            f"double_pendulum_{name}": (_DOUBLE.format(name), digest)
            for name, digest in (
                ("00", "3ea9f330443c902711faaf7f99059dd43e42ea30bb4e2d310d78aa1ec897532d"),
                ("01", "fbac28e9765eb86380a3ecbc75d7fd71ee7283a4b6eda740f486b5d8d670bab3"),
                ("02", "1dd18e2ef41511253b9d2ca2a51fd1a9cafe5eae7cb8280496f050cdae02db0d"),
                ("03", "f686c90294ee11e371b949369f7bd80541c74fe358a4e5c28c52dd86e08ac398"),
            )
        },
    ),
    "qube": Source(
        "decargroup/closed_loop_koopman",
        "0b64a62e7f302441ce3580143a44d9d87c83532c",
        "MIT",
        ("t", "theta", "alpha", "plant_input", "saturation"),
        {
            f"qube_{name}": (_QUBE.format(stamp), digest)
            for name, stamp, digest in (
                (
                    "00",
                    "150615_434_696_394",
                    "706189b4ca1be5595071db23dbf694e91f46fd7bd6c493a189bf68a559179d98",
                ),
                (
                    "01",
                    "150709_610_277_801",
                    "f9e6501c943e8a2aae6d94dbc19f728c718cacc77267c66b88701e23c2e8e08b",
                ),
                (
                    "02",
                    "161155_317_133_447",
                    "6650c643baecf6b6d2dec570a4d72c2979526a8cb64bb384ca442a17e8eee9a8",
                ),
                (
                    "03",
                    "161301_532_620_833",
                    "90fca344320f4e1fea968ba5671ca827b6da44fca7558d2c4aaed6ea6d665417",
                ),
                (
                    "04",
                    "161334_640_863_527",
                    "fa5e7ff533d3777cafa812efdcf1a20ffe070b553c5af2c2e2630fe3fcf55004",
                ),
                (
                    "05",
                    "161408_751_866_301",
                    "73d3297b55284e67a945fa852806d80efe4eb2f0d368195c0ca3e6eb4724cad7",
                ),
            )
        },
    ),
}
"""Where the runs of each plant come from."""


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
