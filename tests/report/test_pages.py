"""Pages: well formed, self-contained, safe whatever a label holds; and their Markdown."""

import json
import re
import subprocess
import sys
from collections import Counter
from html.parser import HTMLParser

import numpy as np
import pytest
from samples import HOSTILE, figure, heat_map, tracks

from credo.report import tables
from credo.report.markup import markdown_text
from credo.report.pages import markdown, render, write
from credo.report.sections import (
    SMOKE,
    Curve,
    Drawing,
    Figure,
    Page,
    Reference,
    Summary,
    Table,
    Text,
    Track,
)
from credo.report.styles import STATIC
from credo.report.tables import shown


class Reader(HTMLParser):
    """Tags, attributes and text; fails on a tag that is not closed."""

    VOID = {"meta", "link", "br"}

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


def full_page() -> Page:
    """A page with everything on it, the same figure twice, and a hostile string everywhere."""
    bad_curve = Curve(HOSTILE, [1, 10, 100], [[0.0, 1.0, np.nan]])
    bad = Figure(HOSTILE, HOSTILE, HOSTILE, [bad_curve], [Reference(HOSTILE, 0.5)], HOSTILE)
    runs = Summary([0.25, 0.5, None], [0, 1, 2])
    return Page(
        HOSTILE,
        HOSTILE,
        f"credo reproduce fig-3.4a {HOSTILE}",
        [
            Text(HOSTILE, [HOSTILE, "two"]),
            figure(),
            figure(),
            heat_map(row_labels=[HOSTILE, "b", "c"], x_label=HOSTILE),
            Table(HOSTILE, [HOSTILE, "n"], [(HOSTILE, 1.5), ("0.50", None)], HOSTILE),
            Table(HOSTILE, [HOSTILE, "n"], [(HOSTILE, runs)], HOSTILE, [0], True),
            bad,
            tracks(tracks=[Track(HOSTILE, [0, 1, 2, 2], [HOSTILE] * 4)], goal_label=HOSTILE),
        ],
        {HOSTILE: HOSTILE, "several": [HOSTILE, "two"]},
        HOSTILE,
    )


@pytest.fixture(scope="module")
def html(tmp_path_factory) -> str:
    path = write(full_page(), tmp_path_factory.mktemp("page") / "new" / "report.html")
    assert [child.name for child in path.parent.iterdir()] == ["report.html"]
    return path.read_text(encoding="utf-8")


def test_page_is_well_formed_and_has_its_sections(html):
    page = Reader(html)
    assert page.tags["svg"] == 2 * 5 + 5  # of the legends one for each curve
    assert page.tags["table"] == 4  # with that of tracks, and provenance
    assert page.tags["title"] == page.tags["h1"] == 1
    assert page.tags["details"] == 2
    assert ("lang", "en") in page.attributes
    assert ("name", "viewport") in page.attributes
    labels = [value for name, value in page.attributes if name == "aria-label"]
    expected = "Success: share against generation; curves: depth 2, depth 3; "
    assert labels.count(f"{expected}references: baseline at 0.25, upper bound at 1") == 4


def test_page_loads_nothing_from_anywhere(html):
    links = [value for name, value in Reader(html).attributes if name in ("href", "src")]
    assert links
    assert all(link.startswith(("#", "data:")) for link in links)
    assert set(re.findall(r"https?://[^\"' ]+", html)) == {"http://www.w3.org/2000/svg"}
    assert set(re.findall(r"url\((.)", html)) == {"#"}
    assert "@import" not in html


def test_whatever_a_label_holds_is_shown_and_never_run(html):
    page = Reader(html)
    assert page.tags["script"] == 1
    (script,) = re.findall(r"<script>(.*?)</script>", html, flags=re.S)
    assert script == (STATIC / "page.js").read_text(encoding="utf-8")
    handlers = [name for name, _ in page.attributes if name.startswith("on")]
    assert handlers == []
    # Banner, title, heading, lead, text, tables, captions, facts.
    assert sum(HOSTILE in text for text in page.text) >= 16
    assert "".join(page.text).count(f"credo reproduce fig-3.4a {HOSTILE}") == 1
    tips = [value for name, value in page.attributes if name == "data-tips"]
    assert len(tips) == 4
    assert json.loads(tips[2])["rows"][0] == f"cell {HOSTILE}"


def test_ids_differ_and_every_reference_stays_in_its_figure(html):
    drawings = re.findall(r"<svg xmlns.*?</svg>", html, flags=re.S)
    assert len(drawings) == 10
    found = [set(re.findall(r'<[^>]* id="([^"]+)"', drawing)) for drawing in drawings]
    assert sum(map(len, found)) == len(set().union(*found))
    for drawing, ids in zip(drawings, found, strict=True):
        used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', drawing))
        assert used
        assert used <= ids


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
    assert shown(cell) == (text, "", "")


def test_numbers_stand_right_and_strings_left(html):
    assert re.search(r'<th scope="col" class="number">n</th>', html)
    assert '<td class="number">1.5</td>' in html
    assert '<th scope="row">0.50</th>' in html
    assert '<td class="number">–</td>' in html


