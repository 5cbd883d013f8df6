"""A training for a given time: plans against their own steps added up, ends by false clocks, the same bytes again."""

import dataclasses
import json
import tomllib

import numpy as np
import pytest
from commands import SCENE, no_space
from hostile import refusal
from trainings import begin, state_of, stepped, steps

from warp_splat.cli import main, parse
from warp_splat.errors import InputError
from warp_splat.flags import flags_of
from warp_splat.formats.checkpoint import load_checkpoint
from warp_splat.formats.model_folder import ply_path
from warp_splat.runtime.distributed import ALONE, Processes
from warp_splat.training import plan as plans
from warp_splat.training.deadline import REACHED, Deadline, plan_training
from warp_splat.training.options import LearnOptions, TrainConfig, schedule_of
from warp_splat.training.photographs import shrink_at
from warp_splat.training.plan import RATES, Cost, Reached, as_flags, comparable, of_length, plan_for, seconds_of
from warp_splat.training.record import keep, restore

FAST = parse(["train", "-s", "x", "--preset", "fast"])
TASK, COST = plans.Task(500_000, 10_000, 1, FAST.grow.max_gaussians, (0.4, 0.7)), Cost(0.004, 3e-7, 5e-8)


def test_costs_are_found_again():
    places = [(10_000, 30_000), (10_000, 500_000), (200_000, 500_000)]
    found = Cost.of([plans.StepTime(n, p, COST.step + COST.gaussian * n + COST.pixel * p) for n, p in places])
    assert found == pytest.approx(COST)
    seconds = (0.021, 0.02, 0.05)  # fewer pixels took longer
    noisy = Cost.of([plans.StepTime(*place, took) for place, took in zip(places, seconds, strict=True)])
    assert min(noisy) >= 0


@pytest.mark.parametrize(
    ("factor", "start", "least"),
    [(0.1, 10_000, 1), (1.0, 10_000, 1), (3.7, 10_000, 1), (0.1, 80_000, 1), (0.1, 80_000, 80_000)],
)
def test_seconds_are_those_of_the_steps_added_up(factor, start, least):
    """Of more points than a plan has Gaussians, as many start; a file of Gaussians stays whole."""
    task = TASK._replace(start=start, least=least)
    config = of_length(FAST, factor, task)
    learn, options, expected = config.learn, config.plugins["budget"], 0.0
    assert config.grow.max_gaussians == max(round(TASK.most * min(factor, 1) ** 0.5), least)
    for step in range(1, learn.iterations + 1):
        side = [4, 2, 1][sum(step >= learn.coarse_until_iter * share for share in TASK.shares)]
        done = (step - options.densify_from_iter) / (options.densify_until_iter - options.densify_from_iter)
        share = min(max(done, 0), 1) ** 0.5
        begin = min(start, config.grow.max_gaussians)
        gaussians = begin + share * (config.grow.max_gaussians - begin)
        expected += COST.step + COST.gaussian * gaussians + COST.pixel * TASK.pixels / side**2
    assert seconds_of(config, COST, task) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(("growth", "least"), [("budget", 1000), ("reference", 4500), ("mcmc", 4500)])
def test_points_beyond_a_limit_go_where_a_growth_shrinks(growth, least, scene):
    """Early, and a plan has no more Gaussians than it is allowed; a file of Gaussians stays whole."""
    config = TrainConfig(growth=growth, max_gaussians=1000)
    task = plans.task_of(config, scene, ())
    assert (task.start, task.least, task.most) == (4500, least, 1000)
    plan = of_length(config, 0.02, task)
    options = plan.plugins["budget"]
    assert plan.grow.max_gaussians == least
    assert options.densify_from_iter + options.densification_interval < options.densify_until_iter / 2
    assert plans.task_of(config, dataclasses.replace(scene, start=object()), ()).least == 4500


