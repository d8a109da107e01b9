"""Named tables and their rows, after the tables of the paper, all in matched settings."""

from __future__ import annotations

from collections.abc import Sequence

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.studies.jobs.rows import Row, TableSet

UNSHIPPED = "hoigs ships no {}; prepare a clip with them and name it in --clips"


def _source(label: str, key: str, what: str) -> Row:
    return Row(label, None, paper=(f"priors/{key}",), why=UNSHIPPED.format(what))


def _method(name: str, *paper: str) -> Row:
    return Row(name, f"{name}@matched", paper=paper)


TABLE_SETS = {
    table.name: table
    for table in (
        TableSet(
            "comparison",
            "Comparison with other methods, matched settings",
            (
                _method("hoigs", "runtime/hoigs", "hosnerf/hoigs", "behave/hoigs", "arctic/hoigs",
                        "arctic-geometry/hoigs"),
                _method("hoigs-paper"),
                _method("4dgs", "runtime/4dgs", "hosnerf/4dgs", "behave/4dgs", "arctic/4dgs"),
                _method("d3dgs", "runtime/d3dgs", "hosnerf/d3dgs"),
                _method("e-d3dgs", "runtime/e-d3dgs", "hosnerf/e-d3dgs", "behave/e-d3dgs",
                        "arctic/e-d3dgs"),
                _method("ex4dgs", "runtime/ex4dgs", "hosnerf/ex4dgs"),
                _method("exavatar", "hosnerf/exavatar", "behave/exavatar"),
                _method("hugs"),
                _method("static-3dgs"),
                _method("k-planes-gs", "hosnerf/k-planes"),
                _method("nerfies-gs", "hosnerf/nerfies"),
                _method("hypernerf-gs", "hosnerf/hypernerf"),
                _method("d2nerf-gs", "hosnerf/d2nerf"),
                _method("neuman-gs", "hosnerf/neuman"),
                _method("hosnerf-gs", "hosnerf/hosnerf"),
                _method("hold-gs", "arctic/hold", "arctic-geometry/hold"),
            ),
        ),
        TableSet(
            "ablation-object-motion",
            "Ablation: how the object moves",
            (
                # the paper's has no track, which would give it the true pose of every frame
                Row("MLP", "hoigs-object-mlp@matched", ("model.object.deformation.track=false",),
                    paper=("object-motion/mlp",)),
                Row("MLP about the track's poses", "hoigs-object-mlp@matched"),
                Row("CHS that starts near the track", "hoigs@matched",
                    ("model.object.deformation.use=deformation:chs",),
                    paper=("object-motion/hoigs",)),
                Row("CHS about the track, tangents by finite differences", "hoigs-chs-fd@matched",
                    paper=("object-motion/baseline-deformation",)),
                Row("CHS about the track (hoigs)", "hoigs@matched"),
            ),
        ),
        TableSet(
            "ablation-interaction",
            "Ablation: the interaction module",
            (
                Row("off", "hoigs-no-interaction@matched", paper=("interaction/no-interaction",)),
                Row("on (hoigs)", "hoigs@matched", paper=("interaction/hoigs",)),
            ),
        ),
        TableSet(
            "ablation-human-feature",
            "Ablation: the human's features",
            (
                Row("embedding", "hoigs-human-embedding@matched",
                    paper=("interaction/no-human-feature",)),
                Row("HexPlane (hoigs)", "hoigs@matched", paper=("interaction/hoigs",)),
            ),
        ),
        TableSet(
            "object-prior",
            "Where the object's first Gaussians come from",
            (
                Row("the clip's own points", "hoigs@matched"),
                Row("masked depth", "hoigs@matched",
                    ("model.object.initializer.use=initializer:depth",),
                    paper=("object-prior/depth",)),
                Row("MASt3R", None, paper=("object-prior/mast3r",),
                    why="hoigs ships no MASt3R; give its points with --specs, initializer:points"),
                Row("diffusion (score distillation)", None, paper=("object-prior/diffusion",),
                    why="hoigs ships no diffusion weights; give yours: --specs, initializer:sds"),
            ),
        ),
        TableSet(
            "mask-depth-source",
            "Where masks and depth come from",
            (
                Row("the clip's own", "hoigs@matched"),
                Row("a third of the masks' borders wrong", "hoigs@matched",
                    clip_settings="noise.mask_boundary=0.33"),
                Row("depth with 5 % noise and 10 % holes", "hoigs@matched",
                    clip_settings="noise.depth_relative=0.05&noise.depth_holes=0.1"),
                _source("Samurai + Metric3D v2", "samurai+metric3dv2", "Samurai, no Metric3D"),
                _source("Samurai + Video Depth Anything", "samurai+vda",
                        "Samurai, no Video Depth Anything"),
                _source("Samurai + DepthCrafter", "samurai+depthcrafter",
                        "Samurai, no DepthCrafter"),
                _source("Track Anything + Metric3D v2", "trackanything+metric3dv2",
                        "Track Anything, no Metric3D"),
                _source("SAM 2 + Video Depth Anything", "sam2+vda",
                        "SAM 2, no Video Depth Anything"),
                _source("Mask R-CNN + Metric3D v2", "maskrcnn+metric3dv2",
                        "Mask R-CNN, no Metric3D"),
            ),
        ),
    )
}  # fmt: skip


def choose_sets(names: Sequence[str], specs: Sequence[str]) -> list[TableSet]:
    """The sets of these names, then one of these specs; all named sets when neither is given.

    Raises:
        HoigsError: no set of that name.
    """
    chosen = []
    for name in names or ([] if specs else list(TABLE_SETS)):
        if name not in TABLE_SETS:
            known = list(TABLE_SETS)
            raise HoigsError(
                f"no table set {name!r}; there are {', '.join(known)}{did_you_mean(name, known)}"
            )
        chosen.append(TABLE_SETS[name])
    if specs:
        rows = tuple(Row(spec, spec, paper=_of_spec(spec)) for spec in specs)
        chosen.append(TableSet("specs", "Chosen specs", rows))
    return chosen


def _of_spec(spec: str) -> tuple[str, ...]:
    """The paper's rows for the method of a spec's name, if any."""
    name = spec.partition("@")[0]
    rows = (row for row in TABLE_SETS["comparison"].rows if row.label == name)
    return next((row.paper for row in rows), ())
