"""A film shows the stored trial, and what its model really knew at each frame."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from analysis.cli import main
from analysis.data.matching import AnalysisError, Filter
from analysis.data.selection import select
from analysis.film import Story, _stage, shoot, tell
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from orchestrate.store import LaunchRecord, Reader, Store
from tests.analysis.synthetic import make_spec
from tests.orchestrate.store.fakes import RUN

HORIZON = 30

pytestmark = pytest.mark.xdist_group("films")  # the trials are run once for all of them
KINDS = ("pendulum", "quadrotor", "chain", "van_der_pol")
"""A rod, a body that is followed, several masses, and a system without a picture."""


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return real trials, one of each kind of system, and one of the oracle."""
    specs = [make_spec(env, "d_optimal", 1, env={"horizon": HORIZON}) for env in KINDS]
    specs.append(make_spec("pendulum", "oracle", 1, env={"horizon": HORIZON}))
    return stored(tmp_path_factory.mktemp("films"), specs)


def stored(folder: Path, specs: list[TrialSpec]) -> str:
    url = f"sqlite:///{folder}/results.db"
    with Store.open(url) as store:
        launch = store.begin_launch(LaunchRecord(["test"], [], "here", 1))
        for claim in store.claim(launch, store.register(launch, specs).todo):
            spec = next(one for one in specs if one.trial_key == claim.trial_key)
            store.commit(claim, run_trial(spec), RUN)
        store.end_launch(launch, "done")
    return url


@pytest.fixture
def story(url: str) -> Callable[..., Story]:
    def told(env: str = "pendulum", policy: str = "d_optimal", frames: int = 4) -> Story:
        with Reader.open(url) as reader:
            (entry,) = select(reader, Filter((env,), (policy,))).entries
            return tell(reader, entry, 1, frames)

    return told


@pytest.mark.parametrize("policy", ["d_optimal", "oracle"])
def test_the_last_frame_knows_what_was_stored(story: Callable[..., Story], policy: str) -> None:
    told = story(policy=policy)
    spec = make_spec("pendulum", policy, 1, env={"horizon": HORIZON})
    result = run_trial(spec)
    np.testing.assert_array_equal(told.states, result.states)
    expected = spec.model.predict(spec.system, result.parameters, result.states)
    np.testing.assert_allclose(told.learned[-1], expected)
    assert told.steps.tolist() == [0, 10, 20, 30]


def test_learning_brings_the_learned_force_to_the_true_one(story: Callable[..., Story]) -> None:
    told = story(policy="oracle")
    errors = np.abs(told.learned - told.truth).mean(axis=(1, 2))
    assert errors[-1] < 0.1 * errors[0]


@pytest.mark.parametrize("env", KINDS)
def test_every_picture_shows_something_else(
    story: Callable[..., Story], env: str, tmp_path: Path
) -> None:
    target = tmp_path / "new" / "film.gif"
    shoot(story(env), target, 10)
    with Image.open(target) as film:
        assert film.info["duration"] == 100
        frames = {frame.convert("RGB").tobytes() for frame in ImageSequence.Iterator(film)}
    assert len(frames) == 4
    assert [path.name for path in target.parent.iterdir()] == ["film.gif"]


@pytest.mark.skipif(not shutil.which("ffmpeg"), reason="the program ffmpeg is not installed")
def test_an_mp4_is_written_by_ffmpeg(story: Callable[..., Story], tmp_path: Path) -> None:
    shoot(story(), tmp_path / "film.mp4", 10)
    assert b"ftyp" in (tmp_path / "film.mp4").read_bytes()[:32]


def test_another_ending_is_refused_before_the_trial_runs_again(
    url: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("analysis.film.rerun", lambda *_: pytest.fail("the trial ran again"))
    assert main(["animate", "pendulum", "oracle", "--db", url, "--out", "film.avi"]) == 2
    assert "film.avi cannot be written, but a .gif can" in capsys.readouterr().err


def test_a_trial_that_diverged_is_shown_as_far_as_it_went(tmp_path: Path) -> None:
    limits = {"horizon": HORIZON, "state_limit": 0.4}
    spec = make_spec("pendulum", "random", 1, env=limits)
    end = run_trial(spec).diverged_at
    assert end is not None
    with Reader.open(stored(tmp_path, [spec])) as reader:
        (entry,) = select(reader, Filter(("pendulum",))).entries
        told = tell(reader, entry, 1, 4)
    assert told.states.shape == (end, 2)
    assert told.loss.shape == (end - 1,)
    assert np.isfinite(told.states).all()
    _stage(told)[1](3)


def test_a_trial_that_diverged_at_once_has_no_film(tmp_path: Path) -> None:
    limits = {"horizon": HORIZON, "state_limit": 1e-6}
    url = stored(tmp_path, [make_spec("pendulum", "random", 1, env=limits)])
    with Reader.open(url) as reader:
        (entry,) = select(reader, Filter(("pendulum",))).entries
        with pytest.raises(AnalysisError, match=r"diverged at its first steps: .* another with"):
            tell(reader, entry, 1, 4)


def test_a_trial_that_runs_another_way_is_refused(
    monkeypatch: pytest.MonkeyPatch, story: Callable[..., Story]
) -> None:
    honest = Reader.trajectory

    def shifted(self: Reader, key: str, seed: int) -> object:
        found = honest(self, key, seed)
        found.states[5:] += 0.1
        return found

    monkeypatch.setattr(Reader, "trajectory", shifted)
    with pytest.raises(AnalysisError, match="runs another way here"):
        story()


def test_where_two_configurations_fit_one_can_be_chosen(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    sizes = ({"width": 8}, {"width": 12})
    specs = [make_spec("pendulum", "random", 1, env={"horizon": 9}, model=one) for one in sizes]
    words = ["animate", "pendulum", "random", "--frames", "2", "--db", stored(tmp_path, specs)]
    assert main(words) == 2
    advice = capsys.readouterr().err.partition("choose one with ")[2].rstrip(".\n")
    assert main([*words, *advice.split()]) == 0
    assert main([*words, "--where", "model.width=9"]) == 2
    assert "stored are 8, 12: choose one" in capsys.readouterr().err


def test_the_command_picks_a_seed_and_a_name(
    url: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["animate", "quadrotor", "d_optimal", "--db", url, "--frames", "3"]) == 0
    assert capsys.readouterr().out == "figures/quadrotor_d_optimal.gif: seed 1, 3 pictures\n"
    assert main(["animate", "pendulum", "oracle", "--db", url, "--frames", "1"]) == 0
    assert capsys.readouterr().out == "figures/pendulum_oracle.gif: seed 1, 1 picture\n"
    assert main(["animate", "pendulum", "d_optimal", "--db", url, "--seed", "9"]) == 2
    assert "by --seed one of 1." in capsys.readouterr().err
    assert main(["animate", "pendulum", "uniform", "--db", url]) == 2
    assert "no trial of policy 'uniform'" in capsys.readouterr().err
    assert main(["animate", "pendulum", "oracle", "--db", url, "--frames", "0"]) == 2
    assert "a whole number above 0 is expected" in capsys.readouterr().err
