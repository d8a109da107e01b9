"""A scene composed by hand, without registry and spec: three entities, interaction, rasterizer.

Run: python examples/01_compose.py [CLIP [STEPS]]
"""

import sys

import hoigs as h

source = sys.argv[1] if sys.argv[1:] else "builtin:lift-and-swing?width=128"
steps = int(sys.argv[2]) if sys.argv[2:] else 500

clip = h.read_clip(source)
track = clip.objects["object"]
body = h.AnnyBody()

scene = h.SceneModel(
    {
        "scene": h.Entity(h.Gaussians.from_points(clip.points, clip.point_colors), h.Static()),
        "human": h.Entity(
            body.canonical(6000),
            h.HexPlaneSkinning(body=body, num_frames=clip.num_frames),
            features=h.BodyPartFeatures(),
        ),
        "object": h.Entity(
            h.Gaussians.from_points(track.points, track.colors),
            h.CubicHermite(h.CubicHermite.Config(keyframes=17), track=track),
            features=h.SplineMotionFeatures(),
        ),
    },
    interaction=h.CrossAttention(),
    rasterizer=h.WarpRasterizer(),
)

trainer = h.Trainer(scene, clip, h.TrainSpec(steps=steps))
trainer.train(lambda report: report.psnr and print(report.step, report.psnr))

frame = clip[len(clip) // 2]
image = scene.render(frame.moment, frame.camera).color
print(
    f"frame {frame.position} drawn as {tuple(image.shape)} by {sum(scene.count().values())} splats"
)
