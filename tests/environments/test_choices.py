"""Actions that are choices: several at once, beside Boxes, of teams, and such as are forbidden. The
tasks raise when a forbidden action is played, and no failure is tolerated."""

import dataclasses
import functools
import re

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from barred import Barred, Mixed, N, Team

from credo import rollout
from credo.algorithms.erl import ERL
from credo.algorithms.merl import MERL
from credo.algorithms.neuroevolution import Neuroevolution
from credo.algorithms.off_policy import OffPolicy
from credo.algorithms.ppo import PPO
from credo.environments import checks
from credo.environments.base import AbstractEnvironment
from credo.environments.gymnasium import Gymnasium
from credo.environments.hidden import hidden
from credo.environments.last_step import with_last_step
from credo.environments.pettingzoo import PettingZoo
from credo.environments.wrappers import NoisyObservations, delayed
from credo.learners.discrete_sac import DiscreteSAC
from credo.learners.dqn import DQN
from credo.networks.choosing import Choosing, choosing
from credo.networks.mlp import MLP
from credo.networks.recurrent import Recurrent
from credo.networks.team import Team as TeamNetwork
from credo.normalization import Moments
from credo.runner import Units
from credo.runs.policy import Policy
from credo.types import Batch, TimeStep

KEY = jax.random.key(0)


def task(name, api=Gymnasium, **kwargs):
    steps = kwargs.get("steps", 10)
    return api(f"barred:{name}", kwargs, steps, in_process=True, tolerated=0.0)


class Forbidding(AbstractEnvironment):
    """In JAX: of four actions two are allowed, drawn anew at every step. Pays 1 for the larger of
    them, and -100 for one that is not allowed."""

    signals = ("reward",)
    obs_size = N + 1
    action_size = N
    max_steps = 10
    choices = (N,)
    masked = True

    def _answer(self, reward, *, key):
        order = jnp.argsort(jax.random.uniform(key, (N,)))
        mask = (order < 2).astype(jnp.float32)
        no = jnp.bool_(False)
        return mask, TimeStep(jnp.append(mask, 0.5), {"reward": reward}, no, no)

    def reset(self, *, key):
        mask, first = self._answer(jnp.float32(0.0), key=key)
        return (mask, jnp.int32(0)), first

    def step(self, state, action, *, key):
        mask, steps = state
        taken = jnp.argmax(action)  # the worst that a task can do: it follows no mask
        best = jnp.max(jnp.where(mask > 0, jnp.arange(N), -1))
        reward = jnp.where(mask[taken] > 0, (taken == best).astype(jnp.float32), -100.0)
        mask, now = self._answer(reward, key=key)
        return (mask, steps + 1), now.cut(steps + 1 >= self.max_steps)


def trained(algorithm, generations, play=None):
    state, rows = algorithm.init(key=KEY), []
    play = play or eqx.filter_jit(lambda a, s, key: a.generation(s, key=key))
    for key in jax.random.split(jax.random.key(1), generations):
        state, metrics = play(algorithm, state, key)
        rows.append(jax.tree.map(float, metrics))
    return rows, state


eager = lambda a, s, key: a.generation(s, key=key)  # noqa: E731
FAST = {"learning_rate": 0.01, "tau": 0.1, "gamma": 0.5, "exploration": 100, "batch_size": 32}
RATES = {"actor_lr": 0.01, "critic_lr": 0.01, "alpha_lr": 0.01, "target_entropy": 0.1}
SOFT = {"tau": 0.1, "gamma": 0.5, "batch_size": 32, **RATES}
QUICK = {"start_frames": 50, "test_episodes": 5, "test_every": 50, "replay_capacity": 2000}
EVOLVING = {"population_size": 4, "elite_fraction": 0.25, "sync_period": 1, "warmup_frames": 50}
PATHS = {
    "dqn": lambda env: OffPolicy.dqn(env, learner=DQN(**FAST), **QUICK),
    "dueling": lambda env: OffPolicy.dqn(env, learner=DQN(dueling=True, **FAST), **QUICK),
    "normalized": lambda env: OffPolicy.dqn(
        env, learner=DQN(**FAST), normalize_observations=True, **QUICK
    ),
    "memory": lambda env: OffPolicy.dqn(
        env, Recurrent("gru", 8), learner=DQN(**FAST | {"batch_size": 80}), **QUICK
    ),
    "sac": lambda env: OffPolicy.sac(env, learner=DiscreteSAC(**SOFT), **QUICK),
    "soft memory": lambda env: OffPolicy.sac(
        env, Recurrent("gru", 8), learner=DiscreteSAC(**SOFT | {"batch_size": 80}), **QUICK
    ),
    "ppo": lambda env: PPO.ppo(env, horizon=160, copies=16, batch_size=40, learning_rate=3e-3),
    "erl": lambda env: ERL.erl(env, learners=(DQN(**FAST),), **EVOLVING),
    "ea": lambda env: ERL.ea(env, **{k: v for k, v in EVOLVING.items() if k[0] in "pe"}),
    "last": lambda env: OffPolicy.dqn(with_last_step(env), learner=DQN(**FAST), **QUICK),
    "late": lambda env: PPO.ppo(delayed(env), horizon=100, copies=10, batch_size=40),
}


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("where", ["obs", "info"])
def test_what_is_forbidden_is_never_played(path, where):
    rows, _ = trained(PATHS[path](task("Barred", where=where)), 6, eager)
    assert np.isfinite(rows[-1]["champion_score"])


