import re
import subprocess
import sys
from collections import Counter
from html.parser import HTMLParser

import matplotlib
import numpy as np
import pytest

from credo.analysis.statistics import bootstrap_interval
from credo.report import plots
from credo.report.page import (
    Curve,
    Figure,
    HeatMap,
    Page,
    Reference,
    Table,
    Text,
    Track,
    Tracks,
    write,
)
from credo.report.page import cell_text as shown

HOSTILE = '<script>alert(\'x\')</script> & "$a_$" id="f"'


def figure(**changes) -> Figure:
    rng = np.random.default_rng(0)
    curves = [Curve(f"depth {d}", np.arange(30), rng.random((4, 30))) for d in (2, 3)]
    arguments = {
        "title": "Success",
        "x_label": "generation",
        "y_label": "share",
        "curves": curves,
        "references": (Reference("floor", 0.25), Reference("ceiling", 1.0)),
    }
    return Figure(**(arguments | changes))


def heat_map(**changes) -> HeatMap:
    arguments = {
        "title": "Writes",
        "values": np.linspace(-1.0, 2.0, 15).reshape(3, 5),
        "row_labels": ["a", "b", "c"],
        "column_labels": list("12345"),
        "x_label": "step",
        "y_label": "cell",
    }
    return HeatMap(**(arguments | changes))


def tracks(**changes) -> Tracks:
    arguments = {
        "title": "Walk",
        "tracks": [
            Track("robot", [0, 1, 1, 2], ["", "told", "", ""]),
            Track("static", [0] * 4, (), True),
        ],
        "goals": [0, 2, 1, 1],
        "reached": [True, False, True, False],
        "row_labels": ["a", "b", "c"],
        "column_labels": list("1234"),
        "x_label": "trial",
        "y_label": "endpoint",
        "breaks": (2,),
    }
    return Tracks(**(arguments | changes))


class Reader(HTMLParser):
    """Tags, attributes and text; fails on a tag that is not closed."""

    VOID = {"meta", "link", "wbr"}

    def __init__(self, html: str):
        super().__init__()
        self.tags, self.attributes, self.text, self.stack = Counter(), [], [], []
        self.feed(html)
        assert self.stack == []

    def handle_starttag(self, tag, attrs):
        self.tags[tag] += 1
        self.attributes += attrs
        if tag not in self.VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags[tag] += 1
        self.attributes += attrs

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture(scope="module")
def html(tmp_path_factory) -> str:
    """A page with everything on it, the same figure twice, and a hostile string everywhere."""
    bad_curve = Curve(HOSTILE, [1, 10, 100], [[0.0, 1.0, np.nan]])
    bad = Figure(HOSTILE, HOSTILE, HOSTILE, [bad_curve], [Reference(HOSTILE, 0.5)], HOSTILE, True)
    page = Page(
        HOSTILE,
        HOSTILE,
        f"credo reproduce fig-3.4a {HOSTILE}",
        [
            Text(HOSTILE, [HOSTILE, "two"]),
            figure(),
            figure(),
            heat_map(row_labels=[HOSTILE, "b", "c"]),
            Table(HOSTILE, [HOSTILE, "n"], [(HOSTILE, 1.5), ("0.50", None)], HOSTILE),
            bad,
            tracks(tracks=[Track(HOSTILE, [0, 1, 2, 2], [HOSTILE] * 4)], goal_label=HOSTILE),
        ],
        {HOSTILE: HOSTILE},
    )
    path = write(page, tmp_path_factory.mktemp("page") / "new" / "report.html")
    assert [child.name for child in path.parent.iterdir()] == ["report.html"]
    return path.read_text(encoding="utf-8")


def test_page_is_well_formed_and_has_its_sections(html):
    page = Reader(html)
    assert page.tags["svg"] == 2 * 5
    assert page.tags["table"] == 2
    assert page.tags["title"] == page.tags["h1"] == page.tags["details"] == 1
    assert ("lang", "en") in page.attributes
    assert ("name", "viewport") in page.attributes
    labels = [value for name, value in page.attributes if name == "aria-label"]
    expected = "Success: share against generation; curves: depth 2, depth 3; "
    assert labels.count(f"{expected}references: floor at 0.25, ceiling at 1") == 4


def test_page_loads_nothing_from_anywhere(html):
    links = [value for name, value in Reader(html).attributes if name in ("href", "src")]
    assert links
    assert all(link.startswith(("#", "data:")) for link in links)
    assert set(re.findall(r"https?://[^\"' ]+", html)) == {"http://www.w3.org/2000/svg"}
    assert set(re.findall(r"url\((.)", html)) == {"#"}
    assert "@import" not in html


def test_whatever_a_label_holds_is_shown_and_never_run(html):
    page = Reader(html)
    assert page.tags["script"] == 0
    # Title, heading, lead; text twice; table five times; figure title and caption; two facts.
    assert sum(HOSTILE in text for text in page.text) >= 12
    assert "".join(page.text).count(f"credo reproduce fig-3.4a {HOSTILE}") == 1


