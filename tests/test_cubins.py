"""Every CUDA kernel compiles ahead of time for every architecture, without spills, and needs no more than it did."""

import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

import cubins  # noqa: E402

KEYS = ("registers", "static_shared", "dynamic_shared")


def recorded():
    """What ``benchmarks/cubins.py --out docs/cuda`` wrote, by (module, kernel, architecture)."""
    records = json.loads((ROOT / "docs/cuda/cubins.json").read_text())["records"]
    return {(record["module"], record["kernel"], record["arch"]): record for record in records}


@pytest.mark.skipif(cubins.cuobjdump() is None, reason="cuobjdump is missing (it comes with triton, torch's on Linux)")
@pytest.mark.parametrize(
    "arch",
    [
        pytest.param(90, marks=pytest.mark.slow),
        *(pytest.param(arch, marks=pytest.mark.long) for arch in (75, 80, 86, 89)),
    ],
)
def test_resources(arch):
    before, seen = recorded(), set()
    for name, module in cubins.modules().items():
        for record in cubins.resources(name, module, arch, cubins.cuobjdump()):
            place = (record["module"], record["kernel"], arch)
            seen.add(place)
            assert record["stack"] == 0, place
            for key in KEYS:
                assert record[key] <= before[place][key], (place, key, "rerun benchmarks/cubins.py if that is wanted")
    assert seen == {place for place in before if place[2] == arch}


def test_occupancy():
    """Worked by hand: 72 registers take 18432 of a block's 256 threads, 3 blocks of 65536, 768 of 2048 threads."""
    record = {"arch": 90, "registers": 72, "static_shared": 2384, "dynamic_shared": 11312}
    assert cubins.occupancy(record) == pytest.approx(768 / 2048)
    assert cubins.occupancy(record | {"registers": 24, "dynamic_shared": 100_000}) == pytest.approx(512 / 2048)
