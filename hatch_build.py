"""The README and the addresses of a built package.

A package page has no files beside it, so relative links would lead nowhere. With `home` set in
pyproject.toml (`[tool.hatch.metadata.hooks.custom]`) they lead there; without it links become plain
text and pictures are left out.
"""

import pathlib
import re

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|#)([^)]+)\)")
PICTURES = re.compile(r"<p [^>]*>\n(?:<img [^>]*>\n)+</p>\n\n(?:\*[^*]+\*\n\n)?")


class CustomMetadataHook(MetadataHookInterface):
    """Called by hatchling when a package is built."""

    def update(self, metadata):
        root = pathlib.Path(self.root)
        home = self.config.get("home", "")
        text = packaged((root / "README.md").read_text("utf-8"), home)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
        if home:
            metadata["urls"] = {"Repository": home, "Changelog": f"{home}/blob/main/CHANGELOG.md"}


def packaged(text: str, home: str) -> str:
    """The README as a package page can show it. `home`: address of the repository, or ""."""
    if not home:
        return LINK.sub(lambda link: "" if link[1] else link[2], PICTURES.sub("", text))
    text = re.sub(r'(<img src=")(?!https?:)', rf"\1{home}/raw/main/", text)
    return LINK.sub(lambda link: f"{link[1]}[{link[2]}]({home}/blob/main/{link[3]})", text)