@pytest.mark.parametrize("minutes", [0.2, 1, 5, 60])
def test_plans_take_their_time_and_keep_the_shape(minutes):
    plan = plan_for(FAST, COST, 60.0 * minutes, TASK)
    assert 0.99 * 60 * minutes < seconds_of(plan, COST, TASK) <= 60 * minutes
    assert TASK.least <= plan.grow.max_gaussians <= TASK.most
    factor = plan.learn.iterations / FAST.learn.iterations
    before, after = schedule_of(FAST), schedule_of(plan)
    brief = {"cooldown", "coarse_until_iter"} if factor < 0.3 else set()
    for name in before.keys() - brief:
        assert after[name] == pytest.approx(factor * before[name], rel=2e-3, abs=1.0), name
    others = {name for name, value in plan.flat().items() if value != FAST.flat()[name]} - {"densification_interval"}
    assert others == {name for name in before if before[name]} | ({"max_gaussians", *RATES} if factor < 1 else set())
    for name in RATES:  # higher by the root of what is left out, at most twice
        quicker = getattr(plan.learn, name) / getattr(FAST.learn, name)
        assert quicker == pytest.approx(min(max(factor**-0.5, 1), 2), rel=5e-3), name


@pytest.mark.parametrize(("factor", "start"), [(1.0, 10_000), (0.1, 10_000), (0.06, 1000), (0.03, 20)])
def test_short_plans_reach_their_budget(factor, start):
    plan = of_length(FAST, factor, TASK._replace(start=start))
    options, count = plan.plugins["budget"], start
    for step in range(options.densify_from_iter + 1, options.densify_until_iter):
        count *= 1 + (step % options.densification_interval == 0)
    assert count >= plan.grow.max_gaussians
    assert options.densification_interval == 100 or factor < 0.2


def test_a_shape_without_a_cooldown_gets_one():
    plan = plan_for(parse(["train", "-s", "x"]), COST, 60.0, TASK._replace(shares=()))
    assert plan.learn.cooldown == pytest.approx(0.2 * plan.learn.iterations, abs=1)


def test_flags_of_a_plan_are_the_plan():
    plan = plan_for(FAST, COST, 60.0, TASK).changed(settle_from_iter=99)
    again = parse(["train", "-s", "x", *as_flags(plan).split()])
    assert again == plan and again.learn.end == 99 + plan.learn.cooldown
    assert "pose" not in as_flags(plan) and "--pose_from_iter 0" in as_flags(plan.changed(parts="pose"))


def test_what_can_be_compared():
    table = [Reached("desk", 480_000, 1.0, 1000, 30_000, 25.25), Reached("room", 5_000_000, 1.0, 1000, 30_000, 29.0)]
    plan = FAST.changed(iterations=1200)
    assert comparable(table, plan, TASK).startswith("Comparable trainings reached 25.2 dB (desk, 1000 steps) on held")
    other = comparable(table, FAST.changed(iterations=1600), TASK)
    assert other.startswith("Nothing comparable was measured for 0.50 megapixels and 1600 steps.")
    assert "desk, 0.48 megapixels, 1000 steps: 25.2 dB; room, 5.00 megapixels" in other


def test_the_package_compares_with_what_was_measured():
    """The package's table is that of the documents."""
    measured = json.loads((SCENE.parents[1] / "docs" / "benchmarks" / "minutes.json").read_text())
    rows = [dict(zip(measured["headers"], row, strict=True)) for row in measured["rows"]]
    rows = [row for row in rows if row[measured["headers"][0]] in ("embedded", "half")]
    table = [Reached(**entry) for entry in json.loads(REACHED.read_text())]
    assert len(table) == len(rows) > 2
    for entry, row in zip(table, rows, strict=True):
        assert entry[2:5] == (float(row["asked s"]) / 60, row["iterations"], row["Gaussians"])
        assert entry.psnr == float(row["PSNR dB"])


