"""The loss against a float64 torch implementation written from the formula."""

import math

import pytest
import torch
from common import using
from hostile import refusal

from warp_splat.raster.drivers import CPU, CUDA
from warp_splat.runtime.timers import profile
from warp_splat.training import loss as losses
from warp_splat.training.loss import image_loss


def oracle(x, y, share):
    """(1 - share) L1 + share (1 - SSIM) by 2D convolution, zero padding."""
    x, y = (image.double().permute(2, 0, 1)[:, None] for image in (x, y))
    bell = torch.exp(-((torch.arange(11.0, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    window = (torch.outer(bell, bell) / bell.sum() ** 2)[None, None]
    blur = lambda image: torch.nn.functional.conv2d(image, window, padding=5)  # noqa: E731
    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
    cov = blur(x * y) - mean_x * mean_y
    ssim = (2 * mean_x * mean_y + 1e-4) * (2 * cov + 9e-4) / ((mean_x**2 + mean_y**2 + 1e-4) * (var_x + var_y + 9e-4))
    return (1 - share) * (x - y).abs().mean() + share * (1 - ssim.mean())


def differentiated(image, target, share=0.2, mask=None):
    """Value and gradient."""
    leaf = image.clone().requires_grad_()
    loss = image_loss(leaf, target, share, mask)
    loss.backward()
    return loss.item(), leaf.grad


def check(image, target, share=0.2, mask=None, value=1e-6, slope=1e-5):
    """Value and gradient against float64, relative to L2; both, as the kernels have them."""
    (loss, gradient), exact = differentiated(image, target, share, mask), image.double().requires_grad_()
    keep = 1.0 if mask is None else mask.double()
    expected = oracle(exact * keep, (target / 255.0 if target.dtype == torch.uint8 else target) * keep, share)
    expected.backward()
    assert abs(loss - expected.item()) < value
    assert (gradient - exact.grad).norm() < slope * exact.grad.norm()
    return loss, gradient


def pictures(size, kind="floats", seed=2):
    """An image and a target of this kind."""
    image, target = torch.rand(2, *size, 3, generator=torch.Generator().manual_seed(seed))
    image = image + 20.0 if kind == "far apart" else image
    return image, (255 * target).to(torch.uint8) if kind == "bytes" else target


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("size", [(1, 1), (1, 40), (7, 3), (11, 16), (33, 50), (100, 67)])
def test_value_and_gradient(size, share):
    check(*pictures(size, seed=sum(size)), share)


def both(image, target, share=0.2):
    """Value and gradient by the kernels of a CPU, and by those of a GPU in fibers."""
    found = []
    for driver in (CPU, CUDA):
        with using(driver):
            found.append(differentiated(image, target, share))
    return found


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("size", [(1, 1), (1, 40), (7, 3), (33, 50), (100, 77)])
@pytest.mark.parametrize("kind", ["floats", "bytes", "far apart"])
def test_blocks_agree_with_the_lanes(kind, size, share):
    """Up to two strips of two bands, where each has both ends and neighbors."""
    (loss, gradient), (found, found_gradient) = both(*pictures(size, kind, sum(size)), share)
    assert abs(found - loss) < 1e-6 * max(1.0, abs(loss))
    assert (found_gradient - gradient).norm() < 1e-5 * gradient.norm()


def test_loss_and_adjoint_are_stages(driver):
    """The target may come from inference mode."""
    image = torch.rand(24, 35, 3).requires_grad_()
    with torch.inference_mode():
        target = torch.rand(24, 35, 3)
    with profile() as stages:
        image_loss(image, target, 0.2).backward()
        assert set(stages) == {"loss", "adjoint of loss"} and min(stages.values()) > 0
        assert image.grad.any() and not image_loss(image.detach(), target, 0.2).requires_grad


def test_blocks_find_equal_images_equal():
    image = torch.rand(24, 35, 3, generator=torch.Generator().manual_seed(1))
    for loss, gradient in both(image, image):
        assert abs(loss) < 1e-6 and gradient.abs().max() < 1e-6 / 24


def test_blocks_keep_what_is_not_finite_where_it_is():
    """A pixel that is not a number has no gradient, and makes the loss one that is none, as on a CPU."""
    image, target = pictures((40, 30))
    image[20, 11, 1] = torch.nan
    (loss, gradient), (found, found_gradient) = both(image, target)
    assert loss != loss and found != found
    finite = gradient.isfinite()  # lanes blur two rows together, and so spread it a row farther
    assert not found_gradient[20, 11, 1] and found_gradient[finite].isfinite().all() and not finite.all()
    assert (found_gradient[finite] - gradient[finite]).norm() < 1e-5 * gradient[finite].norm()


@pytest.mark.parametrize("size", [(1, 1), (2, 5), (33, 50), (40, 64)])
def test_clamped_as_by_torch(size, driver):
    image, target = pictures(size, "bytes")
    image = 1.6 * image - 0.3
    image.view(-1)[:2] = torch.tensor([0.0, 1.0])
    leaf, other = image.clone().requires_grad_(), image.clone().requires_grad_()
    loss, expected = image_loss(leaf, target, clamped=True), image_loss(other.clamp(0.0, 1.0), target)
    (2 * loss).backward()
    (2 * expected).backward()
    assert loss.item() == expected.item() and torch.equal(leaf.grad, other.grad)


def test_images_that_lie_otherwise_in_memory():
    image, target = torch.rand(2, 30, 20, 3, generator=torch.Generator().manual_seed(4)).transpose(1, 2)
    flat = torch.full((3,), 0.5).expand(20, 30, 3)
    dense = image.contiguous()
    for other in (target, flat):
        assert image_loss(image, other).item() == image_loss(dense, other.contiguous()).item()
    signed = image_loss(torch._neg_view(-dense), torch._neg_view(-target))
    assert signed.item() == image_loss(dense, target).item()


def test_smooth_images_match_as_well():
    """Nearly constant windows: variances are differences of nearly equal numbers."""
    ramp = torch.linspace(0.4, 0.6, 64)[None, :, None].expand(40, 64, 3).contiguous()
    check(ramp + 0.01, ramp, value=1e-5, slope=1e-3)


def by_threads(image, target, threads):
    """Value and gradient on 1, 2, 3 and 7 threads."""
    results = []
    for count in (1, 2, 3, 7):
        threads(count)
        loss, gradient = differentiated(image, target)
        results.append(torch.cat([torch.tensor([loss]), gradient.ravel()]))
    assert len(losses._bands(len(image))[0]) > 2  # or there was nothing to compare
    return results


@pytest.mark.parametrize("size", [(455, 21), (897, 7), (128, 40)])
@pytest.mark.parametrize("kind", ["floats", "bytes"])
def test_bands_of_rows_are_right_and_change_no_bit(kind, size, threads):
    first, *others = by_threads(*pictures(size, kind), threads)
    assert all(torch.equal(other, first) for other in others)
    check(*pictures(size, kind))


@pytest.mark.parametrize("height", [1, 2, 5, 6, 7, 11, 12, 13, 24])
def test_bands_of_few_rows(height, threads, monkeypatch):
    monkeypatch.setattr(losses, "SMALLEST_SLICE", 1)
    threads(5)
    test_value_and_gradient((height, 19), 0.2)


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e25, 1e30])
def test_what_is_not_finite_spreads_alike_on_any_number_of_threads(value, threads):
    image, target = pictures((455, 21))
    for picture in (image, target):
        for row in (64, 227, 300):
            spoilt = picture.clone()
            spoilt[row, 5, 1] = value
            pair = (spoilt, target) if picture is image else (image, spoilt)
            first, *others = by_threads(*pair, threads)
            assert all(torch.equal(other.nan_to_num(7.0), first.nan_to_num(7.0)) for other in others)


IMAGE, MASK = torch.zeros(20, 30, 3), torch.ones(20, 30, 1, dtype=torch.uint8)
SHAPES = ((20, 30), (20, 30, 4), (21, 30, 3), (1, 1, 3))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((IMAGE.double(), IMAGE), "float64"),
        ((IMAGE, IMAGE.long()), "int64"),
        ((IMAGE, IMAGE, 0.2, MASK.float()), r"a tensor \[20, 30, 1\] of uint8.*float32"),
        ((IMAGE, IMAGE, 0.2, MASK[1:]), r"got \[19, 30, 1\]"),
        ((IMAGE, IMAGE, 0.2, [[1]]), "got list"),
        ((IMAGE, IMAGE.to_sparse()), "dense"),
        ((IMAGE, IMAGE, 0.2, MASK.to_sparse()), "dense"),
        ((IMAGE, IMAGE.to("meta")), "one device.*meta"),
        ((IMAGE.to("meta"), IMAGE.to("meta")), "on the CPU or an NVIDIA GPU"),
        ((IMAGE, None), "two tensors.*NoneType"),
        *(((IMAGE, IMAGE, share), "lambda_dssim.*0 to 1") for share in (-0.1, 1.1, float("nan"), "x")),
        ((IMAGE[:0], IMAGE[:0]), r"1 x 1 or more.*\[0, 30, 3\]"),
        *(((IMAGE, torch.zeros(shape), 0.2, mask), r"\[H, W, 3\]") for shape in SHAPES for mask in (None, MASK)),
    ],
)
def test_what_is_refused(arguments, said):
    refusal(lambda: image_loss(*arguments), match=said)
