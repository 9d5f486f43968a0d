"""Lineage: who made whom, in cases computed by hand."""

import dataclasses

import jax.numpy as jnp
import pytest

from credo.algorithms.lineage import (
    CROSSED,
    CROSSED_AND_MUTATED,
    DRAWN,
    INJECTED,
    MAKERS,
    MUTATED,
    Lineage,
)
from credo.evolution.descent import Descent


def index(*numbers):
    return jnp.array(numbers, jnp.int32)


def flags(*numbers):
    return jnp.array(numbers, bool)


def descent(elites, parents, mates=None, crossed=None, taken=None, mutated=None):
    """Elites as they are, then a child of each parent."""
    e, n = len(elites), len(parents)

    no = jnp.zeros(n, bool)
    crossed, mutated = (no if x is None else x for x in (crossed, mutated))
    taken = jnp.where(crossed, jnp.zeros(n) if taken is None else taken, 0.0)
    return Descent(
        parent=jnp.concatenate([elites, parents]),
        elite=jnp.arange(e + n) < e,
        crossed=jnp.concatenate([jnp.zeros(e, bool), crossed]),
        mutated=jnp.concatenate([jnp.zeros(e, bool), mutated]),
        mate=jnp.concatenate([elites * 0, parents * 0 if mates is None else mates])[:, None],
        taken=jnp.concatenate([jnp.zeros(e), taken])[:, None],
    )


@pytest.fixture
def guests():
    """Five members; learner 0's actor lies in slot 4 and learner 1's in slot 3."""
    return Lineage.first(5, 2).inject(4, 0).inject(3, 1)


def test_at_first_everybody_was_drawn():
    lineage = Lineage.first(3, 2)
    assert lineage.maker.tolist() == [DRAWN] * 3
    assert lineage.share.tolist() == [[1.0, 0.0, 0.0]] * 3
    assert lineage.guest.tolist() == [-1] * 3
    assert Lineage.first(3, 0).share.tolist() == [[1.0]] * 3


def test_an_injected_actor_is_its_learners_and_nobody_elses(guests):
    assert guests.maker.tolist() == [DRAWN, DRAWN, DRAWN, INJECTED, INJECTED]
    assert guests.share.tolist() == [[1.0, 0.0, 0.0]] * 3 + [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]
    assert guests.guest.tolist() == [-1, -1, -1, 1, 0]


def test_children_in_every_way(guests):
    next_ = guests.after(
        descent(
            elites=index(4),
            parents=index(4, 3, 0, 0),
            mates=index(4, 4, 4, 4),
            crossed=flags(0, 1, 1, 0),
            taken=jnp.array([0.3, 0.5, 0.5, 0.3]),
            mutated=flags(0, 0, 1, 1),
        )
    )
    made = [INJECTED, INJECTED, CROSSED, CROSSED_AND_MUTATED, MUTATED]
    assert next_.maker.tolist() == made
    assert next_.share.tolist() == [
        [0.0, 1.0, 0.0],
        [0.0, 1.0, 0.0],
        [0.0, 0.5, 0.5],
        [0.5, 0.5, 0.0],
        [1.0, 0.0, 0.0],
    ]
    assert next_.guest.tolist() == [-1] * 5
    assert next_.guest.dtype == guests.guest.dtype


def test_the_share_of_a_learner_grows_with_each_crossing(guests):
    """Member 0's line is crossed with an elite, which is learner 0's, three times."""
    lineage, everyone, half = guests, jnp.ones(4, bool), jnp.full(4, 0.5)
    lineage = lineage.after(
        descent(index(4), index(0, 0, 0, 0), index(4, 4, 4, 4), everyone, half, everyone)
    )
    for share in (0.75, 0.875):
        lineage = lineage.after(
            descent(index(0), index(1, 2, 3, 4), index(0, 0, 0, 0), everyone, half, ~everyone)
        )
        assert lineage.share.tolist() == [[0.0, 1.0, 0.0], *[[1.0 - share, share, 0.0]] * 4]
    assert lineage.maker.tolist() == [INJECTED, *[CROSSED] * 4]


