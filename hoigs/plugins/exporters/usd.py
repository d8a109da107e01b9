"""exporter:usd: Gaussians, people, objects and the camera over time in one OpenUSD stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel, UsdVol, Vt
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.maths.rotations import axis_angle_to_quats
from hoigs.core.model.exporter import Exporter, ExportRequest
from hoigs.core.reporting import Progress
from hoigs.core.values.between import camera_between, frame_of
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.exporters.carried import at_rest
from hoigs.plugins.exporters.glb import linear_color
from hoigs.plugins.exporters.posed import (
    AXES,
    BodyMotion,
    Move,
    ObjectMotion,
    body_motion,
    object_motions,
    world_move,
)
from hoigs.plugins.exporters.surfaces import Surface, body_surface, motion_surface

INFLUENCES = 8  # joints that may move a vertex
FILM = 36.0  # width of the camera's aperture, millimetres


class UsdConfig(ComponentConfig):
    """Settings of `exporter:usd`."""

    splats: bool = True
    """Gaussians, a ParticleField3DGaussianSplat for each entity"""
    skeletons: bool = True
    """people as UsdSkel, invisible where there are splats"""
    textures: bool = False
    """materials with texture files beside the stage (name a folder or a zip); without, meshes have
    the colours at their vertices"""
    texture: int = Field(default=1024, ge=64, le=8192)
    """pixels of a side of each texture"""


class UsdExporter(Exporter):
    """`scene.usd`: `/World/splats`, `/World/people`, `/World/objects` and `/World/camera`.

    Attributes that change have a time sample a moment; the others have one value.
    """

    Config: ClassVar = UsdConfig
    config: UsdConfig
    suffixes = (".usd", ".usdc")
    up = "y"
    axes = AXES["y"]
    keeps: ClassVar = {
        "Gaussians": "ParticleField3DGaussianSplat, float32, all SH bands, time samples",
        "people": "UsdSkel: skeleton, animation, skinned mesh with normals, st and colours",
        "objects": "an Xform that moves, with a closed mesh through the centres of its Gaussians",
        "camera": "of the video, with time samples",
    }

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        move = world_move(request.clip, "y")
        stage = _stage(request)
        lost: dict[str, str] = {}
        if self.config.splats:
            _add_splats(stage, request, move, progress)
        for name in request.of_kind("human") if self.config.skeletons else ():
            progress(0.7, name)
            if name in request.bodies:
                motion = body_motion(request, name)
                surface = body_surface(motion, at_rest(request, motion), self.config.texture)
                picture = self._picture(folder, name, surface)
                _add_person(stage, motion.moved(move), surface, picture, hidden=self.config.splats)
            else:
                lost[f"skeleton of {name}"] = "it has no body model"
        progress(0.8, "objects and camera")
        for rigid in object_motions(request):
            found, why = motion_surface(request, rigid, self.config.texture)
            lost |= why
            picture = None if found is None else self._picture(folder, rigid.name, found)
            _add_object(stage, rigid, move, (found, picture), hidden=self.config.splats)
            if rigid.residual > 1e-4:
                lost[f"deformation of the points of {rigid.name}"] = (
                    f"the Xform is rigid, {1000 * rigid.residual:.2f} mm (RMS) from the Gaussians"
                )
        frames = [frame_of(request.clip, moment) for moment in request.moments]
        _add_camera(stage, [camera_between(request.clip, f).to("cpu") for f in frames], move)
        progress(0.9, "writing")
        stage.GetRootLayer().Export(str(folder / "scene.usd"))
        return lost

    def _picture(self, folder: Path, name: str, surface: Surface) -> str | None:
        """Write a texture beside the stage, if any are; its path."""
        if not self.config.textures:
            return None
        (folder / f"{_name(name)}.png").write_bytes(surface.png())
        return f"./{_name(name)}.png"


def _stage(request: ExportRequest) -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory(".usdc")
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(request.fps)
    stage.SetFramesPerSecond(request.fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(request.moments) - 1)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    return stage


def _name(text: str) -> str:
    return str(Tf.MakeValidIdentifier(text))


def _set(attribute: Any, values: Sequence[Any]) -> None:
    """One value if all are equal, else a time sample a moment."""
    if all(value == values[0] for value in values):
        attribute.Set(values[0])
        return
    for time, value in enumerate(values):
        attribute.Set(value, time)


def _vectors(points: Float[Tensor, "*batch 3"]) -> Any:
    array = np.ascontiguousarray(points.reshape(-1, 3).numpy(), np.float32)
    return Vt.Vec3fArray.FromNumpy(array)


def _quats(quats: Float[Tensor, "N 4"]) -> Any:
    """wxyz, unit."""
    unit = torch.nn.functional.normalize(quats.double(), dim=-1).tolist()
    return Vt.QuatfArray([Gf.Quatf(w, x, y, z) for w, x, y, z in unit])


def _add_splats(stage: Usd.Stage, request: ExportRequest, move: Move, progress: Progress) -> None:
    moments: dict[str, list[Gaussians]] = {name: [] for name in request.entities}
    for i, moment in enumerate(request.moments):
        progress(0.5 * i / len(request.moments), f"moment {i + 1} of {len(request.moments)}")
        state = request.scene(moment, request.entities)
        for name, gaussians in state.gaussians.items():
            moments[name].append(move.gaussians(gaussians.detach().to("cpu")))
    UsdGeom.Scope.Define(stage, "/World/splats")
    for name, seen in moments.items():
        prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"/World/splats/{_name(name)}")
        _set(prim.CreatePositionsAttr(), [_vectors(g.means) for g in seen])
        _set(prim.CreateOrientationsAttr(), [_quats(g.quats) for g in seen])
        _set(prim.CreateScalesAttr(), [_vectors(g.scales) for g in seen])
        opacities = [Vt.FloatArray.FromNumpy(g.opacities.numpy()) for g in seen]
        _set(prim.CreateOpacitiesAttr(), opacities)
        prim.CreateRadianceSphericalHarmonicsDegreeAttr(seen[0].sh_degree)
        colors = prim.CreateRadianceSphericalHarmonicsCoefficientsAttr()
        _set(colors, [_vectors(g.sh) for g in seen])
        _set(prim.CreateExtentAttr(), [_extent(g.means, g.scales.amax(1) * 3) for g in seen])


def _extent(points: Float[Tensor, "N 3"], reach: Float[Tensor, " N"] | float = 0.0) -> Any:
    radius = reach[:, None] if isinstance(reach, Tensor) else reach
    if len(points) == 0:
        return _vectors(torch.zeros(2, 3))
    low, high = (points - radius).amin(0), (points + radius).amax(0)
    return _vectors(torch.stack((low, high)))


def _add_person(
    stage: Usd.Stage, motion: BodyMotion, surface: Surface, picture: str | None, *, hidden: bool
) -> None:
    path = f"/World/people/{_name(motion.name)}"
    UsdGeom.Scope.Define(stage, "/World/people")
    root = UsdSkel.Root.Define(stage, path)
    parents, body = motion.body.parents, motion.body
    names: list[str] = []
    for joint, parent in enumerate(parents):
        own = _name(body.joint_names[joint])
        names.append(own if parent < 0 else f"{names[parent]}/{own}")
    rest = motion.rest_joints
    bones = torch.stack([rest[j] - (rest[p] if p >= 0 else 0.0) for j, p in enumerate(parents)])
    skeleton = UsdSkel.Skeleton.Define(stage, f"{path}/skeleton")
    skeleton.CreateJointsAttr(names)
    skeleton.CreateBindTransformsAttr([_translation(p) for p in rest])
    skeleton.CreateRestTransformsAttr([_translation(p) for p in bones])
    animation = UsdSkel.Animation.Define(stage, f"{path}/animation")
    animation.CreateJointsAttr(names)
    turns = axis_angle_to_quats(motion.rotations)
    places = [torch.cat((motion.pelvis[i : i + 1], bones[1:])) for i in range(len(motion))]
    _set(animation.CreateTranslationsAttr(), [_vectors(p) for p in places])
    _set(animation.CreateRotationsAttr(), [_quats(q) for q in turns])
    sizes = Vt.Vec3hArray([Gf.Vec3h(motion.scale if j == 0 else 1.0) for j in range(len(parents))])
    animation.CreateScalesAttr(sizes)
    source = UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel()
    source.SetTargets([animation.GetPath()])
    _add_skin(_add_mesh(stage, f"{path}/mesh", surface, picture), motion, skeleton)
    UsdSkel.BindingAPI.Apply(root.GetPrim())
    span = [motion.vertices(i) for i in range(len(motion))]
    _set(root.CreateExtentAttr(), [_extent(v) for v in span])
    if hidden:
        root.CreateVisibilityAttr(UsdGeom.Tokens.invisible)


def _add_mesh(stage: Usd.Stage, path: str, surface: Surface, picture: str | None) -> UsdGeom.Mesh:
    """A closed mesh: normals a vertex, st a corner, colours a vertex, and a texture if any."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    points = torch.from_numpy(surface.vertices)
    mesh.CreatePointsAttr(_vectors(points))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(surface.faces), 3))
    corners = np.ascontiguousarray(surface.faces.reshape(-1), np.int32)
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr(_extent(points))
    mesh.CreateNormalsAttr(_vectors(torch.from_numpy(surface.normals)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    primvars = UsdGeom.PrimvarsAPI(mesh.GetPrim())
    uv = np.ascontiguousarray(surface.uv.reshape(-1, 2), np.float32)
    kind, each = Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
    primvars.CreatePrimvar("st", kind, each).Set(Vt.Vec2fArray.FromNumpy(uv))
    colors = torch.from_numpy(linear_color(surface.vertex_colors()))
    mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(_vectors(colors))
    if picture is not None:
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(_material(stage, path, picture))
    return mesh


def _material(stage: Usd.Stage, path: str, picture: str) -> UsdShade.Material:
    """UsdPreviewSurface whose colour is a texture's."""
    material = UsdShade.Material.Define(stage, f"{path}_material")
    shaders = {}
    kinds = {"surface": "PreviewSurface", "texture": "UVTexture", "st": "PrimvarReader_float2"}
    for name, kind in kinds.items():
        shaders[name] = UsdShade.Shader.Define(stage, f"{path}_material/{name}")
        shaders[name].CreateIdAttr(f"Usd{kind}")
    types = Sdf.ValueTypeNames
    shaders["st"].CreateInput("varname", types.String).Set("st")
    place = shaders["st"].CreateOutput("result", types.Float2)
    shaders["texture"].CreateInput("file", types.Asset).Set(picture)
    shaders["texture"].CreateInput("sourceColorSpace", types.Token).Set("sRGB")
    shaders["texture"].CreateInput("st", types.Float2).ConnectToSource(place)
    color = shaders["texture"].CreateOutput("rgb", types.Float3)
    shaders["surface"].CreateInput("diffuseColor", types.Color3f).ConnectToSource(color)
    shaders["surface"].CreateInput("roughness", types.Float).Set(1.0)
    whole = shaders["surface"].CreateOutput("surface", types.Token)
    material.CreateSurfaceOutput().ConnectToSource(whole)
    return material


def _add_skin(mesh: UsdGeom.Mesh, motion: BodyMotion, skeleton: UsdSkel.Skeleton) -> None:
    weights = motion.body.skinning_weights.float()
    found = weights.topk(min(INFLUENCES, weights.shape[1]), dim=1)
    kept = found.values / found.values.sum(1, keepdim=True)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    count = found.indices.shape[1]
    joints = np.ascontiguousarray(found.indices.numpy().reshape(-1), np.int32)
    binding.CreateJointIndicesPrimvar(False, count).Set(Vt.IntArray.FromNumpy(joints))
    shares = np.ascontiguousarray(kept.numpy().reshape(-1), np.float32)
    binding.CreateJointWeightsPrimvar(False, count).Set(Vt.FloatArray.FromNumpy(shares))
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))


