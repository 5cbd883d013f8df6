"""A part and a growth of one's own: a class and a line of a table, without a change elsewhere."""

import re
from dataclasses import dataclass, fields

import pytest
import torch
from commands import ROOT, SCENE, train
from hostile import refusal
from trainings import Pretended, begin, check_same, resumed, state_of

from warp_splat.cli import main, parse
from warp_splat.flags import growing, learning
from warp_splat.formats.model_folder import ply_path
from warp_splat.training.config_file import load_options, read_config, write_config
from warp_splat.training.growth import GROWTHS
from warp_splat.training.options import TrainConfig
from warp_splat.training.parts import PARTS
from warp_splat.training.record import keep
from warp_splat.training.seams import Change, Entry, Verdict
from warp_splat.training.trainer import Trainer


@dataclass(frozen=True)
class GainOptions:
    """Of the part below."""

    gain_lr: float = learning(0.01, "rate of the gain of each photograph")


class Gain:
    """The logarithm of a factor for each photograph, learned by Adam; it also asks for depth and counts steps."""

    def __init__(self, options, setting):
        self.options, self.steps = options, torch.zeros(1, dtype=torch.int64)
        self.places = {view: place for place, view in enumerate(setting.scene.train)}
        self.gains = torch.zeros(len(self.places), device=setting.model.device, requires_grad=True)

    @classmethod
    def needed(cls, scene):
        spread = float(torch.tensor([float(view.image.mean()) for view in scene.train]).std())
        return Verdict(spread > 1.0, f"the brightness of the photographs varies by {spread:.1f}")

    def parameters(self):
        return [{"name": "gain", "params": [self.gains], "lr": self.options.gain_lr}]

    def asks(self, options, step):
        return type(options)(**{**vars(options), "depth": True})

    def image(self, image, out, step):
        assert out.depth is not None
        return image * torch.exp(self.gains[self.places[step.view]])

    def loss(self, loss, out, step):
        return loss + 1e-3 * self.gains.square().mean()

    def after_step(self, iteration):
        self.steps += 1

    def state(self):
        return {"gain.steps": self.steps}

    def restore(self, checkpoint):
        if "gain.steps" in checkpoint.arrays:
            self.steps = torch.from_numpy(checkpoint.array("gain.steps", (1,), "int64").copy())


@dataclass(frozen=True)
class FaintOptions:
    """Of the growth below."""

    faint_below: float = growing(0.02, "opacity under which to prune")


class Faint:
    """Prunes what is faint every tenth step, and never adds."""

    def __init__(self, options, setting, optimizer):
        self.options, self.model, self.optimizer = options, setting.model, optimizer
        self.seen = torch.zeros(1, dtype=torch.int32)

    def observe(self, out, step):
        self.seen += 1

    def update(self, iteration):
        if iteration % 10:
            return None
        keep = torch.sigmoid(self.model.parameters["opacities"].detach()) >= self.options.faint_below
        self.optimizer.replace(keep.nonzero()[:, 0], {n: t.detach()[:0] for n, t in self.model.parameters.items()})
        return Change(0, 0, int((~keep).sum()))

    def grows(self, iterations):
        return False

    def state(self):
        return {"faint.seen": self.seen}

    def restore(self, checkpoint):
        self.seen = torch.from_numpy(checkpoint.array("faint.seen", (1,), "int32").copy())


@pytest.fixture(autouse=True)
def _registered(monkeypatch):
    monkeypatch.setitem(PARTS, "gain", Entry(GainOptions, f"{__name__}.Gain"))
    monkeypatch.setitem(GROWTHS, "faint", Entry(FaintOptions, f"{__name__}.Faint"))


@pytest.mark.parametrize(
    "options",
    [
        {"parts": "gain", "gain_lr": 0.05, "opacity_reset_interval": 100},
        {"parts": "random_background,gain", "growth": "faint", "optimizer_type": "sparse_adam", "faint_below": 0.095},
    ],
    ids=str,
)
def test_own_ones_learn_and_resume_to_the_same_bytes(options, scene, tmp_path):
    trainer, run = expected = resumed(scene, tmp_path, [34], **options)
    state, _ = state_of(trainer, run)
    for name in ("parameters", "exp_avg", "exp_avg_sq", "gradients"):
        assert state[f"{name}.gain"][1] == (len(scene.train),)
    gain = trainer.parts[-1]
    assert int(gain.steps) == 33 and int((gain.gains != 0).sum()) == 33  # one photograph in each step
    trainer, run = found = resumed(scene, tmp_path, [0, 11, 20, 34], **options)
    check_same(found, expected)
    if options.get("growth"):
        assert int(trainer.growth.seen) == 34 and len(trainer.model) < len(scene.points)


