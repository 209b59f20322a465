"""`spotcheck open`: the page of a dataset or of results, in the browser."""

import argparse
import webbrowser
from pathlib import Path

from spotcheck.errors import InputError

EXAMPLE = """Example:
  spotcheck open out/my-frames
"""
PAGES = ("report.html", "look.html", "comparison.html")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.epilog = EXAMPLE
    parser.add_argument("place", type=Path, help="dataset folder, a folder of results, or a page")
    parser.add_argument("--results", type=Path, default=Path("results"), help="where results lie (default: results)")


def run(args: argparse.Namespace) -> None:
    """Open the page, and say where it is."""
    page = page_of(args.place, args.results)
    print(page)
    try:
        opened = webbrowser.open(page.resolve().as_uri())
    except webbrowser.Error:
        opened = False
    if not opened:
        print("no browser was found here; open that file in one")


def page_of(place: Path, results: Path = Path("results")) -> Path:
    """The page of a place. Raises `InputError`, which says what makes one."""
    if place.is_file() and place.suffix == ".html":
        return place
    if not place.is_dir():
        raise InputError(f"{place}: no such folder; name a dataset, a folder of results or a page")
    name = place.resolve().name
    folders = (place, results / name)
    for folder in folders:
        for page in PAGES:
            if (folder / page).exists():
                return folder / page
    if (place / "manifest.csv").exists():
        raise InputError(
            f"{results / name}: has no page yet; run `snakemake --cores 2 --config dataset={place}`, or name the folder"
            " of the results with --results"
        )
    raise InputError(
        f"{place}: has no page and is no dataset; `spotcheck look {place}` makes one of a folder of images"
    )
