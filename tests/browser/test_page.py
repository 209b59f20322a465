"""What every page must be, whatever its dataset has: whole without a network, readable at any width, by any reader."""

import pytest

from spotcheck.report import provenance
from tests.browser.opening import WINDOW, look

# Widths [px] of a telephone, a notebook and a large screen.
WIDTHS = (380, 1280, 2560)
SCHEMES = ("light", "dark")
# Contrast of text against what is behind it, WCAG 2.2, success criterion 1.4.3 (level AA), text of any size.
LEAST_CONTRAST = 4.5
# Size [bytes] of a page that opens at once, for 96 frames.
LARGEST_PAGE = 15_000_000


@pytest.fixture
def page(opened):
    """The same, as a reader finds it: light, folded, at the top."""
    opened.page.set_viewport_size({"width": WINDOW[0], "height": WINDOW[1]})
    opened.page.emulate_media(media="screen", color_scheme="light")
    opened.page.evaluate("looks.unfold(false); scrollTo(0, 0)")
    return opened.page


def test_opens_from_disk_without_a_network(opened):
    """It asks for nothing elsewhere, and neither its scripts nor the browser complain, also of what is drawn when it is
    seen."""
    opened.page.evaluate("looks.unfold(true)")
    opened.page.evaluate("looks.visit()")
    assert opened.page.title()
    assert opened.outside == []
    assert opened.errors == []


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_overflows_sideways(page, width):
    """Folded and unfolded, light and dark; what is wider than the window scrolls in a box of its own."""
    page.set_viewport_size({"width": width, "height": WINDOW[1]})
    for scheme in SCHEMES:
        page.emulate_media(color_scheme=scheme)
        for unfolded in (False, True):
            page.evaluate("looks.unfold", unfolded)
            assert look(page, "overflow") == "", f"{scheme}, {'unfolded' if unfolded else 'folded'}"


@pytest.mark.parametrize("width", WIDTHS)
def test_graphs_show_all_their_words(page, width):
    """No title, note or number of a graph is cut off by its edge."""
    page.set_viewport_size({"width": width, "height": WINDOW[1]})
    page.evaluate("looks.unfold(true)")
    page.evaluate("looks.visit()")
    assert look(page, "beyond") == ""


def test_every_picture_has_an_alternative_text(page):
    """Images, drawings and graphs say what they show."""
    assert look(page, "unnamed") == ""


def test_headings_are_in_order(page):
    """One title, and no level left out."""
    assert look(page, "headings") == ""


@pytest.mark.parametrize("scheme", SCHEMES)
def test_text_stands_out(page, scheme):
    """Every text against its background, unfolded; a graph takes the colours of the scheme once it comes into view."""
    page.emulate_media(color_scheme=scheme)
    page.evaluate("looks.unfold(true)")
    page.evaluate("looks.visit()")
    assert look(page, "faint", LEAST_CONTRAST) == ""


def test_no_number_is_left_out_by_accident(page):
    """No text shows what a program writes where it has nothing."""
    page.evaluate("looks.unfold(true)")
    assert look(page, "leftovers") == ""


def test_numbers_say_where_they_come_from(page, results):
    """What is marked is known to `spotcheck explain`, the first and last of each file at least; of the tables of fits,
    of the data sheet and of the simulation's parameters every number is."""
    keys = page.evaluate("[...document.querySelectorAll('.from')].map(own => own.dataset.key)")
    files: dict[str, list[str]] = {}
    for key in keys:
        files.setdefault(key.split("[")[0], []).append(key)
    for own in files.values():
        for key in {own[0], own[-1]}:
            assert provenance.find_number(results, key).description, key
    for fold in ("fits", "sheet", "parameters", "table"):
        # Exposures of the manifest and the constant of Eq. 40 are in no file of numbers.
        rows = f"#{fold} tr:not(:has-text('manifest.csv')):not(:has-text('Eq. 40'))"
        cells = page.locator(f"{rows} td.number:not(:has(.from))").all_text_contents()
        assert [text for text in cells if any(own.isdigit() for own in text)] == [], fold


def test_size(results):
    """It opens at once."""
    assert (results / "report.html").stat().st_size < LARGEST_PAGE
