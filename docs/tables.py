"""``python docs/tables.py``: write the tables of the pages from CSV files and from the code.

Numbers come from the CSV files of the studies, the rest from ``code_tables.py``. A table
stands in a page between ``<!-- table: NAME -->`` and ``<!-- end -->``. ``--check`` writes nothing
and fails where a page differs from its sources.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1]))

import code_tables
from code_tables import markdown

from analysis.stats.curves import band, standard_error
from analysis.stats.scores import compare
from analysis.style import number, plus_minus, share, within
from studies.conclusions import tables as conclusions
from studies.robots import tables as robots

DOCS = Path(__file__).parent
PAGES = (
    "compiled_plugins.md", "conclusions.md", "database.md", "figures.md", "findings.md",
    "method.md", "options.md", "plants.md", "robots.md", "structure.md", "tutorial.md",
    "wide_networks.md", "yardsticks.md", "../README.md",
)  # fmt: skip
ALL = ("pendulum", "cartpole", "arm", "quadrotor")
LEARNERS = ("adam_window", "adam_replay", "gauss_newton")
TITLES = {"d_optimal": "D-optimal", "random_held": "held random", "periodic_square": "square wave"}
BLOCK = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def read(name: str) -> pd.DataFrame:
    return pd.read_csv(DOCS / f"{name}.csv")


def geometric(values: pd.Series[float]) -> float:
    return float(np.exp(np.log(values).mean()))


def named(learner: str, policy: str) -> str:
    """Return the label of a policy in a report, which leaves out the paper's learner."""
    return policy if learner == "adam_window" else f"{policy}, {learner}"


def ratio(row: pd.Series[float], measure: str = "loss") -> str:
    return within(row[f"{measure}_ratio"], row[f"{measure}_low"], row[f"{measure}_high"])


def of_report(study: str, titles: dict[str, str], measure: str = "loss") -> str:
    """Return ratios with intervals from a report, a row for each variant."""
    report = read(f"{study}/report").set_index(["env", "variant"])
    rows = [
        [title, *(ratio(report.loc[env, variant], measure) for env in ALL)]
        for title, variant in titles.items()
    ]
    return markdown(["", *ALL], rows)


def summary() -> str:
    """Return final losses of the paper's grid, mean ± 2 standard errors."""
    table = read("summary").set_index(["env", "policy"])
    names = ("d_optimal", "uniform", "periodic", "random", "oracle")

    def cell(env: str, policy: str) -> str:
        if (env, policy) not in table.index:
            return "no eigenmode"
        row = table.loc[env, policy]
        return plus_minus(row.loss, row.loss_2se) if policy != "oracle" else number(row.loss, 2)

    rows = [[env, *(cell(env, name) for name in names)] for env in ALL]
    return markdown(["system", *(TITLES.get(name, name) for name in names)], rows)


def policies() -> str:
    """Return ratios to D-optimal inputs under three learners."""
    claims = read("claims/report").set_index(["env", "variant"])

    def cell(env: str, policy: str) -> str:
        found = [
            claims.loc[key]
            for one in LEARNERS
            if (key := (env, named(one, policy))) in claims.index
        ]
        parts = [
            number(row.same_loss_ratio) + ("" if row.same_loss_p_adjusted < 0.05 else " n.s.")
            for row in found
        ]
        return " / ".join(parts) or "–"

    names = ("uniform", "periodic", "random", "held random", "exact gain", "look-ahead")
    return markdown(["inputs", *ALL], [[name, *(cell(env, name) for env in ALL)] for name in names])


def aggregate() -> str:
    table = read("profiles/aggregate").set_index("variant")
    return markdown(
        ["inputs", "ratio", "systems"],
        [
            [name, within(row.ratio, row.low, row.high), row.systems]
            for name, row in table.loc[["uniform", "periodic", "random"]].iterrows()
        ],
    )


def learners() -> str:
    return of_report(
        "claims",
        {
            "`adam`": "D-optimal, adam",
            "`adam_replay`": "D-optimal, adam_replay",
            "`gauss_newton`": "D-optimal, gauss_newton",
            "`ekf`, λ = 0.001": "D-optimal, ekf",
            "`ekf`, λ = 0.1": "D-optimal, ekf, λ=0.1",
            "`ekf`, λ = 10": "D-optimal, ekf, λ=10",
        },
    )


def filter_against_window() -> str:
    claims = read("claims/report").set_index(["env", "variant"])
    return markdown(ALL, [[ratio(claims.loc[env, "D-optimal, ekf"]) for env in ALL]])


