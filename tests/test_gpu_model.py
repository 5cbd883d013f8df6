"""What the model of a step on a GPU counts is what there is."""

import json
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import gpu_counts
import gpu_model
from gpu_counts import LAUNCHES, OPERATIONS, REST, WAITS
from made_up import cameras, make_gaussians


@pytest.mark.slow
def test_operations_and_waits():
    counts, x = gpu_counts.np.zeros(3), torch.arange(12.0).view(3, 4)
    with gpu_counts.Operations(counts):
        x[1:].T + x[:2].T.expand(4, 2)
    assert counts[[OPERATIONS, WAITS]].tolist() == [1, 0]
    for waits in (lambda: x.sum().item(), lambda: x[x > 3], lambda: int(x[0, 0]), x.nonzero):
        before = counts[WAITS]
        with gpu_counts.Operations(counts):
            waits()
        assert counts[WAITS] > before


def test_lines_of_pixels():
    """Of blocks of 4 x 4, block by block, to lines of 16."""
    tile = torch.arange(256.0).view(16, 16)
    blocks = tile.view(4, 4, 4, 4).permute(0, 2, 1, 3).reshape(1, 16, 16)
    assert torch.equal(gpu_counts.in_lines(blocks).view(16, 16), tile)


def test_scene():
    """A warp that blends has a pixel or 32 that do; what is walked is listed; and the same as by torch."""
    scene = gpu_counts.count_scene(make_gaussians(2000, "cpu"), cameras(80, 48, 1)[0])
    assert scene.tiles == 15 and scene.pixels == 80 * 48 and scene.gaussians == 2000
    assert 0 < scene.walked <= scene.instances and scene.warps <= scene.pairs <= 32 * scene.warps
    assert scene.warps <= 8 * scene.walked and scene.blocks <= 8 * scene.walked
    assert scene.pairs <= 32 * scene.blocks  # they hold every pixel that is blended into
    assert scene.halves <= min(2 * scene.walked, scene.blocks) and scene.blocks <= 4 * scene.halves


def test_a_card_of_twice_the_rates_takes_half_the_time():
    scene = gpu_counts.Scene(1000, 900, 5000, 20, 3000, 2500, 9000, 3500, 8000, 40_000)
    card = gpu_model.CARDS["H200"]
    twice = card._replace(clock=2 * card.clock, bandwidth=2 * card.bandwidth)
    slow, fast = (gpu_model.times(scene, one) for one in (card, twice))
    assert set(slow) == set(gpu_model.STAGES) and all(max(pair) > 0 for pair in slow.values())
    for stage, pair in slow.items():
        assert pair == pytest.approx([2 * value for value in fast[stage]])


def test_measured_stages_stand_beside_the_model(tmp_path):
    listed, blocks = [1_300_000] * 2, (3_000_000, 1_600_000)
    scene = gpu_counts.Scene(1_000_000, 900_000, 534_100, 2170, *listed, *blocks, 3_000_000, 40_000_000)
    row = {f"{stage} ms": "2.0" for stage in gpu_model.STAGES} | {"size": "980 x 545", "Gaussians": 1_000_000}
    (tmp_path / "gpu.json").write_text(json.dumps({"tables": {"Training step": [row, row | {"Gaussians": 5}]}}))
    rows = gpu_model.measured_rows(tmp_path / "gpu.json", gpu_model.CARDS["H200"], {"ball": scene})
    assert [stage for _, stage, *_ in rows] == list(gpu_model.STAGES)
    assert all(float(ratio) == pytest.approx(2.0 / float(least), rel=0.3) for *_, least, ratio in rows)


@pytest.mark.slow
def test_step():
    """Every launch of a step is in one of its stages, and the host waits for nothing."""
    counts = gpu_counts.count_step()
    assert set(counts) == {*gpu_model.STAGES, REST}
    assert not any(here[WAITS] for here in counts.values())
    assert all(counts[stage][LAUNCHES] for stage in gpu_model.STAGES)