def taken(learn: LearnOptions, pace, spent: float = 0.0, count: int = 1) -> tuple[float, int, int]:
    """Seconds at the end, the iteration before the cooldown and its length, where a step to k takes pace(k) seconds."""
    deadline, iteration, end, settled = Deadline(learn, TASK.shares, count), 0, np.inf, (0, 0)
    while iteration < end:
        iteration += count
        spent += pace(iteration)
        if end == np.inf and (cooldown := deadline.due(iteration, spent)):
            settled = (iteration, cooldown)
            end = iteration + 1 + cooldown
    return spent, *settled


LEARN = plan_for(FAST, COST, 60.0, TASK).changed(minutes=1.0).learn


def paces(learn, count=1):
    """Seconds of a step with so many images, by kind: a part of its own, and one of each pixel."""
    costs = np.array([0.1 + shrink_at(learn, TASK.shares, step) ** -2.0 for step in range(learn.iterations)])
    step = lambda k: 60.0 / costs.sum() * costs[min(k, learn.iterations - 1)] * count  # noqa: E731
    return {
        "as planned": step,
        "twice as fast": lambda k: 0.5 * step(k),
        "half as fast": lambda k: 2.0 * step(k),
        "slower as it grows": lambda k: step(k) * min(0.5 + 1.5 * k / learn.iterations, 1.5),
        "half as fast from the middle": lambda k: step(k) * (1 + (k > learn.iterations / 2)),
        "noisy": lambda k: step(k) * (1 + ((k * 7919 % 101) / 100 - 0.5) * count**-0.5),  # a mean over images
        "slower by a tenth": lambda k: 1.1 * step(k),
    }


PACES = paces(LEARN)


@pytest.mark.parametrize("name", PACES)
def test_trainings_end_in_time(name):
    seconds, begun, cooldown = taken(LEARN, PACES[name])
    assert abs(seconds - 60) < 0.05 * 60
    assert begun >= LEARN.coarse_until_iter * TASK.shares[-1] and LEARN.cooldown // 4 <= cooldown <= LEARN.cooldown
    if name in ("as planned", "twice as fast", "noisy"):
        assert cooldown > 0.95 * LEARN.cooldown


@pytest.mark.parametrize("count", [1, 4, 8])
@pytest.mark.parametrize("factor", [0.08, 0.16, 0.25])
@pytest.mark.parametrize("name", ["as planned", "noisy", "half as fast from the middle", "slower by a tenth"])
def test_brief_trainings_end_in_time(name, factor, count):
    """The full size comes so late that little is left to look at the pace, less with several images a step."""
    learn = of_length(FAST, factor, TASK).changed(minutes=1.0).learn
    seconds, begun, cooldown = taken(learn, paces(learn, count)[name], count=count)
    assert abs(seconds - 60) < 0.1 * 60
    assert begun >= learn.coarse_until_iter * TASK.shares[-1]
    assert cooldown > 0.7 * learn.cooldown or name.startswith(("half", "slower"))


def test_the_full_size_and_a_cooldown_come_even_where_time_is_up():
    seconds, begun, cooldown = taken(LEARN, lambda k: 600.0 / LEARN.iterations)
    assert seconds > 60 and cooldown == LEARN.cooldown // 4
    assert 0 <= begun - LEARN.coarse_until_iter * TASK.shares[-1] <= 20


def test_the_first_process_decides():
    class Told(type(ALONE)):
        rank = 1

        def largest(self, value):
            assert value == 0
            return 7

    assert Deadline(LEARN).due(LEARN.coarse_until_iter + 50, 1e9, Told()) == 7


