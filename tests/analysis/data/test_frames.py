"""What a notebook gets."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import analysis
from analysis.errors import AnalysisError
from analysis.loading import STEP_COLUMNS
from orchestrate.store import NoDatabaseError
from tests.analysis.synthetic import fake_result, make_spec


@pytest.fixture
def results(url: str) -> Iterator[analysis.Results]:
    with analysis.load(url) as opened:
        yield opened


def test_curves_are_tidy_and_exact(results: analysis.Results) -> None:
    table = results.curves()
    assert table.columns[-len(STEP_COLUMNS) :].tolist() == list(STEP_COLUMNS)
    chosen = table[
        (table.env == "cartpole") & (table.policy == "uniform") & (table.seed == 3)
    ].reset_index()
    expected = fake_result(make_spec("cartpole", "uniform", 3, env={"horizon": 60}))
    for name in STEP_COLUMNS:
        np.testing.assert_array_equal(chosen[name], getattr(expected, name))
    np.testing.assert_allclose(chosen.time, chosen.dt * chosen.t)


def test_every_width_is_there_and_told_apart(results: analysis.Results) -> None:
    curves = results.curves("loss")
    dopt = curves[(curves.env == "cartpole") & (curves.policy == "d_optimal")]
    assert sorted(dopt.width.unique()) == [4, 8, 16, 32, 64]
    assert (dopt.groupby("width").size() == 5 * 60).all()


def test_trials_have_one_row_each(results: analysis.Results) -> None:
    trials = results.trials()
    assert trials.trial_key.is_unique
    assert (trials.status == "diverged").sum() == 1
    assert len(trials) == results.configurations().n_done.sum() + 1


def test_a_request_narrows(url: str) -> None:
    with analysis.load(url, "cartpole", "d_optimal", {"model.width": 8}) as results:
        assert results.configurations().width.tolist() == [8]
        assert results.matrix("cartpole", "d_optimal").values.shape == (5, 60)


def test_a_matrix_is_that_of_the_figures(results: analysis.Results) -> None:
    matrix = results.matrix("cartpole", "random")
    assert matrix.seeds.tolist() == list(range(5))
    assert matrix.diverged.tolist() == [False, False, True, False, False]
    assert np.isnan(matrix.values[2, 20:]).all()


def test_trajectories_are_stacked(results: analysis.Results) -> None:
    paths = results.trajectories("cartpole", "random")
    assert paths.states.shape == (5, 61, 4)
    assert paths.inputs.shape == (5, 60, 1)
    assert len(paths.t) == 61
    assert np.isnan(paths.states[2, 21:]).all()


def test_what_is_not_there_is_a_sentence(results: analysis.Results, url: str) -> None:
    with pytest.raises(AnalysisError, match="stored are"):
        results.matrix("arm", "random")
    with pytest.raises(AnalysisError, match="fits no stored configuration"):
        analysis.load(url, where={"model.width": 5}).trials()
    with pytest.raises(NoDatabaseError):
        analysis.load("sqlite:///nowhere/results.db")
