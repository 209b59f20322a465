"""How strong an effect is: its signal-to-noise before and after a refit of the base model, and the search for a
wanted one. Every second row and column is looked at, and the sums are scaled to all pixels."""

from __future__ import annotations

import numpy as np

from tests.validation.generators.second.case import FULL_SCALE, LASER_WIDTH, Case, Effect
from tests.validation.generators.second.optics import budget, light
from tests.validation.generators.second.sensor import expose, read_out, variance

STRIDE = 2
TARGET = (150.0, 400.0)  # signal-to-noise after the refit
LEFT = (0.6, 2.0)  # % of the peak, what is left of an effect after the refit
HEADROOM = 0.92  # highest light plus black level, of full scale


def means(case: Case) -> np.ndarray:
    """Mean of every frame in DN, (frame, y, x), on the coarse grid.

    Mechanisms of codes act on noisy frames only: there the change of one frame with the same noise stands in.
    """
    stack = np.stack([read_out(case, i)[::STRIDE, ::STRIDE] for i in range(len(case.frames))])
    if any(effect.stage == "codes" for effect in case.effects.values()):
        plain = case.only(*(effect for effect in case.effects.values() if effect.stage != "codes"))
        for i, mean in enumerate(stack):
            mean += (expose(case, i) - expose(plain, i))[::STRIDE, ::STRIDE]
    return stack


