"""The sensor that the chain runs on: data sheet where it speaks, frames where they allow, else unknown with the
reason."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from spotcheck.characterization.by_spots import BySpots, seen_by_spots
from spotcheck.characterization.consistent import SURELY, Told, black_too_high, in_numbers, in_sources, stated, too_long
from spotcheck.characterization.noise_curve import ENDS
from spotcheck.characterization.photon_transfer import Quantity
from spotcheck.crops.full_scale import FullScale
from spotcheck.dataset.folder import Dataset
from spotcheck.dataset.frames import ReducedFrame
from spotcheck.dataset.instrument import DEFAULT, Instrument
from spotcheck.dataset.manifest import KINDS
from spotcheck.io import store
from spotcheck.sensor import ROUNDING_VARIANCE, SensorModel

QUANTITIES = {
    "gain_dn_per_e": ("DN/e-", "overall gain K"),
    "read_noise_e": ("e-", "read noise, rms"),
    "dark_current_e_per_s": ("e-/s", "dark current"),
    "quantum_efficiency": ("1", "quantum efficiency"),
    "full_well_e": ("e-", "full well"),
    "black_level_dn": ("DN", "reading without light"),
    "full_scale_dn": ("DN", "largest reading of the converter"),
    "response_bend": ("1", "bend of the response"),
}

# A dark frame holds light that reads more than the darkest by this part of full scale; less does not matter.
LIT = 1e-3


class Darks(NamedTuple):
    """Level [DN] of each dark frame without light in it; what is wrong with the others ("" if nothing); and the lowest
    level of any frame, spots too [DN]."""

    levels: Sequence[float] = ()
    remark: str = ""
    darkest: float = np.nan


NO_DARKS = Darks()


def level_of(frame: ReducedFrame) -> float:
    """What a frame reads in most of its rows, columns or blocks [DN]: a spot and hot pixels hardly move it."""
    return float(min(np.nanmedian(values) for values in frame))


def judge_darks(darks: Iterable[ReducedFrame], spots: Iterable[ReducedFrame], full_scale_dn: float) -> Darks:
    """Which dark frames are dark. Light only adds to a reading: no frame, beside its spot, reads less than black; and
    a dark frame reads alike all over."""
    found = [(level_of(frame), float(np.nanmean(frame.row_mean))) for frame in darks]
    darkest = min([*(level for level, _ in found), *(level_of(frame) for frame in spots)], default=np.nan)
    good = [level for level, mean in found if max(level, mean) <= darkest + LIT * full_scale_dn]
    if len(good) == len(found):
        return Darks(good, "", darkest)
    brightest = max(mean for _, mean in found)
    lit = f"{len(found) - len(good)} of {len(found)} dark frames hold light"
    why = f"they read up to {brightest:.4g} DN on average, where black is {darkest:.4g} DN at most"
    taken = "that of the others" if good else "not taken from them"
    return Darks(good, f"{lit} ({why}), so the black level is {taken}", darkest)


# Where a number may come from, best first: what a data sheet gives is taken, then what flats and darks show.
SHEET, FLATS, SPOTS = SOURCES = ("data sheet", "flats and darks", "spots")
# Quantity of the chain → that of photon transfer. A full well is never taken from frames: it is an effect to be found.
BY_FLATS = {
    "gain_dn_per_e": "gain",
    "read_noise_e": "dark_noise",
    "dark_current_e_per_s": "dark_current",
    "quantum_efficiency": "quantum_efficiency",
    "full_well_e": "full_well",
    "black_level_dn": "dark_offset",
}
NEVER_TAKEN = ("full_well_e",)
# How spots show a full well; the second where their noise is seen to be gone as well.
SHOWN_BY = ("where the readings of spots gather", "where the readings of spots gather and their noise collapses")


class Found(NamedTuple):
    """A number from one source: value, standard error (NaN: not known), how it came about, and what contradicts it so
    that the next source is asked ("": nothing)."""

    value: float
    stderr: float
    how: str
    refused: str = ""


def resolve(
    dataset: Dataset,
    end: FullScale,
    crops: Iterable[np.ndarray],
    darks: Darks = NO_DARKS,
    measured: Mapping[str, Quantity] | None = None,
    pairs: Mapping[str, Iterable[tuple[np.ndarray, np.ndarray]]] | None = None,
    highest_dn: float = np.nan,
) -> xr.Dataset:
    """Every sensor quantity with its standard error and its source; NaN and the reason where it stays unknown; and what
    every source says, side by side.

    `end` is where readings stop; `measured` is the photon transfer of flats and darks; `pairs` are images [DN] of the
    same pixels by what they are pairs of; `highest_dn` is what any frame reads at most. The attribute `remarks` tells
    what speaks against the dark frames, and which numbers contradict each other.
    """
    given = dataset.instrument
    found = _by_sheet(given)
    remarks = _add_flats(found, dataset, darks, measured or {})
    too_high = black_too_high(dataset.instrument, _told(found, SHEET).get("black_level_dn"), darks.darkest)
    against = [too_high] if too_high else []
    if too_high:
        found["black_level_dn"][SHEET] = found["black_level_dn"][SHEET]._replace(refused=too_high.sentence)
    black = _first(found["black_level_dn"], None).value
    known = None if np.isnan(black) else black
    seen = seen_by_spots(crops, pairs or {}, known, end.reading, given.sensor.response_bend)
    _add_spots(found, seen, np.isnan(black), given.model.top_hat)
    against += in_sources(dataset.instrument, *(_told(found, source) for source in SOURCES))
    gain, level = (
        _first(found["gain_dn_per_e"], None).value,
        _first(found["black_level_dn"], given.sensor.black_level_dn),
    )
    against += in_numbers(dataset, gain, Told(level.value, level.stderr), end.reading, highest_dn)
    refused = {name: own.sentence for own in against for name in own.unknown}
    ds = store.make_grid(dataset).drop_vars([axis.name for axis in dataset.axes if axis.values is not None])
    for name, (units, long_name) in QUANTITIES.items():
        used = _used(name, found[name], getattr(given.sensor, name, None), refused.get(name, ""))
        if name == "full_scale_dn":
            used = Found(float(end.reading), np.nan, end.source)
        if name == "black_level_dn" and remarks:
            used = used._replace(how="; ".join([used.how, *remarks]))
        ds[name] = ((), used.value, {"units": units, "long_name": long_name, "source": used.how})
        ds[f"{name}_stderr"] = ((), used.stderr, {"units": units, "long_name": f"standard error of {long_name}"})
    ds["full_well_e"].attrs["infinite"] = "no pixel is ever full"
    _put_sources(ds, found)
    return store.add_remarks(ds, [*remarks, *(own.sentence for own in against)])


def _by_sheet(instrument: Instrument) -> dict[str, dict[str, Found]]:
    """What the data sheet gives of each quantity."""
    found: dict[str, dict[str, Found]] = {name: {} for name in QUANTITIES}
    for name in QUANTITIES:
        own, source = getattr(instrument.sensor, name, None), instrument.get_source(f"sensor.{name}")
        if source != DEFAULT and own is not None:
            # An error of 0 says that none is stated.
            stderr = getattr(instrument.sensor, f"{name}_stderr", 0.0) or np.nan
            found[name][SHEET] = Found(float(own), stderr, source)
    return found


def _add_flats(
    found: dict[str, dict[str, Found]], dataset: Dataset, darks: Darks, measured: Mapping[str, Quantity]
) -> list[str]:
    """What flats and darks show, and remarks on what they do not."""
    for name, key in BY_FLATS.items():
        own = measured.get(key)
        if own is not None and np.isfinite(own.value):
            # A dark current below 0 by chance is none.
            value = max(own.value, 0.0) if name == "dark_current_e_per_s" else own.value
            found[name][FLATS] = Found(value, own.stderr, "photon transfer of flats and darks")
    current, times = (
        found["dark_current_e_per_s"],
        {
            kind: [own.exposure_s for own in dataset.frames if own.kind == kind and own.exposure_s is not None]
            for kind in KINDS
        },
    )
    if not {FLATS, SHEET} & current.keys() and (why := too_long(times["dark"], times["spot"], "spots")):
        lost = found["read_noise_e"].pop(FLATS, None) or SHEET not in found["black_level_dn"]
        found["black_level_dn"].pop(FLATS, None)
        return [why] if lost else []
    # Without a dark current of its own the black level is what darks read, not what they would at no exposure.
    if len(darks.levels) and (darks.remark or not {FLATS, SHEET} & current.keys()):
        count = len(darks.levels)
        error = float(np.std(darks.levels, ddof=1) / np.sqrt(count)) if count > 1 else np.nan
        how = f"mean of {count} dark frame{'s' if count > 1 else ''}"
        found["black_level_dn"][FLATS] = Found(float(np.mean(darks.levels)), error, how)
    remarks = [darks.remark] if darks.remark and SHEET not in found["black_level_dn"] else []
    if remarks and not len(darks.levels):
        # No dark frame is dark: neither their level nor their noise means anything.
        for name in ("black_level_dn", "dark_current_e_per_s"):
            found[name].pop(FLATS, None)
    if FLATS not in current and SHEET in current and times["dark"]:
        remarks += _without_current(found, dataset.instrument, min(times["dark"]))
    return remarks


def _without_current(found: dict[str, dict[str, Found]], instrument: Instrument, exposure_s: float) -> list[str]:
    """Take the dark current of the data sheet off what the shortest darks read; a remark where they hold less."""
    electrons, gain = (
        found["dark_current_e_per_s"][SHEET].value * exposure_s,
        _first(found["gain_dn_per_e"], None).value,
    )
    level, noise = (found[name].get(FLATS) for name in ("black_level_dn", "read_noise_e"))
    too_much = []
    if level is not None and np.isfinite(gain):
        found["black_level_dn"][FLATS] = level._replace(value=level.value - gain * electrons)
        too_much += [f"a level of {level.value:.4g} DN"] if level.value < gain * electrons else []
    if noise is not None:
        rest = noise.value**2 - electrons
        found["read_noise_e"][FLATS] = noise._replace(value=float(np.sqrt(max(rest, 0.0))))
        too_much += [f"a noise of {noise.value:.4g} e-"] if rest < -SURELY * 2 * noise.value * noise.stderr else []
    if not too_much:
        return []
    for name in ("black_level_dn", "read_noise_e"):
        found[name].pop(FLATS, None)
    return [
        f"{stated(instrument, 'dark_current_e_per_s', electrons / exposure_s)}, which is {electrons:.4g} e- in"
        f" darks of {exposure_s:g} s, but these have {' and '.join(too_much)} only"
    ]


def _told(found: Mapping[str, Mapping[str, Found]], source: str) -> dict[str, Told]:
    """What one source says of each quantity."""
    return {name: Told(own[source].value, own[source].stderr) for name, own in found.items() if source in own}


def _put_sources(ds: xr.Dataset, found: Mapping[str, Mapping[str, Found]]) -> None:
    """What every source says, side by side."""
    ds["source"] = ("source", np.array(SOURCES, object), {"units": "1", "long_name": "where a number comes from"})
    for name, (units, long_name) in QUANTITIES.items():
        table = np.array([found[name].get(source, (np.nan, np.nan))[:2] for source in SOURCES])
        ds[f"{name}_by"] = ("source", table[:, 0], {"units": units, "long_name": f"{long_name} by each source"})
        ds[f"{name}_by_stderr"] = (
            "source", table[:, 1], {"units": units, "long_name": f"standard error of {long_name} by each source"},
        )  # fmt: skip


def _first(found: Mapping[str, Found], default: float | None) -> Found:
    """What the best source that nothing contradicts says, else the default; where there is one, and the chain needs a
    number, what was contradicted comes before it."""
    for source in SOURCES:
        if source in found and not found[source].refused:
            return found[source]
    if found and default is not None:
        best = next(found[source] for source in SOURCES if source in found)
        return best._replace(how=f"{best.how}, though frames contradict it: nothing else tells it")
    return Found(np.nan if default is None else float(default), np.nan, DEFAULT)


def _used(name: str, found: Mapping[str, Found], default: float | None, refused: str) -> Found:
    """The number that the chain runs on; unknown where a contradiction has it `refused`."""
    if name in NEVER_TAKEN:
        return Found(np.inf, np.nan, refused) if refused else found.get(SHEET) or Found(np.inf, np.nan, "none given")
    if refused and name != "black_level_dn":
        return Found(np.nan, np.nan, f"unknown: {refused}")
    own = _first(found, default)
    if np.isnan(own.value):
        return own._replace(
            how="unknown: not in instrument.yaml, no flats and darks in pairs, and no frame shows noise that grows with"
            " its light"
        )
    return own


def _add_spots(found: dict[str, dict[str, Found]], seen: BySpots, no_black: bool, top_hat: bool) -> None:
    """What spots show, in electrons of the gain that is taken. Where the light itself has a plateau, readings that
    gather say nothing of the sensor unless their noise is gone."""
    if seen.gain is not None:
        # What texture could be there unseen counts as gain.
        error = max(seen.gain.gain_stderr, (seen.gain.gain - seen.gain.low) / ENDS)
        found["gain_dn_per_e"][SPOTS] = Found(seen.gain.gain, error, seen.how)
    gain = _first(found["gain_dn_per_e"], None)
    if np.isnan(gain.value):
        return
    relative = np.nan_to_num(gain.stderr) / gain.value
    if seen.stop is not None and (seen.collapses or not top_hat):
        level, error = np.array(seen.stop) / gain.value
        stderr = float(np.hypot(error, level * relative))
        found["full_well_e"][SPOTS] = Found(float(level), stderr, SHOWN_BY[seen.collapses])
    if seen.gain is not None:
        floor, floor_error = max(seen.gain.floor - ROUNDING_VARIANCE, 0.0), seen.gain.floor_stderr
        noise = float(np.sqrt(floor)) / gain.value
        # σ = √floor/K: a floor of 0 within its error leaves a noise of 0 with the error of √floor_stderr.
        error = min(floor_error / (2 * np.sqrt(floor)) if floor > 0 else np.inf, np.sqrt(floor_error)) / gain.value
        if no_black:
            # What dark pixels read may be the black level, or light with shot noise of its own.
            least = max(floor - gain.value * max(seen.level_dn, 0.0), 0.0)
            error = float(np.hypot(error, noise - np.sqrt(least) / gain.value))
        found["read_noise_e"][SPOTS] = Found(noise, float(np.hypot(error, noise * relative)), seen.how)


def spots_in_electrons(seen: BySpots) -> dict[str, Found]:
    """What spots alone show of the sensor, where no black level is known: nothing where they show no gain."""
    found: dict[str, dict[str, Found]] = {name: {} for name in QUANTITIES}
    _add_spots(found, seen, True, False)
    return {name: own[SPOTS] for name, own in found.items() if SPOTS in own}


def stderr_of(ds: xr.Dataset) -> tuple[float, float, float]:
    """Standard errors of gain, read noise and black level of a sensor file; 0 where none is known."""
    gain, noise, black = (float(np.nan_to_num(ds[f"{name}_stderr"])) for name in
                          ("gain_dn_per_e", "read_noise_e", "black_level_dn"))  # fmt: skip
    return gain, noise, black


def known_beforehand(ds: xr.Dataset) -> tuple[str, ...]:
    """Which of gain, read noise and black level of a sensor file frames of spots were not needed for."""
    names = ("gain_dn_per_e", "read_noise_e", "black_level_dn")
    return tuple(name for name in names if np.isfinite(ds[f"{name}_by"].sel(source=[SHEET, FLATS])).any())


def model_of(ds: xr.Dataset) -> SensorModel | None:
    """Sensor model of a sensor file; None where gain or read noise is unknown."""
    numbers = {name: float(ds[name]) for name in QUANTITIES}
    if not np.isfinite(numbers["gain_dn_per_e"]) or not np.isfinite(numbers["read_noise_e"]):
        return None
    return SensorModel(**numbers)
