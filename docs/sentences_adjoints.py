"""The figures in the running text of adjoints.md; see sentences.py."""

import figures as f


def adjoints() -> list[tuple]:
    """Pieces of its text, with ``{}`` for a figure, and the figures."""
    exponentials = [f.knob(scene, "exp_degree 3") for scene in f.scenes("knobs")]
    stops = [f.knob(scene, "t_min 0.01") for scene in f.scenes("knobs")]
    default_stops = [f.knob(scene, "t_min 0.0001")[0] for scene in f.scenes("knobs")]
    caps = [f.worst("adjoints", f.MANY, f"cap {cap}") for cap in (2048, 128)]
    lists = max(int(row["longest_list"]) for row in f.rows("training") if not row["variant"].startswith("cap"))
    image, gradient, _ = f.knob(f.EMBEDDED, "alpha_min 0.003922")
    finer, finest = (f.knob(f.EMBEDDED, f"alpha_min {value}") for value in ("0.001", "0.0001"))
    long = f.quoted("compare/compare.txt", r"embedded, step 300 \| central differences .*\| ([\d.e+]+) extrapolated")[0]
    return [
        ("Machine of error and run\ntime: {}. Other", f.compared_on()),
        (
            "545 px, {} million tile",
            f.two(int(f.quoted("benchmarks/adjoints.md", r"(\d+) tile instances")[0]) / 1e6),
        ),
        ("Its gradient is wrong by {} %", round(100 * min(f.errors("plain")))),
        ("`stepwise` lay between {} and {} times", *f.span(f.times_manual("stepwise"), f.two)),
        ("`reversible` between {} and {}. `stored`", *f.span(f.times_manual("reversible"), f.one)),
        (
            "in the forward pass: {} ms instead of {} here",
            *(round(1e3 * f.seconds(mode, "forward", 2)) for mode in ("stored", "manual")),
        ),
        ("**All modes lie between {} and {}.**", *f.span(f.errors(*f.WITH_GENERATED), f.small)),
        ("That is at least {} times below", int(2e-4 / max(f.errors(*f.WITH_GENERATED)))),
        ("within a factor of {} of each other", f.one(f.spread_of_modes())),
        (
            "it is off by {}, and the gradients by {}, where",
            f.small(f.recovered(100_000)),
            f.small(f.stability("chain_100000", "gradient_error")),
        ),
        ("they take {} hours", f.one(float(long) / 3.6e6)),
        ("Their error over the scenes is {} to {}.", *f.span(f.errors("central differences"), f.small)),
        ("1e-4, which errs by {} to {} in the image", *f.span(default_stops, f.small)),
        (
            "1e-6 takes up to {} times as long",
            f.two(max(f.slower("t_min 1e-06", "t_min 0.0001", scene) for scene in f.scenes("knobs"))),
        ),
        (
            "1e-2 takes {} to {} times as long, and errs by {} to {}.",
            *f.span([f.slower("t_min 0.01", "t_min 0.0001", scene) for scene in f.scenes("knobs")], f.two),
            *f.span([image for image, *_ in stops], f.small),
        ),
        (
            "1/255 errs by {} in the image and {} % in the gradient",
            f"{image:.1e}".replace("e-0", "e-"),
            round(100 * gradient),
        ),
        (
            "1e-3 errs by {} and {} %, and takes {} times as long",
            f"{finer[0]:.1e}".replace("e-0", "e-"),
            f.one(100 * finer[1]),
            f.two(f.slower("alpha_min 0.001", "alpha_min 0.003922")),
        ),
        (
            "1e-4 errs by {} and {} %, and takes {} times as long",
            f"{finest[0]:.1e}".replace("e-0", "e-"),
            f.one(100 * finest[1]),
            f.two(f.slower("alpha_min 0.0001", "alpha_min 0.003922")),
        ),
        ("deviations takes {} times as long", f.two(f.slower("extent square", "extent ellipse"))),
        (
            "exponential, which takes {} to {} times as long",
            *f.span([f.slower("exp_degree none", "exp_degree 5", scene) for scene in f.scenes("knobs")], f.one),
        ),
        (
            "3 takes {} to {} times as long, and errs by {} in the image and {} in gradients",
            *f.span([f.slower("exp_degree 3", "exp_degree 5", scene) for scene in f.scenes("knobs")], f.two),
            f.small(max(image for image, *_ in exponentials)),
            f.small(max(off for _, off, _ in exponentials)),
        ),
        ("its gradients err by {} (2048 of 10,000 candidates) to {} (128", f.small(caps[0]), f.one(caps[1])),
        ("different modes are {} to {} times closer", *f.span(f.nearer(), "{:.0f}".format)),
        ("PSNR scatters by {} dB over modes and by {} dB over seeds", *f.scatter()),
        ("The mean of `manual` is {} dB", f.two(f.psnr("manual"))),
        (
            "`reversible` takes {} times the time of `manual`, by `stored` {} times",
            *(f.one(f.steps_slower(mode)) for mode in ("reversible", "stored")),
        ),
        ("no tile lists more than {}.", lists),
        ("A cap of 128 cuts {} % of", round(100 * f.fact("training", "embedded", "cap 128", "lists_cut"))),
        ("It costs {} dB, or {} dB if applied", f.one(f.lost("cap 128")), f.one(f.lost("cap 128, rendering only"))),
        ("it takes {} times as long as projection and colors", f.one(f.projection_backwards())),
        ("it gains {} to {} dB over the affine", *f.span(f.gained(), "{:.0f}".format)),
        ("at the same speed, and PSNR differs by {} dB (one seed)", f"{-f.lost('ellipsoid'):+.2f}"),
        ("runs {} named cases, {} verdicts", f.cases(), len(f.rows("stability"))),
        (
            "direction the image errs by {}.",
            f.small(max(f.stability(f"size_{size}", "value_error") for size in ("1x20000", "20000x1"))),
        ),
        (
            "(measured on a slab: {} and {})",
            *f.quoted("compare/volume.txt", r"slab +\| Euler .*\| ([\d.]+) +\|\n.*\| ([\d.]+)"),
        ),
        (
            "its 64 samples err by {}, those of the exponential by {}.",
            *(f.small(f.integrated(name)) for name in ("RK4", "exponential")),
        ),
        ("linearized exponential: up to {},", f.small(max(f.shortcut("linear depth") + f.shortcut("linear peak")))),
        ("overlap: {} where", f.small(max(f.shortcut("no overlap")))),
        ("affine projection: {} to {};", *f.span(f.shortcut("affine"), f.small)),
        ("low-pass: up to {}.", f.small(max(f.shortcut("affine + blur")))),
        (
            "`stepwise` has {} in all, `manual` {}.",
            *(f.rules(mode) + f.plumbing(mode) for mode in ("stepwise", "manual")),
        ),
        ("it saves almost half: {} against {}.", f.rules("stepwise"), f.rules("manual")),
        ("`stored` takes {} to {} times the adjoint", *f.span(f.stored_to_reversible(), f.one)),
        ("What it costs is {} times the memory", round(f.mebibytes("stored") / f.mebibytes("manual"))),
    ]
