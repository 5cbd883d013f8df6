"""Makes the pictures of the documentation that show a program: uv run python docs/make_pictures.py -m output/abc123"""

import argparse
import sys
import tempfile
from pathlib import Path

from warp_splat.cli import main

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from browser import browser_page  # noqa: E402

LARGEST = 150_000  # bytes of a picture


def page(model: Path, target: Path) -> None:
    """What export-html's page of ``model`` shows after a drag, as a JPEG file."""
    with tempfile.TemporaryDirectory() as folder, browser_page(960, 640) as (browser, errors):
        path = Path(folder) / "page.html"
        main(["export-html", str(model), str(path)])
        browser.goto(path.as_uri())
        browser.wait_for_selector("#message:empty", state="attached")
        browser.mouse.move(480, 300)
        browser.mouse.down()
        browser.mouse.move(560, 290, steps=4)
        browser.mouse.up()
        browser.wait_for_timeout(2000)
        browser.screenshot(path=target, type="jpeg", quality=80)
        assert not errors and target.stat().st_size < LARGEST


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-m", "--model", type=Path, required=True, help="a model trained on the embedded scene")
    page(parser.parse_args().model, ROOT / "docs" / "images" / "page.jpg")
