"""Numbers on a page say where they come from: on hover the file, the variable, the rule and its inputs."""

import re
from collections.abc import Mapping
from pathlib import Path

from markupsafe import Markup, escape

from spotcheck.errors import InputError
from spotcheck.report import provenance


class Cited:
    """Text of numbers of one folder of results, marked with where they come from."""

    def __init__(self, results: Path):
        self.results = results

    def __call__(self, text: str, key: str) -> Markup:
        """The text of a number with its key, as `spotcheck explain` knows it."""
        return self._marked(text, key, self._hover(key))

    def of_frame(self, text: str, table: str, frame: str) -> Markup:
        """The text of a number of one frame; `table` is such as `fits.sigma_mean`."""
        return self._marked(text, f"{table}[frame={frame}]", self._hover_of_frame(table, frame))

    def within(self, sentence: str, keys: Mapping[str, str]) -> Markup:
        """A sentence in which the texts of numbers are marked, each where it stands first; `keys` are theirs."""
        out = str(escape(sentence))
        for text, key in keys.items():
            # A number is no part of another: the 0 of "0.0001" is not meant by "0".
            alone = rf"(?<![\d.]){re.escape(str(escape(text)))}(?!\d|\.\d)"
            if text and (found := re.search(alone, out)):
                out = out[: found.start()] + str(self(text, key)) + out[found.end() :]
        return Markup(out)

    def _marked(self, text: str, key: str, title: str) -> Markup:
        # A dash, or a word in a number's place, comes from nowhere.
        if not title or not any(own.isdigit() for own in str(text)):
            return escape(text)
        return Markup('<span class="from" data-key="{}" title="{}">{}</span>').format(key, title, text)

    def _hover_of_frame(self, table: str, frame: str) -> str:
        try:
            return provenance.frame_hover_text(self.results, table, frame)
        except InputError:
            return ""

    def _hover(self, key: str) -> str:
        """Where a number comes from, in a line; "" for what no result holds."""
        try:
            return provenance.hover_text(provenance.find_number(self.results, key))
        except InputError:
            return ""
