"""gsplat's function: its projection and harmonics in torch are the truth, for pixels our float64 oracle is."""

import inspect
import math

import numpy as np
import pytest
import torch
from hostile import refusal
from scenes import SCENES
from test_rasterize import IMAGE_MAX, relative_error

import warp_splat.gsplat as ours
from warp_splat.compare import oracle
from warp_splat.gsplat import rasterization

gsplat = pytest.importorskip("gsplat")
from gsplat.cuda import _torch_impl as theirs  # noqa: E402

GRADIENT = 1e-5
SKEWLESS = torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]])  # its torch code knows a skew, its kernels do not
CONSTANTS = {"near": 0.01, "alpha_max": 0.999}  # of gsplat, where they are not ours
MODELS = ("pinhole", "ortho", "fisheye")


@pytest.fixture(autouse=True)
def seeded():
    """The strategy draws where the halves of a Gaussian go: the same places in any order of tests."""
    torch.manual_seed(0)


def call_of(name="degree2", cameras=2, **more):
    """The tensors of a scene, seen by cameras side by side, and the size of the image."""
    scene = SCENES[name]()
    camera = scene.camera
    viewmats = torch.eye(4).repeat(cameras, 1, 1)
    viewmats[:, :3, :3], viewmats[:, :3, 3] = torch.tensor(camera.rotation), torch.tensor(camera.translation)
    viewmats[:, 0, 3] += 0.3 * torch.arange(cameras)
    intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]).float()
    names = ("means", "quats", "scales", "opacities")
    call = {name: getattr(scene, name).clone().requires_grad_() for name in names}
    call |= {"colors": scene.sh.clone().requires_grad_(), "viewmats": viewmats.requires_grad_()}
    call |= {"Ks": intrinsics.repeat(cameras, 1, 1).requires_grad_(), "width": camera.width, "height": camera.height}
    return call | {"sh_degree": int(scene.sh.shape[1] ** 0.5) - 1} | more


def test_parameters_are_those_of_gsplat():
    mine, other = (inspect.signature(f).parameters for f in (rasterization, gsplat.rasterization))
    assert list(mine) == list(other)
    for name in mine:
        if name != "rolling_shutter":  # theirs is an enumeration of their own; None is its GLOBAL
            assert mine[name].default == other[name].default, name
    shutter = other["rolling_shutter"].default
    assert rasterization(**call_of(rolling_shutter=shutter))[0].isfinite().all()


def check_agreement(truth, meta, leaves, exact, part=lambda name, gradient: gradient):
    """What ``meta`` has of those that are drawn, and its gradients, against ``truth`` in float64.

    ``part`` of a leaf's gradient is what counts.
    """
    drawn = (meta["radii"] > 0).all(-1)
    assert drawn.sum() > 20
    for name, expected in truth.items():
        found, generator = meta[name], torch.Generator().manual_seed(1)
        upstream = torch.randn(found.shape, generator=generator) * drawn.view(*drawn.shape, *[1] * (found.dim() - 2))
        assert relative_error((found * upstream).detach(), (expected * upstream).detach()) < GRADIENT, name
        if not expected.requires_grad:
            continue
        ways = {"retain_graph": True, "materialize_grads": True}
        one = torch.autograd.grad(found, list(leaves.values()), upstream, **ways)
        other = torch.autograd.grad(expected, list(exact.values()), upstream.double(), **ways)
        for leaf, gradient, wanted in zip(leaves, one, other, strict=True):
            pair = [part(leaf, each) for each in (gradient, wanted * SKEWLESS if leaf == "Ks" else wanted)]
            if wanted.any():
                assert relative_error(*pair) < GRADIENT, (name, leaf)
            else:
                assert not gradient.any(), (name, leaf)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("model", MODELS)
