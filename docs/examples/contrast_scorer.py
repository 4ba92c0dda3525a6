# SPDX-License-Identifier: Apache-2.0
"""A scorer of images in one file: contrast, the standard deviation of grey levels over their mean.

    wiw quality runs/four --scorer "python docs/examples/contrast_scorer.py"

It needs nothing of wiw, so it may run in any environment: the card first, then an answer for each path.
"""

from __future__ import annotations

import json
import sys

import numpy as np
from PIL import Image

CARD = {"scorer": "contrast", "version": "1", "licence": "Apache-2.0", "scores": {"contrast": [0, 16]}}


def contrast(path: str) -> float:
    """Return the standard deviation of an image's grey levels over their mean."""
    with Image.open(path) as image:
        grey = np.asarray(image.convert("L"), np.float64)
    return float(grey.std() / max(grey.mean(), 1.0))


def answer(line: object) -> None:
    """Write an object as one line of JSON, at once: what is answered is kept, whatever happens next."""
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    answer(CARD)
    for asked in sys.stdin:
        file = asked.rstrip("\n")
        answer({"path": file, "scores": {"contrast": contrast(file)}})
