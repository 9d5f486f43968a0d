"""What is drawn of traces: pages that play, films and figures show exactly what was played."""

import dataclasses
import json
import os
import pathlib
import re
import shutil
import subprocess
import types
from html.parser import HTMLParser

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from PIL import Image

from credo.algorithms.merl import MERL
from credo.environments.extended_tmaze import ExtendedTMaze
from credo.environments.rover import Rover
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_recall import SequenceRecall
from credo.environments.server_fleet import ServerFleet
from credo.environments.simple_spread import SimpleSpread
from credo.environments.viewer import Mark, Viewer
from credo.environments.wrappers import DelayedReward, NoisyObservations
from credo.networks.base import AbstractPolicy
from credo.networks.dmmu import DMMU
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent
from credo.networks.team import Team
from credo.report import trajectories, viewer
from credo.report.watch import watch
from credo.rollout import record
from credo.runs import checkpoint, config, files
from credo.runs.record import RunError
from credo.runs.store import Run

ENV = Rover(coupling=2, rovers=3, pois=2, size=8.0, max_steps=9)
NETWORK = Team(trunk=(4,), head=Recurrent("gru", 3))
SHOWN = ("position", "heading", "poi", "observed", "inside", "share", "sensors")


class Seeker(AbstractPolicy):
    """Turns to where the outer ring is strongest and drives there."""

    speed: jax.Array

    def start(self, *, key):
        return None

    def __call__(self, obs, carry):
        bracket = jnp.argmax(obs[:, 36:], axis=1).astype(jnp.float32)
        turn = (bracket + 0.5) / 18.0
        turn = jnp.where(turn > 1.0, turn - 2.0, turn)
        return jnp.stack([turn, jnp.full_like(turn, self.speed)], axis=1), carry


SEEKER = Seeker(jnp.float32(1.0))


def traces_of(env, policy, seeds):
    return {f"seed {s}": record(env, policy, key=jax.random.key(s)) for s in seeds}


@pytest.fixture(scope="module")
def traces():
    return traces_of(ENV, SEEKER, [3, 4, 5])


class Episode(types.SimpleNamespace):
    """What is drawn of a rover's trace, by name."""


def episode_of(env, trace):
    return Episode(**env.viewer().episode(trace), rewards=trace.rewards)


@pytest.fixture(scope="module")
def episodes(traces):
    return [episode_of(ENV, trace) for trace in traces.values()]


def made(path, env=ENV) -> Run:
    """A run on disk whose champion has fresh weights."""
    path.mkdir()
    algorithm = MERL(env, NETWORK, learners=(), population_size=10)
    policy = NETWORK.init(*env.sizes, key=jax.random.key(7))
    checkpoint.export_policy(path / "champion.safetensors", policy)
    files.write_json(path / "config.json", {"algorithm": config.to_tree(algorithm), "seed": 0})
    return Run(path)


def embedded(html):
    """The data in a page."""
    (text,) = re.findall(r'<script type="application/json">(.*?)</script>', html, re.S)
    return json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} in the page"))


def test_an_episode_agrees_with_itself(episodes):
    assert len({len(episode.position) for episode in episodes}) > 1  # some end early
    assert sum(episode.observed[-1].sum() for episode in episodes) >= 3
    for episode in episodes:
        frames = len(episode.position)
        assert episode.sensors.shape == (frames, 3, 2, 36)
        # A POI is observed at the end of the first step with two rovers inside, and stays so.
        enough = episode.inside >= 2
        enough[0] = False
        np.testing.assert_array_equal(episode.observed, np.logical_or.accumulate(enough, axis=0))
        np.testing.assert_allclose(episode.share, episode.observed.mean(axis=1))
        assert episode.rewards["global"][-1] == episode.share[-1]
        # The strongest bar of the outer ring is the closest unobserved POI, as local says.
        for t in range(frames):
            if not episode.observed[t].all():
                closest = 1 / episode.sensors[t, :, 1].max(axis=1) - 1
                way = episode.poi[~episode.observed[t]] - episode.position[t][:, None]
                np.testing.assert_allclose(
                    closest, np.linalg.norm(way, axis=2).min(axis=1), rtol=1e-3, atol=1e-4
                )


