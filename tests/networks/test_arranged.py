"""A policy that was laid out for many steps does what it did before."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.networks.dmmu import DMMU
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent
from credo.networks.team import Centralized, Team

OBS, ACT, AGENTS, STEPS = 3, 2, 3, 4
ALONE = {
    "mmu": MMU(hidden=4),
    "learned coders": MMU(hidden=4, memory=3, encoder="learned", decoder="learned", alpha=0.3),
    "tanh block": MMU(hidden=4, block_activation="tanh", output_activation="tanh"),
    "gru": Recurrent("gru", 4),
    "mlp": MLP(hidden=(4,)),
}
TEAMS = {
    "own mmus": Team(trunk=(), head=MMU(hidden=4), sharing="nothing"),
    "own trunks": Team(trunk=(5,), head=MLP(hidden=()), sharing="nothing"),
    "one trunk": Team(trunk=(5,), head=MMU(hidden=2)),
    "one policy": Team(trunk=(5,), sharing="everything"),
    "dmmu": DMMU(hidden=4, access="everyone"),
    "unequal dmmu": DMMU(hidden=(2, 4, 3), memory=4, access="everyone"),
    "shared lstm": DMMU(cell="lstm", hidden=4, access="everyone"),
    "centralized": Centralized(MMU(hidden=3)),
}


def actions(policy, obs):
    def body(carry, x):
        action, carry = policy(x, carry)
        return carry, action

    return jax.lax.scan(body, policy.start(key=jax.random.key(1)), obs)[1]


@pytest.mark.parametrize("name", [*ALONE, *TEAMS])
def test_it_acts_as_before(name):
    team = name in TEAMS
    network, sizes = (TEAMS[name], (OBS, ACT, AGENTS)) if team else (ALONE[name], (OBS, ACT))
    policy = network.init(*sizes, key=jax.random.key(0))
    shape = (STEPS, AGENTS, OBS) if team else (STEPS, OBS)
    obs = jnp.asarray(np.random.default_rng(0).normal(size=shape), jnp.float32)
    before, after = eqx.filter_jit(lambda p, x: (actions(p, x), actions(p.arranged(), x)))(
        policy, obs
    )
    np.testing.assert_allclose(after, before, atol=1e-5)
    assert np.abs(np.diff(np.asarray(before), axis=0)).max() > 1e-3
