# SPDX-License-Identifier: Apache-2.0
"""Pipelines of diffusers with the real classes and a few thousand random weights, saved as a user's would be.

Tokenizers are built here too, since nothing may be fetched: letters and digits one by one.
"""

from __future__ import annotations

import string
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from diffusers import (
    AutoencoderKLHunyuanVideo,
    AutoencoderKLLTX2Video,
    AutoencoderKLLTXVideo,
    AutoencoderKLTemporalDecoder,
    AutoencoderKLWan,
    Cosmos2VideoToWorldPipeline,
    CosmosTransformer3DModel,
    EulerDiscreteScheduler,
    FlowMatchEulerDiscreteScheduler,
    HunyuanVideoImageToVideoPipeline,
    HunyuanVideoTransformer3DModel,
    LTXImageToVideoPipeline,
    LTXVideoTransformer3DModel,
    SanaWMPipeline,
    SanaWMTransformer3DModel,
    StableVideoDiffusionPipeline,
    UNetSpatioTemporalConditionModel,
    UniPCMultistepScheduler,
    WanImageToVideoPipeline,
    WanTransformer3DModel,
)
from tokenizers import Tokenizer, models, pre_tokenizers
from transformers import (
    CLIPImageProcessor,
    CLIPTextConfig,
    CLIPTextModel,
    CLIPTokenizerFast,
    CLIPVisionConfig,
    CLIPVisionModel,
    CLIPVisionModelWithProjection,
    Gemma2Config,
    Gemma2ForCausalLM,
    LlamaConfig,
    LlavaConfig,
    LlavaForConditionalGeneration,
    PreTrainedTokenizerFast,
    T5Config,
    T5EncoderModel,
    T5TokenizerFast,
    UMT5Config,
    UMT5EncoderModel,
)

from tiny_nwm import TinyNWM

PIECES = ["<pad>", "</s>", "<unk>", "▁", *string.ascii_letters, *string.digits, *string.punctuation]
OPTIONS: dict[str, dict[str, Any]] = {
    "svd": {"size": (64, 64), "frames": 5, "steps": 1},
    "ltx": {"size": (32, 32), "frames": 9, "steps": 1},
    "hunyuan": {"size": (32, 32), "frames": 5, "steps": 1, "guidance": 1.0},
    "wan2.1": {"size": (32, 32), "frames": 5, "steps": 1},
    "wan2.2-5b": {"size": (32, 32), "frames": 5, "steps": 1},
    "wan2.2-a14b": {"size": (32, 32), "frames": 5, "steps": 2},
    "cosmos-predict2": {"size": (32, 32), "frames": 5, "steps": 1, "guardrail": False},
    "sana-wm": {"size": (64, 64), "frames": 9, "steps": 1},
    "nwm": {"steps": 2, "batch": 1},
    "svd-action": {"size": (64, 128), "frames": 3, "steps": 1},
    "ltx-action": {"size": (64, 128), "frames": 9, "steps": 1},
    "wan2.1-action": {"size": (32, 64), "frames": 5, "steps": 1},
    "wan2.2-5b-action": {"size": (32, 64), "frames": 5, "steps": 1},
    "wan2.2-a14b-action": {"size": (32, 64), "frames": 5, "steps": 2},
    "cosmos-predict2-action": {"size": (32, 64), "frames": 5, "steps": 1, "guardrail": False},
}
"""What makes a rollout of each cheap; `weights` is the folder that `save` has written."""


def save(name: str, folder: Path) -> Path:
    """Builds the tiny pipeline of a world model and saves it; the same weights each time."""
    torch.manual_seed(0)
    pipeline = BUILDERS[name.removesuffix("-action")]()
    pipeline.save_pretrained(folder)
    if name.endswith("-action"):
        import tiny_actions

        tiny_actions.save(name, pipeline, folder / "trained")
    return folder


