"""Compile every CUDA kernel ahead of time, without a GPU, and tell what it needs: registers, stack, shared memory.

    python benchmarks/cubins.py [--out docs/cuda]

Stack must be 0: a kernel that spills registers to memory is slow without a word. Occupancy is the share of the
threads that fit on a multiprocessor at once. The loop is the longest one without another in it, in instructions of the
machine code; of a blend, that is what a warp does for a tile instance at most.
"""

import hashlib
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import warp as wp
from common import parse, versions, write_table

from warp_splat.config import ADJOINTS, STRONGEST_MOST
from warp_splat.kernels import sh_colors
from warp_splat.kernels.activation import make_activate, make_adj_activate
from warp_splat.kernels.color_map import make_adj_map_colors, make_map_colors
from warp_splat.kernels.cuda import channels, lists
from warp_splat.kernels.cuda.adam_by_number import make_adam_by_number
from warp_splat.kernels.cuda.adjoint import make_reverse, make_upstream
from warp_splat.kernels.cuda.blend import make_blend
from warp_splat.kernels.cuda.comparison import compare_block
from warp_splat.kernels.cuda.gather import make_gather
from warp_splat.kernels.cuda.taped import make_walk
from warp_splat.kernels.environment import make_adj_put_behind, make_put_behind
from warp_splat.kernels.falloff import reach_of
from warp_splat.kernels.project import adj_camera, affine, ellipsoid
from warp_splat.kernels.project.quarantine import quarantine
from warp_splat.kernels.project.rolling import make_expose
from warp_splat.kernels.project.shared import make_project
from warp_splat.kernels.splat import BlendVariant
from warp_splat.kernels.statistics import make_observe
from warp_splat.lenses.formulas import MODELS, PINHOLE
from warp_splat.raster.beside import WIDTHS as CHANNEL_WIDTHS
from warp_splat.raster.data import WIDTHS

REGISTERS = 65536  # of a multiprocessor, all architectures below
#: Architecture: threads, blocks and KiB of shared memory of a multiprocessor (CUDA C++ Programming Guide, table of
#: technical specifications per compute capability).
LIMITS = {
    **{75: (1024, 16, 64), 80: (2048, 32, 164), 86: (1536, 16, 100), 89: (1536, 24, 100)},
    **{90: (2048, 32, 228), 100: (2048, 32, 228), 120: (1536, 24, 100)},
}

PROPERTIES = re.compile(r"Function (\S+):\s+REG:(\d+) STACK:(\d+) SHARED:(\d+)")
INSTRUCTION = re.compile(r"/\*([0-9a-f]{4,6})\*/\s+(.*?);")
BRANCH = re.compile(r"\bBRA\b.*?\b0x([0-9a-f]+)")


def modules() -> dict[str, wp.Module]:
    """What runs on CUDA, by the name under which it is listed."""
    found = {
        "project": make_project(affine.PROJECTION, reach_of, 1, None).module,
        "project, ellipsoid": make_project(ellipsoid.PROJECTION, reach_of, 1, None).module,
        "project, rolling shutter": make_project(affine.PROJECTION, reach_of, 1, make_expose(PINHOLE, 1)).module,
        "adjoint of pose": adj_camera.make_adj_pose(1).module,
        "adjoint of intrinsics": adj_camera.make_adj_intrinsics(1).module,
        "shade": sh_colors.make_shade(1).module,
        "adjoint of shade": sh_colors.make_adj_shade(1).module,
        "adjoint of coefficients": sh_colors.make_adj_rest().module,
        "quarantine": quarantine.module,
        "activate": make_activate(1).module,
        "adjoint of activate": make_adj_activate(1).module,
        "observe": make_observe(1).module,
        "loss": compare_block.module,
        "adam": make_adam_by_number(False).module,
        "adam, sparse": make_adam_by_number(True).module,
        "adam, halves": make_adam_by_number(False, True).module,
        "adam, sparse halves": make_adam_by_number(True, True).module,
        "map of colors": make_map_colors(1).module,
        "adjoint of the map": make_adj_map_colors(1).module,
        "environment": make_put_behind(1).module,
        "adjoint of environment": make_adj_put_behind(1).module,
        "count tiles": lists.make_count_tiles(reach_of).module,
        "list tiles": lists.make_list_tiles(True).module,
        "list tiles, many": lists.make_list_tiles(False).module,
        "gather tiles": lists.make_gather_tiles(True).module,
        "gather tiles, many": lists.make_gather_tiles(False).module,
    }
    for name in ("OPENCV", "OPENCV_FISHEYE"):
        family = MODELS[name][0]
        found[f"project, {name}"] = make_project(affine.through(family), reach_of, 1, None).module
        found[f"adjoint of {name}"] = make_project(affine.through(family, True), reach_of, 1, None).module
    for depth in (False, True):
        suffix, variant = ", depth" if depth else "", BlendVariant(3 + depth)
        found[f"blend{suffix}"] = make_blend(variant).module
        found[f"blend, stored{suffix}"] = make_blend(variant._replace(keep=True)).module
        found[f"upstream{suffix}"] = make_upstream(variant).module
        found[f"gather{suffix}"] = make_gather(WIDTHS[: 4 + depth]).module
        for mode in ADJOINTS[:2]:
            found[f"{mode}{suffix}"] = make_reverse(mode, variant).module
        for mode in ADJOINTS[2:]:
            found[f"{mode}{suffix}"] = make_walk(mode, variant).module
    plain = BlendVariant()
    found["gather, channels"] = make_gather((*WIDTHS[:3], CHANNEL_WIDTHS[-1])).module
    found["channels"] = channels.make_beside(plain).module
    for mode in ADJOINTS[:2]:
        found[f"{mode}, channels"] = channels.make_adj_channels(mode, plain).module
    found["weights"] = channels.make_adj_channels("manual", plain, STRONGEST_MOST).module
    found["magnitudes"] = channels.make_adj_channels("absolute", plain).module
    found["strongest"] = channels.make_beside(plain, STRONGEST_MOST).module
    return found


