"""Real frames, each judged alone, as they are and with a known effect put into their readings.

`make real`, or `python -m tests.real.beams [--write]`. Nobody knows what else is in them, so no score is set: the
tables say what was named, and a picture what there is to be seen.
"""

import argparse
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from spotcheck import store
from spotcheck.discrepancy.name import scatters
from spotcheck.model.effects import vocabulary
from tests.blind.by_command import by_subcommands
from tests.blind.records import RESULTS, ROOT
from tests.blind.table import markdown
from tests.real.beams_picture import Seen, draw
from tests.real.listed import rows_of

SOURCE = ROOT.parent / "shared" / "data" / "hene-zscan"
NULLS, SEED = 400, 20210

# What is put in: the effect's name → readings of it. Sizes are those that a camera or a bench might have.
CLIP, OFFSET, BEND, DEPTH, PERIOD = 0.7, 6.0, 0.15, 0.1, 23.0
# The spot's highest readings: a bright speck of dust is no spot.
TOP = 99.9


def _stripes(pixels: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
    return pixels * (1 + DEPTH * np.cos(2 * np.pi * (0.8 * x + 0.6 * y) / PERIOD))


HIDDEN: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "": lambda pixels: pixels,
    "saturation": lambda pixels: np.minimum(pixels, CLIP * np.percentile(pixels, TOP)),
    "dark_offset": lambda pixels: pixels + OFFSET,
    "nonlinearity": lambda pixels: pixels - BEND * pixels**2 / 255,
    "interference_fringes": _stripes,
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


def main() -> None:
    """Judge every frame and print, or write, the page."""
    parser = argparse.ArgumentParser(prog="python -m tests.real.beams", description=__doc__)
    parser.add_argument("--write", action="store_true", help="also into workflow/docs/real-beams.md")
    write = parser.parse_args().write
    rows = rows_of(SOURCE)
    found = {row["file"]: {name: judged(row, name) for name in HIDDEN} for row in rows}
    text = page(found)
    (RESULTS / "real-beams.md").write_text(text, encoding="utf-8")
    draw({Path(file).stem: own[""]["seen"] for file, own in found.items()}, RESULTS / "real-beams.png")
    for name in ("real-beams.md", "real-beams.png") if write else ():
        shutil.copyfile(RESULTS / name, ROOT / "workflow" / "docs" / name)
    print(text)


def judged(row: dict[str, str], name: str) -> dict[str, Any]:
    """The verdict on one frame with an effect put in, what part of what the mean is off by each effect alone closes,
    and what there is to be seen."""
    with tempfile.TemporaryDirectory(prefix="spotcheck-real-") as base:
        folder, out = Path(base, "frame"), Path(base, "results")
        (folder / "frames").mkdir(parents=True)
        pixels = np.asarray(Image.open(SOURCE / row["file"]), float)
        changed = np.clip(np.rint(HIDDEN[name](pixels)), 0, 255).astype(np.uint8)
        Image.fromarray(changed).save(folder / "frames" / "spot.png")
        manifest = "file,kind,angle_deg,exposure_s,repeat\nframes/spot.png,spot,0,,0\n"
        (folder / "manifest.csv").write_text(manifest, encoding="utf-8")
        sheet = yaml.safe_load((SOURCE / "instrument.yaml").read_text(encoding="utf-8")) | {"name": row["file"]}
        sheet.pop("conditions")
        (folder / "instrument.yaml").write_text(yaml.safe_dump(sheet), encoding="utf-8")
        by_subcommands(folder, out, RESULTS / "_calibration", NULLS, SEED)
        verdict = json.loads((out / "verdict.json").read_text(encoding="utf-8"))
        with store.read(out / "discrepancy.nc") as ds:
            known = "residual_before" in ds
            left = np.squeeze(ds["residual_before"].values) / float(ds["peak"]) if known else None
            closed = dict(zip(ds["candidate"].values, ds["candidate_closed"].values, strict=True)) if known else {}
            # More noise excuses any mean.
            closed = {name: part for name, part in closed.items() if not scatters(vocabulary()[name])}
        with store.read(out / "crops.nc") as ds:
            corner = tuple(int(ds[name].sel(centring="light").item()) for name in ("top", "left"))
        return {"verdict": verdict, "closed": closed, "seen": Seen(changed, corner, sheet["crop_px"], left)}


def said(own: dict[str, Any]) -> str:
    """A verdict in few words."""
    verdict = own["verdict"]
    sets = [" + ".join(names) for names in verdict["explanations"]]
    return f"{verdict['status']}{': ' if sets else ''}{' / '.join(sets)}"


def closing(own: dict[str, Any]) -> str:
    """The two effects that alone close most of what the mean is off by."""
    best = sorted(own["closed"].items(), key=lambda item: -item[1])[:2]
    return ", ".join(f"{name} ({100 * part:.0f} %)" for name, part in best) or "—"


def page(found: dict[str, dict[str, dict[str, Any]]]) -> str:
    """The page."""
    plain, hidden = [], []
    right = wrong = unjudged = total = 0
    for file, own in found.items():
        as_is = own[""]
        size = as_is["verdict"]["detection"]["rms_residual_percent_of_peak"]
        stem = Path(file).stem
        off = f"{size:.2g} %" if size is not None else "—"
        plain.append((f"`{stem}`", TO_BE_SEEN[stem], off, closing(as_is), said(as_is)))
        for name, with_it in own.items():
            if not name:
                continue
            names = {effect["name"] for effect in with_it["verdict"]["effects"]}
            known = {effect["name"] for effect in as_is["verdict"]["effects"]}
            total += 1
            right += name in names
            wrong += bool(names) and name not in names | known
            unjudged += with_it["verdict"]["status"] == "not_assessed"
            hidden.append((f"`{stem}`", name, closing(with_it), said(with_it)))
    # The spot takes less than half of any frame.
    dark = [np.median(own[""]["seen"].frame) for own in found.values()]
    lines = [
        "# Real frames", "",
        "Nine frames of a HeNe beam (`hene-zscan`), each judged alone with its own brightness and width, by "
        "`make real`.", "",
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
        f"or given stripes of {DEPTH:g} in depth and {PERIOD:g} px in period, then rounded anew. Of {total} sets what "
        f"was put in was named in {right}; something else, and not it, in {wrong}; {unjudged} are not assessed. In the "
        "others nothing is named, as in the frames as they are: what was put in is not all that the model lacks, and "
        "one frame tells no more.", "",
        *markdown(("frame", "put in", "closes most of what is off alone", "verdict"), hidden), "",
    ]  # fmt: skip
    return "\n".join(lines)


if __name__ == "__main__":
    main()
