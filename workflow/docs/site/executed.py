"""Run the code of the pages in `executed_pages` of conf.py, and insert the pictures that it draws below the code.

Blocks of Python run one after another in the root of the repository and share their names. tests/project/test_docs.py
compares their output with the blocks of text below them.
"""

import contextlib
import io
import os
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

ROOT = Path(__file__).parents[3]


class Pictures(SphinxTransform):
    """Runs a page's code and adds the figures that are open after a block."""

    # Before Sphinx collects the images of a page.
    default_priority = 200

    def apply(self, **kwargs) -> None:
        """Run the blocks of one page."""
        if self.env.docname not in self.config.executed_pages:
            return
        import matplotlib

        matplotlib.use("agg")
        from matplotlib import pyplot

        names: dict = {}
        folder = Path(self.app.doctreedir) / "pictures"
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.chdir(ROOT), contextlib.redirect_stdout(io.StringIO()):
            blocks = [node for node in self.document.findall(nodes.literal_block) if node.get("language") == "python"]
            for number, block in enumerate(blocks):
                exec(compile(block.astext(), f"{self.env.docname}.md", "exec"), names)
                for figure in map(pyplot.figure, pyplot.get_fignums()):
                    path = folder / f"{self.env.docname}-{number}-{figure.number}.svg"
                    figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
                    uri = "/" + os.path.relpath(path, self.env.srcdir)
                    last = output_of(block) or block
                    picture = nodes.image("", uri=uri, alt="What the code above draws", classes=["drawn"])
                    last.parent.insert(last.parent.index(last) + 1, picture)
                pyplot.close("all")


def output_of(block: nodes.literal_block) -> nodes.literal_block | None:
    """Return the block of text after a block of code, which shows its output; None if there is none."""
    after = block.next_node(descend=False, siblings=True)
    return after if isinstance(after, nodes.literal_block) and after.get("language") == "text" else None


def setup(app: Sphinx) -> dict:
    """Register with Sphinx."""
    app.add_config_value("executed_pages", [], "env")
    app.add_transform(Pictures)
    return {"version": "1", "parallel_read_safe": False}
