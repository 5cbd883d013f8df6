"""A damaged or forged checkpoint is refused in one sentence, in little memory."""

import json
import random
import struct
import time
import warnings

import numpy as np
import pytest
import safetensors.numpy
import torch
from hostile import changed, changed_json, little_memory, one_sentence, refusal, tried
from hypothesis import strategies as st
from trainings import begin, stepped

from warp_splat.errors import InputError
from warp_splat.formats.checkpoint import LAST, load_checkpoint, save_checkpoint
from warp_splat.training.config_file import load_options
from warp_splat.training.options import TrainConfig
from warp_splat.training.record import Run, keep, restore


@pytest.fixture(scope="module")
def kept(scene, tmp_path_factory):
    """A trainer, and the checkpoint that it wrote."""
    folder = tmp_path_factory.mktemp("kept")
    trainer, run = stepped(scene, folder, 12)
    run.history.append({"iteration": 5, "loss": 0.5, "psnr": 20.0, "gaussians": 4500, "seconds": 1.0})
    keep(trainer, run)
    return trainer, load_checkpoint(folder)


def test_damage_is_found(kept, tmp_path):
    """Cut anywhere, or one bit changed anywhere: the file is refused, in little memory."""
    data, path, place = kept[1].path.read_bytes(), tmp_path / "a.safetensors", random.Random(0)
    files = [data[: place.randrange(len(data))] for _ in range(20)] + [b"", data[:7], data[:-1], data + b"\0"]
    for _ in range(40):
        where = place.choice([place.randrange(len(data)), place.randrange(2000)])
        flipped = bytes([data[where] ^ 1 << place.randrange(8)])
        files.append(data[:where] + flipped + data[where + 1 :])
    lie = json.dumps({"a": {"dtype": "F32", "shape": [10**12], "data_offsets": [0, 4 * 10**12]}}).encode()
    files += [struct.pack("<Q", 10**18), struct.pack("<Q", len(lie)) + lie, struct.pack("<Q", 90_000) + b"[" * 90_000]
    for content in files:
        path.write_bytes(content)
        with little_memory(3 * len(content) + 2**20), pytest.raises(InputError) as error:
            load_checkpoint(path)
        assert one_sentence(error, path).startswith(str(path))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, ("no such file",)),
        ({"name": "chkpnt7000.pth"}, ("can run code", ".ply")),
        ({"name": "point_cloud.ply"}, ("found a model", "--start_ply")),
        ({"metadata": None}, ("other safetensors",)),
        ({"metadata": {"warp_splat": "[1"}}, ("damaged",)),
        ({"metadata": {"warp_splat": "[" * 100_000}}, ("damaged", "nested")),
        ({"metadata": {"warp_splat": '{"format": 99}'}}, ("format 99", "newer")),
        ({"metadata": {"warp_splat": '{"format": 1}'}}, ("checksum",)),
    ],
    ids=str,
)
def test_what_is_no_checkpoint(content, words, tmp_path, fails):
    path = tmp_path / "a.safetensors"
    if content:
        path = tmp_path / content.get("name", path.name)
        safetensors.numpy.save_file({"a": np.zeros(3, np.float32)}, path, content.get("metadata"))
    one_sentence(refusal(lambda: load_checkpoint(path), *words), path)
    assert str(path) in fails("train", "--resume", str(path))


