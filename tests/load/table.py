"""The page of what the workflow bears, from the rows that the programmes left: `python -m tests.load.table` writes
workflow/docs/load.md."""

from tests.load.rows import ROOT, read
from tests.validation.table import markdown

PAGE = ROOT / "workflow" / "docs" / "load.md"
# Programmes in the order of the page: title, the target that runs it, and how its lines are read.
PROGRAMMES = {
    "kills": ("Kills", "make load-kills", ""),
    "hostile": ("Hostile input", "make load-hostile", ""),
    "scale": (
        "Many frames, many datasets",
        "make load-scale",
        "Wall-clock time; how far the last lies off the straight line through those before, by processor time; memory"
        " at its peak.",
    ),
    "rules": (
        "What each rule needs",
        "make load-rules",
        "Memory at its peak and wall-clock time, each of what the rule asks a cluster for; both double where a job"
        " is run again.",
    ),
    "slurm": ("A cluster", "make test-slurm", ""),
}


def page() -> str:
    """The page in Markdown."""
    lines = ["# What the workflow bears", "", "Each line was tried on two cores; its target tries it again.", ""]
    for programme, (title, target, note) in PROGRAMMES.items():
        if rows := read(programme):
            cells = [(row.what, f"{row.tries:,}", row.happened) for row in rows]
            lines += [f"## {title}", "", f"    {target}", "", *([note, ""] if note else [])]
            lines += [*markdown(("what", "tries", "what happened"), cells), ""]
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"wrote {PAGE.relative_to(ROOT)}")
