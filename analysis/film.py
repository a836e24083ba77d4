"""Film of one stored trial: system, phase trace, loss, learned and true accelerations."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.animation import FuncAnimation, writers
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.data.matching import AnalysisError
from analysis.data.samples import simulated_trial
from analysis.data.selection import Entry, ranges
from analysis.figures.losses import loss_label
from analysis.figures.panels import angle_ticks, log_scale, mathematical, styled
from analysis.stats.curves import DrawnPlane, log_limits
from analysis.style import BLACK, GREY, environment_title, loss_unit, policy_style, unit_of
from dopt.run import rerun
from dopt.spec.trial import TrialSpec
from dopt.systems import Arm, Cartpole, Chain, Quadrotor, System
from dopt.types import Array, Integers
from orchestrate.errors import whole
from orchestrate.store import Reader

Move = Callable[[int, int], object]  # puts a panel into the state of a frame and step


def body(system: System, states: Array) -> list[Array]:
    """Return polylines (n, k, 2) at states (n, d), in a vertical plane [m], y up; masses are last.

    The view follows the first point. Without a drawing of its own a system has, 2 m apart, a rod
    for each angle and a spring for each position; without these it has nothing.
    """
    if isinstance(system, Cartpole):
        cart, (w, h) = states[:, :1] * (1.0, 0.0), system.length * np.array([0.3, 0.12])
        tip = cart - _rod(-states[:, 2], system.length)  # the angle is from upright
        outline = cart[:, None] + [[-w, -h], [w, -h], [w, h], [-w, h], [-w, -h]]
        return [np.stack([cart, tip], axis=1), outline, tip[:, None]]
    if isinstance(system, Arm | Chain):
        sides = [system.length] if isinstance(system, Chain) else [system.length_1, system.length_2]
        rods = _rod(states[:, list(system.angle_indices)].T, np.array(sides)[:, None])
        ends = np.cumsum(rods, axis=0).swapaxes(0, 1)
        return [np.pad(ends, ((0, 0), (1, 0), (0, 0))), ends]
    if isinstance(system, Quadrotor):
        centre, arm = states[:, [0, 2]], _rod(0.5 * np.pi + states[:, 4], system.half_span)
        return [np.stack([centre, centre - arm, centre + arm], axis=1), centre[:, None]]
    lines, rod = list[Array](), getattr(system, "length", 1.0)
    for unit, state in zip(map(unit_of, system.state_labels), states.T, strict=True):
        if unit in ("rad", "m"):
            moved = _rod(state, rod) if unit == "rad" else np.outer(state, (1.0, 0.0))
            lines.append(np.stack([0 * moved, moved], axis=1) + np.array([2.0 * len(lines), 0.0]))
    return [*lines, np.stack([line[:, 1] for line in lines], axis=1)] if lines else []


def _rod(angle: Array, length: float | Array) -> Array:
    """Return the ends (..., 2) of rods from the origin, at angles from hanging."""
    return np.stack([length * np.sin(angle), -length * np.cos(angle)], axis=-1)


class Story(NamedTuple):
    """A trial in k frames: ``steps`` done, (k,), states (T + 1, d), and losses (T,).

    Accelerations at zero input along the trajectory: true (T + 1, r), learned (k, T + 1, r).
    """

    spec: TrialSpec
    steps: Integers
    states: Array
    loss: Array
    truth: Array
    learned: Array


def tell(reader: Reader, entry: Entry, seed: int, frames: int) -> Story:
    """Read a trial and replay it, to know what its model had learned at each frame.

    Raises ``AnalysisError`` if it is not finished, has no steps, or runs another way here.
    """
    config, finished = entry.config, [trial.seed for trial in entry.finished]
    name = f"Seed {seed} of {config.env} × {config.policy}"
    if seed not in finished:
        raise AnalysisError(f"{name} is not finished: choose by --seed one of {ranges(finished)}.")
    spec = simulated_trial(config, seed)
    states = reader.trajectory(config.config_key, seed).states
    states = states[np.isfinite(states).all(axis=1)]
    end = len(states) - 1
    if end < 1:
        raise AnalysisError(f"{name} diverged at its first steps: choose another with --seed.")
    seen = rerun(spec, np.unique(np.linspace(end, 0, frames).round().astype(int)).tolist())
    if not np.allclose(seen.states[: end + 1], states, rtol=1e-6, atol=1e-9):
        raise AnalysisError(
            f"{name} runs another way here than when it was stored: run it into a new database."
        )
    curves = reader.curves(config.config_key)
    learned = [spec.model.predict(spec.system, one, states) for one in seen.parameters]
    loss = curves.values[curves.seeds == seed][0, :end]
    truth = spec.system.learned(states, np.arange(end + 1))
    return Story(spec, seen.steps, states, loss, truth, np.array(learned))


def writer_of(target: Path) -> str:
    """Return the name of the program that writes a ``.gif`` or an ``.mp4``.

    Raises ``AnalysisError`` for other files, and where the program is not installed.
    """
    program = {".gif": "pillow", ".mp4": "ffmpeg"}.get(target.suffix, "")
    if not writers.is_available(program):
        raise AnalysisError(
            f"{target} cannot be written, but a .gif can, and an .mp4 where ffmpeg is: choose one."
        )
    return program


def shoot(story: Story, target: Path, frames_per_second: int) -> None:
    """Write all frames into a file that :func:`writer_of` knows, whole or not at all."""
    writer = writers[writer_of(target)](fps=frames_per_second)
    with whole(target) as part, styled():
        FuncAnimation(*_stage(story), frames=len(story.steps)).save(part, writer=writer, dpi=110)


def _stage(story: Story) -> tuple[Figure, Callable[[int], tuple[()]]]:
    """Draw what does not move; return what puts the rest into the state of a frame."""
    system, style = story.spec.system, policy_style(story.spec.policy.name)
    rows = story.truth.shape[1]
    figure = Figure(figsize=(2.0 * (1 + max(3, rows)), 4.5), layout="constrained")
    forces = [min(i, rows - 1) for i in range(max(2, rows))]
    places = [["system", *["phase trace"] * len(forces)], ["loss", *forces]]
    axes = figure.subplot_mosaic(places, height_ratios=(1.25, 1))
    for name, one in axes.items():
        one.set(title=name, xlabel="time [s]")
        one.set_prop_cycle(color=[style.colour])
    panels = [_body(axes["system"], story), _phase(axes["phase trace"], story)]
    panels += [_loss(axes["loss"], story), *(_force(axes[i], story, i) for i in range(rows))]
    title = f"{environment_title(system.name)}, {style.label}, seed {story.spec.seed}"
    clock = figure.suptitle(title, fontsize=9, family="monospace")
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # panels stay where they are while numbers change

    def move(frame: int) -> tuple[()]:
        step = int(story.steps[frame])
        clock.set_text(f"{title}   t = {system.dt * step:6.2f} s")
        for panel in panels:
            panel(frame, step)
        return ()

    return figure, move


def _body(axes: Axes, story: Story) -> Move:
    axes.tick_params(labelleft=False, labelbottom=False, length=0)
    axes.spines[:].set_visible(False)
    axes.set(box_aspect=1, xlabel="")
    if not (parts := body(story.spec.system, story.states)):
        axes.set_title("no picture of it")
        return lambda *_: None
    base = parts[0][:, :1]
    view = 1.1 * max(float(np.abs(part - base).max()) for part in parts) * np.array([-1, 1])
    artists = [axes.plot([], [], color=BLACK, lw=2.2)[0] for _ in parts[1:]]
    artists += axes.plot([], [], "o", ms=6)
    return lambda _, step: (
        [artist.set_data(*part[step].T) for artist, part in zip(artists, parts, strict=True)],
        axes.set(xlim=view + base[step, 0, 0], ylim=view + base[step, 0, 1]),
    )


def _phase(axes: Axes, story: Story) -> Move:
    plane = DrawnPlane.of(story.spec.system)
    points = plane.project(story.states)
    inside = plane.wrapped(points)
    axes.set(xlabel=mathematical(plane.labels[0]), ylabel=mathematical(plane.labels[1]))
    axes.plot(*np.vstack([inside, np.transpose(plane.box)]).T, alpha=0.0)  # sets the limits
    for is_angle, axis in zip(plane.angles, (axes.xaxis, axes.yaxis), strict=True):
        if is_angle:
            angle_ticks(axis)
    trace, now = axes.plot([], [], "-", [], [], "o", lw=0.9, ms=5, mec="white")
    return lambda _, step: (
        trace.set_data(*plane.line(points[: step + 1]).T),
        now.set_data(*inside[step : step + 1].T),
    )


def _loss(axes: Axes, story: Story) -> Move:
    times = story.spec.system.dt * (1 + np.arange(len(story.loss)))
    axes.set(ylabel=loss_label("loss", loss_unit(story.spec.system)), xlim=(0, times[-1]))
    log_scale(axes, *log_limits(story.loss))
    line = axes.plot([], [])[0]
    return lambda _, step: line.set_data(times[:step], story.loss[:step])


def _force(axes: Axes, story: Story, row: int) -> Move:
    """Draw what is learned of a rate, such as ``φ̇ [rad/s]``, along the whole trajectory."""
    system = story.spec.system
    rate, _, unit = system.state_labels[system.learned_rows[row]].partition(" [")
    times = system.dt * np.arange(len(story.states))
    axes.set_title(f"d{mathematical(rate)}/dt at u = 0 [{unit.rstrip(']')}²]")
    axes.plot(times, story.truth[:, row], color=GREY, lw=2.0, alpha=0.6, label="true")
    low, high = axes.get_ylim()
    axes.set(xlim=(0, times[-1]), ylim=(low, high + 0.22 * (high - low)))  # below the legend
    line = axes.plot([], [], lw=0.9, label="learned so far")[0]
    now = axes.axvline(0.0, color=BLACK, lw=0.6)
    axes.legend(loc="upper left", fontsize=6, ncols=2, handlelength=1.6)
    return lambda frame, step: (
        line.set_data(times, story.learned[frame, :, row]),
        now.set(xdata=[times[step]] * 2),
    )