class Refit:
    """The base model with scale, p1, p2 and a centre per site free, fitted by Gauss-Newton to mean frames."""

    def __init__(self, case: Case) -> None:
        """Start at the truth."""
        self.case, self.plain = case, case.only()
        self.base = means(self.plain)
        self.var = variance(self.plain, self.base)
        self.t = np.array([frame.exposure for frame in case.frames])
        self.site = np.array([frame.site for frame in case.frames])
        self.axis = np.arange(0, case.size, STRIDE, dtype=float)
        longest = case.exposures[-1]
        self.unit = case.peak / budget(case.budget, case.p1 * np.log(longest) + case.p2, longest)
        self.still = case.black + case.gain * case.dark_current * self.t[:, None, None]
        self.bright = np.stack([light(self.plain, i)[::STRIDE, ::STRIDE] for i in range(len(self.t))])
        self.bright = self.bright > 0.02 * self.bright.max(axis=(1, 2), keepdims=True)

    def model(self, width: np.ndarray, scale: float, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Frames in DN for widths p_b [px] per frame, and their derivatives with respect to x and y."""
        sigma = (width + LASER_WIDTH)[:, None, None]
        peak = (scale * self.unit * budget(self.case.budget, width, self.t))[:, None, None]
        dx = self.axis[None, None, :] - centres[self.site, 0][:, None, None]
        dy = self.axis[None, :, None] - centres[self.site, 1][:, None, None]
        image = peak * np.exp(-(dx**2) / (2 * sigma**2)) * np.exp(-(dy**2) / (2 * sigma**2))
        flank = image
        if self.case.top_hat:
            top = peak * np.exp(-0.25)
            flank = np.where(image > top, 0.0, image)
            image = np.minimum(image, top)
        return image, flank * dx / sigma**2, flank * dy / sigma**2

    def residual(self, target: np.ndarray, steps: int = 3) -> np.ndarray:
        """What is left of `target` [DN] after the refit."""
        case, sites, lnt = self.case, len(self.case.centres), np.log(self.t)
        theta = np.array([1.0, case.p1, case.p2])
        free = 3 if len(case.exposures) > 1 else 2  # one exposure: p1 stays 0
        centres = case.centres.copy()
        for step in range(steps + 1):
            width = theta[1] * lnt + theta[2]
            image, by_x, by_y = self.model(width, theta[0], centres)
            left = target - self.still - image
            if step == steps:
                return left
            h = 0.01
            up, down = (self.model(width + d, theta[0], centres)[0] for d in (h, -h))
            wider = (up - down) / (2 * h)
            columns = [*[image / theta[0], wider, wider * lnt[:, None, None]][:free], by_x, by_y]
            jac = np.stack([column / np.sqrt(self.var) for column in columns], -1).reshape(len(self.t), -1, free + 2)
            rhs = (left / np.sqrt(self.var)).reshape(len(self.t), -1, 1)
            blocks, sums = jac.transpose(0, 2, 1) @ jac, (jac.transpose(0, 2, 1) @ rhs)[..., 0]
            normal, vector = np.zeros((free + 2 * sites,) * 2), np.zeros(free + 2 * sites)
            for block, part, site in zip(blocks, sums, self.site, strict=True):
                index = np.r_[:free, free + 2 * site : free + 2 * site + 2]
                normal[np.ix_(index, index)] += block
                vector[index] += part
            change = np.linalg.lstsq(normal, vector, rcond=1e-10)[0]
            theta += [change[0], change[2] if free == 3 else 0.0, change[1]]
            centres += change[free:].reshape(sites, 2)
        raise AssertionError("unreachable")

    def measure(self, case: Case, unknowns: int) -> dict[str, float]:
        """Signal-to-noise ratios and sizes of the effects of `case` against the base model.

        `snr_refit` counts what a refit of the base leaves of the mean; `snr_variance` the change of the variance;
        `snr_detect` joins both and discounts random realisations: the deflection of a chi-square of `unknowns` numbers.
        """
        mean = means(case)
        change, left = mean - self.base, self.residual(mean)
        shift = variance(case, self.base) / self.var - 1
        power = STRIDE**2 * np.array([np.sum(change**2 / self.var), np.sum(left**2 / self.var), np.sum(shift**2) / 2])
        found = power[1] / np.sqrt(2 * unknowns + 4 * power[1]) if unknowns else np.sqrt(power[1])
        peak = self.base.max(axis=(1, 2), keepdims=True) - case.black
        percent = 100 * left / peak
        rms = max(np.sqrt(np.mean(percent**2)), np.sqrt(np.mean(percent[self.bright] ** 2)))
        return {
            "snr": float(np.sqrt(power[0])),
            "snr_refit": float(np.sqrt(power[1])),
            "snr_variance": float(np.sqrt(power[2])),
            "snr_detect": float(np.hypot(found, np.sqrt(power[2]))),
            "largest_change_percent_of_peak": float(100 * np.max(np.abs(change) / peak)),
            "rms_after_refit_percent_of_peak": float(rms),
        }


def tune(refit: Refit, effect: Effect, rng: np.random.Generator) -> dict[str, object]:
    """Set the effect's strength: a signal-to-noise ratio of `TARGET`, and a size far above 0.2 % of the peak.

    Returns what was measured, and whether the target was met within the effect's own limits.
    """
    low, high = TARGET
    target, size = float(np.exp(rng.uniform(np.log(low), np.log(high)))), rng.uniform(*LEFT)
    effect.s = max(effect.start, effect.floor)
    for attempt in range(7):
        found = refit.measure(refit.case.only(effect), effect.unknowns)
        wanted = target / max(found["snr_detect"], 1e-6)
        if found["snr_variance"] < found["snr_refit"]:
            wanted = max(wanted, size / max(found["rms_after_refit_percent_of_peak"], 1e-9))
        step = float(np.clip(effect.s * np.clip(wanted, 0.1, 10) ** 0.9, effect.floor, effect.cap))
        if attempt == 6 or abs(np.log(wanted)) < 0.15 or abs(step / effect.s - 1) < 0.02:
            break
        effect.s = step
    met = low <= 1.15 * found["snr_detect"]
    return {"target": target, "met": bool(met), **found}


def fit_under_full_scale(case: Case) -> None:
    """Dim the spot where an effect would drive the light into the converter's full scale."""
    highest = max(float(light(case, i).max()) for i in range(len(case.frames)))
    room = HEADROOM * FULL_SCALE - case.black
    if highest > room and not case.get("saturation"):
        case.peak *= room / highest