def test_projection_and_its_gradients(model, mode):
    call = call_of(packed=False, camera_model=model, rasterize_mode=mode, eps2d=0.4, near_plane=2.5, far_plane=7.0)
    meta = rasterization(**call)[2]
    leaves = {name: call[name] for name in ("means", "quats", "scales", "viewmats", "Ks")}
    exact = {name: leaf.detach().double().requires_grad_() for name, leaf in leaves.items()}
    covariances, _ = theirs._quat_scale_to_covar_preci(exact["quats"], exact["scales"], compute_preci=False)
    _, means2d, depths, conics, share = theirs._fully_fused_projection(
        *(exact["means"], covariances, exact["viewmats"], exact["Ks"], call["width"], call["height"], 0.4, 2.5, 7.0),
        calc_compensations=True,
        camera_model=model,
    )
    opacities = call["opacities"].detach() * (share if mode == "antialiased" else torch.ones_like(share))
    truth = {"means2d": means2d, "depths": depths, "conics": conics, "opacities": opacities}
    check_agreement(truth, meta, leaves, exact)


@pytest.mark.parametrize("degree", range(5))
def test_harmonics(degree):
    rays, coefficients = torch.randn(50, 3).double(), torch.randn(50, 25, 3).double()
    found = ours.spherical_harmonics(degree, rays, coefficients, rays[:, 0] > 0)
    expected = theirs._spherical_harmonics(degree, rays, coefficients) * (rays[:, :1] > 0)
    assert torch.allclose(found, expected, atol=1e-12)
    assert torch.equal(found, ours.spherical_harmonics(np.uint8(degree), rays, coefficients, rays[:, 0] > 0))


@pytest.mark.parametrize(
    ("degree", "of_rays", "shape"),
    [(1, 5, (5, 3, 3)), (0, 5, (1, 4, 3)), (-2, 5, (5, 4, 3)), (1.5, 5, (5, 4, 3)), (1, 5, (5, 4, 2)), (0, 5, (3,))],
)
def test_harmonics_that_do_not_fit(degree, of_rays, shape):
    rays, coefficients = torch.ones(of_rays, 3), torch.ones(shape)
    refusal(lambda: ours.spherical_harmonics(degree, rays, coefficients), "expected a degree")


def test_masks_of_harmonics_are_those_of_the_directions():
    rays, coefficients, mask = torch.ones(3, 3, 3), torch.ones(3, 3, 1, 3), torch.tensor([True, False, False])
    refusal(lambda: ours.spherical_harmonics(0, rays, coefficients, mask), match=r"\(3,\)\]")


@pytest.mark.parametrize("triu", [False, True])
def test_covariances_and_their_inverses(triu):
    quats, scales = torch.randn(50, 4).double(), torch.randn(50, 3).double()
    found = ours.quat_scale_to_covar_preci(quats, scales, triu=triu)
    expected = theirs._quat_scale_to_covar_preci(quats, scales, triu=triu)
    for one, other in zip(found, expected, strict=True):
        assert relative_error(one, other) < 1e-12
    assert ours.quat_scale_to_covar_preci(quats, scales, False, False) == (None, None)


def test_relocation():
    """The double sum of gsplat's kernel; several that lie at one place cover as much as one."""
    binoms = gsplat.MCMCStrategy().initialize_state()["binoms"]
    opacities, scales, ratios = torch.tensor([0.3, 0.9, 0.99, 0.5]), torch.rand(4, 3), torch.tensor([1, 2, 51, 99])
    found, sizes = ours.compute_relocation(opacities, scales, ratios, binoms)
    for opacity, scale, ratio, one, size in zip(opacities, scales, [1, 2, 51, 51], found, sizes, strict=True):
        share = 1 - (1 - opacity.double()) ** (1 / ratio)
        pairs = [(i, k) for i in range(ratio) for k in range(i + 1)]
        total = sum((-1) ** k / (k + 1) ** 0.5 * math.comb(i, k) * share ** (k + 1) for i, k in pairs)
        assert torch.allclose(one.double(), share) and torch.allclose(size, scale * (opacity / total).float())


