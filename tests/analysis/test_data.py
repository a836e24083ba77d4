"""Frames for a notebook, equal numbers from both kinds of database, old rows, stored classes."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest

import analysis
from analysis.data.matching import AnalysisError, Filter, nearness, newest
from analysis.data.samples import learned_model, simulated_trial
from analysis.data.selection import is_possible, select
from analysis.figures.phase_portraits import measure_portraits, measure_spectra, tabulate_portraits
from analysis.stats.curves import PlotOptions, Statistic, measure_curves, tabulate_curves
from analysis.tables.comparisons import compare_policies
from analysis.tables.rendering import TABLES
from dopt.errors import SpecificationError
from dopt.run import run_trial
from dopt.spec.config import usual_values
from dopt.spec.trial import TrialSpec
from orchestrate.store import ConfigRow, Curves, NoDatabaseError, Reader
from orchestrate.store.schema import STEP_VALUES
from tests.analysis.conftest import SHORT, controlled
from tests.analysis.synthetic import fake_result, fill, filled, make_grid, make_spec


@pytest.fixture
def results(url: str) -> Iterator[analysis.Results]:
    with analysis.load(url) as opened:
        yield opened


def test_curves_are_tidy_and_exact(results: analysis.Results) -> None:
    table = results.curves()
    assert table.columns[-len(STEP_VALUES) :].tolist() == list(STEP_VALUES)
    chosen = table[
        (table.env == "cartpole") & (table.policy == "uniform") & (table.seed == 3)
    ].reset_index()
    expected = fake_result(make_spec("cartpole", "uniform", 3, env={"horizon": 60}))
    for name in STEP_VALUES:
        np.testing.assert_array_equal(chosen[name], getattr(expected, name))
    np.testing.assert_allclose(chosen.time, chosen.dt * chosen.t)


def test_every_width_is_told_apart_and_trials_have_one_row_each(results: analysis.Results) -> None:
    curves = results.curves("loss")
    dopt = curves[(curves.env == "cartpole") & (curves.policy == "d_optimal")]
    assert sorted(dopt.width.unique()) == [4, 8, 16, 32, 64]
    assert (dopt.groupby("width").size() == 5 * 60).all()
    trials = results.trials()
    assert trials.trial_key.is_unique
    assert (trials.status == "diverged").sum() == 1
    assert len(trials) == results.configurations().n_done.sum() + 1
    (view,) = results.reader.rows("SELECT * FROM v_trial LIMIT 1")
    assert {*trials.columns} == {*view._fields} - {"trial_id"}


def test_a_request_narrows(url: str) -> None:
    with analysis.load(url, "cartpole", "d_optimal", {"model.width": 8}) as results:
        assert results.configurations().width.tolist() == [8]
        assert results.matrix("cartpole", "d_optimal").values.shape == (5, 60)


def test_a_matrix_equals_the_figures_and_trajectories_are_stacked(
    results: analysis.Results,
) -> None:
    matrix = results.matrix("cartpole", "random")
    assert matrix.seeds.tolist() == list(range(5))
    assert matrix.diverged.tolist() == [False, False, True, False, False]
    assert np.isnan(matrix.values[2, 20:]).all()
    paths = results.trajectories("cartpole", "random")
    assert paths.states.shape == (5, 61, 4)
    assert paths.inputs.shape == (5, 60, 1)
    assert len(paths.t) == 61
    assert np.isnan(paths.states[2, 21:]).all()


def test_one_configuration_of_each_policy_is_shown(results: analysis.Results) -> None:
    shown = results.shown()
    assert not shown.duplicated(["env", "policy"]).any()
    assert len(shown) == 3 * 5 - 1  # the quadrotor has no eigenmode
    dopt = shown[(shown.env == "cartpole") & (shown.policy == "d_optimal")]
    assert dopt.width.tolist() == [16]
    assert set(shown.index) < set(results.configurations().index)


def test_what_is_not_there_is_a_sentence(results: analysis.Results) -> None:
    with pytest.raises(AnalysisError, match="stored are"):
        results.matrix("arm", "random")
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
    with pytest.raises(
        SpecificationError, match=r"states of shape \(3,\) were given, but \(N, 2\)"
    ):
        model.predict(np.zeros(3))


@pytest.mark.parametrize(
    ("request_", "sentence"),
    [
        ({"where": "model.width=16"}, r"^where is 'model.width=16', .*where=\{'model.width': 32\}"),
        ({"where": ["model.width=16"]}, r"^where is \['model.width=16'\], .*'model.width': 32\}"),
        ({"where": {3: 4}}, r"^where is \{3: 4\}, but a mapping of dotted paths"),
        ({"where": {"model.width": np.int64(5)}}, r"model.width=\S+ fits no stored"),
        ({"env": 3}, r"^env is 3, but a name or a list of names is expected: write .*\.$"),
        ({"policy": ["random", None]}, r"^policy is \['random', None\], but a name"),
        ({"env": ["pendulum", "motr"]}, r"no trial of environment 'motr', choose one of cartpole"),
        ({"policy": "greedy"}, r"no trial of policy 'greedy', choose one of d_optimal"),
        ({"env": "quadrotor", "policy": "periodic"}, r"No configuration .* fits"),
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
        with pytest.raises(SpecificationError, match=r"^states of the type .*an array of real num"):
            model.predict(states)
    with pytest.raises(SpecificationError, match=r"^3 states and 2 inputs were given"):
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


@pytest.fixture
def twins(sqlite_url: str, postgresql_url: str) -> tuple[Reader, Reader]:
    """Return one grid in both databases, with a diverged trial, filled in different orders."""
    specs = make_grid(("pendulum", "cartpole"), seeds=range(6), **SHORT) + controlled(range(6))
    lost = next(s for s in specs if (s.system.name, s.policy.name) == ("cartpole", "random"))
    for url, order in ((sqlite_url, specs), (postgresql_url, specs[::-1])):
        fill(url, order, diverged={lost.trial_key: 20})
    return Reader.open(sqlite_url), Reader.open(postgresql_url)


def test_every_number_is_the_same(twins: tuple[Reader, Reader]) -> None:
    for one, other in zip(_numbers(twins[0]), _numbers(twins[1]), strict=True):
        pd.testing.assert_frame_equal(one, other, check_exact=True)
    for reader in twins:
        reader.close()


def _numbers(reader: Reader) -> list[pd.DataFrame]:
    selection = select(reader, Filter())
    asked = PlotOptions()
    tables = [kind.measure(reader, kind.part(selection, asked), asked) for kind in TABLES.values()]
    curves = [
        tabulate_curves(measure_curves(reader, selection, "loss", PlotOptions(statistic=statistic)))
        for statistic in Statistic
    ]
    cartpole = selection.only(["cartpole"])
    spectra = measure_spectra(reader, cartpole, "cartpole").table
    portraits = tabulate_portraits(measure_portraits(reader, cartpole, "cartpole"))
    return [*tables, *curves, spectra, portraits]


PATH = "policy.information"
BRIEF = {"env": {"horizon": 40}}
FRESH = {"policy": {"information": "fresh"}}


@pytest.fixture(scope="module")
def added(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a database with trials of before the field, as they were written, and of after."""
    url = f"sqlite:///{tmp_path_factory.mktemp('added')}/results.db"
    fill(url, make_grid(("pendulum",), ("d_optimal", "random"), range(5), **BRIEF))
    fill(url, make_grid(("pendulum",), ("d_optimal",), range(5), **BRIEF, **FRESH))
    return url


