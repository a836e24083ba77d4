from __future__ import annotations

import itertools
import math

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from analysis.figures.input_spectrum import GREYS
from analysis.figures.panels import (
    angle_text,
    log_text,
    log_ticks,
    mathematical,
    rows_and_columns,
    styled,
)
from analysis.stats.curves import log_limits
from analysis.style import SEQUENCE, policy_style, sequence_style
from dopt.policies import POLICIES
from orchestrate.config.options import option_names

PAPER = ("oracle", "periodic", "d_optimal", "uniform", "random")
BEYOND = {
    name.removeprefix("beyond/") for name in option_names("policy") if name.startswith("beyond/")
}
CLASSICAL = [policy for policy in POLICIES if policy not in BEYOND]


def test_no_two_policies_look_alike() -> None:
    for one, other in itertools.combinations(POLICIES, 2):
        a, b = policy_style(one), policy_style(other)
        assert (a.colour, a.line) != (b.colour, b.line), (one, other)
        assert a.label != b.label


@pytest.mark.parametrize("group", [CLASSICAL, ["d_optimal", *BEYOND & set(POLICIES)]])
def test_policies_of_one_figure_differ_in_colour(group: list[str]) -> None:
    for one, other in itertools.combinations(group, 2):
        a, b = policy_style(one), policy_style(other)
        assert a.line != b.line, (one, other)
        assert math.dist(to_rgb(a.colour), to_rgb(b.colour)) > 0.2, (one, other)


def test_the_policies_of_the_paper_differ_in_grey() -> None:
    """As ITU-R BT.601 turns colours into grey, which is what a printer does."""
    greys = sorted(np.dot(to_rgb(policy_style(p).colour), (0.299, 0.587, 0.114)) for p in PAPER)
    assert min(np.diff(greys)) > 0.1


def contrast_to_white(colour: str) -> float:
    """Return the contrast ratio as WCAG 2 defines it, from 1 to 21."""
    channels = np.array(to_rgb(colour))
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(1.05 / (linear @ (0.2126, 0.7152, 0.0722) + 0.05))


@pytest.mark.parametrize(
    "colour",
    sorted(
        {policy_style(policy).colour for policy in (*POLICIES, "my_policy")}
        | {*SEQUENCE, *GREYS.values()}
    ),
)
def test_every_line_has_a_contrast_of_three_to_white(colour: str) -> None:
    assert contrast_to_white("#ffffff") == pytest.approx(1)
    assert contrast_to_white(colour) >= 3


def test_values_of_a_setting_look_different() -> None:
    styles = [sequence_style(place, 0, "") for place in range(2 * len(SEQUENCE))]
    assert len({(style.colour, style.line) for style in styles}) == len(styles)


def test_policies_of_the_user_have_colours_of_their_own() -> None:
    """The same in every process, and all dark enough for a line."""
    names = ["my_policy", "curiosity", "staircase", "frontier", *(f"own_{n}" for n in range(40))]
    styles = [policy_style(name) for name in names]
    assert styles[0].label == "my policy"
    assert [style.colour for style in styles[:3]] == ["#df2029", "#2039df", "#6c20df"]
    assert len({(style.colour, style.line) for style in styles}) == len(names)
    for colour in (style.colour for style in styles):
        assert max(to_rgb(colour)) - min(to_rgb(colour)) > 0.3, "no grey"
        assert contrast_to_white(colour) >= 3


def test_dotted_letters_become_mathematics() -> None:
    assert mathematical("φ̇ [rad/s]") == r"$\dot{\varphi}$ [rad/s]"
    assert mathematical("ẏ [m/s]") == r"$\dot{y}$ [m/s]"
    assert mathematical("x [m]") == "x [m]"


@pytest.mark.parametrize(
    ("quarters", "text"), [(0, "0"), (1, "π/2"), (-2, "−π"), (3, "3π/2"), (4, "2π"), (-6, "−3π")]
)
def test_angles_as_multiples(quarters: int, text: str) -> None:
    assert angle_text(quarters * math.pi / 2) == text


@pytest.mark.parametrize(("low", "high"), [(0.3, 0.9), (0.2, 30.0), (1e-5, 10.0), (2.0, 2.2)])
def test_a_logarithmic_axis_always_has_two_labels(low: float, high: float) -> None:
    axes = Figure().subplots()
    axes.set_yscale("log")
    axes.set_ylim(low, high)
    log_ticks(axes.yaxis, low, high)
    shown = [tick for tick in axes.yaxis.get_majorticklocs() if low <= tick <= high]
    assert len(shown) >= 2


@pytest.mark.parametrize("low", np.geomspace(0.1, 1, 12))
def test_an_axis_of_nearly_a_decade_has_three_labels(low: float) -> None:
    axes = Figure().subplots()
    axes.set_yscale("log")
    log_ticks(axes.yaxis, low, 7.5 * low)
    shown = [tick for tick in axes.yaxis.get_majorticklocs() if low <= tick <= 7.5 * low]
    assert len(shown) >= 3


@pytest.mark.parametrize("decades", [0.02, 0.1, 0.2, 0.3, 0.45, 0.55, 0.75])
@pytest.mark.parametrize("low", np.geomspace(0.08, 1, 12))
def test_a_short_axis_has_three_labels_and_no_crowd(low: float, decades: float) -> None:
    axes = Figure().subplots()
    axes.set_yscale("log")
    high = low * 10**decades
    axes.set_ylim(low, high)
    log_ticks(axes.yaxis, low, high)
    texts = axes.yaxis.get_major_formatter().format_ticks(list(axes.yaxis.get_majorticklocs()))
    places = axes.yaxis.get_majorticklocs()
    shown = {text for place, text in zip(places, texts, strict=True) if low <= place <= high}
    assert 3 <= len(shown) <= 8


def test_small_ticks_are_powers_of_ten() -> None:
    assert log_text(0.03) == "0.03"
    assert log_text(3e-4) == r"$3\times10^{-4}$"
    assert log_text(1e-3) == r"$10^{-3}$"
    assert log_text(1.5e-3) == r"$1.5\times10^{-3}$"


def test_log_limits_ignore_what_a_logarithm_cannot_show() -> None:
    low, high = log_limits(np.array([np.nan, -1.0, 0.0, 2.0, 8.0]))
    assert 0 < low < 2
    assert high > 8
    assert log_limits(np.array([np.nan])) == (0.1, 1.0)


@pytest.mark.parametrize(
    ("panels", "widest", "grid"), [(1, 3, (1, 1)), (4, 2, (2, 2)), (4, 3, (2, 2)), (5, 3, (2, 3))]
)
def test_rows_and_columns(panels: int, widest: int, grid: tuple[int, int]) -> None:
    assert rows_and_columns(panels, widest) == grid


def test_a_matplotlibrc_changes_no_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that asks for LaTeX made every figure fail where that is not installed."""
    with styled():
        expected = {**matplotlib.rcParams}
    given = {"text.usetex": True, "font.serif": ["Times"], "figure.constrained_layout.use": True}
    for key, value in given.items():
        monkeypatch.setitem(matplotlib.rcParams, key, value)
    with styled():
        assert {**matplotlib.rcParams} == expected
    assert matplotlib.rcParams["text.usetex"]