def test_signs_of_scales_do_not_matter():
    call, signs, found = call_of(packed=False), torch.tensor([1.0, -1.0, -1.0]), []
    weights = torch.randn(2, call["height"], call["width"], 3)
    for turned in (torch.ones(3), signs):
        scales = (call["scales"].detach() * turned).requires_grad_()
        image = rasterization(**call | {"scales": scales})[0]
        found.append((image, torch.autograd.grad(image, scales, weights)[0]))
    (image, grad), (other, other_grad) = found
    assert torch.equal(image, other) and torch.equal(grad, other_grad * signs) and grad.any()


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_covariances_in_place_of_quats_and_scales(mode):
    call = call_of(packed=False, rasterize_mode=mode)
    exact = [call[name].detach().double().requires_grad_() for name in ("quats", "scales")]
    covars = ours.quat_scale_to_covar_preci(*exact)[0]
    given = covars.detach().float().requires_grad_()
    image, other = rasterization(**call)[0], rasterization(**call | {"quats": None, "scales": None, "covars": given})[0]
    assert (image - other).abs().max() < 1e-4
    upstream = torch.randn(image.shape)
    names = ("quats", "scales", "means", "viewmats", "Ks")
    wanted = torch.autograd.grad(image, [call[name] for name in names], upstream)
    upper, *rest = torch.autograd.grad(other, [given, *(call[name] for name in names[2:])], upstream)
    assert not upper.tril(-1).any()
    through = torch.autograd.grad(covars, exact, 0.5 * (upper + upper.mT).double())
    for name, one, two in zip(names, (*through, *rest), wanted, strict=True):
        assert relative_error(one, two.double()) < 1e-4, name


def test_numbers_and_options_that_gsplat_takes():
    """Numbers of NumPy, any tiles, backgrounds of what is a depth, an opacity that is 1 but for a rounding."""
    call = call_of(width=np.int64(50), height=np.int32(40), sh_degree=np.int64(1), render_mode="ED")
    call["opacities"] = torch.full_like(call["opacities"], 1.0000001)
    image = rasterization(**call, tile_size=8, backgrounds=torch.rand(2, 1))[0]
    assert image.shape == (2, 40, 50, 1)
    call["opacities"] = torch.ones_like(call["opacities"])
    assert (image - rasterization(**call)[0]).abs().max() < 1e-4


@pytest.mark.parametrize("name", ["degree2", "near_and_behind", "opaque"])
def test_pixels_against_the_oracle(name, driver):
    call, scene = call_of(name, cameras=1), SCENES[name]()
    leaves = {key: call[key] for key in ("means", "quats", "scales", "opacities", "colors")}
    exact = {key: leaf.detach().double().requires_grad_() for key, leaf in leaves.items()}
    truth = oracle.exact_render(*exact.values(), scene.camera, background=(0.1, 0.2, 0.3), **CONSTANTS)
    image, alpha, _ = rasterization(**call, backgrounds=torch.tensor([[0.1, 0.2, 0.3]]))
    assert (image[0] - truth.image)[~truth.fragile].abs().max() < IMAGE_MAX
    assert (alpha[0, ..., 0] - truth.alpha)[~truth.fragile].abs().max() < IMAGE_MAX
    upstream = torch.randn(image.shape[1:], generator=torch.Generator().manual_seed(0))
    upstream[truth.fragile] = 0
    found = torch.autograd.grad(image[0], list(leaves.values()), upstream)
    wanted = torch.autograd.grad(truth.image, list(exact.values()), upstream.double())
    for key, one, other in zip(leaves, found, wanted, strict=True):
        assert relative_error(one, other) < 1e-4, key