def test_the_share_of_a_graded_reward_counts_who_was_near():
    graded = {"graded": True, "rewards": ("global",), "poi_values": (1.0, 3.0)}
    env = dataclasses.replace(ENV, activation_distance=0.2, **graded)
    for name, trace in traces_of(env, SEEKER, [0, 1]).items():
        episode = episode_of(env, trace)
        assert list(episode.rewards) == ["global"]
        np.testing.assert_allclose(episode.share[-1], episode.rewards["global"][-1], rtol=1e-6)
        assert 0 < episode.share[1] < 1
        html = viewer.page(env.viewer(), {name: trace}, title="A")
        assert list(embedded(html)["episodes"][0]["rewards"]) == ["global"]


def test_the_page_holds_the_episodes_bit_for_bit(tmp_path, traces, episodes):
    path = viewer.write(ENV.viewer(), traces, tmp_path / "new" / "a.html", title="A <b>")
    assert [p.name for p in path.parent.iterdir()] == ["a.html"]
    html = path.read_text()
    assert "<h1>A &lt;b&gt;</h1>" in html
    data = embedded(html)
    task = data["task"]
    assert (task["size"], task["activation_distance"]) == (8, 3)
    assert task["needed"] == [2, 2]
    assert [e["name"] for e in data["episodes"]] == ["seed 3", "seed 4", "seed 5"]
    for shown, episode in zip(data["episodes"], episodes, strict=True):
        for name in SHOWN:
            told, meant = np.array(shown[name]), getattr(episode, name)
            np.testing.assert_array_equal(told.astype(meant.dtype), meant)
        assert shown["rewards"].keys() == episode.rewards.keys() == {"global", "local"}
        for name, reward in episode.rewards.items():
            told = np.array(shown["rewards"][name], np.float32)
            np.testing.assert_array_equal(told, reward)


def test_sensors_as_coded_are_cut_out_of_their_own_layout():
    env = dataclasses.replace(ENV, observation="as-coded")
    policy = NETWORK.init(*env.sizes, key=jax.random.key(0))
    played = traces_of(env, policy, [0])
    seen, sensors = played["seed 0"].observations, episode_of(env, played["seed 0"]).sensors
    np.testing.assert_array_equal(sensors[:, :, 0], seen[:, :, 1:37])
    np.testing.assert_array_equal(sensors[:, :, 1], seen[:, :, 37:73])
    html = viewer.page(env.viewer(), played, title="A")
    assert embedded(html)["task"]["observation"] == "as-coded"


class Reader(HTMLParser):
    """Elements with their attributes, and the text of each option."""

    def __init__(self, html):
        super().__init__()
        self.elements, self.options = [], {}
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data):
        tag, attrs = self.elements[-1] if self.elements else ("", {})
        if tag == "option" and data.strip():
            select = [a["class"] for t, a in self.elements if t == "select"][-1]
            self.options.setdefault(select, []).append((attrs, data))


def test_the_page_has_its_controls_and_asks_nobody(traces):
    html = viewer.page(ENV.viewer(), traces, title="A", speed=7.5)
    read = Reader(html)
    kinds = {attrs.get("class"): (tag, attrs) for tag, attrs in read.elements}
    for name, tag in (("play", "button"), ("time", "input"), ("field", "svg")):
        assert kinds[name][0] == tag
    assert kinds["play"][1]["aria-label"] == "Play"
    assert (kinds["time"][1]["type"], kinds["time"][1]["aria-label"]) == ("range", "Time step")
    assert [label for _, label in read.options["episode"]] == ["seed 3", "seed 4", "seed 5"]
    assert [label for _, label in read.options["agent"]] == ["0", "1", "2"]
    speeds = {label: attrs for attrs, label in read.options["speed"]}
    assert [label for label, attrs in speeds.items() if "selected" in attrs] == ["7.5 steps/s"]
    assert speeds["20 steps/s"]["value"] == "20"
    # No address but the name of SVG, which nobody looks up.
    assert set(re.findall(r"\w+://[^\"' ]+", html)) == {"http://www.w3.org/2000/svg"}
    assert not [
        attrs for tag, attrs in read.elements if tag in ("script", "img") and "src" in attrs
    ]
    assert "prefers-color-scheme: dark" in html


