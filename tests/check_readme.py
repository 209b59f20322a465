"""Holds the numbers that the README quotes against a file that a rule wrote: check_readme.py README.md numbers.md"""

import sys
from pathlib import Path

START, END = "<!-- numbers: written by `make check-numbers`, not by hand -->\n", "<!-- /numbers -->"


def quoted(readme: str) -> str:
    """What stands between the marks of the README."""
    return readme.split(START)[1].split(END)[0]


if __name__ == "__main__":
    readme, numbers = (Path(argument) for argument in sys.argv[1:3])
    text, computed = readme.read_text(encoding="utf-8"), numbers.read_text(encoding="utf-8")
    if quoted(text) != computed:
        if "--write" in sys.argv:
            readme.write_text(text.replace(START + quoted(text) + END, START + computed + END), encoding="utf-8")
        else:
            sys.exit(f"{readme}: quotes other numbers than {numbers}; run with --write and commit")