def versions_of() -> dict[str, str]:
    """What a module's machine code depends on, by its name: a change of Warp, of its source or options changes it."""
    here = f"{wp.config.version}, {hashlib.sha256(Path(__file__).read_bytes()).hexdigest()}"  # and of how
    return {name: f"{here}, {module.hash_module().hex()}" for name, module in modules().items()}


def cuobjdump() -> str | None:
    """NVIDIA's disassembler, which comes with triton, which comes with torch on Linux; None elsewhere."""
    places = (Path(folder) / "triton/backends/nvidia/bin/cuobjdump" for folder in sys.path)
    return next((str(place) for place in places if place.is_file()), None)


def resources(name: str, module: wp.Module, arch: int, tool: str) -> list[dict]:
    """A record for each kernel of the module, compiled for sm_<arch>."""
    with tempfile.TemporaryDirectory() as folder:
        wp.compile_aot_module(module, arch=arch, module_dir=folder, use_ptx=False)
        cubin = next(Path(folder).glob("*.cubin"))
        dynamic = json.loads(next(Path(folder).glob("*.meta")).read_text())
        ask = lambda what: subprocess.run([tool, what, str(cubin)], capture_output=True, text=True, check=True).stdout  # noqa: E731
        said, loops = ask("-res-usage"), dict(map(longest_loop, ask("-sass").split("Function : ")[1:]))
    records = []
    for function, registers, stack, shared in PROPERTIES.findall(said):
        kernel = re.sub(r"^.*__locals__|_[0-9a-f]{8}(?=_cuda)|_cuda_kernel|_forward$", "", function)
        record = {
            "module": name,
            "kernel": kernel.replace("_backward", ", adjoint"),
            "arch": arch,
            "threads": module.options["block_dim"],
            "registers": int(registers),
            "stack": int(stack),
            "static_shared": int(shared),
            "dynamic_shared": dynamic.get(f"{function}_smem_bytes", 0),
            "loop": loops[function],
        }
        records.append(record | {"occupancy": occupancy(record)})
    return records


def longest_loop(code: str) -> tuple[str, int]:
    """A function's name, and the instructions of its longest loop that has no other in it."""
    found = [(int(place, 16), text) for place, text in INSTRUCTION.findall(code)]
    jumps = [(int(match[1], 16), place) for place, text in found if (match := BRANCH.search(text))]
    loops = [(first, last) for first, last in jumps if first < last]
    inner = [a for a in loops if not any(b != a and a[0] <= b[0] and b[1] <= a[1] for b in loops)]
    return code.split(maxsplit=1)[0], max((sum(a <= place <= b for place, _ in found) for a, b in inner), default=0)


def occupancy(record: dict) -> float:
    """Share of a multiprocessor's threads that registers and shared memory leave room for."""
    threads, blocks, shared = LIMITS[record["arch"]]
    by_registers = REGISTERS // (-(-record["registers"] // 8) * 8 * record["threads"])
    used = record["static_shared"] + record["dynamic_shared"]
    by_shared = shared * 1024 // used if used else blocks
    return min(blocks, threads // record["threads"], by_registers, by_shared) * record["threads"] / threads


def main() -> None:
    arguments = parse(__doc__)
    tool = cuobjdump()
    if tool is None:
        raise SystemExit("cuobjdump is missing: it comes with triton, a dependency of torch on Linux.")
    records = [
        record
        for name, module in modules().items()
        for arch in LIMITS
        for record in resources(name, module, arch, tool)
    ]
    kernels = dict.fromkeys((record["module"], record["kernel"]) for record in records)
    rows = []
    for module, kernel in kernels:
        here = [record for record in records if (record["module"], record["kernel"]) == (module, kernel)]
        most = lambda key: max(record[key] for record in here)  # noqa: B023, E731
        shares = (f"{100 * record['occupancy']:.0f}" for record in here)
        shared = (most("static_shared"), most("dynamic_shared"))
        rows.append((module, kernel, most("threads"), most("registers"), most("stack"), *shared, most("loop"), *shares))
    headers = ("module", "kernel", "threads", "registers", "stack", "static B", "dynamic B", "loop")
    headers = (*headers, *(f"sm_{arch} %" for arch in LIMITS))
    note = "The most of any architecture; occupancy in percent. Loop: instructions of the longest that holds no other."
    note += f" {versions()}."
    write_table("cubins", arguments.out, headers, rows, note, {"records": records, "versions": versions_of()})


if __name__ == "__main__":
    main()
