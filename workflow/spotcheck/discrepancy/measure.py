"""All sums of a set of frames about a model's expectation of each."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from spotcheck.discrepancy.base import Base
from spotcheck.discrepancy.pixels import CERTAIN, CODES, DARK, Scene, add_frame, awake, fill_scene, table_of
from spotcheck.discrepancy.shots import Design, Shot
from spotcheck.estimate.scoring import LIKELIHOOD, law_of, one_pass
from spotcheck.model.baseline import Baseline
from spotcheck.model.sensor import ROUNDING_VARIANCE, SensorModel
from spotcheck.model.spot import TOP_HAT_LEVEL

# Blocks along a crop: 8 px of 240.
BLOCKS = 30
# Light above so many times (1 DN and its noise in the dark) is read as it is, unless the model says otherwise.
FAINT = 16.0
# A pixel whose readings scatter by less than this part of the dark's variance hardly ever shows any.
SILENCED = 0.2
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
    the whole set on the sensor [row, column] `dark_pull`, `dark_weight`, `dark_light` Σ r/v, Σ 1/v and Σ µ/v,
    where v is at least that of the noise before black cuts it.
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
    rows_dn: float = 0.0,
    zone_dn: float = 0.0,
) -> Measured:
    """One pass over every frame, about the base model or what `expect` says of a frame; `felt` is the sensor with the
    noise that the model gives it, where that is another than the data sheet's, `rows_dn` the rms of what its rows
    get, and below `zone_dn` signals read 0."""
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
    dark_noise = felt.gain_dn_per_e * felt.read_noise_e
    dark_variance = dark_noise**2 + ROUNDING_VARIANCE
    # Where a dead zone silences nearly all readings, a line's sum is that of a few rare ones and no normal number.
    least = 0.0 if expect is None else SILENCED * dark_variance
    if expect is None:
        law = law_of(sensor)
    else:
        # Readings of all rows together: what black cuts of them follows light by the wider law.
        wide = felt._replace(read_noise_e=float(np.hypot(felt.read_noise_e, rows_dn / felt.gain_dn_per_e)))
        table = table_of(wide, FAINT * (1 + felt.gain_dn_per_e * wide.read_noise_e))
        slope = np.gradient(table.mean, felt.gain_dn_per_e * table.step_e)
    score, information = np.zeros((count, 7)), np.zeros((count, 7, 7))
    for k, shot in enumerate(shots):
        image = np.ascontiguousarray(shot.pixels(), dtype=np.float64)
        scene, site = expect(k) if expect else at_base(k), design.site[k]
        scene = awake(image, scene, DARK * np.sqrt(dark_variance), side)
        chip_at = (int(top[k]) - corner[0], int(left[k]) - corner[1]) if common else (0, 0)
        at = (int(top[k] - site_top[site]), int(left[k] - site_left[site]))
        add_frame(  # type: ignore[call-arg]
            image, *scene, sensor.black_level_dn, sensor.full_scale_dn, dark_variance, least, zone_dn,
            sensor.gain_dn_per_e, side,
            *(part[k] for part in sums[:14]), sums.pull[site], sums.weight[site], *sums[16:], at, chip_at,
        )  # fmt: skip
        theta = spot_of(k, design, base, sensor)
        if expect is None:
            score[k], information[k], _, _ = one_pass(image, theta, LIKELIHOOD, law, baseline.top_hat)
        else:
            # Where black cuts readings the sensor's law says how much of light they show; else the model.
            follows = np.interp(scene.mean, table.mean, slope)
            lit = scene.light > DARK * np.sqrt(dark_variance)
            follows *= np.divide(scene.shown, scene.light, out=np.ones_like(follows), where=lit)
            score[k], information[k] = about_scene(image, scene, follows, theta, baseline.top_hat)
    return Measured(design, base, sums, score, information, side, corner, common, left, top, site_left, site_top,
                    np.zeros((count, 3)), np.zeros((design.sites, 2)))  # fmt: skip


def spot_of(k: int, design: Design, base: Base, sensor: SensorModel) -> np.ndarray:
    """Parameters of the base's spot of frame `k`, as `scoring` has them."""
    exposure = np.nan_to_num(design.exposure_s[design.condition[k]])
    curvature = base.sigma[k] ** -2.0
    dark = sensor.black_level_dn + sensor.gain_dn_per_e * sensor.dark_current_e_per_s * exposure
    return np.array([base.amplitude[k], base.x0[k], base.y0[k], curvature, 0.0, curvature, dark])


