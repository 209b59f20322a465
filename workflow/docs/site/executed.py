"""Pages whose code is run by the build; the pictures that it draws stand below it.

A page says so by `executed: true` in its head. Its blocks of Python run one after another, in the repository's root,
and share their names. tests/library/test_docs.py holds what they print to the blocks of text below them.
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
        if not self.env.metadata[self.env.docname].get("executed"):
            return
        import matplotlib

        matplotlib.use("agg")
        from matplotlib import pyplot

        names: dict = {}
        folder = Path(self.app.doctreedir) / "pictures"
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.chdir(ROOT), contextlib.redirect_stdout(io.StringIO()):
            blocks = [own for own in self.document.findall(nodes.literal_block) if own.get("language") == "python"]
            for block in blocks:
                exec(compile(block.astext(), f"{self.env.docname}.md", "exec"), names)
                for number in pyplot.get_fignums():
                    path = folder / f"{self.env.docname}-{number}.svg"
                    figure = pyplot.figure(number)
                    figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
                    uri = "/" + os.path.relpath(path, self.env.srcdir)
                    block.parent.insert(block.parent.index(block) + 1, nodes.image("", uri=uri, classes=["drawn"]))
                pyplot.close("all")


def setup(app: Sphinx) -> dict:
    """Register with Sphinx."""
    app.add_transform(Pictures)
    return {"version": "1", "parallel_read_safe": False}
