"""Which photographs are compared, on features whose places are known."""

import numpy as np
import pycolmap
import pytest

from warp_splat.config import SfmConfig
from warp_splat.sfm import looks
from warp_splat.sfm.matching import match

COUNT, SEEN, STEP, DISTINCT = 100, 120, 12, 128  # photographs; features of each; new ones from one to the next


def features(order):
    """A walk: of each photograph, features that its neighbors share, in an ``order`` of the photographs' places."""
    random = np.random.default_rng(1)
    world = random.gamma(0.5, 40.0, (COUNT * STEP + SEEN, DISTINCT))
    noisy = lambda rows: rows + random.normal(0, 6, rows.shape)  # noqa: E731
    return lambda index: noisy(world[order[index] * STEP :][:SEEN]).clip(0, 255).astype(np.uint8)


def overlapping(order):
    """Pairs that share half of their features."""
    place = np.array(order)
    apart = np.abs(place[:, None] - place)
    return {(a, b) for a, b in zip(*np.nonzero(apart <= SEEN // STEP // 2), strict=True) if a < b}


@pytest.mark.parametrize("mixed", [False, True])
def test_photographs_that_overlap_are_found_and_order_counts_where_it_means_something(mixed):
    order = np.random.default_rng(2).permutation(COUNT) if mixed else np.arange(COUNT)
    described = looks.described_by_words(features(order), COUNT, 0)
    assert np.array_equal(described, looks.described_by_words(features(order), COUNT, 0))
    near = looks.alike(described)
    true = overlapping(order)
    assert len(true - set(near)) < 0.02 * len(true) and len(near) < COUNT * looks.NEAREST
    beside = looks.next_in_order(COUNT, near)
    assert len(beside) == (0 if mixed else sum(min(COUNT - 1 - a, looks.NEIGHBORS) for a in range(COUNT)))


def test_photographs_without_features_have_no_looks():
    assert not looks.described_by_words(lambda index: np.zeros((0, 128), np.uint8), 3, seed=0).any()


def test_neighbors_of_what_fits_are_compared_the_best_first():
    fits = {(0, 1): 200, (1, 2): 155, (0, 3): 100, (2, 3): 100, (3, 4): 149, (1, 5): 450}
    assert looks.beyond(fits, set(fits)) == [(0, 2), (0, 5), (1, 3), (2, 5)]  # 155 + 100, 200, 100 + 100, 155
    many = {(0, other): 1000 for other in range(1, 100)}
    rows = looks.beyond(many, set(many))
    assert rows and max(np.bincount(np.ravel(rows))) == looks.NEAREST


def synthetic(database, names):
    """Photographs of one cloud of points, as many as ``names``."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_points3D=60)
    options.num_frames_per_rig = len(names)
    with pycolmap.Database.open(database) as connection:
        pycolmap.synthesize_dataset(options, connection)
        images = connection.read_all_images()
        for image, name in zip(images, names, strict=True):
            image.name = name
            connection.update_image(image)
            data = np.random.default_rng(7).integers(0, 256, (len(connection.read_keypoints(image.image_id)), 128))
            descriptors = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, data.astype(np.uint8))
            if not connection.exists_descriptors(image.image_id):
                connection.write_descriptors(image.image_id, descriptors)
        connection.clear_matches()
        connection.clear_two_view_geometries()


@pytest.mark.parametrize("name", ["a b/photo {}.jpg", "#{}.jpg"])
def test_names_with_spaces_and_signs_are_matched_and_kept(tmp_path, name):
    names = [name.format(index) for index in range(8)]
    synthetic(tmp_path / "database.db", names)
    lines: list[str] = []
    config = SfmConfig("", "", matching="looks", threads=1, quiet=True)
    pairs = match(tmp_path / "database.db", config, lines.append)
    with pycolmap.Database.open(tmp_path / "database.db") as connection:
        assert sorted(image.name for image in connection.read_all_images()) == names
        assert connection.num_matched_image_pairs() == 28
    assert lines == [f"28 of 28 pairs of photographs compared, by their looks; {pairs} fit"]
