# SPDX-License-Identifier: Apache-2.0
"""Keys of episodes under a secret salt of the run, so that nothing in them tells which episode it is."""

from __future__ import annotations

import secrets
import struct
from hashlib import blake2b

from wiw.types import Key


def draw_salt() -> str:
    """Return a random salt, 32 hexadecimal digits."""
    return secrets.token_hex(16)


def make_key(seed: int, episode: int, salt: str = "") -> Key:
    """Return the key of an episode's first decision.

    Under a salt, its two numbers are a digest of seed and index that only a holder of the salt can compute: equal in
    all arms of a run, without a relation between episodes. Without one they are seed and index themselves, as in
    environments that somebody steps by hand.
    """
    if not salt:
        return Key(seed, episode)
    secret = blake2b(salt.encode()).digest()
    return Key(*struct.unpack("<QQ", blake2b(struct.pack("<QQ", seed, episode), key=secret, digest_size=16).digest()))