def test_a_folder_without_its_last_checkpoint(kept, tmp_path):
    refusal(lambda: load_options(tmp_path), "no such file")
    save_checkpoint(block := tmp_path / "checkpoint-7-0-of-2.safetensors", {}, {"iteration": 7})
    refusal(lambda: load_options(block), "without options, as a block of one is")
    block.unlink()
    (tmp_path / LAST).mkdir()
    refusal(lambda: load_options(tmp_path), match=f"{LAST}: expected a checkpoint .* found a folder of this name")
    save_checkpoint(tmp_path / "chkpnt7.safetensors", kept[1].arrays, kept[1].facts)
    refusal(lambda: load_options(tmp_path), "chkpnt7.safetensors can be named")


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("iterations", 0),
        ("iterations", 10**30),
        ("iterations", True),
        ("optimizer_type", "sgd"),
        ("lambda_dssim", float("nan")),
        ("save_iterations", [1, "2"]),
        ("source_path", None),
        ("unheard_of", 1),
    ],
)
def test_impossible_options(option, value, kept, tmp_path):
    facts = {**kept[1].facts, "options": {**kept[1].facts["options"], option: value}}
    save_checkpoint(tmp_path / LAST, {}, facts)
    one_sentence(refusal(lambda: load_options(tmp_path), option), tmp_path / LAST)
    del facts["options"][option]  # an older program may not have known it
    save_checkpoint(tmp_path / LAST, {}, facts)
    assert load_options(tmp_path).get(option) == TrainConfig().flat().get(option)


def test_a_generator_that_would_read_beyond_its_words(kept, tmp_path):
    """Torch itself takes this state."""
    state = kept[1].arrays["random.densification"].copy()
    struct.pack_into("<iiQ", state, 8, 624, 1, 624)
    torch.Generator().set_state(torch.from_numpy(state.copy()))
    save_checkpoint(tmp_path / LAST, {**kept[1].arrays, "random.densification": state}, kept[1].facts)
    refusal(lambda: kept[0].restore(load_checkpoint(tmp_path)), "generator")


@st.composite
def forged(draw, arrays, facts):
    """A checkpoint with a right checksum and wrong contents."""
    if draw(st.booleans()):
        facts = changed_json(draw, facts)
    arrays = dict(arrays)
    for name in draw(st.lists(st.sampled_from(sorted(arrays)), max_size=3)):
        array = arrays.pop(name, None)
        match draw(st.sampled_from(["remove", "cut", "fill", "bits", "dtype"])):
            case "cut" if array is not None and array.ndim:
                arrays[name] = array[: draw(st.integers(0, len(array)))]
            case "fill" if array is not None:
                value = draw(st.sampled_from([0, 1, 2**31 - 1, -1, 255]))
                arrays[name] = np.full_like(array, np.array(value).astype(array.dtype))
            case "bits" if array is not None:
                filled = np.frombuffer(draw(st.binary(min_size=1, max_size=8)) * array.nbytes, np.uint8, array.nbytes)
                arrays[name] = filled.view(array.dtype).reshape(array.shape) if array.ndim else array
            case "dtype" if array is not None:
                arrays[name] = array.astype(np.float64 if array.dtype == np.float32 else np.float32)
    return arrays, facts


@pytest.mark.parametrize("examples", [60, pytest.param(1000, marks=pytest.mark.long)])
def test_forged_checkpoints(examples, kept, scene, tmp_path):
    """Load and restore; if that is not refused, train for a step."""
    trainer, path = begin(scene, tmp_path)[0], tmp_path / LAST

    def run(content):
        save_checkpoint(path, *content)
        try:
            load_options(path)
            restore(trainer, Run(tmp_path, time.perf_counter()), load_checkpoint(path))
        except InputError as error:
            assert one_sentence(error, path).startswith(str(path))
            return
        with warnings.catch_warnings(action="error"):
            trainer.update(12)
            trainer.differentiate(13)

    tried(examples, forged(kept[1].arrays, kept[1].facts), run, seeded=True)


@pytest.mark.parametrize("examples", [100, pytest.param(5000, marks=pytest.mark.long)])
def test_changed_bytes(examples, tmp_path, kept):
    """A small file with bytes changed, inserted, removed, repeated, cut: most of it is the header."""
    path = tmp_path / LAST
    save_checkpoint(path, {"losses": np.zeros(3, np.float32), "radii": np.zeros(4, np.int32)}, kept[1].facts)
    data = path.read_bytes()

    def run(content):
        path.write_bytes(content)
        for load in (load_checkpoint, load_options):
            try:
                load(path)
            except InputError as error:
                assert one_sentence(error, path).startswith(str(path))

    tried(examples, st.composite(lambda draw: changed(draw, data))(), run, seeded=True)
