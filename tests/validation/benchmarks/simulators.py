"""Random frames of a spot by other packages: a function each, which sets the package up for a `Scene` and returns what
draws one frame. What a package cannot do is left out of its time and said in the table.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from spotcheck.model.spot import circular_gaussian
from spotcheck.sensor import SensorModel
from tests.validation.benchmarks.spots import SIDE, X, Y

Simulator = Callable[[], np.ndarray]


class Scene(NamedTuple):
    """A round spot [e-, px] and the camera that sees it; the converter has `bits`."""

    peak_e: float
    x: float
    y: float
    sigma: float
    offset_e: float
    sensor: SensorModel
    bits: int

    def light_e(self) -> np.ndarray:
        """Mean electrons of each pixel, point-sampled."""
        return circular_gaussian(X, Y, self.peak_e, self.x, self.y, self.sigma) + self.offset_e


def galsim(scene: Scene, seed: int) -> Simulator:
    """Profile, drawing and noise classes of the package; gain and quantisation are its image operations."""
    import galsim

    rng = galsim.BaseDeviate(seed)

    def draw() -> np.ndarray:
        flux = 2 * np.pi * scene.sigma**2 * scene.peak_e
        shift = (scene.x - (SIDE - 1) / 2, scene.y - (SIDE - 1) / 2)
        spot = galsim.Gaussian(sigma=scene.sigma, flux=flux).shift(*shift)
        image = spot.drawImage(nx=SIDE, ny=SIDE, scale=1.0, method="no_pixel", dtype=float)
        image += scene.offset_e
        image.addNoise(galsim.PoissonNoise(rng))
        image.addNoise(galsim.GaussianNoise(rng, sigma=scene.sensor.read_noise_e))
        image *= scene.sensor.gain_dn_per_e
        image.quantize()
        return image.array

    return draw


def laserbeamsize(scene: Scene, seed: int) -> Simulator:
    """`create_test_image` with its Poisson noise, which has the same mean everywhere."""
    from laserbeamsize import create_test_image

    rng, width = np.random.default_rng(seed), 4 * scene.sigma
    noise, top = max(scene.offset_e * scene.sensor.gain_dn_per_e, 1.0), 2**scene.bits - 1
    given = (SIDE, SIDE, scene.x, scene.y, width, width, 0.0, noise)
    return lambda: create_test_image(*given, max_value=top, rng=rng)


def prysm(scene: Scene, seed: int) -> Simulator:
    """`Detector.expose` of a mean that numpy computes."""
    from prysm.detector import Detector

    sensor = scene.sensor
    bias, conversion = sensor.black_level_dn / sensor.gain_dn_per_e, 1 / sensor.gain_dn_per_e
    detector = Detector(0.0, sensor.read_noise_e, bias, sensor.full_well_e, conversion, scene.bits, 1.0)
    return lambda: detector.expose(scene.light_e())


def emva1288(scene: Scene, seed: int) -> Simulator:
    """`Camera.grab` at one wavelength, of a radiance that gives the electrons wanted."""
    from emva1288.camera import routines
    from emva1288.camera.camera import Camera

    sensor = scene.sensor
    steps = {"K_steps": 1, "blackoffset_steps": 1}
    gain = dict.fromkeys(("K", "K_min", "K_max"), sensor.gain_dn_per_e)
    black = dict.fromkeys(("blackoffset", "blackoffset_min", "blackoffset_max"), sensor.black_level_dn)
    noise = {"dark_current_ref": 0.0, "dark_signal_0": 0.0, "sigma2_dark_0": sensor.read_noise_e**2}
    efficiency = routines.Qe(np.ones((SIDE, SIDE, 1)), np.array([650.0]), SIDE, SIDE)
    size = {"bit_depth": scene.bits, "width": SIDE, "height": SIDE}
    camera = Camera(qe=efficiency, u_esat=sensor.full_well_e, seed=seed, **size, **gain, **black, **noise, **steps)
    per_electron = 1 / camera.get_photons(1.0)
    return lambda: camera.grab(scene.light_e()[:, :, None] * per_electron)


def put_light(detector, peak_e: float, x: float, y: float, sigma: float, offset_e: float) -> None:
    """A model of Pyxel's pipeline: the mean as photons."""
    detector.photon.array = circular_gaussian(X, Y, peak_e, x, y, sigma) + offset_e


def pyxel(scene: Scene, seed: int) -> Simulator:
    """`run_mode` of an exposure with eight models."""
    import pyxel
    from pyxel.detectors import CMOS, ChargeToVoltSettings, CMOSCharacteristics, CMOSGeometry, Environment
    from pyxel.exposure import Exposure, Readout
    from pyxel.pipelines import DetectionPipeline, ModelFunction

    sensor, volts = scene.sensor, 1e-5
    per_dn = volts / sensor.gain_dn_per_e
    mode = Exposure(readout=Readout(times=[1.0]))
    detector = CMOS(
        geometry=CMOSGeometry(row=SIDE, col=SIDE),
        environment=Environment(),
        characteristics=CMOSCharacteristics(
            quantum_efficiency=1.0,
            charge_to_volt=ChargeToVoltSettings(value=volts),
            pre_amplification=1.0,
            adc_bit_resolution=scene.bits,
            adc_voltage_range=(0.0, (2**scene.bits - 1) * per_dn),
            full_well_capacity=int(sensor.full_well_e),
        ),
    )

    def model(group: str, name: str, **arguments) -> ModelFunction:
        return ModelFunction(func=f"pyxel.models.{group}.{name}", name=name, arguments=arguments)

    light = dict(zip(scene._fields[:5], scene[:5], strict=True))
    pipeline = DetectionPipeline(
        photon_collection=[
            ModelFunction(func=f"{__name__}.put_light", name="light", arguments=light),
            model("photon_collection", "shot_noise"),
        ],
        charge_generation=[model("charge_generation", "simple_conversion", binomial_sampling=False)],
        charge_collection=[
            model("charge_collection", "simple_collection"),
            model("charge_collection", "simple_full_well"),
        ],
        charge_measurement=[
            model("charge_measurement", "simple_measurement"),
            model("charge_measurement", "output_node_noise", std_deviation=sensor.read_noise_e * volts),
            model("charge_measurement", "dc_offset", offset=sensor.black_level_dn * per_dn),
        ],
        readout_electronics=[model("readout_electronics", "simple_adc")],
    )

    def draw() -> np.ndarray:
        tree = pyxel.run_mode(mode=mode, detector=detector, pipeline=pipeline)
        return tree["/bucket/image"].to_numpy().squeeze()

    return draw


# By name: what makes a simulator of a scene and a seed, and what it lacks.
SIMULATORS: dict[str, tuple[Callable[[Scene, int], Simulator], str]] = {
    "galsim": (galsim, "full well, clip and black level"),
    "laserbeamsize": (laserbeamsize, "shot noise of the light, read noise, gain, full well, black level"),
    "prysm": (prysm, "spot model (numpy's is used), rounding (it truncates), seed of its own"),
    "emva1288": (emva1288, "spot model (numpy's is used); counts rounding twice"),
    "pyxel": (pyxel, "spot model (numpy's is used), rounding (it truncates)"),
}
