"""Styles, axes and legends of all figures; phase portraits."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.cli import main
from analysis.data.matching import AnalysisError, Filter
from analysis.data.selection import select
from analysis.figures.panels import (
    COLUMN_WIDTH,
    angle_text,
    legend_below,
    log_scale,
    log_text,
    mathematical,
    rows_and_columns,
    styled,
)
from analysis.figures.phase_portraits import GREYS, measure_portraits, tabulate_portraits
from analysis.stats.curves import Band, axis_parts, band_limits, log_limits, median_seed
from analysis.style import SEQUENCE, policy_style, sequence_style
from dopt.assessment import Plane
from dopt.policies import POLICIES
from dopt.systems import SYSTEMS
from orchestrate.config.options import option_names
from orchestrate.store import Reader
from tests.analysis.conftest import SHORT, limited
from tests.analysis.synthetic import fill, make_grid

SHORT_LABELS = ("D-optimal", "random", "95 % interval")
LONG = tuple(f"curiosity, candidates={n}, grid_half_widths=[3, 3]" for n in range(5))
ENDLESS = tuple("a label of many words " * n for n in (6, 9))


@pytest.mark.parametrize(
    ("labels", "columns", "grows"), [(SHORT_LABELS, 3, False), (LONG, 1, True), (ENDLESS, 1, True)]
)
def test_a_legend_has_as_many_columns_as_fit_into_its_figure(
    labels: tuple[str, ...], columns: int, grows: bool
) -> None:
    with styled():
        figure = Figure(figsize=(COLUMN_WIDTH, 3), layout="constrained")
        axes = figure.subplots()
        planned = axes.get_window_extent().height
        legend = legend_below(figure, 3, handles=[Line2D([], [], label=one) for one in labels])
        FigureCanvasAgg(figure).draw()
        box = legend.get_window_extent()
        assert box.x0 >= 0
        assert box.x1 <= figure.bbox.width
        assert legend._ncols == columns
        assert bool(figure.get_figheight() > 3) == grows
        assert axes.get_window_extent().height > 0.7 * planned


def test_the_words_of_a_wrapped_label_stay() -> None:
    with styled():
        figure = Figure(figsize=(COLUMN_WIDTH, 3), layout="constrained")
        figure.subplots()
        handles = [Line2D([], [], label=one) for one in ENDLESS]
        texts = legend_below(figure, 2, handles=handles).get_texts()
    assert [text.get_text().split() for text in texts] == [one.split() for one in ENDLESS]


def band(*mean: float, half: float = 0.1) -> Band:
    centre = np.array(mean)
    return Band(centre, centre * (1 - half), centre * (1 + half), 5)


def test_neighbours_share_one_axis() -> None:
    parts = axis_parts([band(10, 5, 2), band(10, 3, 1), band(9, 1, 0.5)])
    assert parts.lower is None
    assert parts.upper[0] < 0.45
    assert parts.upper[1] > 11


def test_a_far_lower_curve_gets_its_own_part() -> None:
    low = band(10, *[1e-3] * 19)
    parts = axis_parts([band(*np.linspace(10, 1, 20)), low, band(*np.linspace(8, 2, 20))])
    assert parts.lower is not None
    assert 0.3 < parts.upper[0] < 1
    assert parts.upper[1] > 10
    assert parts.lower[0] < 0.9e-3
    assert 1e-3 < parts.lower[1] < parts.upper[0]


def test_empty_and_nan_curves_do_not_matter() -> None:
    empty = np.full(3, np.nan)
    nothing = Band(empty, empty, empty, 0)
    assert axis_parts([nothing]).upper == (0.1, 1.0)
    assert axis_parts([nothing, band(3, 2, 1)]) == axis_parts([band(3, 2, 1)])


def test_a_band_that_reaches_zero_does_not_stretch_the_axis() -> None:
    low, high = band_limits([band(4, 3, 2, half=0.999)])
    assert low > 0.5
    assert high < 10


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


def test_every_line_has_a_contrast_of_three_to_white() -> None:
    assert contrast_to_white("#ffffff") == pytest.approx(1)
    policies = {policy_style(policy).colour for policy in (*POLICIES, "my_policy")}
    for colour in policies | {*SEQUENCE, *GREYS.values()}:
        assert contrast_to_white(colour) >= 3, colour


def test_values_of_a_setting_look_different() -> None:
    styles = [sequence_style(place, 0, "") for place in range(2 * len(SEQUENCE))]
    assert len({(style.colour, style.line) for style in styles}) == len(styles)


def test_policies_of_the_user_have_their_own_colours() -> None:
    """The same in every process, and all dark enough for a line."""
    names = ["my_policy", "curiosity", "staircase", "frontier", *(f"own_{n}" for n in range(40))]
    styles = [policy_style(name) for name in names]
    assert styles[0].label == "my policy"
    assert [style.colour for style in styles[:3]] == ["#df2029", "#2039df", "#6c20df"]
    assert len({(style.colour, style.line) for style in styles}) == len(names)
    for colour in (style.colour for style in styles):
        assert max(to_rgb(colour)) - min(to_rgb(colour)) > 0.3, "no grey"
        assert contrast_to_white(colour) >= 3


def test_labels_and_small_ticks_become_mathematics() -> None:
    assert mathematical("φ̇ [rad/s]") == r"$\dot{\varphi}$ [rad/s]"
    assert mathematical("ẏ [m/s]") == r"$\dot{y}$ [m/s]"
    assert mathematical("x [m]") == "x [m]"
    assert log_text(0.03) == "0.03"
    assert log_text(3e-4) == r"$3\times10^{-4}$"
    assert log_text(1e-3) == r"$10^{-3}$"
    assert log_text(1.5e-3) == r"$1.5\times10^{-3}$"


@pytest.mark.parametrize(
    ("quarters", "text"), [(0, "0"), (1, "π/2"), (-2, "−π"), (3, "3π/2"), (4, "2π"), (-6, "−3π")]
)
def test_angles_as_multiples(quarters: int, text: str) -> None:
    assert angle_text(quarters * math.pi / 2) == text


@pytest.mark.parametrize(
    ("decades", "fewest"),
    [*((d, 3) for d in (0.02, 0.1, 0.2, 0.3, 0.45, 0.55, 0.75, 0.875)), (2.2, 2), (6.0, 2)],
)
def test_a_logarithmic_axis_has_labels_and_no_crowd(decades: float, fewest: int) -> None:
    axes = Figure().subplots()
    for low in np.geomspace(0.08, 1, 12):
        high = low * 10**decades
        log_scale(axes, low, high)
        places = list(axes.yaxis.get_majorticklocs())
        texts = axes.yaxis.get_major_formatter().format_ticks(places)
        shown = {text for place, text in zip(places, texts, strict=True) if low <= place <= high}
        assert fewest <= len(shown) <= 8


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


def test_median_seed() -> None:
    assert median_seed({0: 3.0, 1: 1.0, 2: 2.0}) == 2
    assert median_seed({0: 4.0, 1: 3.0, 2: 2.0, 3: 1.0}) == 2
    assert median_seed({7: 1.0, 3: 1.0, 5: 1.0}) == 5


def test_every_system_rests_inside_its_box() -> None:
    plane = Plane.of(SYSTEMS["cartpole"]())
    assert plane.box[0] == pytest.approx((0, 2 * math.pi)), "centred on hanging"
    assert plane.angles == (True, False)
    for name, kind in SYSTEMS.items():
        system = kind()
        plane = Plane.of(system)
        rest = np.array([system.equilibrium or (0.0,) * system.n_states])
        x, y = plane.wrapped(plane.project(rest))[0]
        (left, right), (bottom, top) = plane.box
        assert left < x < right, name
        assert bottom < y < top, name


def test_panels_share_the_seed_and_the_start(reader: Reader) -> None:
    portraits = measure_portraits(reader, select(reader, Filter()), "pendulum")
    assert portraits.panels[0].policy == "d_optimal"
    for panel in portraits.panels:
        assert panel.start == pytest.approx(portraits.panels[0].start)
        assert panel.n == 5
        assert 0 < panel.coverage < 1


def test_the_line_goes_through_the_stored_states(reader: Reader) -> None:
    selection = select(reader, Filter())
    portraits = measure_portraits(reader, selection, "pendulum")
    key = selection.of("pendulum")[0].config.config_key
    states = reader.trajectory(key, portraits.seed).states
    table = tabulate_portraits(portraits)
    drawn = table[(table.policy == "d_optimal") & table.x.notna()]
    assert drawn.y.to_numpy() == pytest.approx(states[:, 1])
    assert (table.seed == portraits.seed).all()


def test_a_diverged_trial_has_no_share_in_the_coverage(reader: Reader) -> None:
    portraits = measure_portraits(reader, select(reader, Filter()), "cartpole")
    panel = portraits.panels[-1]
    assert (panel.policy, panel.n, panel.n_diverged) == ("random", 4, 1)


def test_without_the_reference_there_is_no_seed(reader: Reader) -> None:
    selection = select(reader, Filter(policies=("random",)))
    with pytest.raises(AnalysisError, match="no finished trial of d_optimal"):
        measure_portraits(reader, selection, "pendulum")


def test_trials_with_limits_alone_are_shown_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    address = f"sqlite:///{tmp_path}/limits.db"
    fill(address, limited(("d_optimal", "random"), range(3)))
    assert main(["summary", "--db", address, "--format", "csv"]) == 0
    shown = capsys.readouterr()
    assert "D-optimal, limits" in shown.out
    assert "enforced" not in shown.out
    assert "cartpole: these trials have limits, y=[-0.5, 0.5]\n" in shown.err
    assert main(["summary", "--db", address, "--where", "limits.enforced=false"]) == 0
    assert "random, limits, enforced=False" in capsys.readouterr().out
    fill(address, make_grid(("cartpole",), ("d_optimal", "random", "oracle"), range(3), **SHORT))
    assert main(["summary", "--db", address]) == 0
    shown = capsys.readouterr()
    assert "limits" not in shown.out
    assert "| oracle" in shown.out
    assert "4 other stored configurations" in shown.err
