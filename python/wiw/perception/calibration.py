# SPDX-License-Identifier: Apache-2.0
"""Calibration of confidences: temperature scaling and expected calibration error (Guo et al. 2017)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw.errors import ArgumentError

TEMPERATURE_BOUNDS = (0.05, 20.0)
"""Minimum and maximum temperature."""


def softmax(logits: ArrayLike, temperature: float = 1.0) -> NDArray[np.float64]:
    """Return the probabilities [N, C] of logits [N, C]."""
    scaled = np.asarray(logits, np.float64) / temperature
    powers = np.exp(scaled - scaled.max(axis=-1, keepdims=True))
    return powers / powers.sum(axis=-1, keepdims=True)


def fit_temperature(logits: ArrayLike, labels: ArrayLike) -> float:
    """Return the temperature that minimises the labels' mean negative log-likelihood.

    Args:
        logits: [N, C], N >= 1.
        labels: int [N].

    Raises:
        ArgumentError: arrays of other shapes, or empty ones.
    """
    from scipy.optimize import minimize_scalar

    values, chosen = _check_arrays(logits, labels)

    def loss(log_temperature: float) -> float:
        scaled = values / np.exp(log_temperature)
        peak = scaled.max(axis=1)
        totals = peak + np.log(np.exp(scaled - peak[:, None]).sum(axis=1))
        return float((totals - scaled[np.arange(len(chosen)), chosen]).mean())

    found = minimize_scalar(loss, bounds=tuple(np.log(TEMPERATURE_BOUNDS)), method="bounded")
    return float(np.exp(found.x))


def calibration_error(probabilities: ArrayLike, labels: ArrayLike, bins: int = 15) -> float:
    """Return the expected calibration error: mean |accuracy - confidence| over equal bins of confidence, weighted by
    count.

    Args:
        probabilities: [N, C], N >= 1.
        labels: int [N].
        bins: number of bins.

    Raises:
        ArgumentError: arrays of other shapes, or empty ones.
    """
    values, chosen = _check_arrays(probabilities, labels)
    confidence = values.max(axis=1)
    gap = (values.argmax(axis=1) == chosen) - confidence
    rows = np.clip(np.ceil(confidence * bins).astype(int) - 1, 0, bins - 1)
    return float(np.abs(np.bincount(rows, gap, bins)).sum() / len(chosen))


def _check_arrays(values: ArrayLike, labels: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    table, chosen = np.asarray(values, np.float64), np.asarray(labels, np.int64)
    fits = table.ndim == 2 and chosen.shape == table.shape[:1] and len(table) > 0
    if not fits or chosen.min() < 0 or chosen.max() >= table.shape[1]:
        raise ArgumentError(
            f"calibration: expected values [N, C] and labels [N] from 0 to C - 1, got {table.shape}, {chosen.shape}"
        )
    return table, chosen
