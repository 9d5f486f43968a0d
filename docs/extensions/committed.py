"""The table of `docs/results/index.md`: what is committed of every experiment.

python docs/extensions/committed.py      # writes it anew, after results were added
"""

import json
import pathlib

from blocks import Block

from credo.experiments.catalogue import EXPERIMENTS

ROOT = pathlib.Path(__file__).resolve().parents[2]
BLOCK = Block.of(ROOT / "docs" / "results" / "index.md", "table", "docs/extensions/committed.py")


def table() -> str:
    """A row for each experiment and budget, and one for each experiment without data."""
    lines = [
        "| experiment | what it shows | budget | cells | seeds per cell | files |",
        "|---|---|---|---|---|---|",
    ]
    for name, title in EXPERIMENTS.items():
        found = sorted((ROOT / "results" / name).glob("*/results.json"))
        if not found:
            lines.append(f"| {name} | {title} | **no data** | | | |")
        lines += [row(name, title, path) for path in found]
    return "\n".join(lines) + "\n"


def row(name: str, title: str, path: pathlib.Path) -> str:
    """What one `results.json` holds."""
    record = json.loads(path.read_text("utf-8"))
    cells = record["cells"]
    seeds = sorted({len(cell["seeds"]) for cell in cells})
    runs = str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
    whole = any("--only" not in command for command in record["command"].split("&&"))
    part = str(len(cells)) if whole else f"{len(cells)}, a part"
    link = f"[data](../../{path.relative_to(ROOT).as_posix()})"
    return f"| {name} | {title} | {path.parent.name} | {part} | {runs} | {link} |"


if __name__ == "__main__":
    BLOCK.write(table())
