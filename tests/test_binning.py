"""Tile lists against a loop over every pixel of every tile."""

from operator import attrgetter

import numpy as np
import pytest
import torch
import warp as wp
from common import using
from hostile import refusal

from warp_splat import Camera, InputError, RasterOptions
from warp_splat.raster import bin
from warp_splat.raster import project as projection
from warp_splat.raster.data import Bins, Gaussians, Room
from warp_splat.raster.drivers import CPU, CUDA

SIZE = (70, 53)
PLAIN = RasterOptions()


def project(count=300, seed=0, size=SIZE, stretch=1.0, options=PLAIN):
    """Random Gaussians, needles among them (the more, the larger ``stretch``), as the renderer projects them."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=generator) * 1.5 + torch.tensor([0.0, 0.0, 4.0])
    scales = torch.exp(stretch * torch.randn(count, 3, generator=generator) - 3.0)
    quats, opacities = torch.randn(count, 4, generator=generator), torch.rand(count, generator=generator)
    camera = Camera(*size, 60.0, 55.0, 0.43 * size[0], 0.51 * size[1], np.eye(3), np.zeros(3))
    gaussians = Gaussians(means, quats, scales, opacities, torch.zeros(count, 1, 3), torch.zeros(count, 0, 3))
    return camera, projection.project(gaussians, camera, options)


def lists(bins):
    """Gaussians of each tile, in order."""
    gaussians, ranges, instances = bins.gaussians.numpy(), bins.ranges.numpy(), bins.instances.numpy()
    return [gaussians[instances[first:last]].tolist() for first, last in ranges]


@pytest.mark.parametrize("seed", range(3))
def test_every_tile_lists_what_its_pixels_see_nearest_first(seed):
    camera, projected = project(seed=seed)
    means2d, conics, opacities, _, depths, _, radii = (tensor.double().numpy() for tensor in projected)
    found = lists(CPU.bin(projected, camera, RasterOptions()))
    spare = 0
    for tile, listed in enumerate(found):
        left, top = tile % 5 * 16, tile // 5 * 16
        x, y = np.meshgrid(np.arange(left, min(left + 16, 70)) + 0.5, np.arange(top, min(top + 16, 53)) + 0.5)
        dx, dy = (means2d[:, axis, None, None] - pixel for axis, pixel in enumerate((x, y)))
        q = 0.5 * (conics[:, 0, None, None] * dx**2 + conics[:, 2, None, None] * dy**2)
        q += conics[:, 1, None, None] * dx * dy
        seen = (opacities[:, None, None] * np.exp(-q) >= 1 / 255).any((1, 2)) & (radii > 0)
        expected = [i for i in np.argsort(depths, kind="stable") if seen[i]]
        assert [i for i in listed if seen[i]] == expected
        assert sorted(listed, key=lambda i: (depths[i], i)) == listed
        spare += len(listed) - len(expected)
    assert spare < 0.12 * sum(map(len, found))  # ellipses that pass between the pixel centers of a tile


def test_places_are_those_of_each_splat():
    camera, projected = project()
    for bins in counted_and_sorted(camera, projected):
        begins = np.append(bins.place_begins.numpy()[: len(bins.gaussians)], len(bins.places))
        splats = np.repeat(np.arange(len(bins.gaussians)), np.diff(begins))
        assert (bins.instances.numpy()[bins.places.numpy()] == splats).all() and len(splats) > 300
        assert sorted(bins.places.numpy()) == list(range(len(splats)))


@pytest.mark.parametrize("width", [9, 10])
def test_rows_are_summed_by_gaussian(width, threads):
    """Whoever shares the work, in any mode of torch: bit for bit the sums that one gets from first to last."""
    camera, projected = project(5000)
    for driver in (CPU, CUDA):
        bins = driver.bin(projected, camera, PLAIN)
        slots = torch.randn(len(bins.instances), width, generator=torch.Generator().manual_seed(1))
        sums = np.zeros((5000, width), np.float32)
        first_to_last = bins.gaussians.numpy()[bins.instances.numpy()[bins.places.numpy()]]
        np.add.at(sums, first_to_last, slots.numpy()[bins.places.numpy()])
        for count in (1, 2, 3):
            threads(count)
            with using(driver), torch.inference_mode(count > 1):
                found = driver.gather(bins, slots)
            assert [grad.shape[1:].numel() for grad in found] == [2, 3, 1, 3, 1]
            assert width == 10 or not found[4].any()
            assert (torch.cat([grad.view(5000, -1) for grad in found], 1)[:, :width].numpy() == sums).all()


def test_without_gaussians_or_instances_sums_are_zero():
    for count in (0, 2000):
        camera, projected = project(count)
        projected.radii[:] = 0
        bins = CPU.bin(projected, camera, PLAIN)
        assert not torch.cat([grad.view(-1) for grad in CPU.gather(bins, torch.empty(0, 9))]).any()


@pytest.mark.parametrize("widths", [(2, 3, 1, 3), (2, 3, 1, 3, 1), (2, 3, 1), (2, 3, 1, 32)])
def test_splats_of_many_tiles(widths):
    """On CUDA a warp sums the rows of a splat together, if there are many; two runs give the same bits."""
    bins, slots, counts = crowded(70, sum(widths))
    with using(CUDA):
        tables = [[torch.full((70, width), torch.nan) for width in widths] for _ in range(2)]
        first, second = (CUDA.gather(bins, slots, table) for table in tables)
    owners = bins.gaussians.numpy().repeat(counts)
    expected = torch.zeros(70, sum(widths), dtype=torch.float64)
    expected.index_add_(0, torch.from_numpy(owners), slots[bins.places.long()].double())
    found = torch.cat([grad.view(70, -1) for grad in first], 1)
    assert (found - expected).norm() < 1e-6 * expected.norm() and counts.max() > 300
    assert all(map(torch.equal, first, second))


def crowded(count, width):
    """Lists of ``count`` splats, some of hundreds of tiles, as gather reads them; rows; and the tiles of each."""
    random = np.random.default_rng(0)
    counts = np.where(np.arange(count) % 7, random.integers(0, 20, count), random.integers(60, 400, count))
    total, order = int(counts.sum()), random.permutation(count).astype(np.int32)
    places = torch.from_numpy(random.permutation(total).astype(np.int32))
    begins = torch.from_numpy(np.append(0, counts.cumsum()).astype(np.int32))
    rows = torch.from_numpy(random.standard_normal((total, width), np.float32))
    nothing = torch.empty(0, dtype=torch.int32)
    gaussians = wp.array(order, dtype=int, device="cpu")
    return Bins(count, gaussians, None, nothing, places, begins, nothing, [], 1, 16, 0), rows, counts


def test_depths_are_sorted_in_pieces(monkeypatch, threads):
    """Whatever their sign and size, ties by index; and the depths stay as they are."""
    monkeypatch.setattr(bin, "IN_PIECES", 1000)
    random = np.random.default_rng(0)
    depths = (random.choice([-1.0, 1.0], 7003) * 10.0 ** random.uniform(-30, 30, 7003)).astype(np.float32)
    depths[random.integers(0, 7003, 3000)] = 2.5
    before = depths.copy()
    for count in (1, 2, 4, 7):
        threads(count)
        assert (bin.order_by_depth(depths) == np.argsort(depths, kind="stable")).all()
        assert (depths == before).all()


def test_the_number_of_threads_changes_nothing(monkeypatch, same_by_threads):
    monkeypatch.setattr(bin, "IN_PIECES", 1000)
    camera, projected = project(5000)
    same_by_threads(lambda: attrgetter("instances", "places", "ranges")(CPU.bin(projected, camera, PLAIN)))


def counted_and_sorted(camera, projected, options=PLAIN):
    return [bin_on(projected, camera, options) for bin_on in (bin.bin_by_counting, bin.bin_by_sorting)]


def listed(bins):
    """Of each instance the Gaussian, and which of the Gaussian's instances it is."""
    splat, number = bins.instances.numpy(), np.argsort(bins.places.numpy())
    return np.stack([bins.gaussians.numpy()[splat], number - bins.place_begins.numpy()[splat]])


