"""The table of frames: sorted by any column, by mouse and by keyboard, the worst first."""

import re

import numpy as np
import pytest

from tests.browser.test_frames import held, page, results  # noqa: F401

TABLE = "#table table"


def columns(page) -> list[list[str]]:  # noqa: F811
    """Texts of the table's columns, as they stand."""
    rows = page.locator(TABLE).evaluate(
        "own => [...own.tBodies[0].rows].map(row => [...row.cells].map(c => c.innerText))"
    )
    return [list(own) for own in zip(*rows, strict=True)]


def in_order(texts: list[str], down: bool) -> bool:
    """Whether a column of numbers falls or rises, with what is not known at the end."""
    known = [text for text in texts if text != "–"]
    values = [float(text.replace("−", "-").replace(",", "")) for text in known]
    steps = np.diff(values)
    return texts[: len(known)] == known and bool((steps <= 0).all() if down else (steps >= 0).all())


def test_every_column_sorts(page):  # noqa: F811
    """By click and by Enter, the other way round each time; the head says which way."""
    page.evaluate("document.getElementById('table').open = true")
    heads = page.locator(f"{TABLE} th")
    for at in range(heads.count()):
        ways = []
        for press in ("click", "Enter"):
            button = heads.nth(at).locator("button")
            button.click() if press == "click" else button.press("Enter")
            ways.append(heads.nth(at).get_attribute("aria-sort"))
            others = [heads.nth(k).get_attribute("aria-sort") for k in range(heads.count()) if k != at]
            assert set(others) == {"none"}
            texts = columns(page)[at]
            if all(re.fullmatch(r"–|[−-]?[\d.,]+(e[+-]?\d+)?", text) for text in texts):
                assert in_order(texts, ways[-1] == "descending"), (at, press)
        assert set(ways) == {"ascending", "descending"}


@pytest.mark.parametrize("way", ["click", "Enter"])
def test_a_row_opens_its_frame(page, way):  # noqa: F811
    """By a click anywhere in it, and by Enter on its name."""
    page.evaluate("looks.unfold(false); document.getElementById('table').open = true")
    row = page.locator(f"{TABLE} tbody tr").nth({"click": 1, "Enter": 2}[way])
    number = row.get_attribute("data-frame")
    row.locator("td").last.click() if way == "click" else row.locator("button, a").first.press("Enter")
    page.wait_for_selector(f"#viewer[data-frame='{number}']", timeout=10_000)
    assert page.evaluate("document.getElementById('frames').open")
    assert page.evaluate("looks.chosen()") == page.evaluate("looks.frame", int(number))


def test_the_worst_frame_comes_first(page, held):  # noqa: F811
    """The first row is the frame of which the best model that there is leaves most."""
    page.reload()
    page.evaluate("document.getElementById('table').open = true")
    _, views, dims = held
    first = page.locator(f"{TABLE} tbody tr").first
    number, key = int(first.get_attribute("data-frame")), first.locator("[data-key]").first.get_attribute("data-key")
    left = views[key.removeprefix("views.").split("[")[0]].transpose(*dims).values
    # Where nothing was added to it, the declared model is the best.
    assert not key.startswith("views.simulated") or "declared" not in views
    if np.isfinite(left).any():
        assert left[tuple(page.evaluate("looks.frame", number))] == np.nanmax(left)
