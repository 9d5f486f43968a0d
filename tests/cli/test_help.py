"""Help: one screen of what people use, and behind it every field with what it means."""

import re

import pytest

from credo.cli import completion, main, names, train
from credo.cli.line import Line


def shown(capsys, *words: str) -> str:
    with pytest.raises(SystemExit) as end:
        main(list(words))
    assert end.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("algorithm", list(names.ALGORITHMS))
def test_the_first_screen_is_one_screen(capsys, algorithm):
    lines = shown(capsys, "train", algorithm, "--help").splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 100
    known = {line.split()[0] for line in lines if line.startswith("  --")}
    assert {"--seed", "--seeds", "--path", "--frames"} <= known
    assert ("--network" in known) == (algorithm != "neat")  # which makes its own
    assert ("--preset" in known) == ("presets" in names.ALGORITHMS[algorithm])
    if algorithm in ("erl", "cerl", "td3", "sac", "merl", "ppo"):
        assert {"--gamma", "--learning-rate", "--hidden", "--batch-size"} <= known
    assert lines[-1].startswith("--help-all lists every field")


def test_every_field_is_listed_by_the_object_that_it_is_of(capsys):
    out = shown(capsys, "train", "cerl", "--help-all")
    assert "abstract" not in out.lower()
    for title in ("learners.0", "learners.3.critic", "manager"):
        assert f"\n{title}\n" in out
    for flag in ("--learners.2.gamma", "--manager", "--gamma", "--checkpoint-every", "--learners"):
        assert f"\n  {flag} " in out
    assert "(ucb, uniform, thompson, progress, none) [ucb]" in " ".join(out.split())


def test_a_short_name_shows_the_defaults_of_all_its_fields(capsys):
    out = " ".join(shown(capsys, "train", "erl", "--help").split())
    assert "of actors and critics alike, above 0 [actor-lr 5e-05, critic-lr 0.0005]" in out
    out = " ".join(shown(capsys, "train", "cerl", "--help-all").split())
    assert "of actors and critics alike, above 0 [0.0003]" in out
    assert "in [0, 1] [0.9 or 0.99 or 0.997 or 0.9995] --learning-rate" in out


def test_without_a_task_none_of_its_flags_is_shown(capsys):
    told = "Flags of a task are shown with it: credo train td3 TASK --help-all."
    out = shown(capsys, "train", "td3", "--help-all")
    assert told in " ".join(out.split())
    assert "\nenv" not in out
    out = shown(capsys, "train", "neuroevolution", "sequence-recall", "--help-all")
    assert "Flags of a task are shown" not in out
    assert "\nenv\n" in out


def offered(algorithm: str) -> dict[str, str]:
    """Every flag of an algorithm and its text."""
    entry = names.ALGORITHMS[algorithm]
    line = Line("train", [algorithm, "x", "--help-all"])
    command = line.command(train.Train)
    command.task = ""
    train._algorithm(line, command)
    assert entry["text"]
    return {flag.name: flag.text for flag in line.flags.values()}


@pytest.mark.parametrize("algorithm", list(names.ALGORITHMS))
def test_every_flag_has_a_text(algorithm):
    texts = offered(algorithm)
    assert len(texts) > 30
    assert [name for name, text in texts.items() if not re.search(r"\w{3}", text)] == []


@pytest.mark.parametrize("word", list(names.TASKS))
def test_every_field_of_a_task_has_a_text(word):
    line = Line("check", [])
    line.take(names.load(names.TASKS[word]["path"])(), "env.")
    assert [flag.name for flag in line.flags.values() if len(flag.text) < 8] == []


@pytest.mark.parametrize("word", list(names.NETWORKS))
def test_every_field_of_a_network_has_a_text(word):
    entry = names.NETWORKS[word]
    line = Line("train", [])
    line.take(names.load(entry["path"])(**entry.get("fields", {})), "network.")
    assert len(line.flags) >= 1
    assert [flag.name for flag in line.flags.values() if len(flag.text) < 8] == []


def test_every_member_of_a_family_can_be_made():
    for family in names.CATALOGUE["families"].values():
        for path in family.values():
            assert names.load(path)() is not None


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("", "train resume"),
        ("train", "neuroevolution neat erl"),
        ("train td3", "sequence-classification"),
        ("train td3 x --network", "mmu rnn"),
        ("train td3 x", "--gamma"),
        ("watch", "--episodes --seed"),
        ("reproduce", "fig-3.4a"),
        ("nothing", ""),
    ],
)
def test_what_can_come_next(words, expected):
    assert expected in completion.next(words.split())


def test_scripts_for_shells(capsys):
    for shell in ("bash", "zsh"):
        main(["--print-completion", shell])
        assert "complete -o default -F _credo credo" in capsys.readouterr().out