DRIVE = """<script>addEventListener('load', () => {
  const say = () => document.title += '|' + document.querySelector('.step').textContent + ', ' +
    document.querySelector('.who').textContent + ', ' +
    document.querySelectorAll('.dot.seen').length + ' seen, ' +
    document.querySelectorAll('.arc.lit').length + ' lit, ' +
    document.querySelectorAll('.sensors path.others, .sensors path.pois').length + ' bars';
  const press = key => document.body.dispatchEvent(
    new KeyboardEvent('keydown', {key, bubbles: true}));
  document.title = '';
  say();
  press('ArrowRight'); press('ArrowRight'); press('ArrowLeft'); press('ArrowDown'); say();
  document.querySelectorAll('g.rover')[2].dispatchEvent(new MouseEvent('click', {bubbles: true}));
  press('End'); say();
});</script>"""


def browsed(path):
    """The page's title and whole text once a browser has shown it."""
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    browser = next(filter(None, map(shutil.which, names)), None)
    if browser is None:
        pytest.skip("no Chromium on this machine")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=1000"]
    command = [browser, *options, f"--user-data-dir={path.parent / 'profile'}", "--dump-dom"]
    page = subprocess.run([*command, path.as_uri()], capture_output=True, text=True, timeout=60)
    return re.findall("<title>(.*?)</title>", page.stdout)[0], page.stdout  # marks have titles too


def test_a_browser_shows_it(tmp_path, traces, episodes):
    episode = episodes[0]
    path = viewer.write(ENV.viewer(), {"seed 3": traces["seed 3"]}, tmp_path / "a.html", title="A")
    path.write_text(path.read_text().replace("</body>", DRIVE + "</body>"))
    title, _ = browsed(path)
    last = len(episode.position) - 1
    expected = []
    for t, rover in ((0, 0), (1, 1), (last, 2)):
        over = ", the task ended" if t == last else ""
        seen, lit = episode.observed[t].sum(), np.minimum(episode.inside[t], 2).sum()
        bars = (episode.sensors[t, rover] > 0).sum()
        expected.append(
            f"step {t} of {last}{over}, What rover {rover} senses, {seen} seen, {lit} lit, "
            f"{bars} bars"
        )
    assert title.split("|")[1:] == expected


def test_a_name_cannot_end_the_script(traces):
    evil = "</script><script>alert(1)"
    html = viewer.page(ENV.viewer(), {evil: traces["seed 3"]}, title=evil)
    assert "</script><script>alert" not in html
    assert embedded(html)["episodes"][0]["name"] == evil
    lead = dataclasses.replace(
        ENV.viewer(), lead=evil, agent=evil, legend=(Mark("dot", "c0", evil),)
    )
    html = viewer.page(lead, traces, title="A")
    assert "</script><script>alert" not in html
    assert embedded(html)["legend"][0]["text"] == evil


def test_what_cannot_be_replayed_is_told(traces):
    with pytest.raises(ValueError, match="no episode to play"):
        viewer.page(ENV.viewer(), {}, title="A")
    rewards = {"global": np.full(traces["seed 3"].length, np.nan)}
    broken = dataclasses.replace(traces["seed 3"], rewards=rewards)
    with pytest.raises(ValueError, match="not finite: it cannot be replayed"):
        viewer.page(ENV.viewer(), {"a": broken}, title="A")


MAZE = ExtendedTMaze(depth=2, robots=2, objective="spread", corridor=(1, 3))
MEMORY = Team(trunk=(), head=MMU(hidden=3, output_activation="tanh"), sharing="nothing")
TASKS = {
    "maze": (DelayedReward(MAZE), MEMORY),
    "fleet": (ServerFleet.case_study(), DMMU(hidden=3)),
    "recall": (SequenceRecall(depth=2), MMU(hidden=3)),
    "classification": (NoisyObservations(SequenceClassification(depth=3), 0.1), MMU(hidden=3)),
}
SAY = """<script>
const failed = []; addEventListener('error', event => failed.push(event.message));
addEventListener('load', () => {
  const press = key => document.body.dispatchEvent(
    new KeyboardEvent('keydown', {key, bubbles: true}));
  press('ArrowRight'); press('ArrowDown'); press('End');
  document.title = document.querySelector('.step').textContent + '|' +
    document.querySelector('.rewards td:last-child').textContent + '|' +
    document.querySelectorAll('.legend li').length + '|' +
    document.querySelectorAll('.memory canvas').length + '|' + failed;
});</script>"""


