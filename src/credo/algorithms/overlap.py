"""Overlap: learners learn while the generation is played (Khadka 2019, section 6.4, future work).

A generation of Algorithm 6, 10 or 13 plays first and learns then, so processors that play idle
while it learns, and the other way round. With `overlap` its learners make the updates that the
frames of the generation *before* are due, on the replay buffer as that one left it, and the actors
with which they explore are those from before these updates. What is learned from is therefore one
generation older, always, on any number of processes: the lag is part of the algorithm and of a
run's record, and the result depends on no clock.
"""

from dataclasses import replace

import jax.numpy as jnp

from ..normalization import behind
from ..playing import players
from ..rollout import begun
from ..types import Evaluation, Metrics
from .hybrid import Hybrid, HybridState, Key, exploring, improve, observed, stored


def overlapped(
    hybrid: Hybrid, state: HybridState, *, keys: tuple[Key, Key, Key]
) -> tuple[HybridState, Evaluation, Metrics]:
    """Population and learners play, and meanwhile learners improve by what was played before.

    **Arguments:** `keys`: of the population's episodes, of the learners', and of their updates.

    **Returns:** the state with all that was played, the population's episodes, and as metrics what
    `teach` says.
    """
    play_key, explore_key, learn_key = keys
    state = replace(state, moments=state.seen)
    acting = behind(state.moments, state.population)
    population, asked = begun(hybrid.env, acting, hybrid.episodes, key=play_key), []
    for i in range(len(hybrid.learners)):
        team, how = exploring(hybrid, state, i, key=explore_key)
        team = behind(state.moments, team)
        asked.append((how["wanted"], begun(hybrid.env, team, hybrid.workers, **how)))
    players.start()
    state, metrics = improve(hybrid, state, state.owed, hybrid.rounds, key=learn_key)
    played, new = population()
    state, frames = stored(hybrid, state, played, new), jnp.sum(played.steps)
    for i, (mine, explorer) in enumerate(asked):
        theirs, new = explorer()
        state, told = observed(hybrid, stored(hybrid, state, theirs, new), i, mine, theirs)
        frames, metrics = frames + jnp.sum(theirs.steps), metrics | told
    return replace(state, owed=frames), played, metrics | {"frames": frames}