@pytest.mark.parametrize("path", ["dqn", "dueling", "memory", "sac", "soft memory", "ppo", "erl"])
def test_learners_choose_the_best_of_what_is_allowed(path):
    """By chance half are right; forbidden ones would cost 100."""
    rows, _ = trained(PATHS[path](Forbidding()), 40 if "memory" not in path else 60)
    assert min(row["fitness_mean"] for row in rows) >= 0.0
    assert max(row["champion_score"] for row in rows[-10:]) >= 9.0


def test_in_100_000_random_steps_nothing_forbidden_is_played():
    """By an explorer that acts at random, by one that draws, and by numbers drawn without a mask:
    of the last the task itself takes the largest that is allowed."""
    env, jaxed = task("Barred", where="info", steps=1000), Forbidding()
    network = choosing(jaxed, MLP((4,)))
    dqn, ppo = DQN(), PPO(jaxed, network)
    state = dqn.init(network, *jaxed.sizes, key=KEY)
    players = [
        dqn.explorer(state, jnp.bool_(True)),
        ppo.init(key=KEY).actor.explorer(N),
    ]
    for player in players:
        alone = jax.tree.map(lambda x: x[None], player)
        played, _ = rollout.collect(jaxed, alone, 4_000, key=KEY)
        assert float(played.returns["reward"].min()) >= 0.0  # 40,000 steps each
    copies, on = env.copies(20), np.ones(20, bool)
    copies.reset(np.arange(20, dtype=np.uint32), on)
    draw = np.random.default_rng(0)
    for _ in range(1000):
        copies.step(draw.uniform(-1, 1, (20, N)).astype(np.float32), on)
        assert not copies.failed.any()


def test_several_choices_are_learned_by_ppo_and_played_by_all():
    for split in (False, True):
        env = task("Several", split=split)
        assert (env.sizes, env.choices, env.masked, env.discrete) == ((6, 5), (3, 2), True, True)
        trained(ERL.ea(env, population_size=3, elite_fraction=0.4, test_episodes=1), 2, eager)
    settings = {"horizon": 160, "copies": 16, "batch_size": 40, "learning_rate": 3e-3}
    rows, _ = trained(PPO.ppo(env, **settings), 25, eager)
    assert rows[-1]["champion_score"] >= 18.0  # of 20
    assert rows[0]["fitness_mean"] < 17.0
    with pytest.raises(ValueError, match="has 2 choices at a step: DQN cannot learn that"):
        OffPolicy.dqn(env).init(key=KEY)


def test_choices_stand_before_boxes_and_each_part_gets_its_own():
    env = task("Mixed")
    assert (env.choices, env.action_size, env.discrete) == ((2, 2, 3), 9, False)
    copies = env.copies(1)
    copies.reset(np.zeros(1, np.uint32), np.ones(1, bool))
    # of two bits each "no" and "yes"; which; two Boxes
    action = np.float32([[-0.5, 0.1, 0.8, 0.2, -1, 0.3, 0.9, 0.5, 0.25]])
    paid = copies.step(action, np.ones(1, bool)).rewards["reward"][0]
    assert paid == pytest.approx(7.5 + 100 * 1 + 1000 + 0 + 0.25)
    own = Policy(_constant(action[0]), env.task_record())(np.zeros(1))
    assert Mixed.action_space.contains(own)
    assert own["which"] == 1
    assert own["pair"][0].tolist() == [1, 0]
    for build in (OffPolicy.dqn, OffPolicy.td3, PPO.ppo):
        with pytest.raises(ValueError, match=r"has choices beside a Box: .* cannot learn that"):
            build(env).init(key=KEY)
    trained(Neuroevolution(env, MLP((4,)), population_size=4), 1, eager)


