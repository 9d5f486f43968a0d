"""Films: what is drawn is what the champion does, and whatever is missing is named."""

import os
import re
import shutil
import subprocess
import sys
from typing import ClassVar

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pettingzoo import ParallelEnv
from PIL import Image

from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.base import AbstractEnvironment
from credo.environments.gymnasium import Gymnasium
from credo.environments.pettingzoo import PettingZoo
from credo.environments.probes import Copy
from credo.environments.sequence_recall import SequenceRecall
from credo.environments.wrappers import DelayedHostReward, DelayedReward
from credo.networks.mlp import MLP
from credo.networks.recurrent import Recurrent
from credo.networks.team import Team
from credo.report.films import film
from credo.report.watch import watch
from credo.runs import checkpoint, config, files
from credo.runs.record import RunError
from credo.runs.store import Run
from credo.types import TimeStep

LENGTH = 6


class Painter(gymnasium.Env):
    """Red is the step, green the seed, blue the last action; steps are never the same picture."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)
    action_space = gymnasium.spaces.Box(0.0, 200.0, (1,), np.float32)

    def __init__(self, render_mode=None, width=8, height=8, raises="", dtype="uint8"):
        self.render_mode, self.size = render_mode, (height, width)
        self.raises, self.dtype = raises, dtype

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.seed, self.action = 0, seed, 0.0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t, self.action = self.t + 1, float(action[0])
        return np.float32([self.t / LENGTH]), 0.0, False, False, {}

    def render(self):
        if self.raises:
            raise RuntimeError(self.raises)
        colour = (40 * self.t, self.seed, round(self.action))
        return np.full((*self.size, 3), colour, self.dtype)


class Fixed(Painter):
    """Its size is its own."""

    def __init__(self, render_mode=None):
        super().__init__(render_mode, width=12, height=10)


class Blind(Painter):
    """It cannot draw."""

    metadata = {"render_modes": ["human"]}


class Wrapped(gymnasium.Wrapper):
    """Of one's own, and without render_mode."""

    def __init__(self):
        super().__init__(Painter())


class Handed(gymnasium.Wrapper):
    """It hands on what the task within takes."""

    def __init__(self, **kwargs):
        super().__init__(Painter(**kwargs))


class Picky(gymnasium.Wrapper):
    """Its arguments go nowhere that draws."""

    def __init__(self, **kwargs):
        super().__init__(Painter(**{"raises": "", **kwargs, "size": 3} if kwargs else {}))


class Clear(Painter):
    """Its pictures have an alpha channel."""

    def render(self):
        picture = super().render()
        return np.concatenate([picture, np.full((*self.size, 1), 51, np.uint8)], axis=2)


def factory(render_mode=None, width=8, height=8) -> gymnasium.Env:
    return gymnasium.wrappers.TimeLimit(Painter(render_mode, width, height), 3)


def task(name="Painter", **kwargs):
    return Gymnasium(f"test_watch:{name}", kwargs, max_episode_steps=LENGTH, in_process=True)


def made(path, env, network=None) -> Run:
    """A run on disk whose champion has fresh weights."""
    path.mkdir()
    network = network or (MLP((3,)) if env.agents is None else Team((3,)))
    algorithm = Neuroevolution(env, network, population_size=10)
    policy = network.init(*env.sizes, key=jax.random.key(0))
    checkpoint.export_policy(path / "champion.safetensors", policy)
    files.write_json(path / "config.json", {"algorithm": config.to_tree(algorithm), "seed": 0})
    return Run(path, trust=True)


def frames(path) -> tuple[np.ndarray, list[int]]:
    """Pictures of a gif and milliseconds that each is shown."""
    pictures, durations = [], []
    with Image.open(path) as image:
        for i in range(image.n_frames):
            image.seek(i)
            pictures.append(np.asarray(image.convert("RGB")))
            durations.append(image.info["duration"])
    return np.array(pictures), durations


