"""How many pixels a frame may have so that frames come as fast as one can steer."""

from __future__ import annotations

FRAME_SECONDS = 0.1  # to draw one while moving: 10 per second, of which the way to the browser may take half
LARGEST = (1920, 1080)  # px; a frame at rest has at most this area
FEWEST, MOST = 100 * 100, LARGEST[0] * LARGEST[1]  # pixels
CHANGE = (0.25, 1.5)  # from one frame to the next: down quickly, up slowly


class Pace:
    """The pixels that a moving frame may have, learned from what the last ones took.

    A frame also has costs without any pixel. That only makes the steps too short: the size still settles where a frame
    takes FRAME_SECONDS, or at a bound.
    """

    def __init__(self):
        self.pixels = 0.25 * MOST

    def took(self, seconds: float, pixels: int) -> None:
        """Note that a frame of ``pixels`` took ``seconds``."""
        change = min(max(FRAME_SECONDS / max(seconds, 1e-6), CHANGE[0]), CHANGE[1])
        self.pixels = min(max(pixels * change, FEWEST), MOST)
