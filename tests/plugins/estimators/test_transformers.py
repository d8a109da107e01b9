"""estimator:transformers-depth and -pose with tiny models of random weights, loaded by the real
code.

Real weights were not at hand: what is tested is loading, that frames go in and come out at their
own size and place, kinds of depth, boxes, and keeping results.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from estimator_cases import FRAMES, HEIGHT, WIDTH, frame, request
from pydantic import ValidationError

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import COCO_17_LANDMARKS, EntityRequest, checked
from hoigs.core.registry.registry import default_registry
from hoigs.plugins.estimators.transformers.depth_anything import TransformersDepthEstimator
from hoigs.plugins.estimators.transformers.models import Detection, Detector, follow, overlap
from hoigs.plugins.estimators.transformers.sam2 import TransformersSam2Estimator
from hoigs.plugins.estimators.transformers.vitpose import TransformersPoseEstimator

transformers = pytest.importorskip("transformers", reason="the extra hoigs[estimators]")


def transformers_pose(**settings: Any) -> TransformersPoseEstimator:
    return TransformersPoseEstimator(TransformersPoseEstimator.Config(**settings))


def transformers_depth(**settings: Any) -> TransformersDepthEstimator:
    return TransformersDepthEstimator(TransformersDepthEstimator.Config(**settings))


pytestmark = pytest.mark.usefixtures("one_thread")


def test_depth_of_each_frame_at_the_videos_size(tmp_path, depth):
    video = request(tmp_path)
    estimator = transformers_depth(checkpoint=str(depth), device="cpu")
    maps = checked(estimator.estimate(video), video, estimator).depth
    assert maps.kind == "disparity"
    # the library's own pipeline of processor, model and post-processing
    model = transformers.DepthAnythingForDepthEstimation.from_pretrained(depth).eval()
    processor = transformers.AutoImageProcessor.from_pretrained(depth)
    with torch.inference_mode():
        inputs = processor(images=frame(3), return_tensors="pt")
        expected = processor.post_process_depth_estimation(
            model(**inputs), target_sizes=[(HEIGHT, WIDTH)]
        )[0]["predicted_depth"].numpy()
    np.testing.assert_allclose(maps.maps[3], expected, rtol=2e-3, atol=1e-4)
    assert np.ptp(maps.maps[3]) > 0 and not np.array_equal(maps.maps[3], maps.maps[0])


def test_depth_goes_on_where_it_was_cut_short(tmp_path, depth):
    asked = []

    def read(i):
        asked.append(i)
        if len(asked) == 3:
            raise KeyboardInterrupt
        return frame(i)

    video = request(tmp_path, read=read, wanted=(0, 1, 2, 4))
    with pytest.raises(KeyboardInterrupt):
        transformers_depth(checkpoint=str(depth)).estimate(video)
    maps = transformers_depth(checkpoint=str(depth)).estimate(video).depth.maps
    assert asked == [0, 1, 2, 2, 4]
    transformers_depth(checkpoint=str(depth)).estimate(video)
    assert len(asked) == 5 and maps[4].shape == (HEIGHT, WIDTH)


def test_metric_models_say_so_and_unknown_ones_are_asked_for(tmp_path, vitpose):
    from tiny_networks import depth_model

    metric = depth_model(tmp_path / "metric", depth_estimation_type="metric", max_depth=20)
    video = request(tmp_path)
    depth = transformers_depth(checkpoint="metric").estimate(video).depth
    assert depth.kind == "metric"
    assert np.nanmin(depth.maps[0]) > 0 and np.nanmax(depth.maps[0]) < 25  # bicubic
    assert transformers_depth(checkpoint=str(metric), kind="disparity").estimate(
        video
    ).depth.kind == ("disparity")
    with pytest.raises(HoigsError, match="whether vitpose gives metres or disparity is not known"):
        transformers_depth(checkpoint=str(vitpose)).estimate(video)
    with pytest.raises(HoigsError, match="cannot be loaded"):
        transformers_depth(checkpoint=str(vitpose), kind="metric").estimate(video)


def test_weights_that_are_absent_are_no_random_numbers(tmp_path, depth):
    """transformers fills gaps with random weights and a warning; here it is an error."""
    from safetensors.torch import load_file, save_file

    folder = tmp_path / "torn"
    folder.mkdir()
    for path in depth.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    weights = load_file(folder / "model.safetensors")
    weights.pop("head.conv3.weight")
    save_file(weights, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(HoigsError, match=r"lacks 1 weights of .*, such as head\.conv3\.weight"):
        transformers_depth(checkpoint="torn").estimate(request(tmp_path))


def test_pose_in_given_boxes(tmp_path, vitpose):
    boxes = np.array([[3.0 * i, 6, 3 * i + 12, 22] for i in range(FRAMES)])
    boxes[2] = np.nan
    np.save(tmp_path / "boxes.npy", boxes)
    video = request(tmp_path)
    estimator = transformers_pose(checkpoint=str(vitpose), boxes="boxes.npy", least=0.0)
    track = checked(estimator.estimate(video), video, estimator).landmarks["human"]
    assert track.world_xyzv is None and np.isnan(track.image_xyzv[2]).all()
    landmarks = sorted(COCO_17_LANDMARKS)
    x, y = track.image_xyzv[:, landmarks, 0], track.image_xyzv[:, landmarks, 1]
    assert np.isfinite(x[[0, 1, 3, 4]]).sum() > 17
    # ViTPose looks into the box, enlarged by a quarter and to 3:4, and finds points in there,
    # to the side of a cell of its 16x12 heat map
    for i in (0, 1, 3, 4):
        middle, height = boxes[i].reshape(2, 2).mean(0), 1.25 * 16 / 2
        assert np.nanmax(np.abs(y[i] - middle[1])) <= height + 3
        assert np.nanmax(np.abs(x[i] - middle[0])) <= height * 0.75 + 3
    # the library's own pipeline
    model = transformers.VitPoseForPoseEstimation.from_pretrained(vitpose).eval()
    processor = transformers.AutoImageProcessor.from_pretrained(vitpose)
    box = [[[9.0, 6.0, 12.0, 16.0]]]
    with torch.inference_mode():
        outputs = model(**processor(images=frame(3), boxes=box, return_tensors="pt"))
    expected = processor.post_process_pose_estimation(outputs, boxes=box)[0][0]["keypoints"]
    found = track.image_xyzv[3, list(COCO_17_LANDMARKS), :2]
    known = np.isfinite(found[:, 0])
    np.testing.assert_allclose(found[known], expected.numpy()[known], atol=1e-4)

    def refuse(i):
        raise AssertionError("estimated again")

    again = estimator.estimate(replace(video, read=refuse)).landmarks["human"]
    np.testing.assert_array_equal(again.image_xyzv, track.image_xyzv)


def test_pose_in_the_boxes_of_a_detector(tmp_path, vitpose, rtdetr):
    video = request(tmp_path, wanted=(0, 3))
    estimator = transformers_pose(
        checkpoint=str(vitpose), detector=str(rtdetr), threshold=0.0, least=0.0
    )
    track = checked(estimator.estimate(video), video, estimator).landmarks["human"]
    found = np.isfinite(track.image_xyzv[:, 0, 0])
    assert not found[[1, 2, 4]].any()
    assert found[[0, 3]].any()
    none = transformers_pose(checkpoint=str(vitpose), detector=str(rtdetr), threshold=1.0)
    assert np.isnan(none.estimate(video).landmarks["human"].image_xyzv).all()


def test_the_detector_finds_boxes_of_a_word_within_the_image(tmp_path, rtdetr):
    video = request(tmp_path)
    detector = Detector(str(rtdetr), video, "test", "cpu", 0.0)
    assert detector.label_of(EntityRequest("anna", "human")) == "person"
    assert detector.label_of(EntityRequest("ball", text="Sports Ball")) == "sports ball"
    with pytest.raises(HoigsError, match='has no label "sport ball"; did you mean "sports ball"'):
        detector.label_of(EntityRequest("sport ball"))
    found = [d for word in ("person", "sports ball") for d in detector.find(frame(0), word)]
    assert found
    for detection in found:
        x0, y0, x1, y1 = detection.box
        assert 0 <= x0 < x1 <= WIDTH and 0 <= y0 < y1 <= HEIGHT
    scores = [d.score for d in detector.find(frame(0), "person")]
    assert scores == sorted(scores, reverse=True)


def test_one_of_several_boxes_is_followed():
    assert overlap((0, 0, 2, 2), (1, 0, 3, 2)) == pytest.approx(1 / 3)
    assert overlap((0, 0, 1, 1), (1, 0, 2, 1)) == 0
    found = [Detection((0, 0, 10, 10), 0.9), Detection((50, 0, 60, 10), 0.8)]
    assert follow(found, None) == (0, 0, 10, 10)
    assert follow(found, (51, 0, 61, 10)) == (50, 0, 60, 10)
    assert follow([], (0, 0, 1, 1)) is None


def test_sam2_asks_a_detector_for_what_has_no_prompt(tmp_path, rtdetr):
    entities = (EntityRequest("anna", "human"), EntityRequest("ball", text="sports ball"))
    video = request(tmp_path, entities=entities)
    estimator = TransformersSam2Estimator(
        TransformersSam2Estimator.Config(checkpoint="none", detector=str(rtdetr), threshold=0.0)
    )
    prompted = estimator._prompted(video)
    assert [e.name for e in prompted] == ["anna", "ball"] and prompted[0].kind == "human"
    detector = Detector(str(rtdetr), video, "test", "cpu", 0.0)
    for entity, word in zip(prompted, ("person", "sports ball"), strict=True):
        best = {i: detector.find(frame(i), word)[0] for i in range(FRAMES)}
        surest = max(best, key=lambda i: best[i].score)
        assert (entity.frame, entity.box) == (surest, best[surest].box)
    sure = TransformersSam2Estimator(
        TransformersSam2Estimator.Config(checkpoint="none", detector=str(rtdetr), threshold=1.0)
    )
    with pytest.raises(HoigsError, match=r'finds no "anna" \(as person\), "ball" \(as sports ball'):
        sure._prompted(video)


def test_settings_of_pose(tmp_path, vitpose):
    config = default_registry().config_class("estimator:transformers-pose")
    with pytest.raises(ValidationError, match="give either `detector` or `boxes`"):
        config(checkpoint="x")
    with pytest.raises(ValidationError, match="either `detector` or `boxes`"):
        config(checkpoint="x", detector="y", boxes="z.npy")
    with pytest.raises(HoigsError, match=r"boxes\.npy: no such file"):
        transformers_pose(checkpoint=str(vitpose), boxes="boxes.npy").estimate(request(tmp_path))
    np.save(tmp_path / "boxes.npy", np.zeros((3, 4)))
    with pytest.raises(HoigsError, match="has 3 frames, the video has 5"):
        transformers_pose(checkpoint=str(vitpose), boxes="boxes.npy").estimate(request(tmp_path))