def test_a_film_shows_what_the_champion_does(tmp_path):
    run = made(tmp_path / "run", DelayedHostReward(task()), Recurrent("gru", 3))
    output = watch(run, tmp_path / "new" / "film.gif", episodes=2, seed=30, size=(20, 16))
    pictures, durations = frames(output)
    assert pictures.shape == (2 * (LENGTH + 1), 16, 20, 3)
    assert set(durations) == {50}  # 20 steps per second
    policy, expected = run.policy(raw=True), []
    for seed in (30, 31):
        policy.reset()
        expected.append((0, seed, 0))
        for t in range(LENGTH):
            action = 100 + 100 * policy(np.float32([t / LENGTH]))[0]
            expected.append((40 * (t + 1), seed, round(float(action))))
    np.testing.assert_allclose(pictures[:, 8, 10], expected, atol=1)
    assert sorted(p.name for p in output.parent.iterdir()) == ["film.gif"]


def test_an_environment_may_have_a_size_of_its_own(tmp_path):
    pictures, _ = frames(watch(made(tmp_path / "run", task("Fixed")), tmp_path / "film.gif"))
    assert pictures.shape == (LENGTH + 1, 10, 12, 3)


def test_a_faster_film_leaves_steps_out(tmp_path):
    run = made(tmp_path / "run", task())
    pictures, durations = frames(watch(run, tmp_path / "film.gif", fps=200))
    assert pictures[:, 0, 0, 0].tolist() == [0, 160, 240]  # steps 0, 4 and the last
    assert set(durations) == {20}
    pictures, durations = frames(watch(run, tmp_path / "film.gif", fps=5))
    assert len(pictures) == LENGTH + 1
    assert set(durations) == {200}