@pytest.mark.parametrize(
    ("summary", "text", "small"),
    [
        (Summary([0.5]), "0.500", ""),
        (Summary([0.5], digits=1), "0.5", ""),
        # Means of two draws from {0, 1}: 0, ½, 1 with ¼, ½, ¼.
        (Summary([0.0, 1.0], [3, 4]), "0.50 [0.00, 1.00]", "0.00, 1.00"),
        (Summary([0.5, 0.5, 0.5], scale=100.0), "50.0 [50.0, 50.0]", "50.0, 50.0, 50.0"),
        (Summary([12345.0, 12345.0]), "12,345 [12,345, 12,345]", "12,345, 12,345"),
        (Summary([-0.2, -0.2]), "−0.200 [−0.200, −0.200]", "−0.200, −0.200"),
        (Summary([1.0, None, float("nan"), 1.0]), "1.00 [1.00, 1.00]", "1.00, –, –, 1.00"),
        (Summary([None, float("nan")]), "–", ""),
        (Summary([0.0, 0.0]), "0 [0, 0]", "0, 0"),
        (Summary([1.0] * 5 + [3.0, None]), "1.33 [1.00, 2.00]", "1.00 … 3.00, n = 6"),
    ],
)
def test_a_summary_is_its_mean_with_an_interval_and_every_run(summary, text, small):
    found = shown(summary)
    assert (found.text, found.small) == (text, small)


def test_a_summary_tells_every_seed_and_its_column_what_it_is():
    runs = Summary([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], range(10, 16))
    page = Page("p", "", "", [Table("t", ["method", "share"], [["a", runs]])])
    html = render(page)
    every = ", ".join(f"seed {10 + i}: 0.{i + 1}00" for i in range(6))
    assert f'title="{every}"' in html
    assert '<th scope="col" class="number">share</th>' in html
    assert "<small>0.100 … 0.600, n = 6</small>" in html
    assert tables.NOTE in html


def test_interval_of_a_summary_is_known_where_all_resamples_can_be_counted():
    # All 3125 resamples of five values: the quantiles of their means.
    x = np.array([0.1, 0.4, 0.5, 0.9, 1.7])
    every = x[np.stack(np.meshgrid(*[range(5)] * 5)).reshape(5, -1)].mean(axis=0)
    value, low, high = tables.mean(x)
    assert value == pytest.approx(0.72)
    np.testing.assert_allclose([low, high], np.quantile(every, [0.025, 0.975]), atol=0.03)
    assert np.isnan(tables.mean([0.5])[1:]).all()


def test_a_banner_stands_before_everything(tmp_path):
    page = Page("p", "lead", "", [], banner=SMOKE)
    html = render(page)
    assert html.index(SMOKE) < html.index("<h1>")
    assert f"> **{SMOKE}**" in markdown(page, tmp_path).read_text(encoding="utf-8")


def test_what_differs_is_marked_and_a_folded_table_opens():
    table = Table("t", ["setting", "a"], [["x", "1"], ["y", "2"]], marked=[1], folded=True)
    html = render(Page("p", "", "", [table]))
    assert "<details><summary>t</summary>" in html
    (row,) = re.findall(r'<tr class="marked">(.*?)</tr>', html, flags=re.S)
    assert "y" in row
    assert "●" in row
    assert html.count("●") == 1


def test_provenance_is_a_table():
    html = render(Page("p", "", "", [], {"machine": "one", "runs": ["a", "b"]}))
    assert '<tr><th scope="row">machine</th><td>one</td></tr>' in html
    assert '<tr><th scope="row">runs</th><td>a<br>b</td></tr>' in html


def test_curves_of_one_label_look_alike_in_all_figures_of_a_page():
    x = np.arange(30)
    other = figure(curves=[Curve(name, x, [x * 0.1]) for name in ("new", "depth 3", "td3")])
    html = render(Page("p", "", "", [figure(), other]))
    found = re.findall(r'style="(stroke: var[^"]*)"/></svg>(depth 3|td3|new|depth 2)<', html)
    looks = {}
    for look, name in found:
        looks.setdefault(name, set()).add(look)
    assert {name: len(of) for name, of in looks.items()} == dict.fromkeys(looks, 1)
    assert len(set.union(*looks.values())) == len(looks) == 4


def test_neighbouring_figures_stand_together():
    html = render(Page("p", "", "", [figure(), figure(), Text("t", ["x"]), figure()]))
    assert re.findall(r'<div class="(figures[^"]*)">', html) == ["figures", "figures alone"]