def _translation(place: Float[Tensor, " 3"]) -> Gf.Matrix4d:
    return Gf.Matrix4d(1.0).SetTranslate(Gf.Vec3d(*place.double().tolist()))


def _matrix(turn: Float[Tensor, "3 3"], place: Float[Tensor, " 3"]) -> Gf.Matrix4d:
    """USD multiplies row vectors from the left."""
    whole = torch.eye(4, dtype=torch.float64)
    whole[:3, :3], whole[3, :3] = turn.double().mT, place.double()
    return Gf.Matrix4d(*whole.flatten().tolist())


def _add_object(
    stage: Usd.Stage,
    motion: ObjectMotion,
    move: Move,
    found: tuple[Surface | None, str | None],
    *,
    hidden: bool,
) -> None:
    """An object's mesh, with its texture's path, on a frame that moves; points if it has none."""
    UsdGeom.Scope.Define(stage, "/World/objects")
    frame = UsdGeom.Xform.Define(stage, f"/World/objects/{_name(motion.name)}")
    poses = zip(motion.rotations, motion.translations, strict=True)
    _set(frame.AddTransformOp(), [_matrix(move.turn @ r, move.points(t)) for r, t in poses])
    shape: UsdGeom.PointBased
    if found[0] is not None:
        shape = _add_mesh(stage, f"{frame.GetPath()}/mesh", found[0], found[1])
    else:
        shape = points = UsdGeom.Points.Define(stage, frame.GetPath().AppendChild("points"))
        points.CreatePointsAttr(_vectors(motion.points))
        points.CreateWidthsAttr(Vt.FloatArray(len(motion.points), 0.005))
        colors = torch.from_numpy(linear_color(motion.colors.numpy()))
        points.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(_vectors(colors))
        points.CreateExtentAttr(_extent(motion.points, 0.0025))
    if hidden:
        shape.CreateVisibilityAttr(UsdGeom.Tokens.invisible)


