"""Pages read without a mouse, and on paper."""

import io

import numpy as np
import pytest
from PIL import Image

from tests.browser.opening import WINDOW, from_disk, look, tabbed
from tests.browser.test_page import LEAST_CONTRAST, SCHEMES

# Width [px] of what a sheet of A4 shows between margins of 1 cm, at 96 px an inch.
PAPER = 718


@pytest.fixture
def page(chromium, results):
    """The page from disk, seen once from top to bottom."""
    with from_disk(chromium, results / "report.html") as own:
        own.page.evaluate("looks.visit()")
        yield own.page


@pytest.mark.parametrize("unfolded", [False, True], ids=["folded", "unfolded"])
def test_tab_reaches_every_control_in_order(page, unfolded):
    """From the top to the last, in the order of the document, and the focus is seen on each; also on what stands in the
    folds."""
    page.evaluate("looks.unfold", unfolded)
    page.evaluate("looks.visit()")
    steps = tabbed(page)
    assert steps
    assert [step["place"] for at, step in enumerate(steps) if step["at"] != at] == []
    assert [step["place"] for step in steps if not step["seen"]] == []


def test_enter_opens_and_shuts_every_fold(page):
    """By the keyboard alone."""
    for fold in page.locator("details:visible > summary").all():
        before = fold.evaluate("own => own.parentElement.open")
        fold.press("Enter")
        assert fold.evaluate("own => own.parentElement.open") != before
        fold.press("Enter")


@pytest.mark.parametrize("scheme", SCHEMES)
def test_paper_shows_all(page, scheme):
    """What is folded on screen is there on paper, nothing is cut off at its edge, and dark text is printed on white
    also for those who read on a dark ground."""
    page.emulate_media(color_scheme=scheme)
    page.evaluate("looks.visit()")
    page.set_viewport_size({"width": PAPER, "height": WINDOW[1]})
    page.emulate_media(media="print", color_scheme=scheme)
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    for function in ("folded", "overflow", "cut"):
        assert look(page, function) == "", function
    assert look(page, "faint", LEAST_CONTRAST) == ""
    sheet = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("L"), float)
    assert np.median(sheet) > 240, "the paper is not white"
    assert sheet.min() < 80, "nothing is printed"


def test_figures_fit_the_sheet_and_come_back(page):
    """Whatever the window's width, and what was folded is folded again."""
    page.evaluate("looks.visit()")
    folded = page.locator("details:not([open])").count()
    widths = "[...document.querySelectorAll('.js-plotly-plot .main-svg')].map((own) => own.clientWidth)"
    before = page.evaluate(widths)
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    page.wait_for_function(f"Math.max(...{widths}) <= {PAPER}")
    assert page.locator("details:not([open])").count() == 0
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert page.locator("details:not([open])").count() == folded
    page.wait_for_function(f"Math.max(0, ...{widths}) == {max(before, default=0)}")


def test_it_prints(page):
    """A PDF of more than one page."""
    assert page.pdf(format="A4").count(b"/Type /Page\n") > 1
