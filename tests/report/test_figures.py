"""Figures: what they draw and say, and colours that a method keeps."""

import re

import matplotlib
import numpy as np
import pytest
from samples import figure, heat_map, tracks

from credo.analysis.statistics import bootstrap_interval
from credo.report import figures, styles
from credo.report.sections import Curve, Reference
from credo.report.styles import Look


def svg(item, dark=False) -> str:
    return figures.picture(item, styles.DARK if dark else styles.LIGHT).svg


def test_text_of_a_figure_is_text_in_a_generic_font():
    text = svg(figure())
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", text)
    assert {"generation", "share", "depth 2", "depth 3", "baseline", "upper bound"} <= set(texts)
    families = set(re.findall(r"font-family: ([^;\"]+)", text))
    assert families == {figures.FONT}
    assert "<style" not in text


def test_dark_and_light_differ_in_colour_alone():
    def without_colour(svg: str) -> str:
        # The id of a marker is a hash of its path and its colour.
        return re.sub(r"#[0-9a-f]{6}\b|\bm[0-9a-f]{10}\b", "", svg)

    light, dark = svg(figure()), svg(figure(), dark=True)
    assert light != dark
    assert without_colour(light) == without_colour(dark)
    assert light == svg(figure())
    assert svg(heat_map()) != svg(heat_map(), dark=True)


def drawn(item, dark=False):
    theme = styles.DARK if dark else styles.LIGHT
    with matplotlib.rc_context(theme.rc):
        canvas = figures.draw(item, theme)
        canvas.draw_without_rendering()
    return canvas


def test_figure_draws_every_seed_the_mean_and_its_interval():
    runs = np.random.default_rng(1).random((5, 12))
    axes = drawn(figure(curves=[Curve("a", np.arange(12), runs)])).axes[0]
    *seeds, thick, baseline, bound = [line.get_ydata() for line in axes.lines]
    np.testing.assert_array_equal(seeds, runs)
    np.testing.assert_array_equal(thick, runs.mean(axis=0))
    assert set(baseline) == {0.25}
    assert set(bound) == {1.0}
    low, high = bootstrap_interval(runs, resamples=figures.RESAMPLES)
    band = axes.collections[0].get_paths()[0].vertices
    for x in range(12):
        assert {low[x], high[x]} == set(band[band[:, 0] == x, 1])


def test_runs_over_a_setting_are_dots_that_no_line_joins():
    runs = np.random.default_rng(1).random((3, 4))
    curves = [Curve("a", [1, 2, 4, 7], runs), Curve("b", [1, 2, 4, 7], runs + 1)]
    axes = drawn(figure(curves=curves, joined=False)).axes[0]
    *dots, centre = axes.lines[:4]
    assert [line.get_linewidth() for line in dots] == [0.0] * 3
    np.testing.assert_array_equal([line.get_ydata() for line in dots], runs)
    np.testing.assert_array_equal(centre.get_ydata(), runs.mean(axis=0))
    assert centre.get_marker() == "o"
    low, high = bootstrap_interval(runs, resamples=figures.RESAMPLES)
    bars = [path.vertices[:, 1].tolist() for path in axes.collections[0].get_paths()]
    np.testing.assert_array_equal(bars, np.transpose([low, high]))
    assert axes.get_xticks().tolist() == [1, 2, 4, 7]
    # Curves stand beside each other: no dot of one hides one of the other.
    places = [line.get_transform().transform((4.0, 0.5))[0] for line in (centre, axes.lines[7])]
    assert places[1] - places[0] > 3
    assert axes.get_xlim()[0] < 1
    assert axes.get_xlim()[1] > 7
    told = "Mean over 3 runs. Bars: its 95 % bootstrap interval. Dots: each run."
    assert figures.note(figure(curves=curves, joined=False)) == told


@pytest.mark.parametrize("runs", [1, 3])
def test_dots_lie_within_the_axes(runs):
    values = 5.0 + np.random.default_rng(1).random((runs, 3))
    values[0, 1] = 9.0  # beyond the interval of the mean
    axes = drawn(figure(curves=[Curve("a", [1, 2, 5], values)], joined=False, references=[])).axes[
        0
    ]
    low, high = axes.get_ylim()
    assert low <= values.min()
    assert high >= 9.0
    assert high - low < 3 * (9.0 - values.min())


