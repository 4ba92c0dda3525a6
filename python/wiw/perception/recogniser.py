# SPDX-License-Identifier: Apache-2.0
"""The built-in recogniser: names a boxed object from any number of real and imagined glimpses, without a VLM."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, DependencyError, FileError
from wiw.files import atomic_file
from wiw.networks import single_thread
from wiw.perception.calibration import softmax
from wiw.perception.glimpses import Glimpses, join_glimpses

if TYPE_CHECKING:
    from wiw.perception.recognition_network import Network

FORMAT = "wiw-recogniser-1"


class Recogniser:
    """A trained network with its temperature.

    Args:
        network: `wiw.perception.recognition_network.Network`; its weights are rounded to half precision, in which they
            are stored, so that a loaded recogniser answers exactly as the saved one.
        categories: the names of its logits.
        temperature: divides the logits.
        card: how it was trained and evaluated, JSON-able: recipe, accuracy, calibration.
    """

    def __init__(
        self,
        network: Network,
        categories: Sequence[str],
        temperature: float = 1.0,
        card: Mapping[str, Any] | None = None,
    ) -> None:
        self.categories, self.temperature, self.card = tuple(categories), float(temperature), dict(card or {})
        self.network = network.eval()
        if len(set(self.categories)) != network.categories or len(self.categories) != network.categories:
            raise ArgumentError(
                f"Recogniser: expected {network.categories} different categories, got {list(self.categories)}"
            )
        if not (np.isfinite(self.temperature) and self.temperature > 0):
            raise ArgumentError(f"Recogniser: expected a temperature above 0, got {temperature}")
        for value in (*network.parameters(), *network.buffers()):
            if value.is_floating_point():
                value.data = value.data.half().float()

    @classmethod
    def load(cls, path: str | Path) -> Recogniser:
        """Load a recogniser from its file.

        Raises:
            DependencyError: torch or safetensors is not installed.
            FileError: there is no such file, or it is damaged or of another format.
        """
        require_torch()
        from safetensors import SafetensorError, safe_open

        from wiw.perception.recognition_network import Network

        try:
            with safe_open(path, framework="pt") as file:
                header = _parse_header(file.metadata(), path)
                weights = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 - it is no mapping
        except (OSError, SafetensorError) as error:
            raise FileError(
                f"{path}: expected weights of a recogniser (safetensors): {error}; train them with `wiw train "
                f"recogniser --out {path}`"
            ) from error
        try:
            network = Network(len(header["categories"]), int(header["width"]), bool(header.get("extents", False)))
            missing, unknown = network.load_state_dict(weights, strict=False)
            absent = [name for name in missing if not name.endswith("num_batches_tracked")]
            if absent or unknown:
                raise ValueError(f"missing {absent}, unknown {list(unknown)}")
            return cls(network, header["categories"], header["temperature"], header["card"])
        except (KeyError, TypeError, ValueError, RuntimeError, ArgumentError) as error:
            raise FileError(
                f"{path}: header and weights do not form a recogniser ({error}); train it again with `wiw train "
                f"recogniser --out {path}`"
            ) from error

    def save(self, path: str | Path) -> None:
        """Write half-precision weights with a JSON header, atomically.

        Raises:
            FileError: the file cannot be written.
        """
        from safetensors.torch import save

        from wiw.perception.recognition_network import select_float_state

        header = {
            "categories": list(self.categories),
            "width": self.network.width,
            "extents": self.network.extents,
            "temperature": self.temperature,
            "card": self.card,
        }
        weights = {name: value.half().contiguous() for name, value in select_float_state(self.network).items()}
        metadata = {"format": FORMAT, "header": json.dumps(header, sort_keys=True)}
        with atomic_file(Path(path)) as draft:
            draft.write_bytes(save(weights, metadata))

    def __call__(self, sets: Sequence[Glimpses], choices: Sequence[str] | None = None) -> NDArray[np.float64]:
        """Classify each target by all its glimpses: float64 [sets, choices], rows sum to 1.

        A target without glimpses gets equal probabilities. Rows do not depend on the other sets.

        Args:
            sets: glimpses of one target each, real and imagined.
            choices: the possible answers; None means `categories`. Probabilities of other categories are dropped, and
                the rest scaled to sum to 1.

        Raises:
            ArgumentError: a choice that the recogniser was not trained on.
        """
        columns = self._find_columns(self.categories if choices is None else choices)
        return softmax(self.compute_logits(sets)[:, columns], self.temperature)

    def compute_logits(self, sets: Sequence[Glimpses]) -> NDArray[np.float64]:
        """Return float64 [sets, categories], before the temperature."""
        import torch

        from wiw.perception.recognition_network import to_network_input

        looks = join_glimpses(sets)
        owners = torch.from_numpy(np.repeat(np.arange(len(sets)), [len(each) for each in sets]))
        with torch.inference_mode(), single_thread():
            rows = [
                self.network.encode_glimpses(  # one at a time: how rows round may hang on how many there are
                    to_network_input(
                        torch.from_numpy(looks.images[i : i + 1]), torch.from_numpy(looks.boxes[i : i + 1])
                    ),
                    torch.from_numpy(looks.scalars[i : i + 1]),
                )
                for i in range(len(looks))
            ]
            if not rows:
                return np.zeros((len(sets), len(self.categories)))
            logits, weights = (torch.cat(column) for column in zip(*rows, strict=True))
            return self.network.fuse(logits, weights, owners, len(sets)).double().numpy()

    def _find_columns(self, choices: Sequence[str]) -> list[int]:
        unknown = sorted(set(choices) - set(self.categories))
        if unknown or not choices:
            raise ArgumentError(
                f"the recogniser does not know {', '.join(unknown) or 'an empty list of choices'}; it was trained on "
                f"{', '.join(self.categories)}: choose from these (categories=[...]), or train another with `wiw train "
                "recogniser`"
            )
        return [self.categories.index(name) for name in choices]


def require_torch() -> None:
    """Check that torch and safetensors are installed.

    Raises:
        DependencyError: saying how to install them.
    """
    try:
        import safetensors  # noqa: F401
        import torch  # noqa: F401
    except ImportError as error:
        raise DependencyError(
            f"the recogniser needs torch and safetensors ({error}): pip install 'wiw[torch]', or for CPU only pip "
            "install torch safetensors --extra-index-url https://download.pytorch.org/whl/cpu"
        ) from error


def _parse_header(metadata: Mapping[str, str] | None, path: str | Path) -> dict[str, Any]:
    if not metadata or metadata.get("format") != FORMAT:
        raise FileError(
            f"{path}: expected the format '{FORMAT}' in its header, got {(metadata or {}).get('format')!r}; these are "
            "weights of something else, or of another version"
        )
    try:
        header = json.loads(metadata["header"])
    except (KeyError, ValueError) as error:
        raise FileError(f"{path}: its header cannot be read ({error}); train it again") from error
    if not isinstance(header, dict):
        raise FileError(f"{path}: expected an object as its header, got {type(header).__name__}; train it again")
    return header