@pytest.mark.slow
@pytest.mark.parametrize("settled", [22, 55])
def test_bytes_are_those_of_the_flags(settled, scene, tmp_path):
    """Settled while the set grows, and beyond the planned end; a part's rates fall to the planned end."""
    options = {"parts": "exposure", "cooldown": 12, "coarse": 2, "coarse_until_iter": 10, "densify_until_iter": 33}
    trainer, run = stepped(scene, tmp_path / "a", settled - 5, minutes=1.0, **options)
    (tmp_path / "a").mkdir()
    run.spent = 30.0
    keep(trainer, run)
    trainer, run = begin(scene, tmp_path / "a", minutes=1.0, **options)
    restore(trainer, run, load_checkpoint(tmp_path / "a"))  # what is left of the time is kept
    assert run.spent == 30.0 and trainer.config.learn.end == np.inf
    steps(trainer, run, settled)
    trainer.settle(settled + 1, 9)
    assert trainer.config.learn.end == settled + 10 and trainer.config.learn.minutes == 0
    steps(trainer, run, settled + 10)
    found, facts = state_of(trainer, run)
    options |= {"settle_from_iter": settled + 1, "cooldown": 9}
    expected, others = state_of(*stepped(scene, tmp_path, settled + 10, **options))
    assert found.keys() == expected.keys() and [name for name in found if found[name] != expected[name]] == []
    assert {**facts, "options": 0} == {**others, "options": 0}


def test_rates_fall_and_the_set_stays_once_settled(scene, tmp_path):
    trainer, run = begin(scene, tmp_path, settle_from_iter=21, cooldown=10)
    assert trainer.config.learn.end == 31
    rates, sizes = [], []
    for iteration in range(1, 32):
        steps(trainer, run, iteration)
        rates.append(trainer.optimizer.tables["opacities"].rate)
        sizes.append(len(trainer.model))
    assert rates[:21] == [trainer.config.learn.opacity_lr] * 21
    np.testing.assert_allclose(rates[20:], trainer.config.learn.opacity_lr * 0.1 ** np.linspace(0, 1, 11))
    assert len(set(sizes)) > 1 and len(set(sizes[20:])) == 1


