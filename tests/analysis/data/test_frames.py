"""Frames that a notebook gets."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import analysis
from analysis.data.frames import STEP_COLUMNS
from analysis.errors import AnalysisError
from dopt.run import run_trial
from orchestrate.store import Curves, NoDatabaseError, Reader
from tests.analysis.synthetic import fake_result, fill, make_grid, make_spec


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


def test_one_configuration_of_each_policy_is_shown(results: analysis.Results) -> None:
    shown = results.shown()
    assert not shown.duplicated(["env", "policy"]).any()
    assert len(shown) == 3 * 5 - 1  # the quadrotor has no eigenmode
    dopt = shown[(shown.env == "cartpole") & (shown.policy == "d_optimal")]
    assert dopt.width.tolist() == [16]
    assert set(shown.index) < set(results.configurations().index)


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


def test_a_stored_trial_has_its_model_again(results: analysis.Results) -> None:
    trials = results.trials()
    row = trials[(trials.env == "quadrotor") & (trials.policy == "random")].iloc[2]
    model = results.model(row)
    spec = model.spec
    assert (spec.trial_key, spec.seed) == (row.trial_key, row.seed)
    assert results.model(row.trial_key).spec == spec
    expected = fake_result(spec).parameters
    np.testing.assert_array_equal(model.parameters, expected)
    states, inputs = np.zeros((3, spec.system.n_states)), np.ones((3, spec.system.n_inputs))
    states[1:] = 0.3
    accelerations = model.predict(states)
    np.testing.assert_array_equal(accelerations, spec.model.predict(spec.system, expected, states))
    np.testing.assert_allclose(model.predict(states[1]), accelerations[1], rtol=1e-12)
    difference = spec.system.derivative(states[1], inputs[1]) - model.predict(states, inputs)[1]
    error = spec.system.learned(states)[1] - accelerations[1]
    np.testing.assert_allclose(difference[list(spec.system.learned_rows)], error, rtol=1e-9)
    others = np.delete(difference, list(spec.system.learned_rows))
    np.testing.assert_allclose(others, 0.0, atol=1e-12)


def test_a_model_of_no_trial_or_of_wrong_states_is_a_sentence(results: analysis.Results) -> None:
    with pytest.raises(AnalysisError, match="No trial of the request has the key 'abc'"):
        results.model("abc")
    model = results.model(results.trials().iloc[0])
    with pytest.raises(AnalysisError, match=r"states have the shape \(3,\), but \(N, 2\)"):
        model.predict(np.zeros(3))


@pytest.mark.parametrize(
    ("request_", "sentence"),
    [
        ({"where": "model.width=16"}, r"^where is 'model.width=16', .*where=\{'model.width': 16\}"),
        ({"where": ["model.width=16"]}, r"^where is \['model.width=16'\], .*'model.width': 16\}"),
        ({"where": {3: 4}}, r"^where is \{3: 4\}, but a mapping of dotted paths"),
        ({"where": {"model.width": np.int64(5)}}, r"model.width=\S+ fits no stored"),
        ({"env": 3}, r"^env is 3, but a name or a list of names is expected: write .*\]\.$"),
        ({"policy": ["random", None]}, r"^policy is \['random', None\], but a name"),
        ({"env": ["pendulum", "motr"]}, r"no trial of environment 'motr', choose one of cartpole"),
        ({"policy": "greedy"}, r"no trial of policy 'greedy', choose one of"),
    ],
)
def test_a_request_of_another_kind_is_a_sentence(
    url: str, request_: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(AnalysisError, match=sentence):
        analysis.load(url, **request_).trials()


def test_what_is_no_trial_or_no_number_is_a_sentence(results: analysis.Results) -> None:
    trials = results.trials()
    for given, said in (
        (3, "is 3"),
        (trials.iloc[:2], "is a table of 2 rows"),
        ({"seed": 1}, r"is \{'seed': 1\}"),
        (None, "is None"),
    ):
        with pytest.raises(AnalysisError, match=rf"^The trial {said}, but one row of"):
            results.model(given)
    model = results.model(dict(trials.iloc[0]))
    for states in ("x", [[1.0, 2.0], [3.0]], {"a": 1}):
        with pytest.raises(AnalysisError, match=r"^states are .*but numbers of the shape \(N, 2\)"):
            model.predict(states)
    with pytest.raises(AnalysisError, match=r"^inputs have 2 rows and states have 3"):
        model.predict(np.zeros((3, 2)), np.zeros((2, 1)))


def test_the_error_of_a_stored_model_is_the_stored_loss(tmp_path: Path) -> None:
    """The trial, the database and the prediction agree on the accelerations that were learned."""
    spec = make_spec("pendulum", "random", 0, env={"horizon": 40})
    url, result = f"sqlite:///{tmp_path}/one.db", run_trial(spec, path="reference")
    fill(url, [spec], edit=lambda *_: result)
    with analysis.load(url) as results:
        trials = results.trials()
        model = results.model(trials.iloc[0])
    grid = spec.system.grid()
    error = model.predict(grid) - spec.system.learned(grid)
    rms = np.sqrt(np.mean(np.sum(error**2, axis=1)))
    assert trials.final_loss[0] == pytest.approx(rms, rel=1e-4)


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_what_is_finished_during_a_read_is_not_in_a_part_of_it(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    url, short = request.getfixturevalue(f"{kind}_url"), {"env": {"horizon": 20}}
    fill(url, make_grid(("pendulum",), ("random",), range(2), **short))
    read, left = Reader.curves, make_grid(("pendulum",), ("random",), range(2, 4), **short)

    def curves(self: Reader, config_key: str, column: str) -> Curves:
        found = read(self, config_key, column)
        if left:
            fill(url, [left.pop()])
        return found

    monkeypatch.setattr(Reader, "curves", curves)
    with analysis.load(url) as results:
        table = results.curves("loss", "plan_us")
        assert table.seed.unique().tolist() == [0, 1]
        assert len(results.curves("loss", "plan_us")) == 4 * 20