def by_gaussian(bins, drawn):
    """The splats of the Gaussians ``drawn``, as bytes, by Gaussian."""
    splats, gaussians = bins.splats.numpy(), bins.gaussians.numpy()
    return splats[np.argsort(gaussians)][np.isin(np.sort(gaussians), drawn)].tobytes()


@pytest.mark.parametrize("options", [PLAIN, RasterOptions(extent="square"), RasterOptions(alpha_min=0.0)], ids=str)
@pytest.mark.parametrize("size", [SIZE, (1, 1), (1, 2000), (2000, 1), (3000, 2900)], ids=str)
@pytest.mark.parametrize(("count", "stretch"), [(300, 1.0), (5000, 1.0), (300, 3.0), (1, 1.0), (0, 1.0)])
def test_sorting_gives_the_lists_that_counting_gives(count, stretch, size, options):
    """What a GPU does, on the CPU: the same Gaussians by tile, their places in the same order, and the same splats."""
    camera, projected = project(count, 4, size, stretch, options)
    counted, by_sorting = counted_and_sorted(camera, projected, options)
    drawn = counted.gaussians.numpy()
    assert (listed(by_sorting) == listed(counted)).all() and torch.equal(by_sorting.ranges, counted.ranges)
    assert by_sorting.instances.dtype == by_sorting.ranges.dtype == torch.int32
    assert by_gaussian(by_sorting, drawn) == by_gaussian(counted, drawn)
    assert len(by_sorting.gaussians) == len(by_sorting.splats) == len(by_sorting.place_begins) - 1 == count
    assert by_sorting.place_begins[-1] == len(counted.instances)
    assert int(by_sorting.invalid) == counted.invalid and type(counted.invalid) is int  # or radii would be copied


