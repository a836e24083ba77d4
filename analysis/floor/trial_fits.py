"""Offline fits of the models of stored trials, to uniform and to recorded samples."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import pandas as pd

from analysis.data.learned_model import simulated_trial
from analysis.data.trial_selection import Entry, Selection
from analysis.errors import AnalysisError
from dopt.offline_fit import OfflineFit, can_be_fitted, fit_offline
from dopt.samples import Samples, recorded_samples, uniform_samples
from dopt.spec.trial import TrialSpec
from orchestrate.store import Reader

Say = Callable[[str], None]


@dataclass(frozen=True)
class TrialLosses:
    """Grid losses of a trial: offline fits to uniform and recorded samples, and online."""

    entry: Entry
    seed: int
    trial_key: str
    floor: OfflineFit
    offline: OfflineFit
    online: float

    def row(self) -> dict[str, object]:
        """Return the row of the CSV; the factors multiply to online / floor."""
        config = self.entry.config
        return {
            "env": config.env,
            "policy": config.policy,
            "label": self.entry.label,
            "seed": self.seed,
            "trial_key": self.trial_key,
            "floor": self.floor.loss,
            "exploration_factor": self.offline.loss / self.floor.loss,
            "offline": self.offline.loss,
            "learner_factor": self.online / self.offline.loss,
            "online": self.online,
            "floor_steps": self.floor.steps,
            "floor_converged": self.floor.converged,
            "offline_steps": self.offline.steps,
            "offline_converged": self.offline.converged,
        }


def with_offline_fit(selection: Selection) -> Selection:
    """Return the entries whose model has an offline fit; the others are named in the notes.

    Raises
    ------
    AnalysisError
        If there is none.
    """
    held = [entry for entry in selection.entries if entry.trials]
    kept = [entry for entry in held if can_be_fitted(_specification(entry, 0).model)]
    left = [entry for entry in held if entry not in kept]
    if left and not kept:
        raise AnalysisError(
            f"No selected trial has a model with an offline fit, they have "
            f"{', '.join(sorted({entry.config.model for entry in left}))}: choose trials with "
            f"--where model.name=mlp."
        )
    notes = tuple(
        f"{one.config.env} × {one.config.policy}: model '{one.config.model}' has no offline fit"
        for one in left
    )
    return replace(selection, entries=tuple(kept), notes=(*selection.notes, *notes))


def fit_trials(
    reader: Reader, selection: Selection, ridge: float, workers: int, say: Say
) -> pd.DataFrame:
    """Return the losses of all trials that are done, one row for each.

    The fits run side by side in threads: compiled code leaves the interpreter free.
    """
    pool = ThreadPoolExecutor(workers)
    try:
        fits = _Fits(pool, ridge)
        waiting = [(entry, list(_submit(reader, entry, fits))) for entry in selection.entries]
        rows = []
        for entry, trials in waiting:
            rows += [trial().row() for trial in trials]
            say(f"{entry.config.env}, {entry.label}: {len(trials)} trials fitted")
    finally:  # after an interruption or an error nobody waits for what has not begun
        pool.shutdown(cancel_futures=True)
    return pd.DataFrame(rows)


class _Fits:
    """Fits under way; one to uniform samples is shared by the trials for which it is the same."""

    def __init__(self, pool: ThreadPoolExecutor, ridge: float) -> None:
        self._pool, self._ridge = pool, ridge
        self._floors: dict[Hashable, Future[OfflineFit]] = {}

    def floor(self, spec: TrialSpec) -> Future[OfflineFit]:
        key = (spec.system, spec.model, spec.seed)
        if key not in self._floors:
            self._floors[key] = self.fit(spec, uniform_samples(spec))
        return self._floors[key]

    def fit(self, spec: TrialSpec, samples: Samples) -> Future[OfflineFit]:
        given = (spec, samples.states, samples.accelerations)
        return self._pool.submit(fit_offline, *given, inputs=samples.inputs, ridge=self._ridge)


def _submit(reader: Reader, entry: Entry, fits: _Fits) -> Iterator[Callable[[], TrialLosses]]:
    """Start the fits of an entry; yield what waits for each of its trials."""
    online = entry.final_losses()
    for trial in entry.trials:
        if trial.seed not in online:
            continue
        spec = _specification(entry, trial.seed)
        stored = reader.trajectory(entry.config.config_key, trial.seed)
        floor = fits.floor(spec)
        offline = fits.fit(spec, recorded_samples(spec.system, stored.states, stored.inputs))
        known = (entry, trial.seed, trial.trial_key)
        yield _awaited(known, floor, offline, online[trial.seed])


def _awaited(
    known: tuple[Entry, int, str],
    floor: Future[OfflineFit],
    offline: Future[OfflineFit],
    online: float,
) -> Callable[[], TrialLosses]:
    return lambda: TrialLosses(*known, floor.result(), offline.result(), online)


def _specification(entry: Entry, seed: int) -> TrialSpec:
    return simulated_trial(entry.config, seed)
