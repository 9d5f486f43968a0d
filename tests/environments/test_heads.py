"""Whether the head of a Ray cluster is there, without Ray."""

import socket
import types

from credo.environments import cluster


def head(address: str, store: str | None = None) -> cluster.Head:
    """As a process sees it that is connected there; `store`: the socket of Ray on this machine."""
    context = types.SimpleNamespace(gcs_address=address)
    node = types.SimpleNamespace(plasma_store_socket_name=store)
    private = types.SimpleNamespace(worker=types.SimpleNamespace(_global_node=node))
    return cluster.Head(
        types.SimpleNamespace(get_runtime_context=lambda: context, _private=private)
    )


def asked_again(one: cluster.Head) -> str:
    one.asked -= 2.0  # it is asked once a second
    return one.missing()


def test_a_head_that_does_not_answer_is_named_once_there_is_no_hope(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as server:
        one = head(f"127.0.0.1:{server.getsockname()[1]}")
        assert asked_again(one) == ""
    assert one.missing() == ""  # it was asked just now
    assert asked_again(one) == ""
    assert one.failing is not None
    monkeypatch.setattr(cluster, "HEAD", 1.0)
    one.failing -= 2.0
    told = f"the head of the Ray cluster at {one.address} has not answered for 1 s ("
    assert asked_again(one).startswith(told)


def test_ray_that_ended_on_this_machine_is_told(tmp_path):
    path = tmp_path / "store"
    one = head("127.0.0.1:1", str(path))
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as store:
        store.bind(str(path))
        store.listen()
        assert one.gone() == ""
    assert one.gone().startswith("Ray has ended on this machine (")
    assert head("127.0.0.1:1").gone() == ""
