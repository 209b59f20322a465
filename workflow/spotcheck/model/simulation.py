"""The simulate stage: write a dataset folder of random frames and a file of mean images, both from a model.

The paper's model, the baseline without effects, is simulated at its calibrated parameters. The extended model, which
adds effects, is simulated as its model.yaml says. With an exposure law, peak and width of a spot follow from the
exposure; without one each spot has its own. The folder keeps the dataset contract, so that simulated frames pass the
same stages as measured ones. A cell is a tuple of indices on the grid of the dataset: angle, exposure, repeat and
declared conditions.
"""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tifffile
import xarray as xr
import yaml

from spotcheck.crops import spotfinding
from spotcheck.dataset.folder import Dataset
from spotcheck.errors import InputError
from spotcheck.io import progress, store
from spotcheck.model.baseline import Baseline, build_baseline
from spotcheck.model.conditions import FrameConditions, PixelGrid, SpotState, crop_grid
from spotcheck.model.forward import ForwardModel, RandomStreams
from spotcheck.model.light_shape import LIGHT
from spotcheck.model.model_file import ExtendedModel, Site, Spot, check_bounds, scales_of, site_of
from spotcheck.model.stage import Stage
from spotcheck.sensor import SensorModel

# All simulated frames, one page each, in the order of the manifest.
STACK = "frames/simulated.tif"
# Frames are larger than the crop by this factor, so that a crop at a maximum anywhere on the plateau stays inside.
CANVAS = 2

# Cell of each frame → peak and width of its spot.
SpotStates = Mapping[tuple[int, ...], SpotState]
# Name → definition of each variable of the file of mean images.
Variables = Mapping[str, store.Variable]

# Variables for the paper's model.
VARIABLES = {
    "mean_light": store.Variable(("y", "x"), "f4", "DN", "mean light of the simulated spot"),
    "amplitude": store.Variable((), "f8", "DN", "peak of the Gaussian before the top hat"),
    "sigma": store.Variable((), "f8", "pixel", "sigma_g, standard deviation of the Gaussian"),
}

# Variables for the extended model.
EXTENDED_VARIABLES = VARIABLES | {
    "mean_light": store.Variable(("y", "x"), "f4", "DN", "mean light of the extended model; NaN beyond the frame"),
    "mean_reading": store.Variable(("y", "x"), "f4", "DN", "mean reading of the extended model; NaN beyond the frame"),
    "left": store.Variable((), "i4", "pixel", "column of the sensor under column 0 of the crop"),
    "top": store.Variable((), "i4", "pixel", "row of the sensor under row 0 of the crop"),
}


