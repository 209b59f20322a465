"""Text files as editors and spreadsheets save them."""

import codecs
from collections.abc import Sequence
from pathlib import Path

from spotcheck.errors import InputError


def replace_unprintable(text: str) -> str:
    """Return a text with a space in place of each character that cannot be printed, such as a control character."""
    return text if text.isprintable() else "".join(letter if letter.isprintable() else " " for letter in text)


def join_first(texts: Sequence[str], most: int) -> str:
    """Return the first `most` texts, separated by commas, with an ellipsis if there are more."""
    return ", ".join(texts[:most]) + (", …" if len(texts) > most else "")


def read_text(path: Path) -> str:
    """Return the text of a UTF-8 or UTF-16 file without its byte order mark. Raises `InputError` if it is neither."""
    content = path.read_bytes()
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    else:
        # UTF-16 without a mark: files here start with an ASCII character, so one of the first two bytes is zero.
        encoding = {0: "utf-16-be", 1: "utf-16-le"}.get(content[:2].find(b"\0"), "utf-8-sig")
    try:
        return content.decode(encoding)
    except UnicodeDecodeError:
        raise InputError(f"{path.name}: not UTF-8 text; save it as UTF-8") from None
