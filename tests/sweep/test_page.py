"""The page of a sweep says what its journal says, the same bytes each time."""

import dataclasses
import re

import pytest

from credo.report.sections import Drawing, Table
from credo.report.tables import shown
from credo.sweep import page
from credo.sweep.journal import COMPLETE, FAILED, PRUNED, Journal
from credo.sweep.plan import Plan
from credo.sweep.space import Range

pytest.importorskip("optuna", reason="Optuna is of the extra sweep")

RANGES = [
    Range("learner.actor-lr", low=1e-5, high=1e-3, log=True),
    Range("batch-size", low=64, high=512, step=64, whole=True),
    Range("breeder", ("genetic", "cem")),
    Range("decay", low=0.0, high=1.0, when=(("breeder", ("cem",)),)),
]
PLAN = Plan(trials=16, seeds=2, together=4, startup=8, sampler="random", seed=3)
SEEDS = range(7, 9)


def journal(folder, count, plan=PLAN):
    """So many trials: the fifth has failed, the ninth is pruned, the last one runs; the more
    `batch-size`, the better."""
    folder.mkdir(exist_ok=True)
    book = Journal(folder, plan, RANGES, owned=True)
    for number in range(count):
        trial = book.begin(number)
        size = float(trial.drawn["batch-size"])
        ended = dataclasses.replace(trial, scores=(size, size + 1), state=COMPLETE)
        if number == 4:
            ended = dataclasses.replace(trial, state=FAILED, why="seed 7: <script> & NaN")
        elif number == 8:
            ended = dataclasses.replace(trial, scores=(3.0,), state=PRUNED, why="3 after 1 seed")
        if number < count - 1:
            book.end(ended)
    return book


def sections(book, folder):
    return {x.title: x for x in page.describe(folder, book, "td3-Hopper-v5", SEEDS).sections}


def test_the_table_has_every_trial_the_best_first(tmp_path):
    book = journal(tmp_path, 16)
    table = sections(book, tmp_path)["Trials"]
    assert isinstance(table, Table)
    flags = ["learner.actor-lr", "batch-size", "breeder", "decay"]
    assert table.columns == ["trial", *flags, "seed 7", "seed 8", "IQM", "state"]
    rows = {row[0]: row for row in table.rows}
    assert sorted(map(int, rows)) == list(range(16))
    sizes = [float(row[2]) for row in table.rows[:-3]]
    assert sizes == sorted(sizes, reverse=True)
    assert table.marked == [0]
    assert [row[0] for row in table.rows[-3:]] == ["8", "15", "4"]
    assert rows["8"][5:] == [3.0, None, 3.0, "pruned: 3 after 1 seed"]
    assert rows["4"][-1] == "failed: seed 7: <script> & NaN"
    assert shown(rows["4"][7]).text == "–"
    assert rows["15"][-1] == "running"
    for trial in book.trials:
        assert (rows[str(trial.number)][4] is None) == (trial.drawn["breeder"] == "genetic")


def test_where_less_is_better_the_least_is_first(tmp_path):
    plan = dataclasses.replace(PLAN, direction="minimize")
    table = sections(journal(tmp_path, 16, plan), tmp_path)["Trials"]
    sizes = [float(row[2]) for row in table.rows[:-3]]
    assert sizes == sorted(sizes)


def test_the_page_says_which_trial_is_best_and_that_its_seeds_chose_it(tmp_path):
    book = journal(tmp_path, 16)
    told = page.describe(tmp_path, book, "td3-Hopper-v5", SEEDS)
    assert told.lead.startswith(
        "td3-Hopper-v5: 16 of 16 trials (13 complete, 1 pruned, 1 running, 1 failed), 2 seeds each."
    )
    largest = max((t.value, -t.number) for t in book.trials if t.state == COMPLETE)
    assert f"Best: trial {-largest[1]} with {largest[0]:.1f}" in told.lead
    assert "These seeds chose it" in told.lead
    assert told.facts["seeds of runs"] == "7, 8"
    winner = next(x for title, x in sections(book, tmp_path).items() if title.startswith("Best"))
    size = next(row for row in winner.rows if row[0] == "batch-size")
    assert size[2] == "64 … 512 by 64"
    assert float(size[1]) == largest[0] - 0.5


def test_figures_have_every_trial(tmp_path):
    found = sections(journal(tmp_path, 16), tmp_path)
    drawings = {title: x for title, x in found.items() if isinstance(x, Drawing)}
    assert list(drawings) == [
        "History of the search",
        "Importance of flags",
        "Parallel coordinates",
    ]
    for drawing in drawings.values():
        assert drawing.light.startswith("<svg")
        assert drawing.light != drawing.dark
    assert "values of 14 trials" in drawings["History of the search"].light
    names = re.search(r'aria-label="([^"]*)"', drawings["Importance of flags"].light)[1]
    assert names.startswith("batch-size ")  # which alone matters
    assert "of 13 trials over learner.actor-lr" in drawings["Parallel coordinates"].light
    for text in ("genetic", "cem", "512", "1e−05"):
        assert text in drawings["Parallel coordinates"].light


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_a_sweep_that_has_hardly_begun_has_a_page(tmp_path, count):
    found = sections(journal(tmp_path, count), tmp_path)
    assert len(found["Trials"].rows) == count
    assert ("History of the search" in found) == (count > 1)
    assert ("Parallel coordinates" in found) == (count > 2)
    assert "Importance of flags" not in found


def test_where_all_values_are_one_there_is_a_page(tmp_path):
    book = Journal(tmp_path, PLAN, RANGES, owned=True)
    for number in range(14):
        book.end(dataclasses.replace(book.begin(number), scores=(1.0, 1.0), state=COMPLETE))
    found = sections(book, tmp_path)
    assert "Parallel coordinates" in found
    assert "Importance of flags" not in found


def test_the_file_is_the_same_each_time_and_safe(tmp_path):
    book = journal(tmp_path, 16)
    path = page.write(tmp_path, book, "td3-Hopper-v5", SEEDS)
    text = path.read_text("utf-8")
    assert path == tmp_path / "report.html"
    assert page.write(tmp_path, book, "td3-Hopper-v5", SEEDS).read_text("utf-8") == text
    assert "&lt;script&gt; &amp; NaN" in text
    assert "seed 7: <script>" not in text
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))
