"""Write every figure that the results support, and index.json.

index.json has the caption of each figure that was drawn, and the reason for each figure that the results do not
support. An entry is the record of a figure: name, title, required results and drawing function.
"""

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
        Results folder of a dataset.
    folder : Path
        Folder to write to. Files that an earlier run wrote are removed if their figure can no longer be drawn.
    entries : tuple of Entry, optional
        Figures to draw; by default all.

    Returns
    -------
    dict of str to list
        Content of index.json, two lists of dictionaries. `figures` has `name`, `title`, `caption`, `category` and
        `paper` of each drawn figure; `paper` is the corresponding figure of the paper ("Fig. 7") or None. `skipped` has
        `name`, `title` and the reason `why` of each figure that the results do not support.
    """
    index: dict[str, list] = {"figures": [], "skipped": []}
    for entry in progress.track(every_figure() if entries is None else entries, "drawing figures"):
        record: dict[str, str | None] = {"name": entry.name, "title": entry.title}
        try:
            # Raises `Unavailable` if a required result is missing.
            for name in entry.needs:
                results.get(name)
            with style.house_style():
                drawing = entry.draw(results)
                style.save_drawing(drawing, folder, entry.name)
        except Unavailable as reason:
            index["skipped"].append(record | {"why": str(reason)})
            for suffix in style.FORMATS:
                (folder / f"{entry.name}.{suffix}").unlink(missing_ok=True)
        else:
            caption = drawing.caption + results.paper_note(entry.name)
            described = {"caption": caption, "category": entry.category.value, "paper": entry.paper}
            index["figures"].append(record | described)
    store.write_text(folder / "index.json", json.dumps(index, indent=1, ensure_ascii=False) + "\n")
    return index
