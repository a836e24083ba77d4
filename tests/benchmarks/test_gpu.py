"""The GPU benchmark runs on the CPU with small batches, and says where inputs differ."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from benchmarks import gpu
from benchmarks.rows import Row
from dopt.spec.trial import TrialSpec


def test_the_cpu_stands_in_for_a_card(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(gpu, "SIZES", {"cpu": (2, 3)})
    monkeypatch.setattr(gpu, "COMPARED", 8)
    monkeypatch.setattr(gpu, "speed", _full_at(3))
    assert gpu.main(["--device", "cpu"]) == 0
    out = capsys.readouterr().out
    assert out.count("largest difference of an input: ") == 2
    assert "2 trials on cpu: " in out
    assert "% of the memory's rate" in out
    assert "3 trials on cpu: left out (the memory of the device is too small)" in out
    assert gpu.main(["--device", "cpu", "--seconds", "0"]) == 0
    assert "2 trials on cpu: left out (the time was over" in capsys.readouterr().out


def _full_at(size: int) -> Callable[..., Row]:
    measured = gpu.speed

    def speed(what: str, device: str, trials: int, steps: int, rate: float) -> Row:
        if trials == size:
            raise torch.OutOfMemoryError
        return measured(what, device, trials, steps, rate)

    return speed


def test_a_device_that_is_not_there_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert gpu.main(["--device", "cuda:99"]) == 1
    assert "--device is 'cuda:99', but torch runs here on cpu" in capsys.readouterr().err


def test_an_input_of_another_sign_counts_unless_rounding_decides(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spec = TrialSpec.from_names(env="cartpole", policy="d_optimal", seed=0)
    one = np.ones((1, 6, 1))
    other = one.copy()
    other[0, 4:] = -1.0
    assert gpu.cosine(spec, 4) > gpu.TIE
    assert gpu.largest_difference([spec], one, other) == (2.0, "")
    monkeypatch.setattr(gpu, "TIE", 1.1)
    assert gpu.largest_difference([spec], one, other) == (0.0, ", a tie at step 4 of seed 0")
    monkeypatch.undo()
    other[0, 2] = np.nan
    assert gpu.largest_difference([spec], one, other)[0] == np.inf
