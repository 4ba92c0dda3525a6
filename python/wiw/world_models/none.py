# SPDX-License-Identifier: Apache-2.0
"""No world model: the same loop with imagination left out."""


def none() -> None:
    """Act without a world model: the same loop, without imagination."""
    return
