"""The directive `commands`: every subcommand's help, as the command line prints it."""

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from spotcheck import cli


class Commands(SphinxDirective):
    """A section for each subcommand."""

    def run(self) -> list[nodes.Node]:
        """Ask each subcommand for its help."""
        found: list[nodes.Node] = []
        for name in cli.COMMANDS:
            section = nodes.section(ids=[f"spotcheck-{name}"], names=[f"spotcheck {name}"])
            section += nodes.title("", f"spotcheck {name}")
            section += nodes.literal_block("", cli.parser_of(name).format_help(), language="none")
            found.append(section)
        return found


def setup(app: Sphinx) -> dict:
    """Register with Sphinx."""
    app.add_directive("commands", Commands)
    return {"version": "1", "parallel_read_safe": True}