@pytest.mark.parametrize("name", TASKS)
def test_every_world_plays_to_its_end_in_a_browser(tmp_path, name):
    env, network = TASKS[name]
    policy = network.init(*env.sizes, key=jax.random.key(0))
    trace = record(env, policy, key=jax.random.key(1))
    path = viewer.write(env.viewer(), {"seed 1": trace}, tmp_path / "a.html", title="A")
    path.write_text(path.read_text().replace("</head>", SAY + "</head>"))
    title, page = browsed(path)
    ended = "the task ended" if trace.terminated else "time ran out"
    paid = f"{float(next(iter(trace.rewards.values())).sum()):.2f}".replace("-", "\u2212")
    marks = len(env.viewer().legend)
    assert title == f"step {trace.length} of {trace.length}, {ended}|{paid}|{marks}|1|"
    assert "NaN" not in page.split("</script>")[-1]


def test_a_page_holds_the_memory_of_all_or_of_each():
    shown = {}
    for name, (env, network) in TASKS.items():
        policy = network.init(*env.sizes, key=jax.random.key(0))
        trace = record(env, policy, key=jax.random.key(1))
        html = viewer.page(env.viewer(), {"seed 1": trace}, title="A")
        shown[name] = embedded(html)["episodes"][0]
        shared = shown[name]["memory"]["shared"]
        values = np.float32(shown[name]["memory"]["values"])
        carry = trace.carries.memory if name == "fleet" else trace.carries[1]
        assert shared == (name != "maze")
        np.testing.assert_array_equal(values, carry)
    fleet = shown["fleet"]
    assert sum(map(sum, fleet["worth"])) == pytest.approx(sum(fleet["rewards"]["net"]))
    recall = shown["recall"]
    right = [r for r, asked in zip(recall["right"], recall["scored"], strict=True) if asked]
    assert np.mean(right) == pytest.approx(sum(recall["rewards"]["accuracy"]))
    maze = shown["maze"]
    assert maze["level"][0] == -1
    assert maze["level"].count(2) == 12 == len(maze["goal"])
    for trial, moment in enumerate(np.flatnonzero(np.array(maze["level"]) == 2)):
        assert maze["trial"][moment] == trial
        assert maze["turns"][moment] == maze["endpoint"][trial]


class Own(SimpleSpread):
    """A task with a drawing of its own."""

    def viewer(self):
        script = pathlib.Path(os.environ["CREDO_TEST_SCRIPT"])
        return Viewer(str(script), "My own.", lambda trace: {"place": trace.states.position})


def test_a_task_may_bring_a_drawing_of_its_own(tmp_path, monkeypatch):
    script = tmp_path / "mine.js"
    script.write_text("credo.draw(view => ({build() {}, draw(t) { /* mine */ }}));")
    monkeypatch.setenv("CREDO_TEST_SCRIPT", str(script))
    env = Own()
    trace = record(env, NETWORK.init(*env.sizes, key=jax.random.key(0)), key=jax.random.key(0))
    html = viewer.page(env.viewer(), {"a": trace}, title="A")
    assert "/* mine */" in html
    np.testing.assert_array_equal(
        np.float32(embedded(html)["episodes"][0]["place"]), trace.states.position
    )


def test_watch_writes_a_page_of_the_champion_by_default(tmp_path):
    run = made(tmp_path / "run", DelayedReward(ENV))
    output = watch(run, episodes=2, seed=30, fps=4)
    assert output == run.path / "champion.html"
    data = embedded(output.read_text())
    expected = traces_of(ENV, run.champion, [30, 31])
    assert len(data["episodes"]) == 2
    for shown, (name, trace) in zip(data["episodes"], expected.items(), strict=True):
        assert shown["name"] == name
        np.testing.assert_array_equal(np.float32(shown["position"]), trace.states.position)
    assert ">4 steps/s</option>" in output.read_text()
    assert sorted(p.name for p in run.path.iterdir()) == [
        "champion.html",
        "champion.safetensors",
        "config.json",
    ]