def checkpoint(name: str, folder: Path, kind: str) -> str:
    """Of a model in `folder`: the one that `save` has made, or for poses another."""
    if kind == "discrete":
        return str(folder / "trained")
    import tiny_actions

    poses = folder / "poses"
    if not poses.exists():
        torch.manual_seed(0)
        box = {"low": (-0.3, -0.5, 0.6), "high": (0.7, 0.5, 1.6)}
        tiny_actions.save(name, BUILDERS[name.removesuffix("-action")](), poses, kind=kind, **box)
    return str(poses)


def _t5_tokenizer() -> Any:
    return T5TokenizerFast(vocab=[(piece, -float(i)) for i, piece in enumerate(PIECES)], extra_ids=10)


def _t5() -> Any:
    return T5EncoderModel(
        T5Config(d_model=32, d_kv=8, d_ff=37, num_layers=2, num_heads=4, vocab_size=len(PIECES) + 20)
    ).eval()


def _umt5() -> Any:
    return UMT5EncoderModel(
        UMT5Config(d_model=32, d_kv=8, d_ff=37, num_layers=2, num_heads=4, vocab_size=len(PIECES) + 20)
    ).eval()


def _words_tokenizer(special: list[str], **names: str) -> Any:
    """One token a word, all words alike but the special ones."""
    vocabulary = {word: index for index, word in enumerate(["<unk>", "<pad>", *special])}
    tokenizer = Tokenizer(models.WordLevel(vocabulary, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    fast = PreTrainedTokenizerFast(tokenizer_object=tokenizer, unk_token="<unk>", pad_token="<pad>", **names)
    fast.add_special_tokens({"additional_special_tokens": special})
    return fast


def _vision(projected: bool, image: int, patch: int) -> Any:
    config = CLIPVisionConfig(
        hidden_size=32,
        projection_dim=32,
        intermediate_size=37,
        num_hidden_layers=2,
        num_attention_heads=4,
        image_size=image,
        patch_size=patch,
    )
    return (CLIPVisionModelWithProjection if projected else CLIPVisionModel)(config).eval()


def _image_processor(size: int) -> Any:
    return CLIPImageProcessor(size=size, crop_size={"height": size, "width": size})


def svd() -> Any:
    unet = UNetSpatioTemporalConditionModel(
        sample_size=8,
        block_out_channels=(32, 64),
        down_block_types=("CrossAttnDownBlockSpatioTemporal", "DownBlockSpatioTemporal"),
        up_block_types=("UpBlockSpatioTemporal", "CrossAttnUpBlockSpatioTemporal"),
        addition_time_embed_dim=32,
        projection_class_embeddings_input_dim=96,
        layers_per_block=1,
        cross_attention_dim=32,
        num_attention_heads=4,
        num_frames=5,
    )
    vae = AutoencoderKLTemporalDecoder(
        block_out_channels=(32, 32, 32, 32), down_block_types=("DownEncoderBlock2D",) * 4, latent_channels=4
    )
    scheduler = EulerDiscreteScheduler(
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        interpolation_type="linear",
        prediction_type="v_prediction",
        sigma_min=0.002,
        sigma_max=700.0,
        timestep_spacing="leading",
        timestep_type="continuous",
        use_karras_sigmas=True,
    )
    return StableVideoDiffusionPipeline(vae, _vision(True, 224, 32), unet, scheduler, _image_processor(224))


def ltx(timestep_conditioning: bool = False) -> Any:
    transformer = LTXVideoTransformer3DModel(
        in_channels=8,
        out_channels=8,
        num_attention_heads=4,
        attention_head_dim=8,
        cross_attention_dim=32,
        num_layers=2,
        caption_channels=32,
    )
    vae = AutoencoderKLLTXVideo(
        latent_channels=8,
        block_out_channels=(8, 8, 8, 8),
        decoder_block_out_channels=(8, 8, 8, 8),
        layers_per_block=(1, 1, 1, 1, 1),
        decoder_layers_per_block=(1, 1, 1, 1, 1),
        spatio_temporal_scaling=(True, True, True, False),
        decoder_spatio_temporal_scaling=(True, True, True, False),
        decoder_inject_noise=(False,) * 5,
        upsample_residual=(False,) * 4,
        upsample_factor=(1,) * 4,
        patch_size=4,
        patch_size_t=1,
        timestep_conditioning=timestep_conditioning,
    )
    return LTXImageToVideoPipeline(FlowMatchEulerDiscreteScheduler(), vae, _t5(), _t5_tokenizer(), transformer)


def _wan_vae() -> Any:
    return AutoencoderKLWan(
        base_dim=3, z_dim=16, dim_mult=[1, 1, 1, 1], num_res_blocks=1, temperal_downsample=[False, True, True]
    )


def _wan_transformer(channels: int, latent: int, image: int | None = None) -> Any:
    return WanTransformer3DModel(
        patch_size=(1, 2, 2),
        num_attention_heads=2,
        attention_head_dim=12,
        in_channels=channels,
        out_channels=latent,
        text_dim=32,
        freq_dim=256,
        ffn_dim=32,
        num_layers=2,
        cross_attn_norm=True,
        qk_norm="rms_norm_across_heads",
        rope_max_seq_len=32,
        image_dim=image,
    )


def _wan(**parts: Any) -> Any:
    scheduler = UniPCMultistepScheduler(prediction_type="flow_prediction", use_flow_sigmas=True, flow_shift=3.0)
    default = {"image_encoder": None, "image_processor": None, "transformer_2": None, "vae": _wan_vae()}
    return WanImageToVideoPipeline(
        tokenizer=_t5_tokenizer(), text_encoder=_umt5(), scheduler=scheduler, **{**default, **parts}
    )


def wan21() -> Any:
    return _wan(
        transformer=_wan_transformer(36, 16, 32),
        image_encoder=_vision(False, 224, 32),
        image_processor=_image_processor(224),
    )


def wan22_5b() -> Any:
    vae = AutoencoderKLWan(
        base_dim=3,
        z_dim=48,
        in_channels=12,
        out_channels=12,
        is_residual=True,
        patch_size=2,
        latents_mean=[0.0] * 48,
        latents_std=[1.0] * 48,
        dim_mult=[1, 1, 1, 1],
        num_res_blocks=1,
        scale_factor_spatial=16,
        scale_factor_temporal=4,
        temperal_downsample=[False, True, True],
    )
    return _wan(transformer=_wan_transformer(48, 48), vae=vae, expand_timesteps=True)


def wan22_a14b() -> Any:
    return _wan(transformer=_wan_transformer(36, 16), transformer_2=_wan_transformer(36, 16), boundary_ratio=0.9)


def cosmos() -> Any:
    from wiw.world_models.video.cosmos import make_empty_filter

    transformer = CosmosTransformer3DModel(
        in_channels=17,
        out_channels=16,
        num_attention_heads=2,
        attention_head_dim=16,
        num_layers=2,
        mlp_ratio=2,
        text_embed_dim=32,
        adaln_lora_dim=4,
        max_size=(4, 32, 32),
        patch_size=(1, 2, 2),
        rope_scale=(2.0, 1.0, 1.0),
        concat_padding_mask=True,
        extra_pos_embed_type="learnable",
    )
    scheduler = FlowMatchEulerDiscreteScheduler(use_karras_sigmas=True)
    scheduler.register_to_config(sigma_max=80.0, sigma_min=0.002, sigma_data=1.0, final_sigmas_type="sigma_min")
    return Cosmos2VideoToWorldPipeline(_t5(), _t5_tokenizer(), transformer, _wan_vae(), scheduler, make_empty_filter())


def hunyuan(condition: str = "latent_concat") -> Any:
    transformer = HunyuanVideoTransformer3DModel(
        in_channels=9 if condition == "latent_concat" else 4,
        out_channels=4,
        num_attention_heads=2,
        attention_head_dim=10,
        num_layers=1,
        num_single_layers=1,
        num_refiner_layers=1,
        patch_size=1,
        patch_size_t=1,
        guidance_embeds=condition != "latent_concat",
        text_embed_dim=16,
        pooled_projection_dim=8,
        rope_axes_dim=(2, 4, 4),
        image_condition_type=condition,
    )
    vae = AutoencoderKLHunyuanVideo(
        latent_channels=4,
        down_block_types=("HunyuanVideoDownBlock3D",) * 4,
        up_block_types=("HunyuanVideoUpBlock3D",) * 4,
        block_out_channels=(8, 8, 8, 8),
        layers_per_block=1,
        norm_num_groups=4,
    )
    special = ["<image>", "<|start_header_id|>", "<|end_header_id|>", "<|eot_id|>"]
    tokenizer = _words_tokenizer(special)
    language = LlamaConfig(
        vocab_size=len(tokenizer),
        hidden_size=16,
        intermediate_size=37,
        num_hidden_layers=4,
        num_attention_heads=4,
        pad_token_id=tokenizer.pad_token_id,
    )
    vision = _vision(False, 336, 14).config
    image_token = tokenizer.convert_tokens_to_ids("<image>")
    text = LlavaForConditionalGeneration(
        LlavaConfig(
            vision_config=vision,
            text_config=language,
            image_token_index=image_token,
            image_seq_length=576,
            pad_token_id=tokenizer.pad_token_id,
        )
    ).eval()
    pooled = CLIPTextModel(
        CLIPTextConfig(
            vocab_size=200,
            hidden_size=8,
            intermediate_size=37,
            num_hidden_layers=2,
            num_attention_heads=4,
            projection_dim=32,
            bos_token_id=0,
            eos_token_id=2,
        )
    ).eval()
    return HunyuanVideoImageToVideoPipeline(
        text_encoder=text,
        tokenizer=tokenizer,
        transformer=transformer,
        vae=vae,
        scheduler=FlowMatchEulerDiscreteScheduler(shift=7.0),
        text_encoder_2=pooled,
        tokenizer_2=_clip_tokenizer(),
        image_processor=_image_processor(336),
    )


def _clip_tokenizer() -> Any:
    letters = [*string.ascii_lowercase, *string.digits, *string.punctuation]
    pieces = ["<|startoftext|>", "<unk>", "<|endoftext|>", *letters, *(f"{letter}</w>" for letter in letters)]
    return CLIPTokenizerFast(vocab={piece: i for i, piece in enumerate(pieces)}, merges=[], model_max_length=77)


def sana_wm() -> Any:
    transformer = SanaWMTransformer3DModel(
        in_channels=8,
        num_layers=2,
        hidden_size=32,
        num_attention_heads=2,
        softmax_every_n=2,
        linear_head_dim=16,
        chunk_plucker_post_attn_blocks=2,
        caption_channels=16,
        mlp_ratio=2.0,
    )
    vae = AutoencoderKLLTX2Video(
        latent_channels=8,
        block_out_channels=(8, 8, 8, 8),
        decoder_block_out_channels=(8, 16, 32),
        layers_per_block=(1, 1, 1, 1, 1),
        decoder_layers_per_block=(1, 1, 1, 1),
        spatial_compression_ratio=32,
        temporal_compression_ratio=8,
    )
    tokenizer = _words_tokenizer(["<bos>", "<eos>"], bos_token="<bos>", eos_token="<eos>")
    text = Gemma2ForCausalLM(
        Gemma2Config(
            vocab_size=len(tokenizer),
            hidden_size=16,
            intermediate_size=37,
            num_hidden_layers=2,
            num_attention_heads=2,
            num_key_value_heads=2,
            head_dim=8,
        )
    ).eval()
    return SanaWMPipeline(tokenizer, text, vae, transformer, FlowMatchEulerDiscreteScheduler())


BUILDERS: dict[str, Callable[[], Any]] = {
    "svd": svd,
    "ltx": ltx,
    "hunyuan": hunyuan,
    "wan2.1": wan21,
    "wan2.2-5b": wan22_5b,
    "wan2.2-a14b": wan22_a14b,
    "cosmos-predict2": cosmos,
    "sana-wm": sana_wm,
    "nwm": TinyNWM,
}