def test_ids_differ_and_every_reference_stays_in_its_figure(html):
    drawings = re.findall(r"<svg.*?</svg>", html, flags=re.S)
    found = [set(re.findall(r'<[^>]* id="([^"]+)"', drawing)) for drawing in drawings]
    assert sum(map(len, found)) == len(set().union(*found))
    for drawing, ids in zip(drawings, found, strict=True):
        used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', drawing))
        assert used
        assert used <= ids


def test_text_of_a_figure_is_text_in_a_generic_font():
    svg = plots.figure_svg(figure())
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", svg)
    assert {"generation", "share", "depth 2", "depth 3", "floor", "ceiling"} <= set(texts)
    families = set(re.findall(r"font-family: ([^;\"]+)", svg))
    assert families == {plots.FONT}
    assert "<style" not in svg


def test_dark_and_light_differ_in_colour_alone():
    def without_colour(svg: str) -> str:
        # The id of a marker is a hash of its path and its colour.
        return re.sub(r"#[0-9a-f]{6}\b|\bm[0-9a-f]{10}\b", "", svg)

    light, dark = plots.figure_svg(figure()), plots.figure_svg(figure(), dark=True)
    assert light != dark
    assert without_colour(light) == without_colour(dark)
    assert light == plots.figure_svg(figure())
    assert plots.figure_svg(heat_map()) != plots.figure_svg(heat_map(), dark=True)


def drawn(item, dark=False):
    with matplotlib.rc_context(plots.STYLE):
        canvas = plots.draw(item, plots.DARK if dark else plots.LIGHT)
        canvas.draw_without_rendering()
    return canvas


@pytest.mark.parametrize("centre", ["mean", "median"])
def test_figure_draws_every_seed_the_centre_and_its_interval(centre):
    runs = np.random.default_rng(1).random((5, 12))
    axes = drawn(figure(curves=[Curve("a", np.arange(12), runs)], centre=centre)).axes[0]
    *seeds, thick, floor, ceiling = [line.get_ydata() for line in axes.lines]
    np.testing.assert_array_equal(seeds, runs)
    statistic = getattr(np, centre)
    np.testing.assert_array_equal(thick, statistic(runs, axis=0))
    assert set(floor) == {0.25}
    assert set(ceiling) == {1.0}
    low, high = bootstrap_interval(runs, statistic)
    band = axes.collections[0].get_paths()[0].vertices
    for x in range(12):
        assert {low[x], high[x]} == set(band[band[:, 0] == x, 1])


def test_a_curve_ends_where_a_seed_has_no_value():
    runs = np.ones((2, 4))
    runs[1, 2:] = np.nan, np.inf
    curve = plots.sampled(Curve("a", np.arange(4), runs), "mean", False, 400)
    assert np.isnan(curve.centre).tolist() == [False, False, True, True]
    assert np.isnan(curve.low).tolist() == [False, False, True, True]
    assert curve.runs[0].tolist() == [1.0] * 4


@pytest.mark.parametrize("log_x", [False, True])
def test_long_curves_are_picked_from_and_not_smoothed(log_x):
    x = np.arange(1.0, 15_001.0)
    runs = np.random.default_rng(2).random((2, 15_000))
    curve = plots.sampled(Curve("a", x, runs), "mean", log_x, 400)
    assert 200 < len(curve.x) <= 400
    assert (curve.x[0], curve.x[-1]) == (1.0, 15_000.0)
    np.testing.assert_array_equal(curve.runs, runs[:, curve.x.astype(int) - 1])
    gaps = np.diff(np.log(curve.x[-100:]) if log_x else curve.x)
    assert gaps.max() < 1.1 * gaps.min()


def test_note_says_what_is_drawn():
    long = Curve("a", np.arange(15_000), np.zeros((60, 15_000)))
    expected = "Thick: median of 60 seeds; thin: each seed; band: 95 % bootstrap interval of the "
    assert plots.note(figure(curves=[long, long], centre="median")) == (
        f"{expected}median. Up to 200 of 15,000 points are drawn, unsmoothed."
    )
    assert plots.note(figure(curves=[Curve("a", [0, 1], [[0, 1]])])) == "One seed per line."
    assert plots.note(heat_map(values=np.full((3, 5), np.nan))) == "Grey: no value."


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
    assert plots.spread_out([0.2, 0.5], [0.1, 0.1]) == [0.2, 0.5]
    np.testing.assert_allclose(plots.spread_out([0.5, 0.5], [0.1, 0.3]), [0.5, 0.7])
    np.testing.assert_allclose(plots.spread_out([0.98, 1.0], [0.1, 0.1]), [0.85, 0.95])


