"""Small spot frames drawn with numpy alone: code that makes test data shares nothing with the code that explains it.

Frames are crops of a sensor of `SENSOR_SIDE` px. Each spot is a Gaussian whose peak and width follow the exposure t:
σ = P1 ln(t / 1 s) + P2 and peak ∝ t/σ², unless a test states other peaks and widths.
"""

from dataclasses import dataclass, replace

import numpy as np

# Sides of a crop and of the sensor [px].
SIDE, SENSOR_SIDE = 72, 100
# Gain [DN/e-], read noise [e-], black level and largest reading [DN] of a camera with 10 bit.
GAIN, READ_NOISE_E, BLACK, FULL_SCALE = 0.11, 6.0, 12.0, 1023.0
# Exposures [s], fibre angles [deg] and number of repeats of a usual set of frames.
EXPOSURES_S, ANGLES_DEG, REPEATS = (1e-4, 3e-4, 9e-4), (0.0, 45.0, 90.0, 135.0), 2
# Law of the width [px], 5.6 … 7.2 px over these exposures, and peak at the longest exposure [DN].
P1, P2, PEAK = 0.728, 12.306, 700.0
# Standard errors of ln peak, ln σ and centre [px] in drawn numbers, about those of such frames, and the correlation of
# ln peak and ln σ.
PEAK_ERROR, SIGMA_ERROR, CENTRE_ERROR, CORRELATION = 2e-3, 1.5e-3, 1e-2, -0.7
# Largest distance of a centre from the middle of its crop, and largest shift of a crop on the sensor [px].
CENTRE_SPREAD, CROP_SHIFT = 2.0, 5


@dataclass(frozen=True)
class Conditions:
    """Conditions of F frames; all frames of an angle and a repeat have one site."""

    exposure_s: np.ndarray  # exposure [frame, s]
    angle: np.ndarray  # angle of the fibres [frame, rad]
    order: np.ndarray  # place in the order of acquisition, from 0 to 1 [frame]
    repeat: np.ndarray  # repeat [frame]
    site: np.ndarray  # number of the site [frame]
    condition: np.ndarray  # number of the exposure [frame]

    def __len__(self) -> int:
        return len(self.site)


@dataclass(frozen=True)
class DrawnLight:
    """Light of the drawn spots."""

    ratio: float = 1.0  # long axis over short axis of an ellipse of unchanged area
    direction_deg: float = 0.0  # direction of its long axis, from +x towards +y [deg]
    pedestal_dn: float = 0.0  # uniform light below the spot [DN]
    speckle_contrast: float = 0.0  # relative standard deviation of a field that is new at each site
    grain_px: float = 1.0  # its grain: the correlation is exp(−d²/2 grain²) [px]
    # Stripes of the light: relative depth, period [px], direction across them [deg], and whether their phase is drawn
    # for each site or is 0 at pixel (0, 0) of the sensor.
    stripes: tuple[float, float, float] = (0.0, 1.0, 0.0)
    has_new_stripes: bool = True


@dataclass(frozen=True)
class DrawnCamera:
    """Camera that reads the drawn frames."""

    read_noise_e: float = READ_NOISE_E  # [e-]
    black_dn: float = BLACK  # black level [DN]
    row_dn: float = 0.0  # standard deviation of an offset of each row, new in each frame [DN]
    clip_dn: float = np.inf  # level at which the charge stops, in front of the read noise [DN]
    bend: float = 0.0  # q of a response y − q y²/full scale
    gain_scatter: float = 0.0  # relative standard deviation of the gains of pixels
    hot_pixels: tuple[tuple[int, int, float], ...] = ()  # (row, column, offset [DN]) on the sensor


@dataclass(frozen=True)
class DrawnFrames:
    """Drawn frames with their truth."""

    readings: np.ndarray  # [frame, row, column] DN
    left: np.ndarray  # column of the sensor under column 0 of each crop [frame]
    top: np.ndarray  # row of the sensor under row 0 [frame]
    conditions: Conditions  # of the frames
    peak_dn: np.ndarray  # peak of the Gaussian [frame, DN]
    sigma_px: np.ndarray  # its width [frame, px]
    x: np.ndarray  # column of its centre on the sensor [frame, px]
    y: np.ndarray  # row of its centre [frame, px]

    def select(self, frames: np.ndarray) -> "DrawnFrames":
        """Return some of the frames."""
        parts = {name: values[frames] for name, values in vars(self).items() if name != "conditions"}
        conditions = Conditions(**{name: values[frames] for name, values in vars(self.conditions).items()})
        return replace(self, conditions=conditions, **parts)


