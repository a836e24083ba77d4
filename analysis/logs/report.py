"""``python -m analysis log FILE``: the health of a recorded run, one line a fact, and a picture."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from analysis.logs.health import FEW, MOST_ROWS, Effect, Health, Signal, examine
from analysis.logs.tables import is_flag, log_of, read_table
from analysis.style import number
from dopt.log import TURN, Log
from orchestrate.program import UsageError, path, positive, tell

HELP = "how healthy a recorded run is: sampling, noise, limits, delay, feedback, units"

PICTURES = (".png", ".pdf", ".svg")

RESTS = 0.2
"""Share of a log at rest from which the report says so."""

UNEVEN = 0.05
"""Share of irregular steps from which the report says that effects do not heed them."""

_MANY_TURNS = 100.0  # radians


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Add the file and the options of the command."""
    command.add_argument("file", metavar="FILE", help=".csv, .csv.gz, .parquet, .mat or .h5")
    for option, what in (
        ("--states", "measured states, such as th or angle=th,rate=om (all other columns)"),
        ("--inputs", "inputs, such as u or voltage=u (columns that are named like inputs)"),
        ("--angles", "states in radians that are angles: unwrapped (none)"),
        ("--units", "units of columns, such as t=ms,th=counts/4096"),
    ):
        command.add_argument(option, help=what)
    command.add_argument("--time", help="column of the stamps (time, t or timestamp)")
    for option, what in (("--dt", "seconds between two rows without stamps"), ("--gap", "s")):
        help_text = what if option == "--dt" else "longest step within a piece [s] (10 medians)"
        command.add_argument(option, type=positive(option, float), help=help_text)
    command.add_argument("--out", type=path("--out"), help="picture (figures/NAME.png)")


def run(options: argparse.Namespace) -> int:
    """Print the report of a log and save its picture."""
    target = options.out or Path("figures") / f"{Path(options.file).name.split('.')[0]}.png"
    if target.suffix not in PICTURES:
        raise UsageError(
            f"--out is {str(target)!r}, but a name with one of the endings {', '.join(PICTURES)} "
            f"is expected: give one."
        )
    table = read_table(options.file).rename(columns=str)
    log = log_of(
        table,
        names_of("--states", options.states),
        names_of("--inputs", options.inputs),
        time=options.time,
        dt=options.dt,
        gap=options.gap,
        angles=tuple(names_of("--angles", options.angles) or ()),
        units=names_of("--units", options.units),
    )
    health, file = examine(log), Path(options.file)
    guessed = " (named like inputs: --inputs says otherwise)" * (options.inputs is None)
    for line in (f"{file.name}: {log!r}{guessed}", *lines(log, health, table)):
        tell(sys.stdout, f"{line}\n")
    from analysis.figures.reports import draw_log  # Matplotlib: other commands do without it

    draw_log(log, health, target, file.name)
    tell(sys.stdout, f"picture: {target}\n")
    return 0


def names_of(option: str, text: str | None) -> dict[str, str] | None:
    """Return the columns that an option names, by state or input."""
    if text is None:
        return None
    found = {}
    for part in text.split(","):
        name, equals, column = (one.strip() for one in part.partition("="))
        if not name or (equals and not column) or (option == "--units" and not equals):
            raise UsageError(
                f"{option} is {text!r}, but names that commas separate are expected, such as "
                f"{'th=deg' if option == '--units' else 'th or angle=th'}: correct it."
            )
        found[name] = column or name
    return found


def lines(log: Log, health: Health, table: pd.DataFrame) -> Iterator[str]:
    """Yield the sentences of the report: sampling, signals, inputs, suspicions, notes."""
    yield f"sampling: {_sampling(log, health)}"
    for one in health.states:
        yield f"{one.name}: {_signal(one)}, noise at most {number(one.noise)}"
        yield from _units(one)
    for one in health.inputs:
        yield f"{one.name}: {_signal(one)}{_limits(one)}"
    wrapped = [one.name for one in health.states if not math.isnan(one.period)]
    if wrapped:
        yield f"effects of the inputs: not judged while {', '.join(wrapped)} wraps"
    else:
        yield from (line for effect in health.effects for line in _effect(effect, health))
    if health.effects and health.irregular > UNEVEN:
        yield "effects of the inputs: as if all steps were of the median length"
    unseen = {*log.inputs} - {effect.input for effect in health.effects}
    yield from (f"{name}: constant, or too few rows to see its effect" for name in sorted(unseen))
    yield from _rest(log, health)
    if log.n_rows > MOST_ROWS:
        yield f"effects of the inputs: of the first {MOST_ROWS:,} rows"
    yield from _others(log, table)
    yield from (f"note: {note}" for note in log.notes)


def _sampling(log: Log, health: Health) -> str:
    unit, scale = ("ms", 1e3) if health.step < 1 else ("s", 1.0)
    shown = [number(scale * one) for one in (health.step, health.shortest, health.longest)]
    text = f"median step {shown[0]} {unit}, {shown[1]} to {shown[2]} {unit}"
    if shown[1] == shown[2]:
        text = f"every {shown[0]} {unit}"
    if health.irregular > 0:
        text += f", {100 * health.irregular:.2g} % of the steps off by more than 20 %"
    text += f", {len(log.pieces)} piece{'s' * (len(log.pieces) > 1)} without gaps"
    if health.step >= 1:
        likely = "ms" if health.step < 1e3 else "us" if health.step < 1e6 else "ns"
        text += (
            f"; stamps in {likely}? A step of {number(health.step)} s is long: --units t={likely}"
        )
    return text


