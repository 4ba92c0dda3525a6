# SPDX-License-Identifier: Apache-2.0
"""A model in this process, through the auto classes of `transformers`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from hashlib import blake2b
from itertools import takewhile
from pathlib import Path
from typing import Any

from wiw.errors import DependencyError, WeightsError
from wiw.vlm.base import Client
from wiw.vlm.choices import LETTER_CONTEXT
from wiw.vlm.instances import generate_instance
from wiw.vlm.messages import Call, Completion, Message
from wiw.vlm.tiny import MISSING_PACKAGES

MAX_FIRST_TOKENS = 256
"""Number of likeliest first tokens that are considered."""


class TransformersClient(Client):
    """Queries a local image-text-to-text model, one request after the other.

    Multiple choice reads the scores of the first token. Objects that match a schema are built by letting the model
    choose between the schema's continuations, so that they are always well-formed.

    Args:
        path: a folder or hub name that `AutoModelForImageTextToText.from_pretrained` takes.
        device: of torch; None means a GPU if there is one.
        dtype: of the weights, such as "bfloat16"; None means as they were saved.
        options: see `Client`.

    Raises:
        DependencyError: torch or transformers is not installed.
        WeightsError: the model cannot be loaded.
    """

    def __init__(
        self, path: str | Path, *, device: str | None = None, dtype: str | None = None, **options: Any
    ) -> None:
        super().__init__(**options)
        self.path, self._given = str(path), {"device": device, "dtype": dtype, **options}
        try:
            import torch
            import transformers as hf
        except ImportError as error:
            raise DependencyError(f"{MISSING_PACKAGES}: {error}") from None
        self.device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        try:
            self._processor = hf.AutoProcessor.from_pretrained(self.path)
            network: Any = hf.AutoModelForImageTextToText.from_pretrained(self.path, dtype=dtype or "auto")
        except (OSError, ValueError) as error:
            raise WeightsError(
                f"{self.path}: cannot load a vision-language model from there: {error}. Expected a folder with "
                "config.json, weights and processor, or a hub name that this machine can reach"
            ) from error
        self._network = network.to(self.device).eval()

    def __reduce__(self) -> Any:
        return _recreate_client, (self.path, self._given)

    @property
    def model(self) -> str:
        """The folder's name, or the hub's."""
        return Path(self.path).name if Path(self.path).exists() else self.path

    @cached_property
    def manner(self) -> str:
        """Digest of the weights, and the device: folders of one name may hold different weights."""
        import torch

        digest = blake2b(str(getattr(self._processor, "chat_template", "")).encode(), digest_size=16)
        for name, values in sorted(self._network.state_dict().items()):
            digest.update(f"{name} {values.dtype} {tuple(values.shape)}".encode())
            digest.update(values.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
        return f"{digest.hexdigest()} {torch.device(self.device).type}"

    def complete(self, calls: Sequence[Call]) -> list[Completion]:
        """Complete the calls one after the other."""
        return [self._complete_one(call) for call in calls]

    def _complete_one(self, call: Call) -> Completion:
        inputs = self._prepare_inputs(call.messages)
        read = int(inputs["input_ids"].shape[1])
        if call.logprobs:
            listed = self._first_tokens(inputs)
            tokens_listed = [
                pair
                for rank, pair in enumerate(listed)
                if rank < call.logprobs or pair[0].strip(LETTER_CONTEXT) in call.labels
            ]
            return Completion(listed[0][0], "length", tuple(tokens_listed), read, 1)
        if call.schema is not None:
            text = self._generate_object(call)
            return Completion(text, "stop", None, read, self._count_tokens(text))
        tokens = self._generate_tokens(inputs, call)
        text = self._tokenizer.decode(tokens, skip_special_tokens=True)
        finish = "stop" if len(tokens) and tokens[-1] == self._tokenizer.eos_token_id else "length"
        return Completion(text, finish, None, read, len(tokens))

    @property
    def _tokenizer(self) -> Any:
        return self._processor.tokenizer

    def _count_tokens(self, text: str) -> int:
        return len(self._tokenizer(text, add_special_tokens=False)["input_ids"])

    def _prepare_inputs(self, messages: Sequence[Message], begun: str = "") -> Any:
        """Return the tensors of a conversation whose answer begins with `begun`."""
        from PIL import Image

        turns, images = [], []
        for message in messages:
            parts: list[dict[str, str]] = []
            for part in message.content:
                if isinstance(part, str):
                    parts.append({"type": "text", "text": part})
                else:
                    parts.append({"type": "image"})
                    images.append(Image.fromarray(part))
            turns.append({"role": message.role, "content": parts})
        text = self._processor.apply_chat_template(turns, add_generation_prompt=True, tokenize=False) + begun
        first = self._tokenizer.bos_token
        once = {"add_special_tokens": False} if first and text.startswith(first) else {}  # the template has it already
        return self._processor(text=[text], images=images or None, return_tensors="pt", **once).to(self.device)

    def _first_tokens(self, inputs: Any) -> list[tuple[str, float]]:
        import torch

        with torch.inference_mode():
            scores = torch.log_softmax(self._network(**inputs).logits[0, -1].float(), dim=-1)
        values, ids = scores.topk(min(MAX_FIRST_TOKENS, len(scores)))
        return [
            (self._tokenizer.decode([token]), value) for token, value in zip(ids.tolist(), values.tolist(), strict=True)
        ]

    def _generate_tokens(self, inputs: Any, call: Call) -> list[int]:
        import torch

        sampling = (
            {"do_sample": True, "temperature": call.temperature} if call.temperature > 0 else {"do_sample": False}
        )
        with torch.inference_mode(), torch.random.fork_rng():
            torch.manual_seed(call.seed)
            whole = self._network.generate(**inputs, max_new_tokens=call.max_tokens, **sampling)
        return list(whole[0, inputs["input_ids"].shape[1] :].tolist())

    def _generate_object(self, call: Call) -> str:
        """Generate an object that matches the schema; each choice is sampled by the model's probabilities."""
        import torch

        assert call.schema is not None
        random = torch.Generator().manual_seed(call.seed)

        def choose(before: str, options: Sequence[str]) -> int:
            if len(options) == 1:
                return 0
            scores = self._compute_logprobs(call.messages, before, options)
            if call.temperature == 0:
                return int(scores.argmax())
            return int(torch.multinomial(torch.softmax(scores / call.temperature, -1), 1, generator=random))

        return generate_instance(call.schema, choose)

    def _compute_logprobs(self, messages: Sequence[Message], before: str, options: Sequence[str]) -> Any:
        """Return the log-probability of each text after `before`, given that the model writes one of them."""
        import torch

        ways = [self._prepare_inputs(messages, before + option) for option in options]
        tokens = [way["input_ids"][0].tolist() for way in ways]
        begin = sum(1 for _ in takewhile(lambda column: len(set(column)) == 1, zip(*tokens, strict=False)))
        chances, logprobs = [], None
        for way, own in zip(ways, tokens, strict=True):
            goes_on = sum(each[: begin + 1] == own[: begin + 1] for each in tokens) > 1  # as another does
            if logprobs is None or goes_on:
                with torch.inference_mode():
                    logprobs = self._network(**way).logits[0, begin - 1 :].float().log_softmax(-1).cpu()
            chances.append(_compute_logprob(logprobs if goes_on else logprobs[:1], own, tokens, begin))
        return torch.tensor(chances)


def _compute_logprob(logprobs: Any, own: list[int], tokens: Sequence[list[int]], begin: int) -> float:
    """Return the log-probability of one of several texts, token by token, among the texts that share its beginning.

    Args:
        logprobs: log-probabilities [len(own) - begin + 1, V] of the tokens after the first `begin`.
        own: the text's tokens.
        tokens: the tokens of all texts.
        begin: number of first tokens that all texts share.
    """
    chance = 0.0
    for place, following in enumerate(logprobs, start=begin):
        alike = [each for each in tokens if each[:place] == own[:place]]
        ways = following[sorted({each[place] for each in alike if len(each) > place})].logsumexp(0)
        if place == len(own):
            chance += float((1 - ways.exp()).clamp(min=1e-30).log())
        elif min(map(len, alike)) > place:
            chance += float(following[own[place]] - ways)
        else:
            chance += float(following[own[place]])
    return chance


def _recreate_client(path: str, options: dict[str, Any]) -> TransformersClient:
    return TransformersClient(path, **options)
