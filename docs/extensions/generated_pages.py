"""Pages that are made when the site is built: the reference, by the names that `credo` exports, and
the pages of experiments, which `credo reproduce` wrote beside their data."""

import importlib
import pathlib
import shutil

GROUPS = {
    "algorithms": ("Algorithms", "One file each; every field is a setting, and a flag."),
    "environments": ("Tasks", "What has a reward, and adapters for the tasks of others."),
    "networks": ("Networks and exploration", "What has weights."),
    "learners": ("Learners", "What needs a gradient, and resource managers for several of them."),
    "evolution": ("Evolution", "What changes or picks genomes without a gradient."),
    "runs": ("Runs", "Training, resuming and reading what is on disk."),
    "rollout": ("Playing episodes", "How a policy meets a task, and the records of that."),
}
MORE = [  # documented beside the names that `credo` exports, where they exist
    "credo.rollout.collect",
    "credo.rollout.record",
    "credo.rollout.Experience",
    "credo.types.Trace",
    "credo.types.Transition",
    "credo.types.Evaluation",
    "credo.environments.viewer.Viewer",
    "credo.environments.viewer.Mark",
]
HOMES = {"types": "rollout", "runner": "runs", "report": "runs"}  # modules without a page


def setup(app):
    app.connect("builder-inited", generate)
    app.connect("build-finished", copy_pictures)
    return {"parallel_read_safe": True}


def generate(app) -> None:
    """Write `docs/generated` anew."""
    target = pathlib.Path(app.srcdir) / "generated"
    shutil.rmtree(target, ignore_errors=True)
    for group, names in grouped().items():
        write(target / "reference" / f"{group}.md", reference(group, names))
    write(target / "reference" / "index.md", contents("Python reference", GROUPS))
    pages = copied(pathlib.Path(app.srcdir).parent / "results", target / "results")
    write(target / "results" / "index.md", contents("Experiments, page by page", pages))


def copy_pictures(app, error) -> None:
    """Pages of experiments name their pictures in HTML, where Sphinx does not see them."""
    source = pathlib.Path(app.srcdir)
    for picture in (source / "generated" / "results").rglob("*.svg"):
        target = pathlib.Path(app.outdir) / picture.relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(picture, target)


def grouped() -> dict[str, list[tuple[str, object]]]:
    """Public names by the package they come from."""
    credo = importlib.import_module("credo")
    found = {f"credo.{name}": getattr(credo, name) for name in credo.__all__}
    for name in MORE:
        module, _, attribute = name.rpartition(".")
        try:
            found.setdefault(name, getattr(importlib.import_module(module), attribute))
        except (ImportError, AttributeError):
            continue
    groups = {group: {} for group in GROUPS}
    for name, value in found.items():
        package = value.__module__.split(".")[1]
        groups[HOMES.get(package, package)].setdefault(id(value), (name, value))
    return {group: sorted(names.values(), key=lambda x: x[0]) for group, names in groups.items()}


def reference(group: str, names: list[tuple[str, object]]) -> str:
    """The page of a package."""
    title, lead = GROUPS[group]
    parts = [f"# {title}", lead]
    for name, value in names:
        kind = "class" if isinstance(value, type) else "function"
        members = "\n   :members:\n   :special-members: __call__" if kind == "class" else ""
        parts.append(f"```{{eval-rst}}\n.. auto{kind}:: {name}{members}\n```")
    return "\n\n".join(parts) + "\n"


def copied(source: pathlib.Path, target: pathlib.Path) -> list[str]:
    """Copy the pages of experiments and what they show."""
    pages = sorted(source.glob("*/*/README.md"))
    for page in pages:
        shutil.copytree(
            page.parent,
            target / page.parent.relative_to(source),
            ignore=shutil.ignore_patterns("report.html"),
        )
    return [str(page.relative_to(source).with_suffix("")) for page in pages]


def contents(title: str, pages) -> str:
    """A page that lists others."""
    listed = "\n".join(pages)
    return f"# {title}\n\n```{{toctree}}\n:maxdepth: 1\n\n{listed}\n```\n"


def write(path: pathlib.Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, "utf-8")
