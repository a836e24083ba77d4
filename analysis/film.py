"""Film of one stored trial: system, phase trace, loss, learned and true accelerations."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.animation import FFMpegWriter, FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from analysis.data.matching import AnalysisError
from analysis.data.samples import simulated_trial
from analysis.data.selection import Entry
from analysis.figures.losses import loss_label
from analysis.figures.panels import angle_ticks, log_ticks, mathematical, styled
from analysis.stats.curves import DrawnPlane, log_limits
from analysis.style import BLACK, GREY, environment_title, loss_unit, policy_style, unit_of
from dopt.run import rerun
from dopt.systems import Arm, Cartpole, Chain, Quadrotor, System
from orchestrate.files import whole
from orchestrate.store import Reader

Array = npt.NDArray[np.float64]
Move = Callable[[int, int], object]  # puts a panel into the state of a frame, at a step

SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
"""Corners of a square about the origin, from one back to it."""

CART, BLOCK = (0.3, 0.12), 0.3
"""Half the sides of a cart, by its rod; half the side of a block [m]."""

FOLLOW = 4.0
"""Sizes of its body that a system travels before the view follows it."""


class Body(NamedTuple):
    """Polylines (n, k, 2) and masses (n, p, 2) at n states, in a vertical plane [m], y up."""

    lines: tuple[Array, ...]
    masses: Array


def body(system: System, states: Array) -> Body | None:
    """Return the body of a system at states (n, d); None for one without angles and positions.

    Without a drawing of its own it has, 2 m apart, a rod for each angle and a block for each
    position.
    """
    if isinstance(system, Cartpole):
        cart = np.stack([states[:, 0], np.zeros(len(states))], axis=1)
        tip = cart - _rod(-states[:, 2], system.length)  # the angle is from upright
        corners = cart[:, None] + system.length * np.array(CART) * SQUARE
        return Body((corners, np.stack([cart, tip], axis=1)), tip[:, None])
    if isinstance(system, Arm | Chain):
        sides = [system.length] if isinstance(system, Chain) else [system.length_1, system.length_2]
        rods = _rod(states[:, list(system.angle_indices)].T, np.array(sides)[:, None])
        ends = np.cumsum(rods, axis=0).swapaxes(0, 1)
        return Body((np.pad(ends, ((0, 0), (1, 0), (0, 0))),), ends)
    if isinstance(system, Quadrotor):
        centre, arm = states[:, [0, 2]], _rod(0.5 * np.pi + states[:, 4], system.half_span)
        return Body((np.stack([centre - arm, centre + arm], axis=1),), centre[:, None])
    units = [unit_of(label) for label in system.state_labels]
    shown = [i for i, unit in enumerate(units) if unit in ("rad", "m")]
    lines, masses = [], []
    for place, i in enumerate(shown):
        rest = np.full((len(states), 2), [2.0 * place - (len(shown) - 1), 0.0])
        if units[i] == "rad":
            masses.append(rest + _rod(states[:, i], getattr(system, "length", 1.0)))
            lines.append(np.stack([rest, masses[-1]], axis=1))
        else:
            masses.append(rest + np.pad(states[:, i : i + 1], ((0, 0), (0, 1))))
            lines.append(masses[-1][:, None] + BLOCK * SQUARE)
    return Body(tuple(lines), np.stack(masses, axis=1)) if shown else None


def _rod(angle: Array, length: float | Array) -> Array:
    """Return the ends (..., 2) of rods from the origin, at angles from hanging."""
    return np.stack([length * np.sin(angle), -length * np.cos(angle)], axis=-1)


class Story(NamedTuple):
    """A trial in k frames: ``steps`` done, (k,), states (T + 1, d), and losses (T,).

    ``truth``, (T + 1, r), and ``learned``, (k, T + 1, r), are accelerations at zero input along the
    trajectory: the true ones, and the model's at each frame.
    """

    title: str
    colour: str
    system: System
    steps: npt.NDArray[np.int64]
    states: Array
    loss: Array
    truth: Array
    learned: Array


def tell(reader: Reader, entry: Entry, seed: int, frames: int) -> Story:
    """Read a trial and replay it, to know what its model had learned at each frame.

    Raises ``AnalysisError`` if it is not finished, has no steps, or runs another way here.
    """
    config, style = entry.config, policy_style(entry.config.policy)
    name = f"Seed {seed} of {config.env} × {config.policy}"
    finished = sorted(trial.seed for trial in entry.finished)
    if seed not in finished:
        raise AnalysisError(f"{name} is not finished: choose by --seed one of {finished[:10]}.")
    spec = simulated_trial(config, seed)
    states = reader.trajectory(config.config_key, seed).states
    curves = reader.curves(config.config_key)
    states = states[np.isfinite(states).all(axis=1)]
    end = len(states) - 1
    if end < 1:
        raise AnalysisError(f"{name} diverged at its first steps: choose another with --seed.")
    seen = rerun(spec, np.unique(np.linspace(end, 0, frames).round().astype(int)).tolist())
    if not np.allclose(seen.states[: end + 1], states, rtol=1e-6, atol=1e-9):
        raise AnalysisError(
            f"{name} runs another way here than when it was stored, so what its model knew is not "
            f"known: run it again here, in a database of its own."
        )
    return Story(
        title=f"{environment_title(config.env)}, {style.label}, seed {seed}",
        colour=style.colour,
        system=spec.system,
        steps=seen.steps,
        states=states,
        loss=curves.values[int(np.flatnonzero(curves.seeds == seed)[0])][:end],
        truth=spec.system.learned(states, np.arange(len(states))),
        learned=np.array([spec.model.predict(spec.system, p, states) for p in seen.parameters]),
    )


def shoot(story: Story, target: Path, frames_per_second: int) -> None:
    """Write all frames into a ``.gif`` or an ``.mp4``, whole or not at all."""
    if target.suffix != ".gif" and (target.suffix != ".mp4" or not shutil.which("ffmpeg")):
        raise AnalysisError(
            f"{target} cannot be written, but a .gif can, and an .mp4 where the program ffmpeg is "
            f"installed: choose one."
        )
    writer = PillowWriter if target.suffix == ".gif" else FFMpegWriter
    with whole(target) as part, styled():
        figure, move = _stage(story)
        film = FuncAnimation(figure, move, frames=len(story.steps))
        film.save(part, writer=writer(fps=frames_per_second), dpi=110)


def _stage(story: Story) -> tuple[Figure, Callable[[int], tuple[()]]]:
    """Draw what does not move; return what puts the rest into the state of a frame."""
    rows, dt = story.truth.shape[1], story.system.dt
    figure = Figure(figsize=(2.0 * (1 + max(3, rows)), 4.5), layout="constrained")
    grid = figure.add_gridspec(2, 1 + max(2, rows), height_ratios=(1.25, 1))
    places = [grid[1, 1 + row] if rows > 1 else grid[1, 1:] for row in range(rows)]
    panels = [
        _body(figure.add_subplot(grid[0, 0], title="system"), story),
        _phase(figure.add_subplot(grid[0, 1:], title="phase trace"), story),
        _loss(figure.add_subplot(grid[1, 0], title="loss", xlabel="time [s]"), story),
        *(_force(figure.add_subplot(p, xlabel="time [s]"), story, i) for i, p in enumerate(places)),
    ]
    clock = figure.suptitle("t", fontsize=9, family="monospace")
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # panels stay where they are while numbers change

    def move(frame: int) -> tuple[()]:
        step = int(story.steps[frame])
        clock.set_text(f"{story.title}   t = {dt * step:{len(f'{dt * len(story.loss):.2f}')}.2f} s")
        for panel in panels:
            panel(frame, step)
        return ()

    return figure, move


def _body(axes: Axes, story: Story) -> Move:
    """Draw the system from the side, in a view that follows it where it travels far."""
    axes.tick_params(labelleft=False, labelbottom=False, length=0)
    axes.spines[:].set_visible(False)
    axes.set_box_aspect(1)
    drawn = body(story.system, story.states)
    if drawn is None:
        axes.text(0.5, 0.5, "no picture of it", transform=axes.transAxes, ha="center")
        return lambda *_: None
    points = np.concatenate(drawn.lines, axis=1)
    low, high = points.min(axis=1), points.max(axis=1)
    size, reach = float((high - low).max()), float(np.ptp(points, axis=(0, 1)).max())
    centres, half = (low + high) / 2, 1.5 * size
    if reach <= FOLLOW * size:
        centres[:], half = (low.min(axis=0) + high.max(axis=0)) / 2, 0.54 * reach
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(size))  # lines that pass by show the motion
    artists = [axes.plot([], [], color=BLACK, lw=2.2)[0] for _ in drawn.lines]
    artists += axes.plot([], [], "o", ms=6, color=story.colour)

    def move(_: int, step: int) -> None:
        for artist, line in zip(artists, (*drawn.lines, drawn.masses), strict=True):
            artist.set_data(*line[step].T)
        (x, y) = centres[step]
        axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half))

    return move


def _phase(axes: Axes, story: Story) -> Move:
    plane = DrawnPlane.of(story.system)
    points = plane.project(story.states)
    inside = plane.wrapped(points)
    axes.set(xlabel=mathematical(plane.labels[0]), ylabel=mathematical(plane.labels[1]))
    axes.plot(*np.vstack([inside, np.transpose(plane.box)]).T, alpha=0.0)  # sets the limits
    for is_angle, axis in zip(plane.angles, (axes.xaxis, axes.yaxis), strict=True):
        if is_angle:
            angle_ticks(axis)
    trace = axes.plot([], [], color=story.colour, lw=0.9)[0]
    now = axes.plot([], [], "o", ms=5, color=story.colour, mec="white")[0]
    return lambda _, step: (
        trace.set_data(*plane.line(points[: step + 1]).T),
        now.set_data(*inside[step : step + 1].T),
    )


def _loss(axes: Axes, story: Story) -> Move:
    times, (low, high) = story.system.dt * (1 + np.arange(len(story.loss))), log_limits(story.loss)
    axes.set(ylabel=loss_label("loss", loss_unit(story.system)), yscale="log")
    axes.set(xlim=(0, times[-1]), ylim=(low, high))
    log_ticks(axes.yaxis, low, high)
    line = axes.plot([], [], color=story.colour)[0]
    return lambda _, step: line.set_data(times[:step], story.loss[:step])


def _force(axes: Axes, story: Story, row: int) -> Move:
    """Draw what is learned of a rate, such as ``φ̇ [rad/s]``, along the whole trajectory."""
    rate, _, unit = story.system.state_labels[story.system.learned_rows[row]].partition(" [")
    times = story.system.dt * np.arange(len(story.states))
    axes.set_title(f"d{mathematical(rate)}/dt at u = 0 [{unit.rstrip(']')}²]")
    axes.plot(times, story.truth[:, row], color=GREY, lw=2.0, alpha=0.6, label="true")
    low, high = axes.get_ylim()
    axes.set(xlim=(0, times[-1]), ylim=(low, high + 0.22 * (high - low)))  # below the legend
    line = axes.plot([], [], color=story.colour, lw=0.9, label="learned so far")[0]
    now = axes.axvline(0.0, color=BLACK, lw=0.6)
    axes.legend(loc="upper left", fontsize=6, ncols=2, handlelength=1.6)
    return lambda frame, step: (
        line.set_data(times, story.learned[frame, :, row]),
        now.set(xdata=[times[step]] * 2),
    )