def test_what_a_part_learns_is_adams_step_of_the_mean_gradient(scene, monkeypatch):
    """Against torch's own Adam, with rate, betas and epsilon for two processes; the model's set changes meanwhile."""
    config = {"device": "cpu", "parts": "gain", "densify_from_iter": 1, "densification_interval": 4}
    trainer = Trainer(scene, TrainConfig(**config), Pretended(0, 2))
    exchanged = []
    monkeypatch.setattr(trainer.processes, "average", exchanged.append)
    copy = torch.zeros(len(scene.train), dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([copy], 0.01 * 2**0.5, (0.9**2, 0.999**2), 1e-15 / 2**0.5)
    for iteration in (2, 4, 6):
        trainer.differentiate(iteration)
        gains = trainer.optimizer.parts["gain"]
        assert any(tensor is gains.grad for tensor in exchanged[-1])
        copy.grad = gains.grad.double()
        trainer.update(iteration)
        adam.step()
        assert torch.allclose(gains.detach().double(), copy.detach(), rtol=5e-7, atol=1e-8) and gains.grad is None


@pytest.mark.slow
def test_flags_files_and_output_know_them(tmp_path, capsys, fails, ran):
    """Of those that the scene does not need, the figure is told."""
    options = "--no-quiet --parts auto --growth faint --gain_lr 0.5 --iterations 12"
    assert train(tmp_path / "a", *options.split()) == 0
    out = "".join(capsys.readouterr())
    assert "Part random_background: left out, since 0 of 43 photographs are transparent somewhere." in out
    assert "Part gain: taken, since the brightness of the photographs varies by" in out and "as at the beginning" in out
    config = read_config(tmp_path / "a" / "config.toml")
    assert (config["parts"], config["growth"], config["gain_lr"]) == ("gain", "faint", 0.5)
    assert load_options(tmp_path / "a")["faint_below"] == 0.02
    ran("train", "--resume", tmp_path / "a", "--iterations", 24)
    assert train(tmp_path / "b", "--config", str(tmp_path / "a" / "config.toml"), "--iterations", "24") == 0
    assert ply_path(tmp_path / "a", 24).read_bytes() == ply_path(tmp_path / "b", 24).read_bytes()
    said = ran("train", "--resume", tmp_path / "b", "--parts", "floaters", "--no-quiet")
    assert "Warning: the part gain is left out from here on" in said
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    assert "--gain_lr FLOAT" in capsys.readouterr().out
    begun = ["train", "-s", str(SCENE), "-m", str(tmp_path / "c")]
    names = "random_background, sky, exposure, pose, depth, surface, floaters, gain"
    assert f"--parts: expected auto, or some of {names}" in fails(*begun, "--parts", "weather")
    assert "--growth: expected one of reference, budget, mcmc, faint" in fails(*begun, "--growth", "weather")


def test_neither_trainer_nor_command_line_knows_one_by_name():
    files = ("cli", "training/trainer", "training/command", "training/opening", "training/record")
    texts = [(ROOT / f"warp_splat/{file}.py").read_text() for file in files]
    words = set(re.findall(r"\w+", re.sub(r'""".*?"""|#[^\n]*', "", "\n".join(texts), flags=re.DOTALL)))
    for entry in (*PARTS.values(), *GROWTHS.values()):
        found = words & {*entry.place.split(".")[-2:], *(item.name for item in fields(entry.options))}
        assert found <= {"background", "depth", "surface"}  # a color, a plane, and of a mesh, too


def test_options_of_one_name_are_refused(monkeypatch, fails):
    @dataclass(frozen=True)
    class OtherOptions:
        faint_below: float = growing(0.5, "of another growth")

    monkeypatch.setitem(GROWTHS, "other", Entry(OtherOptions, f"{__name__}.Faint"))
    message = "--faint_below: expected one kind of options with it, found FaintOptions and OtherOptions; rename one."
    refusal(TrainConfig, message)
    assert message in fails("train")


def test_growths_may_share_their_options(monkeypatch):
    monkeypatch.setitem(GROWTHS, "other", Entry(FaintOptions, f"{__name__}.Faint"))
    config = TrainConfig(faint_below=0.25, growth="other")
    assert config.plugins["other"] == config.plugins["faint"] == FaintOptions(0.25)
    assert config.changed(seed=1).flat()["faint_below"] == 0.25


@pytest.mark.parametrize(("flags", "parts"), [([], "random_background,gain"), (["--no-random_background"], "gain")])
def test_a_part_that_auto_took_is_left_out_where_its_flag_says_so(flags, parts, scene, tmp_path):
    """Of a training that goes on, and of one that takes its options."""
    trainer, run = begin(scene, tmp_path, parts="random_background,gain")  # as after auto
    keep(trainer, run)
    write_config(tmp_path, trainer.config)
    for source in (["--resume", str(tmp_path)], ["--config", str(tmp_path / "config.toml")]):
        config = parse(["train", *source, *flags])
        assert config.model.parts == parts and config.used_parts == [n for n in PARTS if n in parts.split(",")]
