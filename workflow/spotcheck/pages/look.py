"""The page of a first look."""

import base64
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from spotcheck import writing
from spotcheck.figures import style
from spotcheck.first_look import pictures, words
from spotcheck.pages import TEMPLATES

if TYPE_CHECKING:
    from spotcheck.first_look.looking import Look

NAME = "look.html"
# Images that get a picture; of more, these many spread evenly.
MOST_PICTURES = 24


class Shown(NamedTuple):
    """A picture on the page: its file's name, its content for the page, and what is said of it."""

    name: str
    content: str
    caption: str
    rows: list[tuple[str, str]]


def write(look: "Look", folder: Path) -> Path:
    """Write look.html and each of its pictures as PNG; returns the page's path."""
    shown = list(_pictures(look, folder))
    single = len(look.images) == 1
    head, body = words.table(look.images, look.pixel_pitch_m)
    content = TEMPLATES.get_template("look.html").render(
        title=f"A first look at {look.images[0].name if single else f'{len(look.images)} images'}",
        single=single,
        head=head,
        body=body,
        cameras=[own.lines() for own in look.cameras],
        remarks=[*look.remarks, *([] if single else words.remarks_of(look.images))],
        beams=words.beams(look),
        shown=shown,
        missing=len(look.images) - sum(bool(own.rows) for own in shown) if not single else 0,
        rows=words.rows(look.images[0], look.pixel_pitch_m) if single else [],
    )
    writing.text(folder / NAME, content)
    return folder / NAME


def _pictures(look: "Look", folder: Path) -> Iterator[Shown]:
    if any(not own.why_not for own in look.beams):
        yield _drawn("caustic", lambda: pictures.caustic(look.beams), folder, [])
    drawn = [one for one in look.images if one.picture is not None]
    step = -(-len(drawn) // MOST_PICTURES) or 1
    for number, one in enumerate(drawn[::step]):
        name = "spot" if len(drawn) == 1 else f"spot-{number * step + 1:03}"
        rows = words.rows(one, look.pixel_pitch_m)
        yield _drawn(name, lambda one=one: pictures.spot(one), folder, rows)


def _drawn(name: str, draw, folder: Path, rows: Sequence[tuple[str, str]]) -> Shown:
    """Draw a picture, write it and keep it for the page."""
    with style.applied():
        drawing = draw()
        stream = io.BytesIO()
        drawing.figure.savefig(stream, format="png", metadata={"Software": None})
    with writing.whole(folder / f"{name}.png") as scratch:
        scratch.write_bytes(stream.getvalue())
    content = base64.b64encode(stream.getvalue()).decode("ascii")
    return Shown(name, f"data:image/png;base64,{content}", drawing.caption, list(rows))
