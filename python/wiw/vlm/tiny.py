# SPDX-License-Identifier: Apache-2.0
"""A vision-language model with random weights, built in a second: nonsense through the real classes."""

from __future__ import annotations

from pathlib import Path

from wiw.errors import DependencyError

MISSING_PACKAGES = "a local vision-language model needs torch and transformers: pip install 'wiw[torch,vlm]'"
TEMPLATE = (
    "{% for message in messages %}{{ message['role'] }}: {% for part in message['content'] %}"
    "{% if part['type'] == 'image' %}<image>{% else %}{{ part['text'] }}{% endif %}{% endfor %}\n{% endfor %}"
    "{% if add_generation_prompt %}assistant: {% endif %}"
)
WORDS = ("the", "chair", "table", "door", "forward", "left", "right", "turn", "turn_left", "turn_right", "answer")


def make_tiny(folder: str | Path, seed: int = 0) -> Path:
    """Write a LLaVA of 30 thousand random parameters with its processor, as `from_pretrained` expects.

    Images become 49 tokens each; the tokenizer knows printable ASCII and a few words.

    Raises:
        DependencyError: torch or transformers is not installed.
    """
    try:
        import torch
        import transformers as hf
        from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil
    except ImportError as error:
        raise DependencyError(f"{MISSING_PACKAGES}: {error}") from None
    pieces = ["<unk>", "<s>", "</s>", "<pad>", "\u2581", *(chr(code) for code in range(33, 127)), "\n"]
    pieces += [f"\u2581{word}" for word in WORDS] + [f"\u2581{letter}" for letter in "ABCDEFGHIJKLMNOPQRSTUVWXYZ"]
    tokenizer = hf.LlamaTokenizerFast(vocab={piece: i for i, piece in enumerate(pieces)}, merges=[])
    tokenizer.add_special_tokens({"additional_special_tokens": ["<image>"], "pad_token": "<pad>"})
    tokenizer.chat_template = TEMPLATE
    vision = hf.CLIPVisionConfig(
        hidden_size=16, intermediate_size=32, num_hidden_layers=2, num_attention_heads=2, image_size=56, patch_size=8,
        projection_dim=16,
    )  # fmt: skip
    text = hf.LlamaConfig(
        vocab_size=len(tokenizer), hidden_size=16, intermediate_size=32, num_hidden_layers=2, num_attention_heads=2,
        num_key_value_heads=2, max_position_embeddings=8192, bos_token_id=1, eos_token_id=2, pad_token_id=3,
    )  # fmt: skip
    image_token = int(tokenizer.get_vocab()["<image>"])
    config = hf.LlavaConfig(vision_config=vision, text_config=text, image_token_index=image_token)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = hf.LlavaForConditionalGeneration(config).eval()
    pixels = CLIPImageProcessorPil(size={"shortest_edge": 56}, crop_size={"height": 56, "width": 56})
    processor = hf.LlavaProcessor(
        image_processor=pixels, tokenizer=tokenizer, patch_size=8, vision_feature_select_strategy="default",
        chat_template=TEMPLATE, image_token="<image>", num_additional_image_tokens=1,
    )  # fmt: skip
    folder = Path(folder)
    model.save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder
