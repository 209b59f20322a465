"""One job, one dataset folder, one truth."""

import csv
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import yaml

from tests.validation.generators.light import hene
from tests.validation.generators.light.bound import BESIDE_STRIPES, FAR_REACH, Reference, behind_grain
from tests.validation.generators.light.case import draw_case
from tests.validation.generators.light.outside import MECHANISMS, RARE
from tests.validation.generators.light.plan import SHAPES
from tests.validation.generators.light.strength import SCATTERS, tune, unknown_of
from tests.validation.generators.second.case import Case, Effect
from tests.validation.generators.second.effects import VOCABULARY
from tests.validation.generators.second.sensor import expose
from tests.validation.generators.second.sheet import instrument
from tests.validation.protocol import Job

# A third of the sets with one effect on light that is no Gaussian have speckle on top.
SPECKLED, CONTRAST = 1 / 3, (0.2, 0.5)
# Row of the sets that have the light of another set and no effect.
UNALTERED = "unaltered"
# Not beside this one, whose signal-to-noise is that beside another base.
ALONE = ("spread_law",)


def write_job(job: Job, folder: Path) -> dict[str, Any]:
    """Make what a job says; returns the truth."""
    is_unaltered = job.kind.startswith(UNALTERED)
    row, put_in, *drawn = job.kind.removeprefix(f"{UNALTERED}:").split(":")
    if row == "frame":
        return hene.write(int(job.design.split()[-1]), put_in, job.seed, folder)
    light = drawn[0]
    names = [f"outside:{put_in}"] if row == "outside" else [name for name in put_in.split("+") if name]
    case = draw_case(job.seed, job.design, light, names)
    alone = row == "outside" or len(names) != 1 or names[0] in (*SCATTERS, *ALONE)
    truths = [] if is_unaltered else hide(case, names, float(drawn[1]), None if alone else _on_top(case))
    write(case, folder)
    return {
        "seed": job.seed,
        "design": job.design,
        "light": {
            "kind": light,
            "name": case.shape.name if case.shape else "gauss",
            "off": case.shape.off if case.shape else 0.0,
        },
        "effects": truths,
        "base": {"p1_px": case.p1, "p2_px": case.p2, "peak_dn": case.peak, "frames": len(case.frames),
                 "photon_budget": case.budget},
    }  # fmt: skip


def hide(case: Case, names: Sequence[str], level: float, top: Effect | None = None) -> list[dict[str, Any]]:
    """Draw effects into a case, each tuned by itself, and with them speckle `on top`. Returns their truths."""
    if top:
        # Room for bright grains.
        case.peak /= 1 + 2 * top.s
    truths, found = [], []
    for k, name in enumerate(names):
        rng = np.random.default_rng([case.seed, 1, k])
        strange = name.removeprefix("outside:")
        effect = (MECHANISMS[strange] if strange != name else VOCABULARY[name])(case, rng)
        effect.name = name
        if strange in RARE:
            reference = Reference(case, also=effect.state["frames"].tolist())
            effect.cap = effect.floor
        else:
            nodes = BESIDE_STRIPES if name == "interference_fringes" else None
            reference = Reference(case, nodes=nodes, reach=FAR_REACH if name in SHAPES else None)
        behind = partial(_behind, reference, case, effect, top) if top else None
        tuned = tune(reference, case, effect, level, behind)
        truth: dict[str, Any] = {"name": name, "form": effect.form, "parameters": effect.at(effect.s)}
        truth |= tuned._asdict()
        if behind:
            truth["behind_speckle"] = behind()
        truths.append(truth)
        found.append(effect)
    for effect in (*found, *([top] if top else [])):
        case.effects[effect.name] = effect
    if top:
        truths.append({"name": "speckle", "form": top.form, "parameters": top.at(top.s), "on_top": True})
    return truths


def _behind(reference: Reference, case: Case, effect: Effect, top: Effect) -> float:
    """Signal-to-noise of an effect, as strong as it is, behind speckle."""
    change = reference.change(case.only(effect))
    return behind_grain(reference, change, top["contrast"], top["grain"], unknown_of(reference, effect.name))


def _on_top(case: Case) -> Effect | None:
    """Speckle, new at each site, in a third of the sets of several sites."""
    rng = np.random.default_rng([case.seed, 4])
    if not case.shape or case.design == "single_frame" or rng.random() >= SPECKLED:
        return None
    effect = VOCABULARY["speckle"](case, rng)
    effect.s = float(rng.uniform(*CONTRAST))
    return effect


def write(case: Case, folder: Path) -> None:
    """A case as a dataset folder with one file a frame."""
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    sheet = yaml.safe_dump(instrument(case, folder.name), sort_keys=False)
    (folder / "instrument.yaml").write_text(sheet, encoding="utf-8")
    rows: list[Sequence[object]] = [("file", "kind", "angle_deg", "exposure_s", "repeat")]
    for i, frame in enumerate(case.frames):
        file = f"frames/{i:04d}.tif"
        rows.append((file, "spot", f"{frame.angle:g}", f"{frame.exposure:g}", frame.repeat))
        tifffile.imwrite(folder / file, expose(case, i).astype(np.uint16), photometric="minisblack", compression="zlib")
    with (folder / "manifest.csv").open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerows(rows)
