"""Networks of transformers with the layouts of real ones, of tiny random weights, in folders."""

from __future__ import annotations

from pathlib import Path

import torch
import transformers
from estimator_cases import frame


def saved(model, processor, folder: Path, noise: float = 0.05, **biases: float) -> Path:
    """A model whose random weights are large enough to tell images apart, and its processor.

    `biases` sets those of the layers that have such a word in their name.
    """
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            parameter.add_(noise * torch.randn_like(parameter))
            for word, value in biases.items():
                if word in name and name.endswith("bias"):
                    parameter.fill_(value)
    model.save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder


def depth_model(folder: Path, **settings) -> Path:
    torch.manual_seed(0)
    backbone = transformers.Dinov2Config(
        image_size=28, patch_size=14, hidden_size=16, num_hidden_layers=4, num_attention_heads=2,
        out_indices=[1, 2, 3, 4], reshape_hidden_states=False, apply_layernorm=True,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8, head_hidden_size=8, **settings,
    )  # fmt: skip
    processor = transformers.DPTImageProcessorPil(
        size={"height": 28, "width": 28}, keep_aspect_ratio=True, ensure_multiple_of=14
    )
    model = transformers.DepthAnythingForDepthEstimation(config)
    return saved(model, processor, folder, 0.3, conv3=1.0)


def vitpose_model(folder: Path) -> Path:
    torch.manual_seed(0)
    backbone = transformers.VitPoseBackboneConfig(
        image_size=[64, 48], hidden_size=16, num_hidden_layers=1, num_attention_heads=2,
        out_indices=[1],
    )  # fmt: skip
    config = transformers.VitPoseConfig(backbone_config=backbone, num_labels=17)
    processor = transformers.VitPoseImageProcessorPil(size={"height": 64, "width": 48})
    model = transformers.VitPoseForPoseEstimation(config)
    return saved(model, processor, folder)


def rtdetr_model(folder: Path) -> Path:
    torch.manual_seed(0)
    backbone = transformers.RTDetrResNetConfig(
        embedding_size=8, hidden_sizes=[8, 8, 8, 8], depths=[1, 1, 1, 1],
        out_features=["stage2", "stage3", "stage4"], layer_type="basic",
    )  # fmt: skip
    config = transformers.RTDetrConfig(
        backbone_config=backbone, encoder_hidden_dim=16, encoder_in_channels=[8, 8, 8],
        encoder_ffn_dim=16, encoder_attention_heads=2, d_model=16, num_queries=12,
        decoder_in_channels=[16, 16, 16], decoder_ffn_dim=16, decoder_layers=1,
        decoder_attention_heads=2, num_denoising=0, id2label={0: "person", 1: "sports ball"},
        label2id={"person": 0, "sports ball": 1},
    )  # fmt: skip
    processor = transformers.RTDetrImageProcessorPil(size={"height": 64, "width": 64})
    model = transformers.RTDetrForObjectDetection(config)
    saved(model, processor, folder, 0.3)
    with torch.no_grad():  # as likely to see a person as a ball
        logits = model.eval()(**processor(images=frame(0), return_tensors="pt")).logits[0]
        model.model.decoder.class_embed[-1].bias -= logits.mean(0) + 1
    model.save_pretrained(folder)
    return folder


def sam2_model(folder: Path) -> Path:
    """A SAM 2 for 128x128 images, of some hundred thousand random weights."""
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=12, image_size=[128, 128], embed_dim_per_stage=[12, 24, 48, 96],
        num_attention_heads_per_stage=[1, 2, 4, 8], blocks_per_stage=[1, 2, 2, 1],
        window_positional_embedding_background_size=[4, 4], global_attention_blocks=[4],
        window_size_per_stage=[8, 4, 8, 4],
    )  # fmt: skip
    vision = transformers.Sam2VisionConfig(
        backbone_config=backbone, backbone_channel_list=[96, 48, 24, 12], fpn_hidden_size=128,
        backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]],
    )  # fmt: skip
    prompts = transformers.Sam2VideoPromptEncoderConfig(
        hidden_size=128, image_size=128, patch_size=16, mask_input_channels=8
    )
    decoder = transformers.Sam2VideoMaskDecoderConfig(
        hidden_size=128, mlp_dim=32, num_attention_heads=2, iou_head_hidden_dim=16
    )
    config = transformers.Sam2VideoConfig(
        vision_config=vision.to_dict(), prompt_encoder_config=prompts.to_dict(),
        mask_decoder_config=decoder.to_dict(), image_size=128, memory_attention_hidden_size=128,
        memory_attention_num_layers=1, memory_attention_feed_forward_hidden_size=32,
        memory_attention_rope_feat_sizes=[8, 8], memory_encoder_hidden_size=128,
        memory_encoder_output_channels=64, mask_downsampler_embed_dim=128,
        memory_fuser_embed_dim=128, memory_fuser_intermediate_dim=32, memory_fuser_num_layers=1,
        num_maskmem=3, max_object_pointers_in_encoder=3,
    )  # fmt: skip
    torch.manual_seed(0)
    model = transformers.Sam2VideoModel(config)
    with torch.no_grad():  # as it starts, every mask is the same everywhere
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
        model.mask_decoder.pred_obj_score_head.proj_out.bias.fill_(5.0)  # sure that it is there
    model.save_pretrained(folder)
    return folder
