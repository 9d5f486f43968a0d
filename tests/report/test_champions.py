"""What a page draws of a champion: its graph, its heads, its memory."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

from credo.algorithms.neat import NEAT
from credo.algorithms.neuroevolution import Neuroevolution
from credo.analysis import probes
from credo.environments.passive_tmaze import PassiveTMaze
from credo.environments.probes import Remember
from credo.environments.sequence_copy import SequenceCopy
from credo.networks.dnc import DNC
from credo.networks.graph import Graph, GraphPolicy
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.ntm import NTM
from credo.report import champions, run_page, sections, styles
from credo.report.sections import Drawing, HeatMap, Table
from credo.runs.loop import train
from credo.runs.store import Run

QUIET = {"progress": False, "tensorboard": False}
COPY = SequenceCopy(bits=1, max_length=2)


def trained(algorithm, tmp_path):
    train(algorithm, path=tmp_path / "run", generations=1, **QUIET)
    return Run(tmp_path / "run")


def evolved(network, tmp_path, env=COPY):
    sizes = {"population_size": 2, "episodes": 1, "test_episodes": 1}
    return trained(Neuroevolution(env, network, **sizes), tmp_path)


def made(weights, outputs, hidden, cells="rnn"):
    """A network of these connections, `(row, column): weight`, 2 inputs and a bias."""
    network = Graph(hidden=hidden, cells=cells)
    matrix = np.zeros((network.sockets(outputs), network.sources(2, outputs)), np.float32)
    for place, weight in weights.items():
        matrix[place] = weight
    return GraphPolicy(jnp.asarray(matrix), outputs, network)


def test_the_table_names_every_connection_and_where_it_ends():
    """Rows: y1, then hidden units; columns: x1, x2, bias, y1, h1, h2."""
    picture, table = champions.graph(
        made({(0, 0): 0.5, (1, 1): -2.0, (0, 4): 1.0, (1, 4): 0.25}, 1, 2)
    )
    assert table.columns == ["from", "to", "weight"]
    assert table.rows == [
        ["x2", "h1", -2.0],
        ["h1", "y1", 1.0],
        ["x1", "y1", 0.5],
        ["h1", "h1", 0.25],
    ]
    assert "4 connections, 1 hidden unit" in picture.caption
    for svg in (picture.light, picture.dark):
        names = set(re.findall(r"<!-- (\w+) -->", svg)) or set(re.findall(r">([xyh1]\d?)<", svg))
        assert "h2" not in names  # it has no connection


def test_gates_are_named():
    """Rows of one LSTM cell: y1, block input, input, forget and output gate."""
    gates = {(0, 4): 1.0, (1, 0): 4.0, (2, 1): 3.0, (3, 2): 2.0, (4, 0): -0.5}
    _, table = champions.graph(made(gates, 1, 1, "lstm"))
    assert table.columns == ["from", "to", "ends at", "weight"]
    assert table.rows == [
        ["x1", "h1", "block input", 4.0],
        ["x2", "h1", "input gate", 3.0],
        ["1", "h1", "forget gate", 2.0],
        ["h1", "y1", "block input", 1.0],
        ["x1", "h1", "output gate", -0.5],
    ]


def test_connections_of_a_unit_with_itself_are_seen_beside_its_marker(monkeypatch):
    """One at each place of an LSTM cell; the marker reaches 7.5 points from its middle."""
    paints = []

    def drawing(title, label, paint, caption, height):
        paints.append(paint)
        return Drawing(title, "", "", caption)

    monkeypatch.setattr(champions, "drawing", drawing)
    ports = {(port, 4): 1.0 for port in (1, 2, 3, 4)}
    champions.graph(made({(0, 4): 1.0} | ports, 1, 1, "lstm"))
    canvas = Figure(figsize=(7, 3), dpi=72)
    axes = canvas.add_subplot()
    paints[0](canvas, axes, styles.LIGHT)
    canvas.draw_without_rendering()
    middle = next(text for text in axes.texts if text.get_text() == "h1").get_window_extent()
    above = [patch.get_window_extent().y1 - (middle.y0 + middle.y1) / 2 for patch in axes.patches]
    loops = sorted(height for height in above if height > 7.5)
    assert len(loops) == 4
    assert np.all(np.diff(loops) > 2)  # and none hides another


def test_units_stand_in_columns_by_their_distance_from_the_inputs():
    """x1 → h1 → h2 → y1, and h3, which nothing feeds but itself."""
    weights = {(1, 0): 1.0, (2, 4): 1.0, (0, 5): 1.0, (3, 6): 1.0, (0, 6): 1.0}
    policy = made(weights, 1, 3)
    places = champions.placed(champions.fixed_of(policy), champions.edges_of(policy))
    assert [places[name][0] for name in ("x1", "h1", "h2", "y1")] == [0, 1 / 3, 2 / 3, 1]
    assert places["x1"][1] > places["x2"][1] > places["1"][1]
    assert 0 < places["h3"][0] < 1


def test_a_network_without_any_connection_is_drawn():
    picture, table = champions.graph(made({}, 2, 1))
    assert table.rows == []
    assert "0 connections" in picture.caption


def test_a_run_of_neat_shows_its_graph_on_the_page(tmp_path):
    sizes = {"population_size": 4, "episodes": 2, "test_episodes": 2}
    run = trained(NEAT(Remember(1), Graph(hidden=2), **sizes), tmp_path)
    sections = run_page.describe({"neat": [run]}, [run.path]).sections
    assert [type(s) for s in sections if s.title.endswith("champion")] == [Drawing, Table]
    path = run_page.write([run.path], tmp_path / "report.html")
    assert "Network of the champion" in path.read_text()


@pytest.mark.parametrize(
    ("network", "titles"),
    [
        (NTM("feedforward", 3, 4, 2, read_heads=2), ["writing head", "reading head 1", "2"]),
        (DNC(hidden=3, rows=4, width=2, read_heads=1), ["writing head", "reading head"]),
    ],
)
def test_heads_are_shown_row_by_row(network, titles, tmp_path):
    run = evolved(network, tmp_path)
    maps = [x for x in champions.pictures(run) if isinstance(x, HeatMap)]
    assert len(maps) == len(titles)
    for shown, title in zip(maps, titles, strict=True):
        assert title in shown.title
        assert shown.row_labels == ["1", "2", "3", "4"][: len(shown.row_labels)]
        assert len(shown.column_labels) == np.shape(shown.values)[1] >= 3
        sums = np.sum(shown.values, axis=0)
        assert (sums <= 1 + 1e-5).all()


def test_memory_cells_are_shown(tmp_path):
    found = champions.pictures(evolved(MMU(hidden=3), tmp_path))
    (shown,) = (x for x in found if isinstance(x, HeatMap))
    assert np.shape(shown.values)[0] == 3
    assert shown.y_label == "memory cell"


def test_networks_without_memory_have_no_picture(tmp_path):
    assert list(champions.pictures(evolved(MLP(hidden=(2,)), tmp_path))) == []


def test_of_sequences_a_long_one_is_shown_and_empty_rows_are_not(tmp_path):
    """A memory of which the heads use the first two rows alone."""
    env = SequenceCopy(bits=1, max_length=6)
    assert int(champions._shown(env).sequences.length[0]) > 10
    values = np.zeros((9, 5))
    values[:, 0], values[3, 1], values[4, 2] = 1.0, 0.5, 0.005
    (shown,) = champions._map("Where it is", values, "row")
    assert shown.row_labels == ["1", "2"]
    assert "Nothing reaches 0.01 in the 3 rows" in shown.caption
    assert list(champions._map("Where it is", values * np.nan, "row")) == []
    assert list(champions._map("What it remembers", values * 0.0, "cell")) == []


class TestProbes:
    """Beside what a network keeps, how long it keeps it, and where."""

    @pytest.fixture(scope="class")
    @classmethod
    def shown(cls, tmp_path_factory):
        run = evolved(MMU(hidden=3), tmp_path_factory.mktemp("probes"), PassiveTMaze(3))
        return list(champions.pictures(run))

    def test_the_horizon_curve_has_four_lengths(self, shown):
        (curve,) = (x for x in shown if isinstance(x, sections.Figure))
        assert np.asarray(curve.curves[0].x).tolist() == [1, 2, 5, 10]
        assert np.shape(curve.curves[0].runs) == (1, 4)
        assert "× 10: length 30" in curve.caption
        assert curve.y_label == "success"

    def test_every_cell_has_a_row(self, shown):
        (table,) = (x for x in shown if isinstance(x, Table))
        assert sorted(row[0] for row in table.rows) == ["1", "2", "3"]
        assert all(0 <= x <= 1 for row in table.rows for x in row[1:])
        assert table.columns == ["cell", "success without it", "success with it alone"]

    def test_the_most_needed_of_many_cells_come_first(self, monkeypatch):
        without = np.ones(20)
        without[[4, 9]] = 0.25, 0.5
        worth = probes.Worth(1.0, without, np.zeros(20), 0.0)
        monkeypatch.setattr(champions, "worth_of_cells", lambda *_, **__: worth)
        policy = MMU(hidden=20).init(2, 2, key=jax.random.key(0))
        (table,) = champions.cells(PassiveTMaze(3), policy)
        assert [row[0] for row in table.rows[:2]] == ["5", "10"]
        assert len(table.rows) == champions.ROWS
        assert f"The {champions.ROWS} most needed of 20 cells" in table.caption

    def test_what_would_take_long_is_left_out(self, monkeypatch):
        policy = MMU(hidden=3).init(2, 2, key=jax.random.key(0))
        monkeypatch.setattr(champions, "MOST", 20)
        (curve,) = champions.horizon(PassiveTMaze(3), policy)
        assert np.asarray(curve.curves[0].x).tolist() == [1, 2, 5]
        monkeypatch.setattr(champions, "STEPS", 8 * champions.PLAYED * 4 - 1)
        assert not list(champions.cells(PassiveTMaze(3), policy))

    def test_no_curve_where_the_task_has_no_setting_for_it(self, tmp_path):
        run = evolved(MMU(hidden=2), tmp_path, Remember(delay=1))
        assert not [x for x in champions.pictures(run) if isinstance(x, sections.Figure)]