def horizons() -> str:
    claims = read("claims/report").set_index("variant").query("env == 'pendulum'")
    steps = {10: ", lookahead=10", 20: ", lookahead=20", 30: ", lookahead=30", 40: ", lookahead=40"}
    steps |= {49: "", 65: ", lookahead=65", 98: ", lookahead=98"}
    return markdown(
        ["steps", *map(str, steps)],
        [
            [
                f"`{learner}`",
                *(
                    number(claims.loc[named(learner, "look-ahead") + words, "same_loss_ratio"])
                    for words in steps.values()
                ),
            ]
            for learner in ("adam_window", "gauss_newton")
        ],
    )


def rivals() -> str:
    return of_report(
        "rivals",
        {
            "D-optimal": "D-optimal",
            "look-ahead": "look-ahead",
            "episodic agent of FLEX": "episodic plans",
            "receding horizon curiosity": "episodic plans, replan_every=10",
            "OPAX": "iCEM, criterion=sum",
        },
    )


def space_filling() -> str:
    return of_report(
        "space_filling",
        {
            "`idw`": "space filling",
            "`igs`": "space filling, criterion=igs",
            "`gsx`": "space filling, criterion=gsx",
            "held random": "held random",
            "random": "random",
        },
    )


def control() -> str:
    """Return shares of successful models after 100, 200 and 500 steps."""
    table = read("claims_control/report_control").set_index(["env", "variant", "t"])

    def cell(env: str, variant: str) -> str:
        keys = [(env, variant, t) for t in (100, 200, 500)]
        known = keys[0] in table.index
        return " / ".join(share(table.loc[key, "success"]) for key in keys if known) or "–"

    names = ("D-optimal", "look-ahead", "uniform", "periodic", "held random", "random")
    rows = [
        [f"{name}, `{learner}`", *(cell(env, named(learner, name)) for env in ALL)]
        for name in names
        for learner in ("adam_window", "gauss_newton")
    ]
    return markdown(["inputs, learner", *ALL], rows)


def best() -> str:
    losses, times = read("best"), read("step_times").set_index("configuration")
    times = times.loc["iCEM, domain=box, gauss_newton, ensemble"].groupby("env")

    def cell(env: str, column: str) -> str:
        logarithms = np.log(losses.loc[losses.env == env, column])
        half = stats.t.ppf(0.975, len(logarithms) - 1) * stats.sem(logarithms)
        return within(
            *np.exp([logarithms.mean(), logarithms.mean() - half, logarithms.mean() + half])
        )

    rows = [
        [title, *(cell(env, column) for env in ALL)]
        for title, column in (
            ("loss", "final_loss"),
            ("loss of one network", "one_network_loss"),
            ("loss, tuned for each system", "tuned_loss"),
        )
    ]
    mean, longest = times.mean_us.mean(), times.longest_us.max()
    rows.append(["step, mean [µs]", *(f"{mean[env]:,.0f}" for env in ALL)])
    rows.append(["longest step [µs]", *(f"{longest[env]:,.0f}" for env in ALL)])
    return markdown(["", *ALL], rows)


def best_control() -> str:
    table = read("best_control")

    def cell(env: str, t: int) -> str:
        successes = table.loc[table.env == env, f"after_{t}"]
        found = stats.binomtest(int(successes.sum()), len(successes))
        low, high = found.proportion_ci(method="wilson")
        return f"{share(successes.mean())} [{share(low)}, {share(high)}]"

    rows = [[env, *(cell(env, t) for t in (100, 200, 500))] for env in ALL if env in set(table.env)]
    return markdown(["system", "after 100 steps", "after 200", "after 500"], rows)


def best_within() -> dict[float, pd.Series[float]]:
    """Return losses of the best configuration by the limit of its mean step [ms]."""
    points = read("pareto/figure6_pareto")
    points["name"] = points.policy_label + ", " + points.learner_label
    losses, times = (
        points.pivot_table(index="name", columns="env", values=column).dropna()
        for column in ("loss", "us_per_step")
    )
    over_systems, slowest = np.log(losses).mean(axis=1), times.max(axis=1)
    limits = (0.2, 1.0, 5.0, 10.0)
    return {one: losses.loc[over_systems[slowest <= 1000 * one].idxmin()] for one in limits}


def pareto() -> str:
    rows = [
        [f"{limit:g}", str(losses.name), *(number(losses[env]) for env in ALL)]
        for limit, losses in best_within().items()
    ]
    return markdown(["mean step at most [ms]", "configuration", *ALL], rows)