@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("channels", [1, 3, 6])
def test_modes_channels_and_batches(mode, channels):
    """Two scenes of two cameras; each view as if it were alone."""
    call = call_of("degree1")
    colors = torch.rand(len(call["means"]), channels)
    backgrounds = torch.rand(2, 2, channels)
    single = {key: call[key].detach() for key in ("means", "quats", "scales", "opacities", "viewmats", "Ks")}
    single |= {key: call[key] for key in ("width", "height")} | {"render_mode": mode}
    both = {key: torch.stack([single[key]] * 2) for key in ("means", "quats", "scales", "opacities", "viewmats", "Ks")}
    both["means"][1] += 0.1
    both |= {"colors": torch.stack([colors] * 2), "backgrounds": backgrounds}
    image, alpha, meta = rasterization(**single | both, packed=False)
    depth = mode != "RGB"
    shown = depth + (0 if mode in ("D", "ED") else channels)
    assert image.shape == (2, 2, call["height"], call["width"], shown) and alpha.shape == (*image.shape[:-1], 1)
    assert (meta["n_batches"], meta["n_cameras"]) == (2, 2) and meta["means2d"].shape == (2, 2, len(colors), 2)
    assert meta["isect_offsets"].shape == (2, 2, meta["tile_height"], meta["tile_width"])
    alone = single | {key: single[key][1:] for key in ("viewmats", "Ks")} | {"means": both["means"][1]}
    expected, _, packed = rasterization(**alone, colors=colors[None], backgrounds=backgrounds[1, 1:])
    assert torch.equal(image[1, 1], expected[0])
    seen = (meta["radii"][1, 1] > 0).all(-1)
    assert torch.equal(packed["gaussian_ids"], seen.nonzero()[:, 0]) and not packed["camera_ids"].any()
    assert torch.equal(packed["means2d"], meta["means2d"][1, 1][seen])
    order = packed["gaussian_ids"][packed["flatten_ids"].long()]
    assert torch.equal(order, meta["flatten_ids"][meta["isect_offsets"][1, 1, 0, 0] :].long() - 3 * len(colors))
    assert (packed["isect_ids"].diff() >= 0).all() and packed["tiles_per_gauss"].sum() == len(order)


@pytest.mark.parametrize("size", [16, 48, 64])
def test_ids_of_instances_are_read_as_gsplat_reads_them(size):
    """By as many bits as the number of tiles has, also where that is a power of two."""
    call = call_of("degree1")
    views = {key: call[key].detach()[:1].repeat(3, 1, 1) for key in ("viewmats", "Ks")}
    _, _, meta = rasterization(**{**call, **views, "width": size, "height": size}, packed=False)
    tiles = meta["tile_width"] * meta["tile_height"]
    high = meta["isect_ids"] >> 32
    places = (high >> tiles.bit_length()) * tiles + high % 2 ** tiles.bit_length()
    begins = torch.searchsorted(places, torch.arange(3 * tiles))
    assert torch.equal(begins.int(), meta["isect_offsets"].flatten())


@pytest.mark.parametrize("colors", [(0, 9, 3), (2, 0, 9, 3)])  # of all cameras, of each
def test_no_gaussians(colors):
    nothing = {"means": (0, 3), "quats": (0, 4), "scales": (0, 3), "opacities": (0,), "colors": colors}
    call = call_of(**{name: torch.zeros(shape) for name, shape in nothing.items()}, backgrounds=torch.ones(2, 3))
    for packed in (True, False):
        image, alpha, meta = rasterization(**call, packed=packed)
        assert (image == 1).all() and not alpha.any() and len(meta["flatten_ids"]) == 0


def test_gradients_of_what_meta_shows_and_sparse_ones():
    found = []
    for packed in (False, True):
        call = call_of(packed=packed, sparse_grad=packed)
        image, _, meta = rasterization(**call)
        meta["means2d"].retain_grad()
        image.square().sum().backward()
        grads = [call[name].grad for name in ("means", "quats", "scales", "viewmats", "Ks")]
        assert all(grad.is_sparse == (packed and index < 3) for index, grad in enumerate(grads))
        around = meta["means2d"].grad if packed else meta["means2d"].grad[(meta["radii"] > 0).all(-1)]
        found.append([grad.to_dense() for grad in (*grads, around)])
    assert all(torch.allclose(one, other, rtol=1e-5, atol=1e-5) for one, other in zip(*found, strict=True))
    for packed in (False, True):
        covars = torch.diag_embed(call_of()["scales"].detach() ** 2).requires_grad_()
        given = call_of() | {"quats": None, "scales": None, "covars": covars}
        rasterization(**given, packed=packed, sparse_grad=packed)[0].square().sum().backward()
        found.append([covars.grad.to_dense()])
    assert torch.allclose(*found[2], *found[3], rtol=1e-5, atol=1e-5) and found[2][0].any()
    clipped = rasterization(**call_of(radius_clip=8.0))[2]
    assert (clipped["radii"] > 8).any(-1).all() and len(clipped["radii"]) > 0


