"""Training on disk: stopped, killed, damaged or moved on, a run ends in the same bytes."""

import contextlib
import json
import os
import pathlib
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from reading import read

from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.sequence_classification import SequenceClassification
from credo.networks.mmu import MMU
from credo.runs import checkpoint, config, loop
from credo.runs.checkpoint import CheckpointError, DamagedCheckpoint, damage, read_metadata
from credo.runs.lock import RunLocked

ALGORITHM = Neuroevolution(
    SequenceClassification(depth=2, min_gap=1, max_gap=2),
    MMU(hidden=3),
    population_size=10,
    episodes=4,
    test_episodes=6,
)
BACKEND_COMPILE = "/jax/core/compile/backend_compile_duration"
QUIET = {"tensorboard": False, "progress": False}
BUDGET = 150


def train(path, generations=BUDGET, **options):
    return loop.train(ALGORITHM, generations=generations, path=path, **QUIET | options)


def resume(path, **options):
    return loop.resume(path, **QUIET | options)


def until(generation):
    """A callback that stops there. The dispatch that it falls in is finished first."""
    return (lambda run, g, metrics: g >= generation,)


def checkpoints(path) -> list[pathlib.Path]:
    return sorted((path / "checkpoints").glob("[0-9]*"))


def contents(path) -> dict[str, bytes]:
    """What a rerun repeats bit for bit."""
    newest = checkpoints(path)[-1]
    names = ("metrics.csv", "champion.safetensors", "best.safetensors")
    files = [*(path / name for name in names), *newest.iterdir()]
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


def results(path) -> dict[str, bytes]:
    """The same without the seals, which tell budgets and versions apart."""
    champion = safetensors.numpy.load_file(path / "champion.safetensors")
    files = [path / "metrics.csv", checkpoints(path)[-1] / "state.safetensors"]
    named = {str(file.relative_to(path)): file.read_bytes() for file in files}
    return named | {name: array.tobytes() for name, array in champion.items()}


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """A run that nothing disturbed, with a checkpoint at every dispatch."""
    path = tmp_path_factory.mktemp("straight") / "run"
    train(path, checkpoint_every=0.0, keep=100)
    return path


@pytest.fixture
def stopped(straight, tmp_path):
    """A run stopped half-way."""
    path = tmp_path / "stopped"
    train(path, callbacks=until(4), checkpoint_every=0.0, keep=100)
    assert 4 <= int(checkpoints(path)[-1].name) < BUDGET
    return path


def test_a_run_is_a_folder_that_says_everything(straight):
    run = loop.Run(straight)
    assert run.algorithm == ALGORITHM
    assert run.config["seed"] == 0
    assert run.config["budget"] == {"generations": BUDGET, "frames": None, "stop_at": None}
    assert run.metrics["generation"].tolist() == list(range(1, BUDGET + 1))
    assert np.all(np.diff(run.metrics["frames"]) >= 10 * 4 * 3)  # depth 2, gaps of 1 or 2
    metadata = read_metadata(straight / "champion.safetensors")
    assert json.loads(metadata["algorithm"]) == run.config["algorithm"]
    assert metadata["generation"] == str(BUDGET)
    assert checkpoints(straight)[-1].name == f"{BUDGET:08}"


def test_metrics_are_those_of_generations_played_by_hand(straight):
    root = jax.random.key(0)
    state = jax.jit(ALGORITHM.init)(key=jax.random.fold_in(root, 0))
    generation = jax.jit(lambda state, key: ALGORITHM.generation(state, key=key))
    logged = loop.Run(straight).metrics
    for g in range(1, 4):
        state, metrics = generation(state, jax.random.fold_in(root, g))
        for name in ("fitness_max", "fitness_mean", "champion_score"):
            assert logged[name][g - 1] == pytest.approx(float(metrics[name]), rel=1e-5)


def test_another_seed_is_another_run(straight, tmp_path):
    train(tmp_path / "other", generations=3, seed=1)
    mine = loop.Run(straight).metrics["fitness_mean"][:3]
    assert not np.isin(loop.Run(tmp_path / "other").metrics["fitness_mean"], mine).any()


def test_stopped_and_resumed_is_bit_for_bit_the_straight_run(straight, stopped):
    assert contents(stopped) != contents(straight)
    resume(stopped)
    assert contents(stopped) == contents(straight)
    assert (stopped / "config.json").read_bytes() == (straight / "config.json").read_bytes()


