"""Writers of animation files: GIF by Pillow, MP4 by ffmpeg."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image
from PIL.Image import Dither

from analysis.animation.axes import Stage, build
from analysis.animation.replay_data import Story
from analysis.errors import AnalysisError
from analysis.figures.style import styled
from orchestrate.files import whole

Picture = npt.NDArray[np.uint8]

DPI = 110
COLOURS = 64
"""Colours of a GIF, whose palette is that of the last picture, where everything is drawn."""


def shoot(story: Story, target: Path, frames_per_second: int) -> None:
    """Write all frames of a story, whole or not at all.

    Raises
    ------
    AnalysisError
        If the ending of the file is neither ``.gif`` nor ``.mp4``, or ffmpeg is missing.
    """
    _check(target)
    with whole(target) as part, styled():
        frames = pictures(build(story), len(story.steps))
        write = _write_gif if target.suffix == ".gif" else _write_mp4
        write(frames, part, frames_per_second)


def pictures(stage: Stage, n: int) -> Iterator[Picture]:
    """Yield n frames, (height, width, 4): what does not move is drawn once for all of them."""
    stage.figure.set_dpi(DPI)
    canvas: Any = FigureCanvasAgg(stage.figure)  # matplotlib does not say its types
    canvas.draw()
    background = canvas.copy_from_bbox(stage.figure.bbox)
    for frame in range(n):
        canvas.restore_region(background)
        stage.move(frame)
        for artist in stage.moving:
            artist.draw(canvas.get_renderer())
        yield np.array(canvas.buffer_rgba())


def _check(target: Path) -> None:
    if target.suffix not in (".gif", ".mp4"):
        raise AnalysisError(
            f"{target} ends in '{target.suffix}', but a film is a .gif or an .mp4: choose one."
        )
    if target.suffix == ".mp4" and not shutil.which("ffmpeg"):
        raise AnalysisError(
            f"{target} needs the program ffmpeg, which is not found: install it, or write a .gif."
        )


def _write_gif(frames: Iterator[Picture], target: Path, frames_per_second: int) -> None:
    images = [Image.fromarray(frame).convert("RGB") for frame in frames]
    palette = images[-1].quantize(COLOURS)
    first, *others = (image.quantize(palette=palette, dither=Dither.NONE) for image in images)
    first.save(
        target, save_all=True, append_images=others, duration=1000 / frames_per_second, loop=0
    )


def _write_mp4(frames: Iterator[Picture], target: Path, frames_per_second: int) -> None:
    first = next(frames)
    height, width = first.shape[:2]
    command = [
        "ffmpeg", "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgba",
        "-s", f"{width}x{height}", "-r", str(frames_per_second), "-i", "-",
        "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-pix_fmt", "yuv420p",
        str(target),
    ]  # fmt: skip
    film = b"".join(frame.tobytes() for frame in (first, *frames))
    done = subprocess.run(command, input=film, capture_output=True)
    if done.returncode:
        reason = done.stderr.decode(errors="replace").strip().splitlines()
        raise AnalysisError(
            f"ffmpeg could not write {target} ({reason[-1] if reason else 'no reason given'}): "
            f"write a .gif instead."
        )
