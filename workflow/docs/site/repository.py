"""Links to files and folders of the repository lead to pages that show them."""

import ast
import html
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform
from sphinx.util.osutil import relative_uri

ROOT = Path(__file__).parents[3]
LEXERS = {".py": "python", ".smk": "python", ".yaml": "yaml", ".js": "javascript", ".css": "css", ".html": "html+jinja"}
LEXERS |= {".csv": "none", ".txt": "none", ".toml": "toml", ".cff": "yaml", "": "none"}
# Pages that lie elsewhere in the repository, and those that include them.
INCLUDED = {"README": "index", "CHANGELOG": "changelog", "config/README": "configuration"}
INCLUDED |= {"workflow/rig/README": "virtual-rig"}


def page_of(path: Path) -> str:
    """Name of the page that shows a file or a folder."""
    return f"files/{path.relative_to(ROOT).as_posix()}"


class Links(SphinxTransform):
    """Turns links that lead out of the pages' folder into links to pages, and notes what they lead to."""

    # Before Sphinx collects headings, which may hold links.
    default_priority = 200

    def apply(self, **kwargs) -> None:
        """Look at the links of one page."""
        for link in [
            *self.document.findall(addnodes.download_reference),
            *self.document.findall(addnodes.pending_xref),
        ]:
            target = Path(self.env.relfn2path(str(link["reftarget"]))[1])
            if link.get("refdomain") == "doc":
                link["reftarget"] = INCLUDED.get(str(link["reftarget"]).removeprefix(f"{ROOT}/"), link["reftarget"])
            elif target.is_dir() or (isinstance(link, addnodes.download_reference) and target.suffix in LEXERS):
                noted(self.app).add(target)
                uri = relative_uri(self.app.builder.get_target_uri(self.env.docname), f"{page_of(target)}.html")
                link.replace_self(nodes.reference("", "", *link.children, internal=True, refuri=uri))


def noted(app: Sphinx) -> set[Path]:
    """Files and folders that some page links to; kept with the pages that were read before."""
    if not hasattr(app.env, "repository_links"):
        app.env.repository_links = set()
    return app.env.repository_links


def pages(app: Sphinx) -> Iterator[tuple[str, dict, str]]:
    """A page for each file, and for each folder with the files in it."""
    folders = {path: files_in(path) for path in noted(app) if path.is_dir()}
    files = {path for path in noted(app) if path.is_file()}.union(*folders.values())
    for path in sorted(files):
        code = app.builder.highlighter.highlight_block(path.read_text(encoding="utf-8"), LEXERS[path.suffix])
        yield page_of(path), context(path, code), "page.html"
    for path, inside in sorted(folders.items()):
        start = app.builder.get_target_uri(page_of(path))
        rows = [
            f'<li><a href="{relative_uri(start, page_of(own) + ".html")}">{own.name}</a> {html.escape(sentence(own))}'
            for own in inside
        ]
        yield page_of(path), context(path, f"<ul>{''.join(rows)}</ul>"), "page.html"


def files_in(folder: Path) -> list[Path]:
    """Files of a folder that a page can show."""
    return sorted(path for path in folder.iterdir() if path.is_file() and path.suffix in LEXERS)


def sentence(path: Path) -> str:
    """The first line of a module's docstring."""
    told = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) if path.suffix == ".py" else None
    return (told or "").split("\n")[0]


def context(path: Path, body: str) -> dict:
    """What the theme's page needs."""
    name = PurePosixPath(path.relative_to(ROOT))
    return {"title": str(name), "body": f"<h1>{name}</h1>{body}", "parents": []}


def setup(app: Sphinx) -> dict:
    """Register with Sphinx."""
    app.add_transform(Links)
    app.connect("html-collect-pages", pages)
    return {"version": "1", "parallel_read_safe": False}