def test_resuming_a_finished_run_changes_nothing_and_says_so(straight, capsys):
    before = contents(straight)
    options = {"progress": True, "callbacks": (lambda *_: pytest.fail("trained"),)}
    assert resume(straight, **options).path == straight
    assert contents(straight) == before
    assert capsys.readouterr().err == (
        f"{straight} is finished: {BUDGET} of {BUDGET} generations; to go on give a larger "
        "--generations or --frames\n"
    )


def test_a_larger_budget_is_the_run_that_had_it_from_the_start(straight, tmp_path):
    train(tmp_path / "short", generations=7)
    resume(tmp_path / "short", generations=BUDGET)
    assert contents(tmp_path / "short") == contents(straight)
    short, whole = loop.Run(tmp_path / "short").config, loop.Run(straight).config
    assert (short["budget"], short["algorithm"]) == (whole["budget"], whole["algorithm"])
    old = {"generations": 7, "frames": None, "stop_at": None}
    assert short["changes"] == [{"generation": 7, "budget": old}]


def test_a_smaller_budget_is_refused(straight):
    with pytest.raises(loop.RunError, match=r"budget is 150 generations.*larger, not 149"):
        resume(straight, generations=149)
    assert loop.Run(straight).config["budget"]["generations"] == BUDGET


def test_an_impossible_budget_is_refused(tmp_path):
    with pytest.raises(ValueError, match="generations is 0"):
        train(tmp_path / "run", generations=0)
    with pytest.raises(ValueError, match="frames is -1"):
        train(tmp_path / "run", frames=-1)
    assert not (tmp_path / "run").exists()


def test_a_budget_of_frames_stops_inside_a_dispatch(straight, tmp_path):
    frames = loop.Run(straight).metrics["frames"]
    last = 100  # of the generations; by then dispatches are longer than one
    run = train(tmp_path / "run", generations=None, frames=int(frames[last - 1]))
    assert run.metrics["generation"][-1] == last
    resume(tmp_path / "run", frames=int(frames[last - 1]) + 1)
    assert run.metrics["generation"][-1] == last + 1
    resume(tmp_path / "run", generations=BUDGET)
    assert contents(tmp_path / "run") == contents(straight)
    assert loop.Run(run.path).config["budget"] == loop.Run(straight).config["budget"]


def test_a_budget_of_generations_has_no_limit_of_frames():
    """Frames are counted beyond what 32 bits hold."""
    state = loop._initial(ALGORITHM, jax.random.key(0))
    seen, budget = 2**31 + 5, loop.Budget(generations=2)
    best = loop.Best.none(eqx.filter(state.champion, eqx.is_array))
    state, best, batch = loop.play(ALGORITHM, state, best, jax.random.key(0), 0, seen, 2, budget)
    assert [row["generation"] for row in batch] == [1, 2]
    assert batch[0]["frames"] > seen
    budget = loop.Budget(frames=batch[1]["frames"] + 1)
    _, _, more = loop.play(
        ALGORITHM, state, best, jax.random.key(0), 2, batch[1]["frames"], 2, budget
    )
    assert [row["generation"] for row in more] == [3]


def test_a_run_of_an_older_version_knows_no_frames_optax_task_or_signature(stopped, straight):
    old = json.loads((stopped / "config.json").read_text())
    old = {name: old[name] for name in ("algorithm", "seed", "budget", "machine")}
    del old["budget"]["frames"], old["machine"]["versions"]["optax"]
    (stopped / "config.json").write_text(json.dumps(old))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        resume(stopped)
    assert results(stopped) == results(straight)


def test_without_a_budget_neuroevolution_has_a_thousand_generations(tmp_path):
    run = train(tmp_path / "run", generations=None, callbacks=until(1))
    assert run.config["budget"] == {"generations": 1000, "frames": None, "stop_at": None}


def test_the_memory_of_a_state_is_used_again():
    state = loop._initial(ALGORITHM, jax.random.key(0))
    before = jax.tree.leaves(eqx.filter(state, eqx.is_array))
    budget = loop.Budget(generations=1)
    best = loop.Best.none(eqx.filter(state.champion, eqx.is_array))
    state, _, _ = loop.play(ALGORITHM, state, best, jax.random.key(0), 0, 0, 1, budget)
    assert all(leaf.is_deleted() for leaf in before)
    assert np.isfinite(jax.tree.leaves(state.population)[0]).all()


