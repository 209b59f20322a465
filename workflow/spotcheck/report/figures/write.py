"""Draw every figure that the results support, and say in index.json what was drawn and what was not, and why."""

import json
from pathlib import Path

from spotcheck.io import progress, store
from spotcheck.report.figures import every_figure, style
from spotcheck.report.figures.entry import Entry
from spotcheck.report.figures.results import Results, Unavailable


def write_all(results: Results, folder: Path, entries: tuple[Entry, ...] | None = None) -> dict[str, list]:
    """Write `<name>.svg`, `<name>.png` of some figures (by default of all) and index.json into `folder`; return the
    index.

    A figure that an earlier run drew and this one cannot is removed.
    """
    drawn: list[dict[str, str | None]] = []
    skipped: list[dict[str, str | None]] = []
    for entry in progress.track(every_figure() if entries is None else entries, "drawing figures"):
        record: dict[str, str | None] = {"name": entry.name, "title": entry.title}
        try:
            for need in entry.needs:
                results.get(need)
            with style.applied():
                drawing = entry.draw(results)
                style.save(drawing, folder, entry.name)
        except Unavailable as reason:
            skipped.append(record | {"why": str(reason)})
            for kind in style.FORMATS:
                (folder / f"{entry.name}.{kind}").unlink(missing_ok=True)
        else:
            drawn.append(record | {"caption": drawing.caption, "category": entry.category.value, "paper": entry.paper})
    index = {"figures": drawn, "skipped": skipped}
    store.write_text(folder / "index.json", json.dumps(index, indent=1, ensure_ascii=False) + "\n")
    return index