@pytest.mark.parametrize(
    ("last", "labels"), [(1e6, ["1", "100", "10k", "1M"]), (100.0, ["1", "2", "5", "10", "100"])]
)
def test_a_logarithmic_axis_has_labels_over_any_range(last, labels):
    x = np.geomspace(1, last, 9)
    item = figure(curves=[Curve("", x, x[None])], log_x=True, references=())
    canvas = drawn(item)
    assert canvas.legends == []
    assert set(labels) <= {label.get_text() for label in canvas.axes[0].get_xticklabels()}


def test_given_range_is_widened_for_the_references():
    low, high = drawn(figure(y_range=(0.5, 0.9))).axes[0].get_ylim()
    assert (low, high) == pytest.approx((0.25 - 0.0225, 1.0 + 0.0225))


def test_heat_map_of_both_signs_is_centred_on_the_colour_of_the_page():
    values = np.array([[-1.0, 0.0, 4.0]])
    for theme in (plots.LIGHT, plots.DARK):
        colors, low, high = plots.color_scale(values, theme)
        assert (low, high) == (-4.0, 4.0)
        middle = np.array(colors(0.5)[:3]) * 255
        expected = [int(theme.page[i : i + 2], 16) for i in (1, 3, 5)]
        np.testing.assert_allclose(middle, expected, atol=2)
    assert plots.color_scale(np.array([[1.0, 3.0]]), plots.LIGHT)[1:] == (1.0, 3.0)
    assert plots.color_scale(np.array([[2.0, np.nan]]), plots.LIGHT)[1:] == (1.5, 2.5)


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
    theme = plots.DARK if dark else plots.LIGHT
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
    assert plots.description(tracks()) == told
    assert plots.note(tracks()) == ""


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        ("0.50", "0.50"),
        ("-1", "-1"),
        (0.123456, "0.1235"),
        (-0.5, "−0.5"),
        (np.float32(0.25), "0.25"),
        (1_234_567.8, "1,234,568"),
        (1_000_000, "1,000,000"),
        (np.int64(-3), "−3"),
        (3e-7, "3e−07"),
        (None, "–"),
        (float("nan"), "–"),
        (float("inf"), "∞"),
        (True, "True"),
    ],
)
def test_cells(cell, text):
    assert shown(cell) == text


def test_numbers_stand_right_and_strings_left(html):
    assert re.search(r'<th scope="col" class="number">n</th>', html)
    assert '<td class="number">1.5</td>' in html
    assert "<td>0.50</td>" in html
    assert '<td class="number">–</td>' in html


def test_short_numbers_of_the_ticks():
    values = (0.0, -0.5, 950.0, 20_000.0, -1_500.0, 1e6, 2.5e9)
    assert [plots.short_number(v) for v in values] == [
        *("0", "−0.5", "950", "20k", "−1.5k", "1M", "2.5G")
    ]


def test_many_long_curves_stay_a_light_page(tmp_path):
    rng = np.random.default_rng(3)
    curves = [Curve(f"{d}", np.arange(1000), rng.random((10, 1000))) for d in range(9)]
    path = write(Page("p", "", "", [figure(curves=curves)]), tmp_path / "page.html")
    assert path.stat().st_size < 1_000_000


def test_png_is_written_with_its_title(tmp_path):
    path = plots.save_png(figure(), tmp_path / "figure.png", dark=True)
    header = path.read_bytes()[:24]
    assert header[:8] == b"\x89PNG\r\n\x1a\n"
    assert int.from_bytes(header[16:20]) == 960


def test_describing_a_page_loads_neither_jax_nor_matplotlib():
    program = (
        "import sys, credo.report.page; "
        "print([m for m in ('jax', 'matplotlib') if m in sys.modules])"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Curve("c", [1, 2, 3], [[1, 2]]), r"runs \[seeds, points\]"),
        (lambda: Curve("c", [1, 2], [1, 2]), r"runs \[seeds, points\]"),
        (lambda: Curve("c", [], np.zeros((3, 0))), "at least one"),
        (lambda: Curve("c", [2, 1], [[1, 2]]), "does not increase"),
        (lambda: Reference("r", float("nan")), "must be finite"),
        (lambda: figure(curves=[]), "at least one"),
        (lambda: figure(log_x=True), "not positive"),
        (lambda: figure(y_range=(1.0, 0.0)), r"give \(low, high\)"),
        (lambda: figure(centre="mode"), "'mean' or 'median'"),
        (lambda: heat_map(row_labels=["a"]), r"values must be \[rows, columns\]"),
        (lambda: tracks(goals=[0]), r"\[4, 1, 4, 4, 4\] outcomes, goals, rows and notes: give"),
        (lambda: tracks(tracks=[]), "0 tracks .* give at least one track"),
        (lambda: tracks(goals=[0, 1, 2, 3]), r"goal in rows \[0, 1, 2, 3\]: each must be in 0..2"),
        (lambda: Table("t", ["a", "b"], [("x",)]), "a row of 1 cells"),
    ],
)
def test_errors_say_what_is_allowed(make, message):
    with pytest.raises(ValueError, match=message):
        make()
