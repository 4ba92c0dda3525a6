# SPDX-License-Identifier: Apache-2.0
"""Networks of the video world models at their published sizes.

Sizes are those of the `config.json` files on the hub; what is not said here is the default of the class. Most are in
diffusers' conversion scripts (`scripts/convert_{wan,ltx,cosmos,hunyuan_video}_to_diffusers.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from diffusers import (
    AutoencoderKLHunyuanVideo,
    AutoencoderKLLTXVideo,
    AutoencoderKLTemporalDecoder,
    AutoencoderKLWan,
    CosmosTransformer3DModel,
    EulerDiscreteScheduler,
    FlowMatchEulerDiscreteScheduler,
    HunyuanVideoTransformer3DModel,
    LTXVideoTransformer3DModel,
    UNetSpatioTemporalConditionModel,
    UniPCMultistepScheduler,
    WanTransformer3DModel,
)
from transformers import (
    CLIPTextConfig,
    CLIPTextModel,
    CLIPVisionConfig,
    CLIPVisionModel,
    CLIPVisionModelWithProjection,
    LlamaConfig,
    LlavaConfig,
    LlavaForConditionalGeneration,
    T5Config,
    T5EncoderModel,
    UMT5Config,
    UMT5EncoderModel,
)

Build = Callable[[], Any]


@dataclass(frozen=True)
class Published:
    """A pipeline: what makes each of its networks, by place, and its scheduler."""

    networks: Mapping[str, Build]
    scheduler: Build
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the world model that have no default."""

    @property
    def denoisers(self) -> list[str]:
        """Places of the networks that run at each step; of two experts, one does."""
        return [place for place in self.networks if place in ("unet", "transformer", "transformer_2")]


XXL = {
    "d_model": 4096,
    "d_kv": 64,
    "d_ff": 10240,
    "num_layers": 24,
    "num_heads": 64,
    "feed_forward_proj": "gated-gelu",
}
"""Sizes of T5 1.1 XXL and UMT5 XXL."""


def t5_xxl() -> Any:
    """Encoder of google/t5-v1_1-xxl."""
    return T5EncoderModel(T5Config(vocab_size=32128, **XXL))


def t5_11b() -> Any:
    """Encoder of google-t5/t5-11b."""
    return T5EncoderModel(
        T5Config(
            vocab_size=32128,
            d_model=1024,
            d_kv=128,
            d_ff=65536,
            num_layers=24,
            num_heads=128,
            feed_forward_proj="relu",
        )
    )


def umt5_xxl() -> Any:
    """Encoder of google/umt5-xxl."""
    return UMT5EncoderModel(UMT5Config(vocab_size=256384, **XXL))


def clip_vit_h(projected: bool) -> Any:
    """Vision half of laion/CLIP-ViT-H-14-laion2B-s32B-b79K."""
    config = CLIPVisionConfig(
        hidden_size=1280,
        intermediate_size=5120,
        projection_dim=1024,
        num_hidden_layers=32,
        num_attention_heads=16,
        image_size=224,
        patch_size=14,
        hidden_act="gelu",
    )
    return (CLIPVisionModelWithProjection if projected else CLIPVisionModel)(config)


def clip_vit_l_text() -> Any:
    """Text half of openai/clip-vit-large-patch14."""
    return CLIPTextModel(
        CLIPTextConfig(
            vocab_size=49408,
            hidden_size=768,
            intermediate_size=3072,
            projection_dim=768,
            num_hidden_layers=12,
            num_attention_heads=12,
            max_position_embeddings=77,
            bos_token_id=0,
            eos_token_id=2,
        )
    )


def llava_llama_3_8b() -> Any:
    """xtuner/llava-llama-3-8b-v1_1-transformers, with the special tokens of `tiny_pipelines`' tokenizer."""
    language = LlamaConfig(
        vocab_size=128320,
        hidden_size=4096,
        intermediate_size=14336,
        num_hidden_layers=32,
        num_attention_heads=32,
        num_key_value_heads=8,
        max_position_embeddings=8192,
        rms_norm_eps=1e-5,
        pad_token_id=1,
    )
    vision = CLIPVisionConfig(
        hidden_size=1024,
        intermediate_size=4096,
        projection_dim=768,
        num_hidden_layers=24,
        num_attention_heads=16,
        image_size=336,
        patch_size=14,
    )
    return LlavaForConditionalGeneration(
        LlavaConfig(
            vision_config=vision, text_config=language, image_token_index=2, image_seq_length=576, pad_token_id=1
        )
    )


