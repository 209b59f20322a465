"""Random frames of a spot by other packages, one small class each: made once, then called for one frame.

All get the same `Scene`. What a package cannot do is left out of its time and said in `lacks`.
"""

from typing import NamedTuple

import numpy as np

from spotcheck.model.spot import circular_gaussian
from spotcheck.sensor import SensorModel
from tests.validation.benchmarks.spots import SIDE, X, Y


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


class Galsim:
    """Profile, drawing and noise classes of the package; gain and quantisation are its image operations."""

    name, package = "galsim", "galsim"
    lacks = "full well, clip and black level"

    def __init__(self, scene: Scene, seed: int):
        import galsim

        self.galsim, self.scene, self.rng = galsim, scene, galsim.BaseDeviate(seed)

    def __call__(self) -> np.ndarray:
        galsim, scene = self.galsim, self.scene
        flux = 2 * np.pi * scene.sigma**2 * scene.peak_e
        shift = (scene.x - (SIDE - 1) / 2, scene.y - (SIDE - 1) / 2)
        spot = galsim.Gaussian(sigma=scene.sigma, flux=flux).shift(*shift)
        image = spot.drawImage(nx=SIDE, ny=SIDE, scale=1.0, method="no_pixel", dtype=float)
        image += scene.offset_e
        image.addNoise(galsim.PoissonNoise(self.rng))
        image.addNoise(galsim.GaussianNoise(self.rng, sigma=scene.sensor.read_noise_e))
        image *= scene.sensor.gain_dn_per_e
        image.quantize()
        return image.array


class LaserBeamSize:
    """`create_test_image` with its Poisson noise, which has the same mean everywhere."""

    name, package = "laserbeamsize", "laserbeamsize"
    lacks = "shot noise of the light, read noise, gain, full well, black level"

    def __init__(self, scene: Scene, seed: int):
        import laserbeamsize

        self.make, self.scene, self.rng = laserbeamsize.create_test_image, scene, np.random.default_rng(seed)

    def __call__(self) -> np.ndarray:
        scene, width = self.scene, 4 * self.scene.sigma
        noise, top = max(scene.offset_e * scene.sensor.gain_dn_per_e, 1.0), 2**scene.bits - 1
        return self.make(SIDE, SIDE, scene.x, scene.y, width, width, 0.0, noise, max_value=top, rng=self.rng)


class Prysm:
    """`Detector.expose` of a mean that numpy computes."""

    name, package = "prysm", "prysm"
    lacks = "spot model (numpy's is used), rounding (it truncates), seed of its own"

    def __init__(self, scene: Scene, seed: int):
        from prysm.detector import Detector

        sensor = scene.sensor
        bias = sensor.black_level_dn / sensor.gain_dn_per_e
        self.scene = scene
        self.detector = Detector(
            0.0, sensor.read_noise_e, bias, sensor.full_well_e, 1 / sensor.gain_dn_per_e, scene.bits, 1.0
        )

    def __call__(self) -> np.ndarray:
        return self.detector.expose(self.scene.light_e())


class Emva1288:
    """`Camera.grab` at one wavelength, of a radiance that gives the electrons wanted."""

    name, package = "emva1288", "emva1288"
    lacks = "spot model (numpy's is used); counts rounding twice"

    def __init__(self, scene: Scene, seed: int):
        from emva1288.camera import routines
        from emva1288.camera.camera import Camera

        sensor = scene.sensor
        self.scene = scene
        self.camera = Camera(
            bit_depth=scene.bits,
            width=SIDE,
            height=SIDE,
            qe=routines.Qe(np.ones((SIDE, SIDE, 1)), np.array([650.0]), SIDE, SIDE),
            K=sensor.gain_dn_per_e,
            K_min=sensor.gain_dn_per_e,
            K_max=sensor.gain_dn_per_e,
            K_steps=1,
            blackoffset=sensor.black_level_dn,
            blackoffset_min=sensor.black_level_dn,
            blackoffset_max=sensor.black_level_dn,
            blackoffset_steps=1,
            dark_current_ref=0.0,
            dark_signal_0=0.0,
            sigma2_dark_0=sensor.read_noise_e**2,
            u_esat=sensor.full_well_e,
            seed=seed,
        )
        self.per_electron = 1 / self.camera.get_photons(1.0)

    def __call__(self) -> np.ndarray:
        return self.camera.grab(self.scene.light_e()[:, :, None] * self.per_electron)


def put_light(detector, peak_e: float, x: float, y: float, sigma: float, offset_e: float) -> None:
    """A model of Pyxel's pipeline: the mean as photons."""
    detector.photon.array = circular_gaussian(X, Y, peak_e, x, y, sigma) + offset_e


class Pyxel:
    """`run_mode` of an exposure with eight models."""

    name, package = "pyxel", "pyxel-sim"
    lacks = "spot model (numpy's is used), rounding (it truncates)"

    def __init__(self, scene: Scene, seed: int):
        import pyxel
        from pyxel.detectors import CMOS, ChargeToVoltSettings, CMOSCharacteristics, CMOSGeometry, Environment
        from pyxel.exposure import Exposure, Readout
        from pyxel.pipelines import DetectionPipeline, ModelFunction

        sensor = scene.sensor
        volts = 1e-5
        top = (2**scene.bits - 1) / sensor.gain_dn_per_e * volts
        self.run = pyxel.run_mode
        self.mode = Exposure(readout=Readout(times=[1.0]))
        self.detector = CMOS(
            geometry=CMOSGeometry(row=SIDE, col=SIDE),
            environment=Environment(),
            characteristics=CMOSCharacteristics(
                quantum_efficiency=1.0,
                charge_to_volt=ChargeToVoltSettings(value=volts),
                pre_amplification=1.0,
                adc_bit_resolution=scene.bits,
                adc_voltage_range=(0.0, top),
                full_well_capacity=int(sensor.full_well_e),
            ),
        )

        def model(name: str, function: str, **arguments) -> ModelFunction:
            return ModelFunction(func=function, name=name, arguments=arguments)

        kind = "pyxel.models"
        self.pipeline = DetectionPipeline(
            photon_collection=[
                model("light", f"{__name__}.put_light", **dict(zip(scene._fields[:5], scene[:5], strict=True))),
                model("shot_noise", f"{kind}.photon_collection.shot_noise"),
            ],
            charge_generation=[
                model("qe", f"{kind}.charge_generation.simple_conversion", binomial_sampling=False),
            ],
            charge_collection=[
                model("collection", f"{kind}.charge_collection.simple_collection"),
                model("full_well", f"{kind}.charge_collection.simple_full_well"),
            ],
            charge_measurement=[
                model("measurement", f"{kind}.charge_measurement.simple_measurement"),
                model(
                    "read_noise",
                    f"{kind}.charge_measurement.output_node_noise",
                    std_deviation=sensor.read_noise_e * volts,
                ),
                model(
                    "black",
                    f"{kind}.charge_measurement.dc_offset",
                    offset=sensor.black_level_dn / sensor.gain_dn_per_e * volts,
                ),
            ],
            readout_electronics=[model("adc", f"{kind}.readout_electronics.simple_adc")],
        )

    def __call__(self) -> np.ndarray:
        tree = self.run(mode=self.mode, detector=self.detector, pipeline=self.pipeline)
        return tree["/bucket/image"].to_numpy().squeeze()


SIMULATORS = (Galsim, LaserBeamSize, Prysm, Emva1288, Pyxel)