def about_scene(
    image: np.ndarray, scene: Scene, follows: np.ndarray, theta: np.ndarray, top_hat: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Score [7] and information [7, 7] of a frame's spot, as `scoring` has them, about any expectation.

    Quasi-likelihood (Wedderburn 1974, doi:10.1093/biomet/61.3.439): it needs no law of a reading but its mean, its
    variance, and by how much it `follows` light.
    """
    known = np.isfinite(image) & (scene.variance >= CERTAIN)
    variance = np.where(known, scene.variance, np.inf)
    pull = follows * np.where(known, image - scene.mean, 0.0) / variance
    weight = follows**2 / variance
    amplitude, x0, y0, a, _, c, _ = theta
    dx, dy = np.arange(image.shape[1]) - x0, np.arange(image.shape[0]) - y0
    along, across = np.exp(-c * dy**2 / 2), np.exp(-a * dx**2 / 2)
    # On a top hat's plateau nothing but brightness and pedestal show.
    flat = along[:, None] * across > (TOP_HAT_LEVEL if top_hat else 2.0)
    x_powers, y_powers = dx ** np.arange(5)[:, None], dy ** np.arange(5)[:, None]

    def moments(values: np.ndarray, power: int) -> np.ndarray:
        """Σ values × (light of unit amplitude)^power × dx^p dy^q, flanks only [p, q]."""
        flanks = np.where(flat, 0.0, values)
        return (x_powers * across**power) @ flanks.T @ (y_powers * along**power).T

    # Slopes are `scale` times the light times these powers of dx and dy.
    p, q = np.array([(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]).T
    scale = np.array([1.0, amplitude * a, amplitude * c, -amplitude / 2, -amplitude, -amplitude / 2])
    score, information = np.empty(7), np.empty((7, 7))
    score[:6], score[6] = scale * moments(pull, 1)[p, q], pull.sum()
    information[:6, :6] = np.outer(scale, scale) * moments(weight, 2)[np.add.outer(p, p), np.add.outer(q, q)]
    information[:6, 6] = information[6, :6] = scale * moments(weight, 1)[p, q]
    information[6, 6] = weight.sum()
    score[0] += TOP_HAT_LEVEL * pull[flat].sum()
    information[0, 0] += TOP_HAT_LEVEL**2 * weight[flat].sum()
    information[0, 6] = information[6, 0] = information[0, 6] + TOP_HAT_LEVEL * weight[flat].sum()
    return score, information


def base_scenes(
    shots: Sequence[Shot], design: Design, base: Base, baseline: Baseline, sensor: SensorModel
) -> Callable[[int], Scene]:
    """The base model's expectation of each frame, in arrays that are filled anew for every frame."""
    gain = sensor.gain_dn_per_e
    exposures = np.nan_to_num(design.exposure_s)
    highest = 1.05 * float(np.max(base.amplitude)) + gain * sensor.dark_current_e_per_s * float(exposures.max()) + 1.0
    table = table_of(sensor, 16.0 * float(np.ceil(highest / 16.0)))
    mean, variance, spot_light = (np.empty(shots[0].pixels().shape) for _ in range(3))
    scene = Scene(mean, variance, spot_light, spot_light)

    def expect(k: int) -> Scene:
        dark_e = sensor.dark_current_e_per_s * exposures[design.condition[k]]
        spot = (base.amplitude[k], base.x0[k], base.y0[k], base.sigma[k])
        fill_scene(*spot, baseline.top_hat, gain, dark_e, *table, *scene[:3])
        return scene

    return expect
