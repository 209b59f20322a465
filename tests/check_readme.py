"""Holds what pages quote against what runs wrote.

check_readme.py PAGE                          every number that the page takes from another page's table
check_readme.py PAGE BLOCK SOURCE [--first]   one block; --first: the first paragraph of the source alone

A number stands as `<!-- page.md: name of a row -->number<!-- / -->`, where page.md lies in workflow/docs/; the row's
second cell begins with it. A block stands between `<!-- BLOCK: … -->` and `<!-- /BLOCK -->`. Its source is a file, or
the block of the same name in a page; of verdict.json the sentence; of a figures' index.json the caption of the figure
that the block is named after, whose picture workflow/docs/BLOCK.png must show as well. With --write the page is mended
instead.
"""

import argparse
import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
from PIL import Image

DOCS = Path(__file__).parents[1] / "workflow" / "docs"
NUMBER = re.compile(r"(<!-- ([\w-]+\.md): ([^\n]*?) -->)([^<]*)(<!-- / -->)")
# Grey levels of 255 by which a picture may differ on average: another processor moves a line by part of a pixel.
ALIKE = 2.0


def pattern(block: str) -> re.Pattern[str]:
    """The block with its marks, in three groups: mark, content, mark."""
    return re.compile(rf"(<!-- {block}: [^\n]* -->\n)(.*?)(<!-- /{block} -->)", re.DOTALL)


def cell(page: Path, row: str) -> str:
    """The number with its unit that the second cell of a row begins with; the row is the first whose name begins so."""
    for line in page.read_text(encoding="utf-8").splitlines():
        name, _, rest = line.removeprefix("| ").partition(" | ")
        if line.startswith("| ") and name.startswith(row):
            return rest.split(" | ")[0].split(" (")[0].removeprefix("× ")
    sys.exit(f"{page}: has no row {row}")


def with_numbers(text: str) -> str:
    """A page's text with every number as its source has it."""
    return NUMBER.sub(lambda found: found[1] + cell(DOCS / found[2], found[3]) + found[5], text)


def quoted(source: Path, block: str, first: bool) -> str:
    """What a block must hold."""
    text = source.read_text(encoding="utf-8")
    if source.name == "verdict.json":
        text = f"> {json.loads(text)['sentence']}\n"
    elif source.name == "index.json":
        (text,) = [own["caption"] + "\n" for own in json.loads(text)["figures"] if own["name"] == block]
    elif inner := pattern(block).search(text):
        text = inner[2]
    return text.split("\n\n")[0].rstrip() + "\n" if first else text


def alike(one: Path, two: Path) -> bool:
    """Whether two pictures show the same."""
    first, second = (np.asarray(Image.open(path).convert("L"), float) for path in (one, two))
    return first.shape == second.shape and bool(np.abs(first - second).mean() < ALIKE)


def main() -> None:
    """Check or mend; status 1 and a sentence where something else is quoted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("block", nargs="?")
    parser.add_argument("source", type=Path, nargs="?")
    parser.add_argument("--first", action="store_true")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    text = args.page.read_text(encoding="utf-8")
    if args.source is None:
        wanted = with_numbers(text)
    else:
        found = pattern(args.block).search(text)
        if found is None:
            sys.exit(f"{args.page}: has no block {args.block}")
        wanted = text[: found.start(2)] + quoted(args.source, args.block, args.first) + text[found.end(2) :]
        if args.source.name == "index.json":
            picture = args.source.with_name(f"{args.block}.png"), DOCS / f"{args.block}.png"
            if args.write:
                shutil.copyfile(*picture)
            elif not alike(*picture):
                sys.exit(f"{picture[1]}: shows something else than {picture[0]}; run with --write and commit")
    # Where lines break does not matter.
    if wanted.split() == text.split():
        return
    if args.write:
        args.page.write_text(wanted, encoding="utf-8")
    else:
        sys.exit(f"{args.page}: quotes something else than {args.source or 'its tables'}; run with --write and commit")


if __name__ == "__main__":
    main()
