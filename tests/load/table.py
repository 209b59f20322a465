"""Write workflow/docs/load.md from the measured rows of the load tests: `python -m tests.load.table`."""

from tests.load.rows import ROOT, read
from tests.validation.table import markdown

PAGE = ROOT / "workflow" / "docs" / "load.md"
# Programmes in the order of the page: title, the target that runs it, and what its rows mean.
PROGRAMMES = {
    "kills": (
        "Interrupted runs",
        "make load-kills",
        "A run gets a signal at a random moment. The same call is then made again, and all values are compared with\n"
        "those of an undisturbed run. The longest time from the signal to the end of the run is in brackets.",
    ),
    "hostile": (
        "Corrupt input files",
        "make load-hostile",
        "Images are valid files with changed bytes; texts are generated. Each input must be read, or refused with one\n"
        "sentence. The longest time of one input comes last.",
    ),
    "scale": (
        "Many frames and datasets",
        "make load-scale",
        "Each row gives wall-clock times; the deviation of the last processor time from a straight line through the\n"
        "first and the last but one; and peak memory, with the increase from the first to the last in brackets.",
    ),
    "rules": (
        "Memory and time of each rule",
        "make load-rules",
        'Each row gives peak memory and wall-clock time, and after "of" what the rule requests from a cluster. The\n'
        "second attempt of a job requests twice as much, the third three times.",
    ),
    "slurm": (
        "Slurm cluster",
        "make test-slurm",
        "Slurm runs on two nodes of one machine. Values are compared with those of a run without a cluster.",
    ),
}


def page() -> str:
    """The page in Markdown."""
    introduction = "Results of tests on two cores. The command above each table repeats them."
    lines = ["# Load and failure tests", "", introduction, ""]
    for programme, (title, target, note) in PROGRAMMES.items():
        if rows := read(programme):
            cells = [(row.what, f"{row.tries:,}", row.happened) for row in rows]
            lines += [f"## {title}", "", f"    {target}", "", note, ""]
            lines += [*markdown(("test", "tries", "result"), cells), ""]
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"wrote {PAGE.relative_to(ROOT)}")
