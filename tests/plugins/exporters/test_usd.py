"""usd: OpenUSD's validators find nothing; Gaussians, skin, objects and camera come back."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hoigs.core.registry.registry import default_registry
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.exporters.posed import Move, body_motion, object_motion

WHY = "usd-core is not installed: hoigs[usd]"
Gf, Usd, UsdGeom, UsdSkel, UsdVol = (
    pytest.importorskip(f"pxr.{name}", reason=WHY)
    for name in ("Gf", "Usd", "UsdGeom", "UsdSkel", "UsdVol")
)


@pytest.fixture(scope="module")
def written(request_of, tmp_path_factory):
    request = request_of(end=2.0)
    folder = tmp_path_factory.mktemp("usd") / "out"
    usd = default_registry().get("exporter:usd")
    usd(usd.Config(textures=True, texture=64)).export(request, folder)
    return request, Usd.Stage.Open(str(folder / "scene.usd"))


def test_the_validators_find_nothing(written):
    validation = pytest.importorskip("pxr.UsdValidation", reason="usd-core lacks UsdValidation")
    registry = validation.ValidationRegistry()
    names = [m.name for m in registry.GetAllValidatorMetadata() if not m.isSuite]
    validators = [registry.GetOrLoadValidatorByName(name) for name in names]
    assert len(validators) > 10
    errors = validation.ValidationContext(validators).Validate(written[1])
    assert not errors, [(e.GetName(), e.GetMessage()) for e in errors][:5]


@pytest.mark.parametrize("frame", [0, 2])
def test_gaussians_draw_the_picture(frame, written, psnr_to_ours, upright):
    request, stage = written
    parts = []
    for name in request.entities:
        prim = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath(f"/World/splats/{name}"))
        degree = prim.GetRadianceSphericalHarmonicsDegreeAttr().Get()
        read = lambda attribute: torch.from_numpy(np.array(attribute.Get(frame)))  # noqa: E731
        quats = prim.GetOrientationsAttr().Get(frame)
        parts.append(
            Gaussians(
                read(prim.GetPositionsAttr()),
                torch.tensor([[q.GetReal(), *q.GetImaginary()] for q in quats]),
                read(prim.GetScalesAttr()).log(),
                read(prim.GetOpacitiesAttr()).logit(),
                read(prim.GetRadianceSphericalHarmonicsCoefficientsAttr()).reshape(
                    -1, (degree + 1) ** 2, 3
                ),
            )
        )
    move = np.float32(np.linalg.inv(upright(request, "y")))
    back = Move(torch.from_numpy(move[:3, :3]), torch.from_numpy(move[:3, 3]))
    assert psnr_to_ours(back.gaussians(Gaussians.cat(parts)), frame) > 60


def test_what_stands_still_has_no_samples(written):
    stage = written[1]
    scene, human = (stage.GetPrimAtPath(f"/World/splats/{n}") for n in ("scene", "human"))
    assert scene.GetAttribute("positions").GetNumTimeSamples() == 0
    assert human.GetAttribute("positions").GetNumTimeSamples() == 3
    assert stage.GetEndTimeCode() == 2 and UsdGeom.GetStageUpAxis(stage) == "Y"


def test_usdskel_poses_the_body(written, upright):
    request, stage = written
    root = UsdSkel.Root(stage.GetPrimAtPath("/World/people/human"))
    assert UsdSkel.BakeSkinning(root, Gf.Interval(0, 2))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/people/human/mesh"))
    motion = body_motion(request, "human")
    move = upright(request, "y")
    for frame in (0, 2):
        points = np.array(mesh.GetPointsAttr().Get(frame))
        away = np.linalg.norm(
            points - motion.vertices(frame).numpy() @ move[:3, :3].T - move[:3, 3], axis=1
        )
        assert away.mean() < 1e-3


def test_meshes_are_closed_and_textured(written):
    import trimesh

    stage = written[1]
    for path in ("/World/people/human/mesh", "/World/objects/object/mesh"):
        prim = UsdGeom.Mesh(stage.GetPrimAtPath(path))
        faces = np.array(prim.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        mesh = trimesh.Trimesh(np.array(prim.GetPointsAttr().Get()), faces, process=False)
        assert mesh.is_watertight and mesh.volume > 0
        assert np.allclose(prim.GetNormalsAttr().Get(), mesh.vertex_normals, atol=1e-3)
        st = UsdGeom.PrimvarsAPI(prim.GetPrim()).GetPrimvar("st")
        assert len(st.Get()) == 3 * len(faces) and st.GetInterpolation() == "faceVarying"
        shader = stage.GetPrimAtPath(f"{path}_material/texture")
        assert shader.GetAttribute("inputs:file").Get().resolvedPath.endswith(".png")


def test_objects_and_the_camera_move(written, upright):
    request, stage = written
    motion, turn = object_motion(request, "object"), upright(request, "y")
    for frame in (0, 2):
        cache = UsdGeom.XformCache(frame)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = motion.rotations[frame], motion.translations[frame]
        frame_prim = stage.GetPrimAtPath("/World/objects/object")
        read = np.array(cache.GetLocalToWorldTransform(frame_prim)).T
        assert np.allclose(read, turn @ pose, atol=1e-5)
        seen = UsdGeom.Camera(stage.GetPrimAtPath("/World/camera")).GetCamera(frame)
        camera = request.clip.cameras[frame]
        point = camera.unproject(torch.tensor([[20.0, 45.0]]), torch.tensor([2.0]))[0].numpy()
        clip_space = (turn @ np.append(point, 1)) @ np.array(
            seen.frustum.ComputeViewMatrix() * seen.frustum.ComputeProjectionMatrix()
        )
        x, y = clip_space[:2] / clip_space[3]
        assert np.allclose(((x + 1) * 32, (1 - y) * 32), (20, 45), atol=0.01)
