"""Pages opened in the system's Chromium, cut off from any network."""

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

LOOKS = Path(__file__).with_name("looks.js")
# Window [px] of a small notebook, on which the first screen must fit.
WINDOW = (1280, 800)
# Schemes of addresses that need no network.
AT_HOME = ("file:", "data:", "blob:", "about:")
# How long [ms] anything on a page may take: ten times what it takes on two cores that others use as well.
PATIENCE = 60_000
# How long [s] a page may look wrong after a change of the window: graphs are drawn anew behind it.
REST = 15.0


class Opened(NamedTuple):
    """A page, the addresses elsewhere that it asked for, and what its console and its scripts complained of."""

    page: Page
    outside: list[str]
    errors: list[str]


def executable() -> str | None:
    """The system's Chromium, where there is one."""
    return shutil.which("chromium") or shutil.which("chromium-browser")


@contextmanager
def started() -> Iterator[Browser]:
    """Chromium without a window; never the one that Playwright would download."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable(), timeout=PATIENCE, args=["--disable-gpu"])
        yield browser
        browser.close()


@contextmanager
def alone(browser: Browser, window: tuple[int, int] = WINDOW, **options: Any) -> Iterator[Opened]:
    """An empty page in a context of its own, without a network; options are those of Playwright's `new_context`."""
    context = browser.new_context(viewport={"width": window[0], "height": window[1]}, offline=True, **options)
    context.set_default_timeout(PATIENCE)
    context.add_init_script(path=LOOKS)
    yield watched(context)
    context.close()


@contextmanager
def from_disk(browser: Browser, path: Path, **options: Any) -> Iterator[Opened]:
    """A page from disk, without a network."""
    with alone(browser, **options) as own:
        own.page.goto(path.resolve().as_uri())
        yield own


def watched(context: BrowserContext) -> Opened:
    """A new page that remembers what it asks for and what goes wrong in it."""
    page = context.new_page()
    opened = Opened(page, [], [])

    def asked(address: str) -> None:
        if not address.startswith(AT_HOME):
            opened.outside.append(address)

    page.on("request", lambda request: asked(request.url))
    page.on("websocket", lambda socket: asked(socket.url))
    page.on("console", lambda line: opened.errors.append(line.text) if line.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: opened.errors.append(str(error)))
    return opened


def look(page: Page, name: str, *arguments: object) -> str:
    """Faults that a function of looks.js finds once the page has come to rest, one a line; empty where none is."""
    deadline = time.monotonic() + REST
    while True:
        faults = page.evaluate("([name, own]) => looks[name](...own)", [name, list(arguments)])
        if not faults or time.monotonic() > deadline:
            return "\n".join(faults)
        page.wait_for_timeout(100)


def tabbed(page: Page) -> list[dict[str, Any]]:
    """Where Tab leads from the top of the page, once for every control: `at` counts controls in the order of the
    document (−1: none of them), `seen` says whether the focus shows there."""
    page.evaluate("document.activeElement.blur()")
    steps = []
    for _ in range(page.evaluate("looks.controls().length")):
        page.keyboard.press("Tab")
        steps.append(page.evaluate("looks.focused()"))
    return steps
