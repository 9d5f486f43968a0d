"""Blocks of pages that a program writes between two comments."""

import pathlib
from typing import NamedTuple


class Block(NamedTuple):
    """What stands between two lines of a page."""

    page: pathlib.Path
    begin: str
    end: str

    @classmethod
    def of(cls, page: pathlib.Path, what: str, program: str) -> "Block":
        """Called `what`, with the command that writes it."""
        return cls(page, f"<!-- {what}: python {program} -->\n", f"<!-- end of {what} -->\n")

    def parts(self) -> tuple[str, str, str]:
        """What comes before it, with its first line, the block, and the rest."""
        before, _, rest = self.page.read_text("utf-8").partition(self.begin)
        inside, _, after = rest.partition(self.end)
        return before + self.begin, inside, self.end + after

    def read(self) -> str:
        return self.parts()[1]

    def write(self, text: str) -> None:
        before, _, after = self.parts()
        self.page.write_text(before + text + after, "utf-8")