@pytest.mark.slow
def test_a_whole_training_by_the_clock_is_repeated_by_its_options(tmp_path, ran):
    common = "--eval", "-r", 4, "--densification_interval", 5, "--parts", "auto"
    out = ran("train", "-s", SCENE, *common, "-m", tmp_path / "a", "--minutes", 0.02)
    assert "Plan for 0.02 minutes" in out and "ms a step with 4500 Gaussians" in out
    options = tomllib.loads((tmp_path / "a" / "config.toml").read_text())
    end = options["settle_from_iter"] + options["cooldown"]
    assert options["minutes"] == 0 and options["preset"] == "fast" and f"Done after {end} iterations" in out
    assert f"  flags     {as_flags(TrainConfig(**options))}" in out
    ran("train", "--config", tmp_path / "a" / "config.toml", "-m", tmp_path / "b", "--quiet")
    a, b = (ply_path(tmp_path / name, end).read_bytes() for name in "ab")
    assert a == b
    first, again = (json.loads((tmp_path / name / "history.json").read_text()) for name in "ab")
    assert [{**record, "seconds": 0} for record in first] == [{**record, "seconds": 0} for record in again]
    assert len(first) <= max(options["iterations"] // 50, 1)  # evaluations take no large part of so short a time


@pytest.mark.parametrize("images", [4, 7, 9])
def test_a_plan_has_whole_steps(scene, monkeypatch, images):
    """Else the same options, which round up to them, would train otherwise."""
    monkeypatch.setattr("warp_splat.training.deadline.cost_of", lambda *_: COST)
    config = FAST.changed(minutes=1.0, views=images)
    plan = plan_training(scene, config, Processes(images=images), str)
    assert plan.learn.iterations % images == 0


@pytest.mark.slow
def test_a_full_disk_costs_no_step_of_the_cooldown(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("warp_splat.training.record.write_config", no_space)
    common = ["train", "-s", str(SCENE), "-m", str(tmp_path), "-r", "8", "--parts", "", "--minutes", "0.01"]
    assert main(common) == 1
    (*_, last) = json.loads((tmp_path / "history.json").read_text())  # written once all steps are done
    assert "no space left" in capsys.readouterr().err and ply_path(tmp_path, last["iteration"]).exists()


def test_a_shape_has_to_fit_its_iterations(scene):
    """As a file that names but a part of it may have: nothing would grow, and no end come."""
    for shape in ({"coarse": 4, "coarse_until_iter": 51}, {"cooldown": 51}):
        config = TrainConfig(device="cpu", minutes=1.0, iterations=50, **shape)
        refusal(lambda: plan_training(scene, config, ALONE, str), "cooldown in 50 iterations, got 51")  # noqa: B023


@pytest.mark.parametrize(("factor", "late"), [(1.0, 0), (0.3, 0), (0.225, 0.5), (0.15, 1), (0.05, 1)])
@pytest.mark.parametrize(("share", "brief"), [(0.7, 0.3), (0.6, 0.4), (1.0, 1 / 9), (0.0, 1.0)])
def test_far_below_the_shape_the_full_size_comes_late(factor, late, share, brief):
    """The more so the shorter, up to where sizes take all steps, or half of its own; the cooldown likewise."""
    plan, plain = (of_length(FAST, factor, TASK._replace(shares=shares)).learn for shares in ((0.4 * share, share), ()))
    own = 1 - share * 2800 / 3600
    full = 1 - share * plan.coarse_until_iter / plan.iterations
    assert full == pytest.approx(own + late * (brief - own), abs=0.01)
    assert plan.cooldown == pytest.approx(plain.cooldown * full / own, abs=2)


def test_a_densification_has_to_fit(scene):
    config = TrainConfig(device="cpu", minutes=1e-4)
    with pytest.raises(InputError, match=r"^--minutes 0.0001: expected time for one densification .* found"):
        plan_training(scene, config, ALONE, str)


def test_files_and_checkpoints(scene, tmp_path, fails):
    """A file's steps are a shape; its minutes want none beside them. A training that goes on keeps its minutes."""
    file = tmp_path / "a.toml"
    file.write_text("minutes = 3\niterations = 5\n")
    assert "expected no --iterations beside it" in fails("train", "--config", str(file))
    file.write_text("minutes = 3\n")
    assert "expected no --cooldown beside it" in fails("train", "--config", str(file), "--cooldown", "7")
    assert parse(["train", "--config", str(file), "--cooldown", "7", "--iterations", "50"]).learn.end == 50
    file.write_text("settle_from_iter = 3\niterations = 500\n")
    config = parse(["train", "-s", "x", "--config", str(file), "--minutes", "2"])
    assert config.learn.end == 1003 and config.data.preset == "fast" and config.learn.iterations == 500
    assert plan_for(config, COST, 120.0, TASK).learn.settle_from_iter == 0
    assert parse(["train", "--config", str(file), "--iterations", "8"]).learn.end == 8
    trainer, run = begin(scene, tmp_path, minutes=2.0)
    keep(trainer, run)
    resume = ["train", "--resume", str(tmp_path)]
    assert parse(resume).learn.end == parse([*resume, "--minutes", "4"]).learn.end == np.inf
    assert parse([*resume, "--iterations", "70"]).learn.end == 70
    run.spent = 180.0
    keep(trainer, run)
    assert "--minutes 3: expected more than the 3 that" in fails(*resume, "--minutes", "3")
    trainer.settle(20, 5)
    keep(trainer, run)
    assert parse(resume).learn.end == 25
    assert "expected a training that began with it" in fails(*resume, "--minutes", "4")


def test_schedules_are_marked():
    marked = {item.name for item in flags_of(TrainConfig) if item.metadata["schedule"]}
    others = {"iterations", "position_lr_max_steps", "cooldown", "sh_interval", "opacity_reset_interval"}
    assert marked == {name for name in TrainConfig().flat() if name.endswith("_iter")} | others
