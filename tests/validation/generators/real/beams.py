"""Frames of a HeNe beam, each judged alone, as it is and with a known effect put into its readings.

Nobody knows what else is in them, so no score is set: the tables say what was named, and a picture what there is to be
seen.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from spotcheck import store
from spotcheck.discrepancy.name import scatters
from spotcheck.model.effects import vocabulary
from tests.validation.generators.real.beams_picture import Seen
from tests.validation.protocol import Record, manifest_of
from tests.validation.records import ROOT
from tests.validation.table import markdown

SOURCE = ROOT.parent / "shared" / "data" / "hene-zscan"

# What is put in: the effect's name → readings of it, and what is known of its parameters. Sizes are those that a camera
# or a bench might have.
CLIP, OFFSET, BEND, DEPTH, PERIOD = 0.7, 6.0, 0.15, 0.1, 23.0
# The spot's highest readings: a bright speck of dust is no spot.
TOP = 99.9


def _stripes(pixels: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
    return pixels * (1 + DEPTH * np.cos(2 * np.pi * (0.8 * x + 0.6 * y) / PERIOD))


PUT_IN: dict[str, tuple[Callable[[np.ndarray], np.ndarray], dict[str, float]]] = {
    "": (lambda pixels: pixels, {}),
    "saturation": (lambda pixels: np.minimum(pixels, CLIP * np.percentile(pixels, TOP)), {}),
    "dark_offset": (lambda pixels: pixels + OFFSET, {"level": OFFSET}),
    "nonlinearity": (lambda pixels: pixels - BEND * pixels**2 / 255, {"q": BEND}),
    "interference_fringes": (_stripes, {"d": DEPTH, "period": PERIOD}),
}
# What a person sees beside a round Gaussian spot, in the frame and in the picture of what the base model leaves.
TO_BE_SEEN = {
    "t-168mm": "rings and stripes around, a trail down the columns, a faint pedestal",
    "t-210mm": "a pedestal, a bar across the spot, stripes at its right, a second spot at the edge",
    "t-280mm": "a pedestal, four lobes, a second spot at the edge",
    "t-348mm": "a pedestal, four lobes, a faint spot below, a second one at the edge",
    "t-414mm": "a pedestal, three lobes, a faint spot below",
    "t-495mm": "a pedestal, a tail to the lower right",
    "t-580mm": "a pedestal, a faint spot below",
    "t-666mm": "a pedestal, a faint trail",
    "t-770mm": "a pedestal",
}


def stems() -> list[str]:
    """The names of the frames."""
    return [Path(row["file"]).stem for row in manifest_of(SOURCE)]


def pixels_of(stem: str, name: str) -> np.ndarray:
    """A frame with an effect put into its readings, which are rounded anew ("": as it is) [DN]."""
    (file,) = (row["file"] for row in manifest_of(SOURCE) if Path(row["file"]).stem == stem)
    pixels = np.asarray(Image.open(SOURCE / file), float)
    return np.clip(np.rint(PUT_IN[name][0](pixels)), 0, 255).astype(np.uint8)


def write(stem: str, name: str, folder: Path) -> dict[str, float]:
    """One frame as a data set; returns what is known of the effect's parameters."""
    (folder / "frames").mkdir(parents=True)
    Image.fromarray(pixels_of(stem, name)).save(folder / "frames" / "spot.png")
    manifest = "file,kind,angle_deg,exposure_s,repeat\nframes/spot.png,spot,0,,0\n"
    (folder / "manifest.csv").write_text(manifest, encoding="utf-8")
    sheet = yaml.safe_load((SOURCE / "instrument.yaml").read_text(encoding="utf-8")) | {"name": stem}
    sheet.pop("conditions")
    (folder / "instrument.yaml").write_text(yaml.safe_dump(sheet), encoding="utf-8")
    return PUT_IN[name][1]


