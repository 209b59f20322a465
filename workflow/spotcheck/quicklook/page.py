"""Page of a first look, and its first picture as a separate file.

A caustic is the radius of a beam along z. A row is the name and the text of a result.
"""

import base64
import io
import math
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from spotcheck.io import atomic_files
from spotcheck.quicklook import pictures, text_report
from spotcheck.report.figures import style
from spotcheck.report.pages import TEMPLATES

if TYPE_CHECKING:
    from spotcheck.quicklook.first_look import Look

# Names of the files that are written; the page is also the name of its template.
PAGE, PICTURE = "look.html", "look.png"
# Most images with a picture; if there are more, evenly spaced ones are drawn.
MOST_PICTURES = 24


class PagePicture(NamedTuple):
    """A picture on the page."""

    png: bytes  # content of the PNG file
    caption: str  # what the picture shows
    title: str  # name of the image; "" for caustics
    rows: text_report.Rows  # results of the image; [] for caustics

    @property
    def data_url(self) -> str:
        """URL that contains the picture itself (RFC 2397)."""
        return f"data:image/png;base64,{base64.b64encode(self.png).decode('ascii')}"


def write_page(look: "Look", folder: Path) -> Path:
    """Write look.html, and look.png with the caustics or the first spot; return the path of the page.

    There is no look.png if there are neither caustics nor spots. Raises `InputError` if `folder` cannot be written.
    """
    pitch_m, images = look.pixel_pitch_m, look.images
    is_single = len(images) == 1
    has_caustics = any(not scan.reason for scan in look.beams)
    caustics = [_render(pictures.draw_caustics(look.beams))] if has_caustics else []
    images_with_spot = [image for image in images if image.picture is not None]
    # Every `step`-th image is drawn, at most `MOST_PICTURES` in all.
    step = max(1, math.ceil(len(images_with_spot) / MOST_PICTURES))
    spots = [
        _render(pictures.draw_spot(image), image.name, text_report.describe_image(image, pitch_m))
        for image in images_with_spot[::step]
    ]
    head, body = text_report.build_table(images, pitch_m)
    content = TEMPLATES.get_template(PAGE).render(
        title=f"A first look at {images[0].name if is_single else f'{len(images)} images'}",
        is_single=is_single,
        rows=text_report.describe_image(images[0], pitch_m),
        head=head,
        body=body,
        beam_lines=text_report.describe_beams(look),
        cameras=[text_report.describe_camera(camera, look.cameras) for camera in look.cameras],
        remarks=[*look.remarks, *([] if is_single else text_report.merge_cautions(images))],
        caustics=caustics,
        spots=spots,
        without_picture=len(images) - len(spots),
    )
    atomic_files.write_text(folder / PAGE, content)
    if page_pictures := [*caustics, *spots]:
        with atomic_files.write_atomically(folder / PICTURE) as scratch:
            scratch.write_bytes(page_pictures[0].png)
    return folder / PAGE


def _render(drawing: style.Drawing, title: str = "", rows: text_report.Rows | None = None) -> PagePicture:
    """Return a drawing as a picture on the page, with the name of its image and the results beside it."""
    stream = io.BytesIO()
    with style.house_style():
        drawing.figure.savefig(stream, format="png", metadata={"Software": None})
    return PagePicture(stream.getvalue(), drawing.caption, title, rows or [])
