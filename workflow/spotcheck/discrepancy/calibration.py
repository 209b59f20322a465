"""Null sets: the baseline alone, drawn at random over the range of its parameters, for the design at hand."""

import hashlib
import json
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck import provenance, store
from spotcheck.discrepancy.assess import likeliest, of_means
from spotcheck.discrepancy.base import Base
from spotcheck.discrepancy.cells import Setting
from spotcheck.discrepancy.detect import Null, null_of
from spotcheck.discrepancy.explain import account
from spotcheck.discrepancy.look import Look, look_at
from spotcheck.discrepancy.shots import Design, Shot
from spotcheck.discrepancy.surround import STATISTIC
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import Law
from spotcheck.model.effects import choose, chosen, record
from spotcheck.model.sensor import SensorModel
from spotcheck.model.simulate import frames

# Ranges from which null sets are drawn: gain [DN/e-] for 10 bit, read noise [e-], brightest light as a part of full
# scale, width at the longest exposure and its rise per e-fold of exposure as parts of the crop and the width.
GAIN, NOISE, BRIGHT, WIDTH, RISE = (0.03, 0.3), (2.0, 25.0), (0.25, 0.88), (0.05, 0.16), (0.05, 0.28)
# How far apart spots land on the sensor [px].
WANDER = 8


class Kind(NamedTuple):
    """What belongs to a design beside its grid: crop [px], bits, photon budget, top hat."""

    crop_px: int
    bit_depth: int
    photon_budget: str
    top_hat: bool


def null_set(design: Design, kind: Kind, rng: np.random.Generator) -> tuple[list[Shot], Base, Setting]:
    """Frames of the baseline with random parameters, and the truth as their base."""
    full = 2.0**kind.bit_depth - 1
    gain = float(np.exp(rng.uniform(*np.log(GAIN)))) * (full / 1023)
    sensor = SensorModel(
        gain, float(rng.uniform(*NOISE)), float(rng.uniform(0, 200)), np.inf,
        float(rng.choice([0.0, rng.uniform(3, 40)])), full,
    )  # fmt: skip
    known = design.exposure_s[np.isfinite(design.exposure_s)]
    longest = float(known.max()) if known.size else 1.0
    width = float(rng.uniform(*WIDTH)) * kind.crop_px
    laser = float(rng.choice([0.0, 0.15 * width]))
    baseline = Baseline(laser, kind.photon_budget, kind.top_hat, longest)
    peak = float(rng.uniform(*BRIGHT)) * full / baseline.plateau(1.0)
    exposure = design.exposure_s[design.condition]
    rise = float(rng.uniform(*RISE)) if len(np.unique(exposure)) > 1 else 0.0
    # The faintest condition keeps half of the brightest one's width.
    span = np.log(longest / known.min()) if known.size else 0.0
    p1 = min(rise, 0.5 / max(span, 1e-9)) * (width - laser)
    law: Law | None = Law(p1, width - laser - p1 * np.log(longest), peak)
    if kind.photon_budget == "free":
        amplitude = peak * rng.uniform(0.4, 1.0, len(exposure))
        sigma, law = width * rng.uniform(0.8, 1.2, len(exposure)), None
    else:
        assert law is not None  # given just above
        amplitude = peak * baseline.relative_peak(exposure, law.p1, law.p2)
        sigma = baseline.sigma(exposure, law.p1, law.p2) + 0 * exposure
    middle = (kind.crop_px - 1) / 2
    centre = (middle + rng.uniform(-1, 1, (design.sites, 2)))[design.site]
    base = Base(amplitude, sigma, centre[:, 0], centre[:, 1], law)
    pixel = np.arange(kind.crop_px, dtype=float)
    # Spots land elsewhere on the sensor at every site.
    corner = rng.integers(0, WANDER + 1, (design.sites, 2))[design.site]
    shots = []
    for k in range(len(exposure)):
        (x0, y0), (left, top) = centre[k], corner[k].tolist()
        light = baseline.shape(pixel[None], pixel[:, None], amplitude[k], x0, y0, sigma[k])
        (image,) = frames([light], float(np.nan_to_num(exposure[k])), sensor, [rng])
        shots.append(Shot(None, None, 0, k, (), left, top, partial(np.asarray, image)))
    return shots, base, Setting(baseline, sensor, kind.crop_px, (middle, middle))


