"""A real Chromium without a window, driven by playwright; its WebGL runs in software.

Both come with neither this package nor its tests' dependencies alone: playwright drives a Chromium that is installed
(``apt-get install chromium``), or its own (``playwright install chromium``), or the one that WARP_SPLAT_CHROMIUM names.
"""

import os
import shutil
from contextlib import contextmanager

import pytest

CHROMIUM = os.environ.get("WARP_SPLAT_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


@contextmanager
def browser_page(width: int = 1280, height: int = 720):
    """Yield a page of playwright's, and a list of the errors that its console shows, which grows; skip without one."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright not found: pip install playwright")
    with api.sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        except api.Error as error:
            if CHROMIUM:
                raise
            pytest.skip(f"no Chromium: apt-get install chromium, or playwright install chromium ({error!s:.80})")
        try:
            page = browser.new_page(viewport={"width": width, "height": height})
            errors: list[str] = []
            page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
            page.on("pageerror", lambda error: errors.append(str(error)))
            yield page, errors
        finally:
            browser.close()
