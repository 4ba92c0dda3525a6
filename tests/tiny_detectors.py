# SPDX-License-Identifier: Apache-2.0
"""Detectors and segmenters of transformers: the real classes with a few random weights, saved as a user's would be."""

from __future__ import annotations

import string
from pathlib import Path
from typing import Any

import torch
import transformers

SIDE = 64
"""Of SAM 2's square images."""


def save_owl(folder: Path, kind: str) -> Path:
    """OWL-ViT ("OwlViT") or OWLv2 ("Owlv2") with a tokenizer of letters."""
    torch.manual_seed(0)
    sizes = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    letters = [*string.ascii_lowercase, *(f"{letter}</w>" for letter in string.ascii_lowercase)]
    vocabulary = {piece: i for i, piece in enumerate([*letters, "<|startoftext|>", "<|endoftext|>"])}
    config = getattr(transformers, f"{kind}Config")(
        text_config={**sizes, "vocab_size": len(vocabulary), "eos_token_id": len(vocabulary) - 1},
        vision_config={**sizes, "image_size": 32, "patch_size": 8},
        projection_dim=16,
    )
    getattr(transformers, f"{kind}ForObjectDetection")(config).save_pretrained(folder)
    size = {"height": 32, "width": 32}
    getattr(transformers, f"{kind}ImageProcessorPil")(size=size).save_pretrained(folder)
    transformers.CLIPTokenizerFast(vocab=vocabulary, merges=[]).save_pretrained(folder)
    return folder


def save_grounding_dino(folder: Path) -> Path:
    """Grounding DINO with BERT's ids of the special tokens, which its attention masks are made by."""
    torch.manual_seed(0)
    backbone = transformers.SwinConfig(
        image_size=128,
        embed_dim=8,
        depths=[1, 1, 1, 1],
        num_heads=[1, 1, 1, 1],
        window_size=2,
        out_features=["stage2", "stage3", "stage4"],
    )
    text = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    config = transformers.GroundingDinoConfig(
        backbone_config=backbone,
        text_config={"model_type": "bert", "vocab_size": 1030, **text},
        max_text_len=16,
        num_queries=6,
        d_model=32,
        encoder_layers=1,
        encoder_ffn_dim=16,
        encoder_attention_heads=2,
        decoder_layers=2,
        decoder_ffn_dim=16,
        decoder_attention_heads=2,
    )
    transformers.GroundingDinoForObjectDetection(config).save_pretrained(folder)
    size = {"shortest_edge": 128, "longest_edge": 128}
    transformers.GroundingDinoImageProcessorPil(size=size).save_pretrained(folder)
    vocabulary = [f"[unused{i}]" for i in range(1030)]
    for first, pieces in (
        (0, ["[PAD]"]),
        (100, ["[UNK]", "[CLS]", "[SEP]", "[MASK]"]),
        (200, [*string.ascii_lowercase]),
        (300, [f"##{letter}" for letter in string.ascii_lowercase]),
        (1012, ["."]),
    ):
        vocabulary[first : first + len(pieces)] = pieces
    transformers.BertTokenizerFast(vocab={piece: i for i, piece in enumerate(vocabulary)}).save_pretrained(folder)
    return folder


def save_sam2(folder: Path, video: bool) -> Path:
    """SAM 2 of about a million numbers, as the network of single images or of videos."""
    torch.manual_seed(0)
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=8,
        num_attention_heads=1,
        blocks_per_stage=[1, 2, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 2, 4, 8],
        global_attention_blocks=[4],
        window_size_per_stage=[8, 4, 4, 2],
        image_size=[SIDE, SIDE],
        window_positional_embedding_background_size=[4, 4],
    )
    parts: dict[str, Any] = {
        "vision_config": transformers.Sam2VisionConfig(
            backbone_config=backbone,
            backbone_channel_list=[64, 32, 16, 8],
            backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]],
            fpn_hidden_size=128,
            image_size=SIDE,
        ),
        "prompt_encoder_config": {"hidden_size": 128, "image_size": SIDE},
        "mask_decoder_config": {
            "hidden_size": 128,
            "mlp_dim": 32,
            "num_attention_heads": 2,
            "iou_head_hidden_dim": 32,
        },
    }
    if not video:
        transformers.Sam2Model(transformers.Sam2Config(**parts)).save_pretrained(folder)
        return folder
    config = transformers.Sam2VideoConfig(
        **parts,
        image_size=SIDE,
        memory_attention_hidden_size=128,
        memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=32,
        memory_attention_rope_feat_sizes=[4, 4],
        memory_encoder_hidden_size=128,
        memory_encoder_output_channels=64,
        mask_downsampler_embed_dim=128,
        memory_fuser_embed_dim=128,
        memory_fuser_intermediate_dim=32,
    )
    transformers.Sam2VideoModel(config).save_pretrained(folder)
    return folder
