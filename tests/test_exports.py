"""What `import credo` offers is there, typed, and imported only when it is used."""

import pathlib
import subprocess
import sys

import credo


def test_every_name_is_there_and_its_own():
    assert {"train", "Run", "RunOptions", "Callback"} <= set(credo.__all__)
    for name in credo.__all__:
        assert getattr(credo, name).__name__ == name
    assert pathlib.Path(credo.__file__).with_name("py.typed").exists()


def test_nothing_is_imported_before_it_is_used():
    script = "import sys, credo; credo.RunOptions(frames=3); print('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr
