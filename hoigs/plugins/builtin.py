"""The built-in parts: names and where each stands. They enter through the hook that all use."""

from __future__ import annotations

from collections.abc import Iterator

from hoigs.core.component import Component
from hoigs.core.hookspecs import hookimpl

DEFORMATION = "hoigs.plugins.deformation"
FEATURES = "hoigs.plugins.features"
INTERACTION = "hoigs.plugins.interaction"
PRIORS = "hoigs.plugins.priors"
READERS = "hoigs.plugins.readers"

# key, module, class, config class, summary
PARTS = (
    ("rasterizer:torch", "hoigs.rasterizers.torch_tiles", "TorchRasterizer", "TorchConfig",
     "readable and tiled, in plain torch; any device"),
    ("rasterizer:warp", "hoigs.rasterizers.warp", "WarpRasterizer", "WarpConfig",
     "Warp kernels for CPU and CUDA with a hand-written backward pass"),
    ("rasterizer:oracle", "hoigs.rasterizers.oracle", "OracleRasterizer", "OracleConfig",
     "the yardstick: float64, every Gaussian at every pixel"),
    ("rasterizer:gsplat", "hoigs.rasterizers.gsplat", "GsplatRasterizer", "GsplatConfig",
     "gsplat's CUDA kernels, with their fixed cut-offs"),
    ("deformation:static", f"{DEFORMATION}.static", "Static", "StaticConfig",
     "does not move"),
    ("deformation:mlp", f"{DEFORMATION}.mlp", "MlpDeformation", "MlpConfig",
     "an MLP of position and time, as in Deformable 3D Gaussians"),
    ("deformation:hexplane-field", f"{DEFORMATION}.hexplane_field", "HexPlaneField",
     "HexPlaneFieldConfig", "six planes over space and time and small heads, as in 4DGS"),
    ("deformation:embedded", f"{DEFORMATION}.embedded", "Embedded", "EmbeddedConfig",
     "a code per Gaussian and a table over time, coarse and fine, as in E-D3DGS"),
    ("deformation:se3-field", f"{DEFORMATION}.se3_field", "Se3Field", "Se3FieldConfig",
     "a field of rigid motions as in Nerfies, with HyperNeRF's slices if asked for"),
    ("deformation:chs", f"{DEFORMATION}.chs", "CubicHermite", "CubicHermiteConfig",
     "a cubic Hermite spline per Gaussian, tangents learned or finite differences"),
    ("deformation:rigid-spline", f"{DEFORMATION}.rigid_spline", "RigidSpline", "RigidSplineConfig",
     "one SE(3) spline moves a whole object, knots uniform or adaptive"),
    ("deformation:rigid-residual", f"{DEFORMATION}.rigid_residual", "RigidResidual",
     "RigidResidualConfig", "as rigid-spline, with a small motion of each Gaussian's own"),
    ("deformation:articulated", f"{DEFORMATION}.articulated", "Articulated", "ArticulatedConfig",
     "two rigid parts about a learned hinge or slide, as ARCTIC's objects"),
    ("deformation:linear-displacement", f"{DEFORMATION}.linear_displacement", "LinearDisplacement",
     "LinearDisplacementConfig", "each Gaussian on a line, as Ex4DGS's static ones"),
    ("deformation:ex4dgs", f"{DEFORMATION}.ex4dgs", "Ex4dgs", "Ex4dgsConfig",
     "static Gaussians on lines; those that move most are promoted to keyframes, as in Ex4DGS"),
    ("deformation:hexplane-skinning", f"{DEFORMATION}.hexplane_skinning", "HexPlaneSkinning",
     "HexPlaneSkinningConfig", "a skinned body whose looks come from space-time planes"),
    ("deformation:triplane-avatar", f"{DEFORMATION}.triplane_avatar", "TriplaneAvatar",
     "TriplaneAvatarConfig", "a skinned body decoded from three planes, as in ExAvatar and HUGS"),
    ("deformation:lbs", f"{DEFORMATION}.lbs", "Lbs", "LbsConfig",
     "a body that is skinned and nothing else"),
    ("deformation:object-bone", f"{DEFORMATION}.object_bone", "ObjectBone", "ObjectBoneConfig",
     "an object that hangs on a wrist as one more bone, as in HOSNeRF"),
    ("deformation:rigid-frames", f"{DEFORMATION}.rigid_frames", "RigidFrames",
     "RigidFramesConfig", "an object's track, corrected frame by frame, as in HOLD"),
    ("deformation:static-dynamic", f"{DEFORMATION}.static_dynamic", "StaticDynamic",
     "StaticDynamicConfig", "Gaussians that sort themselves into still and moving, as in D2NeRF"),
    ("features:body-parts", f"{FEATURES}.body_parts", "BodyPartFeatures", "BodyPartConfig",
     "16 tokens, one a body part, from the body's feature field"),
    ("features:spline-motion", f"{FEATURES}.spline_motion", "SplineMotionFeatures",
     "SplineMotionConfig", "velocity, keyed embedding and time of each Gaussian"),
    ("features:embedding", f"{FEATURES}.embedding", "EmbeddingFeatures", "EmbeddingConfig",
     "learned tokens that see neither space nor time (an ablation)"),
    ("interaction:cross-attention", f"{INTERACTION}.cross_attention", "CrossAttention",
     "CrossAttentionConfig", "humans and objects in reach attend to each other"),
    ("interaction:none", f"{INTERACTION}.none", "NoInteraction", "NoInteractionConfig",
     "entities ignore each other (an ablation)"),
    ("body:anny", "hoigs.plugins.bodies.anny", "AnnyBody", "AnnyConfig",
     "the body that comes with hoigs, made from Anny"),
    ("body:smplx", "hoigs.plugins.bodies.smplx", "SmplxBody", "SmplxConfig",
     "SMPL-X, from your own SMPLX_*.npz"),
    ("body:smplh", "hoigs.plugins.bodies.smplh", "SmplhBody", "SmplhConfig",
     "SMPL+H, from your own model.npz; BEHAVE's body"),
    ("body:smpl", "hoigs.plugins.bodies.smplh", "SmplBody", "SmplConfig",
     "SMPL, from your own .npz; HOSNeRF's and NeuMan's body"),
    ("reader:clip", "hoigs.plugins.readers.clip", "ClipFolderReader", "ClipFolderReaderConfig",
     "the clip folder that `hoigs prepare` writes"),
    ("reader:colmap", f"{READERS}.colmap", "ColmapReader", "ColmapConfig",
     "images/ beside COLMAP's sparse model, masks by entity if there are any"),
    ("reader:dnerf", f"{READERS}.dnerf", "DnerfReader", "DnerfConfig",
     "Blender scenes with times, as D-NeRF's"),
    ("reader:nerfstudio", f"{READERS}.nerfstudio", "NerfstudioReader", "NerfstudioConfig",
     "nerfstudio's transforms.json, lens distortion taken out"),
    ("reader:hypernerf", f"{READERS}.hypernerf", "HypernerfReader", "HypernerfConfig",
     "captures of Nerfies and HyperNeRF"),
    ("reader:neuman", f"{READERS}.neuman", "NeumanReader", "NeumanConfig",
     "NeuMan's scenes: cameras, person masks, depth and SMPL poses, in metres"),
    ("reader:exavatar", f"{READERS}.exavatar", "ExavatarReader", "ExavatarConfig",
     "ExAvatar's fitted videos: cameras, person masks and SMPL-X poses"),
    ("reader:hosnerf", f"{READERS}.hosnerf", "HosnerfReader", "HosnerfConfig",
     "a scene of HOSNeRF: cameras and SMPL poses by frame name"),
    ("density:adc", "hoigs.plugins.density.adc", "AdaptiveDensity", "AdaptiveDensityConfig",
     "clone, split and prune as 3DGS does, under a hard cap"),
    ("density:absgrad", "hoigs.plugins.density.absgrad", "AbsoluteGradientDensity",
     "AbsoluteGradientConfig", "as adc, by gradients whose opposite pulls do not cancel (AbsGS)"),
    ("density:mcmc", "hoigs.plugins.density.mcmc", "McmcDensity", "McmcDensityConfig",
     "relocate what is dead, explore with noise, grow to the cap (3DGS-MCMC)"),
    ("density:budget", "hoigs.plugins.density.budget", "BudgetDensity", "BudgetDensityConfig",
     "exactly as many as asked for, grown where it matters (Taming 3DGS)"),
    ("density:none", "hoigs.plugins.density.none", "NoDensity", "NoDensityConfig",
     "the number of Gaussians stays"),
    ("prior:depth", f"{PRIORS}.depth", "DepthPrior", "DepthPriorConfig",
     "an object's masked depth, back-projected and carried by its track"),
    ("prior:points", f"{PRIORS}.points", "PointsPrior", "PointsPriorConfig",
     "points of any generator, aligned by scale and world transform"),
    ("prior:mesh", f"{PRIORS}.mesh", "MeshPrior", "MeshPriorConfig",
     "a mesh, sampled evenly with its colours and aligned"),
    ("prior:sfm", f"{PRIORS}.sfm", "SfmPrior", "SfmPriorConfig",
     "scene points within the mask of a thing that stands still"),
    ("prior:sds", f"{PRIORS}.sds", "SdsPrior", "SdsPriorConfig",
     "score distillation from a diffusers pipeline of yours, for the sides that no frame shows"),
    ("prior:masks-files", f"{PRIORS}.video_masks_files", "MasksFilesPrior", "MasksFilesConfig",
     "masks of a video that any segmenter has written: images, labels, arrays, videos"),
    ("prior:depth-files", f"{PRIORS}.video_depth_files", "DepthFilesPrior", "DepthFilesConfig",
     "depth of a video that any estimator has written: npy, npz, 16-bit PNG, EXR"),
    ("prior:landmarks-files", f"{PRIORS}.video_landmarks_files", "LandmarksFilesPrior",
     "LandmarksFilesConfig", "landmarks of a person: MediaPipe's, COCO's, OpenPose's files"),
    ("prior:mediapipe", f"{PRIORS}.video_mediapipe", "MediapipePrior", "MediapipeConfig",
     "landmarks of a person by MediaPipe Pose, in an environment of its own"),
    ("prior:command", f"{PRIORS}.video_command", "CommandPrior", "CommandConfig",
     "masks, depth or landmarks that a command line of yours writes"),
)  # fmt: skip
# parts that need an optional dependency
EXTRAS = {"rasterizer:gsplat": "gsplat", "prior:sds": "sds"}


@hookimpl
def hoigs_components() -> Iterator[Component]:
    for key, module, name, config, summary in PARTS:
        yield Component(
            key,
            f"{module}:{name}",
            config=f"{module}:{config}",
            summary=summary,
            extra=EXTRAS.get(key),
        )
