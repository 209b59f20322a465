"""Structure of the light between the nodes of its free shape, against stripes that were added to drawn frames."""

from dataclasses import replace

import numpy as np

from spotcheck.discrepancy.frames import select_pixels
from spotcheck.discrepancy.joint_fit import JointFit, fit_jointly
from spotcheck.discrepancy.light_shape import FINE_STEP, add_fine_structure
from spotcheck.discrepancy.shape_grid import ShapeGrid
from tests.samples.drawn_frames import DrawnFrames, draw_frames, lay_out
from tests.samples.models_of_frames import frame_set, starting_model

# Stripes [peak], and their period [σ]: nodes 0.8 σ apart cannot follow them.
SIZE, PERIOD = 0.03, 0.7
COARSE = ShapeGrid(step=0.8)


def stripes(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return stripes on a Gaussian spot [peak] at u, v [σ]."""
    return SIZE * np.cos(2 * np.pi * u / PERIOD) * np.exp(-(u**2 + v**2) / 2)


def with_stripes(drawn: DrawnFrames) -> DrawnFrames:
    """Return drawn frames to which stripes were added that move and widen with the spots."""
    side = np.arange(drawn.readings.shape[1])
    column, row = (
        (side + corner[:, None] - centre[:, None]) / drawn.sigma_px[:, None]
        for corner, centre in ((drawn.left, drawn.x), (drawn.top, drawn.y))
    )
    added = drawn.peak_dn[:, None, None] * stripes(column[:, None, :], row[:, :, None])
    return replace(drawn, readings=drawn.readings + added)


def fit_shape(drawn: DrawnFrames) -> JointFit:
    """Return the fit of a free shape with nodes far apart."""
    model = replace(starting_model(drawn), free=()).with_free_shape(COARSE)
    return fit_jointly(model, select_pixels(frame_set(drawn), model.spots))


def test_stripes_between_the_nodes_are_found():
    """The structure is that of the stripes, and −2 ln L falls by nearly as much as the stripes make of it."""
    plain = draw_frames(4, lay_out())
    fit = fit_shape(with_stripes(plain))
    fine = add_fine_structure(fit)
    finer = fine.model.forward.baseline.learned.finer
    u = FINE_STEP * np.arange(-24, 25)
    found, put_in = finer(u[None, :], u[:, None]), stripes(u[None, :], u[:, None])
    assert np.corrcoef(found.ravel(), put_in.ravel())[0, 1] > 0.9
    assert fine.has_converged
    # What is left is noise: the drop is that of a fit that never saw stripes, to a tenth.
    ideal = fit.deviance - fit_shape(plain).deviance
    assert abs(fit.deviance - fine.deviance - ideal) < 0.1 * ideal


def test_noise_is_no_structure():
    """Without stripes −2 ln L falls by less than a twentieth of what noise alone gives to free nodes: their number."""
    fit = fit_shape(draw_frames(4, lay_out()))
    fine = add_fine_structure(fit)
    assert fit.deviance - fine.deviance < np.pi * (4 / FINE_STEP) ** 2 / 20


def test_a_single_site_has_none():
    """The frames of one site share more than the light, so that nothing is taken for its structure."""
    fit = fit_shape(with_stripes(draw_frames(4, lay_out(angles_deg=(0.0,), repeats=1))))
    assert add_fine_structure(fit) is fit