def test_an_early_interrupt_leaves_nothing_behind(tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    (tmp_path / "mine").mkdir()
    monkeypatch.setattr(loop, "_initial", interrupted)
    for path in (tmp_path / "new" / "folder" / "run", tmp_path / "mine"):
        with pytest.raises(KeyboardInterrupt):
            train(path)
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_no_warm_start_where_the_algorithm_has_none(straight, tmp_path):
    with pytest.raises(loop.RunError, match="Neuroevolution cannot start from another run's"):
        train(tmp_path / "run", warm_start=straight)
    assert not (tmp_path / "run").exists()


def test_stop_at_ends_at_the_first_score_that_reaches_it(straight, tmp_path):
    scores = loop.Run(straight).metrics["champion_score"].astype(np.float32)
    best = int(np.argmax(scores))
    assert best > 0
    run = train(tmp_path / "run", stop_at=float(scores[best]))
    np.testing.assert_array_equal(
        run.metrics["champion_score"].astype(np.float32), scores[: best + 1]
    )
    resume(tmp_path / "run")  # it has stopped: nothing to do
    assert len(run.metrics["generation"]) == best + 1
    resume(tmp_path / "run", generations=BUDGET, stop_at=None)
    assert contents(tmp_path / "run") == contents(straight)


def test_wall_clock_saves_and_ends(straight, tmp_path):
    run = train(tmp_path / "run", generations=10**6, wall_clock=0.0)
    assert run.metrics["generation"].tolist() == [1]
    assert checkpoints(run.path)[-1].name == "00000001"
    resume(run.path, callbacks=until(BUDGET))
    rows = (tmp_path / "run" / "metrics.csv").read_text().splitlines()
    assert rows[: BUDGET + 1] == (straight / "metrics.csv").read_text().splitlines()


def test_the_callback_sees_every_generation_once_in_order(straight, tmp_path):
    seen = []
    train(tmp_path / "run", callbacks=(lambda _, g, m: seen.append((g, m["fitness_mean"])),))
    assert [g for g, _ in seen] == list(range(1, BUDGET + 1))
    logged = loop.Run(straight).metrics["fitness_mean"]
    np.testing.assert_array_equal(np.float32([f for _, f in seen]), logged.astype(np.float32))


def test_a_folder_with_a_run_is_refused(straight):
    before = contents(straight)
    with pytest.raises(loop.RunError, match="holds a run already: `credo resume"):
        train(straight)
    assert contents(straight) == before


def test_what_is_not_a_run_is_refused(tmp_path):
    with pytest.raises(loop.RunError, match=r"is not a run: it has no config\.json"):
        resume(tmp_path)
    with pytest.raises(loop.RunError, match="is not a run"):
        loop.Run(tmp_path / "nowhere")
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(loop.RunError, match=r"config\.json is damaged"):
        loop.Run(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["config.json"]


def test_a_second_process_is_refused_and_harms_nothing(straight, tmp_path):
    script = f"from credo.runs import loop; loop.resume({str(tmp_path / 'run')!r}, generations=999)"
    answers = []

    def intrude(run, generation, metrics):
        if generation == 2:
            before = contents(tmp_path / "run")
            other = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
            answers.append((other.returncode, other.stderr, contents(tmp_path / "run") == before))
            with pytest.raises(RunLocked):
                resume(tmp_path / "run")

    train(tmp_path / "run", checkpoint_every=0.0, callbacks=(intrude,))
    ((code, told, unharmed),) = answers
    assert code == 1
    assert f"RunLocked: {tmp_path / 'run'} is in use by process {os.getpid()}" in told
    assert unharmed
    assert contents(tmp_path / "run") == contents(straight)


def flip_a_bit(folder):
    data = bytearray((folder / "state.safetensors").read_bytes())
    data[-5] ^= 1
    (folder / "state.safetensors").write_bytes(data)


def truncate(folder):
    os.truncate(folder / "state.safetensors", 100)


def empty(folder):
    for file in folder.iterdir():
        file.unlink()


def uncommit(folder):
    (folder / "COMMIT").unlink()


HARMS = (flip_a_bit, truncate, empty, uncommit)


@pytest.mark.parametrize("harm", HARMS, ids=lambda harm: harm.__name__)
def test_a_damaged_checkpoint_is_named_and_an_older_one_used(straight, stopped, harm):
    *_, older, newest = checkpoints(stopped)
    harm(newest)
    with pytest.warns(DamagedCheckpoint, match=f"{newest} is damaged .*using {older.name}"):
        resume(stopped)
    assert contents(stopped) == contents(straight)


def test_with_every_checkpoint_damaged_nothing_is_retrained(stopped):
    for folder in checkpoints(stopped):
        flip_a_bit(folder)
    before = contents(stopped)
    with pytest.raises(CheckpointError, match="no intact checkpoint"):
        resume(stopped, callbacks=(lambda *_: pytest.fail("trained"),))
    assert contents(stopped) == before


def test_a_half_written_row_of_metrics_is_no_obstacle(straight, stopped):
    with (stopped / "metrics.csv").open("a") as file:
        file.write("99,13")
    resume(stopped)
    assert contents(stopped) == contents(straight)


@contextlib.contextmanager
def largest_file(size):
    """Stands for a full disk: writing fails beyond this many bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        yield lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_spares_the_older_checkpoints(straight, tmp_path):
    size = (checkpoints(straight)[-1] / "state.safetensors").stat().st_size
    with largest_file(size - 1) as fill, pytest.raises(CheckpointError, match="cannot save"):
        train(
            tmp_path / "run", checkpoint_every=0.0, callbacks=(lambda _, g, m: g >= 4 and fill(),)
        )
    saved = checkpoints(tmp_path / "run")
    assert 1 <= int(saved[-1].name) <= 4
    assert [damage(folder) for folder in saved] == [None] * len(saved)
    resume(tmp_path / "run")
    assert contents(tmp_path / "run") == contents(straight)


def test_a_disk_too_full_for_metrics_says_so_and_the_run_goes_on_later(straight, tmp_path):
    whole = (straight / "metrics.csv").read_bytes()
    size = len(b"".join(whole.splitlines(keepends=True)[:100])) + 7  # a part of row 100
    with largest_file(size) as fill, pytest.raises(OSError, match=r"free some space.*metrics\.csv"):
        train(tmp_path / "run", callbacks=(lambda _, g, m: g >= 3 and fill(),))
    left = (tmp_path / "run" / "metrics.csv").read_bytes()
    assert (whole.startswith(left), left[-1:], len(left) < size) == (True, b"\n", True)
    resume(tmp_path / "run")
    assert contents(tmp_path / "run") == contents(straight)


def test_another_machine_is_mentioned(stopped, monkeypatch):
    here = config.machine()
    monkeypatch.setattr(config, "machine", lambda: here | {"cores": here["cores"] + 1})
    with pytest.warns(
        UserWarning, match=r"began under other conditions \(cores: .* not bit for bit"
    ):
        run = resume(stopped)
    assert run.metrics["generation"][-1] == run.config["budget"]["generations"]  # it goes on


NUMBERS = [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]


@pytest.mark.parametrize(("number", "code"), NUMBERS)
def test_a_signal_saves_and_says_how_to_go_on(tmp_path, number, code):
    path = tmp_path / "run"
    arguments = "train neuroevolution sequence-classification --depth 2 --min-gap 1 --max-gap 2"
    arguments += " --population-size 10 --episodes 4 --test-episodes 6 --network.hidden 3"
    arguments += f" --generations 1000000 --tensorboard False --path {path}"
    process = subprocess.Popen(
        [sys.executable, "-m", "credo", *arguments.split()],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        give_up = time.monotonic() + 120
        while not (path / "metrics.csv").exists() and process.poll() is None:
            assert time.monotonic() < give_up
            time.sleep(0.01)
        process.send_signal(number)
        output, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == code, output
    told = re.search(
        r"credo: stopped at generation (\d+) of 1000000 and saved; go on with "
        rf"`credo resume {path}`",
        output,
    )
    assert told
    assert "Traceback" not in output
    assert int(checkpoints(path)[-1].name) == int(told[1]) >= 1
    resume(path, callbacks=until(int(told[1]) + 5))
    end = int(loop.Run(path).metrics["generation"][-1])
    assert end >= int(told[1]) + 5
    alone = tmp_path / "alone"
    train(alone, generations=end)
    assert results(path) == results(alone)


def test_a_policy_plays_numpy_observations_like_a_rollout(straight):
    run = loop.Run(straight)
    inputs = np.array([[1.0], [0.0], [-1.0], [0.0], [0.0]], np.float32)
    actions, _ = read(run.champion, jnp.asarray(inputs))
    policy = run.policy()
    for _ in range(2):  # and the same after a reset
        policy.reset()
        played = [policy(observation) for observation in inputs]
        assert all(isinstance(a, np.ndarray) and a.dtype == np.float32 for a in played)
        np.testing.assert_allclose(played, actions, rtol=1e-5, atol=1e-6)
    assert not np.allclose(policy(inputs[0]), played[0])  # without one it remembers
    assert np.abs(played).max() <= 1.0


def test_a_policy_takes_what_gymnasium_gives(straight):
    policy = loop.Run(straight).policy()
    once = policy(np.array([1.0]))  # float64
    policy.reset()
    np.testing.assert_array_equal(policy([1]), once)


def test_nothing_compiles_once_the_loop_runs(tmp_path):
    events, at = [], {}

    def listen(event, duration, **_):
        if event == BACKEND_COMPILE:
            events.append(event)

    # Another budget and seed of the same algorithm are data too.
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        jax.jit(lambda x: x + 3.25)(jnp.float32(1.0))
        seen = len(events)
        train(
            tmp_path / "run",
            generations=200,
            seed=5,
            checkpoint_every=0.0,
            callbacks=(lambda run, g, _: at.setdefault(g, len(events)) and None,),
        )
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert seen > 0  # the count sees a compilation
    assert at[200] - at[3] == 0


def test_a_run_without_a_path_gets_a_free_name(straight, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = [train(None, generations=1, seed=7).path for _ in range(2)]
    assert [str(name) for name in names] == [
        "runs/neuroevolution-sequenceclassification-7",
        "runs/neuroevolution-sequenceclassification-7-2",
    ]


def test_a_run_moves_with_its_folder(straight, tmp_path):
    shutil.copytree(straight, tmp_path / "moved")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        resume(tmp_path / "moved", generations=BUDGET)
    assert contents(tmp_path / "moved") == contents(straight)


def test_what_a_killed_start_left_behind_is_replaced(tmp_path):
    run = tmp_path / "run"
    checkpoint.save(run / "checkpoints", 0, jnp.ones(3), {"frames": 0})
    (run / "checkpoints" / ".00000000.partial-1").mkdir()
    (run / "lock").write_text("")
    (run / ".config.json.draft.json").write_text("{")
    fresh = train(run, generations=2)
    assert fresh.metrics["generation"].tolist() == [1, 2]


def test_a_run_may_lie_in_a_folder_that_is_called_checkpoints(tmp_path):
    path = tmp_path / "checkpoints"
    assert train(path, generations=1).metrics["generation"].tolist() == [1]
    assert resume(path, generations=2).metrics["generation"].tolist() == [1, 2]


def tree(path) -> dict[str, bytes | None]:
    """Every file and folder in a folder, with what is in it."""
    return {
        str(p.relative_to(path)): p.read_bytes() if p.is_file() else None for p in path.rglob("*")
    }


@pytest.mark.parametrize(
    "name", ["checkpoints/model.pt", "metrics.csv", "checkpoints/00000007/COMMIT", "notes.txt"]
)
@pytest.mark.parametrize("source", [None, "nowhere"])
def test_a_folder_of_somebody_else_stays_as_it_is(tmp_path, name, source):
    (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
    (tmp_path / name).write_text("mine")
    before = tree(tmp_path)
    with pytest.raises(loop.RunError, match=r"is not empty and no run|nowhere is not a run"):
        train(tmp_path, generations=1, warm_start=source)
    assert tree(tmp_path) == before


def test_a_start_that_fails_leaves_an_empty_folder_empty(straight, tmp_path):
    with pytest.raises(loop.RunError, match="cannot start from another run's"):
        train(tmp_path, generations=1, warm_start=straight)
    assert tree(tmp_path) == {}


def test_a_run_with_a_mutation_of_a_script_can_be_reopened(tmp_path):
    """`python script.py` records its classes under the file's name, not as `__main__`."""
    (tmp_path / "my_script.py").write_text(
        "import credo, jax\n"
        "from credo import tree\n"
        "class Nudge(credo.AbstractMutation):\n"
        "    def __call__(self, genome, *, key):\n"
        "        w, unravel, _ = tree.ravel(genome)\n"
        "        return unravel(w + jax.random.normal(key, w.shape))\n"
        "if __name__ == '__main__':\n"
        "    task = credo.SequenceClassification(depth=2, min_gap=1, max_gap=1)\n"
        "    breeder = credo.Breeder(mutation=Nudge())\n"
        "    algorithm = credo.Neuroevolution(task, credo.MMU(hidden=2), population_size=4,\n"
        "                                     breeder=breeder)\n"
        "    credo.train(algorithm, generations=1, path='run', progress=False)\n"
    )
    done = subprocess.run(
        [sys.executable, "my_script.py"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    done = subprocess.run(
        [sys.executable, "-m", "credo", "evaluate", "run", "--episodes", "2"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "2 fresh episodes" in done.stdout
