"""Holds what the README quotes against a file that a run wrote: check_readme.py README.md BLOCK file.md [--write]

A block stands between `<!-- BLOCK: … -->` and `<!-- /BLOCK -->`.
"""

import re
import sys
from pathlib import Path


def pattern(block: str) -> re.Pattern[str]:
    """The block with its marks, in three groups: mark, content, mark."""
    return re.compile(rf"(<!-- {block}: [^\n]* -->\n)(.*?)(<!-- /{block} -->)", re.DOTALL)


if __name__ == "__main__":
    readme, block, source = Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3])
    text, computed = readme.read_text(encoding="utf-8"), source.read_text(encoding="utf-8")
    found = pattern(block).search(text)
    if found is None:
        sys.exit(f"{readme}: has no block {block}")
    if found[2] != computed:
        if "--write" not in sys.argv:
            sys.exit(f"{readme}: quotes something else than {source}; run with --write and commit")
        readme.write_text(text[: found.start(2)] + computed + text[found.end(2) :], encoding="utf-8")