def test_watch_films_rovers(tmp_path):
    run = made(tmp_path / "run")
    output = watch(run, tmp_path / "film.gif", episodes=2, seed=1, fps=100, size=(200, 180))
    lengths = [int(t.length) for t in traces_of(ENV, run.champion, [1, 2]).values()]
    with Image.open(output) as film:
        assert film.size == (200, 180)
        assert film.info["duration"] == 20
        # Every other step, and the last one.
        assert film.n_frames == sum(len({*range(0, last, 2), last}) for last in lengths)
        film.seek(0)
        first = np.asarray(film.convert("RGB")).astype(int)
        film.seek(1)
        assert np.abs(np.asarray(film.convert("RGB")) - first).max() > 50  # it moved


def test_an_mp4_of_rovers_has_every_step(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    import imageio_ffmpeg

    run = made(tmp_path / "run")
    output = watch(run, tmp_path / "film.mp4", seed=1, size=(160, 160))
    (trace,) = traces_of(ENV, run.champion, [1]).values()
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(output))
    assert frames == trace.length + 1
    assert seconds == pytest.approx(frames / 5, abs=0.21)


@pytest.mark.parametrize(
    ("env", "output", "error", "told"),
    [
        (ENV, "a.webm", ValueError, r"a\.webm': its name must end in \.html, \.mp4 or \.gif"),
        (SimpleSpread(), None, RunError, "SimpleSpread has nothing to draw.* are rovers, T-mazes"),
    ],
    ids=["suffix", "task"],
)
def test_what_cannot_be_watched_names_what_can(tmp_path, env, output, error, told):
    run = made(tmp_path / "run", env)
    with pytest.raises(error, match=told):
        watch(run, output and tmp_path / output)
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_a_film_shows_the_rovers_where_they_are(episodes):
    """The colour of the first rover is found at its place, and no POI is red before its time."""
    episode = episodes[0]
    moments = range(len(episode.position))
    frames = list(trajectories.pictures(ENV, vars(episode), "seed 3", moments, (300, 300)))
    assert len(frames) == len(episode.position)
    assert {frame.shape for frame in frames} == {(300, 300, 3)}
    red = matplotlib.colors.to_rgb(trajectories.SEEN[trajectories.LIGHT])
    red = np.round(255 * np.array(red))
    seen = [bool((np.abs(frame - red).max(axis=2) < 3).any()) for frame in frames]
    assert seen == episode.observed.any(axis=1).tolist()


def drawn(episode, **changes):
    arguments = {"activation_distance": 3.0, "size": 8.0, "title": "MERL"} | changes
    return trajectories.trajectories(
        episode.position, episode.poi, episode.observed[-1], **arguments
    )


def test_a_figure_of_trajectories(episodes):
    episode = Episode(**vars(episodes[0]) | {"observed": np.array([[True, False]])})
    svg = drawn(episode, prefix="left-")
    assert svg.startswith("<svg")
    assert 'aria-label="MERL: paths of 3 rovers; 1 of 2 POIs observed"' in svg
    assert svg.count("#c8102e") >= 2  # the ring and the POI
    for color in trajectories.LIGHT.curves[:3]:
        assert color in svg
    assert trajectories.LIGHT.curves[3] not in svg
    assert set(re.findall(r'\bid="(.{5})', svg)) == {"left-"}
    unseen = Episode(**vars(episode) | {"observed": np.array([[False, False]])})
    assert "#c8102e" not in drawn(unseen)
    assert trajectories.SEEN[trajectories.DARK] in drawn(episode, dark=True)


@pytest.mark.parametrize(
    ("position", "poi", "observed", "told"),
    [
        (np.zeros((4, 2)), np.zeros((1, 2)), [True], r"position has shape \(4, 2\): give"),
        (np.zeros((4, 1, 2)), np.zeros((1, 2)), [True, True], r"\(1, 2\) and observed \(2,\)"),
        (np.full((4, 1, 2), np.nan), np.zeros((1, 2)), [True], "is not finite"),
    ],
    ids=["position", "observed", "nan"],
)
def test_wrong_trajectories_are_told(position, poi, observed, told):
    with pytest.raises(ValueError, match=told):
        trajectories.trajectories(position, poi, observed, activation_distance=1.0, size=5.0)
