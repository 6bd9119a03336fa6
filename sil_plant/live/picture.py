"""A picture of the live page, taken by a browser without a window: this system's Chromium, led by playwright."""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from sil_plant.config import ConfigError

if TYPE_CHECKING:
    import playwright.sync_api

WIDTH, HEIGHT = 1200, 815
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_LOAD_LIMIT_MS, _LIMIT_S = 60_000, 180.0
_STOP_S = 20.0
_FADE_MS = 800.0
BEFORE_S, AFTER_S = 9.0, 8.6  # and after something has changed: so long it is watched
# WebGL by the processor, for computers without a screen
_FLAGS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--mute-audio")


def chromium() -> str:
    """The browser of this system.

    Raises
    ------
    ConfigError
        When there is none; with the next step.
    """
    for name in _BROWSERS:
        path = shutil.which(name)
        if path is not None:
            return path
    raise ConfigError(f"none of {', '.join(_BROWSERS)} is here: sudo apt-get install --no-install-recommends chromium")


@contextlib.contextmanager
def browser_page(width: int = WIDTH, height: int = HEIGHT) -> Iterator[playwright.sync_api.Page]:
    """A page of a browser without a window, closed at the end; one thread must do all with it."""
    from playwright.sync_api import sync_playwright

    flags = [*_FLAGS, *(["--no-sandbox"] if os.geteuid() == 0 else [])]
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium(), args=flags, timeout=_LOAD_LIMIT_MS)
        try:
            yield browser.new_page(viewport={"width": width, "height": height})
        finally:
            browser.close()


def wait_for_estimate(page: playwright.sync_api.Page, limit_ms: int = _LOAD_LIMIT_MS) -> None:
    """Wait until the page shows a load estimate, and an ECU in RUN."""
    page.wait_for_function(
        """() => {
            const load = document.querySelector('[data-diarc="load"]');
            const mode = document.querySelector('[data-diarc="mode"]');
            return load && /^-?[0-9]/.test(load.textContent) && mode && mode.textContent === 'RUN';
        }""",
        timeout=limit_ms,
    )


class Picture:
    """Takes the picture in a thread, while the tool goes on showing.

    Parameters
    ----------
    url : str
        Of the page.
    path : Path
        The file to write.
    change : callable
        Lets something happen that is worth a picture.

    Attributes
    ----------
    problem : str
        Why there is none; empty when there is one.
    """

    def __init__(self, url: str, path: Path, change: Callable[[], None]) -> None:
        self.problem = "it was broken off"
        self._give_up = threading.Event()
        self._thread = threading.Thread(target=self._take, args=(url, path, change), daemon=True)
        self._thread.start()

    def _take(self, url: str, path: Path, change: Callable[[], None]) -> None:
        try:
            with browser_page() as page:
                page.goto(url, timeout=_LOAD_LIMIT_MS)
                wait_for_estimate(page, int(_LIMIT_S * 1e3))
                for pause_s, action in ((BEFORE_S, change), (AFTER_S, lambda: None)):
                    if self._give_up.wait(pause_s):
                        return
                    action()
                for notice in page.locator(".mantine-Notification-closeButton").all():
                    notice.click()  # "no graphics card here"
                page.wait_for_timeout(_FADE_MS)
                path.parent.mkdir(parents=True, exist_ok=True)
                page.screenshot(path=str(path))
            self.problem = ""
        except Exception as error:  # playwright's, the system's: one line for the user
            self.problem = str(error).partition("\n")[0] or type(error).__name__

    def done(self) -> bool:
        """Whether it is over."""
        return not self._thread.is_alive()

    def stop(self) -> None:
        """End it."""
        self._give_up.set()
        self._thread.join(_STOP_S)