def time_of_a_step() -> str:
    """Return the configurations of :func:`pareto` with the steps of the slowest system."""
    times, rows = read("step_times").set_index("configuration"), []
    for losses in best_within().values():
        steps = times.loc[str(losses.name)].groupby("env")
        mean, longest = steps.mean_us.mean().max(), steps.longest_us.max().max()
        rows.append([number(mean / 1000), number(longest / 1000), str(losses.name)])
        rows[-1] += [number(losses[env]) for env in ALL]
    return markdown(["mean [ms]", "worst [ms]", "policy, learner", *ALL], rows)


def adam_replay() -> str:
    keys = ["policy", "steps", "learning_rate"]
    rows = [
        [
            f"{TITLES[str(policy)]}, {steps}, {rate:g}",
            *(number(geometric(part.loc[part.env == env, "final_loss"])) for env in ALL),
        ]
        for (policy, steps, rate), part in read("adam_replay").groupby(keys)
    ]
    return markdown(["inputs, steps, rate", *ALL], rows)


def sensitivity() -> str:
    """Return losses at the ends and at the paper's value of each setting."""
    keys = ["setting", "policy", "value"]
    rows = [
        [
            f"`{setting}` = {value:g}",
            TITLES.get(policy, policy),
            *(number(part.set_index("env").loss[env]) for env in ALL),
        ]
        for (setting, policy, value), part in read("sensitivity/figure8_sensitivity").groupby(keys)
        if policy in {"d_optimal", "random"} and set(ALL) <= set(part.env)
    ]
    return markdown(["setting", "inputs", *ALL], rows)


def periodic() -> str:
    table, envs = read("periodic").set_index(["policy", "env"]), ALL[:3]
    rows = [
        [f"{title}, {words}", *(ratio(table.loc[policy, env], measure) for env in envs)]
        for words, measure in (("grid", "loss"), ("reachable set", "reachable_loss"))
        for title, policy in (("sine", "periodic"), ("square wave", "periodic_square"))
    ]
    return markdown(["inputs, loss", *envs], rows)


def models() -> str:
    """Return ratios of other models and learners to the network with D-optimal inputs."""
    report = read("beyond/report").set_index(["env", "variant"])
    titles = {
        "random features, D-optimal": "d optimal, rff",
        "random features, held random": "random held, rff",
        "Gaussian process, entropy": "gaussian process",
        "Gaussian process, held random": "random held, gaussian process",
        "disagreement of five networks (MAX)": "max",
        "exact gain": "exact",
        "A-optimal": "a optimal",
        "E-optimal": "e optimal",
        "task-optimal": "task",
    }

    def cell(env: str, variant: str) -> str:
        row = report.loc[env, variant]
        return number(row.loss_ratio) + ("" if row.loss_p_adjusted < 0.05 else " n.s.")

    return markdown(
        ["model, inputs", *ALL],
        [[title, *(cell(env, variant) for env in ALL)] for title, variant in titles.items()],
    )


def unknown_gain() -> str:
    table = read("unknown_gain")

    def losses(env: str, model: str, learner: str) -> pd.DataFrame:
        rows = table[(table.env == env) & (table.model == model) & (table.learner == learner)]
        return rows.pivot_table(index="seed", columns="policy", values="final_loss")

    rows = []
    for env in ("pendulum", "cartpole"):
        for model in ("affine", "black_box"):
            for learner in ("adam_window", "adam_replay", "adam_replay ×100", "gauss_newton"):
                known = losses(env, "mlp", learner).d_optimal
                own = losses(f"{env}_unknown_gain", model, learner)
                means = [geometric(one) for one in (known, own.d_optimal, own.random)]
                cells = [*means, geometric(own.d_optimal / known), means[1] / means[2]]
                rows.append([env, f"`{model}`", f"`{learner}`", *map(number, cells)])
    head = ["system", "model", "learner", "D-optimal, effect known", "D-optimal", "random"]
    return markdown([*head, "times known", "times random"], rows)


def integrators(name: str = "integrators") -> str:
    table = read(name)

    def cells(env: str) -> list[str]:
        found = []
        for integrator in ("euler", "rk4"):
            rows = table[(table.env == env) & (table.integrator == integrator)]
            losses = rows.pivot_table(index="seed", columns="policy", values="final_loss")
            found.append(number(geometric(losses.d_optimal)))
            for policy in ("random", "uniform", "periodic"):
                if policy not in losses:
                    found.append("–")
                    continue
                gaps = np.log(losses[policy] / losses.d_optimal)
                text = number(float(np.exp(gaps.mean())))
                found.append(text if stats.ttest_1samp(gaps, 0).pvalue < 0.01 else f"{text} n.s.")
        return found

    head = [
        f"{word}, {integrator}"
        for integrator in ("Euler", "RK4")
        for word in ("D-optimal", "random", "uniform", "periodic")
    ]
    return markdown(["system", *head], [[env, *cells(env)] for env in ALL])


