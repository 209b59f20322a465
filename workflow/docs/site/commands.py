"""The directive `commands`: every subcommand's help, as the command line prints it."""

import io
from contextlib import redirect_stdout, suppress

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from spotcheck import cli


class Commands(SphinxDirective):
    """A section for each group of subcommands, and one in it for each of them."""

    def run(self) -> list[nodes.Node]:
        """Ask each subcommand for its help."""
        found: list[nodes.Node] = []
        for title, names in cli.GROUPS.items():
            group = self.section(f"{title[0].upper()}{title[1:]}")
            for name in names:
                own = self.section(f"spotcheck {name}")
                own += nodes.literal_block(text := help_of(name), text, language="none")
                group += own
            found.append(group)
        return found

    def section(self, title: str) -> nodes.section:
        """An empty section."""
        out = nodes.section(names=[nodes.fully_normalize_name(title)])
        out += nodes.title(title, title)
        self.state.document.note_implicit_target(out, out)
        return out


def help_of(name: str) -> str:
    """What `spotcheck NAME --help` prints."""
    said = io.StringIO()
    with redirect_stdout(said), suppress(SystemExit):
        cli.parse([name, "--help"])
    return said.getvalue()


def setup(app: Sphinx) -> dict:
    """Register with Sphinx."""
    app.add_directive("commands", Commands)
    return {"version": "1", "parallel_read_safe": True}
