"""estimator:transformers-sam2 with a tiny SAM 2 of random weights, loaded by the real code.

Real weights were not at hand: what is tested is that frames, prompts and masks go the right way,
against the library's own propagation over the whole video in memory.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from estimator_cases import ENTITIES, FRAMES, HEIGHT, WIDTH, frame, request
from pydantic import ValidationError

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.estimator import EntityRequest, PromptPoint, checked
from hoigs.core.registry.registry import default_registry
from hoigs.plugins.estimators.transformers.sam2 import (
    MEAN,
    STD,
    TransformersSam2Estimator,
    _Tracker,
)

transformers = pytest.importorskip("transformers", reason="the extra hoigs[estimators]")

PROMPTED = (
    EntityRequest("human", "human", box=(2.0, 4.0, 20.0, 20.0), frame=2),
    EntityRequest(
        "object", points=(PromptPoint(25, 10), PromptPoint(3, 20, inside=False)), frame=2
    ),
)


pytestmark = pytest.mark.usefixtures("one_thread")


def transformers_sam2(**settings: Any) -> TransformersSam2Estimator:
    return TransformersSam2Estimator(TransformersSam2Estimator.Config(**settings))


def in_memory(sam2: Path, entities, images: list[np.ndarray], start: int, reverse: bool):
    """The masks of transformers itself, whose session holds the whole video."""
    model = transformers.Sam2VideoModel.from_pretrained(sam2).eval()
    rgb = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).float() / 255
    rgb = torch.nn.functional.interpolate(rgb, (128, 128), mode="bilinear", antialias=True)
    mean, std = torch.tensor(MEAN).view(1, 3, 1, 1), torch.tensor(STD).view(1, 3, 1, 1)
    session = transformers.Sam2VideoInferenceSession(
        (rgb - mean) / std, HEIGHT, WIDTH, dtype=torch.float32
    )
    # as transformers' processor arranges prompts
    for k, entity in enumerate(entities):
        points = [[p.x, p.y] for p in entity.points]
        labels = [int(p.inside) for p in entity.points]
        if entity.box:
            points, labels = [[*entity.box[:2]], [*entity.box[2:]]], [2, 3]
        coordinates = torch.tensor(points) * torch.tensor([128 / WIDTH, 128 / HEIGHT])
        inputs = {
            "point_coords": coordinates[None, None],
            "point_labels": torch.tensor(labels, dtype=torch.int32)[None, None],
        }
        session.add_point_inputs(session.obj_id_to_idx(k + 1), start, inputs)
    session.obj_with_new_inputs = [k + 1 for k in range(len(entities))]
    with torch.inference_mode():
        model(inference_session=session, frame_idx=start)
        found = {}
        for output in model.propagate_in_video_iterator(
            session, start_frame_idx=start, reverse=reverse
        ):
            masks = torch.nn.functional.interpolate(
                output.pred_masks, (HEIGHT, WIDTH), mode="bilinear", align_corners=False
            )
            found[output.frame_idx] = (masks[:, 0] > 0).numpy()
    return found


def test_masks_are_those_of_transformers_own_propagation(tmp_path, sam2):
    video = request(tmp_path, entities=PROMPTED)
    estimator = transformers_sam2(checkpoint=str(sam2), device="cpu")
    masks = checked(estimator.estimate(video), video, estimator).masks.entities
    images = [frame(i) for i in range(FRAMES)]
    expected = in_memory(sam2, PROMPTED, images, 2, reverse=False)
    assert set(expected) == {2, 3, 4}
    for i, both in expected.items():
        for k, name in enumerate(("human", "object")):
            assert np.array_equal(masks[name][i], both[k]), (name, i)
    # backwards is forwards through the frames in the other order
    turned = in_memory(sam2, PROMPTED, images[2::-1], 0, reverse=False)
    for step, both in turned.items():
        for k, name in enumerate(("human", "object")):
            assert np.array_equal(masks[name][2 - step], both[k]), (name, step)
    shares = [masks[name][i].mean() for name in masks for i in range(FRAMES)]
    assert min(shares) > 0 and max(shares) < 1 and len(set(shares)) > 5  # it is no blank


def test_what_the_model_no_longer_looks_at_is_forgotten(tmp_path, sam2):
    video = request(tmp_path, frames=12, read=lambda i: frame(i % FRAMES))
    model = transformers.Sam2VideoModel.from_pretrained(sam2).eval()
    tracker, sessions = _Tracker(model, video), []
    step = tracker._step
    tracker._step = lambda session, *rest: sessions.append(session) or step(session, *rest)
    entities = [replace(PROMPTED[0], frame=0)]
    followed = {i: masks[0].numpy() for i, masks in tracker.follow(entities, range(12))}
    assert not sessions[0].processed_frames
    kept = sessions[0].output_dict_per_obj[0]["non_cond_frame_outputs"]
    assert len(kept) <= tracker.reach < 11
    whole = in_memory(sam2, entities, [frame(i % FRAMES) for i in range(12)], 0, False)
    for i in range(12):
        assert np.array_equal(followed[i], whole[i][0]), i


def test_masks_are_kept_and_a_run_that_was_cut_short_is_done_again(tmp_path, sam2):
    video = request(tmp_path, entities=PROMPTED[:1])
    estimator = transformers_sam2(checkpoint=str(sam2))
    first = estimator.estimate(video).masks.entities["human"][3]

    def refuse(i):
        raise AssertionError("estimated again")

    blind = replace(video, read=refuse)
    assert np.array_equal(estimator.estimate(blind).masks.entities["human"][3], first)
    next((tmp_path / "work").glob("transformers-sam2-*/done")).unlink()
    with pytest.raises(AssertionError, match="estimated again"):
        estimator.estimate(blind)
    moved = {"human": {"frame": 1, "box": PROMPTED[0].box}}
    with pytest.raises(AssertionError, match="estimated again"):
        transformers_sam2(checkpoint=str(sam2), prompts=moved).estimate(blind)


def test_prompts_from_a_spec_and_what_is_wrong_with_them(tmp_path, sam2):
    registry = default_registry()
    key, config = (
        "estimator:transformers-sam2",
        registry.config_class("estimator:transformers-sam2"),
    )

    def build(**settings):
        values = config.model_validate({"checkpoint": str(sam2)} | settings)
        return registry.get(key).from_config(values, BuildContext())

    video = request(tmp_path)
    box, points = {"box": [2, 4, 20, 20], "frame": 2}, {"points": [[25, 10]], "outside": [[3, 20]]}
    estimator = build(prompts={"human": box, "object": points | {"frame": 2}})
    human, thing = estimator._prompted(video)
    assert human.box == PROMPTED[0].box and thing.points == PROMPTED[1].points
    assert set(estimator.estimate(video).masks.entities) == {"human", "object"}
    with pytest.raises(HoigsError, match='give a point or a box for "object" in `prompts`'):
        build(prompts={"human": box}).estimate(video)
    with pytest.raises(HoigsError, match='"humen" is not requested; did you mean "human"'):
        build(prompts={"humen": box}).estimate(video)
    with pytest.raises(HoigsError, match="in frame 99; the video has 5"):
        build(prompts={"human": box | {"frame": 99}, "object": points}).estimate(video)
    with pytest.raises(ValidationError, match="give `points` on it, or its `box`"):
        build(prompts={"human": {"frame": 1}})


def test_a_checkpoint_of_something_else_is_refused(tmp_path, sam2):
    video = request(tmp_path, entities=PROMPTED)
    with pytest.raises(HoigsError, match=r"no such file or folder.*a name on the hub"):
        transformers_sam2(checkpoint="weights").estimate(video)
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(HoigsError, match=r"lacks \['config.json', '\*.safetensors"):
        transformers_sam2(checkpoint="empty").estimate(video)
    clip = tmp_path / "clip"
    tiny = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1}
    vision = transformers.CLIPVisionConfig(
        image_size=16, patch_size=8, num_attention_heads=2, **tiny
    )
    transformers.CLIPVisionModel(vision).save_pretrained(clip)
    with pytest.raises(HoigsError, match="clip"):
        transformers_sam2(checkpoint="clip").estimate(video)
    assert ENTITIES[0].box is None  # the request's own entities have no prompt