def _signal(one: Signal) -> str:
    text = f"{number(one.low)} to {number(one.high)}"
    if one.levels < FEW:
        return f"{text}, {one.levels} level{'s' * (one.levels > 1)}"
    if math.isnan(one.quantum):
        return f"{text}, no steps"
    turn = TURN / one.quantum
    whole = abs(turn - round(turn)) < 1e-3 * max(1.0, turn / 1000) and turn > 50
    return f"{text}, steps of {one.quantum:.6g}{f' ({round(turn):,} a turn)' * whole}"


def _limits(one: Signal) -> str:
    rows = [
        f"{count:,} rows at {number(end)}"
        for count, end in ((one.at_low, one.low), (one.at_high, one.high))
        if count
    ]
    return f", saturated: {' and '.join(rows)}" if rows else ", not saturated"


def _units(one: Signal) -> Iterator[str]:
    """Yield what a state's values say of its unit."""
    span = one.high - one.low
    whole = one.quantum == round(one.quantum, 6) and one.quantum >= 1
    if not math.isnan(one.period):
        unit = {1.0: "rev", TURN: "rad", 360.0: "deg"}.get(one.period, f"counts/{one.period:.0f}")
        words = {"rad": "name it in --angles"}.get(unit, f"--angles and --units {one.name}={unit}")
        yield f"{one.name}: wraps about every {one.period:.6g}: an angle in {unit}? {words}"
    elif whole and span > 50:
        yield (
            f"{one.name}: whole numbers over {span:.6g}: degrees, or counts of an encoder? "
            f"--units {one.name}=deg or {one.name}=counts/N"
        )
    elif span > _MANY_TURNS and not math.isnan(one.quantum):
        yield (
            f"{one.name}: {span / TURN:.3g} turns if it is an angle in radians; degrees? "
            f"--units {one.name}=deg"
        )


def _effect(effect: Effect, health: Health) -> Iterator[str]:
    told = 100 * (1 - effect.open)
    pair = f"{effect.input} on {effect.state}"
    if effect.follows_state:
        yield (
            f"{effect.input}: this input explains nothing here: it follows the measured state "
            f"(R² = {told / 100:.3f}), so that a fit learns this law and not the plant"
        )
    elif effect.explains_nothing:
        yield (
            f"{effect.input}: this input explains nothing here: it varies on its own, but its "
            f"effect is {effect.steadiness:.1f} standard errors; motor off, or the wrong column?"
        )
    elif not effect.has_effect:
        yield f"{effect.input}: effect not told apart: the state tells {told:.0f} % of this input"
    else:
        yield (
            f"{pair}: explains {100 * effect.explained.max():.0f} % of the acceleration that "
            f"the state leaves open ({effect.steadiness:.0f} standard errors)"
        )
    if effect.delays is None:
        yield f"{pair}: delay not told apart"
    else:
        first, last = (max(0, one) for one in effect.delays)
        samples = f"{first}" if first == last else f"{first} to {last}"
        step = number(1e3 * health.step)
        about = "; about, as noise is fed back" * effect.closed_loop
        yield f"{pair}: suspected delay: {samples} sample{'s' * (last != 1)} of {step} ms{about}"
    if effect.follows_state:
        yield f"{effect.input}: closed loop, or as regular as the motion: a function of the state"
    elif effect.closed_loop:
        yield (
            f"{effect.input}: closed loop: measurements explain {100 * effect.feedback:.0f} % of "
            f"what its own past leaves open"
        )
    else:
        yield f"{effect.input}: open loop, as far as can be seen"


def _rest(log: Log, health: Health) -> Iterator[str]:
    """Yield where nothing moves, and whether an input acts there."""
    rests = health.resting
    if rests.mean() < RESTS:
        return
    bounds = np.flatnonzero(np.diff(np.r_[False, rests, False].astype(int)))
    longest = int(np.diff(bounds)[::2].max())
    applied = np.abs(np.concatenate([piece.inputs for piece in log.pieces]))
    blocks = np.array_split(applied, len(rests))
    most = np.max([block.max(axis=0) for block, rest in zip(blocks, rests, strict=True) if rest], 0)
    acts = ", ".join(
        f"|{name}| up to {number(value)}" for name, value in zip(log.inputs, most, strict=True)
    )
    yield (
        f"rest: nothing moves in {100 * rests.mean():.0f} % of the log, in {longest} % of it on "
        f"end, with {acts} there: dry friction, held or without power; little is learned there"
    )


def _others(log: Log, table: pd.DataFrame) -> Iterator[str]:
    """Yield the columns that are neither states nor inputs."""
    used = {*log.states, *log.inputs}
    for name in table:
        values = table[name]
        if is_flag(values) and name not in used:
            yield f"{name}: a flag, not 0 in {int((values != 0).sum()):,} rows"
