"""The page of a first look, and its first picture as a file of its own."""

import base64
import io
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from spotcheck.io import atomic_files
from spotcheck.quicklook import pictures, words
from spotcheck.report.figures import style
from spotcheck.report.pages import TEMPLATES

if TYPE_CHECKING:
    from spotcheck.quicklook.looking import Look

PAGE, PICTURE = "look.html", "look.png"
# Images that get a picture; of more, so many spread evenly.
MOST_PICTURES = 24


class Shown(NamedTuple):
    """A picture on the page: its title, the picture as PNG, what it shows, and what is said of the image."""

    title: str
    png: bytes
    caption: str
    rows: list[tuple[str, str]]

    @property
    def address(self) -> str:
        """The picture as an address that holds it."""
        return f"data:image/png;base64,{base64.b64encode(self.png).decode('ascii')}"


def write(look: "Look", folder: Path) -> Path:
    """Write look.html, and look.png with the scan or the first spot; returns the page's path."""
    scan = [_shown(pictures.caustic(look.beams))] if any(not own.why_not for own in look.beams) else []
    drawn = [one for one in look.images if one.picture is not None]
    step = -(-len(drawn) // MOST_PICTURES) or 1
    spots = [_shown(pictures.spot(one), one.name, words.rows(one, look.pixel_pitch_m)) for one in drawn[::step]]
    single = len(look.images) == 1
    head, body = words.table(look.images, look.pixel_pitch_m)
    content = TEMPLATES.get_template(PAGE).render(
        title=f"A first look at {look.images[0].name if single else f'{len(look.images)} images'}",
        single=single,
        rows=words.rows(look.images[0], look.pixel_pitch_m),
        head=head,
        body=body,
        beams=words.beams(look),
        cameras=[words.camera_rows(own, look.cameras) for own in look.cameras],
        remarks=[*look.remarks, *([] if single else words.remarks_of(look.images))],
        scan=scan,
        spots=spots,
        without=len(look.images) - len(spots),
    )
    atomic_files.write_text(folder / PAGE, content)
    for first in (*scan, *spots)[:1]:
        with atomic_files.write_atomically(folder / PICTURE) as scratch:
            scratch.write_bytes(first.png)
    return folder / PAGE


def _shown(drawing: style.Drawing, title: str = "", rows: list[tuple[str, str]] | None = None) -> Shown:
    """A drawing as the page shows it."""
    stream = io.BytesIO()
    with style.house_style():
        drawing.figure.savefig(stream, format="png", metadata={"Software": None})
    return Shown(title, stream.getvalue(), drawing.caption, rows or [])