def test_markdown_has_tables_and_pictures_beside_it(tmp_path):
    drawing = Drawing("Paths", "<svg id='a'/>", "<svg id='b'/>")
    runs = Summary([0.25, 0.25], [0, 1])
    many = Summary([0.5] * 6, range(6))
    rows = [["a|b", runs, 1], ["c", many, None]]
    table = Table("Scores", ["method", "share", "n"], rows, "By `credo`.", marked=[1])
    page = Page("Title", "A lead.", "credo x", [figure(), table, drawing], {"seeds": ["0", "1"]})
    (tmp_path / "figure-7-light.svg").write_text("of an earlier page")
    (tmp_path / "figure.svg").write_text("of somebody")
    path = markdown(page, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "README.md",
        *(f"figure-{i}-{theme}.svg" for i in (1, 2) for theme in ("dark", "light")),
        "figure.svg",
    ]
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    assert lines[:6] == ["# Title", "", "A lead.", "", "Made by", ""]
    assert lines[6:9] == ["```sh", "credo x", "```"]
    i = lines.index("| method | share | n |")
    assert lines[i - 1] == ""
    assert lines[i + 1] == "| --- | ---: | ---: |"
    small = "0.250 [0.250, 0.250]<br><sub>0.250, 0.250</sub>"
    assert lines[i + 2] == f"| a\\|b | {small} | 1 |"
    assert lines[i + 3].startswith("| ● c | 0.500 [0.500, 0.500]<br><sub>0.500 … 0.500, n = 6")
    assert "By `credo`." in text
    assert "- c, share: seed 0: 0.500, seed 1: 0.500" in text
    assert "| seeds | 0<br>1 |" in text
    assert 'srcset="figure-1-dark.svg"><img src="figure-1-light.svg"' in text
    svg = (tmp_path / "figure-1-light.svg").read_text(encoding="utf-8")
    assert svg.startswith('<svg xmlns="http://www.w3.org/2000/svg"')
    assert ">depth 2</text>" in svg  # it has its legend inside
    assert (tmp_path / "figure-2-dark.svg").read_text() == "<svg id='b'/>\n"


def test_the_same_page_is_the_same_markdown(tmp_path):
    a, b = (markdown(full_page(), tmp_path / name).parent for name in "ab")
    assert {p.name: p.read_bytes() for p in a.iterdir()} == {
        p.name: p.read_bytes() for p in b.iterdir()
    }


def test_nothing_a_label_holds_is_markup_in_markdown(tmp_path):
    text = markdown(full_page(), tmp_path).read_text(encoding="utf-8")
    outside = re.sub(r"```+.*?```+", "", text, flags=re.S)
    assert "<script" not in outside
    assert set(re.findall(r"<(/?[a-z0-9]+)", outside)) <= {
        *("picture", "source", "img", "/picture", "details", "/details", "summary", "/summary"),
        *("br", "sub", "/sub"),
    }
    # Inside HTML, as in the summary of a folded table, a link of Markdown is none.
    lines = [x for x in outside.splitlines() if not x.startswith(("<details>", "<picture>"))]
    assert all("](b)" not in line.replace("\\](b)", "") for line in lines)
    assert all(line.count("`") == line.count("\\`") for line in lines)
    rows = [line for line in outside.splitlines() if line.startswith("| ")]
    assert {len(re.findall(r"(?<!\\)\|", row)) for row in rows} <= {3, 4}


@pytest.mark.parametrize(
    ("text", "escaped"),
    [
        ("champion_score of 3 * 4", "champion_score of 3 \\* 4"),
        ("_a_ | $x$", "\\_a\\_ \\| \\$x\\$"),
        ("# no heading", "\\# no heading"),
        ("1. no list", "1\\. no list"),
        ("-0.5 [0, 1]", "-0.5 [0, 1]"),
        ("a\nb <b>", "a b &lt;b&gt;"),
    ],
)
def test_text_in_markdown(text, escaped):
    assert markdown_text(text) == escaped


def test_many_long_curves_stay_a_light_page(tmp_path):
    rng = np.random.default_rng(3)
    curves = [Curve(f"{d}", np.arange(1000), rng.random((10, 1000))) for d in range(9)]
    path = write(Page("p", "", "", [figure(curves=curves)]), tmp_path / "page.html")
    assert path.stat().st_size < 1_000_000


def test_describing_a_page_loads_neither_jax_nor_matplotlib():
    program = (
        "import sys, credo.report.sections; "
        "print([m for m in ('jax', 'matplotlib', 'scipy') if m in sys.modules])"
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
        (lambda: figure(y_range=(1.0, 0.0)), r"give \(low, high\)"),
        (lambda: heat_map(row_labels=["a"]), r"values must be \[rows, columns\]"),
        (lambda: tracks(goals=[0]), r"\[4, 1, 4, 4, 4\] outcomes, goals, rows and notes: give"),
        (lambda: tracks(tracks=[]), "0 tracks .* give at least one track"),
        (lambda: tracks(goals=[0, 1, 2, 3]), r"goal in rows \[0, 1, 2, 3\]: each must be in 0..2"),
        (lambda: Table("t", ["a", "b"], [("x",)]), "a row of 1 cells"),
        (lambda: Summary([1.0, 2.0], [0]), "2 values and 1 seeds"),
    ],
)
def test_errors_say_what_is_allowed(make, message):
    with pytest.raises(ValueError, match=message):
        make()
