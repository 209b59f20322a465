"""Real frames, each judged alone, as they are and with a known effect put into their readings.

`make real`, or `python -m tests.real.beams [--write]`. Nobody knows what else is in them, so no score is set: the
tables say what was named.
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

from tests.blind.by_command import by_subcommands
from tests.blind.records import RESULTS, ROOT
from tests.blind.table import markdown
from tests.real.listed import rows_of

SOURCE = ROOT.parent / "shared" / "data" / "hene-zscan"
NULLS, SEED = 400, 20210

# What is put in: the effect's name → readings of it. Sizes are those that a camera or a bench might have.
CLIP, OFFSET, BEND, DEPTH, PERIOD = 0.7, 6.0, 0.15, 0.1, 23.0


def _stripes(pixels: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
    return pixels * (1 + DEPTH * np.cos(2 * np.pi * (0.8 * x + 0.6 * y) / PERIOD))


HIDDEN: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "": lambda pixels: pixels,
    "saturation": lambda pixels: np.minimum(pixels, CLIP * pixels.max()),
    "dark_offset": lambda pixels: pixels + OFFSET,
    "nonlinearity": lambda pixels: pixels - BEND * pixels**2 / 255,
    "interference_fringes": _stripes,
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
    if write:
        shutil.copyfile(RESULTS / "real-beams.md", ROOT / "workflow" / "docs" / "real-beams.md")
    print(text)


def judged(row: dict[str, str], name: str) -> dict[str, Any]:
    """The verdict on one frame with an effect put in, and what each effect alone explains (−2 ln L)."""
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
        evidence = json.loads((out / "findings.json").read_text(encoding="utf-8")).get("singles", {})
        return {"verdict": verdict, "evidence": {key: value["score"] for key, value in evidence.items()}}


def said(own: dict[str, Any]) -> str:
    """A verdict in few words."""
    verdict = own["verdict"]
    sets = [" + ".join(names) for names in verdict["explanations"]]
    return f"{verdict['status']}{': ' if sets else ''}{' / '.join(sets)}"


def page(found: dict[str, dict[str, dict[str, Any]]]) -> str:
    """The page."""
    plain, hidden = [], []
    right = wrong = total = 0
    for file, own in found.items():
        as_is = own[""]
        best = sorted(as_is["evidence"].items(), key=lambda item: item[1])[:3]
        shown = ", ".join(f"{name} ({-value:.3g})" for name, value in best)
        size = as_is["verdict"]["detection"]["rms_residual_percent_of_peak"]
        plain.append((f"`{Path(file).stem}`", f"{size:.2g} %" if size is not None else "—", shown, said(as_is)))
        for name, with_it in own.items():
            if not name:
                continue
            names = {effect["name"] for effect in with_it["verdict"]["effects"]}
            known = {effect["name"] for effect in as_is["verdict"]["effects"]}
            total += 1
            right += name in names
            wrong += bool(names) and name not in names | known
            hidden.append((f"`{Path(file).stem}`", name, said(with_it)))
    lines = [
        "# Real frames", "",
        "Nine frames of a HeNe beam (`hene-zscan`), each judged alone with its own brightness and width, by "
        "`make real`.", "",
        "## As they are", "",
        *markdown(("frame", "off by (rms, of the peak)", "explains most alone (−2 ln L)", "verdict"), plain), "",
        "## With an effect put in", "",
        f"Readings are cut at {CLIP:g} of the highest, raised by {OFFSET:g} DN, bent by {BEND:g} y²/full scale, or "
        f"given stripes of {DEPTH:g} in depth and {PERIOD:g} px in period, then rounded anew. Of {total} sets what was "
        f"put in was named in {right}; something else, and not it, in {wrong}. In the others nothing is named, as in "
        "the frames as they are: what was put in is not all that the model lacks, and one frame tells no more.", "",
        *markdown(("frame", "put in", "verdict"), hidden), "",
    ]  # fmt: skip
    return "\n".join(lines)


if __name__ == "__main__":
    main()
