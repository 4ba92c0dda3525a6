# SPDX-License-Identifier: Apache-2.0
"""What a user could pick instead, one file each: `Peer(arrays)` draws `perspective(pose)`, `panorama(pose)`."""
