"""The page of what the workflow bears, from the rows that the programmes left: `python -m tests.load.table` writes
workflow/docs/load.md."""

from tests.load.rows import ROOT, read
from tests.validation.table import markdown

PAGE = ROOT / "workflow" / "docs" / "load.md"
# Programmes in the order of the page, and the target that runs each.
PROGRAMMES = {
    "kills": ("Kills", "make load-kills"),
    "hostile": ("Hostile input", "make load-hostile"),
    "scale": ("Many frames, many datasets", "make load-scale"),
    "rules": ("What each rule needs", "make load-rules"),
    "slurm": ("A cluster", "make test-slurm"),
}


def page() -> str:
    """The page in Markdown."""
    lines = ["# What the workflow bears", "", "Each line was tried on two cores; its target tries it again.", ""]
    for programme, (title, target) in PROGRAMMES.items():
        if rows := read(programme):
            cells = [(row.what, f"{row.tries:,}", row.happened) for row in rows]
            lines += [f"## {title}", "", f"    {target}", "", *markdown(("what", "tries", "what happened"), cells), ""]
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"wrote {PAGE.relative_to(ROOT)}")