def svd_vae() -> Any:
    return AutoencoderKLTemporalDecoder(
        down_block_types=("DownEncoderBlock2D",) * 4,
        block_out_channels=(128, 256, 512, 512),
        layers_per_block=2,
        latent_channels=4,
        sample_size=768,
        scaling_factor=0.18215,
        force_upcast=True,
    )


def svd_unet() -> Any:
    return UNetSpatioTemporalConditionModel(sample_size=96, num_frames=14)


def wan_transformer(**sizes: Any) -> Any:
    """14B of image to video unless the sizes say otherwise."""
    usual = {"num_attention_heads": 40, "num_layers": 40, "ffn_dim": 13824, "in_channels": 36, "out_channels": 16}
    return WanTransformer3DModel(attention_head_dim=128, text_dim=4096, **{**usual, **sizes})


def wan22_vae() -> Any:
    """VAE of the 5B model; statistics of latents are left at 0 and 1."""
    return AutoencoderKLWan(
        base_dim=160,
        decoder_base_dim=256,
        z_dim=48,
        in_channels=12,
        out_channels=12,
        is_residual=True,
        patch_size=2,
        scale_factor_spatial=16,
        scale_factor_temporal=4,
        latents_mean=[0.0] * 48,
        latents_std=[1.0] * 48,
    )


def cosmos_transformer() -> Any:
    return CosmosTransformer3DModel(
        in_channels=17,
        out_channels=16,
        num_attention_heads=16,
        attention_head_dim=128,
        num_layers=28,
        mlp_ratio=4.0,
        text_embed_dim=1024,
        adaln_lora_dim=256,
        rope_scale=(1.0, 3.0, 3.0),
        concat_padding_mask=True,
        extra_pos_embed_type=None,
    )


def hunyuan_transformer() -> Any:
    """Transformer of hunyuanvideo-community/HunyuanVideo-I2V, which replaces the first frame's tokens."""
    return HunyuanVideoTransformer3DModel(image_condition_type="token_replace", guidance_embeds=True)


def svd_scheduler() -> Any:
    return EulerDiscreteScheduler(
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        prediction_type="v_prediction",
        sigma_min=0.002,
        sigma_max=700.0,
        steps_offset=1,
        timestep_spacing="leading",
        timestep_type="continuous",
        use_karras_sigmas=True,
    )


def ltx_scheduler() -> Any:
    return FlowMatchEulerDiscreteScheduler(
        use_dynamic_shifting=True,
        base_shift=0.95,
        max_shift=2.05,
        base_image_seq_len=1024,
        max_image_seq_len=4096,
        shift_terminal=0.1,
    )


def wan_scheduler(shift: float) -> Any:
    return UniPCMultistepScheduler(prediction_type="flow_prediction", use_flow_sigmas=True, flow_shift=shift)


PUBLISHED: dict[str, Published] = {
    "svd": Published(
        {"unet": svd_unet, "image_encoder": partial(clip_vit_h, projected=True), "vae": svd_vae}, svd_scheduler
    ),
    "ltx": Published(
        {"transformer": LTXVideoTransformer3DModel, "text_encoder": t5_xxl, "vae": AutoencoderKLLTXVideo},
        ltx_scheduler,
    ),
    "cosmos-predict2": Published(
        {"transformer": cosmos_transformer, "text_encoder": t5_11b, "vae": AutoencoderKLWan},
        partial(FlowMatchEulerDiscreteScheduler, use_karras_sigmas=True),
        {"guardrail": False},
    ),
    "wan2.2-5b": Published(
        {
            "transformer": partial(
                wan_transformer, num_attention_heads=24, num_layers=30, ffn_dim=14336, in_channels=48, out_channels=48
            ),
            "text_encoder": umt5_xxl,
            "vae": wan22_vae,
        },
        partial(wan_scheduler, 5.0),
    ),
    "wan2.1": Published(
        {
            "transformer": partial(wan_transformer, image_dim=1280, added_kv_proj_dim=5120),
            "text_encoder": umt5_xxl,
            "image_encoder": partial(clip_vit_h, projected=False),
            "vae": AutoencoderKLWan,
        },
        partial(wan_scheduler, 3.0),
    ),
    "wan2.2-a14b": Published(
        {
            "transformer": wan_transformer,
            "transformer_2": wan_transformer,
            "text_encoder": umt5_xxl,
            "vae": AutoencoderKLWan,
        },
        partial(wan_scheduler, 3.0),
    ),
    "hunyuan": Published(
        {
            "transformer": hunyuan_transformer,
            "text_encoder": llava_llama_3_8b,
            "text_encoder_2": clip_vit_l_text,
            "vae": AutoencoderKLHunyuanVideo,
        },
        partial(FlowMatchEulerDiscreteScheduler, shift=7.0),
    ),
}
"""By world model, the cheap ones first."""
