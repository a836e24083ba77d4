"""Panels of an animation; each is drawn once and then updated for each frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.animation.replay_data import Story, extent
from analysis.figures.axes import angle_ticks, log_limits, log_ticks
from analysis.figures.loss_curves.plot import loss_label
from analysis.figures.style import mathematical
from analysis.line_styles import BLACK, GREY, environment_title, policy_style
from analysis.units import loss_unit
from dopt.geometry import Body

Array = npt.NDArray[np.float64]
Move = Callable[[int], None]

FOLLOW = 4.0
"""Sizes of its body that a system travels before the view follows it."""

LEGEND = 0.22
"""Share of a panel's height that its legend takes."""

TRAIL = 40
"""Steps for which the path of the last mass stays."""

PALE = "#e4e4e4"

WIDTH, HEIGHT = 8.0, 4.5
"""Of a film [inches], 16 to 9, unless the system has more accelerations than fit side by side."""

FITTING = 3
"""Panels of accelerations that fit."""


@dataclass(frozen=True)
class Stage:
    """A figure, its artists that move, and what puts them into the state of a frame.

    The moving artists are ``animated``: drawing the figure leaves them out.
    """

    figure: Figure
    moving: tuple[Artist, ...]
    move: Move


def build(story: Story) -> Stage:
    """Draw everything that does not move and return how the rest does."""
    rows = story.truth.shape[1]
    width = WIDTH * (1 + max(FITTING, rows)) / (1 + FITTING)
    figure = Figure(figsize=(width, HEIGHT), layout="constrained")
    grid = figure.add_gridspec(2, 1 + max(2, rows), height_ratios=(1.25, 1))
    places = [grid[1, 1 + row] if rows > 1 else grid[1, 1:] for row in range(rows)]
    moves = [
        _body(figure.add_subplot(grid[0, 0]), story),
        _phase(figure.add_subplot(grid[0, 1:]), story),
        _loss(figure.add_subplot(grid[1, 0]), story),
        *_forces([figure.add_subplot(place) for place in places], story),
        _clock(figure, story),
    ]
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # panels stay where they are while numbers change

    def move(frame: int) -> None:
        for one in moves:
            one(frame)

    return Stage(figure, tuple(figure.findobj(Artist.get_animated)), move)


def _clock(figure: Figure, story: Story) -> Move:
    title = figure.suptitle("t", fontsize=9, family="monospace", animated=True)
    name = f"{environment_title(story.env)}, {policy_style(story.policy).label}, seed {story.seed}"
    width = len(f"{story.system.dt * len(story.inputs):.2f}")

    def move(frame: int) -> None:
        time = story.system.dt * story.steps[frame]
        title.set_text(f"{name}   t = {time:{width}.2f} s")

    return move


def _body(axes: Axes, story: Story) -> Move:
    """Draw the system from the side; a view that follows it where it travels far."""
    axes.set_title("system")
    axes.tick_params(labelleft=False, labelbottom=False, length=0)
    axes.spines[:].set_visible(False)
    axes.set_box_aspect(1)  # the camera shows as much in x as in y
    if story.body is None:
        axes.text(0.5, 0.5, "no picture of it", transform=axes.transAxes, ha="center")
        return _still
    body, colour = story.body, policy_style(story.policy).colour
    look = _camera(axes, body)
    trail = axes.plot([], [], color=colour, lw=0.6, alpha=0.5, animated=True)[0]
    drawn = [axes.plot([], [], color=BLACK, lw=2.2, animated=True)[0] for _ in body.lines]
    masses = axes.plot([], [], "o", ms=6, color=colour, animated=True)[0]

    def move(frame: int) -> None:
        step = int(story.steps[frame])
        for artist, line in zip(drawn, body.lines, strict=True):
            artist.set_data(line[step, :, 0], line[step, :, 1])
        masses.set_data(body.masses[step, :, 0], body.masses[step, :, 1])
        recent = body.masses[max(0, step - TRAIL) : step + 1, -1]
        trail.set_data(recent[:, 0], recent[:, 1])
        look(step)

    return move


