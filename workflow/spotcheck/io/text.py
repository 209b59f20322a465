"""Text files as editors and spreadsheets save them."""

import codecs
from pathlib import Path

from spotcheck.errors import InputError


def read_text(path: Path) -> str:
    """Content of a UTF-8 or UTF-16 file, with or without a byte order mark, which is left out. Raises `InputError`."""
    content = path.read_bytes()
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    else:
        # These files begin with an ASCII letter or sign: UTF-16 shows by the zero beside it.
        encoding = {0: "utf-16-be", 1: "utf-16-le"}.get(content[:2].find(b"\0"), "utf-8-sig")
    try:
        return content.decode(encoding)
    except UnicodeDecodeError:
        raise InputError(f"{path.name}: not UTF-8 text; save it as UTF-8") from None