@pytest.mark.parametrize("last", [3, 7, 40])
def test_whole_numbers_have_whole_ticks(last):
    x = np.arange(1, last + 1)
    axes = drawn(figure(curves=[Curve("a", x, [x / last])])).axes[0]
    ticks = [x for x in axes.get_xticks() if 1 <= x <= last]
    assert len(ticks) >= 2
    assert all(tick == round(tick) for tick in ticks)


def test_curves_that_coincide_are_told_and_drawn_inside_each_other():
    x = np.arange(100)
    wave = np.sin(x / 9)
    curves = [
        Curve("td3", x, [wave]),
        Curve("ea", x, [wave + 1]),
        Curve("erl", x[10:90], [wave[10:90] + 0.001]),
    ]
    item = figure(curves=curves, references=())
    assert figures.coinciding(item) == [[0, 2]]
    assert figures.note(item) == "One run per line. td3 and erl coincide."
    td3, ea, erl = drawn(item).axes[0].lines
    assert td3.get_linewidth() > 2 * erl.get_linewidth() == 2 * ea.get_linewidth()


def test_a_method_keeps_its_colour_and_dash_on_every_page():
    alone = styles.assign(["td3"])["td3"]
    for labels in (["erl", "td3", "cerl"], ["2-deep", "3-deep", "td3"], ["td3 local", "TD3"]):
        looks = styles.assign(labels)
        assert looks[next(x for x in labels if x.lower() == "td3")] == alone
        assert len(set(looks.values())) == len(labels)
        assert looks == styles.assign(labels)
    assert styles.assign(["erl: actor_lr 0.1"])["erl: actor_lr 0.1"] == styles.METHODS["erl"]
    assert len(set(styles.METHODS.values())) == len(styles.METHODS)
    many = styles.assign(f"{i}-deep" for i in range(40))
    assert len(set(many.values())) == len(styles.LIGHT.curves) * len(styles.DASHES)


def test_methods_that_are_compared_differ_in_colour():
    for group in (
        ["erl", "cerl", "ea", "td3", "ddpg", "sac", "ppo"],
        ["merl", "ea", "td3", "matd3", "maddpg", "ccea"],
        ["mmu", "lstm", "gru", "rnn", "mlp", "dmmu"],
    ):
        assert len({look.color for look in styles.assign(group).values()}) == len(group)


def test_looks_of_a_page_are_those_of_its_figures():
    looks = {"depth 2": Look(5, 1), "depth 3": Look(3, 0)}
    with matplotlib.rc_context(styles.LIGHT.rc):
        lines = figures.draw(figure(), styles.LIGHT, looks).axes[0].lines
    assert [lines[i].get_color() for i in (4, 9)] == [styles.LIGHT.curves[i] for i in (5, 3)]


def test_tips_tell_values_and_where_the_axes_are():
    item = figure(curves=[Curve("a", [1, 2], [[0.0, -0.5], [1.0, np.nan]])])
    tips = figures.picture(item, styles.LIGHT).tips
    assert tips["curves"][0]["x"] == [1.0, 2.0]
    assert tips["curves"][0]["text"] == ["0.5 [0, 1]", ""]
    left, top, width, height = tips["box"]
    assert 0 < left < left + width < 1
    assert 0 < top < top + height < 1
    low, high = tips["x"]
    assert low < 1
    assert high > 2
    cells = figures.picture(heat_map(), styles.LIGHT).tips
    assert (cells["rows"][0], cells["columns"][1]) == ("cell a", "step 2")
    assert cells["values"][0][:2] == ["-1", "-0.7857"]


def test_a_curve_ends_where_a_seed_has_no_value():
    runs = np.ones((2, 4))
    runs[1, 2:] = np.nan, np.inf
    curve = figures.sampled(Curve("a", np.arange(4), runs), 400)
    assert np.isnan(curve.centre).tolist() == [False, False, True, True]
    assert np.isnan(curve.low).tolist() == [False, False, True, True]
    assert curve.runs[0].tolist() == [1.0] * 4