@pytest.fixture
def stored(added: str) -> Iterator[Reader]:
    with Reader.open(added) as opened:
        yield opened


def information(reader: Reader, **where: object) -> list[object]:
    """Return the values of the entries of D-optimal that a condition accepts."""
    wanted = Filter(policies=("d_optimal",), where=where)
    return [entry.config.config["policy"]["information"] for entry in select(reader, wanted).stored]


def test_a_condition_tells_the_values_apart(stored: Reader) -> None:
    assert information(stored, **{PATH: "accumulated"}) == ["accumulated"]
    assert information(stored, **{PATH: "fresh"}) == ["fresh"]
    assert sorted(map(str, information(stored))) == ["accumulated", "fresh"]
    both = information(stored, **{"policy.refresh_every": 1})
    assert sorted(both) == ["accumulated", "fresh"]
    with pytest.raises(AnalysisError, match='stored are "accumulated", "fresh"'):
        select(stored, Filter(where={PATH: "old"}))


def test_the_values_are_grouped_and_compared(stored: Reader) -> None:
    selection = select(stored, Filter(group_by=(PATH,)))
    assert selection.labels == ("information=accumulated", "information=fresh")
    assert [len(entry.trials) for entry in selection.entries] == [5, 5]
    table = compare_policies(stored, selection)
    assert list(table.variant) == ["information=fresh"]
    assert list(table.reference) == ["information=accumulated"]