def test_a_guest_is_elite_before_it_is_selected(guests):
    fates = guests.fates(descent(index(4, 0), index(4, 3, 1)))
    assert {name: count.tolist() for name, count in fates.items()} == {
        "elite": [1, 0],
        "selected": [0, 1],
        "discarded": [0, 0],
    }


def test_who_is_neither_elite_nor_parent_is_discarded(guests):
    fates = guests.fates(descent(index(1, 0), index(1, 1, 4)))
    assert {name: count.tolist() for name, count in fates.items()} == {
        "elite": [0, 0],
        "selected": [1, 0],
        "discarded": [0, 1],
    }


def test_members_that_are_no_guests_do_not_count():
    fates = Lineage.first(4, 1).fates(descent(index(0), index(1, 2, 3)))
    assert {name: count.tolist() for name, count in fates.items()} == {
        "elite": [0],
        "selected": [0],
        "discarded": [0],
    }


def test_makers_have_names():
    assert MAKERS[DRAWN] == "drawn"
    assert MAKERS[MUTATED] == "mutation"
    assert MAKERS[CROSSED] == "crossover"
    assert MAKERS[CROSSED_AND_MUTATED] == "crossover and mutation"
    assert MAKERS[INJECTED] == "learner"


def test_an_elite_is_judged_by_all_it_had_and_the_lucky_are_believed_half():
    lineage, standing = Lineage.first(4, 1).averaged(jnp.array([8.0, 6.0, 2.0, 0.0]))
    assert standing.tolist() == [6.0, 5.0, 3.0, 2.0]  # with the mean, 4: the order is the same
    lineage = lineage.after(descent(index(0, 1), index(0, 1), mutated=flags(1, 1)))
    assert lineage.earned.tolist() == [8.0, 6.0, 0.0, 0.0]
    assert lineage.times.tolist() == [1.0, 1.0, 0.0, 0.0]
    # A hard world: the old elites had bad luck, and a child was lucky.
    lineage, standing = lineage.averaged(jnp.array([0.0, 4.0, 8.0, 0.0]))
    assert standing.tolist() == pytest.approx([11 / 3, 13 / 3, 5.5, 1.5])
    lineage, standing = lineage.averaged(jnp.array([8.0, 8.0, 0.0, 0.0]))
    assert standing.tolist() == pytest.approx([20 / 4, 22 / 4, 12 / 3, 4 / 3])
    guest = lineage.inject(0, 0)
    assert (float(guest.earned[0]), float(guest.times[0])) == (0.0, 0.0)


def test_who_had_no_number_is_nobodys_standard():
    _, standing = Lineage.first(3, 1).averaged(jnp.array([jnp.nan, 2.0, 4.0]))
    assert standing.tolist()[1:] == [2.5, 3.5]
    assert jnp.isnan(standing[0])


def test_who_is_newly_drawn_has_no_ancestors(guests):
    bred = descent(index(4), index(3, -1, -1, 2), mutated=flags(1, 1, 0, 0))
    next_ = guests.after(bred)
    assert next_.maker.tolist() == [INJECTED, MUTATED, DRAWN, DRAWN, DRAWN]
    assert next_.share[:, 0].tolist() == [0.0, 0.0, 1.0, 1.0, 1.0]


def test_a_later_mate_is_of_the_new_population(guests):
    """First a child of 0 takes half of guest 4, then its sibling takes half of that child."""
    bred = descent(index(4), index(0, 0, 0, 0), index(4, 4, 4, 4), flags(1, 0, 0, 0))
    mate = jnp.stack([jnp.array([0, 4, 4, 4, 4]), jnp.array([0, 1, 1, 1, 1])], axis=1)
    taken = jnp.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5], [0.0, 0.0], [0.0, 0.0]])
    bred = dataclasses.replace(bred, mate=mate, taken=taken)
    assert guests.after(bred).share[:, 1].tolist() == [1.0, 0.5, 0.25, 0.0, 0.0]
