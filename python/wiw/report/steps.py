# SPDX-License-Identifier: Apache-2.0
"""One decision of an episode, from its row in the run store."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from wiw.report import cuts
from wiw.report.beliefs import Belief
from wiw.report.plans import Poses, Primitives
from wiw.report.story import Album, Candidate, Picture, Step
from wiw.runs.rows import select_frames

PREFIX = "believed/"
"""Prefix of the names of pictures of what policies believed."""


def step(
    row: Mapping[str, Any],
    images: Mapping[str, bytes],
    way: Primitives | Poses,
    album: Album,
    name: str,
    belief: Belief | None = None,
) -> Step:
    """Return a decision; `name` makes the names of its pictures unique."""
    seen = images.get(way.view)
    return Step(
        row["decision"] + 1,
        way.text(row["executed"]),
        album.draw(f"{name}-seen", partial(way.observation, seen, album)) if seen else None,
        tuple(_list_candidates(row, images, way, album, name)),
        way.text(row["actions"]) if row["chosen"] is None else "",
        _find_remaining_distance(row, "before"),
        _find_remaining_distance(row, "after"),
        row["note"],
        _format_fidelity(row["fidelity"]),
        row["seconds"],
        row["calls"],
        belief.text if belief is not None else "",
        ", ".join(f"{reason} ({count})" for reason, count in Counter(row["refused"]).items()),
        f"shot-{name}" if isinstance(way, Poses) else "",
        belief=belief,
        believed=_make_belief_pictures(images, album, name),
    )


def _make_belief_pictures(images: Mapping[str, bytes], album: Album, name: str) -> tuple[tuple[str, Picture], ...]:
    """Return the pictures of what the policies believed, with their names."""
    found = {title.removeprefix(PREFIX): image for title, image in images.items() if title.startswith(PREFIX)}
    size = album.belief_width, album.belief_quality, album.scale
    return tuple(
        (title.replace("_", " "), album.draw(f"{name}-believed-{index}", partial(cuts.cut_front, image, *size)))
        for index, (title, image) in enumerate(list(found.items())[: album.belief_count])
    )


def _format_fidelity(found: Mapping[str, Any] | None) -> str:
    """Return e.g. "rank agreement +0.33 · regret 0.120"."""
    said = {"rank agreement": ("rank", "{:+.2f}"), "regret": ("regret", "{:.3f}")}
    return _join_numbers(found or {}, said)


def _format_truth(found: Mapping[str, Any] | None, index: int) -> tuple[str, bool]:
    """Return the measurements of a candidate's true future, and whether it scores best."""
    if found is None:
        return "", False
    own = {name: found[name][index] for name in ("scores", "psnr", "ssim", "lpips") if name in found}
    said = {"true score": ("scores", "{:.3f}"), "PSNR": ("psnr", "{:.1f} dB"), "SSIM": ("ssim", "{:.2f}")}
    said["LPIPS"] = ("lpips", "{:.2f}")
    known = [score for score in found["scores"] if score is not None]
    return _join_numbers(own, said), own["scores"] is not None and own["scores"] == max(known)


def _join_numbers(values: Mapping[str, Any], said: Mapping[str, tuple[str, str]]) -> str:
    """Return the numbers that exist, with their names."""
    return " · ".join(
        f"{title} {form.format(values[name])}" for title, (name, form) in said.items() if values.get(name) is not None
    )


def _find_remaining_distance(row: Mapping[str, Any], when: str) -> float | None:
    geodesic, straight = row[f"{when}_geodesic"], row[f"{when}_distance"]
    known = geodesic if geodesic is not None and np.isfinite(geodesic) else straight
    return None if known is None else float(known)


def _list_candidates(
    row: Mapping[str, Any], images: Mapping[str, bytes], way: Primitives | Poses, album: Album, name: str
) -> list[Candidate]:
    proposals = row["proposals"]
    scores = row["scores"] or [None] * len(proposals)
    shares = _scale_scores(scores)
    found = []
    for index, proposal in enumerate(proposals):
        real = row["real_frames"][index] if row["real_frames"] else []
        kept = select_frames(len(real) or len(proposal["actions"]))
        shown = {
            kind: album.draw(f"{name}-{kind}-{index}", partial(way.strip, jpeg, len(kept), album))
            for kind in ("imagined", "true")
            if (jpeg := images.get(f"{kind}/{index}"))
        }
        found.append(
            Candidate(
                way.text(proposal["actions"]),
                scores[index],
                shares[index],
                index == row["chosen"],
                proposal["note"],
                shown.get("imagined"),
                shown.get("true"),
                *_format_truth(row["fidelity"], index),
                sum(real[k] for k in kept) if real else 0,
                len(kept),
                way.drawing(proposal["actions"]),
                proposal.get("text", ""),
            )
        )
    return found


def _scale_scores(scores: Sequence[float | None]) -> list[float]:
    """Return scores scaled from 0 for the worst to 1 for the best."""
    finite = [score for score in scores if score is not None]
    low, high = (min(finite), max(finite)) if finite else (0.0, 0.0)
    return [(score - low) / (high - low) if score is not None and high > low else 1.0 for score in scores]