def lay_out(exposures_s=EXPOSURES_S, angles_deg=ANGLES_DEG, repeats: int = REPEATS) -> Conditions:
    """Return the conditions of one frame for each exposure, angle and repeat, taken in a random order."""
    repeat, angle, exposure = (index.ravel() for index in np.mgrid[:repeats, : len(angles_deg), : len(exposures_s)])
    count = len(repeat)
    # A fixed seed: the order is part of the design, not of what is drawn.
    order = np.random.default_rng(11).permutation(count) / max(count - 1, 1)
    return Conditions(
        exposure_s=np.array(exposures_s)[exposure],
        angle=np.deg2rad(angles_deg)[angle],
        order=order,
        repeat=repeat,
        site=repeat * len(angles_deg) + angle,
        condition=exposure,
    )


def follow_law(conditions: Conditions) -> tuple[np.ndarray, np.ndarray]:
    """Return peak [frame, DN] and width [frame, px] of the law of the exposure."""
    sigma_px = P1 * np.log(conditions.exposure_s) + P2
    strength = conditions.exposure_s / sigma_px**2
    return PEAK * strength / strength.max(), sigma_px


def draw_frames(
    seed: int,
    conditions: Conditions,
    light: DrawnLight = DrawnLight(),
    camera: DrawnCamera = DrawnCamera(),
    peak_factor: np.ndarray | float = 1.0,
) -> DrawnFrames:
    """Draw frames at random.

    Parameters
    ----------
    seed : int
        Seed of all random numbers.
    conditions : Conditions
        Conditions of the frames.
    light, camera : DrawnLight, DrawnCamera
        Departures from round spots and a plain camera.
    peak_factor : array [frame] or float
        Factor on the peaks of the law.
    """
    rng = np.random.default_rng(seed)
    sites = int(conditions.site.max()) + 1
    middle = (SENSOR_SIDE - SIDE) // 2
    corners = middle + rng.integers(-CROP_SHIFT, CROP_SHIFT + 1, (sites, 2))
    centres = corners + (SIDE - 1) / 2 + rng.uniform(-CENTRE_SPREAD, CENTRE_SPREAD, (sites, 2))
    gains = 1 + camera.gain_scatter * rng.standard_normal((SENSOR_SIDE, SENSOR_SIDE))
    grains = [1 + light.speckle_contrast * draw_field(rng, light.grain_px) for _ in range(sites)]
    hot = np.zeros((SENSOR_SIDE, SENSOR_SIDE))
    for row, column, offset_dn in camera.hot_pixels:
        hot[row, column] = offset_dn
    peak_dn, sigma_px = follow_law(conditions)
    peak_dn = peak_dn * peak_factor
    depth, period_px, direction_deg = light.stripes
    phases = 2 * np.pi * rng.random(sites) if depth else np.zeros(sites)
    across = np.array([np.cos(np.deg2rad(direction_deg)), np.sin(np.deg2rad(direction_deg))]) / period_px
    left, top = corners[conditions.site, 0], corners[conditions.site, 1]
    x0, y0 = centres[conditions.site, 0], centres[conditions.site, 1]
    readings = []
    for frame in range(len(conditions)):
        part = np.s_[top[frame] : top[frame] + SIDE, left[frame] : left[frame] + SIDE]
        dx = np.arange(left[frame], left[frame] + SIDE)[None, :] - x0[frame]
        dy = np.arange(top[frame], top[frame] + SIDE)[:, None] - y0[frame]
        spot = peak_dn[frame] * ellipse(dx / sigma_px[frame], dy / sigma_px[frame], light)
        spot = spot * np.maximum(grains[conditions.site[frame]][part], 0.0)
        phase = phases[conditions.site[frame]] if light.has_new_stripes else 2 * np.pi * across @ (x0[frame], y0[frame])
        spot = spot * (1 + depth * np.cos(2 * np.pi * (dx * across[0] + dy * across[1]) + phase))
        mean_e = (spot + light.pedestal_dn) * np.maximum(gains[part], 0.0) / GAIN
        signal = np.minimum(GAIN * rng.poisson(mean_e), camera.clip_dn)
        signal = signal + GAIN * camera.read_noise_e * rng.standard_normal((SIDE, SIDE))
        signal = signal - camera.bend * signal**2 / FULL_SCALE
        signal = signal + hot[part] + camera.row_dn * rng.standard_normal((SIDE, 1))
        readings.append(np.clip(np.rint(signal + camera.black_dn), 0, FULL_SCALE))
    return DrawnFrames(np.array(readings), left, top, conditions, peak_dn, sigma_px, x0, y0)


