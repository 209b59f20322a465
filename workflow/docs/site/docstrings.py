"""Docstrings as Sphinx takes them: what is said of a parameter begins on the line of its name."""

import re

from sphinx.application import Sphinx

SECTION = re.compile(r"(Parameters|Attributes)$")
NAMED = re.compile(r"(\s*)((?:\w+, )*\w+) : (.+)")


def apart(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Put what is said of each parameter below its name, where napoleon would take the first line for its type."""
    inside, out = False, list[str]()
    for k, line in enumerate(lines):
        if k + 1 < len(lines) and set(lines[k + 1]) == {"-"}:
            inside = bool(SECTION.match(line))
        named = NAMED.match(line) if inside else None
        if named and not named[1]:
            out += [named[2], f"    {named[3]}"]
        else:
            out.append(line)
    lines[:] = out


def setup(app: Sphinx) -> dict:
    """Register with Sphinx, before napoleon."""
    app.connect("autodoc-process-docstring", apart, priority=400)
    return {"version": "1", "parallel_read_safe": True}