def _constant(action):
    """A policy that always says this."""
    policy = MLP(()).init(1, len(action), key=KEY)
    weights = {"W_0": jnp.zeros((len(action), 1)), "b_0": jnp.arctanh(jnp.asarray(action) * 0.9999)}
    return dataclasses.replace(policy, weights=weights)


LEARNERS = {"dqn": DQN(signal="local", **FAST), "sac": DiscreteSAC(signal="local", **SOFT)}


@pytest.mark.parametrize(
    ("where", "kind"), [("obs", "dqn"), ("info", "dqn"), ("nowhere", "dqn"), ("obs", "sac")]
)
def test_a_team_chooses_and_learns_each_for_itself(where, kind):
    env = task("Team", PettingZoo, where=where)
    assert (env.sizes, env.choices, env.masked) == ((5, 3, 2), (3,), True)
    copies = env.copies(1)
    seen = copies.reset(np.array([3], np.uint32), np.ones(1, bool))
    assert seen[0, 1, 2] == 0.0  # b has no third action
    assert seen[0, :, 3].tolist() == [0.5, 0.5]
    small = {"population_size": 5, "episodes": 1, "workers": 2, "warmup_frames": 20}
    settings = small | {"updates_per_frame": 1.0, "test_episodes": 10}
    network = TeamNetwork((8,), MLP((), initializer="uniform"))
    algorithm = MERL.merl(env, network, learners=(LEARNERS[kind],), **settings)
    rows, state = trained(algorithm, 12, eager)
    assert rows[-1]["champion_score"] >= 4.5  # of 5
    assert isinstance(state.champion.config, Choosing)
    policy = Policy(state.champion, env.task_record())
    team = Team(where)
    obs, _ = team.reset(seed=5)
    while team.agents:
        masks = None if where == "nowhere" else [team.allowed[name] for name in team.agents]
        given = {n: obs[n]["observation"] if where == "obs" else obs[n] for n in obs}
        obs, paid, *_ = team.step(policy(given, masks))
        assert set(paid.values()) <= {0.0, 1.0}


def test_where_nothing_is_allowed_all_counts_as_such():
    """As at the end of an episode: a value of -1e9 would enter targets."""
    network = Choosing(MLP((4,)), (2, 2), masked=True)
    policy = network.init(6, 4, key=KEY)
    obs = jnp.array([0.0, 0, 0, 1, 0.2, 0.3])
    u = policy.spoken(obs, ())[1]
    assert (np.asarray(u) == -1e9).tolist() == [False, False, True, False]
    learners = (DQN(gamma=0.9), DQN(gamma=0.9, dueling=True), DiscreteSAC(gamma=0.9))
    single = Choosing(MLP((4,)), (4,), masked=True)
    rows = [jnp.zeros((3, 6)), jnp.ones((3, 4)), jnp.ones(3), jnp.zeros((3, 6))]
    batch = Batch(*rows, jnp.zeros(3, bool), jnp.ones(3, bool))
    for learner in learners:
        state = learner.init(single, 6, 4, key=KEY)
        _, metrics = learner.update(state, batch, key=KEY)
        assert all(abs(float(x)) < 100 for x in metrics.values())


def test_a_mask_may_stand_before_the_observation_of_any_agent():
    """That of the second, with its mask, is as short as that of the first without."""
    env = task("Team", PettingZoo)
    assert env.task_record()["lengths"] == [2, 1]
    units = Units(env.task_record() | {"names": None})
    given = [[0, 1, 1, 0.5, 0.6], [0, 1, 0, 0.5]]
    read = units.read(given)
    np.testing.assert_allclose(read, [[0, 1, 1, 0.5, 0.6], [0, 1, 0, 0.5, 0]])
    read = units.read([[0.5, 0.6], given[1]])
    np.testing.assert_allclose(read, [[1, 1, 1, 0.5, 0.6], [0, 1, 0, 0.5, 0]])


