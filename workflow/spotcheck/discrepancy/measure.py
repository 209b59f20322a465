"""All sums of a set of frames about a model's expectation of each."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.base import Base
from spotcheck.discrepancy.pixels import CODES, Scene, add_frame, fill_scene, table_of
from spotcheck.discrepancy.shots import Design, Shot
from spotcheck.estimate.scoring import LIKELIHOOD, law_of, one_pass
from spotcheck.model.baseline import Baseline
from spotcheck.model.chain import offset_response
from spotcheck.model.sensor import ROUNDING_VARIANCE, SensorModel
from spotcheck.model.spot import TOP_HAT_LEVEL

# Blocks along a crop: 8 px of 240.
BLOCKS = 30
# Standard deviations from full scale within which it cuts the law of a reading.
CUT = 3.0
# Crops that lie further apart than this [px] share no pixel worth the memory of a common window.
LARGEST_WINDOW = 2048


class Sums(NamedTuple):
    """Sums over every frame, of residuals r with variance v and light µ.

    Blocks [frame, row, column]: `residual` mean r [DN], `variance` mean v [DN²], `pixels`, `rough` Σ of squared
    standardised residuals about a plane, its `rough_dof`, and `fourth` Σ of fourth powers. Lines [frame, line]: `row`
    Σ r/v, `row_weight` Σ 1/v, `row_light` Σ (µ/v)², and so the columns. `comb` [frame, class of variance, reading
    modulo the longest code] pixels; `totals` [frame, (outliers, excess of Σ z³ of lit pixels over shot noise, their
    number, Σ (µr/v)², Σ (µ²/v)², Σ (µ/v)²)].

    Fields: `pull`, `weight` [site, row, column] Σ µr/v and Σ µ²/v over the frames of a site, in its own window; over
    the whole set on the sensor [row, column] `dark_pull`, `dark_weight`, `dark_light` Σ r/v, Σ 1/v and Σ µ/v.
    """

    residual: np.ndarray
    variance: np.ndarray
    pixels: np.ndarray
    rough: np.ndarray
    rough_dof: np.ndarray
    fourth: np.ndarray
    row: np.ndarray
    row_weight: np.ndarray
    row_light: np.ndarray
    column: np.ndarray
    column_weight: np.ndarray
    column_light: np.ndarray
    comb: np.ndarray
    totals: np.ndarray
    pull: np.ndarray
    weight: np.ndarray
    dark_pull: np.ndarray
    dark_weight: np.ndarray
    dark_light: np.ndarray


class Measured(NamedTuple):
    """Sums about a model, the base spots, score [frame, 7] and information [frame, 7, 7] of each frame's own spot (the
    parameters of `scoring`), side of a block [px], the corner (row, column) of the window on the sensor, whether sites
    share it, where each crop and each site's window lies [px], by how much the brightness and centre that a frame was
    given of its own differ from the model's [frame, (relative, x px, y px)], and the stripes that a site was given
    [site, (cos, sin)]."""

    design: Design
    base: Base
    sums: Sums
    score: np.ndarray
    information: np.ndarray
    side: int
    corner: tuple[int, int]
    common: bool
    left: np.ndarray
    top: np.ndarray
    site_left: np.ndarray
    site_top: np.ndarray
    given: np.ndarray
    waves: np.ndarray


def block_side(crop_px: int) -> int:
    """Side of a block [px]."""
    return max(crop_px // BLOCKS, 2)


def measure(
    shots: Sequence[Shot],
    design: Design,
    base: Base,
    baseline: Baseline,
    sensor: SensorModel,
    expect: Callable[[int], Scene] | None = None,
    felt: SensorModel | None = None,
) -> Measured:
    """One pass over every frame, about the base model or what `expect` says of a frame; `felt` is the sensor with the
    noise that the model gives it, where that is another than the data sheet's."""
    rows, columns = shots[0].pixels().shape
    count, side = len(shots), block_side(min(rows, columns))
    blocks = (count, rows // side, columns // side)
    left, top = np.array([s.left for s in shots]), np.array([s.top for s in shots])
    corner = (int(top.min()), int(left.min()))
    window = (int(top.max()) - corner[0] + rows, int(left.max()) - corner[1] + columns)
    common = max(window) <= LARGEST_WINDOW
    window = window if common else (rows, columns)
    site_left, site_top = (
        np.array([v[design.site == site].min() for site in range(design.sites)]) for v in (left, top)
    )
    reach = int(max(np.max(left - site_left[design.site]), np.max(top - site_top[design.site])))
    sites = (design.sites, rows + reach, columns + reach)
    lines = [np.zeros((count, n)) for n in (rows,) * 3 + (columns,) * 3]
    parts: list[np.ndarray] = [
        *(np.zeros(blocks) for _ in range(6)),
        *lines,
        np.zeros((count, len(CODES) + 1, int(CODES[-1]))),
        np.zeros((count, 6)),
        *(np.zeros(sites, np.float32) for _ in range(2)),
        *(np.zeros(window) for _ in range(3)),
    ]
    sums = Sums(*parts)
    at_base = base_scenes(shots, design, base, baseline, sensor)
    felt = felt or sensor
    law = law_of(felt)
    faint = np.linspace(0.0, 16.0 * (1 + sensor.gain_dn_per_e * sensor.read_noise_e), 400)
    response = faint, offset_response(faint, sensor)
    score, information = np.zeros((count, 7)), np.zeros((count, 7, 7))
    dark_variance = (felt.gain_dn_per_e * felt.read_noise_e) ** 2 + ROUNDING_VARIANCE
    for k, shot in enumerate(shots):
        image = np.ascontiguousarray(shot.pixels(), dtype=np.float64)
        scene, site = expect(k) if expect else at_base(k), design.site[k]
        chip_at = (int(top[k]) - corner[0], int(left[k]) - corner[1]) if common else (0, 0)
        at = (int(top[k] - site_top[site]), int(left[k] - site_left[site]))
        add_frame(  # type: ignore[call-arg]
            image, *scene, sensor.black_level_dn, sensor.full_scale_dn, dark_variance, sensor.gain_dn_per_e**2, side,
            *(part[k] for part in sums[:14]), sums.pull[site], sums.weight[site], *sums[16:], at, chip_at,
        )  # fmt: skip
        theta = spot_of(k, design, base, sensor)
        lift = 0.0
        if expect:
            # The exact law of a faint reading is asked where the reading lies: on the model's pedestal.
            lift = max(float(np.median(scene.mean - at_base(k).mean)), 0.0)
            theta[6] += lift
        score[k], information[k], _, _ = one_pass(image, theta, LIKELIHOOD, law, baseline.top_hat)
        if expect:
            # What the model has over the base spot is no sign of another brightness, place or width.
            spot = at_base(k, lift)
            more = np.interp(spot.light + lift, *response) * (scene.mean - spot.mean) / spot.variance
            # Where full scale cuts the base spot, a reading below it has been scored by the plain law.
            plain, spread = theta[6] + spot.light, dark_variance + sensor.gain_dn_per_e * (spot.light + lift)
            margin = CUT * np.sqrt(spread)
            whole = np.where(scene.mean + margin < sensor.full_scale_dn, (scene.mean - plain) / spread, 0.0)
            more = np.where(plain + margin > sensor.full_scale_dn, whole, more)
            score[k] -= pull_of(np.where(np.isfinite(image), more, 0.0), theta, baseline.top_hat)
    return Measured(design, base, sums, score, information, side, corner, common, left, top, site_left, site_top,
                    np.zeros((count, 3)), np.zeros((design.sites, 2)))  # fmt: skip


def spot_of(k: int, design: Design, base: Base, sensor: SensorModel) -> np.ndarray:
    """Parameters of the base's spot of frame `k`, as `scoring` has them."""
    exposure = np.nan_to_num(design.exposure_s[design.condition[k]])
    curvature = base.sigma[k] ** -2.0
    dark = sensor.black_level_dn + sensor.gain_dn_per_e * sensor.dark_current_e_per_s * exposure
    return np.array([base.amplitude[k], base.x0[k], base.y0[k], curvature, 0.0, curvature, dark])


def pull_of(weighted: np.ndarray, theta: np.ndarray, top_hat: bool) -> np.ndarray:
    """Σ of weighted residuals [row, column] in 1/DN times the slopes of the spot's light, in the order of `scoring`."""
    amplitude, x0, y0, a, _, c, _ = theta
    dx, dy = np.arange(weighted.shape[1]) - x0, np.arange(weighted.shape[0]) - y0
    along, across = np.exp(-c * dy**2 / 2), np.exp(-a * dx**2 / 2)
    plateau = 0.0
    if top_hat:
        high = along[:, None] * across[None] > TOP_HAT_LEVEL
        plateau = TOP_HAT_LEVEL * float(weighted[high].sum())
        rest = float(weighted.sum())
        weighted = np.where(high, 0.0, weighted)
    else:
        rest = float(weighted.sum())

    def total(power_x: int, power_y: int) -> float:
        return float((along * dy**power_y) @ weighted @ (across * dx**power_x))

    by_shape = (a * total(1, 0), c * total(0, 1), -total(2, 0) / 2, -total(1, 1), -total(0, 2) / 2)
    return np.array([total(0, 0) + plateau, *(amplitude * own for own in by_shape), rest])


def base_scenes(
    shots: Sequence[Shot], design: Design, base: Base, baseline: Baseline, sensor: SensorModel
) -> Callable[..., Scene]:
    """The base model's expectation of each frame, if need be on a pedestal [DN], in arrays that are filled anew for
    every frame."""
    gain = sensor.gain_dn_per_e
    exposures = np.nan_to_num(design.exposure_s)
    # Room for a pedestal.
    brightest = 1.05 * float(np.max(base.amplitude)) + 0.5 * min(sensor.full_scale_dn, 65535.0)
    highest = brightest + gain * sensor.dark_current_e_per_s * float(exposures.max()) + 1.0
    table = table_of(sensor, 16.0 * float(np.ceil(highest / 16.0)))
    mean, variance, spot_light = (np.empty(shots[0].pixels().shape) for _ in range(3))
    scene = Scene(mean, variance, spot_light, spot_light)

    def expect(k: int, lift_dn: float = 0.0) -> Scene:
        dark_e = sensor.dark_current_e_per_s * exposures[design.condition[k]] + lift_dn / gain
        spot = (base.amplitude[k], base.x0[k], base.y0[k], base.sigma[k])
        fill_scene(*spot, baseline.top_hat, gain, dark_e, *table, *scene[:3])
        return scene

    return expect