class SimulatedFrame(NamedTuple):
    """A frame to simulate: its model, its conditions, and peak and width of its spot."""

    model: ForwardModel  # model that the frame follows
    conditions: FrameConditions  # conditions at which the model is evaluated
    spot: SpotState  # peak and width for the file of mean images; the peak is NaN for a frame without a usable spot

    def values(self, side: int, variables: Variables) -> dict[str, Any]:
        """Return the values of `variables` for the file of mean images, by name.

        Images are crops [y, x] in DN of `side` px around the spot, NaN beyond the frame.
        """
        model, spot = self.model, self.spot
        frame = self._near_spot(side)
        pixels, column, row = frame.pixels, round(frame.x0), round(frame.y0)
        # Row and column of the spot in the array of the pixels that are evaluated.
        centre = spotfinding.Spot(row - int(pixels.y[0, 0]), column - int(pixels.x[0, 0]), exists=True)
        light = np.broadcast_to(model.light(frame).total, (pixels.y.size, pixels.x.size))
        crop = spotfinding.cut_crop(light, centre, side)
        values: dict[str, Any] = {"mean_light": crop, "amplitude": spot.peak_dn, "sigma": spot.sigma_px}
        if "mean_reading" in variables:
            reading = spotfinding.cut_crop(model.expected(frame).mean, centre, side)
            values |= {"mean_reading": reading, "left": column - side // 2, "top": row - side // 2}
        return values

    def _near_spot(self, side: int) -> FrameConditions:
        """Return the conditions for only those pixels of the frame that lie in the crop, of `side` px, around the spot.

        All rows remain if light is smeared along columns, since the smear is a sum over them.
        """
        frame, pixels = self.conditions, self.conditions.pixels
        first_column, first_row = round(frame.x0) - side // 2, round(frame.y0) - side // 2
        x = pixels.x[:, (pixels.x[0] >= first_column) & (pixels.x[0] < first_column + side)]
        is_in_crop = (pixels.y[:, 0] >= first_row) & (pixels.y[:, 0] < first_row + side)
        y = pixels.y if self.model.steps_at(Stage.SMEAR) else pixels.y[is_in_crop]
        return replace(frame, pixels=replace(pixels, x=x, y=y))


@dataclass(frozen=True)
class Destination:
    """Files of a simulation: their paths and provenance, and how they are written."""

    folder: Path  # dataset folder of the simulated frames
    path: Path  # file of mean images
    seed: int  # seed of all random numbers
    code: str  # digest of the code that simulates
    inputs: Sequence[str | Path]  # files that the simulation depends on

    def write_frames(
        self, dataset: Dataset, frames: Iterable[SimulatedFrame], variables: Variables, attributes: Mapping[str, Any]
    ) -> None:
        """Draw the frames, one for each spot frame of the dataset; write their stack and the file of mean images.

        `frames` are in the order of the manifest. `variables` and `attributes` are those of the file of mean images.
        Equal frames and seeds give equal files.
        """
        side = dataset.instrument.crop_px
        extra = xr.Dataset(attrs={"seed": self.seed, **attributes})
        for name, text in (("y", "row of the crop"), ("x", "column of the crop")):
            extra[name] = (name, np.arange(side, dtype="i4"), {"units": "pixel", "long_name": text})
        # Site → its number, in the order of first appearance.
        sites: dict[Site, int] = {}
        frames = progress.track(frames, "simulating frames", len(dataset.spots))
        with (
            store.frame_writer(self.path, dataset, extra, variables, code=self.code, inputs=self.inputs) as writer,
            store.write_with_sidecar(self.folder / STACK) as scratch,
            tifffile.TiffWriter(scratch) as stack,
        ):
            for number, (frame, (cell, manifest_row)) in enumerate(zip(frames, dataset.cells(), strict=True)):
                # Frames of a site at different exposures share its random numbers.
                key = site_of(manifest_row, dataset.instrument.conditions, has_law=True)
                site = sites.setdefault(key, len(sites))
                readings = frame.model.sample(frame.conditions, RandomStreams(self.seed, number, site))
                stack.write(readings, compression="zlib", contiguous=False, metadata=None, software="")
                writer.put(cell, frame.values(side, variables))

    def write_contract(self, dataset: Dataset, sections: Mapping[str, Any]) -> None:
        """Write manifest.csv with the spot frames of the dataset, and instrument.yaml with `sections` of keys."""
        columns = ["file", "page", "kind", "angle_deg", "exposure_s", "repeat", *dataset.instrument.conditions]
        table = io.StringIO()
        writer = csv.DictWriter(table, columns, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        for page, frame in enumerate(dataset.spots):
            writer.writerow({**vars(frame), **frame.extra, "file": STACK, "page": page})
        store.write_text(self.folder / "manifest.csv", table.getvalue())
        content = {"name": f"{dataset.title} (simulated)", "crop_px": dataset.instrument.crop_px}
        keys = _without_missing({**content, "conditions": list(dataset.instrument.conditions), **sections})
        store.write_text(self.folder / "instrument.yaml", yaml.safe_dump(keys, sort_keys=False))


def _without_missing(keys: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of instrument.yaml and of its sections whose values are neither None nor infinite nor empty."""
    # Sections first, as they may become empty.
    cleaned = {key: _without_missing(value) if isinstance(value, dict) else value for key, value in keys.items()}
    return {key: value for key, value in cleaned.items() if value not in (None, np.inf, [], {})}


class NoiseFreeModel(ForwardModel):
    """A forward model for a sensor whose gain or read noise is unknown: readings are the rounded mean light."""

    def sample(self, frame: FrameConditions, streams: RandomStreams) -> np.ndarray:
        """Return the frame [row, column] in DN (uint16); `streams` is not used."""
        return np.clip(np.rint(self.light(frame).total), 0, self.sensor.full_scale_dn).astype(np.uint16)


def simulate(
    dataset: Dataset,
    states: SpotStates,
    sensor: SensorModel | None,
    full_scale: int,
    destination: Destination,
    attributes: Mapping[str, str],
) -> None:
    """Simulate the paper's model: write the dataset folder, and the mean images [grid, y, x] around the spots.

    Parameters
    ----------
    dataset : Dataset
        Measured dataset whose spot frames are simulated.
    states : mapping of tuple of int to SpotState
        Peak and width of the spot of each frame by cell; the peak is NaN for a frame without a usable spot.
    sensor : SensorModel or None
        The camera. Without it frames are the rounded mean image, which the attribute `noise` says.
    full_scale : int
        Largest reading [DN].
    destination : Destination
        Files to write.
    attributes : mapping of str to str
        Further attributes of the file of mean images.
    """
    # The paper's model has no learned light shape.
    baseline = replace(build_baseline(dataset.instrument, dataset.exposures), learned=None)
    noise_free = SensorModel(gain_dn_per_e=1.0, read_noise_e=0.0, full_scale_dn=full_scale)
    model = ForwardModel(baseline, sensor) if sensor else NoiseFreeModel(baseline, noise_free)
    attributes = {"noise": "drawn" if sensor else "none: gain or read noise of the sensor is unknown", **attributes}
    destination.write_frames(dataset, _baseline_frames(dataset, states, model), VARIABLES, attributes)
    destination.write_contract(dataset, {"sensor": {"bit_depth": full_scale.bit_length()}})


def _baseline_frames(dataset: Dataset, states: SpotStates, model: ForwardModel) -> Iterator[SimulatedFrame]:
    """Yield every frame of the paper's model in the order of the manifest, with its spot in the middle of the frame.

    Frames are `CANVAS` times as large as a crop. `states` has peak and width of each spot by cell.
    """
    side = CANVAS * dataset.instrument.crop_px
    grid, middle = crop_grid(range(side), range(side), side, side), side // 2
    for cell, manifest_row in dataset.cells():
        # A frame without a usable spot is simulated as one without light.
        spot = states[cell] if np.isfinite(states[cell].peak_dn) else SpotState(peak_dn=0.0, sigma_px=1.0)
        # Without a law peak and width are given, and the exposure counts for the dark current only: the longest and the
        # reference exposure are not used.
        exposure_s = manifest_row.exposure_s or 0.0
        conditions = FrameConditions(grid, middle, middle, exposure_s, longest_s=1.0, reference_s=1.0, **asdict(spot))
        yield SimulatedFrame(model, conditions, states[cell])


def simulate_extended(
    dataset: Dataset, model: ExtendedModel, sensor: SensorModel, destination: Destination, name: str
) -> None:
    """Simulate the extended model: write the dataset folder, and the expected crop around each spot [grid, y, x].

    Expected values are means over everything that is random. Frames are the window of the sensor that contains all
    spots with a margin of one crop on every side, or the whole sensor if that is smaller. `name` is the name of the
    model file, for messages. Raises `InputError` for a model that does not fit the instrument or the design.
    """
    if not dataset.exposures:
        # As in the verdict: without exposures the dark signal is unknown.
        sensor = replace(sensor, dark_current_e_per_s=0.0)
    forward = ForwardModel(build_baseline(dataset.instrument, dataset.exposures), sensor, model.law, model.effects)
    check_model(dataset, model, forward.baseline, sensor, name)
    spots, side = _spots_of_frames(dataset, model), dataset.instrument.crop_px
    # Positions remain those of the whole sensor, to which pedestals, fringes and smear refer.
    columns = _window([spot.x_px for spot in spots], side, model.columns)
    rows = _window([spot.y_px for spot in spots], side, model.rows)
    frames = _extended_frames(dataset, model, forward, spots, crop_grid(columns, rows, model.columns, model.rows), name)
    effects = " ".join(applied.effect.name for applied in model.effects) or "none"
    attributes = {"noise": "drawn", "effects": effects, "window_left_px": columns.start, "window_top_px": rows.start}
    destination.write_frames(dataset, frames, EXTENDED_VARIABLES, attributes)
    destination.write_contract(dataset, _simulated_instrument(dataset, sensor))
    if (profile := dataset.instrument.light.profile) is not None:
        (destination.folder / LIGHT).write_bytes(Path(profile).read_bytes())


def check_model(dataset: Dataset, model: ExtendedModel, baseline: Baseline, sensor: SensorModel, name: str) -> None:
    """Raise `InputError` if a model does not fit the instrument or the design; `name` is the name of its file.

    It fits if there are spot frames, if the photon budget is not "free" beside an exposure law, if a crop is not larger
    than the frame, and if parameters of effects are within their bounds.
    """
    budget, crop = baseline.photon_budget, dataset.instrument.crop_px
    if not dataset.spots:
        raise InputError("manifest.csv: has no frame of kind spot; there is nothing to simulate")
    if model.law is not None and budget == "free":
        raise InputError(f"{name}: has a law, which the photon budget free of this dataset cannot take")
    if crop > min(model.rows, model.columns):
        raise InputError(f"{name}: the frame has {model.columns} × {model.rows} px, but crop_px is {crop}")
    check_bounds(model, scales_of(model, baseline, sensor, crop, dataset.exposures), name)


def _spots_of_frames(dataset: Dataset, model: ExtendedModel) -> list[Spot]:
    """Return the spot of every spot frame in the order of the manifest, in px of the sensor.

    A spot that the model does not know is at the mean position of the known ones, or else in the middle of the sensor.
    It has no peak or width.
    """
    centres = [(spot.x_px, spot.y_px) for spot in model.spots.values()]
    unknown = Spot(*np.mean(centres or [((model.columns - 1) / 2, (model.rows - 1) / 2)], axis=0))
    sites = (site_of(frame, dataset.instrument.conditions, model.law is not None) for frame in dataset.spots)
    return [model.spots.get(site, unknown) for site in sites]


def _window(centres_px: Sequence[float], side: int, pixels: int) -> range:
    """Return the range of pixels along one axis that holds all centres with a margin of `side` [px] on both ends.

    It ends at the edges of the sensor, which has `pixels` along the axis, and has at least `side` pixels.
    """
    low = int(np.clip(np.floor(min(centres_px)) - side, 0, pixels - side))
    return range(low, int(np.clip(np.ceil(max(centres_px)) + side + 1, low + side, pixels)))


def _extended_frames(
    dataset: Dataset, extended: ExtendedModel, model: ForwardModel, spots: Sequence[Spot], grid: PixelGrid, name: str
) -> Iterator[SimulatedFrame]:
    """Yield every frame of the extended model; raises `InputError` for a negative peak or a width not above 0.

    `spots` has the spot of each frame, `grid` the pixels to simulate; `name` is the name of the model file.
    """
    last = len(spots) - 1
    for number, (manifest_row, spot) in enumerate(zip(dataset.spots, spots, strict=True)):
        conditions = FrameConditions(
            pixels=grid,
            x0=float(spot.x_px),
            y0=float(spot.y_px),
            # Exposures that were not recorded count as one second, and an unknown order as its middle, as in the
            # verdict.
            exposure_s=1.0 if manifest_row.exposure_s is None else manifest_row.exposure_s,
            longest_s=extended.longest_s,
            reference_s=extended.reference_s,
            angle=float(np.deg2rad(manifest_row.angle_deg or 0.0)),
            order=number / last if dataset.instrument.order_known and last else 0.5,
            # Used only without a law; a frame without a usable spot is then simulated as one without light.
            peak_dn=float(spot.peak_dn or 0.0),
            sigma_px=float(spot.sigma_px or 1.0),
        )
        # The model's own learned shape replaces that of the instrument.
        learned = extended.light_of(spot) or model.baseline.learned
        frame_model = replace(model, baseline=replace(model.baseline, learned=learned))
        state = frame_model.spot(conditions)
        peak, width = state.peak_dn, state.sigma_px
        if not (0 <= peak < np.inf and 0 < width < np.inf):
            raise InputError(
                f"{name}: gives {manifest_row.label} peak {peak:g} DN and width {width:g} px; the width must be above"
                " 0, and the peak 0 or more"
            )
        yield SimulatedFrame(frame_model, conditions, state)


def _simulated_instrument(dataset: Dataset, sensor: SensorModel) -> dict[str, Any]:
    """Return the sections of instrument.yaml with which the extended model was simulated, for later analysis.

    They are those of the dataset, with the values of `sensor`. None stands for keys that are not written.
    """
    instrument, full_scale = dataset.instrument, int(sensor.full_scale_dn)
    bit_depth = full_scale.bit_length()
    keys = {"pixel_pitch_m": instrument.sensor.pixel_pitch_m, "bit_depth": bit_depth} | asdict(sensor)
    # Stated only if it is below the end of the range of the bit depth.
    keys["full_scale_dn"] = full_scale if full_scale < 2**bit_depth - 1 else None
    sections = {name: asdict(getattr(instrument, name)) for name in ("optics", "laser", "material", "model")}
    light = {"profile": instrument.light.profile and LIGHT}
    return {"order_known": instrument.order_known, "sensor": keys, **sections, "light": light}
