"""The trials that a figure or a table is about, and those that are missing from it."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from analysis.choice import REFERENCE, Candidate, Filter, choose
from analysis.errors import AnalysisError
from analysis.gaps import Compatible, Gap, absent_cells, is_possible
from orchestrate.store import Cell, Reader, TrialRow

FINISHED = ("done", "diverged")

ENVIRONMENTS = (
    *("pendulum", "cartpole", "arm", "quadrotor"),
    *("drifting_pendulum", "chain", "mass_spring"),
)
"""The paper's order; other environments follow by name."""

POLICIES = (
    *(REFERENCE, "oracle", "uniform", "periodic", "random", "random_held", "random_sphere"),
    *("prbs", "multisine", "chirp"),
    *("max", "gaussian_process", "gradient", "linear"),
    *("lookahead", "exact", "trace", "trace_linearized", "a_optimal", "e_optimal", "task"),
)
"""Order of legends and tables; other policies follow by name."""


@dataclass(frozen=True)
class Entry:
    """One configuration with its registered trials, ordered by seed."""

    cell: Cell
    trials: tuple[TrialRow, ...]

    @property
    def finished(self) -> tuple[TrialRow, ...]:
        return tuple(trial for trial in self.trials if trial.status in FINISHED)

    def final_losses(self) -> dict[int, float]:
        """Return the final loss by seed of the trials that did not diverge."""
        return {
            trial.seed: trial.final_loss
            for trial in self.trials
            if trial.status == "done" and trial.final_loss is not None
        }


@dataclass(frozen=True)
class Selection:
    """Entries in the order in which they are drawn, gaps, and sentences on what was left out.

    ``stored`` are all entries that the request allows, other widths and variants included.
    """

    entries: tuple[Entry, ...]
    gaps: tuple[Gap, ...] = ()
    notes: tuple[str, ...] = ()
    stored: tuple[Entry, ...] = ()

    @property
    def environments(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(entry.cell.env for entry in self.entries))

    @property
    def policies(self) -> tuple[str, ...]:
        return tuple(sorted({entry.cell.policy for entry in self.entries}, key=policy_rank))

    def of(self, environment: str) -> tuple[Entry, ...]:
        """Return the entries of one environment."""
        return tuple(entry for entry in self.entries if entry.cell.env == environment)

    def only(self, environments: Iterable[str], policies: Iterable[str] = ()) -> Selection:
        """Return the part about some environments and policies; no policies means all."""
        envs, names = set(environments), set(policies)

        def kept(env: str, policy: str) -> bool:
            return env in envs and (not names or policy in names)

        return Selection(
            tuple(entry for entry in self.entries if kept(entry.cell.env, entry.cell.policy)),
            tuple(gap for gap in self.gaps if kept(gap.env, gap.policy)),
            self.notes,
            tuple(entry for entry in self.stored if kept(entry.cell.env, entry.cell.policy)),
        )

    def compared(self) -> Selection:
        """Return the environments in which the reference policy has a final loss."""
        return self.only(
            entry.cell.env
            for entry in self.entries
            if entry.cell.policy == REFERENCE and entry.final_losses()
        )

    def fingerprint(self) -> str:
        """Return the SHA-256 of the selected trials, their outcome and what is missing."""
        content = [
            [entry.cell.config_key, *([t.trial_key, t.status, t.final_loss] for t in entry.trials)]
            for entry in self.entries
        ]
        gaps = [[gap.env, gap.policy, list(gap.seeds)] for gap in self.gaps]
        return hashlib.sha256(json.dumps([content, gaps]).encode()).hexdigest()


def policy_rank(policy: str) -> tuple[int, str]:
    """Return the sorting key of a policy."""
    return (POLICIES.index(policy) if policy in POLICIES else len(POLICIES), policy)


def environment_rank(environment: str) -> tuple[int, str]:
    """Return the sorting key of an environment."""
    known = environment in ENVIRONMENTS
    return (ENVIRONMENTS.index(environment) if known else len(ENVIRONMENTS), environment)


def select(reader: Reader, wanted: Filter, compatible: Compatible = is_possible) -> Selection:
    """Return the trials that stand for each environment and policy.

    Raises
    ------
    AnalysisError
        When nothing fits, a name is unknown, or several configurations fit equally well.
    """
    cells = list(reader.cells())
    _check_names("environment", wanted.environments, {cell.env for cell in cells})
    _check_names("policy", wanted.policies, {cell.policy for cell in cells})
    wanted.check_where(cells)
    accepted = newest([cell for cell in cells if wanted.accepts(cell)])
    if not accepted:
        raise AnalysisError(
            f"No configuration in {reader.safe_url} fits the request, "
            f"it holds {len(cells)} in all: run the grid first, or ask for less."
        )
    trials = {cell.config_key: tuple(reader.trials(cell.config_key)) for cell in accepted}
    chosen = choose(Candidate(cell, len(trials[cell.config_key])) for cell in accepted)
    chosen.sort(key=lambda cell: (environment_rank(cell.env), policy_rank(cell.policy)))
    entries = tuple(Entry(cell, trials[cell.config_key]) for cell in chosen)
    return Selection(
        entries,
        tuple(_gaps(entries, compatible)),
        tuple(_notes(accepted, chosen)),
        tuple(Entry(cell, trials[cell.config_key]) for cell in accepted),
    )


def newest(cells: list[Cell]) -> list[Cell]:
    """Return the cells of the newest code version: numbers of different versions do not mix.

    Of those with a task, whose assessments have a version of their own, the newest of these.
    """
    code = max((cell.config.get("code_version", 0) for cell in cells), default=0)
    assessment = max((_assessment_version(cell) or 0 for cell in cells), default=0)
    return [
        cell
        for cell in cells
        if cell.config.get("code_version", 0) == code
        and _assessment_version(cell) in (None, assessment)
    ]


def _assessment_version(cell: Cell) -> int | None:
    return int(cell.config.get("assessment_version", 1)) if cell.config.get("task") else None


def _check_names(kind: str, given: Iterable[str], stored: set[str]) -> None:
    for name in given:
        if name not in stored:
            raise AnalysisError(
                f"The database has no trial of {kind} '{name}', "
                f"choose one of {', '.join(sorted(stored)) or 'none: it is empty'}."
            )


def _gaps(entries: tuple[Entry, ...], compatible: Compatible) -> Iterable[Gap]:
    seeds: dict[str, set[int]] = {}
    for entry in entries:
        seeds.setdefault(entry.cell.env, set()).update(trial.seed for trial in entry.trials)
    for entry in entries:
        expected = seeds[entry.cell.env]
        missing = expected - {trial.seed for trial in entry.finished}
        if missing:
            state = {trial.seed: trial.status for trial in entry.trials}
            states = Counter(state.get(seed, "not registered") for seed in missing)
            text = ", ".join(f"{count} {name}" for name, count in sorted(states.items()))
            yield Gap(entry.cell.env, entry.cell.policy, tuple(sorted(missing)), text)
    for env, policy in absent_cells([entry.cell for entry in entries], compatible):
        expected = seeds[env]
        yield Gap(env, policy, tuple(sorted(expected)), f"{len(expected)} not registered")


def _notes(accepted: list[Cell], chosen: list[Cell]) -> Iterable[str]:
    kept = {cell.config_key for cell in chosen}
    left = Counter(cell.env for cell in accepted if cell.config_key not in kept)
    for env, count in sorted(left.items()):
        yield f"{env}: {count} other stored configurations are not part of this (see --where)"
