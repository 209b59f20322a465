"""The page of several datasets in a browser."""

import pytest

from spotcheck.report.comparison.table import compare_datasets
from spotcheck.report.pages.comparison import write_comparison_page
from tests.browser.opening import WINDOW, from_disk, look
from tests.browser.test_page import LEAST_CONTRAST, SCHEMES, WIDTHS
from tests.report.test_comparison import row, sets

__all__ = ["sets"]


@pytest.fixture(scope="module")
def found(sets):
    """Three datasets, the last of which differs."""
    return compare_datasets([sets[name] for name in ("before", "again", "after")])


@pytest.fixture(scope="module")
def opened(chromium, found, tmp_path_factory):
    """Their page from disk, without a network."""
    path = tmp_path_factory.mktemp("page") / "comparison.html"
    write_comparison_page(found, path, "c0de")
    with from_disk(chromium, path) as own:
        yield own


@pytest.fixture
def page(opened):
    """The same, light, at the top, with all folds open and all graphs drawn."""
    opened.page.set_viewport_size({"width": WINDOW[0], "height": WINDOW[1]})
    opened.page.emulate_media(media="screen", color_scheme="light")
    opened.page.evaluate("looks.unfold(true)")
    opened.page.locator("#quantity-plot").scroll_into_view_if_needed()
    opened.page.wait_for_selector("#quantity-plot .main-svg")
    return opened.page


def test_it_looks_right_at_any_width(page, opened):
    """Nothing fetched, no complaint; nothing wider than the window; pictures named, headings in order, no left-over."""
    for width in WIDTHS:
        page.set_viewport_size({"width": width, "height": WINDOW[1]})
        assert look(page, "overflow") == "", width
    for name in ("unnamed", "headings", "leftovers"):
        assert look(page, name) == ""
    assert opened.outside == [] and opened.errors == []


@pytest.mark.parametrize("scheme", SCHEMES)
def test_text_stands_out(page, scheme):
    page.emulate_media(color_scheme=scheme)
    assert look(page, "faint", LEAST_CONTRAST) == ""


def test_the_chosen_quantity_is_drawn(page, found):
    """Its values and errors, and the same in words."""
    own = row(found, "amplitude", 90, 3e-4)
    # Whether it changed beyond chance, which its text says first, depends on the draw.
    texts = page.locator("#quantity option").all_text_contents()
    page.select_option("#quantity", label=next(text for text in texts if text.endswith("amplitude, 90°, 300 µs")))
    drawn = page.evaluate(
        "(([trace]) => [trace.x, trace.y, trace.error_y.array])(document.getElementById('quantity-plot').data)"
    )
    assert drawn[0] == found.axis.places
    assert drawn[1] == pytest.approx([number.value for number in own.numbers])
    assert drawn[2] == pytest.approx([number.stderr for number in own.numbers])
    said = page.get_attribute("#quantity-plot", "aria-label")
    assert said.startswith(f"amplitude, 90°, 300 µs: before {own.numbers[0].value:.0f}"[:-1]) and "slope" in said


def test_what_changed_sorts_by_z(page):
    """Largest first, whatever the sign, then the other way round."""
    button = page.locator("#changed ~ div table.sortable button", has_text="z").first
    cells = "#changed ~ div table.sortable td[data-value]"
    orders = []
    for _ in range(2):
        button.click()
        orders.append([float(own.get_attribute("data-value")) for own in page.locator(cells).all()])
    assert len(orders[0]) > 2
    assert orders[0] == sorted(orders[0], reverse=True) and orders[1] == sorted(orders[0])