def _add_camera(stage: Usd.Stage, cameras: Sequence[Camera], move: Move) -> None:
    """The camera of the video; USD's looks along -z with y up, its lengths are millimetres."""
    camera = UsdGeom.Camera.Define(stage, "/World/camera")
    flip = torch.diag(torch.tensor((1.0, -1.0, -1.0)))
    views = [move.turn @ c.world_to_camera[:3, :3].mT @ flip for c in cameras]
    places = [move.points(c.center) for c in cameras]
    _set(camera.AddTransformOp(), [_matrix(r, t) for r, t in zip(views, places, strict=True)])
    # lengths of the lens are in tenths of the scene's unit; only their ratios matter
    scale = [FILM / c.width for c in cameras]
    _set(camera.CreateFocalLengthAttr(), [float(c.K[0, 0]) * s for c, s in zip(cameras, scale)])
    camera.CreateHorizontalApertureAttr(FILM)
    heights = [c.height * s * float(c.K[0, 0] / c.K[1, 1]) for c, s in zip(cameras, scale)]
    _set(camera.CreateVerticalApertureAttr(), heights)
    right = [(c.width / 2 - float(c.K[0, 2])) * s for c, s in zip(cameras, scale)]
    _set(camera.CreateHorizontalApertureOffsetAttr(), right)
    up = [(float(c.K[1, 2]) - c.height / 2) * s for c, s in zip(cameras, scale)]
    _set(camera.CreateVerticalApertureOffsetAttr(), up)
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.05, 1000.0))
