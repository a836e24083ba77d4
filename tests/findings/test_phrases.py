"""The numbers in sentences of the pages are those of the tables, each rounded once."""

from __future__ import annotations

import pytest

from tests.findings.report_columns import (
    ALL,
    FINDINGS,
    beyond,
    budgets,
    claims,
    each,
    horizons,
    learners,
    same,
    same_interval,
    texts,
)

PHRASES = [
    (
        "5, 10 and 20 steps give the ratios {}, {} and {}",
        texts(*horizons("quadrotor", 5, None, 20)),
    ),
    (
        "uniform inputs on the arm under `adam_replay` ({}). On the pendulum white inputs end at "
        "{} times the loss of D-optimal ones under `adam_window`, but at {} times under",
        same(("arm", "uniform, adam_replay"), *learners("pendulum", "random")[:2]),
    ),
    (
        "held random inputs are better under both Adam learners ({}, {}) and no different under",
        same(*learners("arm", "held random")[:2]),
    ),
    (
        "small under `adam_window` ({}, 400 seeds), {} under `adam_replay`, and not settled under "
        "`gauss_newton` ({}, 20 seeds).",
        [
            same_interval("cartpole", "periodic"),
            *same(("cartpole", "periodic, adam_replay")),
            same_interval("cartpole", "periodic, gauss_newton"),
        ],
    ),
    (
        "under the curve of uniform inputs is {} of theirs, and they need {:.0f} steps against "
        "{:.0f} to stay",
        [
            same_interval("pendulum", "uniform", "same_auc"),
            *claims(*each("uniform", "pendulum"), ("pendulum", "D-optimal"), columns=("steps",)),
        ],
    ),
    (
        "the area of uniform inputs is {} and {} times as large.",
        texts(*learners("pendulum", "uniform")[1:], column="same_auc_ratio"),
    ),
    (
        "its ratio is {} on the quadrotor, {} on the pendulum and {} on the arm; on the cartpole "
        "it is not told apart ({}). Under both Adam learners it is worse there ({}, {}).",
        same(
            *each("look-ahead, gauss_newton", "quadrotor", "pendulum", "arm", "cartpole"),
            *learners("cartpole", "look-ahead")[:2],
        ),
    ),
    (
        "`gauss_newton` ends at {} (pendulum), {} (cartpole), {} (arm) and {} (quadrotor) times",
        texts(*each("D-optimal, gauss_newton", *ALL)),
    ),
    (
        "on the arm under both Adam learners ({} and {}) and worse on the cartpole under "
        "`adam_replay` ({}). On the quadrotor no difference is significant (`gauss_newton`: {}).",
        [
            *same(*learners("arm", "exact gain")[:2], ("cartpole", "exact gain, adam_replay")),
            same_interval("quadrotor", "exact gain, gauss_newton"),
        ],
    ),
    (
        "reachable set under `adam_window`: {} on the grid, {} on the states",
        [
            *same(("arm", "random")),
            *texts(("arm", "random"), column="same_reachable_loss_ratio"),
        ],
    ),
    (
        "median of the whole planning [µs] | {} | {} | {} | {} |",
        texts(*budgets(None, 1000, 500, 250), column="plan_us"),
    ),
    ("| ratio | {} | {} | {} | {} |", texts(*budgets(None, 1000, 500, 250))),
    (
        "On the arm the search takes {:.1f} ms of",
        [us / 1000 for us in claims(("arm", "look-ahead"), columns=("plan_us",))],
    ),
    (
        "look-ahead is below all rows: {} (pendulum), {} (cartpole), {} (arm) and {} (quadrotor),",
        texts(*each("look-ahead, gauss_newton", *ALL)),
    ),
    (
        "random features, D-optimal | {:.2f} | {:.2f} | {:.2f} | {:.2f} |",
        beyond(*each("d optimal, rff", *ALL)),
    ),
    (
        "random features, held random | {:.2f} n.s. | {:.2f} n.s. | {:.2f} | {:.2f} n.s. |",
        beyond(*each("random held, rff", *ALL)),
    ),
    (
        "Gaussian process, entropy | {:.2f} | {:.2f} | {:.2f} | {:.2f} |",
        beyond(*each("gaussian process", *ALL)),
    ),
    (
        "Gaussian process, held random | {:.2f} n.s. | {:.2f} | {:.2f} n.s. | {:.2f} |",
        beyond(*each("random held, gaussian process", *ALL)),
    ),
    (
        "Adam on all samples (one step), D-optimal | {:.2f} | {:.2f} | {:.2f} n.s. | {:.2f} |",
        beyond(*each("d optimal, adam replay", *ALL)),
    ),
    (
        "Kalman filter, D-optimal | {:.1f} | {:.1f} | {:.2f} | {:.1f} n.s. |",
        beyond(*each("d optimal, ekf", *ALL)),
    ),
    (
        "disagreement of five (MAX) | {:.2f} n.s. | {:.2f} | {:.2f} | {:.2f} |",
        beyond(*each("max", *ALL)),
    ),
    ("by a factor of {:.1f}, compared", beyond(("pendulum", "random held"))),
    (
        "all samples, [{:.2f}, {:.2f}], contains 1.",
        beyond(("pendulum", "d optimal, adam replay"), columns=("loss_low", "loss_high")),
    ),
    (
        "the Gaussian process has {:.2f} times",
        beyond(("arm", "gaussian process"), columns=("reachable_loss_ratio",)),
    ),
    (
        "its ratio is {:.2f} on the grid and {:.2f} on the reachable set (with 100 seeds {} and "
        "{}).",
        beyond(("arm", "random"), columns=("loss_ratio", "reachable_loss_ratio"))
        + texts(("arm", "random"))
        + texts(("arm", "random"), column="reachable_loss_ratio"),
    ),
    (
        "the trace ({:.2f}), A-optimal inputs ({:.2f}) and the ascent ({:.2f}) are slightly",
        beyond(("arm", "trace"), ("arm", "a optimal"), ("arm", "gradient")),
    ),
    (
        "worse on the pendulum ({:.1f}, {:.1f}, {:.1f}) and on the cartpole ({:.1f}, {:.1f}, "
        "{:.1f}). On the arm E-optimal inputs are better ({:.2f}).",
        beyond(
            *((env, f"{one}") for env in ALL[:2] for one in ("a optimal", "e optimal", "task")),
            ("arm", "e optimal"),
        ),
    ),
    ("the look-ahead is better ({:.2f}).", beyond(("drifting_pendulum", "lookahead"))),
    (
        "with 0.99 it ends at {:.2f} times its loss.",
        beyond(("drifting_pendulum", "d optimal, ekf, forgetting=0.99")),
    ),
    (
        "at {:.2f} times the loss of D-optimal ones; the exact gain ends at {:.2f}.",
        beyond(("chain", "random"), ("chain", "exact")),
    ),
    (
        "D-optimal inputs coincide ({:.3f}). Held random inputs end at {:.1f} times their loss, "
        "white inputs at {:.0f} times.",
        beyond(*(("mass_spring", one) for one in ("linear", "random held", "random"))),
    ),
]


@pytest.mark.parametrize(("phrase", "values"), PHRASES, ids=[phrase for phrase, _ in PHRASES])
def test_numbers_of_the_findings_are_rounded_once(phrase: str, values: list[float]) -> None:
    assert phrase.format(*values) in FINDINGS