def integrators_gauss_newton() -> str:
    return integrators("integrators_gauss_newton")


def calibration() -> str:
    table = read("calibration").set_index(["model", "learner", "policy", "env"]).sort_index()
    names = [("linear", "ekf"), ("mlp", "gauss_newton"), ("mlp", "ekf"), ("mlp", "adam_window")]
    rows = []
    for model, learner in names:
        for policy in ("d_optimal", "random"):
            found = [table.loc[(model, learner, policy, env)] for env in ALL]
            cells = [f"{share(one.grid_covered)} / {share(one.reachable_covered)}" for one in found]
            if set(cells) != {"– / –"}:
                rows.append([f"`{model}`, `{learner}`", TITLES.get(policy, policy), *cells])
    return markdown(["model, learner", "inputs", *ALL], rows)


def limits() -> str:
    keys, rows = ["env", "policy", "learner"], []
    for (env, policy, learner), part in read("limits").groupby(keys, sort=False):
        free, kept = (part[part.enforced == enforced] for enforced in (False, True))
        shares = [f"{100 * one.violations.sum() / one.n_steps.sum():.2g} %" for one in (free, kept)]
        losses = [geometric(one.final_loss) for one in (free, kept)]
        cells = [*shares, number(kept.worst.max()), *map(number, (*losses, losses[1] / losses[0]))]
        rows.append([env, f"`{policy}`", f"`{learner}`", *cells])
    head = ["system", "policy", "learner", "beyond, without", "beyond, with", "farthest"]
    return markdown([*head, "loss without", "loss with", "with / without"], rows)


def noisy_angle() -> str:
    rows = []
    for (known, learner), part in read("noisy_angle").groupby(["known", "learner"], sort=False):
        losses = part.pivot_table(index="seed", columns="policy", values="final_loss")
        if {"d_optimal", "random"} <= set(losses):
            means = [geometric(losses.d_optimal), geometric(losses.random)]
            rows.append([known, learner, *map(number, (*means, means[0] / means[1]))])
    rows.sort(key=lambda row: (row[0] != "state", row[1]))
    return markdown(["known", "learner", "D-optimal", "random", "D-optimal / random"], rows)


def noisy_angle_expected() -> str:
    rows = [
        [str(name), number(geometric(part.final_loss)), number(geometric(part.expected))]
        for name, part in read("noisy_angle_expected").groupby("inputs", sort=False)
    ]
    return markdown(["inputs", "loss", "left by 1° of noise in the angle alone"], rows)


def of_study(module: str, name: str) -> str:
    """Return all tables of a published experiment, as its study prints them."""
    study = importlib.import_module(f"studies.yardsticks.{module}")
    return "\n".join(f"{one.markdown()}\n" for one in study.tables(read(f"yardsticks/{name}")))


def flex_table1() -> str:
    return of_study("swing_up", "flex_table1")


def flex_table1_agents() -> str:
    return of_study("swing_up", "agents/flex_table1")


def flex_table3() -> str:
    return of_study("pendulums", "flex_table3")


def flex_star() -> str:
    return of_study("star", "flex_star")


def active_sysid() -> str:
    return of_study("disk", "active_sysid")


def flex_example() -> str:
    """Return final losses and paired ratios to random inputs, with intervals."""
    losses = read("yardsticks/flex_example").pivot_table(
        index="seed", columns="policy", values="final_loss"
    )

    def interval(values: pd.Series[float]) -> str:
        found = band(np.log(values.to_numpy())[:, None])
        return within(*(float(np.exp(one[0])) for one in (found.centre, found.low, found.high)))

    rows = [
        [name, interval(losses[name]), interval(losses[name] / losses.random)]
        for name in ("d_optimal", "random_held")
    ]
    rows.append(["random", interval(losses.random), "–"])
    return markdown(["policy", "loss [rad/s²]", "by random inputs"], rows)


