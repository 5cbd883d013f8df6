"""The pictures of the documentation that no benchmark makes: ``python docs/make_pictures.py viewer -m output/abc123``.

Needs playwright and a Chromium (see tests/browser.py).
"""

import argparse
import re
import subprocess
import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent / "tests"))

from browser import browser_page  # noqa: E402

PATIENCE = 180_000  # ms, on a machine without a GPU that is busy


def viewer(model: str) -> Path:
    """The page of ``warp-splat view``, at the camera of the third photograph."""
    command = [sys.executable, "-m", "warp_splat", "view", model]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            address = next(found[0] for line in server.stdout if (found := re.search(r"http://[\d.:]+", line)))
            with browser_page(1200, 675) as (page, errors):
                page.goto(f"{address}/?fixedDpr=1")
                page.get_by_text("px in").wait_for(timeout=PATIENCE)
                for _ in range(3):
                    page.get_by_role("button", name="next").click()
                page.locator(".mantine-Notification-closeButton").click()  # that WebGL runs in software here
                page.mouse.move(600, 600)
                page.wait_for_timeout(8000)  # until it is sharp
                path = DOCS / "images" / "viewer.jpg"
                page.screenshot(path=path, type="jpeg", quality=85)
                assert not errors, errors
        finally:
            server.terminate()
    return path


PICTURES = {"viewer": viewer}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("picture", choices=PICTURES)
    parser.add_argument("-m", dest="model", required=True, help="folder of a trained model")
    chosen = parser.parse_args()
    print(PICTURES[chosen.picture](chosen.model))
