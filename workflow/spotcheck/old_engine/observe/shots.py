"""The frames that a verdict looks at: what each is, which of them choose the model and which are kept to test it."""

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck import store
from spotcheck.crops import usable
from spotcheck.dataset import Dataset
from spotcheck.frames import BLOCK_PX
from spotcheck.manifest import number_in
from spotcheck.old_engine.observe.design import Design


class Blocks(NamedTuple):
    """Means [block row, block column] in DN of the square blocks of a whole frame, and their side [px]."""

    mean: np.ndarray
    side: int


class Shot(NamedTuple):
    """One spot frame: fibre angle [deg] and exposure [s] (None: not recorded), repeat, place in the order of
    acquisition (None: unknown), other conditions, where its crop lies on the sensor [px], and its pixels [row,
    column] in DN, NaN where masked; what the whole frame reads (None: not kept)."""

    angle_deg: float | None
    exposure_s: float | None
    repeat: int
    order: int | None
    conditions: tuple[float | None, ...]
    left: int
    top: int
    pixels: Callable[[], np.ndarray]
    beside: Callable[[], Blocks] | None = None


def pose_of(shot: Shot) -> tuple[float, ...]:
    """All of a shot's condition but its exposure: fibre angle [deg] and declared conditions, NaN where not recorded."""
    return or_nan(shot.angle_deg), *map(or_nan, shot.conditions)


def design_of(shots: Sequence[Shot]) -> Design:
    """The design that a list of frames spans."""
    keys = [(*pose_of(s), or_nan(s.exposure_s)) for s in shots]
    _, condition = keys_and_numbers(keys)
    _, site = keys_and_numbers([(key[:-1], s.repeat) for key, s in zip(keys, shots, strict=True)])
    known = [s.order for s in shots if s.order is not None]
    span = max(known) - min(known) if len(known) == len(shots) and len(known) > 1 else 0
    # A span says that the order of all is known.
    order = np.array([((s.order or 0) - min(known)) / span if span else np.nan for s in shots])
    angle, exposure = (np.array([key[at] for key in keys], float) for at in (0, -1))
    return Design(site, condition, angle, exposure, order, np.array([repr(pose_of(s)) for s in shots]))


def held_out(repeat: np.ndarray) -> np.ndarray:
    """Which frames are kept unseen until the model stands: of six repeats or more every third, else none."""
    values = np.unique(repeat)
    if len(values) < 6:
        return np.zeros(len(repeat), bool)
    return np.isin(repeat, values[2::3])


def or_nan(value: float | None) -> float:
    """A number, NaN where it is not known."""
    return np.nan if value is None else float(value) + 0.0  # no minus zero


def keys_and_numbers(keys: list) -> tuple[list, np.ndarray]:
    """Distinct keys in ascending order, and the number of each; NaN equals NaN."""
    texts = [repr(key) for key in keys]
    distinct = sorted(dict(zip(texts, keys, strict=True)).items(), key=lambda item: (_sortable(item[1]), item[0]))
    number = {text: k for k, (text, _) in enumerate(distinct)}
    return [key for _, key in distinct], np.array([number[text] for text in texts])


def _sortable(key) -> tuple:
    flat = [part for piece in key for part in (piece if isinstance(piece, tuple) else (piece,))]
    return tuple(-1e300 if np.isnan(v) else v for v in flat)


def shots_of(dataset: Dataset, crops: xr.Dataset) -> list[Shot]:
    """Every usable spot frame of a dataset, from its crops around the light; pixels are read when asked for."""
    images = crops["image"].sel(centring="light")
    left, top, status = (crops[name].sel(centring="light") for name in ("left", "top", "status"))
    place = {id(frame): k for k, frame in enumerate(dataset.spots)}
    dims = store.grid_dims(crops)
    side = min(BLOCK_PX, crops.sizes["row"], crops.sizes["column"])
    out = []
    for index, frame in dataset.cells():
        at = dict(zip(dims, index, strict=True))
        if not usable(status.isel(at)):
            continue
        conditions = tuple(number_in(frame.extra[name]) for name in dataset.instrument.conditions)
        out.append(
            Shot(
                frame.angle_deg,
                frame.exposure_s,
                frame.repeat or 0,
                place[id(frame)] if dataset.instrument.order_known else None,
                conditions,
                int(left.isel(at)),
                int(top.isel(at)),
                partial(_pixels, images, at),
                partial(_blocks, crops["block_mean"], at, side),
            )
        )
    return sorted(out, key=lambda shot: -1 if shot.order is None else shot.order)


def left_out(dataset: Dataset, crops: xr.Dataset) -> str:
    """How many spot frames cannot be looked at, and why; "" where all can."""
    total = len(dataset.spots)
    if not total:
        return "the manifest names no spot frame, and flats and darks are judged by `spotcheck flats`"
    status, dims = crops["status"].sel(centring="light"), store.grid_dims(crops)
    flags = [int(status.isel(dict(zip(dims, index, strict=True)))) for index, _ in dataset.cells()]
    reasons = Counter(text for own in flags for bit, (_, text) in store.STATUS.items() if own & bit & store.UNUSABLE)
    if not reasons:
        return ""
    count = sum(not usable(own) for own in flags)
    whole = f"none of {total} spot frames can" if count == total else f"{count} of {total} spot frames cannot"
    whole = "the only spot frame cannot" if total == 1 else whole
    parts = [text if len(reasons) == 1 else f"{number}: {text}" for text, number in reasons.items()]
    return f"{whole} be used ({'; '.join(parts)})"


def together(shots: Sequence[Shot], crop_px: int) -> tuple[list[Shot], str]:
    """The frames of each site that look at one place, and how many others there are ("" if none).

    Frames of a site whose crops lie more than half a crop apart do not show the same spot: something else was brighter.
    Most frames count; of as many, those with the longest exposure.
    """
    sites: dict[str, list[Shot]] = {}
    for shot in shots:
        sites.setdefault(repr((shot.angle_deg, shot.conditions, shot.repeat)), []).append(shot)
    keep: set[int] = set()
    for own in sites.values():
        groups = [[s for s in own if max(abs(s.left - a.left), abs(s.top - a.top)) <= crop_px / 2] for a in own]
        best = max(groups, key=lambda group: (len(group), max(s.exposure_s or 0.0 for s in group)))
        keep |= {id(s) for s in best}
    out = [shot for shot in shots if id(shot) in keep]
    astray = len(shots) - len(out)
    why = f"{astray} of {len(shots)} spots lie more than half a crop from where their site has its others"
    return out, why if astray else ""


def parted(shots: Sequence[Shot]) -> tuple[np.ndarray, np.ndarray]:
    """Frames that may choose the model, and those that are kept unseen: whole sites."""
    out = held_out(np.array([shot.repeat for shot in shots]))
    return np.flatnonzero(~out), np.flatnonzero(out)


def never_chose(shots: Sequence[Shot]) -> str:
    """Which frames stand for conditions of which all are kept unseen; "" where there is none."""
    (own, out), condition = parted(shots), design_of(shots).condition
    count = int(np.sum(~np.isin(condition[out], condition[own])))
    which = f"{count} frames belong" if count > 1 else "1 frame belongs"
    told = f"{which} to conditions of which every frame is kept unseen: they may test a model, but did not choose it"
    return told if count else ""


def _pixels(images: xr.DataArray, at: dict[str, int]) -> np.ndarray:
    return images.isel(at).values


def _blocks(means: xr.DataArray, at: dict[str, int], side: int) -> Blocks:
    return Blocks(means.isel(at).values.astype(float), side)
