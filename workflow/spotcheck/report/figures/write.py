"""Write every figure that the results support, and index.json with captions and reasons."""

import json
from pathlib import Path

from spotcheck.io import progress, store
from spotcheck.report.figures import every_figure, style
from spotcheck.report.figures.entry import Entry
from spotcheck.report.figures.results import Results, Unavailable


def write_all(results: Results, folder: Path, entries: tuple[Entry, ...] | None = None) -> dict[str, list]:
    """Draw figures and write them as SVG and PNG, with index.json.

    Parameters
    ----------
    results : Results
        Results of a dataset.
    folder : Path
        Folder to write to. Earlier files of figures that can no longer be drawn are removed from it.
    entries : tuple of Entry, optional
        Entries of the figures to draw; by default all.

    Returns
    -------
    dict of str to list
        Content of index.json. `figures` has name, title, caption, category and figure of the paper of each figure that
        was drawn. `skipped` has name, title and reason (`why`) of each figure that the results do not support.
    """
    drawn: list[dict[str, str | None]] = []
    skipped: list[dict[str, str | None]] = []
    for entry in progress.track(every_figure() if entries is None else entries, "drawing figures"):
        record: dict[str, str | None] = {"name": entry.name, "title": entry.title}
        try:
            for name in entry.needs:
                results.get(name)
            with style.house_style():
                drawing = entry.draw(results)
                style.save_drawing(drawing, folder, entry.name)
        except Unavailable as reason:
            skipped.append(record | {"why": str(reason)})
            for suffix in style.FORMATS:
                (folder / f"{entry.name}.{suffix}").unlink(missing_ok=True)
        else:
            drawn.append(record | {"caption": drawing.caption, "category": entry.category.value, "paper": entry.paper})
    index = {"figures": drawn, "skipped": skipped}
    store.write_text(folder / "index.json", json.dumps(index, indent=1, ensure_ascii=False) + "\n")
    return index