def beside(results: Path) -> dict[str, Any]:
    """What part of what the mean is off by each effect alone closes; and what there is to be seen: row and column of
    the crop's corner, its side [px], and what the base model leaves of its blocks, over the peak."""
    with store.read(results / "discrepancy.nc") as ds:
        known = "residual_before" in ds
        left = np.squeeze(ds["residual_before"].values) / float(ds["peak"]) if known else None
        closed = dict(zip(ds["candidate"].values, ds["candidate_closed"].values, strict=True)) if known else {}
    with store.read(results / "crops.nc") as ds:
        corner = [int(ds[name].sel(centring="light").item()) for name in ("top", "left")]
        side = int(ds.sizes["y"])
    # More noise excuses any mean.
    closed = {str(name): float(part) for name, part in closed.items() if not scatters(vocabulary()[name])}
    blocks = None if left is None else [[round(v, 4) if np.isfinite(v) else None for v in row] for row in left.tolist()]
    return {"closed": closed, "seen": {"corner": corner, "side": side, "left": blocks}}


def seen(records: Sequence[Record]) -> dict[str, Seen]:
    """The frames as they are, for the picture."""
    found = {stem_of(own): own for own in records if not put_in(own)}
    return {
        stem: Seen(pixels_of(stem, ""), tuple(own["seen"]["corner"]), own["seen"]["side"], _array(own["seen"]["left"]))
        for stem, own in found.items()
    }


def stem_of(record: Record) -> str:
    """The name of a record's frame."""
    return record["job"]["design"].split()[-1]


def put_in(record: Record) -> str:
    """The effect that was put in, "" for a frame as it is."""
    return record["job"]["kind"].partition(":")[2]


def _array(rows: Any) -> np.ndarray | None:
    """NaN where a file has null."""
    return None if rows is None else np.array(rows, float)


def said(own: Record) -> str:
    """A verdict in few words."""
    verdict = own["verdict"]
    sets = [" + ".join(names) for names in verdict["explanations"]]
    return f"{verdict['status']}{': ' if sets else ''}{' / '.join(sets)}"


def closing(own: Record) -> str:
    """The two effects that alone close most of what the mean is off by."""
    best = sorted(own["closed"].items(), key=lambda item: -item[1])[:2]
    return ", ".join(f"{name} ({100 * part:.0f} %)" for name, part in best) or "—"


def page(records: Sequence[Record]) -> str:
    """The page."""
    plain, hidden = [], []
    right = wrong = unjudged = 0
    as_is = {stem_of(own): own for own in records if not put_in(own)}
    for own in records:
        stem, name = stem_of(own), put_in(own)
        if not name:
            size = own["verdict"]["detection"]["rms_residual_percent_of_peak"]
            off = f"{size:.2g} %" if size is not None else "—"
            plain.append((f"`{stem}`", TO_BE_SEEN[stem], off, closing(own), said(own)))
            continue
        names, known = ({effect["name"] for effect in one["verdict"]["effects"]} for one in (own, as_is[stem]))
        right += name in names
        wrong += bool(names) and name not in names | known
        unjudged += own["verdict"]["status"] == "not_assessed"
        hidden.append((f"`{stem}`", name, closing(own), said(own)))
    # The spot takes less than half of any frame.
    dark = [np.median(pixels_of(stem, "")) for stem in as_is]
    lines = [
        "# Real frames", "",
        "Nine frames of a HeNe beam (`hene-zscan`), each judged alone with its own brightness and width, by "
        "`make validate-real`.", "",
        "![The frames with their crops, and what the base model leaves of them](real-beams.png)", "",
        "## As they are", "",
        *markdown(("frame", "what a person sees", "off by (rms, of the peak)", "closes most of that alone", "verdict"),
                  plain), "",
        f"What closes most is what the eye sees first: dark pixels read {min(dark):g} to {max(dark):g} DN by frame, "
        "where the data sheet has black at 0, and a pedestal takes most of that away; so would a halo as broad as the "
        "crop. The lobes, bars and rings that are left leave no set of effects standing, so nothing is named. Frames "
        "that tell neither gain nor read noise are not assessed.", "",
        "## With an effect put in", "",
        f"Readings are cut at {CLIP:g} of the spot's highest, raised by {OFFSET:g} DN, bent by {BEND:g} y²/full scale, "
        f"or given stripes of {DEPTH:g} in depth and {PERIOD:g} px in period, then rounded anew. Of {len(hidden)} sets "
        f"what was put in was named in {right}; something else, and not it, in {wrong}; {unjudged} are not assessed. "
        "In the others nothing is named, as in the frames as they are: what was put in is not all that the model "
        "lacks, and one frame tells no more.", "",
        *markdown(("frame", "put in", "closes most of what is off alone", "verdict"), hidden), "",
    ]  # fmt: skip
    return "\n".join(lines)
