"""Runs of a task outside JAX: one generation per turn of the loop, in Python; budgets of frames;
and an environment that fails."""

import functools
import signal
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float, Int, PyTree

from credo.environments.host import (
    AbstractCopies,
    AbstractHostEnvironment,
    EnvironmentFailure,
    HostStep,
)
from credo.executors import Job
from credo.networks.base import AbstractNetwork
from credo.networks.mlp import MLP
from credo.runs import config, loop
from credo.runs.checkpoint import read_metadata
from credo.runs.options import RunOptions

QUIET = {"tensorboard": False, "progress": False}


class LineCopies(AbstractCopies):
    fails_after: ClassVar[int | None] = None  # steps

    def __init__(self, n: int, max_steps: int):
        self.n, self.max_steps, self.steps = n, max_steps, 0
        self.x, self.t = np.zeros(n, np.float32), np.zeros(n, np.int64)

    def reset(self, seeds, active):
        starts = np.array([np.random.default_rng(seed).uniform(-1, 1) for seed in seeds])
        self.x = np.where(active, starts, self.x).astype(np.float32)
        self.t = np.where(active, 0, self.t)
        return self.x[:, None].copy()

    def step(self, actions, active):
        self.steps += 1
        if LineCopies.fails_after is not None and self.steps > LineCopies.fails_after:
            raise EnvironmentFailure("Line raised ValueError in step 3 of seed 7")
        self.x = np.where(active, self.x + 0.5 * actions[:, 0], self.x).astype(np.float32)
        self.t = np.where(active, self.t + 1, self.t)
        rewards = {"reward": 1.0 - np.abs(self.x)}
        ended = self.t >= self.max_steps
        return HostStep(self.x[:, None].copy(), rewards, np.zeros(self.n, bool), ended)


@functools.cache
def opened(n: int, max_steps: int) -> LineCopies:
    return LineCopies(n, max_steps)


class Line(AbstractHostEnvironment):
    """Stay near 0."""

    length: int = eqx.field(static=True, default=5)
    obs_size: ClassVar[int] = 1
    action_size: ClassVar[int] = 1
    signals: ClassVar[tuple[str, ...]] = ("reward",)

    @property
    def max_steps(self) -> int:
        return self.length

    def copies(self, n: int) -> LineCopies:
        return opened(n, self.length)


class ClimberState(eqx.Module):
    champion: PyTree
    best: Float[Array, ""]
    rewards: Float[Array, " steps"]  # stands for a replay buffer
    position: Int[Array, ""]


