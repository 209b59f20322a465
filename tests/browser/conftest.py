"""A browser, and the results whose pages are opened in it."""

from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from playwright.sync_api import Browser, Error

from tests.browser.opening import executable, from_disk, started
from tests.conftest import ROOT

REPORT = ROOT / "workflow" / "spotcheck" / "report"


def shared_with(name: str, fixture: str):
    """Results that other tests make as well, on the worker that has them."""
    return pytest.param(fixture, id=name, marks=[pytest.mark.slow, pytest.mark.xdist_group(name)])


# A whole dataset with a verdict; a scan along z, without exposures; flats and darks alone; what `make` left.
RESULTS = [
    shared_with("small run", "small_run"),
    shared_with("sample", "sample_run"),
    shared_with("flats", "flats_run"),
    pytest.param("default_run", id="default"),
]


@pytest.fixture(scope="session")
def default_run():
    """Results of the default dataset, where their page is the one that this code writes."""
    page = ROOT / "results" / "virtual-rig" / "report.html"
    if not page.exists():
        pytest.skip("the default dataset has no page: `make` writes it")
    if page.stat().st_mtime < max(
        path.stat().st_mtime for folder in ("pages", "dataset_page") for path in (REPORT / folder).iterdir()
    ):
        pytest.skip("the page of the default dataset is older than the code that writes it: `make` renews it")
    return page.parent


@pytest.fixture(scope="session", params=RESULTS)
def results(request):
    """A results folder with its page."""
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def opened(chromium, results):
    """The page from disk, without a network."""
    with from_disk(chromium, results / "report.html") as own:
        yield own


@pytest.fixture(scope="package")
def chromium() -> Iterator[Browser]:
    """The system's browser; where it is missing, or does not start, its tests are skipped."""
    if executable() is None:
        pytest.skip("there is no Chromium on this machine")
    with ExitStack() as stack:
        try:
            browser = stack.enter_context(started())
        except Error as error:
            pytest.skip(f"Chromium does not start: {error.message.splitlines()[0]}")
        yield browser
