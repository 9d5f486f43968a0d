"""A policy with its card, for a hub of models: one file that NumPy plays, and what it scored.

    python examples/publish_policy.py runs/demo build/demo
    pip install huggingface-hub
    hf auth login
    python examples/publish_policy.py runs/demo build/demo --upload NAME/credo-demo

Without --upload nothing leaves this machine: the folder has the policy and its card to be read
first. The score is that of `credo evaluate`, on fresh episodes, and the card says how many.
"""

import argparse
import hashlib
import pathlib
import subprocess
import sys

import credo

FILES = ["README.md", "policy.safetensors"]
CARD = """---
library_name: credo
license: {license}
tags: [reinforcement-learning, credo, {task}]
---
# {name}: {algorithm} on {task}

A policy trained with Credo {version}. Its file has the network and the spaces of the task; nothing
in it is executed.

```
{score}
```

```python
from credo.runner import Runner
from huggingface_hub import hf_hub_download

policy = Runner.load(hf_hub_download("{upload}", "policy.safetensors"))
policy.reset()  # at the start of every episode
action = policy(observation)
```

SHA-256 of policy.safetensors: `{digest}`
"""


def prepare(run: pathlib.Path, folder: pathlib.Path, license: str, upload: str) -> None:
    """Write a run's champion and its card, README.md, into a folder that has nothing else."""
    folder.mkdir(parents=True, exist_ok=True)
    if others := [path.name for path in folder.iterdir() if path.name not in FILES]:
        raise SystemExit(f"{folder} has other files, such as {others[0]}: name a folder of its own")
    loaded, policy = credo.Run(run), folder / "policy.safetensors"
    credo.export(loaded, policy)
    told = credo.Runner.load(policy).description
    command = [sys.executable, "-m", "credo", "evaluate", str(run)]
    score = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    card = CARD.format(
        name=run.name,
        algorithm=type(loaded.algorithm).__name__,
        task=told["task"],
        version=told["credo"],
        score=score.strip().replace(str(run), run.name),
        upload=upload,
        license=license,
        digest=hashlib.sha256(policy.read_bytes()).hexdigest(),
    )
    (folder / "README.md").write_text(card, "utf-8")
    print(f"{policy} and its card: {folder / 'README.md'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=pathlib.Path)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--license", default="apache-2.0")
    parser.add_argument("--upload", metavar="OWNER/NAME")
    parser.add_argument("--public", action="store_true", help="everybody may see what is uploaded")
    args = parser.parse_args()
    prepare(args.run, args.folder, args.license, args.upload or "OWNER/NAME")
    if args.upload:
        from huggingface_hub import HfApi

        hub = HfApi()
        hub.create_repo(args.upload, exist_ok=True, private=not args.public)
        print(hub.upload_folder(repo_id=args.upload, folder_path=args.folder, allow_patterns=FILES))
