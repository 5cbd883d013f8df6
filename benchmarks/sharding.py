"""Memory, traffic and time of steps whose Gaussians lie in blocks on 1, 2 and 4 processes, one thread each.

Cameras and photographs are those of the embedded scene. The Gaussians are small balls at random places of a box around
it, most of which no view shows. As root on Linux, processes have a network of their own, whose bytes are counted.

    python benchmarks/sharding.py [--gaussians 1000000] [--steps 5] [--out docs/benchmarks]
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import ROOT, option, parse, status, write_table

VIEWS, SPREAD, FEW = 4, 4.0, 1000
SENT = 52 + 40  # bytes of a splat that travels, and of its gradients
ROWS = (1, 1000, 10_000, 100_000, 400_000)  # of 52 bytes, exchanged by two processes: latency and bandwidth
MIB = 2**20
COLUMNS = {
    **{"Gaussians": "{gaussians}", "processes": "{count}", "MiB each": "{mib:.0f}", "of Gaussians": "{own:.0f}"},
    **{"x processes": "{share:.2f}", "held": "{held:.0f}", "splats a view": "{splats:.0f}"},
    **{"MB a step": "{sent:.2f}", "formula": "{formula:.2f}", "on the wire": "{wire:.2f}"},
    **{"s a step": "{step:.2f}", "s an image": "{image:.3f}", "exchange s": "{exchange:.2f}"},
}
ALONE = ["unshare", "--net", "sh", "-c", 'ip link set lo up && exec "$@"', "sh"]  # a network without other traffic


def on_the_wire() -> int:
    """Bytes that the loopback of this network has carried."""
    return next(int(line.split()[1]) for line in Path("/proc/net/dev").read_text().splitlines() if "lo:" in line)


def measure(gaussians: int, steps: int, place: Path) -> None:
    """What one of the processes does: a few steps, of which the first puts everything in its place."""
    import torch  # noqa: PLC0415 - only the processes need torch

    from warp_splat.runtime import launch, timers  # noqa: PLC0415
    from warp_splat.runtime.distributed import join  # noqa: PLC0415
    from warp_splat.runtime.shards import Shards  # noqa: PLC0415
    from warp_splat.scene import load_scene  # noqa: PLC0415
    from warp_splat.training.options import TrainConfig  # noqa: PLC0415
    from warp_splat.training.trainer import Trainer  # noqa: PLC0415

    launch.prepare("cpu", 1)
    scene, rng = load_scene(str(ROOT / "assets" / "still_life"), report=str), np.random.default_rng(0)
    config, sent, begun, wire, stages = TrainConfig(device="cpu", views=VIEWS, sh_interval=1), [0, 0], 0.0, 0, {}
    low, high = np.percentile(scene.points, (2, 98), axis=0)
    middle, reach = (low + high) / 2, (high - low) / 2 * (SPREAD, SPREAD, 1)
    points = rng.uniform(middle - reach, middle + reach, (gaussians, 3)).astype(np.float32)
    scene = replace(scene, points=points, colors=np.zeros(points.shape, np.uint8))
    with join("cpu", VIEWS, Shards) as processes:
        trainer = Trainer(scene, config, processes)
        trainer.warm_up()
        started, exchange = status("VmHWM"), getattr(processes, "exchange", list)

        def counted(rows):
            found = exchange(rows)
            sent[0] += sum(part.nbytes for rank, part in enumerate(rows) if rank != processes.rank)
            sent[1] += sum(len(part) for part in rows) * (rows[0].shape[1] == 13)
            return found

        if isinstance(processes, Shards):
            processes.exchange = counted
        for step in range(1, steps + 1):
            if step == 2:  # the first brings memory that is kept, and photographs
                Path("/proc/self/clear_refs").write_text("5")  # the peak is measured from here on
                sent[:], wire, begun = (0, 0), on_the_wire(), time.perf_counter()
            with timers.profile(step > 1) as stages:
                trainer.differentiate(step * VIEWS)
                trainer.update(step * VIEWS)
        seconds, wire = (time.perf_counter() - begun) / (steps - 1), on_the_wire() - wire
        peak, held = status("VmHWM"), sum(tensor.nbytes for tensor in trainer.state()[0].values())
        found = {"started": started, "peak": peak, "held": held, "step": seconds, "sent": sent[0] / (steps - 1)}
        found |= {"drawn": sent[1] / (steps - 1), "wire": wire / (steps - 1), "stages": stages, "trips": {}}
        for rows in ROWS if processes.count == 2 else ():
            table, times = torch.zeros(rows, 13), []
            for _ in range(9):
                begun = time.perf_counter()
                exchange([table[:0], table][:: 1 - 2 * processes.rank])
                times.append(time.perf_counter() - begun)
            found["trips"][rows * 52] = float(np.median(times))
        (place / f"{processes.rank}.json").write_text(json.dumps(found))


def run(gaussians: int, count: int, steps: int) -> dict:
    """What the processes of one run measured, the slowest and largest of them."""
    start = [*(ALONE if os.geteuid() == 0 else []), sys.executable]
    if count > 1:
        start += ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)]
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        options = ["--gaussians", str(gaussians), "--steps", str(steps), "--place", folder]
        subprocess.run([*start, __file__, *options], check=True, env=environment)
        found = [json.loads(path.read_text()) for path in sorted(Path(folder).glob("*.json"))]
    most = {name: max(one[name] for one in found) for name in ("started", "peak", "held", "step", "wire")}
    return {**found[0], **most, **{name: sum(one[name] for one in found) for name in ("sent", "drawn")}}


def record(gaussians: int, count: int, steps: int) -> dict:
    """A row of the table: beside what a training of FEW Gaussians takes."""
    fixed, found = run(FEW, count, 2)["peak"], run(gaussians, count, steps)
    splats, together = found["drawn"] / VIEWS, count > 1
    return {
        **{"gaussians": gaussians, "count": count, "mib": found["peak"] / MIB, "own": (found["peak"] - fixed) / MIB},
        **{"held": found["held"] / MIB, "started": (found["started"] - fixed) / MIB, "splats": splats},
        **{"sent": found["sent"] / 1e6, "formula": SENT * VIEWS * splats * (1 - 1 / count) * together / 1e6},
        **{"wire": found["wire"] * together / 1e6, "step": found["step"], "image": found["step"] / VIEWS},
        **{"stages": found["stages"], "trips": found["trips"], "exchange": found["stages"].get("exchange", 0.0)},
    }


def main() -> None:
    arguments = parse(
        __doc__,
        option("--gaussians", type=int, default=1_000_000),
        option("--steps", type=int, default=5, help="the first of which is not measured"),
        option("--place", type=Path, help="of a process that this script starts: where it writes what it measured"),
    )
    if arguments.place:
        measure(arguments.gaussians, arguments.steps, arguments.place)
        return
    before = arguments.out / "sharding.json" if arguments.out else None
    records = json.loads(before.read_text())["records"] if before and before.exists() else []
    records = [one for one in records if one["gaussians"] != arguments.gaussians]  # of other sizes stay
    records += [record(arguments.gaussians, count, arguments.steps) for count in (1, 2, 4)]
    records.sort(key=lambda one: (one["gaussians"], one["count"]))
    for one in records:
        some = {other["count"]: other for other in records if other["gaussians"] == one["gaussians"]}
        one["share"] = one["own"] * one["count"] / some[1]["own"]
        one["splats"] = some[2]["splats"]  # the same views; one process alone sends none
    note = (
        f"Embedded cameras, degree 3, {VIEWS} views a step, one thread each, the slowest and largest process of each "
        f"run. MiB: peak; of Gaussians: beyond that with {FEW} of them; held: parameters, gradients, moments; formula: "
        f"{SENT} bytes x splats of a view x views x (1 - 1/n); on the wire: all that the loopback carries."
    )
    write_table("sharding", arguments.out, COLUMNS, records, note, {"records": records})


if __name__ == "__main__":
    main()