def _camera(axes: Axes, body: Body) -> Move:
    """Set the view of a body: all that it reaches, or a window around it that moves along."""
    lines = np.concatenate(body.lines, axis=1)
    low, high = lines.min(axis=1), lines.max(axis=1)
    size = float((high - low).max())
    reach = float((high.max(axis=0) - low.min(axis=0)).max())
    follows = reach > FOLLOW * size
    half = 1.5 * size if follows else 0.54 * reach
    centres = (low + high) / 2
    if not follows:
        centres = np.broadcast_to((low.min(axis=0) + high.max(axis=0)) / 2, centres.shape)
    # Lines that pass by show the motion.
    _mesh(axes, size, low.min(axis=0) - 2 * half, high.max(axis=0) + 2 * half)

    def look(step: int) -> None:
        x, y = centres[step]
        axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half))

    return look


def _mesh(axes: Axes, size: float, low: Array, high: Array) -> None:
    """Draw lines at the multiples of a size between two corners."""
    axes.grid(visible=False)
    (left, bottom), (right, top) = low, high
    for place in size * np.arange(np.ceil(left / size), right / size):
        axes.plot([place, place], [bottom, top], color=PALE, lw=0.5, animated=True)
    for place in size * np.arange(np.ceil(bottom / size), top / size):
        axes.plot([left, right], [place, place], color=PALE, lw=0.5, animated=True)


def _phase(axes: Axes, story: Story) -> Move:
    plane, style = story.plane, policy_style(story.policy)
    points = plane.project(story.states)
    x_label, y_label = (mathematical(label) for label in plane.labels)
    axes.set(title="phase trace", xlabel=x_label, ylabel=y_label)
    inside = plane.wrapped(points)
    for dimension, axis in enumerate((axes.xaxis, axes.yaxis)):
        limits = extent(inside[:, dimension], np.array(plane.box[dimension]))
        axis.set_view_interval(*limits, ignore=True)
        if plane.angles[dimension]:
            angle_ticks(axis)
    trace = axes.plot([], [], color=style.colour, lw=0.9, animated=True)[0]
    now = axes.plot([], [], "o", ms=5, color=style.colour, mec="white", animated=True)[0]

    def move(frame: int) -> None:
        step = int(story.steps[frame])
        line = plane.line(points[: step + 1])
        trace.set_data(line[:, 0], line[:, 1])
        now.set_data(inside[step : step + 1, 0], inside[step : step + 1, 1])

    return move


def _forces(panels: list[Axes], story: Story) -> list[Move]:
    times = story.system.dt * np.arange(len(story.states), dtype=np.float64)
    moves = []
    for row, axes in enumerate(panels):
        label = story.system.state_labels[story.system.learned_rows[row]]
        axes.set(title=_acceleration(label), xlabel="time [s]", xlim=(0, times[-1] or 1.0))
        low, high = extent(story.truth[:, row])
        axes.set_ylim(low, high + LEGEND * (high - low))
        axes.plot(times, story.truth[:, row], color=GREY, lw=2.0, alpha=0.6, label="true")
        colour = policy_style(story.policy).colour
        learned = axes.plot([], [], color=colour, lw=0.9, animated=True, label="learned so far")[0]
        axes.legend(loc="upper left", fontsize=6, ncols=2, handlelength=1.6)
        moves.append(_curve_and_now(axes, learned, times, story, story.learned[:, :, row]))
    return moves


def _curve_and_now(axes: Axes, line: Line2D, times: Array, story: Story, values: Array) -> Move:
    now = axes.axvline(0.0, color=BLACK, lw=0.6, animated=True)

    def move(frame: int) -> None:
        line.set_data(times, values[frame])
        now.set_xdata([times[story.steps[frame]]] * 2)

    return move


def _acceleration(label: str) -> str:
    """Return what is learned of the rate with the label, such as ``φ̇ [rad/s]``."""
    rate, _, unit = label.partition(" [")
    return f"d{mathematical(rate)}/dt at u = 0 [{unit.rstrip(']')}²]"


def _loss(axes: Axes, story: Story) -> Move:
    times = story.system.dt * (1 + np.arange(len(story.loss)))
    low, high = log_limits(story.loss)
    axes.set(
        title="loss",
        xlabel="time [s]",
        ylabel=loss_label("loss", loss_unit(story.system)),
        yscale="log",
    )
    axes.set(xlim=(0, times[-1] if len(times) else 1.0), ylim=(low, high))
    log_ticks(axes.yaxis, low, high)
    line = axes.plot([], [], color=policy_style(story.policy).colour, animated=True)[0]

    def move(frame: int) -> None:
        done = int(story.steps[frame])
        line.set_data(times[:done], story.loss[:done])

    return move


def _still(_: int) -> None:
    """Move nothing."""
