"""The first screen, and frames that a reader picks: what the page shows is what the results hold."""

import time

import numpy as np
import pytest

from spotcheck.io import store
from tests.browser.conftest import RESULTS
from tests.browser.opening import REST, WINDOW

# Half of the step [DN] in which the page keeps means of models, 0.25 DN, and the rounding of floats of 32 bits.
STEP = 0.125 + 0.01
# What the first screen shows, in words and as the page names it.
FIRST_SCREEN = {
    "the verdict": ".first h1",
    "how sure, and what to measure next": ".first .sentences",
    "the gap": "#gap",
    "the picture": "#first-picture",
}
MOST_SENTENCES = 3
MODELS = {"declared": "declared model", "extended": "extended model", "simulated": "simulation by p1 and p2"}


@pytest.fixture(scope="session", params=[own for own in RESULTS if own.id != "flats"])
def results(request):
    """A results folder with spots."""
    return request.getfixturevalue(request.param)


@pytest.fixture
def page(opened):
    """The same with the viewer unfolded."""
    opened.page.set_viewport_size({"width": WINDOW[0], "height": WINDOW[1]})
    opened.page.evaluate("looks.unfold(false); scrollTo(0, 0)")
    return opened.page


@pytest.fixture
def viewer(page):
    """The page at its frames, with every control as it was at first."""
    page.evaluate("document.getElementById('frames').open = true")
    page.locator("#viewer").scroll_into_view_if_needed()
    page.locator("#viewer-controls").evaluate("own => own.reset()")
    page.wait_for_selector("#viewer .heatmaplayer")
    return page


@pytest.fixture(scope="module")
def held(results):
    """Crops centred on the light, views, and names of the axes of the grid."""
    with store.read(results / "crops.nc") as crops, store.read(results / "views.nc") as views:
        yield crops["image"].sel(centring="light").load(), views.load(), store.grid_dims(crops)


def images(page, name="viewer") -> dict[str, np.ndarray]:
    """Pixels of a graph's images by their titles; NaN where there are none."""
    found = page.evaluate("looks.images", name)
    return {title: np.array(rows, float) for title, rows in found.items()}


def choose(page, dims, index) -> None:
    """Set the controls of a frame."""
    for dim, at in zip(dims, index, strict=True):
        control = page.locator(f"select[name=axis-{dim}]")
        if control.count():
            control.select_option(value=str(at))


def cells(image) -> list[tuple[int, ...]]:
    """Frames that were measured: first and last, and others between."""
    found = [index for index in np.ndindex(image.shape[:-2]) if np.isfinite(image.values[index]).any()]
    return [found[k] for k in np.unique(np.linspace(0, len(found) - 1, 6).astype(int))]


def same(one, other, tolerance) -> bool:
    """Equal within a tolerance, gaps where the other has them."""
    return one.shape == other.shape and bool(np.allclose(one, other, rtol=0, atol=tolerance, equal_nan=True))


def shows(page, title, wanted, tolerance) -> dict[str, np.ndarray]:
    """Images of the viewer once the one of this title holds what is wanted: it is drawn some time after a control has
    changed."""
    deadline = time.monotonic() + REST
    while True:
        shown = images(page)
        if title in shown and same(shown[title], wanted, tolerance):
            return shown
        assert time.monotonic() < deadline, f"{title}: off by up to {apart(shown.get(title), wanted)} DN"
        page.wait_for_timeout(50)


def apart(one, other) -> float:
    """The largest difference of two images; NaN where one is missing."""
    return float(np.nanmax(np.abs(one - other))) if one is not None and one.shape == other.shape else np.nan


@pytest.mark.parametrize("what", FIRST_SCREEN)
def test_the_first_screen_holds(page, what):
    """Each without scrolling."""
    if what == "the gap" and not page.locator("#gap").count():
        pytest.skip("nothing was tested, so that there is no gap")
    box = page.locator(FIRST_SCREEN[what]).bounding_box()
    assert box["width"] > 0 and box["height"] > 0
    assert box["y"] >= 0 and box["y"] + box["height"] <= WINDOW[1]


def test_the_first_screen_is_short(page):
    """A verdict, how sure it is and what comes next are three sentences at most."""
    text = " ".join(page.locator(".first h1, .first .sentences p").all_inner_texts())
    assert (
        1 <= len([part for part in text.replace("! ", ". ").replace("? ", ". ").split(". ") if part]) <= MOST_SENTENCES
    )


