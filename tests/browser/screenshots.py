"""Pictures of a page for a person to look at: `python -m tests.browser.screenshots RESULTS OUT`."""

import argparse
from pathlib import Path

from tests.browser.opening import WINDOW, from_disk, started

# Name, window [px], colour scheme, whether folds are open, whether the whole page is shown.
SHOTS = (
    ("first-screen", WINDOW, "light", False, False),
    ("first-screen-dark", WINDOW, "dark", False, False),
    ("folded", WINDOW, "light", False, True),
    ("unfolded", WINDOW, "light", True, True),
    ("unfolded-dark", WINDOW, "dark", True, True),
    ("narrow", (380, 800), "light", False, True),
    ("narrow-unfolded", (380, 800), "light", True, True),
    ("wide", (2560, 1440), "light", False, False),
)
# Pause [ms] after the page was scrolled through, in which graphs that wait to be seen are drawn.
PAUSE = 1500


def taken(results: Path, out: Path) -> None:
    """Write one PNG a shot, and the printed page as PDF."""
    out.mkdir(parents=True, exist_ok=True)
    with started() as browser:
        for name, window, scheme, unfolded, whole in SHOTS:
            with from_disk(browser, results / "report.html", window=window, color_scheme=scheme) as opened:
                page = opened.page
                page.evaluate("looks.unfold", unfolded)
                page.evaluate("looks.visit()")
                page.wait_for_timeout(PAUSE)
                page.screenshot(path=out / f"{name}.png", full_page=whole)
        with from_disk(browser, results / "report.html") as opened:
            opened.page.pdf(path=out / "printed.pdf")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path, help="a results folder with its report.html")
    parser.add_argument("out", type=Path, help="folder for the pictures")
    given = parser.parse_args()
    taken(given.results, given.out)