def test_long_curves_are_picked_from_and_not_smoothed():
    x = np.arange(1.0, 15_001.0)
    runs = np.random.default_rng(2).random((2, 15_000))
    curve = figures.sampled(Curve("a", x, runs), 400)
    assert 200 < len(curve.x) <= 400
    assert (curve.x[0], curve.x[-1]) == (1.0, 15_000.0)
    np.testing.assert_array_equal(curve.runs, runs[:, curve.x.astype(int) - 1])
    gaps = np.diff(curve.x)
    assert gaps.max() < 1.1 * gaps.min()


def test_note_says_what_is_drawn():
    long = Curve("a", np.arange(15_000), np.random.default_rng(0).random((60, 15_000)))
    other = Curve("b", long.x, np.asarray(long.runs) + 1)
    assert figures.note(figure(curves=[long, other])) == (
        "Mean over 60 runs. Band: its 95 % bootstrap interval. Thin lines: each run. "
        "Up to 40 of 15,000 points are drawn, unsmoothed."
    )
    assert figures.note(figure(curves=[Curve("a", [0, 1], [[0, 1]])])) == "One run per line."
    assert figures.note(heat_map(values=np.full((3, 5), np.nan))) == "Grey: no value."


CROWDED = figure(
    x_label="a long name of an axis, with its unit and what else there is to be said about it",
    y_label="a long name of an axis, with its unit in parentheses",
    curves=[
        Curve(f"a curve with a long name, number {i}", np.arange(50), np.ones((2, 50)) * i)
        for i in range(11)
    ],
    references=[Reference(f"a level with a long name {i}", 5 + 0.01 * i) for i in range(5)],
)


@pytest.mark.parametrize("item", [figure(), CROWDED], ids=["plain", "crowded"])
def test_nothing_overlaps_and_nothing_is_cut(item):
    canvas = drawn(item)
    axes, legend = canvas.axes[0], canvas.legends[0]
    plot, page = axes.get_window_extent(), canvas.bbox
    # Of a name alone: an annotation's own extent includes its leader line.
    names = [matplotlib.text.Text.get_window_extent(label) for label in axes.texts]
    boxes = [plot, legend.get_window_extent(), axes.xaxis.label.get_window_extent()]
    boxes += [axes.yaxis.label.get_window_extent(), *names]
    for i, box in enumerate(boxes):
        assert box.x0 >= -0.5
        assert box.y0 >= -0.5
        assert box.x1 <= page.x1 + 0.5
        assert box.y1 <= page.y1 + 0.5
        for other in boxes[:i]:
            assert not box.padded(-0.5).overlaps(other)
    assert plot.height > 120
    assert plot.width > 200


def test_labels_move_no_further_than_they_must():
    assert figures.spread_out([0.2, 0.5], [0.1, 0.1]) == [0.2, 0.5]
    np.testing.assert_allclose(figures.spread_out([0.5, 0.5], [0.1, 0.3]), [0.5, 0.7])
    np.testing.assert_allclose(figures.spread_out([0.98, 1.0], [0.1, 0.1]), [0.85, 0.95])


def test_curves_without_a_name_have_no_legend():
    assert drawn(figure(curves=[Curve("", [1, 2], [[0, 1]])])).legends == []


def test_given_range_is_widened_for_the_references():
    low, high = drawn(figure(y_range=(0.5, 0.9))).axes[0].get_ylim()
    assert (low, high) == pytest.approx((0.25 - 0.0225, 1.0 + 0.0225))


def test_heat_map_of_both_signs_is_centred_on_the_colour_of_the_page():
    values = np.array([[-1.0, 0.0, 4.0]])
    for theme in (styles.LIGHT, styles.DARK):
        colors, low, high = figures.color_scale(values, theme)
        assert (low, high) == (-4.0, 4.0)
        middle = np.array(colors(0.5)[:3]) * 255
        expected = [int(theme.page[i : i + 2], 16) for i in (1, 3, 5)]
        np.testing.assert_allclose(middle, expected, atol=2)
    assert figures.color_scale(np.array([[1.0, 3.0]]), styles.LIGHT)[1:] == (1.0, 3.0)
    assert figures.color_scale(np.array([[2.0, np.nan]]), styles.LIGHT)[1:] == (1.5, 2.5)