def test_the_first_picture_shows_its_frame(page, held):
    """Measured, both models and what they leave, on one scale of readings and one of residuals."""
    image, _, _ = held
    page.wait_for_selector("#first-picture .heatmaplayer")
    number = int(page.locator("#first-picture").get_attribute("data-frame"))
    index = tuple(page.evaluate("looks.frame", number))
    shown = images(page, "first-picture")
    assert same(shown["measured"], image.values[index], 0)
    scales = page.evaluate("looks.scales", "first-picture")
    assert len({scale for title, scale in scales.items() if " − " not in title}) == 1
    assert len({scale for title, scale in scales.items() if " − " in title}) == 1


def test_controls_show_the_frame(viewer, held):
    """Readings of the frame that angle, exposure and the others name, models within the step of their packing, and
    residuals that are measured less model."""
    image, views, dims = held
    for index in cells(image):
        choose(viewer, dims, index)
        shown = shows(viewer, "measured", image.values[index], 0)
        models = {name: title for name, title in MODELS.items() if title in shown}
        assert models or not np.isfinite(views["simulated"].values[index]).any()
        for name, title in models.items():
            assert same(shown[title], views[name].values[index], STEP), (index, name)
            assert same(shown[f"measured − {title}"], shown["measured"] - shown[title], 1e-3), (index, name)


def test_every_model_can_be_chosen(viewer, held):
    """Each beside the frame, those without one of the effects as well."""
    image, views, dims = held
    index = cells(image)[-1]
    choose(viewer, dims, index)
    for option in viewer.locator("select[name=first] option").all():
        name, title = option.get_attribute("value"), option.inner_text()
        viewer.locator("select[name=first]").select_option(value=name)
        own = views["extended_without"].sel({"without": name[8:]}) if name.startswith("without ") else views[name]
        wanted = own.transpose(*dims, ...).values[index]
        if np.isfinite(wanted).any():
            shows(viewer, title, wanted, STEP)
            told = f"noise σ by the {title}" in viewer.locator("#viewer-caption").inner_text()
            assert told == np.isfinite(float(views["noise_slope"]))


def test_residuals_over_the_noise(viewer, held):
    """Divided by the noise of the sensor at the model's mean, which views.nc gives as a straight line."""
    image, views, dims = held
    if not np.isfinite(float(views["noise_slope"])):
        pytest.skip("this dataset's noise is not known")
    index = cells(image)[0]
    choose(viewer, dims, index)
    plain = shows(viewer, "measured", image.values[index], 0)
    title = next(title for title in plain if title.startswith("measured − "))
    model = plain[title.removeprefix("measured − ")]
    noise = np.sqrt(np.maximum(float(views["noise_at_zero"]) + float(views["noise_slope"]) * model, 1 / 12))
    viewer.locator("select[name=residual]").select_option(value="noise")
    shows(viewer, title, plain[title] / noise, 1e-3)


def test_linear_and_logarithmic(viewer, held):
    """Colours follow the logarithm of readings from 1 DN on, profiles get a logarithmic axis, and back again."""
    image, _, dims = held
    index = cells(image)[0]
    choose(viewer, dims, index)
    viewer.locator("select[name=scale]").select_option(value="log")
    shows(viewer, "measured", np.log10(np.maximum(image.values[index], 1.0)), 1e-5)
    assert "log" in viewer.evaluate("looks.axisTypes", "viewer")
    viewer.locator("select[name=scale]").select_option(value="linear")
    shows(viewer, "measured", image.values[index], 0)
    assert "log" not in viewer.evaluate("looks.axisTypes", "viewer")


def test_images_move_together(viewer):
    """To enlarge a part of one enlarges it in all; where a single axis was asked for, the others show up to a twentieth
    more, for a pixel stays square."""
    before = viewer.evaluate("looks.ranges", "viewer")
    left, right = before[0][0]
    part = [left + 0.4 * (right - left), left + 0.6 * (right - left)]
    viewer.evaluate("part => Plotly.relayout('viewer', { 'xaxis.range': part })", part)
    after = viewer.evaluate("looks.ranges", "viewer")
    assert len(after) >= 3
    assert all(np.allclose(own, after[0], rtol=0, atol=0.05 * (part[1] - part[0])) for own in after), after
    assert not np.allclose(after[0][0], before[0][0])


def test_a_reading_is_said_on_hover(viewer, held):
    """The number beside the pointer is that of the pixel under it."""
    image, _, dims = held
    index = cells(image)[0]
    choose(viewer, dims, index)
    shows(viewer, "measured", image.values[index], 0)
    box = viewer.locator("#viewer .subplot.xy").first.bounding_box()
    viewer.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    said = viewer.locator("#viewer .hoverlayer .hovertext").first.text_content()
    row, column = viewer.evaluate("looks.pointed", "viewer")
    assert f"measured: {image.values[index][row, column]:.5g} DN" in said
