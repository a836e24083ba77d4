"""``python -m analysis fit``: the plant of the page, fitted to a run, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from analysis import cli
from analysis.outputs import PICTURES, TABLE_FILES
from orchestrate.store import Reader
from tests.dopt.fitting.test_fit import stamps, truth

PAGE = Path(__file__).parents[2] / "docs/fitting.md"


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    found = re.search(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert found
    file = tmp_path / "motor.yaml"
    file.write_text(found[1], encoding="utf-8")
    return file


@pytest.fixture
def run(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    t, u = stamps(rng, 800, 0.0), np.repeat(rng.uniform(-2.5, 2.5, 160), 5)
    x = truth(t, u, 0.02, 0, np.zeros(2), (24.0, 1.4, 90.0, 0.0))
    quantum = 2 * np.pi / 2000
    rows = np.column_stack([t, np.round(x[:, 0] / quantum) * quantum, u])
    file = tmp_path / "run.csv"
    np.savetxt(file, rows, delimiter=",", header="t,th,u", comments="", fmt="%.9g")
    return file


def test_the_plant_of_the_page_is_fitted(
    plant: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, url = tmp_path / "out", f"sqlite:///{tmp_path}/results.db"
    columns = ("--states", "angle=th", "--inputs", "voltage=u", "--time", "t")
    words = ["fit", str(plant), str(run), "--validate", str(run), *columns, "--width", "3"]
    words += ["--db", url]
    assert cli.main([*words, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    gain = re.search(r"gain +(\S+) ± (\S+)", said)
    assert gain
    assert float(gain[1]) == pytest.approx(24.0, rel=0.05)
    for expected in ("delay", "nothing changes", "linear", "physics alone", "Bounds of 90 %"):
        assert expected in said, expected
    assert (out / "fit.png").stat().st_size > 10_000
    assert np.load(out / "model.npz")["constants"].shape == (4,)
    with Reader.open(url) as reader:
        [stored] = reader.rows(
            "SELECT trial_key, value FROM v_assessment WHERE measure = 'constant.gain'"
        )
    assert stored.value == pytest.approx(float(gain[1]), rel=1e-4)
    assert f"trial: {stored.trial_key}" in said


def test_a_model_is_kept_whose_picture_cannot_be_drawn(
    plant: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = tmp_path / "short.csv"
    short.write_text("".join(run.read_text().splitlines(keepends=True)[:8]))
    words = ["fit", str(plant), str(run), "--validate", str(short), "--width", "0"]
    words += ["--columns", "angle=th,voltage=u", "--out", str(tmp_path / "out")]
    assert cli.main(words) == 2
    said = capsys.readouterr()
    assert "Not judged: no run is long enough" in said.out
    assert "no piece of the log is longer" in said.err
    assert (tmp_path / "out/model.npz").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[1, 2]", "holds a list"),
        ("states: {a: rad}\n", "a plant has no inputs"),
        ("dt: [", "cannot be read"),
    ],
)
def test_a_file_that_is_no_plant_is_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, said: str
) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text(text, encoding="utf-8")
    assert cli.main(["fit", str(file), str(run)]) == 2
    assert said in capsys.readouterr().err


def test_a_database_that_cannot_be_used_is_said_before_the_fit(
    plant: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["fit", str(plant), str(run), "--columns", "angle=th,voltage=u", "--db", "results.db"]
    assert cli.main([*words, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr()
    assert "write it as sqlite:///results.db" in said.err
    assert not said.out


@pytest.mark.parametrize(
    "command", [["figures"], ["report"], ["fit", "motor.yaml", "run.csv"]], ids=" ".join
)
@pytest.mark.parametrize("ending", [*PICTURES, *TABLE_FILES, "txt", "json", "gif"])
def test_a_file_is_no_folder(
    command: list[str], ending: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Folders that were called fit.png and report.md were made."""
    assert cli.main([*command, "--out", f"fit.{ending}"]) == 2
    assert f"--out is 'fit.{ending}', but a folder is expected" in capsys.readouterr().err


def test_a_field_that_is_none_is_named(
    plant: Path, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant.write_text(plant.read_text(encoding="utf-8").replace("gamma:", "gama:"), encoding="utf-8")
    assert cli.main(["fit", str(plant), str(run)]) == 2
    assert "gamma" in capsys.readouterr().err
