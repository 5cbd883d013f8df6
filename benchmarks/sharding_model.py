"""A model of the time of a step whose Gaussians lie in blocks on n processes, and what it says of many of them.

    python benchmarks/sharding_model.py [--out docs/benchmarks]

The seconds of a step of V views, of G Gaussians of which a view shows S, where n processes have a card or core each:

    V G/n project + G/n update + V/n (S splat + view) + V/n (4 (n - 1) latency + 92 S (1 - 1/n) / bandwidth)

``project`` is twice a projection and once its adjoint, ``update`` Adam and what else looks at each Gaussian. These, and
``splat`` and ``view``, are fitted to what ``sharding.py`` measured on CPUs (a core runs so many processes by turns), or
are the least that ``gpu_model.py`` finds for an H200. Networks are as their makers promise.
"""

import json
from typing import NamedTuple

import numpy as np
from common import ROOT, parse, write_table
from gpu_counts import Scene
from gpu_model import CARDS, times
from sharding import SENT, VIEWS

RESULTS = ROOT / "docs" / "benchmarks"
CORES = 2  # of the machine that measured
STATE = 4 * 4 * 59  # bytes of a Gaussian: parameters, gradients, two moments
DRAWING = ("bin", "blend", "loss", "adjoint of loss", "adjoint of blend")


class Network(NamedTuple):
    """Of one process, each way."""

    latency: float  # s of a message: assumed
    bandwidth: float  # bytes/s


NETWORKS = {
    "10 GbE": Network(50e-6, 1.25e9),  # IEEE 802.3ae; TCP's usual latency in one room
    "InfiniBand EDR": Network(2e-6, 12.5e9),  # 100 Gb/s: NVIDIA's ConnectX-5 data sheet
    "NVLink 4": Network(2e-6, 450e9),  # 900 GB/s both ways together: NVIDIA's H100 data sheet
}
#: Gaussians, splats of a view, processes: as many views in a step as processes.
ASKED = [(4e6, 353e3, 8), (4e6, 353e3, 64), (100e6, 2e6, 8), (100e6, 2e6, 64), (1e9, 5e6, 8), (1e9, 5e6, 64)]
COLUMNS = {
    **{"Gaussians": "{gaussians:.0f} M", "splats a view": "{splats:.2f} M", "processes": "{count}"},
    **{"GB each": "{held:.1f}", "computed by": "{by}", "network": "{network}", "Gaussians s": "{own:.3g}"},
    **{"drawing s": "{drawing:.3g}", "network s": "{exchange:.3g}", "s an image": "{image:.3g}", "most": "{most}"},
}


class Costs(NamedTuple):
    """Seconds."""

    project: float  # of a Gaussian in a view
    update: float  # of a Gaussian in a step
    splat: float  # that a view shows
    view: float

    def step(self, gaussians: float, splats: float, views: int, count: int, network: Network | None) -> tuple:
        """Of the Gaussians, of the drawing, and of the network."""
        own, rounds = gaussians / count, views / count
        sent = SENT * splats * (1 - 1 / count)
        exchange = rounds * (4 * (count - 1) * network.latency + sent / network.bandwidth) if network else 0.0
        return own * (views * self.project + self.update), rounds * (splats * self.splat + self.view), exchange


def fitted(records: list[dict]) -> tuple[Costs, Network, list[tuple[float, float]]]:
    """Of CPUs: costs of a thread, the network between its processes, and each step as measured and as modeled."""
    turns = [max(1.0, one["count"] / CORES) for one in records]
    own = np.array([turn * one["gaussians"] / one["count"] for turn, one in zip(turns, records, strict=True)])
    rounds = np.array([turn * VIEWS / one["count"] for turn, one in zip(turns, records, strict=True)])
    stage = lambda *names: np.array([sum(one["stages"].get(name, 0.0) for name in names) for one in records])  # noqa: E731
    steps, splats = np.array([one["step"] for one in records]), np.array([one["splats"] for one in records])
    update, drawing = stage("Adam", "densify"), stage(*DRAWING)
    left = steps - update - drawing - stage("exchange", "photographs")
    ratio = lambda y, x: float(np.exp(np.mean(np.log(y / x))))  # noqa: E731 - errors are shares
    splat, view = np.polyfit(splats, drawing / rounds, 1)
    costs = Costs(ratio(left, VIEWS * own), ratio(update, own), float(splat), float(view))
    trips = [(int(size), seconds) for one in records for size, seconds in one["trips"].items()]
    slope, least = np.polyfit(*np.array(trips).T, 1)
    loopback = Network(max(least, 0.0) / 2, 1 / slope)  # a trip is two exchanges: of counts, and of rows
    modeled = [
        turn * sum(costs.step(one["gaussians"], one["splats"], VIEWS, one["count"], loopback))
        for turn, one in zip(turns, records, strict=True)
    ]
    return costs, loopback, list(zip(steps.tolist(), modeled, strict=True))


def least() -> Costs:
    """Of an H200, by what ``gpu_model.py`` counts: a million Gaussians, in an image of half a million pixels."""
    ball = Scene(**json.loads((RESULTS / "gpu_model.json").read_text())["scenes"]["ball"])
    found = {stage: 1e-3 * max(pair) for stage, pair in times(ball, CARDS["H200"]).items()}
    project = 2 * found["project"] + found["adjoint of project"]
    drawing = sum(found[stage] for stage in DRAWING)
    update = found["Adam"] + found["densify"]
    return Costs(project / ball.gaussians, update / ball.gaussians, drawing / ball.drawn, 0.0)


def main() -> None:
    arguments = parse(__doc__)
    costs, loopback, checked = fitted(json.loads((RESULTS / "sharding.json").read_text())["records"])
    machines = [("a core", costs, "10 GbE"), *(("an H200", least(), network) for network in NETWORKS)]
    rows = []
    for gaussians, splats, count in ASKED:
        for by, one, network in machines:
            if network == "NVLink 4" and count > 8:  # of one machine
                continue
            parts = one.step(gaussians, splats, count, count, NETWORKS[network])
            row = {"gaussians": gaussians / 1e6, "splats": splats / 1e6, "count": count, "by": by, "network": network}
            row |= {"held": STATE * gaussians / count / 1e9, "image": sum(parts) / count}
            row |= {"most": ("Gaussians", "drawing", "network")[int(np.argmax(parts))]}
            rows.append({**row, **dict(zip(("own", "drawing", "exchange"), parts, strict=True))})
    off = max(abs(np.log(modeled / measured)) for measured, modeled in checked)
    note = (
        f"Seconds of a step with as many views as processes. A core: {1e9 * costs.project:.0f} ns for a Gaussian in a "
        f"view, {1e9 * costs.update:.0f} ns in a step, {1e9 * costs.splat:.0f} ns for a splat, {1e3 * costs.view:.0f} "
        f"ms for a view of 264 x 248 px, and between processes {loopback.bandwidth / 1e9:.2f} GB/s and "
        f"{1e3 * loopback.latency:.2f} ms: fitted to sharding.json, from whose steps it is off by a factor of "
        f"{np.exp(off):.2f} at most. An H200: the least that gpu_model.py finds; no GPU was measured. GB: parameters, "
        "gradients, moments."
    )
    data = {"rows": rows, "costs": costs._asdict(), "checked": checked, "off": float(np.exp(off))}
    write_table("sharding_model", arguments.out, COLUMNS, rows, note, data)


if __name__ == "__main__":
    main()
