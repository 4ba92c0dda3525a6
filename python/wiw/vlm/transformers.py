# SPDX-License-Identifier: Apache-2.0
"""A model in this process, through the auto classes of `transformers`."""

from __future__ import annotations

import math
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
from wiw.vlm.json_strings import read_string
from wiw.vlm.messages import Call, Completion, Message
from wiw.vlm.tiny import MISSING_PACKAGES

MAX_FIRST_TOKENS = 256
"""Number of likeliest first tokens that are considered."""
GENERATION_VERSION = 2
"""Version of how text and objects are generated; part of the names of cached answers."""
BYTES_OF_A_CHARACTER = 4
"""Most tokens that one character may take, in a tokenizer that falls back on bytes."""


class TransformersClient(Client):
    """Queries a local image-text-to-text model, one request after the other.

    Multiple choice reads the scores of the first token. Objects that match a schema are built by letting the model
    choose between the schema's continuations and write the free strings, so that they are always well-formed.

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
        """The version of the generation, a digest of the weights, which differ between folders of one name, and the
        device.
        """
        import torch

        digest = blake2b(str(getattr(self._processor, "chat_template", "")).encode(), digest_size=16)
        for name, values in sorted(self._network.state_dict().items()):
            digest.update(f"{name} {values.dtype} {tuple(values.shape)}".encode())
            digest.update(values.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
        return f"{GENERATION_VERSION} {digest.hexdigest()} {torch.device(self.device).type}"

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
            text, whole = _ObjectWriter(self, call).generate()
            return Completion(text, "stop" if whole else "length", None, read, self._count_tokens(text))
        tokens = self._generate_tokens(inputs, call, call.max_tokens, call.seed)
        text = self._decode(tokens)
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

    def _generate_tokens(self, inputs: Any, call: Call, most: int, seed: int, **options: Any) -> list[int]:
        """Generate up to `most` tokens, sampled from all of the vocabulary unless the temperature is 0."""
        import torch

        sampling: dict[str, Any] = {"do_sample": False}
        if call.temperature > 0:  # what the model's own settings say of top_k and top_p, the request does not ask for
            sampling = {"do_sample": True, "temperature": call.temperature, "top_k": 0, "top_p": 1.0}
        with torch.inference_mode(), torch.random.fork_rng():
            torch.manual_seed(seed)
            whole = self._network.generate(**inputs, max_new_tokens=most, **sampling, **options)
        return list(whole[0, inputs["input_ids"].shape[1] :].tolist())

    def _decode(self, tokens: Any) -> str:
        return str(self._tokenizer.decode(tokens, skip_special_tokens=True, clean_up_tokenization_spaces=False))

    @cached_property
    def _unwritten_tokens(self) -> list[int]:
        """Special tokens that are no part of a text and do not end one, such as an image's."""
        ends = self._network.generation_config.eos_token_id
        return sorted({*self._tokenizer.all_special_ids} - {*(ends if isinstance(ends, list) else [ends])})

    @cached_property
    def _closing_tokens(self) -> list[int]:
        """Tokens that may end a string: those with a quote, and the special ones."""
        quoting = (token for piece, token in self._tokenizer.get_vocab().items() if '"' in piece)
        return sorted({*quoting, *self._tokenizer.all_special_ids})

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


class _ObjectWriter:
    """Lets a model generate one object that matches the call's schema, by its probabilities at the temperature."""

    def __init__(self, client: TransformersClient, call: Call) -> None:
        import torch

        self.client, self.call, self.whole = client, call, True
        self.random = torch.Generator().manual_seed(call.seed)

    def generate(self) -> tuple[str, bool]:
        """Return the object's text, and whether no string was cut off because of the call's limit on tokens."""
        assert self.call.schema is not None
        return generate_instance(self.call.schema, self.choose, self.write), self.whole

    def choose(self, before: str, options: Sequence[Sequence[str]]) -> int:
        """Return the index of an option; its probability is that of all its texts together."""
        import torch

        if len(options) == 1:
            return 0
        texts = list(dict.fromkeys(text for option in options for text in option))
        logprobs = self.client._compute_logprobs(self.call.messages, before, texts)
        scores = torch.stack([logprobs[[texts.index(text) for text in option]].logsumexp(0) for option in options])
        if self.call.temperature == 0:
            return int(scores.argmax())
        return int(torch.multinomial(torch.softmax(scores / self.call.temperature, -1), 1, generator=self.random))

    def write(self, before: str, least: int, most: int | None) -> str:
        """Return a string that the model writes up to its closing quote, at most half of the tokens that are left: the
        names and values that follow need some, too.
        """
        client, left = self.client, self.call.max_tokens - self.client._count_tokens(before)
        limit = max(1, left // 2, BYTES_OF_A_CHARACTER * least)
        inputs = client._prepare_inputs(self.call.messages, before + '"')
        begin = int(inputs["input_ids"].shape[1])

        def has_ended(tokens: Any, _: Any, **__: Any) -> Any:
            text, closed = read_string(client._decode(tokens[0, begin:]))
            return tokens.new_full((1,), closed or (most is not None and len(text) >= most), dtype=bool)

        def keep_open(tokens: Any, scores: Any) -> Any:
            if len(read_string(client._decode(tokens[0, begin:]))[0]) < least:
                scores[:, client._closing_tokens] = -math.inf
            return scores

        options = {"stopping_criteria": [has_ended], "logits_processor": [keep_open] if least else []}
        options["suppress_tokens"] = client._unwritten_tokens
        tokens = client._generate_tokens(inputs, self.call, limit, self._draw_seed(), **options)
        text, closed = read_string(client._decode(tokens))
        full = most is not None and len(text) >= most
        self.whole &= closed or full or len(tokens) < limit
        return text[:most]

    def _draw_seed(self) -> int:
        """Draw a seed for one string: strings of one object differ, and the order of calls does not count."""
        import torch

        return int(torch.randint(2**31, (1,), generator=self.random))


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