def test_a_policy_takes_a_dict_as_the_task_gives_it():
    """Its parts are in the order of training, what is allowed first; Gymnasium's own flat form has
    another order, and is refused rather than misread."""
    env = task("Barred")
    units, own = Units(env.task_record()), Barred()
    obs, _ = own.reset(seed=0)
    np.testing.assert_array_equal(units.read(obs), [*obs["action_mask"], 0.5])
    with pytest.raises(ValueError, match=r"begins with \[0.5.*give mask="):
        units.read(gymnasium.spaces.flatten(own.observation_space, obs))
    with pytest.raises(ValueError, match="has no part 'a first'"):
        units.read({"action_mask": obs["action_mask"]})
    shown = {"parts": [["x", {"nvec": [2, 3], "start": [0, 1]}], ["y", {"n": 2, "start": 0}]]}
    sizes = {"obs_size": 7, "action_size": 1, "shown": shown}
    read = Units(sizes).read({"y": 1, "x": np.array([1, 3]), "more": "text"})
    np.testing.assert_array_equal(read, [0, 1, 0, 0, 1, 0, 1])
    for parts in ((np.array([1, 3]), 1), [np.array([1, 3]), 1]):
        pairs = {"parts": [[0, shown["parts"][0][1]], [1, shown["parts"][1][1]]]}
        np.testing.assert_array_equal(Units(sizes | {"shown": pairs}).read(parts), read)
    with pytest.raises(ValueError, match="has 3 parts: it must have 2"):
        Units(sizes | {"shown": pairs}).read((np.array([1, 3]), 1, 1))
    np.testing.assert_array_equal(Units(sizes).read(read.tolist()), read)  # its numbers alone
    with pytest.raises(ValueError, match="is a dict, of which the policy's record does not tell"):
        Units(sizes | {"shown": None}).read({"x": 1})


@pytest.mark.parametrize("where", ["obs", "info"])
def test_a_task_with_masks_is_not_played_without_one(where):
    units = Units(task("Barred", where=where).task_record())
    with pytest.raises(ValueError, match="neither a mask was given nor does the observation"):
        units.read([0.5])
    np.testing.assert_array_equal(units.read([0.5], [0, 1, 1, 0]), [0, 1, 1, 0, 0.5])


def test_masks_of_several_choices_may_come_in_a_tuple():
    units = Units(task("Several", split=True).task_record())
    read = units.read([0.0], (np.array([0, 1, 1]), np.array([1, 0])))
    np.testing.assert_array_equal(read, [0, 1, 1, 1, 0, 0])


@pytest.mark.parametrize("where", ["obs", "info", "nowhere"])
def test_a_team_is_not_played_without_the_masks_that_its_task_gives(where):
    env = task("Team", PettingZoo, where=where)
    units, given = Units(env.task_record()), [[0.5, 0.6], [0.5]]
    if where == "nowhere":  # one agent has an action less: that is all
        np.testing.assert_allclose(units.read(given)[:, :3], [[1, 1, 1], [1, 1, 0]])
        return
    with pytest.raises(ValueError, match="neither a mask was given nor does the observation"):
        units.read(given)
    np.testing.assert_allclose(units.read(given, [[0, 1, 1], None])[:, :3], [[0, 1, 1], [1, 1, 0]])
    dicts = {
        "a": {"observation": np.array([0.5, 0.6]), "action_mask": np.array([0, 1, 1])},
        "b": {"action_mask": np.array([0, 1]), "observation": np.array([0.5])},
    }
    np.testing.assert_allclose(units.read(dicts), [[0, 1, 1, 0.5, 0.6], [0, 1, 0, 0.5, 0]])
    with pytest.raises(ValueError, match=r"begins with \[0.5"):
        units.read([[0.5, 0.6, 1, 1, 0], None])


def test_a_network_that_groups_share_is_looked_at_before_groups_are_known():
    network = TeamNetwork(trunk=(4,), sharing="groups")
    assert not network.remembers
    assert TeamNetwork(head=Recurrent("gru", 3), sharing="groups", groups=(0, 0, 1)).remembers
    three = Choosing(TeamNetwork(trunk=(4,), sharing="groups", groups=(0, 0, 1)), (3,))
    assert three.speaks
    assert not three.remembers


def test_what_says_discrete_itself_is_refused():
    with pytest.raises(TypeError, match=r"Old sets discrete, which follows from choices: give"):

        class Old(Forbidding):
            discrete = True


def test_a_team_that_is_masked_learns_by_ppo():
    env = task("Team", PettingZoo)
    settings = {"horizon": 100, "copies": 20, "batch_size": 20, "learning_rate": 3e-3}
    rows, _ = trained(PPO.ppo(env, signal="local", **settings), 25, eager)
    assert rows[-1]["champion_score"] >= 4.5  # of 5
    assert rows[0]["fitness_mean"] < 4.0