def null_look(design: Design, kind: Kind, seed: int, number: int) -> Look:
    """Look at one null set; `number` counts them."""
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(number,))))
    shots, base, setting = null_set(design, kind, rng)
    return look_at(shots, design, base, setting)


def null_statistics(design: Design, kind: Kind, seed: int, number: int) -> dict[str, float]:
    """Statistics of one null set."""
    # Blocks beside the crops are sums of thousands of pixels: by theory their statistic is a normal number.
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(number, 1))))
    look = null_look(design, kind, seed, number)
    own = account(look, ())
    return own.left | likeliest(look, own) | {STATISTIC: float(rng.standard_normal())}


def calibrate(design: Design, kind: Kind, count: int, seed: int, workers: int = 1) -> Null:
    """The null law of a design from `count` null sets."""
    if workers == 1:
        return null_of([null_statistics(design, kind, seed, number) for number in range(count)])
    with ProcessPoolExecutor(workers, initializer=choose, initargs=(chosen(),)) as pool:
        chunk = max(count // (8 * workers), 1)
        work = partial(null_statistics, design, kind, seed)
        return null_of(list(pool.map(work, range(count), chunksize=chunk)))


def stored(folder: Path, design: Design, kind: Kind, count: int, seed: int, workers: int = 1) -> Null:
    """The null law of a design, from `folder`/<digest>/null.nc if it was made before, else made and kept there."""
    design = canonical(design)
    path = folder / digest_of(design, kind, count, seed) / "null.nc"
    if path.exists():
        with store.read(path) as ds:
            numbers = [ds[name].values for name in ("mean", "spread", "skew", "surprise")]
            return Null(tuple(str(v) for v in ds["statistic"].values), *numbers)
    null = calibrate(design, kind, count, seed, workers)
    ds = xr.Dataset(attrs={"title": "law of the statistics without any effect", "dataset": "null sets of the baseline"})
    ds["statistic"] = ("statistic", np.array(null.names, object), {"units": "1", "long_name": "what is judged"})
    for name in ("mean", "spread", "skew"):
        ds[name] = ("statistic", getattr(null, name), {"units": "1", "long_name": f"{name} over the null sets"})
    ds["surprise"] = ("null_set", null.surprise, {"units": "1", "long_name": "largest −log10 p of each null set"})
    path.parent.mkdir(parents=True, exist_ok=True)
    store.write(ds, path, code=provenance.code_digest(__name__))
    return null


def canonical(design: Design) -> Design:
    """The same grid with its frames in one order: a null law depends on the grid, not on what was taken first."""
    at = np.lexsort((design.repeat, design.condition))
    return design.take(at)._replace(order=np.full(len(at), np.nan))


def digest_of(design: Design, kind: Kind, count: int, seed: int) -> str:
    """Digest of all that a null law depends on, the code and the vocabulary included."""
    exposures = np.unique(design.exposure_s, return_inverse=True)[1]
    span = design.exposure_s / np.nanmin(design.exposure_s) if np.isfinite(design.exposure_s).any() else np.zeros(1)
    parts = [design.condition, design.site, design.repeat, design.place, exposures, np.round(span, 6)]
    own = [part.tolist() for part in parts] + [list(kind), count, seed, provenance.code_digest(__name__)]
    # The likeliest effect of the mean is one of the statistics; other effects do not enter any.
    own += [difference] if (difference := record(of_means)) else []
    return hashlib.sha256(json.dumps(own, default=str).encode()).hexdigest()[:16]
