"""The site builds without a warning, names every public name, and what it says of data is so."""

import fcntl
import importlib.util
import os
import pathlib
import re
import subprocess
import sys
import types
import zlib

import pytest

import credo
from credo.experiments.catalogue import EXPERIMENTS

ROOT = pathlib.Path(__file__).resolve().parents[2]
PAGES = [
    path
    for path in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    if "generated" not in path.parts
]
LINK = re.compile(r"\]\(([^)#:\s]+)(?:#[^)\s]*)?\)|<img src=\"([^\":]+)\"")
PATH = re.compile(r"`((?:docs|examples|src|tests|results)/[\w./-]+)`")


def loaded(path: str):
    """A Python file of this repository that no package holds, as a module."""
    spec = importlib.util.spec_from_file_location(pathlib.Path(path).stem, ROOT / path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site: one for all processes of pytest, since pages are generated beside their
    source."""
    pytest.importorskip("sphinx", reason="sphinx is of the extra docs")
    base = tmp_path_factory.getbasetemp()
    target = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "site"
    target.mkdir(exist_ok=True)
    with (target / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (target / "built").exists():
            build(target)
            (target / "built").touch()
    return target / "html"


def build(target):
    """Build the site into a folder."""
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    built = subprocess.run(
        [*command, "-d", str(target / "doctrees"), str(ROOT / "docs"), str(target / "html")],
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr


@pytest.mark.slow
def test_every_public_name_is_in_the_reference(site):
    lines = (site / "objects.inv").read_bytes().split(b"\n", 4)[4]
    known = {line.split()[0] for line in zlib.decompress(lines).decode().splitlines()}
    assert {f"credo.{name}" for name in credo.__all__} <= known


@pytest.mark.slow
def test_docstrings_are_rendered_as_markdown(site):
    page = (site / "generated" / "reference" / "evolution.html").read_text("utf-8")
    assert "<strong>Fields:</strong>" in page
    assert '<span class="pre">probability</span>' in page
    assert "**Arguments:**" not in page


@pytest.mark.slow
def test_the_site_and_its_search_need_no_network(site):
    assert (site / "searchindex.js").stat().st_size > 10_000
    for page in site.rglob("*.html"):
        text = page.read_text("utf-8")
        assert not re.findall(r'<(?:script|img|iframe)[^>]* src="(?:https?:)?//', text), page
        assert not re.findall(r'<link rel="(?:stylesheet|preload)[^>]* href="https?:', text), page


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_to_files(page):
    text = page.read_text("utf-8")
    for link in {target or source for target, source in LINK.findall(text)}:
        if not link.startswith(("generated/", "../generated/")):
            assert (page.parent / link).exists(), f"{page.relative_to(ROOT)}: {link}"
    for path in PATH.findall(text):
        assert (ROOT / path).exists(), f"{page.relative_to(ROOT)}: {path}"


def test_the_table_of_results_says_what_is_committed():
    committed = loaded("docs/extensions/committed.py")
    assert committed.BLOCK.read() == committed.table()


def test_the_tables_of_hybrids_say_what_is_committed():
    for block, make in loaded("docs/extensions/hybrids.py").BLOCKS.items():
        assert block.read() == make()


def test_readme_says_how_many_experiments_have_no_data():
    empty = [name for name in EXPERIMENTS if not any((ROOT / "results").glob(f"{name}/*/*.json"))]
    said = re.search(r"(\d+) of (\d+)\s+experiments have no data", README)
    assert said is not None
    assert (int(said[1]), int(said[2])) == (len(empty), len(EXPERIMENTS))


README = (ROOT / "README.md").read_text("utf-8")


def test_readme_is_a_first_page():
    assert len(README.split()) <= 600  # as `wc -w` counts
    assert len(re.findall(r"^\|[-|]+\|$", README, re.MULTILINE)) <= 2  # tables


def test_readme_on_a_package_page_has_no_link_that_leads_nowhere(monkeypatch):
    name = "hatchling.metadata.plugin.interface"  # needed to build, not to test
    monkeypatch.setitem(sys.modules, name, types.SimpleNamespace(MetadataHookInterface=object))
    packaged = loaded("hatch_build.py").packaged
    assert not [x for x in LINK.findall(packaged(README, "")) if any(x)]
    home = packaged(README, "https://example.org/credo")
    assert not [x for x in LINK.findall(home) if any(x)]
    assert "](https://example.org/credo/blob/main/docs/index.md)" in home
    assert 'src="https://example.org/credo/raw/main/docs/media/rover.gif"' in home


WORDS = {  # what Credo does not say, and what it says
    r"nobody can pass": "upper bound",
    r"\bsomebody\b": "a user, others",
    r"\bnobody\b": "no agent, no member",
    r"\bwhat it earns\b": "return",
    r"\bceilings?\b": "upper bound",
    r"\bfloors?\b": "baseline",
}


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_speak_the_fields_words(page):
    text = re.sub(r"```.*?```|`[^`]*`", "", page.read_text("utf-8"), flags=re.DOTALL)
    found = [
        f"{word!r}: say {better}"
        for word, better in WORDS.items()
        if page.name != "CHANGELOG.md" and re.search(word, text, re.IGNORECASE)
    ]
    assert not found


def test_code_names_pages_that_exist():
    for path in [*(ROOT / "src").rglob("*.py"), *(ROOT / "tests").rglob("*.py")]:
        for page in re.findall(r"\bdocs/[\w/-]+\.md", path.read_text("utf-8")):
            assert (ROOT / page).exists(), f"{path.relative_to(ROOT)}: {page}"
