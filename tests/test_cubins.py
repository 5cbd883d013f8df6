"""Every CUDA kernel compiles ahead of time for every architecture, without spills, and needs no more than it did."""

import json

import cubins
import pytest
from commands import ROOT

SM_90, OTHERS = pytest.param(90, marks=pytest.mark.slow), (75, 80, 86, 89, 100, 120)
KEYS = ("registers", "static_shared", "dynamic_shared", "loop")


RECORDED = json.loads((ROOT / "docs/cuda/cubins.json").read_text())  # by ``benchmarks/cubins.py --out docs/cuda``


@pytest.mark.skipif(cubins.cuobjdump() is None, reason="cuobjdump is missing (it comes with triton, torch's on Linux)")
@pytest.mark.parametrize("arch", [SM_90, *(pytest.param(arch, marks=pytest.mark.long) for arch in OTHERS)])
def test_resources(arch):
    """Of what has changed since they were recorded; the rest would be compiled to the same again."""
    before = {(record["module"], record["kernel"]): record for record in RECORDED["records"] if record["arch"] == arch}
    seen, versions = set(), cubins.versions_of()
    for name, module in cubins.modules().items():
        if versions[name] == RECORDED["versions"].get(name):
            found = [record for place, record in before.items() if place[0] == name]
        else:
            found = cubins.resources(name, module, arch, cubins.cuobjdump())
        for record in found:
            place = record["module"], record["kernel"]
            seen.add(place)
            assert record["stack"] == 0, place
            for key in KEYS:
                assert record[key] <= before[place][key], (place, key, "rerun benchmarks/cubins.py if that is wanted")
    assert seen == set(before)


def test_occupancy():
    """Worked by hand: 72 registers take 18432 of a block's 256 threads, 3 blocks of 65536, 768 of 2048 threads."""
    record = {"arch": 90, "threads": 256, "registers": 72, "static_shared": 2384, "dynamic_shared": 11312}
    assert cubins.occupancy(record) == pytest.approx(768 / 2048)
    small = record | {"threads": 32, "dynamic_shared": 0}
    assert cubins.occupancy(small) == pytest.approx(28 * 32 / 2048)  # blocks, by registers
    assert cubins.occupancy(record | {"registers": 24, "dynamic_shared": 100_000}) == pytest.approx(512 / 2048)


def test_longest_loop():
    """0x10 to 0x40 holds another loop; of the two that hold none, 0x50 to 0x80 is the longer."""
    lines = ["name", *(f"/*{16 * i:04x}*/  NOP ;" for i in range(9))]
    lines[4] = "/*0030*/  @P0 BRA 0x20 ;"
    lines[5] = "/*0040*/  @!P1 BRA 0x10 ;"
    lines[9] = "/*0080*/  BRA.U UP0, `(.L_x_1) 0x50 ;"
    assert cubins.longest_loop("\n".join(lines)) == ("name", 4)
