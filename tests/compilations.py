"""How many programs are compiled, or loaded from the cache, meanwhile."""

import contextlib

import jax

BACKEND_COMPILE = "/jax/core/compile/backend_compile_duration"


@contextlib.contextmanager
def compilations():
    """A list that grows by one for every program."""
    events = []

    def listen(event, duration, **details):
        if event == BACKEND_COMPILE:
            events.append(details)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield events
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