def ellipse(u: np.ndarray, v: np.ndarray, light: DrawnLight) -> np.ndarray:
    """Return a Gaussian of peak 1 at displacements u, v [σ]."""
    cos, sin = np.cos(np.deg2rad(light.direction_deg)), np.sin(np.deg2rad(light.direction_deg))
    along, across = u * cos + v * sin, v * cos - u * sin
    return np.exp(-(along**2 / light.ratio + across**2 * light.ratio) / 2)


def draw_field(rng: np.random.Generator, grain_px: float) -> np.ndarray:
    """Draw a normal field of the sensor [row, column] of mean 0 and variance 1, correlated as exp(−d²/2 grain²)."""
    ky, kx = np.fft.fftfreq(SENSOR_SIDE)[:, None], np.fft.fftfreq(SENSOR_SIDE)[None, :]
    # White noise smoothed by a Gaussian of width s has the correlation exp(−d²/4 s²): s = grain/√2.
    kernel = np.exp(-((np.pi * grain_px) ** 2) * (kx * kx + ky * ky))
    white = rng.standard_normal((SENSOR_SIDE, SENSOR_SIDE))
    return np.fft.ifft2(np.fft.fft2(white) * kernel).real / np.sqrt(np.mean(kernel**2))


@dataclass(frozen=True)
class DrawnNumbers:
    """Drawn brightness and width of F frames, as a fit of the frames would report them."""

    conditions: Conditions  # of the frames
    log_peak: np.ndarray  # ln of the peak in DN [frame]
    log_sigma: np.ndarray  # ln of the width in px [frame]
    covariance: np.ndarray  # of ln peak, ln σ, x, y of frame after frame [4F, 4F]


def draw_numbers(
    seed: int,
    conditions: Conditions,
    peak_factor: np.ndarray | float = 1.0,
    frame_scatter: float = 0.005,
    site_scatter: float = 0.0,
    error_share: float = 1.0,
) -> DrawnNumbers:
    """Draw brightness and width of frames at random.

    Parameters
    ----------
    seed : int
        Seed of all random numbers.
    conditions : Conditions
        Conditions of the frames.
    peak_factor : array [frame] or float
        Factor on the peaks of the law.
    frame_scatter, site_scatter : float
        Standard deviations of ln peak from frame to frame and from site to site.
    error_share : float
        Factor on all standard errors.
    """
    rng = np.random.default_rng(seed)
    count = len(conditions)
    peak_dn, sigma_px = follow_law(conditions)
    block = np.diag([PEAK_ERROR**2, SIGMA_ERROR**2, CENTRE_ERROR**2, CENTRE_ERROR**2])
    block[0, 1] = block[1, 0] = CORRELATION * PEAK_ERROR * SIGMA_ERROR
    block *= error_share**2
    errors = rng.multivariate_normal(np.zeros(2), block[:2, :2], count).T
    of_frames = frame_scatter * rng.standard_normal(count)
    of_sites = site_scatter * rng.standard_normal(conditions.site.max() + 1)[conditions.site]
    return DrawnNumbers(
        conditions=conditions,
        log_peak=np.log(peak_dn * peak_factor) + of_frames + of_sites + errors[0],
        log_sigma=np.log(sigma_px) + errors[1],
        covariance=np.kron(np.eye(count), block),
    )