@pytest.mark.parametrize(
    ("columns", "label", "ticks", "rotation"),
    [(60, "{}", 12, 0.0), (8, "{}", 8, 0.0), (10, "learner {}", 10, 90.0), (3, "+ + −", 3, 0.0)],
)
def test_column_labels_are_all_shown_turned_or_thinned(columns, label, ticks, rotation):
    labels = [label.format(i) for i in range(columns)]
    item = heat_map(values=np.zeros((3, columns)), column_labels=labels)
    shown_labels = drawn(item).axes[0].get_xticklabels()
    assert len(shown_labels) == ticks
    assert shown_labels[1].get_text() == labels[columns // ticks]
    assert {text.get_rotation() for text in shown_labels} == {rotation}


@pytest.mark.parametrize("dark", [False, True])
def test_tracks_mark_everybody_the_goals_and_the_breaks(dark):
    theme = styles.DARK if dark else styles.LIGHT
    axes = drawn(tracks(), dark).axes[0]
    line, *lines = axes.lines
    assert (set(line.get_xdata()), line.get_color()) == ({1.5}, theme.ink)
    marks = [x for x in lines if x.get_linewidth() == 0]
    assert [x.get_marker() for x in marks] == ["o", "X"]
    assert [x.get_color() for x in marks] == [theme.curves[0], theme.ink]
    for mark, track in zip(marks, tracks().tracks, strict=True):
        np.testing.assert_array_equal(np.round(mark.get_ydata()), track.rows)
        np.testing.assert_array_equal(np.round(mark.get_xdata()), range(4))
    assert not set(zip(*marks[0].get_data(), strict=True)) & set(
        zip(*marks[1].get_data(), strict=True)
    )
    squares = [x for x in axes.patches if x.get_height() < 1]
    assert [round(x.get_y() + 0.46) for x in squares] == [0, 2, 1, 1]
    assert [x.get_linestyle() == "solid" for x in squares] == [True, False, True, False]
    columns = [x.get_x() + 0.5 for x in axes.patches if x.get_height() == 3]
    assert columns == [0, 2]


def test_tracks_say_the_same_in_words():
    assert tracks().table.columns == ["trial", "goal", "robot", "static"]
    assert tracks().table.rows == [
        ["1", "a, reached", "a", "a"],
        ["2", "c, missed", "b, told", "a"],
        ["3", "b, reached", "b", "a"],
        ["4", "b, missed", "c", "a"],
    ]
    told = "Walk: endpoint of robot, static against trial; goal reached in 2 of 4"
    assert figures.description(tracks()) == told
    assert figures.note(tracks()) == ""


def test_short_numbers_of_the_ticks():
    x = np.array([0.0, 20_000.0, 2e6])
    axes = drawn(figure(curves=[Curve("a", x, [[-1_500.0, 950.0, 20_000.0]])])).axes[0]
    form = axes.xaxis.get_major_formatter()
    values = (0.0, 950.0, 20_000.0, -1_500.0, 1e6, 2.5e9)
    assert [form(v) for v in values] == ["0", "950", "20k", "−1.5k", "1M", "2.5G"]


def test_side_by_side_a_method_looks_the_same_and_is_named_once():
    left = figure(
        curves=[Curve("hybrid", [1, 2], [[0, 1]]), Curve("its learner", [1, 2], [[1, 0]])]
    )
    right = figure(curves=[Curve("its learner", [1, 2], [[2, 0]]), Curve("ea", [1, 2], [[3, 0]])])
    with matplotlib.rc_context(styles.LIGHT.rc):
        canvas = figures.side_by_side([left, right], ["dense", "late"], styles.LIGHT)
        canvas.draw_without_rendering()
    named = [text.get_text() for text in canvas.legends[0].get_texts()]
    assert named == ["hybrid", "its learner", "ea"]
    colours = [
        {line.get_label(): line.get_color() for line in axes.lines if line.get_label() in named}
        for axes in canvas.axes
    ]
    assert colours[0]["its learner"] == colours[1]["its learner"] != colours[1]["ea"]
    assert [axes.get_title() for axes in canvas.axes] == ["dense", "late"]
