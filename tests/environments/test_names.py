"""Names of environments: which code they stand for, whose it is, and what is never called."""

import os
import subprocess
import sys
import textwrap

import broken
import gymnasium
import numpy as np
import pytest

from credo.environments import names
from credo.environments.foreign import close_all
from credo.environments.gymnasium import Gymnasium, make
from credo.environments.host import EnvironmentFailure


@pytest.fixture(scope="module", autouse=True)
def _workers_end():
    yield
    close_all()


class Made(broken.Tiny):
    """Acts when it is made."""


def maker(n: int = 1):
    return broken.Clock()


@pytest.mark.parametrize(
    "name", ["os:system", "subprocess:Popen", "builtins:eval", "os:environ", "broken:NoEnv"]
)
def test_what_is_no_environment_is_refused_before_it_is_called(name, tmp_path):
    mark = tmp_path / "mark"
    env = Gymnasium(name, {"command": f"touch {mark}"}, in_process=True)
    with pytest.raises(EnvironmentFailure, match=r"is a \w+: name a class derived from gymnasium"):
        _ = env.obs_size
    with pytest.raises(names.Fault, match=r"is a \w+"):
        names.resolve(name)
    assert not mark.exists()


def test_the_tasks_that_credo_registers_make_tasks_alone(tmp_path):
    with pytest.raises(names.Fault, match="is a builtin_function_or_method"):
        make("os:system", command=f"touch {tmp_path / 'mark'}")
    assert not (tmp_path / "mark").exists()


def test_things_are_named_and_found():
    assert names.name_of(broken.Tiny) == "broken:Tiny"
    assert names.name_of("Hopper-v5") == "Hopper-v5"
    assert names.resolve(names.name_of(maker)) is maker
    assert names.resolve("broken:Tiny", gymnasium.Env) is broken.Tiny
    with pytest.raises(ValueError, match=r"3 is given .*: give a class, a plain Python function"):
        names.name_of(3)
    with pytest.raises(names.Fault, match="broken has no Gone"):
        names.resolve("broken:Gone")


def test_what_no_other_process_can_import_is_found_in_this_one():
    class Local(broken.Clock):
        pass

    env = Gymnasium(Local)
    assert (env.id.endswith("<locals>.Local"), env.here, env.in_process) == (True, True, False)
    assert (env.obs_size, env.max_steps) == (2, 4)
    assert env == Gymnasium(Local)
    first = env.id

    class Local(broken.Clock):  # as a notebook's cell that runs again
        observation_space = gymnasium.spaces.Box(-9, 9, (2,), np.float32)

    again = Gymnasium(Local)
    assert again.id == f"{first}@2"
    assert names.find(again.id) is Local
    with pytest.raises(names.Fault, match=r"in a notebook.*not known here"):
        names.resolve("__main__:Elsewhere", gymnasium.Env)


def test_a_class_or_a_factory_in_place_of_its_name():
    assert Gymnasium(broken.Tiny, max_episode_steps=9) == Gymnasium("broken:Tiny", (), 9)
    env = Gymnasium(maker)
    assert env.id == f"{__name__}:maker"
    assert not env.here
    copies = env.copies(1)
    assert copies.reset(np.zeros(1, np.uint32), np.ones(1, bool)).shape == (1, 2)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("broken:Tiny", "gymnasium"),
        ("broken:running", "gymnasium"),
        ("broken:NoEnv", None),
        ("os:system", None),
        ("broken_team:Pair", "pettingzoo"),
        ("broken_team:parallel_env", "pettingzoo"),
        ("broken_team:a_number", None),
    ],
)
def test_whose_interface_a_name_has(name, kind):
    if "team" in name:
        pytest.importorskip("pettingzoo")
    assert names.kind_of(name) == kind


@pytest.mark.parametrize(
    ("api", "id", "kwargs", "code"),
    [
        ("gymnasium", "Hopper-v5", {}, None),
        ("gymnasium", "credo/SequenceRecall-v0", {"depth": 2}, None),
        ("gymnasium", "credo/SequenceRecall-v0", {"task": "mine:Evil"}, "mine:Evil"),
        ("gymnasium", "credo.environments.gymnasium:credo/SequenceRecall-v0", {}, None),
        ("gymnasium", "os:system", {}, "os:system"),
        ("gymnasium", "mine:Name-v0", {}, "mine:Name-v0"),
        ("gymnasium", "__main__:Mine", {}, "__main__:Mine"),
        ("pettingzoo", "mpe2.simple_spread_v3", {}, None),
        ("pettingzoo", "mpe2.simple_spread_v3:np", {}, "mpe2.simple_spread_v3:np"),
        ("pettingzoo", "mpe20.mine", {}, "mpe20.mine"),
        ("pettingzoo", "mine", {}, "mine"),
    ],
)
def test_whose_code_a_name_would_import(api, id, kwargs, code):
    assert names.foreign_code(api, id, kwargs) == code