def test_the_usual_value_stands_for_the_policy(stored: Reader) -> None:
    entries = select(stored, Filter()).entries
    found = [entry.config.config["policy"].get("information") for entry in entries]
    assert found == ["accumulated", None]
    assert [entry.label for entry in entries] == ["D-optimal", "random"]
    old, new = sorted(stored.configs(), key=lambda one: "fresh" in one.label)[0::2]
    assert usual_values(old.config)[PATH] == "accumulated"
    assert nearness(old) > nearness(new)


def test_a_new_criterion_replaces_the_old_one_of_the_same_configuration(tmp_path: Path) -> None:
    noisy = {"learner": {"name": "ekf", "noise_variance": 0.5}}
    with filled(
        tmp_path, make_grid(("pendulum",), ("exact", "d_optimal"), range(2), **BRIEF, **noisy)
    ) as reader:
        configs = reader.configs()
    exact = next(config for config in configs if config.policy == "exact")
    content = {k: v for k, v in exact.config.items() if k != "criterion_version"}
    assert len(content) == len(exact.config) - 1
    old = type(exact)(**{**vars(exact), "config": json.loads(json.dumps(content))})
    assert newest([*configs, old]) == configs
    assert newest([old]) == [old]


def config(section: str, **content: object) -> ConfigRow:
    stored = json.loads(TrialSpec.from_names("pendulum", "random").config_json)
    values = dict.fromkeys((field.name for field in dataclasses.fields(ConfigRow)), 0)
    return ConfigRow(**cast(dict[str, Any], {**values, "config": {**stored, section: content}}))


def test_a_real_plant_is_farther_from_the_defaults_whatever_its_settings() -> None:
    env = json.loads(TrialSpec.from_names("pendulum", "random").config_json)["env"]
    ideal, real = config("env", **env), config("env", **env, plant={"name": "real"})
    delayed = config("env", **env, plant={"name": "real", "delay": 1})
    assert nearness(ideal) > nearness(real) > nearness(delayed)


@pytest.mark.parametrize("section", ["env", "policy", "model", "learner"])
@pytest.mark.parametrize("source", [{}, {"source": "0" * 16}])
def test_a_stranger_s_class_does_not_run(
    source: dict[str, str], section: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "never_run.py").write_text("raise SystemExit('it has run')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    row = config(section, _target_="never_run.Thing", **source)
    with pytest.raises(SpecificationError, match=r"never_run\.Thing"):
        simulated_trial(row, 0)
    with pytest.raises(SpecificationError, match=r"never_run\.Thing"):
        learned_model(cast(Reader, None), row, 0)
    assert is_possible(row, row), "nothing is known against it"
