"""The pictures of the documentation that no benchmark makes: ``python docs/make_pictures.py page -m output/abc123``.

Needs playwright and a Chromium (see tests/browser.py).
"""

import argparse
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent / "tests"))

from browser import browser_page  # noqa: E402

from warp_splat.cli import main  # noqa: E402


def page(model: str) -> Path:
    """The page of ``warp-splat export-html`` at its first camera, after a drag."""
    with tempfile.TemporaryDirectory() as folder, browser_page(960, 640) as (browser, errors):
        exported = Path(folder) / "page.html"
        assert main(["export-html", model, str(exported)]) == 0
        browser.goto(exported.as_uri())
        browser.wait_for_selector("#message:empty", state="attached")
        browser.mouse.move(480, 300)
        browser.mouse.down()
        browser.mouse.move(560, 290, steps=4)
        browser.mouse.up()
        browser.wait_for_timeout(3000)  # until it is sharp
        path = DOCS / "images" / "page.jpg"
        browser.screenshot(path=path, type="jpeg", quality=80)
        assert not errors, errors
    return path


PICTURES = {"page": page}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("picture", choices=PICTURES)
    parser.add_argument("-m", dest="model", required=True, help="folder of a trained model")
    chosen = parser.parse_args()
    print(PICTURES[chosen.picture](chosen.model))