@pytest.fixture
def registering():
    yield lambda id, entry, **more: gymnasium.register(id, entry, max_episode_steps=3, **more)
    for id in [id for id in gymnasium.registry if id.startswith("credo-tests/")]:
        del gymnasium.registry[id]


@pytest.mark.parametrize("entry", ["broken:Tiny", broken.Tiny], ids=["name", "class"])
def test_a_worker_knows_what_the_script_registered(registering, entry):
    env = Gymnasium(f"credo-tests/{type(entry).__name__}-v0")
    registering(env.id, entry, kwargs={"at": 5})
    assert env.foreign_code == (entry if isinstance(entry, str) else env.id)
    assert (env.obs_size, env.max_steps) == (2, 3)


def test_what_the_script_alone_can_make_is_named_so(registering):
    registering("credo-tests/Line-v0", lambda **_: broken.Tiny())
    told = r"in the process of the script alone: name the module, as in mine:.*in_process=True"
    with pytest.raises(EnvironmentFailure, match=told):
        _ = Gymnasium("credo-tests/Line-v0").obs_size
    assert Gymnasium("credo-tests/Line-v0", in_process=True).max_steps == 3


def test_a_script_names_its_own_classes_and_a_prompt_keeps_them(tmp_path):
    code = """
        import gymnasium, broken, credo
        class Mine(broken.Clock):
            pass
        if __name__ == "__main__":
            for given in (Mine, "__main__:Mine"):
                env = credo.Gymnasium(given)
                print(env.id, env.here, env.max_steps)
        """
    script = tmp_path / "my_script.py"
    script.write_text(textwrap.dedent(code))
    path = os.pathsep.join([os.path.dirname(__file__), *filter(None, sys.path)])
    told = [
        subprocess.run(
            [sys.executable, *arguments],
            env={**os.environ, "PYTHONPATH": path},
            input=given,
            capture_output=True,
            text=True,
            check=True,
            timeout=120,
        ).stdout
        for arguments, given in (([str(script)], None), (["-"], script.read_text()))
    ]
    assert told == ["my_script:Mine False 4\n" * 2, "__main__:Mine True 4\n" * 2]


@pytest.mark.parametrize("module", ["evil", "evil.credo", "os"])
@pytest.mark.parametrize("kwargs", [{}, {"task": ""}, {"task": 0}, {"task": None}])
def test_a_module_before_an_id_of_credos_is_somebodys_own(module, kwargs):
    assert names.foreign_code("gymnasium", f"{module}:credo/X-v0", kwargs) is not None
    own = names.foreign_code("gymnasium", "credo.environments.gymnasium:credo/X-v0", kwargs)
    assert (own is None) == (kwargs == {})
    assert names.foreign_code("pettingzoo", "credo.environments.gymnasium:credo/X-v0", kwargs)
    if kwargs:
        assert Gymnasium("credo/SequenceRecall-v0", kwargs=kwargs).foreign_code is not None


def test_a_worker_knows_gymnasiums_own_code_under_a_scripts_name(registering):
    entry = "gymnasium.envs.classic_control.cartpole:CartPoleEnv"
    registering("credo-tests/Pole-v0", entry)
    env = Gymnasium("credo-tests/Pole-v0")
    assert env.foreign_code is None
    assert (env.obs_size, env.max_steps) == (4, 3)


def test_wrappers_of_a_scripts_task_are_sent(registering):
    wrapper = gymnasium.envs.registration.WrapperSpec("W", "somebody:W", {"by": 2})
    entry = "gymnasium.envs.classic_control.cartpole:CartPoleEnv"
    registering("credo-tests/Wrapped-v0", entry, additional_wrappers=(wrapper,))
    assert names.registered("credo-tests/Wrapped-v0")["additional_wrappers"] == [
        ("W", "somebody:W", {"by": 2})
    ]
    assert Gymnasium("credo-tests/Wrapped-v0").foreign_code is not None