@pytest.mark.parametrize("miscounted", [-1, 0, 1])
@pytest.mark.parametrize("spare", [-100, 0, 100])
@pytest.mark.parametrize("dtype", [torch.int16, torch.int32])
def test_lists_stay_within_the_places_that_were_counted(dtype, spare, miscounted):
    """Even where the two runs of a GPU found another number of tiles, or there is more or less room than needed."""
    camera, projected = project(300, 4)
    _, splats, counts = bin._count_tiles(projected, camera, PLAIN)
    ends = torch.cumsum((counts + miscounted).clamp(min=0), 0)
    room = int(ends[-1]) + spare
    memory = torch.full((room + 64,), -7, dtype=dtype)
    begins, ranks = bin._list_tiles(splats, ends, memory[:room], counts[:0].int(), camera, PLAIN)
    listed, ends = memory[:room], ends.clamp(max=room).tolist()
    assert (memory[room:] == -7).all() and (listed[ends[-1] :] == 20).all()  # no tile
    assert begins.tolist() == [0, *ends]
    for rank, (begin, end) in enumerate(zip([0, *ends], ends, strict=False)):
        assert (ranks[begin:end] == rank).all() and (listed[begin:end] >= 0).all() and (listed[begin:end] < 20).all()


@pytest.mark.parametrize("spare", [-100, 0, 5000])
def test_lists_in_a_room(spare):
    """The same lists, if they fit; otherwise it is told, and the next view is waited for."""
    camera, projected = project(300, 4)
    expected = bin.bin_by_sorting(projected, camera, PLAIN)
    count = len(expected.instances)
    room = Room(count + spare)
    bins = bin.bin_by_sorting(projected, camera, PLAIN, room)
    assert len(bins.instances) == count + spare
    assert room.overflowed() == (spare < 0) and not room.overflowed() and (room.instances == 0) == (spare < 0)
    if spare < 0:
        bins = bin.bin_by_sorting(projected, camera, PLAIN, room)
        assert len(bins.instances) == count < room.instances
    for name in ("instances", "places", "place_begins", "ranges"):
        found = getattr(bins, name)
        assert torch.equal(found[:count] if name in ("instances", "places") else found, getattr(expected, name)), name


def test_sorting_breaks_ties_by_index_and_leaves_out_what_is_invalid():
    camera, projected = project(400)
    with torch.no_grad():
        projected.depths[:] = (4.0 * projected.depths).round() / 4.0
        projected.radii[7] = -1
    counted, by_sorting = counted_and_sorted(camera, projected)
    assert (listed(by_sorting) == listed(counted)).all() and torch.equal(by_sorting.ranges, counted.ranges)
    assert int(by_sorting.invalid) == counted.invalid == 1


@pytest.mark.parametrize("bin_on", [bin.bin_by_counting, bin.bin_by_sorting])
def test_too_many_for_a_list_or_a_tile_are_refused_with_the_sizes(bin_on, monkeypatch):
    camera, projected = project()
    sizes = [len(tile) for tile in lists(CPU.bin(projected, camera, PLAIN))]
    longest, total = max(sizes), sum(sizes)
    monkeypatch.setattr(bin, "MAX_TILE", longest)
    bin_on(projected, camera, PLAIN)
    monkeypatch.setattr(bin, "MAX_TILE", longest - 1)
    message = f"one tile of 16 x 16 pixels lists {longest} Gaussians, more than the {longest - 1} that fit"
    refusal(lambda: bin_on(projected, camera, PLAIN), match=message)
    for most in (100, total - 1):
        monkeypatch.setattr(bin, "MAX_INSTANCES", most)
        message = rf"70 x 53 pixels touch tiles \d+ times, more than the {most}"
        refusal(lambda: bin_on(projected, camera, PLAIN), match=message)


@pytest.mark.parametrize("bin_on", [bin.bin_by_counting, bin.bin_by_sorting])
def test_the_count_does_not_wrap(bin_on):
    """70,000 Gaussians that cover 188 x 182 tiles each: 32 bits would see a negative number of instances."""
    camera, projected = project(70_000, size=(3000, 2900), stretch=0.0)
    with torch.no_grad():
        for name, value in (("opacities", 0.5), ("depths", 4.0), ("extents", 1e5), ("radii", 100_000)):
            getattr(projected, name).fill_(value)
        projected.conics[:] = torch.tensor([1e-10, 0.0, 1e-10])
    with pytest.raises(InputError, match=f"touch tiles {70_000 * 188 * 182} times, more than the 2147483647"):
        bin_on(projected, camera, RasterOptions(extent="ellipse"))