@pytest.mark.parametrize(("mode", "channels"), [pytest.param("RGB", 3, marks=pytest.mark.long), ("RGB+ED", 5)])
def test_sums_of_magnitudes(mode, channels, driver):
    """Each pixel's own gradient of the 2D means, by float64."""
    call = call_of("degree1", sh_degree=None, render_mode=mode, absgrad=True)
    generator = torch.Generator().manual_seed(3)
    call["colors"] = torch.rand(len(call["means"]), channels, generator=generator)
    behind = torch.rand(2, channels, generator=generator)
    weights = torch.randn(2, call["height"], call["width"], channels + ("D" in mode) + 1, generator=generator)
    image, alpha, meta = rasterization(**call, backgrounds=behind)
    assert not meta["means2d"].absgrad.any()
    (torch.cat([image, alpha], -1) * weights).sum().backward()
    pixels = torch.cartesian_prod(torch.arange(call["height"]), torch.arange(call["width"])).flip(1) + 0.5
    for view in range(2):
        mine = meta["camera_ids"] == view
        order = meta["depths"][mine].argsort(stable=True)
        ids, depths = meta["gaussian_ids"][mine][order], meta["depths"][mine][order].detach().double()
        means2d = meta["means2d"][mine][order].detach().double()[None].repeat(len(pixels), 1, 1).requires_grad_()
        dx, dy = (means2d - pixels[:, None]).unbind(2)
        xx, xy, yy = meta["conics"][mine][order].detach().double().unbind(1)
        raw = call["opacities"][ids].detach() * torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
        solid = torch.where(raw >= 1 / 255, raw.clamp_max(0.999), 0.0)
        after = torch.cumprod(1 - solid, 1)
        share = solid * torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
        light, total = share @ call["colors"][ids].double() + after[:, -1:] * behind[view], share.sum(1, keepdim=True)
        parts = [light, *([share @ depths[:, None] / total.clamp_min(1e-10)] if "D" in mode else []), total]
        (torch.cat(parts, 1) * weights[view].flatten(0, 1)).sum().backward()
        expected = means2d.grad.abs().sum(0)
        assert relative_error(meta["means2d"].absgrad[mine][order], expected) < 1e-3


GROWING = {"refine_start_iter": 10, "refine_every": 20}
STRATEGIES = {
    "default": gsplat.DefaultStrategy(**GROWING, grow_grad2d=1e-6, refine_stop_iter=200),
    "mcmc": gsplat.MCMCStrategy(**GROWING, noise_lr=10.0, min_opacity=0.05),
}


