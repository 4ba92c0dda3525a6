# SPDX-License-Identifier: Apache-2.0
"""The user's own models and policies in separate processes, which never held a simulator; see `docs/firewall.md`."""
