"""The page of a first look in a browser: of one image and of several, on a wide and a narrow window."""

import io

import numpy as np
import pytest
from PIL import Image

import spotcheck
from tests.browser.opening import WINDOW, from_disk, look


@pytest.fixture(scope="module", params=[1, 3])
def page(request, tmp_path_factory):
    """Page of so many images, the last of which has a second spot and a clip."""
    y, x = np.indices((160, 200))
    light = 300 * np.exp(-((x - 95) ** 2 + (y - 78) ** 2) / 200) + 60 * np.exp(-((x - 130) ** 2 + (y - 90) ** 2) / 50)
    rng = np.random.default_rng(5)
    images = [np.clip(np.rint(rng.normal(light + 12, 1.5)), 0, 255).astype(np.uint8) for _ in range(request.param)]
    found = spotcheck.look(images, pixel_pitch_m=5e-6)
    return found.write(tmp_path_factory.mktemp("look"))


@pytest.mark.parametrize("window", [WINDOW, (380, 800)])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_and_can_be_read(chromium, page, window, scheme):
    """Nothing beyond the window, no number that is none, every picture with words, contrast of 4.5 (WCAG AA)."""
    with from_disk(chromium, page, window=window, color_scheme=scheme) as opened:
        opened.page.evaluate("looks.unfold", True)
        for function in ("overflow", "unnamed", "headings", "leftovers"):
            assert look(opened.page, function) == "", function
        assert look(opened.page, "faint", 4.5) == ""
        assert not opened.outside and not opened.errors


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_pictures_have_the_ground_of_the_page(chromium, page, scheme):
    """The edge of each picture, where nothing is drawn, is as light as the page to 10 of 255."""
    with from_disk(chromium, page, color_scheme=scheme) as opened:
        opened.page.evaluate("looks.unfold", True)
        ground = {"light": 255, "dark": 24}[scheme]
        for picture in opened.page.locator("figure img").all():
            pixels = np.asarray(Image.open(io.BytesIO(picture.screenshot())).convert("L"))
            assert abs(float(np.median(pixels[4:8])) - ground) < 10
