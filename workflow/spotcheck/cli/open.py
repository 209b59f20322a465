"""`spotcheck open`: opens the page of a dataset or of results in the browser.

Examples
--------
spotcheck open out/my-frames
"""

import argparse
import webbrowser
from pathlib import Path

from spotcheck.errors import InputError

# Names of pages, the most complete first.
PAGES = ("report.html", "look.html", "comparison.html")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand to its parser."""
    parser.add_argument("place", type=Path, help="dataset folder, a folder of results, or a page")
    parser.add_argument("--results", type=Path, default=Path("results"), help="folder of results (default: results)")


def run(args: argparse.Namespace) -> None:
    """Open the page in the browser, and print its path. Raises `InputError` if there is no page."""
    page = find_page(args.place, args.results)
    print(page)
    try:
        is_open = webbrowser.open(page.resolve().as_uri())
    except webbrowser.Error:
        is_open = False
    if not is_open:
        print("no browser was found here; open that file in one")


def find_page(place: Path, results: Path = Path("results")) -> Path:
    """Return the path of the page of a dataset, of a folder of results, or of a first look at images.

    Parameters
    ----------
    place : dataset folder, folder with a page, or the page itself.
    results : folder that holds a folder of results for each dataset, under the name of the dataset.

    Raises
    ------
    InputError
        There is no page. The message says which command writes one.
    """
    if place.is_file() and place.suffix == ".html":
        return place
    if not place.is_dir():
        raise InputError(f"{place}: no such folder; name a dataset, a folder of results or a page")
    results_folder = results / place.resolve().name
    for page in (folder / name for folder in (place, results_folder) for name in PAGES):
        if page.exists():
            return page
    if (place / "manifest.csv").exists():
        raise InputError(
            f"{results_folder}: has no page yet; run `snakemake --cores 2 --config dataset={place}`, or name the folder"
            " of the results with --results"
        )
    raise InputError(
        f"{place}: has no page and is no dataset; `spotcheck look {place}` makes one of a folder of images"
    )