def test_an_mp4_has_the_same_pictures(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    run = made(tmp_path / "run", task())
    output = watch(run, tmp_path / "film.mp4", seed=100, size=(65, 48))
    command = [ffmpeg, "-i", output, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    result = subprocess.run(command, capture_output=True, check=True)
    assert re.search(r"h264.* 64x48.* 20 fps", result.stderr.decode())
    pictures = np.frombuffer(result.stdout, np.uint8).reshape(-1, 48, 64, 3)
    red = pictures[:, 24, 32, 0].astype(int)
    np.testing.assert_allclose(red, [40 * t for t in range(LENGTH + 1)], atol=12)


def test_what_ffmpeg_refuses_is_told(tmp_path):
    pytest.importorskip("imageio_ffmpeg")

    def lost():
        with film(tmp_path / "film.mp4", 10) as add:
            shutil.rmtree(next(tmp_path.glob(".film*")))
            for _ in range(3):
                add(np.zeros((4, 4, 3), np.uint8))

    with pytest.raises(RunError, match=r"ffmpeg says .*No such file or directory"):
        lost()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_two_writers_of_one_film_do_not_mix(tmp_path, suffix):
    if suffix == "mp4":
        pytest.importorskip("imageio_ffmpeg")
    path, alone = tmp_path / f"film.{suffix}", tmp_path / f"alone.{suffix}"
    white = np.full((8, 8, 3), 255, np.uint8)
    with film(path, 10) as first:
        first(white // 2)
        with film(path, 10) as second:
            second(white)
            first(white // 3)
        between = path.read_bytes()
        first(white // 4)
    with film(alone, 10) as add:
        for part in (2, 3, 4):
            add(white // part)
    assert path.read_bytes() == alone.read_bytes() != between
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([alone.name, path.name])


def test_without_ffmpeg_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    run = made(tmp_path / "run", task())
    with pytest.raises(RunError, match=r"pip install imageio-ffmpeg`, or ask for a \.gif"):
        watch(run, tmp_path / "film.mp4")


def test_without_a_name_the_film_lies_in_the_run(tmp_path):
    run = made(tmp_path / "run", task())
    assert watch(run) == run.path / "champion.gif"
    assert len(frames(run.path / "champion.gif")[0]) == LENGTH + 1


def test_a_task_of_numbers_has_nothing_to_draw(tmp_path):
    told = r"Copy has nothing to draw.*rovers, T-mazes.*\. `credo report .*run` shows"
    with pytest.raises(RunError, match=told):
        watch(made(tmp_path / "run", Copy()))
    recall = made(tmp_path / "recall", SequenceRecall(depth=2))
    with pytest.raises(ValueError, match=r"film\.gif': its name must end in \.html$"):
        watch(recall, tmp_path / "film.gif")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["recall", "run"]
    assert "direction" in watch(recall).read_text()


def test_a_wrapper_that_hands_render_mode_on_is_drawn(tmp_path):
    run = made(tmp_path / "run", task("Handed"))
    pictures, _ = frames(watch(run, tmp_path / "film.gif", size=(20, 16)))
    assert pictures.shape == (LENGTH + 1, 16, 20, 3)


def test_a_picture_with_an_alpha_channel_is_laid_on_white(tmp_path):
    run = made(tmp_path / "run", task("Clear"))
    pictures, _ = frames(watch(run, tmp_path / "film.gif"))
    # A fifth of 40 t, four fifths of 255.
    np.testing.assert_allclose(
        pictures[:, 0, 0, 0], [204 + 8 * t for t in range(LENGTH + 1)], atol=1
    )


class Crew(AbstractEnvironment):
    """Two agents in JAX; a picture shows the step, and what each of them did last."""

    obs_size: ClassVar[int] = 3
    action_size: ClassVar[int] = 2
    max_steps: ClassVar[int] = LENGTH
    signals: ClassVar[tuple[str, ...]] = ("global",)
    agents: ClassVar[int | None] = 2

    def reset(self, *, key):
        state = (jnp.int32(0), jnp.zeros(2))
        return state, self._now(*state)

    def step(self, state, action, *, key):
        state = (state[0] + 1, action[:, 0])
        return state, self._now(*state)

    def _now(self, step, last):
        obs = jnp.stack([jnp.full(2, step, jnp.float32), last, jnp.arange(2.0)], axis=1)
        end = step >= self.max_steps
        return TimeStep(obs, {"global": jnp.float32(0.0)}, jnp.bool_(False), end)

    def render(self, state):
        step, last = state
        colour = (40 * int(step), *(round(100 + 100 * float(x)) for x in last))
        return np.full((6, 8, 3), colour, np.uint8)


class Players(ParallelEnv):
    """The same as a team of PettingZoo, in which the second agent leaves after two steps."""

    metadata = {"name": "players", "render_modes": ["rgb_array"], "render_fps": 20}
    possible_agents = ["a", "b"]

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def observation_space(self, agent):
        return gymnasium.spaces.Box(-9.0, 9.0, (2,), np.float32)

    def action_space(self, agent):
        return gymnasium.spaces.Box(0.0, 200.0, (1,), np.float32)

    def reset(self, seed=None, options=None):
        self.agents, self.t, self.last = ["a", "b"], 0, {"a": 0.0, "b": 0.0}
        return self._said(self.agents), {}

    def step(self, actions):
        self.t, acted = self.t + 1, self.agents
        self.last |= {agent: float(action[0]) for agent, action in actions.items()}
        over = {agent: self.t >= LENGTH or (agent == "b" and self.t >= 2) for agent in acted}
        self.agents = [agent for agent in acted if not over[agent]]
        nothing = dict.fromkeys(acted, 0.0)
        return self._said(acted), nothing, over, dict.fromkeys(acted, False), {}

    def _said(self, agents):
        return {agent: np.float32([self.t, k]) for k, agent in enumerate(agents)}

    def render(self):
        if self.render_mode != "rgb_array":
            raise RuntimeError("not asked for")
        colour = (40 * self.t, *(round(self.last[agent]) for agent in "ab"))
        return np.full((6, 8, 3), colour, np.uint8)


class Shy(Players):
    """It cannot be asked to draw."""

    def __init__(self):
        super().__init__()


def test_a_team_of_ones_own_in_jax_is_drawn(tmp_path):
    run = made(tmp_path / "run", DelayedReward(Crew()), Team((4,), Recurrent("gru", 3)))
    pictures, _ = frames(watch(run, tmp_path / "film.gif", episodes=2))
    policy, expected = run.policy(), []
    last = np.zeros(2)
    for t in range(LENGTH + 1):
        expected.append((40 * t, *(100 + 100 * last if t else (100, 100))))
        last = policy(np.stack([t * np.ones(2), last, np.arange(2.0)], axis=1))[:, 0]
    assert len(pictures) == 2 * (LENGTH + 1)
    for episode in np.split(pictures[:, 3, 4], 2):
        np.testing.assert_allclose(episode, expected, atol=1)


def crew(name):
    return PettingZoo(f"test_watch:{name}", max_episode_steps=LENGTH, in_process=True)


def test_a_team_of_pettingzoo_is_drawn(tmp_path):
    run = made(tmp_path / "run", crew("Players"), Team((4,), Recurrent("gru", 3)))
    pictures, durations = frames(watch(run, tmp_path / "film.gif"))
    assert set(durations) == {50}
    policy, expected, last = run.policy(raw=True), [(0, 0, 0)], np.zeros(2)
    for t in range(LENGTH):
        there = t < 2
        rows = np.float32([[t, 0.0], [t, 1.0] if t <= 2 else [0.0, 0.0]])
        last[: 1 + there] = 100 + 100 * policy(rows)[: 1 + there, 0]
        expected.append((40 * (t + 1), *last))
    np.testing.assert_allclose(pictures[:, 3, 4], expected, atol=1)


@pytest.mark.parametrize(
    ("env", "told"),
    [
        (
            task("Wrapped"),
            r"Wrapped cannot be drawn: for that it must take render_mode.*it names \['rgb_array'\]",
        ),
        (task("Picky"), r"Picky cannot be drawn: for that it must take render_mode"),
        (crew("Shy"), r"Shy cannot be drawn: for that it must take render_mode"),
        (task("Blind"), r"must take render_mode.*it names \['human'\]"),
        (task(raises="no screen"), r"RuntimeError: no screen\): install what it names, or mend"),
        (task(dtype="float32"), "dtype float32: its render"),
    ],
    ids=["wrapper", "kwargs", "team", "mode", "raises", "dtype"],
)
def test_what_cannot_be_drawn_says_why_and_leaves_no_file(tmp_path, env, told):
    run = made(tmp_path / "run", env)
    with pytest.raises(RunError, match=told):
        watch(run, tmp_path / "film.gif")
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"output": "film.avi"}, r"'film\.avi': its name must end in \.mp4 or \.gif"),
        ({"output": "film.html"}, r"'film\.html': its name must end in \.mp4 or \.gif"),
        ({"episodes": 0}, "episodes is 0"),
        ({"fps": 0}, "fps is 0"),
        ({"size": (0, 10)}, "width is 0"),
    ],
)
def test_wrong_arguments_are_told(tmp_path, wrong, told):
    run = made(tmp_path / "run", task())
    with pytest.raises(ValueError, match=told):
        watch(run, **{"output": tmp_path / "film.gif"} | wrong)
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


HOPPER = """
import sys, pathlib
from credo.environments.gymnasium import Gymnasium
from test_watch import made
from credo.runs.record import RunError
from credo.report.watch import watch
folder = pathlib.Path(sys.argv[1])
run = made(folder / "run", Gymnasium("Hopper-v5", max_episode_steps=9, in_process=True))
try:
    watch(run, folder / "film.gif", size=(64, 48))
except RunError as error:
    print(error)
"""
PLAIN = """
import gymnasium
env = gymnasium.make("Hopper-v5", render_mode="rgb_array")
env.reset(seed=0)
print(env.render().shape)
"""


def drawn_with(renderer, code, *arguments):
    """The output of Python code where MuJoCo draws through `renderer`."""
    path = os.pathsep.join(filter(None, [os.path.dirname(__file__), os.environ.get("PYTHONPATH")]))
    environment = os.environ | {"MUJOCO_GL": renderer, "PYTHONPATH": path}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment)


def test_mujoco_is_drawn_at_the_size_asked_for(tmp_path):
    pytest.importorskip("mujoco")
    result = drawn_with("egl", HOPPER, tmp_path)
    if result.stdout and drawn_with("egl", PLAIN).returncode != 0:
        pytest.skip("MuJoCo cannot draw through EGL on this machine, also without Credo")
    assert (result.returncode, result.stdout) == (0, ""), result.stderr
    pictures, durations = frames(tmp_path / "film.gif")
    assert pictures.shape == (4, 48, 64, 3)  # steps 0, 3, 6 and 9 of 125 per second
    assert set(durations) == {20}
    assert pictures[0].std() > 20
    assert np.abs(pictures[0].astype(int) - pictures[-1]).max() > 20  # it moved


def test_where_mujoco_cannot_draw_the_variable_to_set_is_named(tmp_path):
    pytest.importorskip("mujoco")
    result = drawn_with("disable", HOPPER, tmp_path)
    assert "Hopper-v5 cannot be drawn here" in result.stdout, result.stderr
    assert "set the environment variable MUJOCO_GL=egl" in result.stdout
    assert not (tmp_path / "film.gif").exists()