def mujoco() -> str:
    """Return ratios to random inputs on both sets, in brackets their 95 % intervals."""
    report = read("mujoco/report").set_index(["env", "variant"])
    envs = ("pendulum", "cartpole", "acrobot", "reacher")
    rows = []
    for words, measure in (("grid", "loss"), ("reachable set", "reachable_loss")):
        cells = [number(report.loc[f"mujoco_{env}", "random"][measure]) for env in envs]
        rows.append([f"random, {words}: loss", *cells])
        for variant in ("D-optimal", "held random", "look-ahead"):
            cells = [ratio(report.loc[f"mujoco_{env}", variant], measure) for env in envs]
            rows.append([f"{variant}, {words}", *cells])
    return markdown(["inputs", *envs], rows)


def sketch() -> str:
    """Return losses with the sketch beside exact ones, compared as in all other tables."""
    losses = read("sketch_losses").set_index(["env", "width", "form", "seed"])
    rows = []
    for (env, width), part in losses.groupby(["env", "width"]):
        pairs = part.final_loss.droplevel(["env", "width"]).unstack("form")
        exact, approximate = pairs["dual"].to_numpy(), pairs["sketch"].to_numpy()
        found = compare(approximate, exact, np.random.default_rng(0))
        means = [f"{x.mean():.2f} ± {2 * standard_error(x):.2f}" for x in (exact, approximate)]
        rows.append([str(env), str(width), *means, f"{found.ratio:.2f}", f"{found.p_value:.2f}"])
    return markdown(["system", "width", "exact", "sketch", "ratio", "p"], rows)


def long_trials() -> str:
    """Return times of a step and memory of long trials, at the first tenth and at the last."""
    table, rows = read("scaling").query("against == 'tenth'"), []
    for (trial, form, q, steps), part in table.groupby(
        ["trial", "form", "parameters", "steps"], sort=False
    ):
        first, last = part.iloc[0], part.iloc[-1]
        rows.append([f"{trial}, `{form}`", f"{q:,}", f"{steps:,}"])
        times = first.step_us, last.step_us, part.step_us.min(), part.step_us.max()
        rows[-1] += [f"{one:,.0f}" for one in times]
        rows[-1] += [f"{first.peak:,.0f}", f"{last.peak:,.0f}", f"{last.rows:,.1f}"]
    head = ["trial", "parameters", "steps", "first tenth [µs]", "last", "quickest", "slowest"]
    return markdown([*head, "peak after a tenth [MiB]", "at the end", "record"], rows)


def step_costs() -> str:
    """Return the cost of a step by each size, with its exponent, and its 95 % interval."""
    table, rows = read("scaling").query("against != 'tenth'"), []
    for (against, form), part in table.groupby(["against", "form"], sort=False):
        x, y = np.log(part["size"]), np.log(part.step_us)
        found = stats.linregress(x, y)
        half = stats.t.ppf(0.975, len(x) - 2) * found.stderr
        last = (y.iloc[-1] - y.iloc[-2]) / (x.iloc[-1] - x.iloc[-2])
        slopes = found.slope, found.slope - half, found.slope + half, last
        fitted, low, high, end = (f"{round(one, 2) + 0.0:.2f}" for one in slopes)
        words = [f"{row['size']:,}: {row.step_us:,.0f}" for _, row in part.iterrows()]
        rows.append([str(against), f"`{form}`", "; ".join(words), f"{fitted} [{low}, {high}]", end])
    return markdown(["size", "form", "step [µs]", "exponent", "of the last two"], rows)


TABLES: dict[str, Callable[[], str]] = {
    made.__name__: made
    for made in (
        policies, aggregate, learners, filter_against_window, horizons, rivals, space_filling,
        control, best, best_control, pareto, time_of_a_step, summary, adam_replay, sensitivity,
        periodic, models,
        unknown_gain, integrators, integrators_gauss_newton, calibration, limits, noisy_angle,
        noisy_angle_expected, flex_table1, flex_table1_agents, flex_table3, flex_star,
        active_sysid, flex_example, mujoco, sketch, long_trials, step_costs,
    )
}  # fmt: skip
TABLES |= code_tables.TABLES
MORE = (*conclusions.TABLES, *conclusions.OTHERS, *robots.TABLES)
TABLES |= {made.__name__: made for made in MORE}


def with_tables(text: str) -> str:
    """Return a page with each of its tables made again."""
    return BLOCK.sub(lambda block: f"{block[1]}{TABLES[block[2]]()}{block[3]}", text)


def main(check: bool) -> int:
    status = 0
    for page in (DOCS / name for name in PAGES):
        old = page.read_text()
        new = with_tables(old)
        if old != new and check:
            sys.stderr.write(f"{page.name} differs from its sources: run python docs/tables.py\n")
            status = 1
        elif old != new:
            page.write_text(new)
    return status


if __name__ == "__main__":
    sys.exit(main(check="--check" in sys.argv[1:]))
