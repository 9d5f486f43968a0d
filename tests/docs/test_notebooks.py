"""The notebooks run from top to bottom."""

import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))
EXECUTE = """
import sys, nbclient, nbformat
notebook = nbformat.read(sys.argv[1], 4)
nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
print(sum(len(cell.get("outputs", ())) for cell in notebook.cells))
"""


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_something(path, tmp_path):
    pytest.importorskip("nbclient", reason="nbclient is of the extra dev")
    pytest.importorskip("ipykernel", reason="ipykernel is of the extra dev")
    command = [sys.executable, "-c", EXECUTE, str(path)]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr[-3000:]
    assert int(ran.stdout) >= 4


def test_there_are_notebooks_and_they_are_stored_without_outputs():
    assert [path.stem for path in NOTEBOOKS] == ["hybrid_team", "memory", "own_task"]
    assert not any('"output_type"' in path.read_text("utf-8") for path in NOTEBOOKS)