@pytest.mark.parametrize("packed", [True, pytest.param(False, marks=pytest.mark.long)])
@pytest.mark.parametrize("steps", [60, pytest.param(300, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", STRATEGIES)
def test_its_strategies_grow_a_model(name, packed, steps, monkeypatch):
    """gsplat's own, on our meta; the helpers that it has on a GPU alone are ours."""
    for helper in ("compute_relocation", "quat_scale_to_covar_preci"):
        monkeypatch.setattr(f"gsplat.strategy.ops.{helper}", getattr(ours, helper))
    target = rasterization(**call_of())[0].detach()
    call = call_of(packed=packed)
    names = ("means", "quats", "scales", "opacities", "colors")
    raw = {name: call[name].detach()[::3] for name in names}
    raw |= {"scales": raw["scales"].log(), "opacities": torch.logit(raw["opacities"])}
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(tensor.clone()) for name, tensor in raw.items()})
    optimizers = {name: torch.optim.Adam([params[name]], lr=0.005) for name in names}
    strategy, more = STRATEGIES[name], {"packed": packed} if name == "default" else {"lr": 1e-3}
    strategy.check_sanity(params, optimizers)
    state, losses, before = strategy.initialize_state(), [], len(params["means"])
    cameras = {name: call[name] for name in ("viewmats", "Ks", "width", "height", "sh_degree")}
    for step in range(steps):
        activated = {**params, "scales": params["scales"].exp(), "opacities": params["opacities"].sigmoid()}
        image, _, meta = rasterization(**activated, **cameras, packed=packed)
        if name == "default":
            strategy.step_pre_backward(params, optimizers, state, step, meta)
        loss = (image - target).square().mean()
        losses.append(loss.item())
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        strategy.step_post_backward(params, optimizers, state, step, meta, **more)
    assert len(params["means"]) > (1.5 if name == "default" else 1.04) * before and losses[-1] < 0.5 * losses[0]


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"absgrad": True, "sh_degree": None, "colors": torch.zeros(120, 31)}, "absgrad: expected at most 30 channels"),
        ({"colors": torch.zeros(120, 0), "sh_degree": None}, "colors: expected 1 to 512 channels, got 0"),
        ({"viewmats": torch.zeros(0, 4, 4)}, "viewmats: expected a tensor"),
        ({"viewmats": torch.zeros(2, 4, 4)}, "viewmats: expected matrices from world to camera"),
        ({"Ks": torch.zeros(2, 3, 3)}, "Ks: expected matrices with focal lengths fx and fy .*, got a singular one"),
        ({"opacities": torch.full((120,), 1.0001)}, "opacities: expected values in 0..1 .* to 1.0001"),
        ({"means": torch.zeros(120, 3).to_sparse()}, "means: expected a dense tensor"),
        ({"width": 10**6, "height": 10**6}, "width, height: expected at most 4294967296 pixels"),
        ({"sh_degree": torch.zeros(2)}, "sh_degree: expected 0 to 4 or None"),
        ({"distributed": True}, "distributed: warp_splat.gsplat does not carry it; render in each process"),
        ({"covars": torch.zeros(120, 3, 3), "with_ut": True}, "covars: expected None where with_ut is True; give"),
        ({"ftheta_coeffs": object()}, "ftheta_coeffs: .* undistort"),
        ({"viewmats_rs": torch.zeros(2, 4, 4)}, "viewmats_rs: expected None without a rolling_shutter"),
        ({"rolling_shutter": "ROLLING"}, "rolling_shutter: expected None or gsplat's RollingShutterType of ROLLING"),
        ({"camera_model": "ftheta"}, "camera_model: expected one of pinhole, ortho, fisheye, got 'ftheta'"),
        ({"render_mode": "depth"}, "render_mode: expected one of RGB, D"),
        ({"width": 0}, "width: expected a whole number, at least 1, got 0"),
        ({"tile_size": 0}, "tile_size: expected a whole number, at least 1, got 0"),
        ({"eps2d": -1.0}, "eps2d: expected a number, at least 0"),
        ({"sh_degree": 5}, "sh_degree: expected 0 to 4 or None, got 5"),
        ({"sh_degree": 1.0}, "sh_degree: expected 0 to 4 or None, got 1.0"),
        ({"means": torch.zeros(0, 120, 3)}, r"means: expected a scene or more, got \[0, 120, 3\]"),
        ({"sh_degree": 3}, "colors: expected 16 or more coefficients"),
        ({"sh_degree": None}, r"colors: expected shape \[..., N, D\]"),
        ({"means": torch.zeros(3)}, r"means: expected a tensor \[..., N, 3\]"),
        ({"viewmats": torch.zeros(4, 4)}, r"viewmats: expected a tensor \[..., C, 4, 4\]"),
        ({"backgrounds": torch.zeros(2, 4)}, "backgrounds: expected shape"),
        ({"opacities": torch.full((120,), torch.nan)}, "opacities: expected finite numbers"),
        ({"scales": torch.ones(120, 3).double()}, "scales: expected float32, got float64"),
    ],
)
def test_bad_input(changes, found):
    refusal(lambda: rasterization(**call_of() | changes), match=found)
