"""All that a database holds, but for the numbers that it gives itself."""

from __future__ import annotations

from orchestrate.store import Reader

ALL = (
    "SELECT c.config_key, r.trial_key, r.seed, r.status, r.attempt, r.n_steps, r.final_loss, "
    "r.best_loss, r.diverged_at, r.wall_seconds, r.node, l.token, e.hash FROM trial r "
    "JOIN config c ON c.config_id = r.config_id "
    "LEFT JOIN launch l ON l.launch_id = r.launch_id LEFT JOIN error e ON e.error_id = r.error_id",
    "SELECT r.trial_key, s.t, s.loss, s.reachable_loss, s.plan_us, s.learn_us, s.evaluate_us "
    "FROM step s JOIN trial r ON r.trial_id = s.trial_id",
    "SELECT r.trial_key, p.dtype, p.states_shape, p.states, p.inputs_shape, p.inputs, "
    "p.parameters_shape, p.parameters FROM trajectory p JOIN trial r ON r.trial_id = p.trial_id",
    "SELECT r.trial_key, a.attempt, a.outcome, a.cause, a.node, a.pid, a.claimed, a.started, "
    "a.ended, a.wall_seconds, l.token, e.hash FROM attempt a "
    "JOIN trial r ON r.trial_id = a.trial_id JOIN launch l ON l.launch_id = a.launch_id "
    "LEFT JOIN error e ON e.error_id = a.error_id",
    "SELECT token, state, started, ended, host, pid, argv, overrides, git_commit, git_dirty, "
    "versions, exit_code FROM launch",
    "SELECT config_key, env, policy, model, learner, width, depth, horizon, dt, gamma, config_json "
    "FROM config",
    "SELECT hash, type, message, traceback FROM error",
    "SELECT r.trial_key, b.t, b.measure, b.value FROM assessment b "
    "JOIN trial r ON r.trial_id = b.trial_id",
    "SELECT r.trial_key, p.attempt - r.attempt, p.loss, p.reachable_loss, p.plan_us, p.learn_us, "
    "p.evaluate_us FROM curve p JOIN trial r ON r.trial_id = p.trial_id",
)


def everything(url: str) -> list[list[str]]:
    """Return all that is in a database, without the numbers that it gave itself."""
    with Reader.open(url) as reader:
        return [sorted(repr(_plain(row)) for row in reader.rows(sql)) for sql in ALL]


def _plain(row: tuple[object, ...]) -> list[object]:
    return [bytes(x) if isinstance(x, memoryview) else x for x in row]
