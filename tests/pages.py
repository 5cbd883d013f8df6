"""What tests of exported pages share: a reader of theirs, names of strangers, and Gaussians for them."""

import gzip
from html.parser import HTMLParser

import numpy as np
from splat_files import some_splats

from warp_splat.export_html import pack
from warp_splat.formats.splats import SplatArrays
from warp_splat.rendering.camera_paths import ORBIT_LENS, orbit_cameras

EVIL = "</script><script>window.evil = 1</script><img src=x onerror='window.evil = 1'>\u2028.jpg"
OPTIONS = {"ANTIALIASED": False, "ELLIPSOID": False, "LINEAR": False, "BACKGROUND": 0.0}
CAMERAS = [("one", orbit_cameras(np.zeros(3), np.array([0, -1.0, 0]), np.array([0, 0, -9.0]), 1, ORBIT_LENS)[0])]


class Blocks(HTMLParser):
    """The scripts of a page by id, and all tags."""

    def __init__(self, text):
        super().__init__()
        self.found, self.tags, self.open = {}, [], None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.open = dict(attrs).get("id", "program") if tag == "script" else tag

    def handle_data(self, data):
        self.found[self.open] = self.found.get(self.open, "") + data

    def handle_endtag(self, tag):
        self.open = None


def unpacked(blocks, count, coefficients):
    """The numbers of warp_splat/export_html/pack.py's tables, decoded as it says."""

    def table(name):
        found = [np.frombuffer(gzip.decompress(data), np.uint8) for id, data in blocks.items() if id.startswith(name)]
        parts = [part.reshape(-1, min(pack.CHUNK, count - k * pack.CHUNK)).T for k, part in enumerate(found)]
        return np.concatenate(parts) if parts else np.zeros((count, 0), np.uint8)

    rows = table("gaussians")
    shorts = rows[:, 12:32].copy().view("<i2").astype(np.float64)
    opacities = rows[:, 18:20].copy().view("<u2")[:, 0] / 65535
    half = shorts[:, 4:7] / 8192  # tan(angle / 4) times the axis
    norm = (half**2).sum(axis=1, keepdims=True)
    quats = np.concatenate([(1 - norm) / (1 + norm), 2 * half / (1 + norm)], axis=1)
    groups = table("harmonics").reshape(count, pack.texels(coefficients), 16)
    rest = (
        groups[:, :, :15].view(np.int8).reshape(count, -1, 5, 3)
        * (2.0 ** groups[:, :, 15].astype(np.float64) / 128)[:, :, None, None]
    )
    sh = np.concatenate([shorts[:, None, 7:10] / 256, rest.reshape(count, -1, 3)], axis=1)[:, :coefficients]
    return SplatArrays(rows[:, :12].copy().view("<f4"), sh, opacities, shorts[:, :3] / 256, quats)


def many_splats():
    splats = some_splats(10_000)
    splats.scales[:] -= 3.0
    return splats