@eqx.filter_jit
def propose(state, key):
    arrays, static = eqx.partition(state.champion, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(arrays)
    keys = jax.random.split(key, len(leaves))
    moved = [x + 0.3 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    return eqx.combine(jax.tree.unflatten(structure, moved), static)


@eqx.filter_jit
def act(policy, obs):
    return jax.vmap(lambda obs: policy(obs, policy.start(key=jax.random.key(0)))[0])(obs)


@eqx.filter_jit(donate="all-except-first")
def keep(new, state):
    candidate, fitness, rewards = new
    better = fitness > state.best
    champion = jax.tree.map(
        lambda a, b: jnp.where(better, a, b) if eqx.is_array(a) else a, candidate, state.champion
    )
    buffer = jax.lax.dynamic_update_slice(state.rewards, rewards, (state.position,))
    position = (state.position + rewards.size) % 50
    return ClimberState(champion, jnp.maximum(fitness, state.best), buffer, position), better


class Climber(eqx.Module):
    """Move a policy at random, keep what is better: eager, its state donated."""

    env: AbstractHostEnvironment
    network: AbstractNetwork = MLP(hidden=(3,))
    episodes: int = eqx.field(static=True, default=2)
    default_budget: ClassVar[dict[str, int]] = {"frames": 40}

    def init(self, *, key) -> ClimberState:
        policy = self.network.init(self.env.obs_size, self.env.action_size, key=key)
        return ClimberState(policy, jnp.float32(-jnp.inf), jnp.zeros(60), jnp.int32(0))

    def generation(self, state, *, key):
        seeds_key, move_key = jax.random.split(key)
        candidate = propose(state, move_key)
        copies, active = self.env.copies(self.episodes), np.ones(self.episodes, bool)
        obs = copies.reset(np.asarray(jax.random.bits(seeds_key, (self.episodes,))), active)
        rewards = []
        for _ in range(self.env.max_steps):
            step = copies.step(np.asarray(act(candidate, obs)), active)
            obs = step.obs
            rewards.append(step.rewards["reward"])
        fitness = np.float32(np.mean(np.sum(rewards, axis=0)))
        played = np.asarray(rewards, np.float32).ravel()
        state, better = keep((candidate, jnp.asarray(fitness), jnp.asarray(played)), state)
        return state, {
            "frames": np.int64(self.episodes * self.env.max_steps),
            "fitness_max": fitness,
            "champion_score": state.best,
            "accepted": better,
            "position": state.position,
        }

    def warm(self, state, policy):
        return eqx.tree_at(lambda state: state.champion, state, policy)


ALGORITHM = Climber(Line())  # 10 frames per generation
BUDGET = 12


@pytest.fixture(autouse=True, scope="module")
def known():
    """An algorithm in a test file is none of Credo's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(config, "EXTENSIONS", (*config.EXTENSIONS, Climber))
        yield


@pytest.fixture(autouse=True)
def sound(monkeypatch):
    monkeypatch.setattr(LineCopies, "fails_after", None)
    opened.cache_clear()


def train(path, **options):
    return loop.train(ALGORITHM, path=path, **QUIET | options)


def resume(path, **options):
    return loop.resume(path, **QUIET | options)


def newest(path):
    return sorted((path / "checkpoints").glob("[0-9]*"))[-1]


def contents(path) -> dict[str, bytes]:
    """What a rerun repeats bit for bit."""
    files = [path / "metrics.csv", path / "champion.safetensors"]
    files += [file for file in newest(path).rglob("*") if file.is_file()]
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    path = tmp_path_factory.mktemp("straight") / "run"
    train(path, generations=BUDGET)
    return path


def test_every_generation_is_a_row_in_python_numbers(straight):
    lines = (straight / "metrics.csv").read_text().splitlines()
    assert lines[0] == "generation,frames,accepted,champion_score,fitness_max,position"
    first = lines[1].split(",")
    assert first[:3] + first[5:] == ["1", "10", "1", "10"]  # integers stay integers
    metrics = loop.Run(straight).metrics
    assert metrics["frames"].tolist() == [10.0 * g for g in range(1, BUDGET + 1)]
    assert metrics["position"].tolist() == [10.0 * g % 50 for g in range(1, BUDGET + 1)]
    assert np.all(np.diff(metrics["champion_score"]) >= 0)


def test_metrics_are_those_of_generations_played_by_hand(straight):
    root = jax.random.key(0)
    state = jax.jit(ALGORITHM.init)(key=jax.random.fold_in(root, 0))
    for g in range(1, 4):
        state, metrics = ALGORITHM.generation(state, key=jax.random.fold_in(root, g))
        logged = loop.Run(straight).metrics["fitness_max"][g - 1]
        assert logged == pytest.approx(float(metrics["fitness_max"]), rel=1e-5)


def test_stopped_and_resumed_is_bit_for_bit_the_straight_run(straight, tmp_path):
    for stop in (1, 5):
        train(
            tmp_path / "run", generations=BUDGET, callbacks=(lambda _, g, m, stop=stop: g >= stop,)
        )
        assert newest(tmp_path / "run").name == f"{stop:08}"
        resume(tmp_path / "run")
        assert contents(tmp_path / "run") == contents(straight)
        (tmp_path / "run").rename(tmp_path / f"run-{stop}")


@pytest.mark.parametrize(("frames", "generations"), [(40, 4), (41, 5), (49, 5), (1, 1)])
def test_a_budget_of_frames_ends_the_generation_it_falls_in(tmp_path, frames, generations):
    run = train(tmp_path / "run", frames=frames)
    assert run.metrics["generation"][-1] == generations
    assert run.config["budget"] == {"generations": None, "frames": frames, "stop_at": None}


def test_the_first_of_two_budgets_counts(tmp_path):
    assert train(tmp_path / "a", frames=1e6, generations=2).metrics["generation"][-1] == 2
    assert train(tmp_path / "b", frames=30, generations=20).metrics["generation"][-1] == 3


def test_without_a_budget_the_algorithm_s_own_is_taken(tmp_path):
    run = train(tmp_path / "run")
    assert run.config["budget"]["frames"] == 40
    assert run.metrics["generation"][-1] == 4


def test_a_larger_budget_of_either_kind_goes_on(straight, tmp_path):
    path = tmp_path / "run"
    train(path, frames=40)
    resume(path, frames=60)
    assert loop.Run(path).metrics["frames"][-1] == 60
    resume(path, generations=BUDGET)  # in place of the limit of frames
    assert contents(path) == contents(straight)
    assert loop.Run(path).config["budget"] == loop.Run(straight).config["budget"]


@pytest.mark.parametrize(
    ("budget", "told"),
    [
        ({"frames": 39}, "budget is 40 frames: a new budget must be larger, not 39"),
        ({"generations": 3}, "has done 4 generations: a new budget must be larger, not 3"),
        ({"frames": 0}, "frames is 0: it must lie in"),
    ],
)
def test_a_smaller_budget_is_refused(tmp_path, budget, told):
    train(tmp_path / "run", frames=40)
    before = (tmp_path / "run" / "config.json").read_bytes()
    with pytest.raises((loop.RunError, ValueError), match=told):
        resume(tmp_path / "run", **budget)
    assert (tmp_path / "run" / "config.json").read_bytes() == before


def test_a_failing_environment_leaves_the_last_checkpoint(straight, tmp_path, monkeypatch):
    monkeypatch.setattr(LineCopies, "fails_after", 4 * 5 + 3)  # in generation 5
    path = tmp_path / "run"
    with pytest.raises(loop.RunError) as error:
        train(path, generations=BUDGET, checkpoint_every=0.0)
    assert str(error.value) == (
        "Line raised ValueError in step 3 of seed 7. The checkpoint of generation 4 stands; "
        f"resume with `credo resume {path}`"
    )
    assert newest(path).name == "00000004"
    monkeypatch.setattr(LineCopies, "fails_after", None)
    resume(path)
    assert contents(path) == contents(straight)


def test_a_signal_ends_after_the_generation(straight, tmp_path):
    def interrupt(run, generation, metrics):
        if generation == 3:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(loop.Interrupted, match="generation 3, 30 of 120 frames, and saved") as stop:
        train(tmp_path / "run", frames=120, callbacks=(interrupt,))
    assert stop.value.code == 130
    resume(tmp_path / "run")
    ended, whole = contents(tmp_path / "run"), contents(straight)
    sealed = [
        name
        for name in whole
        if name.endswith(("COMMIT", "champion.safetensors", "best.safetensors"))
    ]
    for name in sealed:  # they tell the budgets apart: frames here, generations there
        assert ended.pop(name) != whole.pop(name)
    assert ended == whole


def test_metrics_with_other_names_are_refused(tmp_path, monkeypatch):
    generation = Climber.generation

    def changing(self, state, *, key):
        state, metrics = generation(self, state, key=key)
        return state, metrics | ({"late": 1.0} if int(metrics["position"]) > 10 else {})

    monkeypatch.setattr(Climber, "generation", changing)
    with pytest.raises(ValueError, match=r"metrics .*late, position, but .*metrics\.csv, have"):
        train(tmp_path / "run")


def test_a_warm_start_begins_with_the_champion_of_another_run(straight, tmp_path):
    source = loop.Run(straight)
    run = train(tmp_path / "run", generations=1, seed=9, warm_start=straight)
    assert run.config["warm_start"] == str(straight)
    cold = train(tmp_path / "cold", generations=1, seed=9)
    assert run.metrics["fitness_max"] != cold.metrics["fitness_max"]
    state = loop._warm(ALGORITHM, ALGORITHM.init(key=jax.random.key(1)), source)
    for warm, champion in zip(
        jax.tree.leaves(state.champion), jax.tree.leaves(source.champion), strict=True
    ):
        np.testing.assert_array_equal(warm, champion)


def test_a_job_has_a_budget_of_frames(straight, tmp_path):
    path = tmp_path / "run"
    job = Job(path, ALGORITHM, 0, RunOptions(frames=40))
    assert not job.finished()
    train(path, frames=30)
    assert not job.finished()
    assert job.state() == "run 30/40 frames"
    resume(path, frames=40)
    assert job.finished()
    assert read_metadata(path / "champion.safetensors")["generation"] == "4"
    assert Job(path, ALGORITHM, 0, RunOptions()).finished()  # the algorithm's own budget
    with pytest.raises(loop.RunError, match="frames: 40 != 30"):
        Job(path, ALGORITHM, 0, RunOptions(frames=30)).finished()
    with pytest.raises(loop.RunError, match="frames: 40 != None"):
        Job(path, ALGORITHM, 0, RunOptions(generations=100)).finished()
    with pytest.raises(loop.RunError, match="warm start: None != other"):
        Job(path, ALGORITHM, 0, RunOptions(), warm_start="other").finished()