@pytest.mark.parametrize("sharing", ["trunk", "everything", "nothing"])
def test_a_team_in_jax_says_what_its_heads_say(sharing):
    network = TeamNetwork((6,), Recurrent("gru", 3), sharing)
    policy = network.init(4, 3, 2, key=KEY)
    obs = jax.random.normal(jax.random.key(2), (2, 4))
    for one in (policy, policy.arranged()):
        carry = one.start(key=KEY)
        features, u, after = one.spoken(obs, carry)
        action, same = one(obs, carry)
        assert features.shape == (2, 3)
        np.testing.assert_allclose(2 * jax.nn.sigmoid(u) - 1, action, atol=1e-6)
        jax.tree.map(np.testing.assert_array_equal, after, same)


def test_a_mask_stays_as_it_is_behind_noise_and_normalisation():
    env = NoisyObservations(Forbidding(), 3.0)
    _, first = env.reset(key=KEY)
    assert set(np.asarray(first.obs[:N]).tolist()) == {0.0, 1.0}
    assert float(first.obs[N]) != 0.5
    moments = Moments.first(env)
    mean, variance = jnp.full(N + 1, 0.5), jnp.full(N + 1, 0.04)
    moments = dataclasses.replace(moments, mean=mean, variance=variance)
    seen = moments.scaled(jnp.array([1.0, 0, 1, 0, 0.7]))
    np.testing.assert_allclose(seen, [1, 0, 1, 0, 1], atol=1e-3)
    with pytest.raises(ValueError, match="the first 4 say which actions are allowed"):
        hidden(Forbidding(), (1,))


@pytest.mark.parametrize("env", [Forbidding(), task("Barred", where="info")], ids=str)
def test_the_last_action_is_the_one_that_was_played(env):
    """Also of a network that does not know what is allowed."""
    told = with_last_step(env)
    if isinstance(env, Forbidding):
        state, first = told.reset(key=KEY)
        step = functools.partial(told.step, state, key=KEY)
        after = step(jnp.array([0.4, 0.3, 0.2, 0.1]))[1].obs
    else:
        copies, on = told.copies(1), np.ones(1, bool)
        first = TimeStep(copies.reset(np.array([3], np.uint32), on)[0], {}, None, None)
        after = copies.step(np.float32([[0.4, 0.3, 0.2, 0.1]]), on).obs[0]
    allowed = np.flatnonzero(np.asarray(first.obs[:N]))
    expected = np.where(np.arange(N) == allowed[0], 1.0, -1.0)
    np.testing.assert_array_equal(after[N + 1 : 2 * N + 1], expected)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"choices": (2.0, 2)}, "choices is .* it must be a tuple of the options of each"),
        ({"choices": (N, 3)}, "choices has 7 options and action_size is 4: it must hold them"),
        ({"obs_size": N}, "masked is set, choices has 4 options and obs_size is 4"),
        ({"scale": 0.5}, "what obs begins with at step 0 is no mask: give 1 or 0 for each option"),
        ({"scale": 0.0}, "what obs begins with at step 0 is no mask"),
    ],
)
def test_the_check_lists_what_is_wrong_with_choices(fields, told):
    class Wrong(Forbidding):
        scale = 1.0

        def _answer(self, reward, *, key):
            mask, now = super()._answer(reward, key=key)
            scale = jnp.where(jnp.arange(N + 1) < N, self.scale, 1.0)
            return mask, dataclasses.replace(now, obs=now.obs * scale)

    for name, value in fields.items():
        setattr(Wrong, name, value)
    found = checks.check_environment(Wrong())
    assert len(found) == 1
    assert re.search(told, found[0])


def test_the_check_follows_masks():
    assert checks.check_environment(Forbidding()) == []
    for env in (task("Barred"), task("Barred", where="info"), task("Several")):
        assert checks.check_environment(env) == []


def test_a_policy_takes_the_mask_in_the_observation_or_beside_it():
    env = task("Barred")
    policy = Policy(choosing(env, MLP((4,))).init(*env.sizes, key=KEY), env.task_record())
    world = gymnasium.wrappers.TimeLimit(Barred(), 10)
    obs, _ = world.reset(seed=0)
    for _ in range(9):
        mask, rest = obs["action_mask"], obs["a first"]
        chosen = policy(rest, mask)
        assert chosen == policy(np.concatenate([mask, rest]))
        assert chosen in 2 + np.flatnonzero(mask)
        obs, *_ = world.step(chosen)
    with pytest.raises(ValueError, match=r"the mask is .* which of 4 are allowed"):
        policy(obs["a first"], np.ones(5))
