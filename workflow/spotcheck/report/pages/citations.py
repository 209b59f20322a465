"""Numbers on a page with their source: on hover they show the file, the variable, the rule and its inputs."""

import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from markupsafe import Markup, escape

from spotcheck.errors import InputError
from spotcheck.report import provenance


class Citations:
    """Mark texts of numbers with the source of the number, as HTML that shows the source on hover.

    A text is marked if it has a digit and a result holds its number; otherwise it is only escaped. The key of a number
    is its name for `spotcheck explain`, such as `calibration.p1_mean`.

    Parameters
    ----------
    results : Path
        Results folder that holds the numbers.
    """

    def __init__(self, results: Path):
        self.results = results

    def cite(self, text: str, key: str) -> Markup:
        """Return the marked text of the number with a key."""
        return _mark(text, key, self._describe(key))

    def cite_frame(self, text: str, table: str, frame: str) -> Markup:
        """Return the marked text of a number of one frame.

        `table` is file and variable, such as `fits.sigma_mean`; `frame` is the label of the frame.
        """
        source = ""
        with suppress(InputError):
            source = provenance.frame_hover_text(self.results, table, frame)
        return _mark(text, f"{table}[frame={frame}]", source)

    def cite_in(self, sentence: str, keys: Mapping[str, str]) -> Markup:
        """Return a sentence in which the first occurrence of each number is marked.

        Parameters
        ----------
        sentence : str
            The sentence, not escaped.
        keys : mapping of str to str
            Key of each number, by its text in the sentence, not escaped. Texts that the sentence lacks are ignored.
        """
        html = str(escape(sentence))
        for text, key in keys.items():
            # The 0 of "0.0001" or "10" must not match the text "0".
            pattern = rf"(?<![\d.]){re.escape(str(escape(text)))}(?!\d|\.\d)"
            if text and (match := re.search(pattern, html)):
                html = html[: match.start()] + str(self.cite(text, key)) + html[match.end() :]
        return Markup(html)

    def _describe(self, key: str) -> str:
        """Return the source of a number in one line; "" if no result holds the number."""
        with suppress(InputError):
            return provenance.hover_text(provenance.find_number(self.results, key))
        return ""


def _mark(text: str, key: str, source: str) -> Markup:
    """Return the HTML of a text with its key and source; without digits in it or without source, it is only escaped."""
    if not source or not any(character.isdigit() for character in str(text)):
        return escape(text)
    return Markup('<span class="from" data-key="{}" title="{}">{}</span>').format(key, source, text)
